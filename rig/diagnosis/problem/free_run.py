"""Free-run simulation under the applied force: the residual is measured less simulated height.

The regression along the motion rests on an identity. Let the reference be a simulation with the
linear dynamics G (heights by force). The residual of the measured heights is G applied to the
force of what is missing, and to the changes of the linear part times the measured motion, plus
sensor noise as it is: an equation error that passes through the model's own dynamics has the noise
of an output error (Young 2011, 8.2). The measured motion itself comes from a smoother.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.linalg import expm

from dart_model.effects import Bench, Motion
from rig.diagnosis.numerics.compiled import (
    Equations,
    Model,
    Scenario,
    Steps,
    Trajectory,
    respond,
    simulate,
)
from rig.diagnosis.numerics.smoother import Smoothed, estimate_noise
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.grid import Grid, fine_times, smoothed
from rig.diagnosis.problem.mechanism import Mechanism
from rig.diagnosis.problem.problem import (
    Candidate,
    Flags,
    Integers,
    LinearParameter,
    Parts,
    Problem,
    ResidualForces,
    Segment,
    Track,
    block_numbers,
    placed,
    slots_of,
    state_scales,
    strut_constants,
)

Array = NDArray[np.float64]

_STEP_ANGLE = 0.2
"""Longest step as an angle of the model's fastest motion: the integrator errs by 1e-5 a radian."""
_LONGEST_STEP_S = 1.25e-3
"""Longest step where the motion is slow: laws that switch need it."""
_BEND = 4.0
"""How much more than its fastest linear motion a smooth nonlinear one may bend within a step."""
_FILTER_ANGLE = 0.25
"""Longest step of the linear dynamics under a force that is linear between samples, as an angle."""
_SETTLES_WITHIN = 0.15
"""Time constant of the slowest response of the regression's dynamics, as a share of a segment."""


class Run(NamedTuple):
    """A recording as it is simulated.

    Attributes:
        grid: Its nodes.
        applied_n: Applied force at the nodes, shape (N,).
        fine_n: Applied force at half sub-steps, shape (2 * substeps * (N - 1) + 1,).
        substeps: Steps of the integrator between nodes.
        angle: Angle by which the fastest motion turns within such a step.
        mechanism: Constant, or along this recording's motion.
    """

    grid: Grid
    applied_n: Array
    fine_n: Array
    substeps: int
    angle: float
    mechanism: Mechanism


def run_of(
    grid: Grid, applied_at: tuple[Array, Array], mechanism: Mechanism, fastest: float
) -> Run:
    """A recording ready to be simulated; the applied force as a cubic spline between its samples.

    Args:
        grid: Its nodes.
        applied_at: Times and values of the applied force.
        mechanism: The mechanism.
        fastest: Largest eigenvalue of the model by size, in rad/s.
    """
    usual = grid.step_s
    substeps = max(1, int(np.ceil(usual / min(_LONGEST_STEP_S, _STEP_ANGLE / fastest) - 1e-9)))
    fine = CubicSpline(*applied_at)(fine_times(grid.t_s, 2 * substeps))
    fine_n = np.ascontiguousarray(fine, dtype=np.float64)
    return Run(
        grid,
        np.ascontiguousarray(fine_n[:: 2 * substeps]),
        fine_n,
        substeps,
        fastest * usual / substeps,
        mechanism,
    )


def _cut(run: Run, nodes: slice) -> Run:
    fine = slice(2 * run.substeps * nodes.start, 2 * run.substeps * (nodes.stop - 1) + 1)
    return run._replace(
        grid=run.grid.cut(nodes),
        applied_n=run.applied_n[nodes],
        fine_n=run.fine_n[fine],
        mechanism=run.mechanism.cut(nodes),
    )


def _finer(run: Run) -> Run:
    steps = 2 * run.substeps
    spline = CubicSpline(fine_times(run.grid.t_s, steps), run.fine_n)
    fine_n = np.ascontiguousarray(spline(fine_times(run.grid.t_s, 2 * steps)))
    return run._replace(fine_n=fine_n, substeps=steps, angle=0.5 * run.angle)


