"""DART as a black box: state in, forces in, state out.

DART's own `World.step` is semi-implicit Euler, first order, with forces held over the step. Here
DART only answers "what is the acceleration in this state under these forces?"
(`computeForwardDynamics`), and Kutta's third-order method asks it
three times a sub-step. That keeps the error of the seed case far below the height's resolution at
one sub-step a millisecond, where a second-order method would need four.

Reference: Kutta, "Beitrag zur näherungsweisen Integration totaler Differentialgleichungen" (1901);
for the use in multibody dynamics: Featherstone, "Rigid Body Dynamics Algorithms" (2008).
"""

import math
from collections.abc import Callable, Sequence
from operator import add, mul
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import dartpy
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from dart_model.effects import Effect, effect
from dart_model.spec import WORLD, BodySpec, FileSkeleton, InlineSkeleton, ModelSpec, StrutSpec
from rig.inputs.errors import InputError

# dartpy ships no types: it is untyped here, and nowhere else.
_dart = cast("Any", dartpy)

DEFAULT_STEP_S = 1e-3
"""Longest sub-step of a smooth model; shorter where an effect is stiff."""

_INSTANT_S = 1e-9
"""DART takes springs and dampers of a joint's own at the end of its time step, not of ours."""

_MAX_SUBSTEPS = 10_000
_STABLE_PRODUCT = 1.0
"""Largest |eigenvalue| * step; Kutta's method is stable up to 2.5."""


class PlantState(Struct, frozen=True, gc=False):
    """State of a model, made by its `DartPlant`.

    Attributes:
        positions: Joint coordinates, in m or rad, as DART orders them.
        velocities: Joint velocities, in m/s or rad/s.
        memory: Memory of all effects, strut after strut.
        t_s: Time, for effects that depend on it.
        struts: Height (m) and velocity (m/s; positive is rebound) of every strut: what the
            coordinates mean to them.
    """

    positions: tuple[float, ...]
    velocities: tuple[float, ...]
    memory: tuple[float, ...]
    t_s: float
    struts: Sequence[tuple[float, float]]


class Loaded(Struct, frozen=True, gc=False):
    """A state under the forces that act from it on.

    Attributes:
        state: The state.
        forces_n: Spring-damper force of each strut with its effects, without the virtual force.
        accelerations_m_per_s2: Second derivative of each strut's height under all forces.
        applied_force_n: Applied force at the state.
        temperature_c: Damper temperature.
        held: Forces that are held until the next state, the virtual ones among them; this and the
            next three are as the integrator wants them.
        position: Joint position.
        velocity: Joint velocity.
        acceleration: Joint acceleration.
        memory_rates: Derivative of the memory.
    """

    state: PlantState
    forces_n: list[float]
    accelerations_m_per_s2: list[float]
    applied_force_n: float
    temperature_c: float
    held: "_Value"
    position: "_Value"
    velocity: "_Value"
    acceleration: "_Value"
    memory_rates: list[float]


class Driven(NamedTuple):
    """A strut whose motion is imposed.

    Attributes:
        force_n: Spring-damper force with effects: what the load cell would show.
        drive_n: Force that the drive adds to it, by inverse dynamics: weight and inertia, less the
            strut's own force.
        memory_rates: Derivative of the memory.
    """

    force_n: float
    drive_n: float
    memory_rates: list[float]


class Mechanics(NamedTuple):
    """Equations of motion in one configuration, as DART has them.

    ``mass @ acceleration = bias + rows.T @ strut_forces + applied * applied_force``.

    Attributes:
        heights_m: Strut heights, shape (struts,).
        rows: Jacobian of the struts, shape (struts, n).
        applied: Generalised force per newton of applied force, shape (n,).
        mass: Mass matrix, shape (n, n).
        bias: Generalised force of all else: weight, Coriolis and centrifugal forces, springs and
            dampers of the joints' own, shape (n,).
    """

    heights_m: NDArray[np.float64]
    rows: NDArray[np.float64]
    applied: NDArray[np.float64]
    mass: NDArray[np.float64]
    bias: NDArray[np.float64]


_Value = Any
"""Joint coordinates: a float where there is one, else an array. The integrator's formulas hold for
both, and a bench with one guided body, the usual one, is spared the cost of arrays."""

_Surroundings = tuple[float, float, float]
"""Time (s), applied force (N), temperature (°C)."""

_Acceleration = Callable[
    [_Value, _Value, _Value, float, Sequence[float], float, float, list[float]], _Value
]
"""Position, velocity, held forces, applied force, memory, time, temperature -> acceleration; writes
memory rates."""


_Put = Callable[[float], None]


