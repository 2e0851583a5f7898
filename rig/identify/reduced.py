"""The model as matrices that DART gave, and its simulation in machine code.

A bench on straight guides has a constant mass matrix and constant strut directions. DART is asked
for them once; then a run of a minute takes milliseconds, fast enough to fit many rival laws.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.identify.compiled import Slots, simulate, slots
from rig.identify.records import Record, RecordError
from rig.identify.smoother import estimate_noise, smooth

Array = NDArray[np.float64]

LONGEST_STEP_S = 1.25e-3
"""Longest step of the reduced simulation."""

_STEP_ANGLE = 0.2
"""Longest step as an angle of the model's fastest motion: the integrator errs by 1e-5 a radian."""

_BEND = 4.0
"""How much more than its fastest linear motion a smooth nonlinear one may bend within a step."""


class Model(NamedTuple):
    """A bench on straight guides.

    Attributes:
        spec: The model it was made from.
        mass_kg: Generalised mass matrix, shape (n, n).
        gravity_n: Generalised gravity force, shape (n,).
        rows: Derivative of heights by coordinates, shape (struts, n).
        offsets_m: Heights at zero coordinates, shape (struts,).
        applied_row: Generalised force per applied newton, shape (n,).
        struts: Free length, stiffness, damping and gravity of each strut, shape (struts, 4).
        mass_by_strut: Change of the mass matrix per kg added to a strut, shape (struts, n, n).
        gravity_by_strut: The same of the gravity force, shape (struts, n).
    """

    spec: ModelSpec
    mass_kg: Array
    gravity_n: Array
    rows: Array
    offsets_m: Array
    applied_row: Array
    struts: Array
    mass_by_strut: Array
    gravity_by_strut: Array

    @property
    def coordinates(self) -> int:
        """Number of coordinates."""
        return self.mass_kg.shape[0]

    @property
    def fastest_rad_per_s(self) -> float:
        """Largest eigenvalue, by size, of the model without effects."""
        n = self.coordinates
        stiffness = self.rows.T @ np.diag(self.struts[:, 1]) @ self.rows
        damping = self.rows.T @ np.diag(self.struts[:, 2]) @ self.rows
        lower = -np.linalg.solve(self.mass_kg, np.hstack([stiffness, damping]))
        system = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])
        return float(np.max(np.abs(np.linalg.eigvals(system))))


def reduced_model(spec: ModelSpec) -> Model:
    """The model's matrices, asked of DART.

    Args:
        spec: The model; effects that it already has are kept apart, see `known_effects`.

    Raises:
        RecordError: The model does not move on straight guides, or has a coordinate without height.
    """
    plain = spec
    for strut in spec.struts:
        plain = plain.with_effects(strut.name, ())
    guided = DartPlant(plain).guided()
    if guided is None or guided.strut_rows.shape[0] != guided.mass_kg.shape[0]:
        raise RecordError(
            f"model {spec.name}: expected struts on straight guides, one for each coordinate, "
            "so that the measured heights give the motion"
        )
    masses: list[Array] = []
    weights: list[Array] = []
    one_kg = EffectSpec(name="added_mass", parameters={"mass_kg": 1.0})
    for strut in spec.struts:
        heavier = DartPlant(plain.with_effects(strut.name, (one_kg,))).guided()
        assert heavier is not None
        masses.append(heavier.mass_kg - guided.mass_kg)
        weights.append(heavier.gravity_n - guided.gravity_n)
    constants = [
        (s.free_length_m, s.stiffness_n_per_m, s.damping_n_s_per_m, spec.gravity_m_per_s2)
        for s in spec.struts
    ]
    return Model(
        spec,
        np.ascontiguousarray(guided.mass_kg),
        np.ascontiguousarray(guided.gravity_n),
        np.ascontiguousarray(guided.strut_rows),
        np.ascontiguousarray(guided.heights_m),
        np.ascontiguousarray(guided.applied_row),
        np.array(constants),
        np.array(masses),
        np.array(weights),
    )


_NOWHERE = np.zeros((1, 1))


