"""From recordings and a nominal model to a problem."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C, Motion, effect
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.smoother import estimate_noise
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.fmu_force import with_mockups
from rig.diagnosis.problem.free_run import FreeRun, Run, run_of, system
from rig.diagnosis.problem.grid import (
    Grid,
    SmoothMotion,
    grid_of,
    smooth_motion,
    with_blocks_kept,
)
from rig.diagnosis.problem.mechanism import Mechanism, Readers, constant, readers, tabulated
from rig.diagnosis.problem.prescribed_motion import Drive, Prescribed, drive_of, noise_of
from rig.diagnosis.problem.problem import (
    Candidate,
    Existing,
    LinearParameter,
    Parts,
    Problem,
    ResidualForces,
    Track,
    existing_values,
    nominal,
)
from rig.diagnosis.recording import Recording, RecordingError, checked

Array = NDArray[np.float64]

_LONGEST_DURATION_S = 600.0
"""A longer recording says nothing new of a strut, and takes minutes."""
_LEAST_SWING = 5.0
"""Motion over sensor noise below which no law can be read off."""
_IMPLAUSIBLE = 5.0
"""Times the largest deflection that the load could cause from which on columns are mixed up."""
_OTHER_UNITS = 100.0
"""Model's over measured force from which on the units are not those of the columns."""
_OPPOSITE = -0.6
"""Correlation of model and load cell from which on the cell's sign is the other one."""
_NEGLIGIBLE = 1e-9
"""Share of the strut's force below which an existing effect does not act on the recordings."""
_TONES = 4
_LEAST_BLOCK_S = 0.1
_MOSTLY = 0.5
"""Share of a piece that takes part in fits, for it to be looked at."""


_Shared = tuple[
    ModelSpec, tuple[LinearParameter, ...], tuple[Existing, ...], tuple[Motion, ...], float, Readers
]
"""What problems of one diagnosis share, as they take it."""


def is_prescribed(recordings: Sequence[Recording]) -> bool:
    """Whether the motion of the recordings is prescribed: a load cell, and no applied force.

    Raises:
        RecordingError: Some are of one kind and some of the other.
    """
    prescribed = [recording.applied_force_n is None for recording in recordings]
    if any(prescribed) and not all(prescribed):
        dyno = recordings[prescribed.index(True)].name
        driven = recordings[prescribed.index(False)].name
        raise RecordingError(
            f"{dyno}: has strut_force_n alone, so its motion is prescribed, and {driven} has "
            "applied_force_n: expected runs of one kind, diagnose the others by themselves"
        )
    return all(prescribed)


