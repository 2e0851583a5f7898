"""From recordings and a nominal model to problems: one to learn from, one to evaluate on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import Motion, effect
from dart_model.spec import ModelSpec
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.fmu_force import mechanism_along
from rig.diagnosis.problem.free_run import FreeRunProblem
from rig.diagnosis.problem.grid import (
    NO_TEMPERATURE_C,
    HeldOutBlocks,
    SmoothRecording,
    smooth_recording,
)
from rig.diagnosis.problem.mechanism import open_plants
from rig.diagnosis.problem.prescribed_motion import PrescribedProblem
from rig.diagnosis.problem.problem import (
    ExistingParameters,
    Problem,
    ProblemBasis,
    ResidualForces,
)
from rig.diagnosis.recording import Recording, RecordingError, check_recording

Array = NDArray[np.float64]

_LONGEST_DURATION_S = 600.0
"""A longer recording adds nothing about a strut, and takes minutes."""
_NEGLIGIBLE = 1e-9
"""Share of the strut's force below which an existing effect does not act on the recordings."""
_TONES = 4
_LEAST_BLOCK_S = 0.1
_MOSTLY = 0.5
"""Share of a piece that takes part in fits from which on the piece is taken."""


class Problems(NamedTuple):
    """The problems of a diagnosis.

    Attributes:
        learnt: That of the recordings that are learnt from.
        evaluated: That of the held-out runs; `learnt`, with blocks held out, where there are none.
    """

    learnt: Problem
    evaluated: Problem

    @property
    def by_blocks(self) -> bool:
        """Whether blocks are held out, not runs."""
        return self.evaluated is self.learnt


def build_problems(
    spec: ModelSpec,
    runs: Sequence[Recording],
    held_out: Sequence[Recording],
    blocks: int,
    held_out_every: int,
) -> Problems:
    """The problems of recordings.

    Args:
        spec: The nominal model.
        runs: Recordings to learn from, all of one kind.
        held_out: Recordings to evaluate on; without them, blocks of `runs` are held out.
        blocks: Blocks of cross-validation over all of `runs`.
        held_out_every: Without held-out runs, one block in so many is held out.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    problem_kind((*runs, *held_out))
    learnt = build(spec, runs, blocks, None if held_out else held_out_every)
    if not held_out:
        return Problems(learnt, learnt)
    for recording in held_out:
        _check_fits(recording, spec)
    smooth = [smooth_recording(recording, None) for recording in held_out]
    return Problems(learnt, type(learnt).of_recordings(learnt.basis, smooth))


def build(
    spec: ModelSpec, recordings: Sequence[Recording], blocks: int, held_out_every: int | None
) -> Problem:
    """The problem of recordings that are learnt from.

    Args:
        spec: The nominal model.
        recordings: Runs, of one kind.
        blocks: Blocks of cross-validation over all of them.
        held_out_every: One block in so many is held out of fits; none if absent.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    kind = problem_kind(recordings)
    for recording in recordings:
        _check_fits(recording, spec)
    length = sum(recording.duration_s for recording in recordings)
    block_s = max(length / blocks, _LEAST_BLOCK_S)
    held_out = None if held_out_every is None else HeldOutBlocks(block_s, held_out_every)
    smooth = [smooth_recording(recording, held_out) for recording in recordings]
    plants = open_plants(spec)
    motions = _motions(spec, smooth)
    mechanism = mechanism_along(plants, smooth[0].motion)
    masses = [linear_part.moving_mass_kg(mechanism, i) for i in range(len(motions))]
    motions = tuple(m._replace(mass_kg=mass) for m, mass in zip(motions, masses, strict=True))
    linear = linear_part.linear_parameters(spec, kind.bench, motions, mechanism)
    existing = _existing(spec, [recording.motion for recording in smooth])
    basis = ProblemBasis(spec, linear, existing, motions, block_s, plants)
    return kind.of_recordings(basis, smooth)