class _Strut:
    """A strut ready to be evaluated: constants and laws in the form that is read fastest."""

    __slots__ = ("constants", "damping", "free_length", "laws", "memory_size", "name", "stiffness")

    def __init__(self, spec: StrutSpec, first_memory: int, gravity_m_per_s2: float) -> None:
        self.name = spec.name
        self.free_length = spec.free_length_m
        self.stiffness = spec.stiffness_n_per_m
        self.damping = spec.damping_n_s_per_m
        self.constants = (self.free_length, self.stiffness, self.damping, gravity_m_per_s2)
        laws: list[tuple[Effect, list[float], int, int]] = []
        start = first_memory
        for item in spec.effects:
            law = effect(item.name)
            laws.append((law, item.values(), start, start + law.state_size))
            start += law.state_size
        self.laws = tuple(laws)
        self.memory_size = start - first_memory

    def force_n(
        self,
        height_m: float,
        velocity_m_per_s: float,
        memory: Sequence[float],
        surroundings: _Surroundings,
        memory_rates: list[float],
    ) -> float:
        """Force of spring, damper and effects; arguments as of `effects_n`."""
        force = self.plain_n(height_m, velocity_m_per_s)
        if self.laws:
            force += self.effects_n(height_m, velocity_m_per_s, memory, surroundings, memory_rates)
        return force

    def plain_n(self, height_m: float, velocity_m_per_s: float) -> float:
        """Force of spring and damper."""
        return self.stiffness * (self.free_length - height_m) - self.damping * velocity_m_per_s

    def effects_n(
        self,
        height_m: float,
        velocity_m_per_s: float,
        memory: Sequence[float],
        surroundings: _Surroundings,
        memory_rates: list[float],
    ) -> float:
        """Force of all effects; writes the derivative of their memory.

        Args:
            height_m: Height.
            velocity_m_per_s: Velocity.
            memory: Memory of the whole model.
            surroundings: Time (s), applied force (N), temperature (°C).
            memory_rates: Derivative of the memory of the whole model, written in this strut's part.
        """
        t_s, applied_n, temperature_c = surroundings
        constants = self.constants
        force = 0.0
        for law, parameters, start, stop in self.laws:
            own = memory[start:stop]
            force += law.force(
                t_s,
                height_m,
                velocity_m_per_s,
                applied_n,
                temperature_c,
                own,
                parameters,
                constants,
            )
            if law.rate is not None:
                out = [0.0] * (stop - start)
                law.rate(
                    t_s,
                    height_m,
                    velocity_m_per_s,
                    applied_n,
                    temperature_c,
                    own,
                    parameters,
                    constants,
                    out,
                )
                memory_rates[start:stop] = out
        return force


class _Joints(Protocol):
    """What the integrator asks of coordinates; `_Value` is the same type in all of it."""

    @property
    def adds_up(self) -> bool:
        """Whether ``q + h * v`` is where a velocity leads to."""
        ...

    @property
    def acceleration(self) -> _Acceleration:
        """DART's acceleration under given forces."""
        ...

    def value(self, numbers: Sequence[float]) -> _Value:
        """One number a coordinate, as the integrator has them."""
        ...

    def state(self, q: _Value, v: _Value, memory: tuple[float, ...], t_s: float) -> PlantState:
        """State of position and velocity."""
        ...

    def moved(self, q: _Value, v: _Value, h: float) -> _Value:
        """Where a velocity leads to in `h` seconds."""
        ...

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Loaded:
        """Let forces act on a state."""
        ...


