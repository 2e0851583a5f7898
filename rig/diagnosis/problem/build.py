"""From recordings and a nominal model to problems: one to learn from, one to evaluate on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from dart_model.effects import Motion, effect
from dart_model.spec import ModelSpec
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.channel_delays import delay_parameters
from rig.diagnosis.problem.delay_estimate import with_estimated_delays
from rig.diagnosis.problem.drive import drive_of_recording
from rig.diagnosis.problem.free_run import FreeRunProblem
from rig.diagnosis.problem.grid import SmoothRecording, smooth_recording, strut_motions
from rig.diagnosis.problem.mechanism import mechanism_along, open_plants
from rig.diagnosis.problem.prescribed_motion import PrescribedProblem
from rig.diagnosis.problem.problem import (
    Problem,
    ProblemBasis,
    ResidualForces,
    first_starts,
    nominal,
    nominal_model,
)
from rig.recordings.recording import Recording, RecordingError
from rig.recordings.recording_checks import check_fits

Array = NDArray[np.float64]

_TONES = 4
_LEAST_BLOCK_S = 0.1
_MOSTLY = 0.5
"""Share of a piece that takes part in fits from which on the piece is taken."""


class Problems(NamedTuple):
    """The problems of a diagnosis; with blocks held out, `held_out` is the learnt one."""

    learnt: Problem
    held_out: Problem
    by_blocks: bool


def build_problems(
    spec: ModelSpec,
    runs: Sequence[Recording],
    held_out: Sequence[Recording],
    blocks: int,
    held_out_every: int,
) -> Problems:
    """The problems of recordings, with a number of cross-validation blocks over all `runs`.

    Without held-out runs, one block in `held_out_every` is held out.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    problem_kind((*runs, *held_out))
    learnt = build(spec, runs, blocks, None if held_out else held_out_every)
    if not held_out:
        if not any(np.any(grid.held_out) for grid in learnt.grids):
            raise RecordingError(
                f"{', '.join(run.name for run in runs)}: no part with motion can be held out to "
                "evaluate the correction, expected motion over most of the recording: record a "
                "longer run, or give another one with --held-out"
            )
        return Problems(learnt, learnt, by_blocks=True)
    for recording in held_out:
        check_fits(recording, spec)
    smooth = _smooth(held_out)
    evaluated = _divide_at_gaps(type(learnt).of_recordings(learnt.basis, smooth), smooth)
    return Problems(learnt, evaluated, by_blocks=False)