def problem_kind(recordings: Sequence[Recording]) -> type[Problem]:
    """The kind of problem of recordings: with a load cell and no applied force, prescribed motion.

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
    return PrescribedProblem if all(prescribed) else FreeRunProblem


def part_of(problem: Problem, most: int) -> Problem:
    """The problem of pieces spread over long recordings; itself with up to twice as many nodes.

    Args:
        problem: The problem.
        most: Nodes of all recordings that are taken, about.
    """
    flags = [problem.fit_nodes(k) for k in range(problem.recordings)]
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


def with_tones(problem: Problem, residual: Sequence[ResidualForces]) -> tuple[Motion, ...]:
    """Motions with the size and the strongest lines of a residual force."""
    motions: list[Motion] = []
    for i, motion in enumerate(problem.motions):
        longest = max(residual, key=lambda forces: len(forces.track.t_s))
        force = longest.force_n[i]
        if not np.all(np.isfinite(force)):
            motions.append(motion)
            continue
        rms = float(np.sqrt(np.mean(force**2)))
        least_hz, _ = effect("periodic_force").bounds(motion)["frequency_hz"]
        motions.append(
            motion._replace(force_n=rms, tones=_tones(longest.track.t_s, force, least_hz))
        )
    return tuple(motions)


def _tones(t_s: Array, force: Array, least_hz: float) -> tuple[tuple[float, float], ...]:
    """Frequency (Hz, at least `least_hz`) and phase (rad) of the strongest lines of a force.

    Lines are subtracted one after another, slower ones too: a window's side lobes are no lines.
    """
    step = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    residual = force - force.mean()
    tones: list[tuple[float, float]] = []
    window = np.hanning(len(residual))
    size = 4 * len(residual)
    for _ in range(2 * _TONES):
        spectrum = np.fft.rfft(residual * window, size)
        best = 4 + int(np.argmax(np.abs(spectrum[4:-4])))
        frequency = best / (size * step)
        carrier = 2.0 * np.pi * frequency * t_s
        columns = np.column_stack([np.sin(carrier), np.cos(carrier)])
        (sine, cosine), *_ = np.linalg.lstsq(columns, residual, rcond=None)
        if frequency >= least_hz:
            tones.append((frequency, float(np.arctan2(cosine, sine))))
        residual = residual - columns @ np.array([sine, cosine])
    return tuple(tones[:_TONES])


def _largest_force_std_n(recordings: Sequence[SmoothRecording]) -> float:
    """Largest standard deviation of a measured force."""
    channels = ((r.recording.applied_force_n, r.recording.strut_forces_n) for r in recordings)
    return max(float(np.nanstd(c)) for pair in channels for c in pair if c is not None)


def _motions(spec: ModelSpec, recordings: Sequence[SmoothRecording]) -> tuple[Motion, ...]:
    """What each strut did on the recordings."""
    grids, tracks = [r.grid for r in recordings], [r.motion for r in recordings]
    largest_n = _largest_force_std_n(recordings)
    warm = [grid.temperature_c for grid in grids if grid.has_temperature]
    celsius = (NO_TEMPERATURE_C, NO_TEMPERATURE_C)
    if warm:
        celsius = (float(min(w.min() for w in warm)), float(max(w.max() for w in warm)))
    motions: list[Motion] = []
    for i, strut in enumerate(spec.struts):
        z = np.concatenate([t.heights_m[i] for t in tracks])
        w = np.concatenate([t.velocities_m_per_s[i] for t in tracks])
        stroke = float(z.max() - z.min())
        force = strut.stiffness_n_per_m * stroke + strut.damping_n_s_per_m * float(np.std(w))
        motions.append(
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
                force or largest_n,
                celsius,
                (),
            )
        )
    return tuple(motions)


def _existing(spec: ModelSpec, tracks: Sequence[track.Track]) -> tuple[ExistingParameters, ...]:
    existing: list[ExistingParameters] = []
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
            existing.append(ExistingParameters(i, item.name, values, acting))
    return tuple(existing)


def _check_fits(recording: Recording, spec: ModelSpec) -> None:
    check_recording(recording)
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
