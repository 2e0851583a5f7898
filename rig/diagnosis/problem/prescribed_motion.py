"""A strut whose motion is given: its residual is the load-cell force less its law's force.

Nothing is simulated: the motion is smoothed over the whole recording, and a law's force along it
takes one pass. Of the initial states only the laws' internal ones remain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from dart_model.effects import Bench
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.delay_step import ForceOverTime
from rig.diagnosis.numerics.smoother import (
    Smoothed,
    estimate_noise,
    estimate_noise_beside_jumps,
    smooth,
)
from rig.diagnosis.outcome import HeldOutSeries, ModelErrors, NoiseFloor, RunFigures
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.channel_delays import delays_of, known_share
from rig.diagnosis.problem.grid import (
    RecordingGrid,
    SmoothRecording,
    Track,
    block_numbers,
    check_swing,
)
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    ComparedModels,
    Flags,
    Integers,
    Problem,
    ProblemBasis,
    ResidualForces,
    RunEvaluation,
    Segment,
    StrutEffect,
    nominal,
    nominal_model,
    rms,
    rms_about_mean,
    select_nodes,
    state_scales,
    strut_constants,
    strut_effects,
)
from rig.recordings.recording import RecordingError

Array = NDArray[np.float64]

_UNCERTAIN = 1.5
"""Times its median from which on the deviation of the smoothed velocity is that of a recording's
end, where nothing follows to smooth with."""
_CERTAIN_SIGN = 4.0
"""Its deviations from zero from which on the sign of a velocity or an acceleration is certain."""
_DRAWS = 3
"""Draws of the motion's noise for a floor: the third changes it by a few percent."""
_LEAST_SWING = 5.0
"""Force over load cell noise below which no law can be determined."""
_OTHER_UNITS = 100.0
"""Model's over measured force from which on the units are not those of the columns."""
_OPPOSITE = -0.6
"""Correlation of model and load cell from which on the cell's sign is the other one."""


class DynoRun(NamedTuple):
    """A recording of a prescribed motion and the forces that it took.

    Attributes:
        courses: Height of each strut over time, also where this is a part of a recording.
        cells_n: Load cells at the nodes, shape (struts, N); NaN where a strut has none.
        cell_rates_n_per_s: Their smoothed rates of change, shape (struts, N).
        certain: Nodes at which the motion is well known and does not turn, shape (N,).
        height_noise_m: Standard deviation of each height's noise, shape (struts,).
        velocity_noise_m_per_s: Standard deviation of each smoothed velocity, shape (struts,).
        cell_noise_n: Standard deviation of each load cell's noise, shape (struts,).
    """

    grid: RecordingGrid
    along: Track
    courses: tuple[CubicHermiteSpline, ...]
    cells_n: Array
    cell_rates_n_per_s: Array
    certain: Flags
    height_noise_m: Array
    velocity_noise_m_per_s: Array
    cell_noise_n: Array

    def seen(self, delays_s: Array) -> Track:
        """The motion as late load cells show its force, by the delay of each, (struts,)."""
        along = self.along
        if not np.any(delays_s):
            return along
        rows: list[tuple[Array, Array]] = []
        for course, delay_s in zip(self.courses, delays_s.tolist(), strict=True):
            at = np.clip(along.t_s - delay_s, course.x[0], course.x[-1])
            rows.append((course(at), course(at, 1)))
        heights, velocities = (np.array(part) for part in zip(*rows, strict=True))
        return along._replace(heights_m=heights, velocities_m_per_s=velocities)

    @property
    def fit_nodes(self) -> Flags:
        """Nodes that take part in fits, shape (N,)."""
        return self.grid.fitted & self.certain

    def cut(self, nodes: slice) -> "DynoRun":
        """The recording at some of the nodes."""
        return self._replace(
            grid=self.grid.cut(nodes),
            along=self.along.cut(nodes),
            cells_n=self.cells_n[:, nodes],
            cell_rates_n_per_s=self.cell_rates_n_per_s[:, nodes],
            certain=self.certain[nodes],
        )