def build(
    spec: ModelSpec, recordings: Sequence[Recording], blocks: int, held_out_every: int | None
) -> Problem:
    """The problem of recordings that are learnt from; arguments as of `build_problems`.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    return with_estimated_delays(build_without_delays(spec, recordings, blocks, held_out_every))


def build_without_delays(
    spec: ModelSpec, recordings: Sequence[Recording], blocks: int, held_out_every: int | None
) -> Problem:
    """The same before the delays of its channels are estimated.

    Raises:
        RecordingError: As of `build`.
    """
    kind = problem_kind(recordings)
    for recording in recordings:
        check_fits(recording, spec)
    length = sum(recording.duration_s for recording in recordings)
    block_s = max(length / blocks, _LEAST_BLOCK_S)
    held_out = None if held_out_every is None else (block_s, held_out_every)
    smooth = _smooth(recordings, held_out)
    plants = open_plants(spec)
    motions = strut_motions(spec, smooth)
    first = smooth[0]
    drive = drive_of_recording(spec, first.recording)
    mechanism = mechanism_along(plants, first.motion, drive.at(first.grid.t_s))
    masses = [linear_part.moving_mass_kg(spec, mechanism, i) for i in range(len(motions))]
    motions = tuple(m._replace(mass_kg=mass) for m, mass in zip(motions, masses, strict=True))
    linear = linear_part.linear_parameters(spec, kind.bench, motions, mechanism, drive)
    linear += delay_parameters(spec, first.recording)
    existing = track.existing_effects(spec, [recording.motion for recording in smooth])
    basis = ProblemBasis(spec, linear, existing, motions, block_s, plants)
    return _divide_at_gaps(kind.of_recordings(basis, smooth), smooth)


def _smooth(
    recordings: Sequence[Recording], held_out: tuple[float, int] | None = None
) -> list[SmoothRecording]:
    """Recordings on nodes and smoothed, each with its index."""
    smooth = [smooth_recording(recording, held_out) for recording in recordings]
    return [it._replace(grid=it.grid._replace(recording=k)) for k, it in enumerate(smooth)]


def _divide_at_gaps(problem: Problem, recordings: Sequence[SmoothRecording]) -> Problem:
    """The problem of the pieces between gaps of the inputs that are not interpolated.

    Raises:
        RecordingError: Less than half of a recording lies in pieces that are long enough.
    """
    if not any(it.recording.gaps and it.recording.gaps.long_s for it in recordings):
        return problem
    pieces: list[tuple[int, slice]] = []
    for k, (recording, grid, *_) in enumerate(recordings):
        gaps = recording.gaps
        between = grid.pieces_between(() if gaps is None else gaps.long_s)
        left = sum(piece.stop - piece.start for piece in between) / len(grid.t_s)
        if gaps is not None and left < _MOSTLY:
            raise RecordingError(
                f"{gaps.report(recording.name)} Only {left:.0%} of the run are left in pieces of "
                "half a second or more, expected half"
            )
        pieces += [(k, piece) for piece in between if _is_fitted(problem, k, piece)]
    divided = problem.cut(pieces)
    return divided.with_noise_of(nominal_model(divided, first_starts(divided, nominal(divided))))


def _is_fitted(problem: Problem, k: int, piece: slice) -> bool:
    """Whether most of a piece takes part in fits."""
    return float(np.mean(problem.fit_nodes(k)[piece])) > _MOSTLY


def problem_kind(recordings: Sequence[Recording]) -> type[Problem]:
    """The kind of problem of recordings: with a load cell and no input, prescribed motion.

    Raises:
        RecordingError: Some are of one kind and some of the other.
    """
    prescribed = [not recording.inputs for recording in recordings]
    if any(prescribed) and not all(prescribed):
        dyno = recordings[prescribed.index(True)].name
        driven = recordings[prescribed.index(False)].name
        raise RecordingError(
            f"{dyno}: has strut_force_n alone, so its motion is prescribed, and {driven} has an "
            "applied force or another input: expected runs of one kind, diagnose the others by "
            "themselves"
        )
    return PrescribedProblem if all(prescribed) else FreeRunProblem


def part_of(problem: Problem, most: int) -> Problem:
    """The problem of pieces of about `most` nodes in all; itself with up to twice as many."""
    lengths = [len(problem.fit_nodes(k)) for k in range(problem.recordings)]
    nodes = sum(lengths)
    if nodes < 2 * most:
        return problem
    pieces = [
        (k, piece)
        for k, length in enumerate(lengths)
        for piece in track.pieces(length, nodes, most, 1)
        if _is_fitted(problem, k, piece)
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
    size = next_fast_len(4 * len(residual), real=True)
    for _ in range(2 * _TONES):
        sizes = np.abs(np.fft.rfft(residual * window, size))
        best = 4 + int(np.argmax(sizes[4:-4]))
        # A line between two bins: the vertex of the parabola through the largest three.
        before, at, after = np.log(np.maximum(sizes[best - 1 : best + 2], 1e-300))
        beyond = 0.5 * (before - after) / min(before - 2.0 * at + after, -1e-12)
        frequency = (best + float(np.clip(beyond, -0.5, 0.5))) / (size * step)
        carrier = 2.0 * np.pi * frequency * t_s
        columns = np.column_stack([np.sin(carrier), np.cos(carrier)])
        (sine, cosine), *_ = np.linalg.lstsq(columns, residual, rcond=None)
        if frequency >= least_hz:
            tones.append((frequency, float(np.arctan2(cosine, sine))))
        residual = residual - columns @ np.array([sine, cosine])
    return tuple(tones[:_TONES])