class _Coordinate:
    """The only coordinate of a guided model, as a float."""

    adds_up = True

    def __init__(self, skeleton: Any, struts: Sequence[_Strut], rows: "Rows") -> None:
        numbered = zip(range(len(struts)), struts, rows.offsets_m, rows.struts[:, 0], strict=True)
        self._struts = [
            (index, strut, float(offset), float(row)) for index, strut, offset, row in numbered
        ]
        self._applied_row = float(rows.applied[0])
        # What the springs push where the coordinate is zero.
        self._preload = sum(row * strut.plain_n(x, 0.0) for _, strut, x, row in self._struts)
        self._without_effects = self._plain_acceleration(skeleton)
        with_effects = any(strut.laws for strut in struts)
        self.acceleration: _Acceleration = (
            self._acceleration_with_effects if with_effects else self._without_effects
        )

    def value(self, numbers: Sequence[float]) -> float:
        return numbers[0]

    def state(self, q: float, v: float, memory: tuple[float, ...], t_s: float) -> PlantState:
        struts: list[tuple[float, float]] = []
        for _, _, offset, row in self._struts:
            struts.append((offset + row * q, row * v))
        return PlantState((q,), (v,), memory, t_s, struts)

    def moved(self, q: float, v: float, h: float) -> float:
        return q + h * v

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Loaded:
        q, v, memory, t_s = state.positions[0], state.velocities[0], state.memory, state.t_s
        rates = [0.0] * len(memory) if memory else []
        forces: list[float] = []
        held, of_effects = self._preload, 0.0
        for index, strut, _, row in self._struts:
            height, velocity = state.struts[index]
            force = strut.plain_n(height, velocity)
            if strut.laws:
                surroundings = (t_s, applied_force_n, temperature_c)
                effects = strut.effects_n(height, velocity, memory, surroundings, rates)
                of_effects += row * effects
                force += effects
            forces.append(force)
            held += row * virtual_forces_n[index]
        acceleration = self._without_effects(
            q, v, held + of_effects, applied_force_n, memory, t_s, temperature_c, rates
        )
        accelerations: list[float] = []
        for _, _, _, row in self._struts:
            accelerations.append(row * acceleration)
        return Loaded(
            state,
            forces,
            accelerations,
            applied_force_n,
            temperature_c,
            held,
            q,
            v,
            acceleration,
            rates,
        )

    def _acceleration_with_effects(
        self,
        q: float,
        v: float,
        held: float,
        applied_n: float,
        memory: Sequence[float],
        t_s: float,
        temperature_c: float,
        memory_rates: list[float],
    ) -> float:
        surroundings = (t_s, applied_n, temperature_c)
        for _, strut, offset, row in self._struts:
            if strut.laws:
                held += row * strut.effects_n(
                    offset + row * q, row * v, memory, surroundings, memory_rates
                )
        return self._without_effects(
            q, v, held, applied_n, memory, t_s, temperature_c, memory_rates
        )

    def _plain_acceleration(self, skeleton: Any) -> "_Acceleration":
        """DART's acceleration under springs, dampers, what is held, and the applied force.

        What is held has to include the springs' preload.
        """
        # Closures over locals, as they are called three times a tick. The springs and dampers of
        # all struts are summed up once.
        stiffness = damping = 0.0
        for _, strut, _, row in self._struts:
            stiffness += row * strut.stiffness * row
            damping += row * strut.damping * row
        applied_row = self._applied_row
        dof = skeleton.getDof(0)
        put_position: _Put = dof.setPosition
        put_velocity: _Put = dof.setVelocity
        put_force: _Put = dof.setForce
        get_acceleration: Callable[[], float] = dof.getAcceleration
        solve: Callable[[], None] = skeleton.computeForwardDynamics

        def by_force(
            q: float,
            v: float,
            held: float,
            applied_n: float,
            _memory: Sequence[float],
            _t_s: float,
            _temperature_c: float,
            _memory_rates: list[float],
        ) -> float:
            put_force(held - stiffness * q - damping * v + applied_row * applied_n)
            solve()
            return get_acceleration()

        def by_state_and_force(
            q: float,
            v: float,
            held: float,
            applied_n: float,
            memory: Sequence[float],
            t_s: float,
            temperature_c: float,
            memory_rates: list[float],
        ) -> float:
            put_position(q)
            put_velocity(v)
            return by_force(q, v, held, applied_n, memory, t_s, temperature_c, memory_rates)

        return by_force if _only_force_matters(skeleton) else by_state_and_force


_SAMPLE_FORCES = (0.0, 1e-3, -0.7, 37.3, -4100.0)
"""In N; a difference in the last bit may hide beside a large force."""


def _only_force_matters(skeleton: Any) -> bool:
    """Whether position and velocity make no difference to DART's answer, not even in the last bit.

    So it is for a body on a straight guide without springs or damping of DART's own. Telling DART
    where the body is would make it compute all anew, which takes as long as the answer itself.
    """
    dof = skeleton.getDof(0)

    def answer(force_n: float, k: int) -> float:
        dof.setPosition(0.3 * math.sin(1.7 * k))
        dof.setVelocity(2.0 * math.cos(2.3 * k))
        dof.setForce(force_n)
        skeleton.computeForwardDynamics()
        return float(dof.getAcceleration())

    return all(len({answer(force_n, k) for k in range(16)}) == 1 for force_n in _SAMPLE_FORCES)