class Grid(NamedTuple):
    """A record on the nodes of the simulation.

    Attributes:
        name: Name of the record.
        t_s: Times of the nodes; measured times and, in gaps, times between, shape (N,).
        measured: Whether a node's heights were measured, shape (N,).
        heights_m: Measured heights, NaN elsewhere, shape (N, struts).
        applied_n: Applied force at the nodes, shape (N,).
        fine_n: Applied force at half sub-steps, shape (2 * substeps * (N - 1) + 1,).
        temperature_c: Temperature at the nodes, shape (N,).
        has_temperature: Whether it was measured.
        substeps: Steps of the integrator between nodes.
        angle: Angle by which the model's fastest motion turns in one of those steps, in rad.
        pull_per_s: Rate at which a simulation is pulled towards `target_m`; 0 is open loop.
        target_m: Smoothed heights, shape (N, struts); read where there is a pull.
        target_m_per_s: Smoothed velocities.
    """

    name: str
    t_s: Array
    measured: NDArray[np.bool_]
    heights_m: Array
    applied_n: Array
    fine_n: Array
    temperature_c: Array
    has_temperature: bool
    substeps: int
    angle: float
    pull_per_s: float = 0.0
    target_m: Array = _NOWHERE
    target_m_per_s: Array = _NOWHERE

    @property
    def step_s(self) -> float:
        """Usual time between nodes."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)

    def rows(self, first: int, last: int) -> "Grid":
        """Nodes `first` to `last`, the last one excluded."""
        fine = slice(2 * self.substeps * first, 2 * self.substeps * (last - 1) + 1)
        cut = slice(first, last)
        return self._replace(
            t_s=self.t_s[cut],
            measured=self.measured[cut],
            heights_m=self.heights_m[cut],
            applied_n=self.applied_n[cut],
            fine_n=self.fine_n[fine],
            temperature_c=self.temperature_c[cut],
        )

    def finer(self) -> "Grid":
        """The same run in half as long steps, the applied force a parabola over each step."""
        whole = self.fine_n
        first, middle, last = whole[:-2:2], whole[1:-1:2], whole[2::2]
        fine = np.empty(2 * (len(whole) - 1) + 1)
        fine[::2] = whole
        fine[1::4] = 0.375 * first + 0.75 * middle - 0.125 * last
        fine[3::4] = -0.125 * first + 0.75 * middle + 0.375 * last
        return self._replace(fine_n=fine, substeps=2 * self.substeps, angle=0.5 * self.angle)

    def input_moved(self) -> "Grid":
        """The run, its applied force moved by as much as its reconstruction may be wrong.

        A cubic spline errs by the fourth power of the sampling interval: what it changes when every
        other sample is left out is sixteen times its error, less that error itself (Richardson).
        """
        fine_t = _fine_times(self.t_s, self.substeps)
        halved = CubicSpline(self.t_s[::2], self.applied_n[::2])(fine_t)
        return self._replace(fine_n=self.fine_n + (self.fine_n - halved) / 15.0)


NO_TEMPERATURE_C = 20.0
"""Temperature of a record that has none."""


def grid_of(record: Record, model: Model, *, held: bool = False) -> Grid:
    """The record on simulation nodes; the applied force as a cubic spline, or held.

    Args:
        record: A record with an applied force.
        model: The bench, whose fastest motion says how short the steps must be.
        held: The force is held between samples instead.
    """
    assert record.applied_force_n is not None
    steps = np.diff(record.t_s)
    usual = float(np.median(steps))
    pieces = np.maximum(1, np.rint(steps / usual)).astype(np.int64)
    first = np.repeat(record.t_s[:-1], pieces)
    part = np.concatenate([np.arange(n) for n in pieces]) if pieces.max() > 1 else 0.0
    t_s = np.append(first + part * np.repeat(steps / pieces, pieces), record.t_s[-1])
    at = np.concatenate([[0], np.cumsum(pieces)])
    heights = np.full((len(t_s), record.heights_m.shape[1]), np.nan)
    heights[at] = record.heights_m
    measured = np.all(np.isfinite(heights), axis=1)
    longest = min(LONGEST_STEP_S, _STEP_ANGLE / max(model.fastest_rad_per_s, 1e-9))
    substeps = max(1, int(np.ceil(usual / longest - 1e-9)))
    fine_t = _fine_times(t_s, substeps)
    if held:
        rank = np.clip(np.searchsorted(record.t_s, fine_t, side="right") - 1, 0, None)
        fine_n = record.applied_force_n[rank]
    else:
        fine_n = CubicSpline(record.t_s, record.applied_force_n)(fine_t)
    temperature = np.full(len(t_s), NO_TEMPERATURE_C)
    if record.temperature_c is not None:
        temperature = _smooth_temperature(record, t_s)
    return Grid(
        record.name,
        t_s,
        measured,
        heights,
        np.ascontiguousarray(fine_n[:: 2 * substeps]),
        np.ascontiguousarray(fine_n),
        temperature,
        record.temperature_c is not None,
        substeps,
        model.fastest_rad_per_s * usual / substeps,
    )


def _smooth_temperature(record: Record, t_s: Array) -> Array:
    # Oil warms slowly; the sensor's noise would make the damper tremble.
    assert record.temperature_c is not None
    if float(np.ptp(record.temperature_c)) == 0.0:
        return np.full(len(t_s), float(record.temperature_c[0]))
    noise = estimate_noise(record.t_s, record.temperature_c)
    smoothed = smooth(record.t_s, record.temperature_c, noise)
    return np.interp(t_s, record.t_s, smoothed.states[:, 0])


def _fine_times(t_s: Array, substeps: int) -> Array:
    share = np.arange(2 * substeps) / (2.0 * substeps)
    fine = t_s[:-1, np.newaxis] + np.diff(t_s)[:, np.newaxis] * share
    return np.append(fine.ravel(), t_s[-1])


class Planted(NamedTuple):
    """Effects of a model, ready to be simulated.

    Attributes:
        effects: Strut index and name of each.
        slots: The same for the compiled loops.
    """

    effects: tuple[tuple[int, str], ...]
    slots: Slots

    @property
    def parameter_count(self) -> int:
        """Number of parameters of all effects."""
        return sum(len(effect(name).parameters) for _, name in self.effects)


def planted(effects: tuple[tuple[int, str], ...]) -> Planted:
    """Effects given by strut index and name."""
    return Planted(effects, slots(effects))


class Trajectory(NamedTuple):
    """Strut motions at the nodes, each of shape (N, struts)."""

    heights_m: Array
    velocities_m_per_s: Array
    accelerations_m_per_s2: Array


def run(
    model: Model, what: Planted, parameters: Array, grid: Grid, start: Array
) -> Trajectory | None:
    """Simulate open loop.

    Args:
        model: The bench.
        what: Its effects.
        parameters: Parameters of all effects, one after another.
        grid: The applied force.
        start: Coordinates, velocities and memory at the first node, shape (2 n + memory,).

    Returns:
        The motion, or None if it runs away.
    """
    mass, gravity = mass_and_gravity(model, what, parameters)
    if float(np.linalg.eigvalsh(mass)[0]) <= 0.0:
        return None
    shape = (len(grid.t_s), model.rows.shape[0])
    heights, velocities, accelerations = np.empty(shape), np.empty(shape), np.empty(shape)
    finite = simulate(
        what.slots.index,
        parameters,
        model.struts,
        model.rows,
        model.offsets_m,
        np.ascontiguousarray(np.linalg.inv(mass)),
        gravity,
        model.applied_row,
        grid.t_s,
        grid.fine_n,
        grid.temperature_c,
        grid.substeps,
        _BEND * grid.angle**2,
        start,
        pull_on(model, grid),
        grid.target_m,
        grid.target_m_per_s,
        heights,
        velocities,
        accelerations,
    )
    return Trajectory(heights, velocities, accelerations) if finite else None


def pull_on(model: Model, grid: Grid) -> Array:
    """Stiffness and damping of the pull on each strut: critically damped, shape (struts, 2)."""
    rate = grid.pull_per_s
    mass = 1.0 / np.einsum("ij,jk,ik->i", model.rows, np.linalg.inv(model.mass_kg), model.rows)
    return np.ascontiguousarray(np.outer(mass, [rate * rate, 2.0 * rate]))


def mass_and_gravity(model: Model, what: Planted, parameters: Array) -> tuple[Array, Array]:
    """Mass matrix and gravity force with the masses that effects add."""
    mass, gravity = model.mass_kg, model.gravity_n
    for row, (strut, name) in enumerate(what.effects):
        if effect(name).adds_mass:
            added = parameters[what.slots.index[row, 1]]
            mass = mass + added * model.mass_by_strut[strut]
            gravity = gravity + added * model.gravity_by_strut[strut]
    return mass, gravity


def start_of(model: Model, heights_m: Array, velocities_m_per_s: Array, memory: int) -> Array:
    """Start vector with the given strut heights and velocities, and memory at zero."""
    q = np.linalg.solve(model.rows, heights_m - model.offsets_m)
    v = np.linalg.solve(model.rows, velocities_m_per_s)
    return np.concatenate([q, v, np.zeros(memory)], dtype=np.float64)
