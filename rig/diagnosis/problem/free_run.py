"""Free-run simulation under the measured inputs: the residual is measured less simulated height.

The regression along the motion rests on an identity. Let the reference be a simulation with the
linear dynamics G (heights by force). The residual of the measured heights is G applied to the
missing force, and to the changes of the linear part times the measured motion, plus sensor noise
as it is: an equation error that passes through the model's own dynamics has the noise of an output
error (Young 2011, 8.2). The measured motion itself comes from a smoother.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.sparse import diags_array

from dart_model.effects import Bench
from dart_model.spec import WORLD, ModelSpec
from rig.channels.measured_quantities import LOAD_CELL_FORCE, MOTION
from rig.diagnosis.numerics.delay_step import ForceOverTime, delay_between
from rig.diagnosis.numerics.march import (
    Equations,
    Model,
    Scenario,
    Steps,
    Tangents,
    Trajectory,
    differentiate,
    simulate,
)
from rig.diagnosis.numerics.smoother import Smoothed, estimate_noise
from rig.diagnosis.outcome import HeldOutSeries, ModelErrors, NoiseFloor, RunFigures
from rig.diagnosis.problem import linear_part, on_dart, track
from rig.diagnosis.problem.channel_delays import (
    SIGNIFICANT,
    Delays,
    delays_of,
    gains_of,
    height_gains,
    known_share,
    late_columns,
    late_reader,
)
from rig.diagnosis.problem.directions import by_linear_part, directions_of, pushed_by
from rig.diagnosis.problem.drive import draw_noise, drive_of_recording, noise_stds
from rig.diagnosis.problem.driven_run import (
    DrivenRun,
    LoadCells,
    driven_run,
    first_motion,
    track_of,
)
from rig.diagnosis.problem.grid import (
    RecordingGrid,
    SmoothRecording,
    Track,
    block_numbers,
    check_swing,
    fine_times,
)
from rig.diagnosis.problem.linear_dynamics import FilterMechanism, LinearDynamics, system_matrix
from rig.diagnosis.problem.mechanism import LinearisedMechanism, mechanism_along, solve_nearest
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    CellDelay,
    ComparedModels,
    Derivative,
    Flags,
    Integers,
    LinearParameter,
    Problem,
    ProblemBasis,
    ResidualForces,
    RunEvaluation,
    Segment,
    StrutEffect,
    first_starts,
    mid_stroke_m,
    nominal,
    nominal_model,
    rms,
    rms_about_mean,
    select_nodes,
    slots_of,
    state_scales,
    strut_constants,
    strut_effects,
)
from rig.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]

_BEND = 4.0
"""How much more than its fastest linear motion a smooth nonlinear one may bend within a step."""
_JUMP = 2e-8
"""Change of height within a step by a jump of force, as a share of the stroke, from which on the
step is cut."""
_LEVEL_DRAWS, _FLOOR_DRAWS = 3, 8
"""Draws of the applied force's noise. Their mean square is known to a third with three; of a floor
the largest counts, since a lightly damped motion answers to it in so few independent swings that
their RMS scatters by a third."""
_PREDICTABLE = 0.1
"""Share of the motion's RMS that the inputs' noise may account for. Where impacts amplify it, two
runs of one model differ by the motion itself, and a wrong model's would excuse any error."""
_LONGER_ANGLE, _LONGER_ERROR = 0.08, 0.02
"""Longest steps of fits that search: angle of the fastest motion within one (with twice as much a
stop errs by a quarter of usual noise), and RMS of what they change of the best linear model, as a
share of the noise: it makes the sum of squares of 10 000 samples larger by 4."""
_LEAST_STRIDES = 16
"""Strides of the shortest recording, at least: a spline has four knots at either end."""
_AGREEMENT, _ACCURACY = 0.1, 0.01
"""Share of the noise, or of the error if that is more, to which DART's steps are refined."""
_FORCE_STEP_S = 0.5e-3
"""Step of the derivative of the force by a delay, or the time between samples, if that is longer:
the force of a smoothed motion is rough."""
_DELAY_STEP_S = 1e-5
"""Step of the difference quotient by the delay of an input."""
_GAIN_STEP = 1e-4
"""The same by the gain of a height, of which it is all but linear."""
_ORDER = 4
"""Columns of a smoothed signal: itself and three derivatives."""
_IMPLAUSIBLE = 5.0
"""Times the largest deflection that the load could cause from which on columns are mixed up."""


