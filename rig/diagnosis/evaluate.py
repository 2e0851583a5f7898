"""Before and after: on data that took no part in the search, and the floor beside them.

A free run's heights are DART's, with the applied force as the only input; only the initial state,
which nobody measured, is fitted. An observer with a high gain would hide any model error.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.diagnosis.on_dart import dart_heights
from rig.diagnosis.outcome import BeforeAfter, HeldOutSeries, NoiseFloor, RunFigures
from rig.diagnosis.problem import track
from rig.diagnosis.problem.free_run import FreeRun, Trajectory, track_of
from rig.diagnosis.problem.prescribed_motion import Drive, Prescribed
from rig.diagnosis.problem.problem import (
    Candidate,
    Parts,
    Problem,
    existing_values,
    nominal,
)
from rig.diagnosis.recording import Recording, RecordingError
from rig.diagnosis.search.fit import Fit, fit

Array = NDArray[np.float64]

_DRAWS, _INPUT_DRAWS = 3, 8
"""Draws of the noise from which a floor is taken: of the motion's the third changes it by a few
percent; of the applied force's the largest counts, since a lightly damped motion answers to it in
so few independent swings that their RMS scatters by a third."""
_AGREEMENT, _ACCURACY = 0.1, 0.01
"""Share of the noise, or of the error if that is more, to which DART's steps are settled."""


class Evaluated(NamedTuple):
    """One recording, before and after.

    Attributes:
        figures: Its figures.
        linear: The figure that counts (height or load-cell error) of the best linear model.
        linear_force_n: Residual force of the best linear model.
        counted: The same before and after.
        floor: What a right model leaves.
        drift_m: What noise of the applied force alone leaves of it; zero on a dyno.
        series: For the report.
    """

    figures: RunFigures
    linear: float
    linear_force_n: float
    counted: BeforeAfter
    floor: NoiseFloor
    drift_m: float
    series: tuple[HeldOutSeries, ...]


class Models(NamedTuple):
    """The models that are compared, as candidate and parts.

    Attributes:
        given: The nominal model.
        linear: The best linear one.
        chosen: The corrected one.
    """

    given: tuple[Candidate, Parts]
    linear: tuple[Candidate, Parts]
    chosen: tuple[Candidate, Parts]


def models_of(problem: Problem, linear: Fit, chosen: Fit) -> Models:
    """Nominal, best linear and corrected model."""
    base = nominal(problem)
    none = np.zeros(len(problem.linear))
    given = Parts(none, existing_values(problem, base), linear.parts.starts)
    return Models((base, given), (linear.candidate, linear.parts), (chosen.candidate, chosen.parts))