_LEVEL_DRAWS = 3
"""Draws of the applied force's noise: their mean square is known to a third."""
_LARGEST_INPUT_NOISE = 0.01
"""Share of an applied force's range above which what is not smooth is not noise but excitation."""
_TOP = 0.8
"""Share of the sampled band above which a bench excites nothing: anti-aliasing filters and the
actuator end below, so what is there is noise."""


def input_noise_n(run: Run) -> float:
    """Standard deviation of the applied force's noise and resolution.

    White noise is in all of the band. What is not smooth, but not at its top either, is excitation.
    """
    force = run.applied_n - run.applied_n.mean()
    variance = estimate_noise(run.grid.t_s, force).variance
    window = np.hanning(len(force))
    power = np.abs(np.fft.rfft(force * window)) ** 2 / float(window @ window)
    # Lines of a periodogram are exponentially distributed: their median is ln 2 of their mean.
    top = float(np.median(power[int(_TOP * len(power)) :])) / np.log(2.0)
    return min(float(np.sqrt(min(variance, top))), _LARGEST_INPUT_NOISE * float(np.ptp(force)))


@dataclass(frozen=True, eq=False)
class FreeRun(Problem):
    """A model held against recordings of a force-driven bench.

    Attributes:
        runs: The recordings.
        noise_m: Standard deviation of each height's noise, shape (struts,).
    """

    bench: ClassVar[Bench] = "force_given"
    runs: tuple[Run, ...]
    noise_m: Array

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return len(self.runs)

    def finer(self) -> "FreeRun":
        """The same problem with steps half as long: the integrator then errs a sixteenth."""
        return replace(self, runs=tuple(_finer(run) for run in self.runs))

    def fitted(self, k: int) -> Flags:
        """Nodes of a recording that take part in fits, shape (N,)."""
        return self.runs[k].grid.fitted

    def cut(self, pieces: Sequence[tuple[int, slice]]) -> "FreeRun":
        """The same of pieces of recordings."""
        return replace(self, runs=tuple(_cut(self.runs[k], nodes) for k, nodes in pieces))

    @cached_property
    def _stroke_m(self) -> float:
        return max(motion.stroke_m for motion in self.motions)

    @cached_property
    def _input_noise_n(self) -> tuple[float, ...]:
        return tuple(input_noise_n(run) for run in self.runs)

    def blocks(self, k: int) -> Integers:
        """Block of each row of a recording's residual."""
        return np.repeat(self.runs[k].grid.blocks(self.block_s), len(self.noise_m))

    def start(self, k: int, candidate: Candidate) -> Array:
        """Coordinates and velocities from a parabola through the first samples; states at zero."""
        grid, mechanism = self.runs[k].grid, self.runs[k].mechanism
        heights, velocities = first_motion(grid)
        jacobian = mechanism.jacobian[0]
        q = mechanism.q[0] + np.linalg.solve(jacobian, heights - mechanism.heights_m[0])
        v = np.linalg.solve(jacobian, velocities)
        return np.concatenate([q, v, np.zeros(slots_of(self, candidate).states)])

    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """A thousandth of the stroke, a hundredth of the speed, and the laws' own scales."""
        row = float(np.max(np.abs(self.runs[0].mechanism.jacobian)))
        q = 1e-3 * self._stroke_m / row
        v = 1e-2 * max(motion.speed_m_per_s for motion in self.motions) / row
        n = self.runs[0].mechanism.coordinates
        scales, fitted = state_scales(placed(self, candidate))
        return (
            np.concatenate([np.full(n, q), np.full(n, v), scales]),
            np.concatenate([np.ones(2 * n, dtype=np.bool_), fitted]),
        )

    def floor_level(self, candidate: Candidate, parts: Parts) -> float:
        """One for the heights' noise, and what noise of the applied forces adds in simulation."""
        squares = [
            float(np.mean((heights_m / self.noise_m) ** 2))
            for k in range(self.recordings)
            for heights_m in self.disturbances_m(k, candidate, parts, _LEVEL_DRAWS)
        ]
        return 1.0 + (float(np.mean(squares)) if squares else 0.0)

    def disturbances_m(self, k: int, candidate: Candidate, parts: Parts, draws: int) -> list[Array]:
        """Heights that draws of the applied force's noise cause, drift of springless axes included.

        Each of shape (n, struts); none where there is no noise, or the model runs away.
        """
        run = self.runs[k]
        noise = self._input_noise_n[k]
        there = self.simulated(run, candidate, parts, parts.starts[k]) if noise > 0.0 else None
        if there is None:
            return []
        rng = np.random.default_rng(0)
        found: list[Array] = []
        for _ in range(draws):
            # White between samples: what the force is wrong by is held over a sample or so.
            nodes = noise * rng.standard_normal(len(run.grid.t_s))
            fine = np.append(np.repeat(nodes[:-1], 2 * run.substeps), nodes[-1])
            other = run._replace(fine_n=run.fine_n + fine)
            moved = self.simulated(other, candidate, parts, parts.starts[k])
            if moved is not None:
                found.append(moved.heights_m - there.heights_m)
        return found

    def simulated(
        self, run: Run, candidate: Candidate, parts: Parts, start: Array
    ) -> Trajectory | None:
        """Free-run simulation, or None if it runs away or its mass is not positive."""
        m = linear_part.corrected(run.mechanism, self.linear, parts.linear)
        if m is None:
            return None
        shape = (len(run.grid.t_s), len(self.noise_m))
        there = Trajectory(np.empty(shape), np.empty(shape), np.empty(shape))
        inverse = np.ascontiguousarray(np.linalg.inv(m.mass), dtype=np.float64)
        equations = Equations(
            inverse, m.bias, m.bias_q, m.bias_v, m.jacobian, m.heights_m, m.applied, m.q, m.v
        )
        slots, struts = slots_of(self, candidate), strut_constants(self, parts.linear)
        finite = simulate(
            slots.laws,
            Model(slots.placement, parts.effects, struts, equations),
            Scenario(start, run.grid.t_s, run.fine_n, run.grid.temperature_c),
            Steps(run.substeps, _BEND * run.angle**2, self._stroke_m),
            there,
        )
        return there if finite else None

    def residual(self, k: int, candidate: Candidate, parts: Parts) -> Array | None:
        """Measured less simulated heights over the noise, at the fitted nodes, flat."""
        run = self.runs[k]
        there = self.simulated(run, candidate, parts, parts.starts[k])
        if there is None:
            return None
        return ((run.grid.heights_m - there.heights_m)[run.grid.fitted] / self.noise_m).ravel()

    def residual_forces(self, k: int, candidate: Candidate, parts: Parts) -> ResidualForces | None:
        """The force that would make the residual vanish, along the smoothed motion."""
        run = self.runs[k]
        there = self.simulated(run, candidate, parts, parts.starts[k])
        m = linear_part.corrected(run.mechanism, self.linear, parts.linear)
        if there is None or m is None:
            return None
        residual, _ = smoothed(run.grid, there.heights_m)
        z, w, a = (
            b + np.column_stack([s.states[:, i] for s in residual]) for i, b in enumerate(there)
        )
        spread = [np.column_stack([s.deviations[:, i] for s in residual]) for i in range(3)]
        along = Track.of_columns(run.grid.t_s, z, w, run.applied_n, run.grid.temperature_c)
        states = self.states(k, candidate, parts)
        forces = track.strut_forces(self, candidate, parts, along, states)
        every = np.arange(len(z)) if len(m.q) > 1 else np.zeros(len(z), dtype=np.int64)
        jacobian, mass = m.jacobian[every], m.mass[every]
        q = (
            m.q[every]
            + np.linalg.solve(jacobian, (z - m.heights_m[every])[..., np.newaxis])[..., 0]
        )
        v = np.linalg.solve(jacobian, w[..., np.newaxis])[..., 0]
        acceleration = np.linalg.solve(jacobian, a[..., np.newaxis])[..., 0]
        bias = m.bias[every] + m.applied[every] * run.applied_n[:, np.newaxis]
        bias = bias + np.einsum("kij,kj->ki", m.bias_q[every], q - m.q[every])
        bias = bias + np.einsum("kij,kj->ki", m.bias_v[every], v - m.v[every])
        needed = np.einsum("kij,kj->ki", mass, acceleration) - bias
        transposed = np.swapaxes(jacobian, 1, 2)
        needed = np.linalg.solve(transposed, needed[..., np.newaxis])[..., 0]
        constants = strut_constants(self, parts.linear)
        inertia = np.abs(np.linalg.solve(transposed[0], mass[0] @ np.linalg.inv(jacobian[0])))
        deviation = (
            spread[2] @ inertia.T + constants[:, 2] * spread[1] + constants[:, 1] * spread[0]
        )
        return ResidualForces(run.grid.name, along, needed.T - forces, deviation.T)

    def states(self, k: int, candidate: Candidate, parts: Parts) -> Array:
        """Internal states at the beginning of a recording."""
        del candidate
        return parts.starts[k][2 * self.runs[k].mechanism.coordinates :]

    # --- the regression along the motion ------------------------------------------------------

    def segments(
        self, candidate: Candidate, parts: Parts, most_samples: int, most_thinned: int
    ) -> tuple[Segment, ...]:
        """The regression about a free run of a model, which becomes the reference.

        Raises:
            FloatingPointError: The model runs away.
        """
        samples = sum(len(run.grid.t_s) for run in self.runs)
        found: list[Segment] = []
        for k, run in enumerate(self.runs):
            there = self.simulated(run, candidate, parts, parts.starts[k])
            if there is None:
                raise FloatingPointError(run.grid.name)
            residual, _ = smoothed(run.grid, there.heights_m)
            pieces = track.pieces(len(run.grid.t_s), samples, most_samples, most_thinned)
            lead = self._whole(run, there, residual) if len(pieces) > 1 else None
            for cut in pieces:
                if not np.any(run.grid.fitted[cut]):
                    continue  # All of it is held out.
                dynamics = _Dynamics(self, run, parts.linear, cut)
                found.append(self._segment(run, there, residual, lead, cut, dynamics))
        return tuple(found)

    def _segment(
        self,
        run: Run,
        there: Trajectory,
        residual: Sequence[Smoothed],
        lead: tuple[Track, Track] | None,
        cut: slice,
        dynamics: "_Dynamics",
    ) -> Segment:
        grid = run.grid
        states = [np.column_stack([s.states[cut, i] for s in residual]) for i in range(3)]
        motion = [a[cut] + b for a, b in zip(there, states, strict=True)]
        # The grid of the filter: finer where the motion is fast, never coarser than the samples.
        t_s = fine_times(grid.t_s[cut], dynamics.finer)
        z = CubicHermiteSpline(grid.t_s[cut], motion[0], motion[1])(t_s)
        w = CubicHermiteSpline(grid.t_s[cut], motion[1], motion[2])(t_s)
        acceleration = CubicSpline(grid.t_s[cut], motion[2])(t_s)
        applied = CubicSpline(grid.t_s, run.applied_n)(t_s)
        temperature_c = np.interp(t_s, grid.t_s, grid.temperature_c)
        along = Track.of_columns(t_s, z, w, applied, temperature_c)
        rows = np.flatnonzero(grid.fitted[cut])
        every = dynamics.finer
        weight = 1.0 / self.noise_m

        def answer(forces: Array) -> Array:
            """Whitened heights (m,) under generalised forces (N, n)."""
            return (dynamics.heights(forces)[rows * every] * weight).ravel()

        tables = _Tables(run.mechanism.cut(cut), grid.t_s[cut], t_s)

        def respond_to(strut: int, force: Array) -> Array:
            return answer(tables.jacobian[:, strut] * force[:, np.newaxis])

        raw = grid.heights_m[cut] - there.heights_m[cut]
        held = dynamics.holding_forces(states[0], states[1], grid.t_s[cut], t_s)
        target = (raw[rows] * weight).ravel() - answer(held)
        columns = [
            answer(tables.generalised(parameter, z, w, acceleration, applied, self.motions))
            for parameter in self.linear
        ]
        initial = [(h[rows * every] * weight).ravel() for h in dynamics.free_motions(len(t_s))]
        numbers = block_numbers(grid.t_s, self.block_s)[cut][rows]
        blocks = np.repeat(numbers - numbers[0], len(self.noise_m))
        reference = along._replace(
            heights_m=_spline_through(grid.t_s[cut], there.heights_m[cut], t_s),
            velocities_m_per_s=_spline_through(grid.t_s[cut], there.velocities_m_per_s[cut], t_s),
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

    def _whole(
        self, run: Run, there: Trajectory, residual: Sequence[Smoothed]
    ) -> tuple[Track, Track]:
        """Measured and reference motion of a whole recording, at its nodes."""
        reference = track_of(run, there)
        measured = reference._replace(
            heights_m=reference.heights_m + np.array([s.states[:, 0] for s in residual]),
            velocities_m_per_s=reference.velocities_m_per_s
            + np.array([s.states[:, 1] for s in residual]),
        )
        return measured, reference


def track_of(run: Run, there: Trajectory) -> Track:
    """A simulated motion of a recording as a track."""
    z, w, _ = there
    return Track.of_columns(run.grid.t_s, z, w, run.applied_n, run.grid.temperature_c)


def _spline_through(nodes_s: Array, values: Array, t_s: Array) -> Array:
    """Columns (N, struts) at other times, as rows."""
    return np.ascontiguousarray(CubicSpline(nodes_s, values)(t_s).T)


def first_motion(grid: Grid) -> tuple[Array, Array]:
    """Heights and velocities at a run's start, by a parabola through its first samples."""
    count = min(len(grid.t_s), max(20, int(0.05 / grid.step_s)))
    heights: list[float] = []
    velocities: list[float] = []
    t = grid.t_s[:count] - grid.t_s[0]
    for column in grid.heights_m[:count].T:
        there = np.isfinite(column)
        polynomial = np.polynomial.Polynomial.fit(t[there], column[there], 2)
        heights.append(float(polynomial(0.0)))
        velocities.append(float(polynomial.deriv()(0.0)))
    return np.array(heights), np.array(velocities)


class _Tables:
    """The mechanism on the grid of the filter."""

    def __init__(self, mechanism: Mechanism, nodes_s: Array, t_s: Array) -> None:
        at = np.zeros(len(t_s), dtype=np.int64)
        if len(mechanism.q) > 1:
            at = np.clip(np.searchsorted(nodes_s, t_s - 1e-12), 0, len(nodes_s) - 1)
        self._mechanism, self._at = mechanism, at
        self.jacobian = mechanism.jacobian[at]

    def generalised(
        self,
        parameter: LinearParameter,
        z: Array,
        w: Array,
        acceleration: Array,
        applied: Array,
        motions: Sequence[Motion],
    ) -> Array:
        """Generalised force (N, n) of a unit change of a linear parameter along the motion."""
        strut = parameter.strut
        if parameter.kind == "mass":
            q = np.linalg.solve(self.jacobian, acceleration[..., np.newaxis])[..., 0]
            inertia = np.einsum("kij,kj->ki", self._mechanism.mass_by_kg[self._at, strut], q)
            return self._mechanism.bias_by_kg[self._at, strut] - inertia
        if parameter.kind == "gain":
            return self._mechanism.applied[self._at] * applied[:, np.newaxis]
        force = linear_part.strut_force(parameter.kind, z[:, strut], w[:, strut], motions[strut])
        return self.jacobian[:, strut] * force[:, np.newaxis]


class _Dynamics:
    """The linear dynamics of a model about its mean configuration, discretised."""

    def __init__(self, problem: FreeRun, run: Run, linear: Array, cut: slice) -> None:
        m = linear_part.corrected(run.mechanism, problem.linear, linear)
        if m is None:
            raise FloatingPointError(run.grid.name)
        n = m.coordinates
        constants = strut_constants(problem, linear)
        jacobian = m.jacobian.mean(axis=0)
        mass = m.mass.mean(axis=0)
        stiffness = jacobian.T @ np.diag(constants[:, 1]) @ jacobian - m.bias_q.mean(axis=0)
        damping = jacobian.T @ np.diag(constants[:, 2]) @ jacobian - m.bias_v.mean(axis=0)
        duration = (cut.stop - cut.start) * run.grid.step_s
        coarse_s = run.grid.step_s * cut.step
        self.more_stiffness, self.more_damping = _settling(
            mass, stiffness, damping, 1.0 / (_SETTLES_WITHIN * duration)
        )
        a = system(mass, stiffness + self.more_stiffness, damping + self.more_damping)
        fastest = float(np.max(np.abs(np.linalg.eigvals(a))))
        self.finer = max(1, int(np.ceil(fastest * coarse_s / _FILTER_ANGLE)))
        step = coarse_s / self.finer
        b = np.vstack([np.zeros((n, n)), np.linalg.inv(mass)])
        augmented = np.zeros((4 * n, 4 * n))
        augmented[: 2 * n, : 2 * n] = a * step
        augmented[: 2 * n, 2 * n : 3 * n] = b * step
        augmented[2 * n : 3 * n, 3 * n :] = np.eye(n)
        e = expm(augmented)
        late = e[: 2 * n, 3 * n :]
        parts = (
            e[: 2 * n, : 2 * n],
            e[: 2 * n, 2 * n : 3 * n] - late,
            late,
            np.hstack([jacobian, np.zeros_like(jacobian)]),
        )
        self._parts = tuple(np.ascontiguousarray(part, dtype=np.float64) for part in parts)
        self._jacobian = jacobian

    def heights(self, forces: Array) -> Array:
        """Heights (N, struts) from rest under generalised forces (N, n)."""
        out = np.empty((len(forces), len(self._jacobian)))
        respond(*self._parts, np.ascontiguousarray(forces), out)
        return out

    def holding_forces(self, z: Array, w: Array, nodes_s: Array, t_s: Array) -> Array:
        """Generalised force of what was added so that the dynamics settle, along a difference."""
        inverse = np.linalg.pinv(self._jacobian)
        force = z @ inverse.T @ self.more_stiffness.T + w @ inverse.T @ self.more_damping.T
        return CubicSpline(nodes_s, force)(t_s)

    def free_motions(self, samples: int) -> list[Array]:
        """Heights (N, struts) of the free motion from a unit of each coordinate and velocity."""
        transition, output = self._parts[0], self._parts[3]
        powers = np.eye(len(transition))[np.newaxis]
        ahead = transition
        while len(powers) < samples:
            powers = np.concatenate([powers, powers @ ahead])
            ahead = ahead @ ahead
        return [(output @ powers[:samples, :, i].T).T for i in range(len(transition))]


def system(mass: Array, stiffness: Array, damping: Array) -> Array:
    """System matrix of coordinates and velocities."""
    n = len(mass)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower], dtype=np.float64)


def _settling(mass: Array, stiffness: Array, damping: Array, slowest: float) -> tuple[Array, Array]:
    """Stiffness and damping to add so that no response lasts longer than a time constant."""
    n = len(mass)
    more_stiffness, more_damping = np.zeros((n, n)), np.zeros((n, n))
    softest = float(np.min(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real))
    if softest < 4.0 * slowest**2:
        more_stiffness = mass * (4.0 * slowest**2 - min(softest, 0.0))
    poles = np.linalg.eigvals(system(mass, stiffness + more_stiffness, damping)).real
    if float(np.max(poles)) > -slowest:
        more_damping = mass * 2.0 * (slowest + max(float(np.max(poles)), 0.0))
    return more_stiffness, more_damping