def dyno_run(smooth_recording: SmoothRecording) -> DynoRun:
    """A recording with load cells as a prescribed motion."""
    recording, grid, sample_nodes, motion, states, noises = smooth_recording
    spread = np.array([s.deviations[:, 1] for s in states])
    cells = np.full((len(states), len(grid.t_s)), np.nan)
    rates = cells.copy()
    noise_n = np.full(len(states), np.nan)
    measured = recording.strut_forces_n
    for i in range(len(states)):
        if measured is not None and np.all(np.isfinite(measured[:, i])):
            cells[i] = np.interp(grid.t_s, grid.t_s[sample_nodes], measured[:, i])
            noise = estimate_noise(grid.t_s, cells[i])
            noise_n[i] = min(np.sqrt(noise.variance), estimate_noise_beside_jumps(measured[:, i]))
            rates[i] = smooth(grid.t_s, cells[i] - cells[i].mean(), noise).states[:, 1]
    rows = zip(motion.heights_m, motion.velocities_m_per_s, strict=True)
    return DynoRun(
        grid,
        motion,
        tuple(CubicHermiteSpline(grid.t_s, z, w) for z, w in rows),
        cells,
        rates,
        np.all([_is_certain(state) for state in states], axis=0),
        np.sqrt([noise.variance for noise in noises]),
        np.median(spread, axis=1),
        noise_n,
    )


def _is_certain(state: Smoothed) -> Flags:
    """Nodes (N,) at which a strut's velocity is well known, and its sign as well.

    At a turn an error of velocity is one of friction's sign, which other laws would take for their
    own. At rest there is no turn.
    """
    _, velocity, acceleration, _ = state.states.T
    _, velocity_std, acceleration_std, _ = state.deviations.T
    is_turning = (np.abs(velocity) < _CERTAIN_SIGN * velocity_std) & (
        np.abs(acceleration) > _CERTAIN_SIGN * acceleration_std
    )
    return (velocity_std < _UNCERTAIN * np.median(velocity_std)) & ~is_turning