def rms(values: Array) -> float:
    """Root mean square of what is not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


def evaluated(
    problem: FreeRun | Prescribed,
    models: Models,
    recordings: tuple[Recording, ...],
    left_n: float,
    *,
    kept: bool,
) -> tuple[Evaluated, ...]:
    """Figures of every recording.

    Args:
        problem: Held-out recordings, or those that blocks of were held out from.
        models: What is compared.
        recordings: As measured.
        left_n: Load-cell force that the corrected model leaves where it was fitted; NaN without.
        kept: The figures are those of the blocks held out; initial states are then known.

    Raises:
        RecordingError: A model runs away on a recording.
    """
    fitted = Models(*(_with_starts(problem, *model, kept=kept) for model in models))
    if isinstance(problem, FreeRun):
        return tuple(
            _free_run(problem, k, fitted, recordings[k], kept) for k in range(problem.recordings)
        )
    return tuple(_prescribed(problem, k, fitted, left_n, kept) for k in range(problem.recordings))


def _with_starts(
    problem: FreeRun | Prescribed, candidate: Candidate, parts: Parts, *, kept: bool
) -> tuple[Candidate, Parts]:
    if not kept:
        starts = tuple(problem.start(k, candidate) for k in range(problem.recordings))
        parts = parts._replace(starts=starts)
    fixed = np.zeros(len(problem.linear), dtype=np.bool_)
    result = fit(problem, candidate, parts, fixed, 10, effects=False)
    if result is None:
        raise RecordingError(
            f"model {problem.spec.name}: runs away on the held-out runs, expected runs that stay "
            "near the motion it was learnt from"
        )
    return candidate, result.parts


def _judged(grid_kept: NDArray[np.bool_], kept: bool) -> NDArray[np.bool_]:
    return grid_kept if kept else np.ones_like(grid_kept)


def _free_run(
    problem: FreeRun, k: int, models: Models, recording: Recording, kept: bool
) -> Evaluated:
    run = problem.runs[k]
    rows = _judged(run.grid.kept, kept)
    measured = np.where(rows[:, np.newaxis], run.grid.heights_m, np.nan)
    motions = [problem.simulated(run, c, p, p.starts[k]) for c, p in models]
    if any(motion is None for motion in motions):
        raise RecordingError(
            f"{run.grid.name}: the model runs away on this run, expected one that stays near the "
            "motion it was learnt from"
        )
    before, linear, after = (motion for motion in motions if motion is not None)
    noise = np.sqrt(
        [estimate_noise(run.grid.t_s, c).variance for c in (run.grid.heights_m - after.heights_m).T]
    )
    on_dart: list[Array] = []
    for (candidate, parts), motion in ((models.given, before), (models.chosen, after)):
        left = rms(measured - motion.heights_m)
        tolerance = max(_AGREEMENT * float(noise.min()), _ACCURACY * left)
        on_dart.append(dart_heights(problem, k, candidate, parts, motion.heights_m, tolerance))
    forces = [problem.residual_forces(k, *model) for model in (models.given, models.chosen)]
    between = problem.residual_forces(k, *models.linear)
    linear_n = np.nan if between is None else rms(np.where(rows, between.force_n, np.nan))
    residual = [np.where(rows, f.force_n, np.nan) for f in forces if f is not None]
    heights = BeforeAfter(rms(measured - on_dart[0]), rms(measured - on_dart[1]))
    deviation = forces[1].deviation_n if forces[1] is not None else np.full((1, 1), np.nan)
    disturbed = problem.disturbances_m(k, *models.chosen, _INPUT_DRAWS)
    drift_m = max((rms(heights_m) for heights_m in disturbed), default=0.0)
    floor_m = float(np.hypot(rms(noise), drift_m))
    series = tuple(
        HeldOutSeries(
            run.grid.name, strut.name, "m", run.grid.t_s, measured[:, i], on_dart[0][:, i],
            on_dart[1][:, i], run.grid.heights_m[:, i],
            forces[0].track.velocities_m_per_s[i] if forces[0] is not None else measured[:, i],
        )
        for i, strut in enumerate(problem.spec.struts)
    )  # fmt: skip
    figures = RunFigures(
        run.grid.name,
        heights,
        BeforeAfter(rms(residual[0]), rms(residual[1])),
        _strut_force(problem, k, models, (before, after), recording, rows),
    )
    return Evaluated(
        figures, rms(measured - linear.heights_m), linear_n, heights,
        NoiseFloor(floor_m, rms(deviation)), drift_m, series,
    )  # fmt: skip


def _strut_force(
    problem: FreeRun,
    k: int,
    models: Models,
    motions: tuple[Trajectory, Trajectory],
    recording: Recording,
    rows: NDArray[np.bool_],
) -> BeforeAfter | None:
    """Error against the load cell where it is judged, the models in free run."""
    if recording.strut_forces_n is None or any(problem.read.plain.mockups):
        return None  # An FMU's force stands with the mechanism's.
    run = problem.runs[k]
    judged = np.interp(recording.t_s, run.grid.t_s, rows) > 0.5
    cells = np.where(judged[:, np.newaxis], recording.strut_forces_n, np.nan)
    found: list[float] = []
    for (candidate, parts), motion in zip((models.given, models.chosen), motions, strict=True):
        along = track_of(run, motion)
        states = problem.states(k, candidate, parts)
        forces = track.strut_forces(problem, candidate, parts, along, states)
        at = np.column_stack([np.interp(recording.t_s, run.grid.t_s, force) for force in forces])
        found.append(rms(cells - at))
    return BeforeAfter(*found)


def _prescribed(
    problem: Prescribed, k: int, models: Models, left_n: float, kept: bool
) -> Evaluated:
    drive = problem.drives[k]
    rows = _judged(drive.grid.kept, kept) & drive.certain
    measured = np.where(rows, drive.cells_n, np.nan)
    forces = [
        track.strut_forces(problem, c, p, drive.along, problem.states(k, c, p)) for c, p in models
    ]
    error = BeforeAfter(rms(measured - forces[0]), rms(measured - forces[2]))
    celled = [i for i in range(len(measured)) if np.any(np.isfinite(measured[i]))]
    series = tuple(
        HeldOutSeries(
            drive.grid.name, problem.spec.struts[i].name, "N", drive.grid.t_s, measured[i],
            forces[0][i], forces[2][i], drive.along.heights_m[i], drive.along.velocities_m_per_s[i],
        )
        for i in celled
    )  # fmt: skip
    # Near a reversal a redrawn motion changes the sign of friction; a smoothed one does not.
    floor_n = min(left_n, _motion_floor_n(problem, drive, k, models.chosen))
    figures = RunFigures(drive.grid.name, BeforeAfter(np.nan, np.nan), error, error)
    left = rms(measured - forces[1])
    return Evaluated(figures, left, left, error, NoiseFloor(np.nan, floor_n), 0.0, series)


def _motion_floor_n(
    problem: Prescribed, drive: Drive, k: int, model: tuple[Candidate, Parts]
) -> float:
    """RMS force that a right model leaves: noise of the cell, and of the motion through the law.

    The motion's is found by drawing the sensor's noise again and smoothing it anew (a parametric
    bootstrap; Efron and Tibshirani, An Introduction to the Bootstrap, 1993, 6.5).
    """
    candidate, parts = model
    states = problem.states(k, candidate, parts)
    here = track.strut_forces(problem, candidate, parts, drive.along, states)
    rng = np.random.default_rng(0)
    squares: list[float] = []
    for _ in range(_DRAWS):
        z, w = drive.along.heights_m.copy(), drive.along.velocities_m_per_s.copy()
        for i, sigma in enumerate(drive.height_noise_m):
            middle = float(z[i].mean())
            noisy = z[i] - middle + sigma * rng.standard_normal(z.shape[1])
            again = smooth(drive.grid.t_s, noisy, estimate_noise(drive.grid.t_s, noisy)).states
            z[i], w[i] = again[:, 0] + middle, again[:, 1]
        moved = drive.along._replace(heights_m=z, velocities_m_per_s=w)
        change = track.strut_forces(problem, candidate, parts, moved, states) - here
        squares.append(float(np.mean(change[:, drive.certain] ** 2)))
    cell = drive.cell_noise_n[np.isfinite(drive.cell_noise_n)]
    return float(np.sqrt(np.mean(squares) + np.mean(cell**2)))