def build(
    spec: ModelSpec, recordings: Sequence[Recording], blocks: int, kept_every: int | None
) -> FreeRun | Prescribed:
    """The problem of recordings that are learnt from.

    Args:
        spec: The nominal model.
        recordings: Runs, of one kind.
        blocks: Blocks of cross-validation over all of them.
        kept_every: One block of so many is held out to be judged on; none if absent.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    for recording in recordings:
        _check_fits(recording, spec)
    length = sum(recording.duration_s for recording in recordings)
    block_s = max(length / blocks, _LEAST_BLOCK_S)
    pairs = [grid_of(recording) for recording in recordings]
    if kept_every is not None:
        pairs = [(with_blocks_kept(grid, block_s, kept_every), at) for grid, at in pairs]
    grids = [grid for grid, _ in pairs]
    read = readers(spec)
    smoothed = [smooth_motion(grid) for grid in grids]
    tracks = [motion for motion, _, _ in smoothed]
    motions = _motions(spec, grids, tracks, _measured_n(recordings))
    mechanism = _mechanism(read, tracks[0])
    masses = [linear_part.moving_mass_kg(mechanism, i) for i in range(len(motions))]
    motions = tuple(m._replace(mass_kg=mass) for m, mass in zip(motions, masses, strict=True))
    bench = "motion_given" if is_prescribed(recordings) else "force_given"
    linear = linear_part.parameters(spec, bench, motions, mechanism)
    existing = _existing(spec, tracks)
    return _problem((spec, linear, existing, motions, block_s, read), recordings, pairs, smoothed)


def build_held_out(learnt: Problem, recordings: Sequence[Recording]) -> FreeRun | Prescribed:
    """The problem of recordings that are judged on, in terms of those that were learnt from.

    Raises:
        RecordingError: A recording cannot be used.
    """
    for recording in recordings:
        _check_fits(recording, learnt.spec)
    pairs = [grid_of(recording) for recording in recordings]
    shared = (
        learnt.spec, learnt.linear, learnt.existing, learnt.motions, learnt.block_s, learnt.read
    )  # fmt: skip
    return _problem(shared, recordings, pairs, [smooth_motion(grid) for grid, _ in pairs])


def _problem(
    shared: _Shared,
    recordings: Sequence[Recording],
    pairs: Sequence[tuple[Grid, NDArray[np.int64]]],
    smoothed: Sequence[SmoothMotion],
) -> FreeRun | Prescribed:
    spec, *_, read = shared
    if is_prescribed(recordings):
        if any(strut.fmu is not None for strut in spec.struts):
            raise RecordingError(
                f"model {spec.name}: an FMU, and runs whose motion is prescribed: expected runs "
                "with applied_force_n"
            )
        drives = tuple(
            drive_of(grid, at, recording, smooth)
            for (grid, at), recording, smooth in zip(pairs, recordings, smoothed, strict=True)
        )
        problem = Prescribed(*shared, drives, noise_of(spec, drives))
        for drive in drives:
            _check_drive(drive, _nominal_forces(problem, drive))
        return problem
    runs: list[Run] = []
    for (grid, _), recording, (motion, _, _) in zip(pairs, recordings, smoothed, strict=True):
        if recording.applied_force_n is None:
            raise RecordingError(f"{recording.name}: expected a column applied_force_n")
        applied = (recording.t_s, recording.applied_force_n)
        mechanism = _mechanism(read, motion._replace(applied_n=np.interp(grid.t_s, *applied)))
        _check_columns(spec, recording, mechanism)
        runs.append(run_of(grid, applied, mechanism, _fastest(spec, mechanism)))
    problem = FreeRun(*shared, tuple(runs), np.full(len(spec.struts), np.inf))
    for run in runs:
        _check_swing(run.grid)
    return with_noise(problem, nominal(problem), None)


def part_of(problem: Problem, most: int) -> Problem:
    """The problem of pieces spread over long recordings; itself up to twice as many nodes.

    Args:
        problem: The problem.
        most: Nodes of all recordings that are taken.
    """
    flags = [problem.fitted(k) for k in range(problem.recordings)]
    nodes = sum(map(len, flags))
    if nodes < 2 * most:
        return problem
    pieces = [
        (k, piece)
        for k, fitted in enumerate(flags)
        for piece in track.pieces(len(fitted), nodes, most, 1)
        if float(np.mean(fitted[piece])) > _MOSTLY
    ]
    if not pieces:
        return problem
    share = sum(piece.stop - piece.start for _, piece in pieces) / nodes
    return replace(problem.cut(pieces), block_s=max(share * problem.block_s, _LEAST_BLOCK_S))


def with_noise(problem: FreeRun, candidate: Candidate, parts: Parts | None) -> FreeRun:
    """The problem with the sensors' noise as a model's free run leaves it, or an earlier one's.

    Args:
        problem: The problem.
        candidate: The model's effects.
        parts: Its parameters; the nominal model from the measured start if absent.
    """
    variances: list[Array] = []
    for k, run in enumerate(problem.runs):
        begin = problem.start(k, candidate) if parts is None else parts.starts[k]
        whole = Parts(
            np.zeros(len(problem.linear)) if parts is None else parts.linear,
            existing_values(problem, candidate) if parts is None else parts.effects,
            (begin,),
        )
        there = problem.simulated(run, candidate, whole, begin)
        heights = run.grid.heights_m
        left = heights - np.nanmean(heights, axis=0) if there is None else heights - there.heights_m
        variances.append(
            np.array([estimate_noise(run.grid.t_s, column).variance for column in left.T])
        )
    # A residual is noise and what the model errs by, of which a part looks like noise: whichever
    # model leaves least is nearest.
    noise = np.minimum(np.sqrt(np.median(variances, axis=0)), problem.noise_m)
    return replace(problem, noise_m=np.maximum(noise, 1e-300))


def with_tones(problem: Problem, residual: Sequence[ResidualForces]) -> tuple[Motion, ...]:
    """Motions with the size and the strongest lines of a residual force."""
    found: list[Motion] = []
    for i, motion in enumerate(problem.motions):
        longest = max(residual, key=lambda forces: len(forces.track.t_s))
        force = longest.force_n[i]
        if not np.all(np.isfinite(force)):
            found.append(motion)
            continue
        rms = float(np.sqrt(np.mean(force**2)))
        least_hz, _ = effect("periodic_force").bounds(motion)["frequency_hz"]
        found.append(motion._replace(force_n=rms, tones=_tones(longest.track.t_s, force, least_hz)))
    return tuple(found)


def _tones(t_s: Array, force: Array, least_hz: float) -> tuple[tuple[float, float], ...]:
    """Frequency (Hz, at least so much) and phase (rad) of the strongest lines of a force.

    One after another, each taken out before the next, slower ones too: a window's side lobes are no
    lines.
    """
    step = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    left = force - force.mean()
    found: list[tuple[float, float]] = []
    window = np.hanning(len(left))
    size = 4 * len(left)
    for _ in range(2 * _TONES):
        spectrum = np.fft.rfft(left * window, size)
        best = 4 + int(np.argmax(np.abs(spectrum[4:-4])))
        frequency = best / (size * step)
        carrier = 2.0 * np.pi * frequency * t_s
        columns = np.column_stack([np.sin(carrier), np.cos(carrier)])
        (sine, cosine), *_ = np.linalg.lstsq(columns, left, rcond=None)
        if frequency >= least_hz:
            found.append((frequency, float(np.arctan2(cosine, sine))))
        left = left - columns @ np.array([sine, cosine])
    return tuple(found[:_TONES])


def _measured_n(recordings: Sequence[Recording]) -> float:
    """Largest standard deviation of a measured force."""
    channels = ((r.applied_force_n, r.strut_forces_n) for r in recordings)
    return max(float(np.nanstd(c)) for pair in channels for c in pair if c is not None)


def _motions(
    spec: ModelSpec, grids: Sequence[Grid], tracks: Sequence[Track], measured_n: float
) -> tuple[Motion, ...]:
    warm = [grid.temperature_c for grid in grids if grid.has_temperature]
    celsius = (AMBIENT_C, AMBIENT_C)
    if warm:
        celsius = (float(min(w.min() for w in warm)), float(max(w.max() for w in warm)))
    found: list[Motion] = []
    for i, strut in enumerate(spec.struts):
        z = np.concatenate([t.heights_m[i] for t in tracks])
        w = np.concatenate([t.velocities_m_per_s[i] for t in tracks])
        stroke = float(z.max() - z.min())
        force = strut.stiffness_n_per_m * stroke + strut.damping_n_s_per_m * float(np.std(w))
        found.append(
            Motion(
                float(z.min()),
                float(z.max()),
                float(np.sqrt(np.mean(w**2))),
                float(np.max(np.abs(w))),
                min(float(np.ptp(t.heights_m[i])) for t in tracks),
                max(grid.duration_s for grid in grids),
                float(np.median([grid.step_s for grid in grids])),
                strut.free_length_m,
                strut.stiffness_n_per_m,
                strut.damping_n_s_per_m,
                1.0,
                force or measured_n,
                celsius,
                (),
            )
        )
    return tuple(found)


def _mechanism(read: Readers, motion: Track) -> Mechanism:
    if read.plain.is_constant:
        here = constant(read)
    else:
        here = tabulated(read, motion.heights_m.T, motion.velocities_m_per_s.T)
    return with_mockups(here, read.plain, motion)


def _fastest(spec: ModelSpec, m: Mechanism) -> float:
    """Largest eigenvalue of the model without effects, by size."""
    constants = np.array([(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in spec.struts])
    jacobian, mass = m.jacobian.mean(axis=0), m.mass.mean(axis=0)
    stiffness = jacobian.T @ np.diag(constants[:, 0]) @ jacobian - m.bias_q.mean(axis=0)
    damping = jacobian.T @ np.diag(constants[:, 1]) @ jacobian - m.bias_v.mean(axis=0)
    poles = np.linalg.eigvals(system(mass, stiffness, damping))
    return max(float(np.max(np.abs(poles))), 1e-9)


def _existing(spec: ModelSpec, tracks: Sequence[Track]) -> tuple[Existing, ...]:
    found: list[Existing] = []
    constants = np.array(
        [
            (s.free_length_m, s.stiffness_n_per_m, s.damping_n_s_per_m, spec.gravity_m_per_s2)
            for s in spec.struts
        ]
    )
    for i, strut in enumerate(spec.struts):
        for item in strut.effects:
            values = tuple(item.values())
            spring = max(float(np.std(t.heights_m[i])) * strut.stiffness_n_per_m for t in tracks)
            acting = not effect(item.name).linear and item.name != "restoring_surface"
            if acting and item.name != "delay":
                forces = [
                    track.law_force(t, i, item.name, np.array(values), constants) for t in tracks
                ]
                acting = any(float(np.max(np.abs(f))) > _NEGLIGIBLE * spring for f in forces)
            found.append(Existing(i, item.name, values, acting))
    return tuple(found)


# --- what cannot be what its name says --------------------------------------------------------


def _check_fits(recording: Recording, spec: ModelSpec) -> None:
    checked(recording)
    struts = len(spec.struts)
    if recording.heights_m.shape[1] != struts:
        raise RecordingError(
            f"{recording.name}: {recording.heights_m.shape[1]} heights, model {spec.name} has "
            f"{struts} struts, expected one height for each"
        )
    if recording.duration_s > _LONGEST_DURATION_S:
        raise RecordingError(
            f"{recording.name}: {recording.duration_s:.0f} s long, "
            f"expected at most {_LONGEST_DURATION_S:.0f} s: cut it"
        )


def _check_swing(grid: Grid) -> None:
    for column in grid.heights_m.T:
        swing = float(np.nanstd(column))
        noise = float(np.sqrt(estimate_noise(grid.t_s, column).variance))
        if swing < _LEAST_SWING * noise:
            raise RecordingError(
                f"{grid.name}: height_m moves by {swing:.3g} m RMS and its noise is {noise:.3g} m, "
                "expected a run with more motion: apply a larger force, or widen the stroke"
            )


def _check_columns(spec: ModelSpec, recording: Recording, mechanism: Mechanism) -> None:
    load = float(np.max(np.abs(mechanism.bias)))
    if recording.applied_force_n is not None:
        load += float(np.max(np.abs(recording.applied_force_n)))
    for strut, height_m in zip(spec.struts, recording.heights_m.T, strict=True):
        if strut.stiffness_n_per_m <= 0.0:
            continue
        bend = load / strut.stiffness_n_per_m
        middle = float(np.nanmedian(height_m))
        if abs(middle - strut.free_length_m) > _IMPLAUSIBLE * (abs(strut.free_length_m) + bend):
            raise RecordingError(
                f"{recording.name}: height_m is {middle:.3g} m in the middle of the run, but a "
                f"load of at most {load:.3g} N bends the model's strut by {bend:.3g} m: expected "
                "heights near its free length: are the columns swapped, or the units wrong?"
            )


def _nominal_forces(problem: Prescribed, drive: Drive) -> Array:
    base = nominal(problem)
    parts = Parts(np.zeros(len(problem.linear)), existing_values(problem, base), ())
    return track.strut_forces(problem, base, parts, drive.along, problem.start(0, base))


def _check_drive(drive: Drive, given_n: Array) -> None:
    """Refuse channels of a dyno that cannot be what their names say."""
    name = drive.grid.name
    _check_swing(drive.grid)
    if not np.any(np.isfinite(drive.cells_n)):
        raise RecordingError(f"{name}: expected strut_force_n of one strut at least")
    for cell, model, noise in zip(drive.cells_n, given_n, drive.cell_noise_n, strict=True):
        if not np.all(np.isfinite(cell)):
            continue
        force, law = cell - cell.mean(), model - model.mean()
        swing, own = float(np.std(force)), float(np.std(law))
        if swing < _LEAST_SWING * noise:
            raise RecordingError(
                f"{name}: strut_force_n moves by {swing:.3g} N RMS and its noise is {noise:.3g} N, "
                "expected a force that stands out of its noise: is the load cell connected?"
            )
        if own > _OTHER_UNITS * swing:
            raise RecordingError(
                f"{name}: along height_m the model gives {own:.3g} N RMS and strut_force_n shows "
                f"{swing:.3g} N: expected the same order: are the units m and N, or columns "
                "swapped?"
            )
        if own > 0.0 and float(np.mean(force * law)) < _OPPOSITE * swing * own:
            raise RecordingError(
                f"{name}: strut_force_n goes against the model's force (correlation "
                f"{np.mean(force * law) / (swing * own):.2f}), expected a force that is positive "
                "where the strut pushes its bodies apart: turn its sign"
            )