def cell_residual_std(spec: ModelSpec, runs: Sequence[DynoRun]) -> Array:
    """Standard deviation of each load cell's residual (struts,); NaN where a strut has no cell.

    Noise of the velocity passes through the damping, noise of the height through the spring.
    """
    slopes = np.array([(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in spec.struts])
    motion_n = [
        np.hypot(slopes[:, 0] * run.height_noise_m, slopes[:, 1] * run.velocity_noise_m_per_s)
        for run in runs
    ]
    cells_n = [run.cell_noise_n for run in runs]
    return np.median(np.hypot(motion_n, cells_n), axis=0)


@dataclass(frozen=True, eq=False)
class PrescribedProblem(Problem):
    """A model and recordings of a dyno; `noise_n`: deviation of each cell's residual, (struts,)."""

    bench: ClassVar[Bench] = "motion_given"
    runs: tuple[DynoRun, ...]
    noise_n: Array

    @classmethod
    def of_recordings(
        cls, basis: ProblemBasis, recordings: Sequence[SmoothRecording]
    ) -> "PrescribedProblem":
        """The problem of recordings with a load cell and without an applied force."""
        spec = basis.spec
        if any(strut.fmu is not None for strut in spec.struts):
            raise RecordingError(
                f"model {spec.name}: an FMU, and runs whose motion is prescribed: expected runs "
                "with applied_force_n"
            )
        runs = tuple(dyno_run(recording) for recording in recordings)
        problem = cls(*basis, runs, cell_residual_std(spec, runs))
        base, start = nominal_model(problem, ()), problem.start(0, nominal(problem))
        for run in runs:
            _check_channels(run, track.strut_forces(problem, base, run.along, start))
        return problem

    @property
    def assumptions(self) -> tuple[str, ...]:
        return ("The motion is smoothed over the whole recording.",)

    @property
    def grids(self) -> tuple[RecordingGrid, ...]:
        return tuple(run.grid for run in self.runs)

    def fit_nodes(self, k: int) -> Flags:
        return self.runs[k].fit_nodes

    def of_held_out_blocks(self) -> "PrescribedProblem":
        held_out = (run for run in self.runs if np.any(run.grid.held_out))
        return replace(
            self, runs=tuple(run._replace(grid=run.grid.of_held_out) for run in held_out)
        )

    def cut(self, pieces: Sequence[tuple[int, slice]]) -> "PrescribedProblem":
        return replace(self, runs=tuple(self.runs[k].cut(nodes) for k, nodes in pieces))

    def coarser(self, model: CandidateModel) -> "PrescribedProblem":
        """The problem itself: nothing is integrated."""
        del model
        return self

    def in_usual_steps(self) -> "PrescribedProblem":
        """The problem itself, likewise."""
        return self

    def held_to(self, motions: Sequence[tuple[int, Track]], share: float) -> None:
        del motions, share

    def finer(self) -> None:
        """None: nothing is integrated."""
        return

    def with_noise_of(self, model: CandidateModel) -> "PrescribedProblem":
        """The problem itself: its noise is that of the load cells and of the motion."""
        del model
        return self

    @cached_property
    def _cell_struts(self) -> Integers:
        return np.flatnonzero(np.isfinite(self.noise_n))

    def _rows(self, k: int) -> Integers:
        return np.flatnonzero(self.runs[k].fit_nodes)

    def blocks(self, k: int) -> Integers:
        numbers = block_numbers(self.runs[k].grid.t_s, self.block_s)[self._rows(k)]
        return np.repeat(numbers, len(self._cell_struts))

    def start(self, k: int, candidate: Candidate) -> Array:
        """Internal states at zero."""
        del k
        return np.zeros(len(state_scales(strut_effects(self, candidate))[0]))

    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """The laws' own scales."""
        return state_scales(strut_effects(self, candidate))

    def states(self, k: int, model: CandidateModel) -> Array:
        return model.parts.starts[k]

    def _delays_s(self, model: CandidateModel) -> Array:
        """Delay of each load cell, shape (struts,)."""
        return delays_of(self.linear, model.parts.linear, len(self.noise_n), 0).struts

    def _residual_n(self, k: int, model: CandidateModel) -> Array:
        """Load cells less the model's forces as the cells show them, shape (struts, N)."""
        run, delays_s = self.runs[k], self._delays_s(model)
        along = run.seen(delays_s)
        residual_n = run.cells_n - track.strut_forces(self, model, along, model.parts.starts[k])
        if np.any(delays_s):
            residual_n *= known_share(along.t_s, delays_s).T
        return residual_n

    def residual(self, k: int, model: CandidateModel) -> Array | None:
        """Load cells less the model's forces over the noise, at the fitted nodes, flat."""
        return self._whiten(self._residual_n(k, model), self._rows(k))

    def _whiten(self, forces: Array, rows: Integers) -> Array:
        return (forces[np.ix_(self._cell_struts, rows)].T / self.noise_n[self._cell_struts]).ravel()

    def law_responses(
        self, k: int, model: CandidateModel, laws: Sequence[tuple[StrutEffect, Array]]
    ) -> Array:
        along, rows = self.runs[k].seen(delays_s := self._delays_s(model)), self._rows(k)
        constants = strut_constants(self, model.parts.linear)
        shares = known_share(along.t_s, delays_s).T
        columns: list[Array] = []
        for at, values in laws:
            forces = np.zeros((len(self.noise_n), len(along.t_s)))
            forces[at[0]] = track.finite_law_force(along, at, values, constants)
            columns.append(-self._whiten(shares * forces, rows))
        return np.column_stack(columns)

    def floor_level(self, model: CandidateModel) -> float:
        """One: noise of the motion is in what whitens the residual."""
        del model
        return 1.0

    def residual_force_rms_n(self, mean_square: float) -> float:
        """RMS residual force of a fit by its whitened mean square, in N."""
        return float(np.sqrt(mean_square * np.nanmean(self.noise_n**2)))

    def residual_forces(self, k: int, model: CandidateModel) -> ResidualForces | None:
        """Load cells less the model's forces along the smoothed motion."""
        residual_n, run = self._residual_n(k, model), self.runs[k]
        deviation = np.broadcast_to(self.noise_n[:, np.newaxis], residual_n.shape)
        along = run.seen(self._delays_s(model))
        return ResidualForces(run.grid.name, along, residual_n, deviation)

    def forces_over_time(
        self, k: int, model: CandidateModel, delays: Sequence[int]
    ) -> Sequence[ForceOverTime]:
        """What the load cells show along the motion that they show."""
        run, along = self.runs[k], self.runs[k].seen(self._delays_s(model))
        forces: list[ForceOverTime] = []
        nodes, struts = len(along.t_s), len(self.noise_n)
        shares = np.broadcast_to(np.eye(struts), (nodes, struts, struts))
        for i in range(struts):
            own = [float(self.linear[delay].strut == i) for delay in delays]
            by_delays = run.cell_rates_n_per_s[i, :, np.newaxis] * own
            nothing = np.zeros((nodes, 0))
            z, w = along.heights_m[i], along.velocities_m_per_s[i]
            forces.append(ForceOverTime(z, w, run.cells_n[i], by_delays, nothing, shares[:, i]))
        return forces

    def segments(
        self, model: CandidateModel, most_samples: int, largest_stride: int
    ) -> tuple[Segment, ...]:
        """The regression about a model's force along the motion."""
        nodes = [len(run.grid.t_s) for run in self.runs]
        segments: list[Segment] = []
        for k, run in enumerate(self.runs):
            residual_n = self._residual_n(k, model)
            cuts = track.pieces(nodes[k], sum(nodes), most_samples, largest_stride)
            segments += [
                self._segment(k, model, residual_n, cut)
                for cut in cuts
                if np.any(run.fit_nodes[cut])
            ]
        return tuple(segments)

    def _segment(self, k: int, model: CandidateModel, residual_n: Array, cut: slice) -> Segment:
        run, delays_s = self.runs[k], self._delays_s(model)
        whole = run.seen(delays_s)
        along = whole.cut(cut)
        rows = np.flatnonzero(run.fit_nodes[cut])
        numbers = block_numbers(whole.t_s, self.block_s)[cut][rows]

        shares = known_share(whole.t_s, delays_s)[cut].T

        def respond(strut: int, forces: Array) -> Array:
            seen = np.zeros((len(rows), len(self._cell_struts), forces.shape[1]))
            own = np.flatnonzero(np.equal(self._cell_struts, strut))
            weight = shares[strut, rows] / self.noise_n[strut]
            seen[:, own] = (weight[:, np.newaxis] * forces[rows])[:, np.newaxis]
            return seen.reshape(-1, forces.shape[1])

        columns: list[Array] = []
        for p in self.linear:
            z, w = along.heights_m[p.strut], along.velocities_m_per_s[p.strut]
            force = linear_part.strut_force(p.kind, z, w, self.motions[p.strut])
            if p.kind == "delay":
                # By the measured rate, in which is what the model lacks.
                force = -run.cell_rates_n_per_s[p.strut, cut]
            columns.append(respond(p.strut, force[:, np.newaxis])[:, 0])
        target = self._whiten(residual_n[:, cut], rows)
        return Segment(
            along,
            along,
            None if cut == slice(0, len(whole.t_s), cut.step) else (whole, whole),
            respond,
            target,
            np.column_stack(columns),
            np.zeros((len(target), 0)),
            np.repeat(numbers - numbers[0], len(self._cell_struts)),
        )

    def evaluate(
        self, k: int, models: ComparedModels, fitted_rms_n: float, *, blocks: bool
    ) -> RunEvaluation:
        """Figures of a held-out recording: forces along the smoothed motion."""
        run = self.runs[k]
        rows = select_nodes(run.grid, blocks=blocks) & run.certain
        shares = [known_share(run.along.t_s, self._delays_s(model)).T for model in models]
        measured = np.where(rows & (np.min(shares, axis=0) == 1.0), run.cells_n, np.nan)
        tracks = [run.seen(self._delays_s(model)) for model in models]
        forces = [
            track.strut_forces(self, model, along, self.states(k, model))
            for model, along in zip(models, tracks, strict=True)
        ]
        before_n, linear_n, after_n = (rms(measured - force) for force in forces)
        errors = ModelErrors(before_n, linear_n, after_n, rms_about_mean(measured.T))
        series = tuple(
            HeldOutSeries(
                run.grid.name, self.spec.struts[i].name, "N", run.grid.t_s, measured[i],
                forces[0][i], forces[2][i], tracks[2].heights_m[i],
                tracks[2].velocities_m_per_s[i],
            )
            for i in range(len(measured)) if np.any(np.isfinite(measured[i]))
        )  # fmt: skip
        # Near a reversal a redrawn motion changes the sign of friction; a smoothed one does not.
        floor_n = min(fitted_rms_n, self._motion_floor_n(k, models.corrected))
        no_heights = ModelErrors(np.nan, np.nan, np.nan, np.nan)
        figures = RunFigures(run.grid.name, no_heights, errors, errors)
        return RunEvaluation(figures, NoiseFloor(np.nan, floor_n), 0.0, series)

    def _motion_floor_n(self, k: int, model: CandidateModel) -> float:
        """RMS residual force of a right model: noise of the cell, and of the motion by the law.

        The share of the motion is determined by drawing the sensor's noise again and smoothing it
        again (a parametric bootstrap; Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
        6.5).
        """
        run, states = self.runs[k], self.states(k, model)
        forces = track.strut_forces(self, model, run.along, states)
        rng = np.random.default_rng(0)
        squares: list[float] = []
        for _ in range(_DRAWS):
            z, w = run.along.heights_m.copy(), run.along.velocities_m_per_s.copy()
            for i, sigma in enumerate(run.height_noise_m):
                middle = float(z[i].mean())
                noisy = z[i] - middle + sigma * rng.standard_normal(z.shape[1])
                again = smooth(run.grid.t_s, noisy, estimate_noise(run.grid.t_s, noisy)).states
                z[i], w[i] = again[:, 0] + middle, again[:, 1]
            redrawn = run.along._replace(heights_m=z, velocities_m_per_s=w)
            change = track.strut_forces(self, model, redrawn, states) - forces
            squares.append(float(np.mean(change[:, run.certain] ** 2)))
        cell = run.cell_noise_n[np.isfinite(run.cell_noise_n)]
        return float(np.sqrt(np.mean(squares) + np.mean(cell**2)))


def _check_channels(run: DynoRun, model_n: Array) -> None:
    """Refuse channels of a dyno that cannot be what their names say; model forces (struts, N)."""
    name = run.grid.name
    check_swing(run.grid)
    if not np.any(np.isfinite(run.cells_n)):
        raise RecordingError(f"{name}: expected strut_force_n of one strut at least")
    for cell, model, noise in zip(run.cells_n, model_n, run.cell_noise_n, strict=True):
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
                f"{name}: strut_force_n opposes the model's force (correlation "
                f"{np.mean(force * law) / (swing * own):.2f}), expected a force that is positive "
                "where the strut pushes its bodies apart: change its sign"
            )