@dataclass(frozen=True, eq=False)
class FreeRunProblem(Problem):
    """A model and recordings of a driven bench.

    Attributes:
        noise_m: Standard deviation of each measured height, shape (struts,).
        in_strides: The recordings as fits simulate laws without internal states, where that is in
            longer steps, or empty. Internal states settle as fast as usual steps are long.
    """

    bench: ClassVar[Bench] = "force_given"
    runs: tuple[DrivenRun, ...]
    noise_m: Array
    in_strides: tuple[DrivenRun, ...] = ()

    @classmethod
    def of_recordings(
        cls, basis: ProblemBasis, recordings: Sequence[SmoothRecording]
    ) -> "FreeRunProblem":
        """The problem of recordings with an applied force."""
        runs = tuple(_driven(basis, recording) for recording in recordings)
        problem = cls(*basis, runs, np.full(len(basis.spec.struts), np.inf))
        for run in runs:
            check_swing(run.grid)
        return problem.with_noise_of(
            nominal_model(problem, first_starts(problem, nominal(problem)))
        )

    @property
    def assumptions(self) -> tuple[str, ...]:
        drive = self.runs[0].drive
        notes = ["The initial state of every recording is fitted, for both models."]
        if drive.has_force:
            notes.append("Between samples an applied force is a cubic spline.")
        if drive.moved:
            notes.append(
                "Measured motions of bodies are smoothed over the whole recording; velocity and "
                "acceleration follow from them."
            )
        if not drive.has_force:
            scale = self._scale_body()
            notes.append(
                "No force drives the bench: the recordings determine masses, stiffnesses, dampings "
                f"and forces up to a common factor. The mass of {scale} is taken as the model has "
                "it; all others are proportional to it."
            )
        return tuple(notes)

    @property
    def is_driven_by_force(self) -> bool:
        return self.runs[0].drive.has_force

    def _scale_body(self) -> str:
        """Body whose mass sets the scale: that of the strut without a correction of its mass."""
        corrected = {item.strut for item in self.linear if item.kind == "mass"}
        strut = next(strut for i, strut in enumerate(self.spec.struts) if i not in corrected)
        lower, upper = strut.between
        return upper if upper != WORLD else lower

    @property
    def height_gains(self) -> tuple[LinearParameter, ...]:
        drive = self.runs[0].drive
        return height_gains(self.spec) if drive.moved and not drive.has_force else ()

    @property
    def grids(self) -> tuple[RecordingGrid, ...]:
        return tuple(run.grid for run in self.runs)

    def coarser(self, model: CandidateModel) -> "FreeRunProblem":
        usual = self.runs[0]
        for every in range(self._longest_stride(), 0, -1):
            if every == usual.substeps == 1:
                break
            runs = tuple(run.in_strides(every) for run in self.runs)
            if self._move_alike(runs, model):
                return replace(self, in_strides=runs)
        return self

    def _longest_stride(self) -> int:
        """Most nodes in a step in which neither the model nor its measured motion turns far."""
        step_s = min(
            _LONGER_ANGLE / max(run.fastest for run in self.runs),
            *(_LONGER_ANGLE * 0.5 * m.stroke_m / m.top_speed_m_per_s for m in self.motions),
        )
        longest = int(step_s / max(run.grid.step_s for run in self.runs) + 1e-6)
        return min(longest, min(len(run.grid.t_s) for run in self.runs) // _LEAST_STRIDES)

    def _move_alike(self, runs: Sequence[DrivenRun], model: CandidateModel) -> bool:
        """Whether a model moves in other steps as in usual ones."""
        for k, (usual, other) in enumerate(zip(self.runs, runs, strict=True)):
            motions = [self.simulate(run, model, model.parts.starts[k]) for run in (usual, other)]
            if motions[0] is None or motions[1] is None:
                return False
            change = (motions[1].heights_m - motions[0].heights_m) / self.noise_m
            if rms(change) > _LONGER_ERROR:
                return False
        return True

    def in_usual_steps(self) -> "FreeRunProblem":
        return replace(self, in_strides=())

    def held_to(
        self, motions: Sequence[tuple[int, Track]], share: float
    ) -> "FreeRunProblem | None":
        along, rate = dict(motions), share * max(run.fastest for run in self.runs)
        if len(along) < self.recordings:
            return None
        runs = tuple(run.held_to(along[k], rate) for k, run in enumerate(self.runs))
        in_strides = tuple(
            other._replace(mechanism=run.mechanism)
            for run, other in zip(runs, self.in_strides, strict=False)
        )
        return replace(self, runs=runs, in_strides=in_strides)

    def finer(self) -> "FreeRunProblem":
        """The problem with steps half as long: the integrator then errs a sixteenth."""
        return replace(self, runs=tuple(run.finer() for run in self.runs), in_strides=())

    def fit_nodes(self, k: int) -> Flags:
        return self.runs[k].grid.fitted

    def of_held_out_blocks(self) -> "FreeRunProblem":
        held_out = (run for run in self.runs if np.any(run.grid.held_out))
        return replace(
            self, runs=tuple(run._replace(grid=run.grid.of_held_out) for run in held_out)
        )

    def cut(self, pieces: Sequence[tuple[int, slice]]) -> "FreeRunProblem":
        return replace(self, runs=tuple(self.runs[k].cut(nodes) for k, nodes in pieces))

    @cached_property
    def _stroke_m(self) -> float:
        return max(motion.stroke_m for motion in self.motions)

    @cached_property
    def _input_noise(self) -> tuple[tuple[float, ...], ...]:
        return tuple(noise_stds(run.drive, run.grid.t_s) for run in self.runs)

    def blocks(self, k: int) -> Integers:
        return np.repeat(self.runs[k].grid.blocks(self.block_s), len(self.noise_m))

    def start(self, k: int, candidate: Candidate) -> Array:
        """Coordinates and velocities from a parabola through the first samples; states at zero."""
        grid, mechanism = self.runs[k].grid, self.runs[k].mechanism
        heights, velocities = first_motion(grid)
        jacobian, (moved_m, moved) = mechanism.jacobian[0], self.runs[k].moved_at_nodes[0]
        q = mechanism.q[0] + solve_nearest(jacobian, heights - mechanism.heights_m[0] - moved_m)
        v = solve_nearest(jacobian, velocities - moved)
        return np.concatenate([q, v, np.zeros(slots_of(self, candidate).states)])

    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """A thousandth of the stroke, a hundredth of the speed, and the laws' own scales."""
        largest = float(np.max(np.abs(self.runs[0].mechanism.jacobian)))
        q = 1e-3 * self._stroke_m / largest
        v = 1e-2 * max(motion.speed_m_per_s for motion in self.motions) / largest
        n = self.runs[0].mechanism.coordinates
        scales, fitted = state_scales(strut_effects(self, candidate))
        return (
            np.concatenate([np.full(n, q), np.full(n, v), scales]),
            np.concatenate([np.ones(2 * n, dtype=np.bool_), fitted]),
        )

    # --- channels ---------------------------------------------------------------------------------

    def _delays(self, model: CandidateModel) -> Delays:
        inputs = len(self.runs[0].drive.inputs)
        return delays_of(self.linear, model.parts.linear, len(self.noise_m), inputs)

    def _gains(self, model: CandidateModel) -> Array:
        """Gain of each strut's measured height, shape (struts,)."""
        return gains_of(self.linear, model.parts.linear, len(self.noise_m))

    def _seen(self, k: int, model: CandidateModel, motion: Trajectory) -> Array:
        """Heights of a simulated motion as the sensors show them, shape (N, struts)."""
        return self._as_read(k, model, motion.heights_m, motion.velocities_m_per_s)

    def _as_read(
        self, k: int, model: CandidateModel, heights_m: Array, rates: Array | None
    ) -> Array:
        """Heights (N, struts) by sensors with their delays, and with their gains about mid-stroke.

        `rates` are those of the heights, where they are known.
        """
        delays_s, gains = self._delays(model).struts, self._gains(model)
        late = late_columns(self.runs[k].grid.t_s, heights_m, rates, delays_s)
        if np.all(gains == 1.0):
            return late
        return self._middles_m + gains * (late - self._middles_m)

    @cached_property
    def _middles_m(self) -> Array:
        return np.array([mid_stroke_m(motion) for motion in self.motions])

    def _before_delays(self, k: int, model: CandidateModel) -> DrivenRun:
        """A recording with its inputs as they were before their delays."""
        return self.runs[k].before_delays(self._delays(model).inputs)

    def in_fits(self, k: int, model: CandidateModel) -> DrivenRun:
        """The same, as fits simulate it."""
        runs = self.runs if slots_of(self, model.candidate).states else self.in_strides or self.runs
        run = runs[k]
        return run.before_delays(self._delays(model).inputs)

    # --- the residual in simulation ---------------------------------------------------------------

    def simulate(self, run: DrivenRun, model: CandidateModel, start: Array) -> Trajectory | None:
        """Free-run simulation, or None if it runs away or its mass is not positive."""
        prepared = self._prepare(run, model, start)
        if prepared is None:
            return None
        motion = self._empty_motion(run)
        slots = slots_of(self, model.candidate)
        return motion if simulate(slots, *prepared, motion) else None

    def _parts(self, run: DrivenRun, model: CandidateModel, start: Array) -> Integers:
        """Parts into which a model's step at each node is cut where a force jumps, shape (N,)."""
        parts = np.ones(len(run.strides), dtype=np.int64)
        prepared = self._prepare(run, model, start)
        if prepared is not None:
            simulate(slots_of(self, model.candidate), *prepared, self._empty_motion(run), parts)
        return parts

    def _prepare(
        self, run: DrivenRun, model: CandidateModel, start: Array
    ) -> tuple[Model, Scenario, Steps] | None:
        """A model as it is simulated, or None if its mass is not positive."""
        parts = model.parts
        m = linear_part.with_linear_changes(run.mechanism, self.linear, parts.linear)
        if m is None:
            return None
        inverse = np.ascontiguousarray(np.linalg.inv(m.mass), dtype=np.float64)
        equations = Equations(
            inverse, m.bias, m.bias_q, m.bias_v, m.jacobian, m.heights_m, m.rates_m_per_s,
            m.inputs, m.q, m.v,
        )  # fmt: skip
        placement, struts = (
            slots_of(self, model.candidate).placement,
            strut_constants(self, parts.linear),
        )
        return (
            Model(placement, parts.effects, struts, equations),
            Scenario(
                start,
                run.grid.t_s,
                run.strides,
                run.drive.applied_n(run.fine),
                run.grid.temperature_c,
                run.fine,
                run.moved,
            ),
            Steps(run.substeps, _BEND * run.angle**3, _JUMP * self._stroke_m, self._stroke_m),
        )

    def _empty_motion(self, run: DrivenRun) -> Trajectory:
        shape = (len(run.grid.t_s), len(self.noise_m))
        return Trajectory(np.empty(shape), np.empty(shape), np.empty(shape))

    def residual(self, k: int, model: CandidateModel) -> Array | None:
        """Measured less simulated heights over the noise, at the fitted nodes, flat."""
        run = self.in_fits(k, model)
        motion = self.simulate(run, model, model.parts.starts[k])
        return None if motion is None else self._compare(k, model, motion)

    def _compare(self, k: int, model: CandidateModel, motion: Trajectory) -> Array:
        """The residual of a simulated motion."""
        grid, delays_s = self.runs[k].grid, self._delays(model).struts
        residual = grid.heights_m - self._seen(k, model, motion)
        if np.any(delays_s):
            residual *= known_share(grid.t_s, delays_s)
        return (residual[grid.fitted] / self.noise_m).ravel()

    @property
    def derivative(self) -> Derivative:
        return self._differentiate

    def _differentiate(self, k: int, model: CandidateModel, varied: Flags) -> Array | None:
        run, parts = self.in_fits(k, model), model.parts
        prepared = self._prepare(run, model, parts.starts[k])
        if prepared is None:
            return None
        directions, simulated = directions_of(self.linear, varied, len(parts.effects), run)
        by = by_linear_part(run.mechanism, self.linear, parts.linear, self._middles_m)
        motion, tangents = (
            self._empty_motion(run),
            self._empty_tangents(k, model, directions.columns),
        )
        slots = slots_of(self, model.candidate)
        if not differentiate(slots, *prepared, directions, by, motion, tangents):
            return None
        if not all(np.all(np.isfinite(part)) for part in tangents):
            return None
        whitened = self._whiten_tangents(k, model, tangents)
        parameters: list[int] = np.flatnonzero(varied).tolist()
        order = [simulated.get(column, 0) for column in parameters]
        columns = whitened if order == list(range(directions.columns)) else whitened[:, order]
        for i, column in enumerate(parameters):
            if column not in simulated:
                changed = self._difference(k, model, motion, column)
                if changed is None:
                    return None
                columns[:, i] = changed
        return columns

    def _empty_tangents(self, k: int, model: CandidateModel, columns: int) -> Tangents:
        """Derivatives of a motion to be filled; those of velocities where a channel is late."""
        shape = (*self.runs[k].grid.heights_m.shape, columns)
        late = bool(np.any(self._delays(model).struts))
        return Tangents(np.empty(shape), np.empty(shape if late else (0, *shape[1:])))

    def _whiten_tangents(self, k: int, model: CandidateModel, tangents: Tangents) -> Array:
        """Derivatives of the residual, shape (m, columns), by those of a motion."""
        grid, delays_s = self.runs[k].grid, self._delays(model).struts
        weight, heights = self._gains(model) / self.noise_m, tangents.heights
        if np.any(delays_s):
            weight = weight * known_share(grid.t_s, delays_s)
            heights = late_columns(grid.t_s, heights, tangents.velocities, delays_s)
        columns = heights * -weight[..., None]
        if not grid.fitted.all():
            columns = columns[grid.fitted]
        return columns.reshape(-1, columns.shape[-1])

    def law_responses(
        self, k: int, model: CandidateModel, laws: Sequence[tuple[StrutEffect, Array]]
    ) -> Array | None:
        """Responses to the laws' forces along the model's free run, which march along with it."""
        run, start = self.in_fits(k, model), model.parts.starts[k]
        prepared, motion = self._prepare(run, model, start), self.simulate(run, model, start)
        if prepared is None or motion is None:
            return None
        along = track_of(motion, self._before_delays(k, model))
        constants = strut_constants(self, model.parts.linear)
        forces = [track.finite_law_force(along, *law, constants) for law in laws]
        tangents = self._empty_tangents(k, model, len(laws))
        pushed = pushed_by([(at[0], n) for (at, _), n in zip(laws, forces, strict=True)], *prepared)
        slots = slots_of(self, model.candidate)
        if not differentiate(slots, *pushed, self._empty_motion(run), tangents):
            return None
        return self._whiten_tangents(k, model, tangents)

    def _difference(
        self, k: int, model: CandidateModel, motion: Trajectory, parameter: int
    ) -> Array | None:
        """Derivative of the residual by a delay or by the gain of a height, as a difference."""
        linear, kind = model.parts.linear, self.linear[parameter].kind
        step = _DELAY_STEP_S if kind == "delay" else _GAIN_STEP
        more, less = (
            model.with_linear(_changed(linear, parameter, sign * step)) for sign in (1.0, -1.0)
        )
        if self.linear[parameter].input < 0:
            ahead, behind = (self._compare(k, other, motion) for other in (more, less))
            return (ahead - behind) / (2.0 * step)
        moved = self.simulate(self.in_fits(k, more), more, model.parts.starts[k])
        if moved is None:
            return None
        return (self._compare(k, more, moved) - self._compare(k, model, motion)) / step

    def states(self, k: int, model: CandidateModel) -> Array:
        return model.parts.starts[k][2 * self.runs[k].mechanism.coordinates :]

    # --- noise ------------------------------------------------------------------------------------

    def with_noise_of(self, model: CandidateModel) -> "FreeRunProblem":
        """The problem with the sensors' noise as a model's free run shows it, or an earlier one's.

        A residual is noise and the model's error, of which a part looks like noise: the smallest
        estimate is nearest.
        """
        variances: list[Array] = []
        for k, start in enumerate(model.parts.starts):
            run = self._before_delays(k, model)
            motion = self.simulate(run, model, start)
            heights = run.grid.heights_m
            reference = np.nanmean(heights, axis=0)
            if motion is not None:
                reference = self._seen(k, model, motion)
            variances.append(_noise_variance(run.grid.t_s, heights - reference))
        noise = np.minimum(np.sqrt(np.median(variances, axis=0)), self.noise_m)
        return replace(self, noise_m=np.maximum(noise, 1e-300))

    def floor_level(self, model: CandidateModel) -> float:
        """One for the heights' noise, and what noise of the inputs adds in simulation."""
        squares = [
            float(np.mean((heights_m / self.noise_m) ** 2))
            for k in range(self.recordings)
            for heights_m in self.disturbances_m(k, model, _LEVEL_DRAWS)
        ]
        return 1.0 + (float(np.mean(squares)) if squares else 0.0)

    def disturbances_m(self, k: int, model: CandidateModel, draws: int) -> list[Array]:
        """Heights that draws of the inputs' noise cause, drift of springless axes included.

        Each of shape (N, struts), no more than is predictable; an empty list where there is no
        noise, or the model runs away.
        """
        run, start = self._before_delays(k, model), model.parts.starts[k]
        stds = self._input_noise[k]
        motion = self.simulate(run, model, start) if any(stds) else None
        if motion is None:
            return []
        rng = np.random.default_rng(0)
        disturbances: list[Array] = []
        for _ in range(draws):
            noise = draw_noise(run.drive, stds, run.grid.t_s, 2 * run.substeps, rng)
            disturbed = self.simulate(run.disturbed(noise), model, start)
            if disturbed is not None:
                disturbances.append(disturbed.heights_m - motion.heights_m)
        if run.drive.moved and disturbances:
            disturbances = _without(self._free_motions(run, model, start, motion), disturbances)
        most_m = _PREDICTABLE * rms_about_mean(self.grids[k].heights_m)
        return [it * min(1.0, most_m / max(rms(it), 1e-300)) for it in disturbances]

    def _free_motions(
        self, run: DrivenRun, model: CandidateModel, start: Array, motion: Trajectory
    ) -> Array:
        """Change of the heights by each coordinate and velocity at the start, (N * struts, 2 n).

        A fit determines the start along with the noise: what the noise of a moved body does to the
        velocity at the start is not left.
        """
        scales, _ = self.start_scales(model.candidate)
        columns: list[Array] = []
        for i in range(2 * run.mechanism.coordinates):
            moved = self.simulate(run, model, start + scales[i] * np.eye(len(start))[i])
            if moved is not None:
                columns.append((moved.heights_m - motion.heights_m).ravel() / scales[i])
        return np.column_stack(columns) if columns else np.zeros((motion.heights_m.size, 0))

    # --- the residual force -----------------------------------------------------------------------

    def residual_force_rms_n(self, mean_square: float) -> float:
        """NaN: heights are fitted."""
        del mean_square
        return np.nan

    def residual_forces(self, k: int, model: CandidateModel) -> ResidualForces | None:
        """The force that would make the residual vanish, along the smoothed motion."""
        smoothed = self._smooth_motion(k, model)
        if smoothed is None:
            return None
        run, motion, spread = smoothed
        m = linear_part.with_linear_changes(run.mechanism, self.linear, model.parts.linear)
        if m is None:
            return None
        needed = m.strut_forces_of_motion(*motion, run.inputs, run.moved_at_nodes)
        along = track_of(motion, run)
        forces = track.strut_forces(self, model, along, self.states(k, model))
        constants = strut_constants(self, model.parts.linear)
        inertia = m.strut_inertia()
        deviation = (
            spread[2] @ inertia.T + constants[:, 2] * spread[1] + constants[:, 1] * spread[0]
        )
        acting = m.without_balance(forces.T)
        return ResidualForces(run.grid.name, along, (needed - acting).T, deviation.T)

    def _smooth_motion(
        self, k: int, model: CandidateModel
    ) -> tuple[DrivenRun, Trajectory, list[Array]] | None:
        """The measured motion before the delays of a model, smoothed about its free run.

        With the recording before these delays, and the standard deviations of heights, velocities
        and accelerations, each (N, struts). None where the model runs away.
        """
        run = self._before_delays(k, model)
        motion = self.simulate(run, model, model.parts.starts[k])
        if motion is None:
            return None
        residual = self._residual_states(k, model, motion)
        smoothed = Trajectory(
            *(b + np.column_stack([s.states[:, i] for s in residual]) for i, b in enumerate(motion))
        )
        spread = [np.column_stack([s.deviations[:, i] for s in residual]) for i in range(3)]
        return run, smoothed, spread

    def _needed_forces(self, run: DrivenRun, motion: Trajectory, linear: Array) -> Array:
        """Strut forces (N, struts) that a motion takes with changes of the linear part.

        Raises:
            FloatingPointError: The mass is not positive.
        """
        m = linear_part.with_linear_changes(run.mechanism, self.linear, linear)
        if m is None:
            raise FloatingPointError(run.grid.name)
        return m.strut_forces_of_motion(*motion, run.inputs, run.moved_at_nodes)

    def forces_over_time(
        self, k: int, model: CandidateModel, delays: Sequence[int]
    ) -> Sequence[ForceOverTime] | None:
        """The force that the smoothed motion takes in each strut, balanced forces left out."""
        linear, step_s = model.parts.linear, max(_FORCE_STEP_S, self.runs[k].grid.step_s)
        masses = [i for i, p in enumerate(self.linear) if p.kind == "mass"]

        def differentiate(delay: int) -> Array:
            later_n, earlier_n = (
                self._smooth_forces(k, model.with_linear(_changed(linear, delay, change_s)))[2]
                for change_s in (step_s, -step_s)
            )
            return (later_n - earlier_n) / (2.0 * step_s)

        try:
            run, motion, force_n = self._smooth_forces(k, model)
            by_delays = np.stack([differentiate(delay) for delay in delays], axis=-1)
            # From the same motion: no smoothing is between them.
            by_masses = [
                self._needed_forces(run, motion, _changed(linear, i, 1.0)) - force_n for i in masses
            ]
        except FloatingPointError:
            return None
        further = np.stack(by_masses, axis=-1) if masses else np.zeros((*force_n.shape, 0))
        shares = run.mechanism.shares_seen(len(force_n))
        return [
            ForceOverTime(
                motion.heights_m[:, i],
                motion.velocities_m_per_s[:, i],
                force_n[:, i],
                by_delays[:, i],
                further[:, i],
                shares[:, i],
            )
            for i in range(force_n.shape[1])
        ]

    def _smooth_forces(self, k: int, model: CandidateModel) -> tuple[DrivenRun, Trajectory, Array]:
        """A smoothed motion, with its recording and the forces (N, struts) that it takes.

        Raises:
            FloatingPointError: The model runs away.
        """
        smoothed = self._smooth_motion(k, model)
        if smoothed is None:
            raise FloatingPointError(self.runs[k].grid.name)
        run, motion, _ = smoothed
        return run, motion, self._needed_forces(run, motion, model.parts.linear)

    def _residual_states(self, k: int, model: CandidateModel, motion: Trajectory) -> list[Smoothed]:
        """Measured less simulated motion, smoothed, before the sensors' delays and gains."""
        grid, delays_s = self.runs[k].grid, self._delays(model).struts
        states, _ = grid.residual_states(self._seen(k, model, motion))
        channels = zip(states, delays_s.tolist(), self._gains(model).tolist(), strict=True)
        return [
            item._replace(
                states=late_columns(grid.t_s, item.states, None, np.full(_ORDER, -delay_s)) / gain
            )
            for item, delay_s, gain in channels
        ]

    # --- the regression along the motion ----------------------------------------------------------

    def segments(
        self, model: CandidateModel, most_samples: int, largest_stride: int
    ) -> tuple[Segment, ...]:
        """The regression about a free run of a model, which becomes the reference.

        Raises:
            FloatingPointError: The model runs away.
        """
        samples = sum(len(run.grid.t_s) for run in self.runs)
        segments: list[Segment] = []
        for k in range(self.recordings):
            run = self._before_delays(k, model)
            motion = self.simulate(run, model, model.parts.starts[k])
            if motion is None:
                raise FloatingPointError(run.grid.name)
            residual = self._residual_states(k, model, motion)
            pieces = track.pieces(len(run.grid.t_s), samples, most_samples, largest_stride)
            lead = _whole_motions(run, motion, residual) if len(pieces) > 1 else None
            seen = self._seen(k, model, motion), self._by_input_delays(k, model, motion)
            segments += [
                self._segment(run, motion, seen, residual, lead, cut, model)
                for cut in pieces
                if np.any(run.grid.fitted[cut])
            ]
        return tuple(segments)

    def _by_input_delays(
        self, k: int, model: CandidateModel, motion: Trajectory
    ) -> dict[int, Array]:
        """Derivative of the seen heights (N, struts) by the delay of each input that has one.

        Raises:
            FloatingPointError: The model runs away.
        """
        changes: dict[int, Array] = {}
        for index, parameter in enumerate(self.linear):
            if parameter.kind != "delay" or parameter.input < 0:
                continue
            later = model.with_linear(_changed(model.parts.linear, index, _DELAY_STEP_S))
            moved = self.simulate(self._before_delays(k, later), later, later.parts.starts[k])
            if moved is None:
                raise FloatingPointError(self.runs[k].grid.name)
            change = self._seen(k, model, moved) - self._seen(k, model, motion)
            changes[index] = change / _DELAY_STEP_S
        return changes

    def _segment(
        self,
        run: DrivenRun,
        simulated: Trajectory,
        seen: tuple[Array, dict[int, Array]],
        residual: Sequence[Smoothed],
        lead: tuple[Track, Track] | None,
        cut: slice,
        model: CandidateModel,
    ) -> Segment:
        linear, delays_s, gains = model.parts.linear, self._delays(model).struts, self._gains(model)
        m = linear_part.with_linear_changes(run.mechanism, self.linear, linear)
        if m is None:
            raise FloatingPointError(run.grid.name)
        grid, step_s, constants = run.grid, run.grid.step_s, strut_constants(self, linear)
        length_s = (cut.stop - cut.start) * step_s
        dynamics = LinearDynamics(m, constants, length_s, step_s * cut.step)
        states = [np.column_stack([s.states[cut, i] for s in residual]) for i in range(3)]
        motion = [a[cut] + b for a, b in zip(simulated, states, strict=True)]
        # The grid of the filter: finer where the motion is fast, never coarser than the samples.
        t_s = fine_times(grid.t_s[cut], dynamics.finer)
        z = CubicHermiteSpline(grid.t_s[cut], motion[0], motion[1])(t_s)
        w = CubicHermiteSpline(grid.t_s[cut], motion[1], motion[2])(t_s)
        acceleration = CubicSpline(grid.t_s[cut], motion[2])(t_s)
        inputs = CubicSpline(grid.t_s, run.inputs)(t_s)
        applied = run.drive.applied_n(inputs)
        temperature_c = np.interp(t_s, grid.t_s, grid.temperature_c)
        along = Track.of_columns(t_s, z, w, applied, temperature_c)
        rows = np.flatnonzero(grid.fitted[cut])
        weight = known_share(grid.t_s, delays_s)[cut][rows] / self.noise_m
        read = late_reader(t_s, grid.t_s[cut][rows], delays_s)
        read = (diags_array((gains * weight).ravel()) @ read).tocsr()

        def whiten(heights_m: Array) -> Array:
            """Changes (N, struts) of heights as they are seen, whitened, shape (m,)."""
            return np.asarray(read @ heights_m.ravel())

        def whiten_heights(generalised: Array) -> Array:
            """Whitened heights (m,) under generalised forces (N, n)."""
            return whiten(dynamics.heights(generalised, np.ones((len(t_s), 1))))

        mechanism = FilterMechanism(run.mechanism.cut(cut), grid.t_s[cut], t_s, inputs)

        def respond_to(strut: int, forces: Array) -> Array:
            heights_m = dynamics.heights(mechanism.jacobian[:, strut], forces)
            return np.asarray(read @ heights_m.reshape(-1, forces.shape[1]))

        raw = grid.heights_m[cut] - seen[0][cut]
        held = dynamics.holding_forces(states[0], states[1], grid.t_s[cut], t_s)
        target = (raw[rows] * weight).ravel() - whiten_heights(held)
        columns: list[Array] = []
        for index, parameter in enumerate(self.linear):
            if parameter.kind == "height_gain":
                own = np.zeros_like(seen[0][cut][rows])
                own[:, parameter.strut] = (seen[0][cut][rows] - self._middles_m)[:, parameter.strut]
                columns.append((own / gains * weight).ravel())
            elif parameter.kind != "delay":
                force = mechanism.unit_force(parameter, along, acceleration, self.motions)
                columns.append(whiten_heights(force))
            elif index in seen[1]:
                columns.append((seen[1][index][cut][rows] * weight).ravel())
            else:
                late = np.zeros_like(w)
                late[:, parameter.strut] = -w[:, parameter.strut]
                columns.append(whiten(late))
        initial = [whiten(heights_m) for heights_m in dynamics.free_motions(len(t_s))]
        numbers = block_numbers(grid.t_s, self.block_s)[cut][rows]
        blocks = np.repeat(numbers - numbers[0], len(self.noise_m))
        reference = along._replace(
            heights_m=_spline_through(grid.t_s[cut], simulated.heights_m[cut], t_s),
            velocities_m_per_s=_spline_through(
                grid.t_s[cut], simulated.velocities_m_per_s[cut], t_s
            ),
        )
        return Segment(
            along,
            reference,
            lead,
            respond_to,
            target,
            np.column_stack(columns),
            np.column_stack(initial),
            blocks,
        )

    # --- held-out data ----------------------------------------------------------------------------

    def evaluate(
        self, k: int, models: ComparedModels, fitted_rms_n: float, *, blocks: bool
    ) -> RunEvaluation:
        """Figures of a held-out recording: heights are DART's, driven as measured."""
        del fitted_rms_n
        grid = self.runs[k].grid
        rows = select_nodes(grid, blocks=blocks)
        measured = np.where(rows[:, np.newaxis], grid.heights_m, np.nan)
        simulated = [
            self.simulate(self._before_delays(k, model), model, model.parts.starts[k])
            for model in models
        ]
        motions = [motion for motion in simulated if motion is not None]
        if len(motions) < len(models):
            raise RecordingError(
                f"{grid.name}: the model runs away on this run, expected one that stays near the "
                "motion it was learnt from"
            )
        before, _, after = motions
        seen_m = [
            self._seen(k, model, motion) for model, motion in zip(models, motions, strict=True)
        ]
        shares = [known_share(grid.t_s, self._delays(model).struts) for model in models]
        measured = np.where(np.min(shares, axis=0) == 1.0, measured, np.nan)
        # Of a model's error a part looks like noise: the smallest estimate is nearest.
        residuals_m = [grid.heights_m - heights_m for heights_m in seen_m]
        noise = np.sqrt(np.min([_noise_variance(grid.t_s, r) for r in residuals_m], axis=0))
        on_dart_m: list[Array] = []
        coarser = self.coarser(models.linear)
        for model, motion, heights_m in (
            (models.nominal, before, seen_m[0]),
            (models.corrected, after, seen_m[2]),
        ):
            error_m = rms(measured - heights_m)
            tolerance_m = max(_AGREEMENT * float(noise.min()), _ACCURACY * error_m)
            start, run = model.parts.starts[k], coarser.in_fits(k, model)
            # DART is compared with steps that err less: friction that is all but a sign needs them.
            finer = self._before_delays(k, model).finer()
            exact = self.simulate(finer, model, start) or motion
            parts = self._parts(run, model, start)
            found_m = on_dart.dart_heights(
                self, run, model, start, exact.heights_m, tolerance_m, parts
            )
            on_dart_m.append(self._as_read(k, model, found_m, None))
        forces = [self.residual_forces(k, model) for model in models]
        before_n, linear_n, after_n = (
            np.nan if f is None else rms(np.where(rows, f.force_n, np.nan)) for f in forces
        )
        signal_n = self._strut_force_n(k, models.corrected, forces[2], rows)
        heights = ModelErrors(
            rms(measured - on_dart_m[0]), rms(measured - seen_m[1]), rms(measured - on_dart_m[1]),
            rms_about_mean(measured),
        )  # fmt: skip
        deviation_n = np.nan if forces[2] is None else rms(forces[2].deviation_n)
        disturbances = self.disturbances_m(k, models.corrected, _FLOOR_DRAWS)
        drift_m = max((rms(heights_m) for heights_m in disturbances), default=0.0)
        floor_m = float(np.hypot(rms(noise), drift_m))
        speeds = measured.T if forces[0] is None else forces[0].track.velocities_m_per_s
        series = tuple(
            HeldOutSeries(
                grid.name, strut.name, "m", grid.t_s, measured[:, i], on_dart_m[0][:, i],
                on_dart_m[1][:, i], grid.heights_m[:, i], speeds[i],
            )
            for i, strut in enumerate(self.spec.struts)
        )  # fmt: skip
        figures = RunFigures(
            grid.name,
            heights,
            ModelErrors(before_n, linear_n, after_n, signal_n),
            self._cell_errors(k, models, motions, rows),
        )
        return RunEvaluation(figures, NoiseFloor(floor_m, deviation_n), drift_m, series)

    def _strut_force_n(
        self, k: int, model: CandidateModel, along: ResidualForces | None, rows: Flags
    ) -> float:
        """RMS of a model's strut forces about their means, along the smoothed motion."""
        if along is None:
            return np.nan
        forces = track.strut_forces(self, model, along.track, self.states(k, model))
        return rms_about_mean(np.where(rows, forces, np.nan).T)

    def _cell_errors(
        self, k: int, models: ComparedModels, motions: Sequence[Trajectory], rows: Flags
    ) -> ModelErrors | None:
        """Errors against the load cell where it is evaluated, the models in free run."""
        run = self.runs[k]
        if run.cells is None or any(self.plants.plain.mockups):
            return None  # The mechanism of an FMU contains its force.
        t_s, cells_n, _ = run.cells
        evaluated = np.interp(t_s, run.grid.t_s, rows) > 0.5
        cells = np.where(evaluated[:, np.newaxis], cells_n, np.nan)
        forces = [
            self._forces_at(t_s, k, model, motion)
            for model, motion in zip(models, motions, strict=True)
        ]
        delays_s = _significant_delays_s(cells, forces[2], run.grid.step_s)
        before_n, linear_n, after_n = (rms(cells - _late_by(delays_s, t_s, it)) for it in forces)
        return ModelErrors(before_n, linear_n, after_n, rms_about_mean(cells))

    def _forces_at(self, t_s: Array, k: int, model: CandidateModel, motion: Trajectory) -> Array:
        """Forces (N, struts) of a model along a motion of its own, at times (N,)."""
        along = track_of(motion, self._before_delays(k, model))
        forces = track.strut_forces(self, model, along, self.states(k, model))
        return np.column_stack([np.interp(t_s, self.runs[k].grid.t_s, force) for force in forces])

    def delays_of_cells(self, model: CandidateModel) -> dict[int, CellDelay]:
        """Delay of each strut's load cell against a model."""
        found: dict[int, list[CellDelay]] = {}
        for k, run in enumerate(self.runs):
            motion = self.simulate(self._before_delays(k, model), model, model.parts.starts[k])
            if run.cells is None or motion is None or any(self.plants.plain.mockups):
                return {}
            t_s, cells_n, known_s = run.cells
            forces = self._forces_at(t_s, k, model, motion)
            for i in np.flatnonzero(np.isfinite(cells_n).any(axis=0)).tolist():
                further_s, std_s = delay_between(cells_n[:, i], forces[:, i], run.grid.step_s)
                delay = CellDelay(float(known_s[i]), float(known_s[i]) + further_s, std_s)
                found.setdefault(i, []).append(delay)
        return {i: _weighted_mean(delays) for i, delays in found.items()}


def _changed(values: Array, index: int, change: float) -> Array:
    """Values of which that at an index is changed, shape as given."""
    changed = values.copy()
    changed[index] += change
    return changed


def _without(columns: Array, signals: Sequence[Array]) -> list[Array]:
    """Signals without what columns (m, k) can give of them, in their own shapes."""
    basis = np.linalg.qr(columns)[0]
    rows = [(signal.shape, signal.ravel()) for signal in signals]
    return [(row - basis @ (basis.T @ row)).reshape(shape) for shape, row in rows]


def _weighted_mean(delays: Sequence[CellDelay]) -> CellDelay:
    """Delay of a cell by several recordings."""
    weights = np.array([max(delay.std_s, 1e-12) ** -2 for delay in delays])
    mean_s = float(np.average([delay.total_s for delay in delays], weights=weights))
    return CellDelay(delays[0].nominal_s, mean_s, float(np.sum(weights)) ** -0.5)


def _significant_delays_s(cells_n: Array, forces_n: Array, step_s: float) -> Array:
    """Delay of each load cell against forces (N, struts), zero where it is not significant."""
    delays_s = np.zeros(forces_n.shape[1])
    for i in np.flatnonzero(np.isfinite(cells_n).any(axis=0)).tolist():
        delay_s, std_s = delay_between(cells_n[:, i], forces_n[:, i], step_s)
        if abs(delay_s) > SIGNIFICANT * std_s:
            delays_s[i] = delay_s
    return delays_s


def _late_by(delays_s: Array, t_s: Array, forces_n: Array) -> Array:
    """Forces (N, struts) as they would be measured with delays."""
    columns = zip(delays_s.tolist(), forces_n.T, strict=True)
    return np.column_stack([np.interp(t_s - delay_s, t_s, f) for delay_s, f in columns])


def _driven(basis: ProblemBasis, smooth: SmoothRecording) -> DrivenRun:
    recording = smooth.recording
    drive = drive_of_recording(basis.spec, recording)
    inputs = drive.at(smooth.grid.t_s)
    motion = smooth.motion._replace(applied_n=drive.applied_n(inputs))
    mechanism = mechanism_along(basis.plants, motion, inputs)
    _check_columns(basis.spec, recording, mechanism, inputs)
    cells = recording.strut_forces_n
    known_s = [
        recording.delays_s.get(f"{LOAD_CELL_FORCE.column}:{strut.name}", 0.0)
        for strut in basis.spec.struts
    ]
    return driven_run(
        smooth.grid,
        drive,
        mechanism,
        _fastest(basis.spec, mechanism),
        None if cells is None else LoadCells(recording.t_s, cells, np.array(known_s)),
    )


def _fastest(spec: ModelSpec, m: LinearisedMechanism) -> float:
    """Largest eigenvalue of the model without effects, by size, in rad/s."""
    constants = np.array([(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in spec.struts])
    jacobian, mass = m.jacobian.mean(axis=0), m.mass.mean(axis=0)
    stiffness = jacobian.T @ np.diag(constants[:, 0]) @ jacobian - m.bias_q.mean(axis=0)
    damping = jacobian.T @ np.diag(constants[:, 1]) @ jacobian - m.bias_v.mean(axis=0)
    poles = np.linalg.eigvals(system_matrix(mass, stiffness, damping))
    return max(float(np.max(np.abs(poles))), 1e-9)


def _check_columns(
    spec: ModelSpec, recording: Recording, mechanism: LinearisedMechanism, inputs: Array
) -> None:
    """Refuse heights that what drives the bench cannot have caused."""
    load = float(np.max(np.abs(mechanism.bias)))
    load += float(np.max(np.abs(mechanism.inputs) @ np.abs(inputs).max(axis=0)))
    stiffest = max(strut.stiffness_n_per_m for strut in spec.struts)
    for item in recording.inputs.values():
        if item.quantity is MOTION:
            load += stiffest * float(np.ptp(item.values))
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


def _whole_motions(
    run: DrivenRun, simulated: Trajectory, residual: Sequence[Smoothed]
) -> tuple[Track, Track]:
    """Measured and reference motion of a whole recording, at its nodes."""
    reference = track_of(simulated, run)
    z, w = (np.array([s.states[:, i] for s in residual]) for i in (0, 1))
    measured = reference._replace(
        heights_m=reference.heights_m + z, velocities_m_per_s=reference.velocities_m_per_s + w
    )
    return measured, reference


def _noise_variance(t_s: Array, residual_m: Array) -> Array:
    """Variance of the noise in residual heights (N, struts), shape (struts,)."""
    return np.array([estimate_noise(t_s, column).variance for column in residual_m.T])


def _spline_through(nodes_s: Array, values: Array, t_s: Array) -> Array:
    """Columns (N, struts) at other times, as rows."""
    return np.ascontiguousarray(CubicSpline(nodes_s, values)(t_s).T)