class _Coordinates:
    """All coordinates of a model, as arrays."""

    def __init__(
        self,
        skeleton: Any,
        struts: Sequence[_Strut],
        rows_at: "Callable[[NDArray[np.float64]], Rows]",
        constant: "Rows | None",
    ) -> None:
        self._skeleton = skeleton
        self._struts = struts
        self.strut_rows = rows_at
        self._constant = None if constant is None else _as_lists(constant)
        dofs = [skeleton.getDof(index) for index in range(int(skeleton.getNumDofs()))]
        self._put: list[tuple[_Put, _Put, _Put]] = [
            (dof.setPosition, dof.setVelocity, dof.setForce) for dof in dofs
        ]
        self._get: list[Callable[[], float]] = [dof.getAcceleration for dof in dofs]
        self._solve: Callable[[], None] = skeleton.computeForwardDynamics
        self.adds_up = _coordinates_add_up(skeleton)

    def value(self, numbers: Sequence[float]) -> NDArray[np.float64]:
        return np.array(numbers)

    def state(
        self,
        q: NDArray[np.float64],
        v: NDArray[np.float64],
        memory: tuple[float, ...],
        t_s: float,
    ) -> PlantState:
        positions, velocities = tuple(q.tolist()), tuple(v.tolist())
        struts = _kinematics(self._rows(q), positions, velocities)
        return PlantState(positions, velocities, memory, t_s, struts)

    def moved(
        self, q: NDArray[np.float64], v: NDArray[np.float64], h: float
    ) -> NDArray[np.float64]:
        self._skeleton.setPositions(q)
        self._skeleton.setVelocities(v)
        self._skeleton.integratePositions(h)
        return np.array(self._skeleton.getPositions())

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Loaded:
        position, velocity, memory = list(state.positions), list(state.velocities), state.memory
        surroundings = (state.t_s, applied_force_n, temperature_c)
        rates = [0.0] * len(memory)
        q, v = np.array(position), np.array(velocity)
        rows = self._rows(q)
        forces = self._forces_n(state.struts, memory, surroundings, rates)
        push = _push(rows, forces, virtual_forces_n, applied_force_n)
        acceleration = self._respond(position, velocity, push)
        turning = [0.0] * len(forces) if self._constant else (self._turning(q, v) @ v).tolist()
        accelerations = [
            _dot(row, acceleration) + turned
            for row, turned in zip(rows.struts, turning, strict=True)
        ]
        answer = np.array(acceleration)
        return Loaded(
            state,
            forces,
            accelerations,
            applied_force_n,
            temperature_c,
            virtual_forces_n,
            q,
            v,
            answer,
            rates,
        )

    def acceleration(
        self,
        q: NDArray[np.float64],
        v: NDArray[np.float64],
        held: Sequence[float],
        applied_n: float,
        memory: Sequence[float],
        t_s: float,
        temperature_c: float,
        memory_rates: list[float],
    ) -> NDArray[np.float64]:
        rows, position, velocity = self._rows(q), q.tolist(), v.tolist()
        kinematics = _kinematics(rows, position, velocity)
        surroundings = (t_s, applied_n, temperature_c)
        forces = self._forces_n(kinematics, memory, surroundings, memory_rates)
        push = _push(rows, forces, held, applied_n)
        return np.array(self._respond(position, velocity, push))

    def _rows(self, q: NDArray[np.float64]) -> "_Lists":
        return self._constant or _as_lists(self.strut_rows(q))

    def _forces_n(
        self,
        kinematics: Sequence[tuple[float, float]],
        memory: Sequence[float],
        surroundings: _Surroundings,
        memory_rates: list[float],
    ) -> list[float]:
        """Force of every strut, without the virtual one."""
        forces: list[float] = []
        for strut, (height, velocity) in zip(self._struts, kinematics, strict=True):
            forces.append(strut.force_n(height, velocity, memory, surroundings, memory_rates))
        return forces

    def _respond(self, q: list[float], v: list[float], push: list[float]) -> list[float]:
        """DART's acceleration; position, velocity and force number by number.

        DART's functions for arrays cost as much as six or more of those for one number.
        """
        for index, (put_position, put_velocity, put_force) in enumerate(self._put):
            put_position(q[index])
            put_velocity(v[index])
            put_force(push[index])
        self._solve()
        return [get() for get in self._get]

    def _turning(self, q: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Time derivative of the struts' rows."""
        h = 1e-6
        ahead, behind = self.strut_rows(self.moved(q, v, h)), self.strut_rows(self.moved(q, v, -h))
        return (ahead.struts - behind.struts) / (2.0 * h)


class DartPlant:
    """A model in DART.

    The skeleton inside is scratch paper: every call first writes all of the state that its answer
    depends on, so that results depend on the arguments alone. One plant must not be used from two
    threads at once.

    Args:
        spec: The model.

    Raises:
        InputError: A skeleton file is wrong, or a body that a strut names is not in it.
    """

    def __init__(self, spec: ModelSpec) -> None:
        self.spec = spec
        self._skeleton, self._bodies = _build(spec)
        self._skeleton.setGravity([0.0, 0.0, -spec.gravity_m_per_s2])
        self._skeleton.setTimeStep(_INSTANT_S)
        _add_masses(spec, self._bodies)
        self.coordinates = int(self._skeleton.getNumDofs())
        self._struts = _struts(spec)
        self.memory_size = sum(strut.memory_size for strut in self._struts)
        self._directions = _guides(spec, self._skeleton, self._bodies)
        rows = self._constant_rows()
        self._rows = rows
        self._joints: _Joints = (
            _Coordinate(self._skeleton, self._struts, rows)
            if rows is not None and self.coordinates == 1
            else _Coordinates(self._skeleton, self._struts, self.strut_rows, rows)
        )
        lightest_kg = min(float(body.getMass()) for body in self._bodies.values())
        self.step_s = _stable_step_s(self._struts, lightest_kg)
        self._longest_s = self.step_s * (1.0 + 1e-9)
        self._acceleration: _Acceleration = self._joints.acceleration
        # Rotations in space do not add up; DART composes them.
        self._moved: Callable[[_Value, _Value, float], _Value] | None = (
            None if self._joints.adds_up else self._joints.moved
        )

    def initial(
        self, heights_m: Sequence[float], velocities_m_per_s: Sequence[float] | None = None
    ) -> PlantState:
        """State with the given strut heights and velocities, found by Newton's method.

        Args:
            heights_m: One height a strut.
            velocities_m_per_s: One velocity a strut; at rest if absent.

        Raises:
            InputError: The joints cannot reach the heights.
        """
        target = np.asarray(heights_m, dtype=np.float64)
        q = np.zeros(self.coordinates)
        for _ in range(50):
            rows = self.strut_rows(q)
            error = target - rows.offsets_m - rows.struts @ q
            if float(np.max(np.abs(error))) < 1e-13:
                break
            q = q + np.linalg.lstsq(rows.struts, error, rcond=None)[0]
        rows = self.strut_rows(q)
        if not np.allclose(rows.offsets_m + rows.struts @ q, target, rtol=0.0, atol=1e-9):
            raise InputError(
                f"model {self.spec.name}: heights {target.tolist()} m: out of the joints' reach"
            )
        v = np.zeros(self.coordinates)
        if velocities_m_per_s is not None:
            v = np.linalg.lstsq(rows.struts, np.asarray(velocities_m_per_s), rcond=None)[0]
        return self.state(q.tolist(), v.tolist(), (0.0,) * self.memory_size, 0.0)

    def state(
        self,
        positions: Sequence[float],
        velocities: Sequence[float],
        memory: tuple[float, ...],
        t_s: float,
    ) -> PlantState:
        """State with the given coordinates; arguments as of `PlantState`."""
        value = self._joints.value
        return self._joints.state(value(positions), value(velocities), memory, t_s)

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Loaded:
        """Let forces act on a state.

        Args:
            state: The state.
            virtual_forces_n: Virtual force in each strut.
            applied_force_n: Applied force.
            temperature_c: Damper temperature.
        """
        return self._joints.load(state, virtual_forces_n, applied_force_n, temperature_c)

    def step(self, loaded: Loaded, dt_s: float, applied_force_end_n: float) -> PlantState:
        """Advance the model.

        Args:
            loaded: State at the beginning and the forces on it; virtual forces are held.
            dt_s: Length of the step; divided into sub-steps of at most `step_s`.
            applied_force_end_n: Applied force at the end; it is linear in between.

        Returns:
            State at the end.
        """
        count, h = 1, dt_s
        if dt_s > self._longest_s:
            count = min(math.ceil(dt_s / self._longest_s), _MAX_SUBSTEPS)
            h = dt_s / count
        half, sixth = 0.5 * h, h / 6.0
        moved, acceleration = self._moved, self._acceleration
        start, held, temperature_c = loaded.state, loaded.held, loaded.temperature_c
        memory, t_s, applied = start.memory, start.t_s, loaded.applied_force_n
        rise = (applied_force_end_n - applied) / count
        q, v, a1, s1 = loaded.position, loaded.velocity, loaded.acceleration, loaded.memory_rates
        while True:
            # Kutta's third-order method, in which the stages' velocities drive the positions.
            m2, s2, m3, s3 = memory, s1, memory, s1
            if memory:
                s2, s3 = [0.0] * len(memory), [0.0] * len(memory)
                m2 = _advanced(memory, half, s1)
            q2 = moved(q, v, half) if moved else q + half * v
            a2 = acceleration(
                q2, v + half * a1, held, applied + 0.5 * rise, m2, t_s + half, temperature_c, s2
            )
            if memory:
                m3 = _advanced(_advanced(memory, 2.0 * h, s2), -h, s1)
            ahead = v + h * a1
            q3 = moved(q, ahead, h) if moved else q + h * ahead
            t_s += h
            applied += rise
            v3 = v + h * (2.0 * a2 - a1)
            a3 = acceleration(q3, v3, held, applied, m3, t_s, temperature_c, s3)
            mean = v + sixth * (a1 + 2.0 * a2)
            q = moved(q, mean, h) if moved else q + h * mean
            v = v + sixth * (a1 + 4.0 * a2 + a3)
            if memory:
                memory = _summed(memory, sixth, s1, s2, s3)
            count -= 1
            if count == 0:
                return self._joints.state(q, v, memory, t_s)
            s1 = [0.0] * self.memory_size
            a1 = acceleration(q, v, held, applied, memory, t_s, temperature_c, s1)

    @property
    def is_constant(self) -> bool:
        """Whether mass matrix and Jacobians are the same in every configuration."""
        if self._rows is None:
            return False
        first, *others = [
            self.mechanics(q, np.zeros_like(q)).mass for q in _sample_positions(self.coordinates)
        ]
        return all(np.allclose(first, other, rtol=1e-9, atol=0.0) for other in others)

    def mechanics(self, q: NDArray[np.float64], v: NDArray[np.float64]) -> Mechanics:
        """Equations of motion at coordinates `q` with velocities `v`, each of shape (n,)."""
        rows = self.strut_rows(q)
        skeleton = self._skeleton
        skeleton.setPositions(q)
        skeleton.setVelocities(v)
        skeleton.setForces(np.zeros(self.coordinates))
        skeleton.computeForwardDynamics()
        mass = np.array(skeleton.getMassMatrix(), dtype=np.float64)
        bias = mass @ np.array(skeleton.getAccelerations(), dtype=np.float64)
        return Mechanics(rows.offsets_m + rows.struts @ q, rows.struts, rows.applied, mass, bias)

    def driven(
        self,
        height_m: float,
        velocity_m_per_s: float,
        acceleration_m_per_s2: float,
        memory: tuple[float, ...],
        t_s: float,
        temperature_c: float,
    ) -> "Driven":
        """The model's only strut moved as on a dyno, whatever forces that takes.

        Args:
            height_m: Imposed height.
            velocity_m_per_s: Its rate.
            acceleration_m_per_s2: Its second derivative.
            memory: Memory of the effects.
            t_s: Time, for effects that depend on it.
            temperature_c: Damper temperature.

        Raises:
            InputError: The model has more than one strut or coordinate.
        """
        rows = self._rows
        if rows is None or rows.struts.shape != (1, 1):
            raise InputError(
                f"model {self.spec.name}: {len(self._struts)} struts, {self.coordinates} "
                "coordinates: expected one of each, on a straight guide, for an imposed motion"
            )
        row = float(rows.struts[0, 0])
        rates = [0.0] * len(memory)
        surroundings = (t_s, 0.0, temperature_c)
        force = self._struts[0].force_n(height_m, velocity_m_per_s, memory, surroundings, rates)
        dof = self._skeleton.getDof(0)
        dof.setPosition((height_m - float(rows.offsets_m[0])) / row)
        dof.setVelocity(velocity_m_per_s / row)
        dof.setAcceleration(acceleration_m_per_s2 / row)
        self._skeleton.computeInverseDynamics()
        return Driven(force, float(dof.getForce()) / row - force, rates)

    def _constant_rows(self) -> "Rows | None":
        """The struts' rows if they are the same in every configuration, else None."""
        first, *others = [self.strut_rows(q) for q in _sample_positions(self.coordinates)]
        same = all(
            np.allclose(a, b, rtol=1e-9, atol=1e-12)
            for other in others
            for a, b in zip(first, other, strict=True)
        )
        return first if same else None

    def strut_rows(self, q: NDArray[np.float64]) -> "Rows":
        """Struts linearised at `q`: ``height = offset + row @ q`` holds exactly at `q`."""
        self._skeleton.setPositions(q)
        heights = np.empty(len(self._directions))
        rows = np.empty((len(self._directions), self.coordinates))
        for index, (strut, guide) in enumerate(
            zip(self.spec.struts, self._directions, strict=True)
        ):
            gap, jacobian = _gap(strut, self._skeleton, self._bodies)
            direction = gap / max(float(np.linalg.norm(gap)), 1e-12) if guide is None else guide
            heights[index] = direction @ gap
            rows[index] = direction @ jacobian
        body = self._bodies[_applied_force_body(self.spec, self._bodies)]
        applied = np.array(self._skeleton.getLinearJacobian(body), dtype=np.float64)[2]
        return Rows(heights - rows @ q, rows, applied)


class Rows(NamedTuple):
    """Struts linearised in a configuration.

    Attributes:
        offsets_m: Heights less `struts @ coordinates`, shape (struts,).
        struts: Derivative of the heights by the coordinates, shape (struts, n).
        applied: Generalised force per newton of applied force, shape (n,).
    """

    offsets_m: NDArray[np.float64]
    struts: NDArray[np.float64]
    applied: NDArray[np.float64]


class _Lists(NamedTuple):
    """`Rows` in the form that is read fastest, with the transpose of `struts`."""

    offsets_m: list[float]
    struts: list[list[float]]
    columns: list[list[float]]
    applied: list[float]


def _as_lists(rows: Rows) -> _Lists:
    struts = rows.struts
    return _Lists(
        rows.offsets_m.tolist(), struts.tolist(), struts.T.tolist(), rows.applied.tolist()
    )


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(map(mul, a, b))


def _kinematics(
    rows: _Lists, position: Sequence[float], velocity: Sequence[float]
) -> list[tuple[float, float]]:
    """Height and velocity of every strut."""
    return [
        (offset + _dot(row, position), _dot(row, velocity))
        for offset, row in zip(rows.offsets_m, rows.struts, strict=True)
    ]


def _push(
    rows: _Lists, forces_n: list[float], virtual_forces_n: Sequence[float], applied_n: float
) -> list[float]:
    """Force on every coordinate."""
    total = list(map(add, forces_n, virtual_forces_n))
    return [
        _dot(column, total) + share * applied_n
        for column, share in zip(rows.columns, rows.applied, strict=True)
    ]


def _advanced(memory: tuple[float, ...], h: float, rates: list[float]) -> tuple[float, ...]:
    return tuple([m + h * rate for m, rate in zip(memory, rates, strict=True)])


def _summed(
    memory: tuple[float, ...], sixth: float, s1: list[float], s2: list[float], s3: list[float]
) -> tuple[float, ...]:
    """Memory at the end of a step."""
    stages = zip(memory, s1, s2, s3, strict=True)
    return tuple([m + sixth * (a + 4.0 * b + c) for m, a, b, c in stages])


def _struts(spec: ModelSpec) -> tuple[_Strut, ...]:
    struts: list[_Strut] = []
    first_memory = 0
    for item in spec.struts:
        strut = _Strut(item, first_memory, spec.gravity_m_per_s2)
        first_memory += strut.memory_size
        struts.append(strut)
    return tuple(struts)


def _gap(
    spec: StrutSpec, skeleton: Any, bodies: dict[str, Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vector from a strut's lower to its upper end, shape (3,), and its Jacobian, shape (3, n)."""
    ends: list[NDArray[np.float64]] = []
    jacobians: list[NDArray[np.float64]] = []
    for name, attachment in zip(spec.between, spec.attachments_m, strict=True):
        local = np.array(attachment)
        if name == WORLD:
            ends.append(local)
            jacobians.append(np.zeros((3, skeleton.getNumDofs())))
        else:
            transform = np.array(bodies[name].getWorldTransform().matrix())
            ends.append(transform[:3, :3] @ local + transform[:3, 3])
            jacobians.append(np.array(skeleton.getLinearJacobian(bodies[name], local)))
    return ends[1] - ends[0], jacobians[1] - jacobians[0]


def _sample_positions(coordinates: int) -> list[NDArray[np.float64]]:
    """Fixed generic configurations at which it is tested what is constant."""
    return [0.3 * np.sin(1.0 + (k + 0.7) * np.arange(1, coordinates + 1)) for k in range(4)]


def _guides(
    spec: ModelSpec, skeleton: Any, bodies: dict[str, Any]
) -> tuple[NDArray[np.float64] | None, ...]:
    """Direction of each strut whose ends move along one straight line, else None.

    The height of a guided strut is measured upwards along its guide and has a sign, so that a bench
    may be given about its rest position; the height of any other strut is the distance of its ends.
    """
    guides: list[NDArray[np.float64] | None] = []
    for strut in spec.struts:
        columns: list[NDArray[np.float64]] = []
        for q in _sample_positions(int(skeleton.getNumDofs())):
            skeleton.setPositions(q)
            columns.append(_gap(strut, skeleton, bodies)[1])
        left, singular, _ = np.linalg.svd(np.hstack(columns))
        if singular[0] < 1e-9:
            raise InputError(
                f"model {spec.name}: strut {strut.name}: no joint lets {strut.between[0]} and "
                f"{strut.between[1]} move, expected one that does"
            )
        if len(singular) > 1 and singular[1] > 1e-9 * singular[0]:
            guides.append(None)
            continue
        direction = cast(
            "NDArray[np.float64]", np.round(left[:, 0], 14)
        )  # exact for guides along an axis
        largest = direction[2] if direction[2] != 0.0 else direction[np.argmax(np.abs(direction))]
        guides.append(direction * math.copysign(1.0, largest))
    return tuple(guides)


def _coordinates_add_up(skeleton: Any) -> bool:
    """Whether joint coordinates add up, as they do for everything but rotations in space."""
    for q in _sample_positions(int(skeleton.getNumDofs())):
        v = np.roll(q, 1) + 1.0
        skeleton.setPositions(q)
        skeleton.setVelocities(v)
        skeleton.integratePositions(0.5)
        if not np.allclose(np.array(skeleton.getPositions()), q + 0.5 * v, rtol=0.0, atol=1e-12):
            return False
    return True


def _applied_force_body(spec: ModelSpec, bodies: dict[str, Any]) -> str:
    name = spec.applied_force_body or spec.struts[-1].between[1]
    if name == WORLD:
        name = spec.struts[-1].between[0]
    if name not in bodies:
        raise InputError(
            f"model {spec.name}: applied_force_body {name!r}: expected one of {', '.join(bodies)}"
        )
    return name


def _add_masses(spec: ModelSpec, bodies: dict[str, Any]) -> None:
    """Give DART the masses that effects add, so that it carries their weight and inertia."""
    for strut in spec.struts:
        for item in strut.effects:
            if not effect(item.name).adds_mass:
                continue
            end = strut.between[1] if strut.between[1] != WORLD else strut.between[0]
            mass = float(bodies[end].getMass()) + item.values()[0]
            if mass <= 0.0:
                raise InputError(
                    f"model {spec.name}: strut {strut.name}: effect {item.name} leaves {end} "
                    f"a mass of {mass} kg, expected more than zero"
                )
            bodies[end].setMass(mass)


def _stable_step_s(struts: Sequence[_Strut], lightest_kg: float) -> float:
    """Longest sub-step with which the stiffest strut is still integrated stably.

    Raises:
        InputError: The parameters of an effect give its law no value.
    """
    size = sum(strut.memory_size for strut in struts)
    fastest = 0.0
    for strut in struts:
        if strut.laws:
            stiffness, damping = _steepest(strut, [0.0] * size)
            fastest = max(fastest, damping / lightest_kg, math.sqrt(stiffness / lightest_kg))
    return min(DEFAULT_STEP_S, max(_STABLE_PRODUCT / max(fastest, 1e-9), 1e-6))


def _steepest(strut: _Strut, memory: list[float]) -> tuple[float, float]:
    """Largest stiffness (N/m) and damping (N·s/m), sampled where a bench can get to."""
    heights = np.linspace(-0.5, 0.5, 501)
    speeds = np.concatenate([-np.logspace(-6, 0.5, 60)[::-1], np.logspace(-6, 0.5, 60)])
    rest, surroundings, unused = strut.free_length, (0.0, 0.0, 20.0), memory.copy()
    try:
        by_height = [
            strut.effects_n(rest + x, 0.0, memory, surroundings, unused) for x in heights.tolist()
        ]
        by_speed = [strut.effects_n(rest, v, memory, surroundings, unused) for v in speeds.tolist()]
    except (ArithmeticError, ValueError) as error:
        names = ", ".join(law.name for law, *_ in strut.laws)
        raise InputError(
            f"strut {strut.name}: effects {names}: no force with these parameters ({error})"
        ) from error
    stiffness = strut.stiffness + float(np.max(np.abs(np.diff(by_height) / np.diff(heights))))
    damping = strut.damping + float(np.max(np.abs(np.diff(by_speed) / np.diff(speeds))))
    return stiffness, damping


def _build(spec: ModelSpec) -> tuple[Any, dict[str, Any]]:
    """DART skeleton of the model and its bodies by name."""
    if isinstance(spec.skeleton, FileSkeleton):
        skeleton = _read_skeleton(spec.skeleton, spec.folder)
    else:
        skeleton = _inline_skeleton(spec.name, spec.skeleton)
    bodies = {str(body.getName()): body for body in skeleton.getBodyNodes()}
    for strut in spec.struts:
        for end in strut.between:
            if end != WORLD and end not in bodies:
                raise InputError(
                    f"model {spec.name}: strut {strut.name}: between {end!r}: expected one of "
                    f"{', '.join([WORLD, *bodies])}"
                )
    if int(skeleton.getNumDofs()) == 0:
        raise InputError(f"model {spec.name}: skeleton has no joint that moves, expected one")
    return skeleton, bodies


def _inline_skeleton(name: str, spec: InlineSkeleton) -> Any:
    skeleton = _dart.dynamics.Skeleton(name)
    bodies: dict[str, Any] = {}
    for body in spec.bodies:
        create, properties = _joint(body, skeleton)
        _, node = create(bodies.get(body.joint.parent), properties)
        node.setName(body.name)
        moments = body.inertia_kg_m2 or (body.mass_kg,) * 3
        inertia = _dart.dynamics.Inertia(body.mass_kg, np.zeros(3), np.diag(moments))
        node.setInertia(inertia)
        bodies[body.name] = node
    return skeleton


def _joint(body: BodySpec, skeleton: Any) -> tuple[Callable[..., Any], Any]:
    kinds = {
        "prismatic": (_dart.dynamics.PrismaticJointProperties, "Prismatic"),
        "revolute": (_dart.dynamics.RevoluteJointProperties, "Revolute"),
        "free": (_dart.dynamics.FreeJointProperties, "Free"),
        "ball": (_dart.dynamics.BallJointProperties, "Ball"),
    }
    make, kind = kinds[body.joint.type]
    properties = make()
    properties.mName = f"{body.name}_joint"
    if body.joint.type in ("prismatic", "revolute"):
        axis = np.array(body.joint.axis)
        properties.mAxis = axis / np.linalg.norm(axis)
    offset = _dart.math.Isometry3()
    offset.set_translation(np.array(body.joint.offset_m))
    properties.mT_ParentBodyToJoint = offset
    return getattr(skeleton, f"create{kind}JointAndBodyNodePair"), properties


def _read_skeleton(spec: FileSkeleton, folder: Path) -> Any:
    path = (folder / spec.file).resolve()
    if not path.is_file():
        raise InputError(f"{path}: skeleton.file: no such file, expected URDF, SDF, SKEL or MJCF")
    suffix = path.suffix.lower()
    if suffix not in _PARSERS:
        raise InputError(f"{path}: suffix {suffix!r}: expected {', '.join(_PARSERS)}")
    try:
        skeleton = _PARSERS[suffix](str(path))
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: DART cannot read it: {reason}") from error
    if skeleton is None:
        raise InputError(f"{path}: DART finds no skeleton in it, expected a valid {suffix} file")
    if suffix in _MJCF:
        _refuse_bodies_without_shape(skeleton, path)
    return skeleton


def _read_urdf(uri: str) -> Any:
    loader = _dart.utils.DartLoader()
    options = loader.getOptions()
    # A bench stands on the ground; DART would let the root link fly.
    options.mDefaultRootJointType = _dart.utils.DartLoaderRootJointType.FIXED
    loader.setOptions(options)
    return loader.parseSkeleton(uri)


def _read_sdf(uri: str) -> Any:
    return _dart.utils.SdfParser.readSkeleton(uri)


def _read_skel(uri: str) -> Any:
    return _first_skeleton(_dart.utils.SkelParser.readWorld(uri))


def _read_mjcf(uri: str) -> Any:
    return _first_skeleton(_dart.utils.MjcfParser.readWorld(uri))


def _first_skeleton(world: Any) -> Any:
    return world.getSkeleton(0) if world is not None and world.getNumSkeletons() > 0 else None


_MJCF = (".xml", ".mjcf")
_PARSERS: dict[str, Callable[[str], Any]] = {
    ".urdf": _read_urdf,
    ".sdf": _read_sdf,
    ".skel": _read_skel,
    **dict.fromkeys(_MJCF, _read_mjcf),
}
"""DART's parser for each suffix."""


def _refuse_bodies_without_shape(skeleton: Any, path: Path) -> None:
    """DART's MJCF parser gives a body without a geom 1 kg, whatever its inertial says."""
    for body in skeleton.getBodyNodes():
        if int(body.getNumShapeNodes()) == 0:
            raise InputError(
                f"{path}: body {body.getName()}: no geom, expected one: DART reads no mass without"
            )
