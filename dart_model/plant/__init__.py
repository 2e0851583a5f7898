"""DART as a black box: state in, forces in, state out.

    skeleton      bodies and joints in DART
    inputs        what drives the model: forces, torques, moved bodies
    motion_between  the motion of a moved body between two times
    loops         joints that close chains of bodies
    coordinates   how the joints' coordinates change
    geometry      heights and Jacobians of the struts
    strut         spring, damper and effects as one force
    fmu           a force that a functional mock-up unit computes
    admitted_programs    FMUs that may run on this machine
    backend       the acceleration, by DART
    integrator    Kutta's method, and how long its steps may be
    equations_of_motion  struts on joints
    state         arguments and results
    virtual_sensors      variables of a model that nothing measures
    prescribed_strut     a strut whose motion is given, as on a dyno

Reference: Featherstone, "Rigid Body Dynamics Algorithms" (2008).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space  # pyright: ignore[reportUnknownVariableType]

from dart_model.effects import AMBIENT_C
from dart_model.errors import ModelError
from dart_model.plant.backend import LoopedCoordinates, ManyCoordinates, OneCoordinate
from dart_model.plant.coordinates import sample_positions
from dart_model.plant.equations_of_motion import EquationsOfMotion
from dart_model.plant.fmu import MockUp
from dart_model.plant.geometry import Array, Geometry, Jacobians
from dart_model.plant.integrator import (
    LONGEST_STEP_S,
    SHORTEST_STEP_S,
    Linearised,
    exact_step_s,
    stable_for,
    stable_step_s,
)
from dart_model.plant.loops import Loops
from dart_model.plant.prescribed_strut import PrescribedStrut
from dart_model.plant.skeleton import build
from dart_model.plant.state import Loaded, Mechanics, PlantState
from dart_model.plant.strut import struts_of
from dart_model.plant.virtual_sensors import VirtualSensors
from dart_model.spec import ModelSpec
from dart_model.virtual_sensors import VirtualSensor

__all__ = ["LONGEST_STEP_S", "DartPlant", "PlantState", "PrescribedStrut"]

_RESTING_STEPS, _RESTING_STEP, _RESTED, _LONGEST_MOVE, _SPRINGLESS = 50, 1e-6, 1e-9, 0.1, 1e-9
"""Newton's method for a bench at rest: steps, difference and end (m or rad), longest move, and the
share of the largest stiffness below which a direction counts as free."""
_FARTHEST = 1.0
"""Distance of a rest (m or rad) beyond which nothing holds the bench: no strut is as long."""
_REACH = 3.0
"""Times the present acceleration by which a strut may be accelerated until the next tick."""
_HALVINGS = 6
"""How often a configuration is brought nearer to zero to close its loops there."""
_DIFFERENCE = 1e-6
"""Step of the coordinates (m or rad, and per second) in central differences of the bias force: a
third of the digits of a double, where rounding and truncation are about equal."""


class DartPlant:
    """A model in DART.

    The skeleton inside holds no state: every call first writes all of the state that its result
    depends on, so that results depend on the arguments alone. One plant must not be used from two
    threads at once.

    Raises:
        ModelError: A skeleton file is wrong, a body that a strut names is not in it, no joint moves
            a strut, an effect has no value, or the bench is too stiff to be simulated.
    """

    def __init__(self, spec: ModelSpec) -> None:
        self.spec = spec
        self._skeleton = build(spec)
        self._geometry = Geometry(spec, self._skeleton)
        self._struts = struts_of(spec)
        self._equations: EquationsOfMotion[float] | EquationsOfMotion[Array]
        self.inputs = self._skeleton.inputs.size
        """Length of the input vector, as `dart_model.plant.inputs` defines it."""
        if self.coordinates == self.inputs == 1 and self._geometry.constant is not None:
            one = OneCoordinate(self._skeleton)
            self._equations = EquationsOfMotion[float](one, self._struts, self._geometry)
        else:
            loops = self._skeleton.loops
            if loops is None:
                many = ManyCoordinates(self._skeleton)
            else:
                many = LoopedCoordinates(self._skeleton, loops)
            self._equations = EquationsOfMotion[Array](many, self._struts, self._geometry)
        self._slopes_vary = self._geometry.constant is not None and not all(
            strut.is_linear for strut in self._struts
        )
        self._slope_tables = [strut.slope_tables() for strut in self._struts]
        self.step_s, self._smooth_step_s, self._mobility_per_kg = self._longest_steps()
        """Longest step of the integrator where the forces of the struts are steepest."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        return len(self._struts)

    @property
    def coordinates(self) -> int:
        """Number of joint coordinates."""
        return self._skeleton.coordinates

    @property
    def free(self) -> NDArray[np.intp]:
        """Indices of the coordinates that are free to move.

        They are all that are not given, and that do not follow from others because of a loop.
        """
        return self._skeleton.free

    @property
    def free_coordinates(self) -> int:
        """Number of coordinates that are free to move."""
        return len(self.free)

    @property
    def motion_columns(self) -> NDArray[np.intp]:
        """Index of each motion's position in the input vector, shape (motions,)."""
        moved = self._skeleton.inputs.moved
        return np.zeros(0, dtype=np.intp) if moved is None else moved.positions

    @property
    def internal_states(self) -> int:
        """Number of internal states of all effects."""
        return sum(strut.states for strut in self._struts)

    @property
    def mockups(self) -> tuple[MockUp | None, ...]:
        """FMU of each strut, if it has one."""
        return tuple(strut.mockup for strut in self._struts)

    def init(
        self,
        heights_m: Sequence[float],
        velocities_m_per_s: Sequence[float] | None = None,
        t_s: float = 0.0,
        inputs: Sequence[float] | None = None,
    ) -> PlantState:
        """State with given strut heights and velocities; internal states are zero.

        The model rests under its weight in the directions that the heights leave free.

        Args:
            heights_m: One height a strut; NaN where none is given.
            velocities_m_per_s: One velocity a strut; at rest if absent.
            t_s: Time.
            inputs: Input vector, for the bodies that are moved; zero if absent.

        Raises:
            ModelError: The joints cannot reach the heights.
        """
        q, v = np.zeros(self.coordinates), np.zeros(self.coordinates)
        if inputs is not None:
            self.put_moved(q, v, np.asarray(inputs, np.float64))
        heights = np.asarray(heights_m, np.float64)
        q = self._geometry.reaching(heights, self._reach(q))
        if not np.isfinite(heights).all():
            q = self._resting(q, heights)
        if velocities_m_per_s is None:
            v = self._spread(q) @ v
        else:
            v = self._rates_with(q, v, np.asarray(velocities_m_per_s, np.float64), heights)
        return self.state(q.tolist(), v.tolist(), (0.0,) * self.internal_states, t_s)

    def following(
        self, q: Array, heights_m: Array, velocities_m_per_s: Array, inputs: Array
    ) -> tuple[Array, Array]:
        """Coordinates near `q` and their rates, each (n,), with given heights and velocities.

        Heights and velocities have the shape (struts,), as those of `init`; moved bodies are where
        the inputs have them.

        Raises:
            ModelError: The joints cannot reach the heights.
        """
        q, v = q.copy(), np.zeros_like(q)
        self.put_moved(q, v, inputs)
        q = self._geometry.reaching(heights_m, self._closed(q))
        return q, self._rates_with(q, v, velocities_m_per_s, heights_m)

    def _rates_with(self, q: Array, v: Array, velocities_m_per_s: Array, heights_m: Array) -> Array:
        """Rates (n,) with the velocities of the struts whose heights are given, moved as in `v`."""
        given, spread, free = np.isfinite(heights_m), self._spread(q), self.free
        rows = (self._geometry.at(q).struts @ spread)[given]
        v = v.copy()
        v[free] = 0.0
        own = velocities_m_per_s[given] - rows @ v
        v[free] = np.linalg.lstsq(rows[:, free], own, rcond=None)[0]
        return spread @ v

    def _spread(self, q: Array) -> Array:
        """Rates of all coordinates per rate of each that is free or moved, shape (n, n)."""
        loops = self._skeleton.loops
        return np.eye(self.coordinates) if loops is None else loops.spread(q)

    def _closed(self, q: Array) -> Array:
        """The free and moved coordinates of `q`, with the others so that the loops are closed."""
        return q if self._skeleton.loops is None else self._skeleton.loops.close(q)

    def _reach(self, q: Array) -> Array:
        """The same, whatever the others are in `q`."""
        return q if self._skeleton.loops is None else self._skeleton.loops.reach(q)

    def put_moved(self, q: Array, v: Array, inputs: Array) -> None:
        """Write positions and velocities of moved bodies into coordinates and rates, each (n,)."""
        if self._skeleton.inputs.moved is not None:
            self._skeleton.inputs.moved.put(q, v, inputs)

    def _resting(self, q: Array, heights_m: Array) -> Array:
        """Coordinates with the given heights, at rest in the directions that these leave free.

        Where there is no such rest within a metre, these directions stay as they are.
        """
        start = q
        for _ in range(_RESTING_STEPS):
            own = self._spread(q)[:, self.free]
            given = self._geometry.at(q).struts[np.isfinite(heights_m)]
            free: Array = null_space(given @ own)
            if not free.size:
                return q
            force = free.T @ self._force_at_rest(q)
            free_in_all: Array = own @ free
            slopes = [
                self._force_at_rest(self._closed(q + _RESTING_STEP * direction))
                - self._force_at_rest(self._closed(q - _RESTING_STEP * direction))
                for direction in free_in_all.T
            ]
            stiffness = -free.T @ np.column_stack(slopes) / (2.0 * _RESTING_STEP)
            # No spring holds some directions: they stay where they are.
            move = np.linalg.lstsq(stiffness, force, rcond=_SPRINGLESS)[0]
            move *= min(1.0, _LONGEST_MOVE / max(float(np.abs(move).max()), 1e-300))
            q = self._geometry.reaching(heights_m, self._closed(q + free_in_all @ move))
            if np.abs(move).max() < _RESTED:
                return q if np.abs(q - start).max() < _FARTHEST else start
        return start

    def _force_at_rest(self, q: Array) -> Array:
        """Generalised force of weight and struts on what is free, at rest at coordinates `q`."""
        zeros = np.zeros(self.coordinates)
        here = self.mechanics(q, zeros)
        state = self.state(q.tolist(), zeros.tolist(), (0.0,) * self.internal_states, 0.0)
        no_inputs = (0.0,) * self.inputs
        forces_n = self.load(state, (0.0,) * self.struts, no_inputs, AMBIENT_C).forces_n
        return here.bias + here.struts.T @ np.array(forces_n)

    def state(
        self,
        positions: Sequence[float],
        velocities: Sequence[float],
        internal: tuple[float, ...],
        t_s: float,
    ) -> PlantState:
        """State with given coordinates; arguments as of `PlantState`."""
        return self._equations.state(positions, velocities, internal, t_s)

    def numbers(self, state: PlantState) -> tuple[float, ...]:
        """A state as numbers, to differentiate a step: without its time, and what is moved."""
        free: list[int] = self.free.tolist()
        positions = [state.positions[k] for k in free]
        velocities = [state.velocities[k] for k in free]
        return (*positions, *velocities, *state.internal)

    def state_of(
        self, numbers: Sequence[float], t_s: float = 0.0, inputs: Sequence[float] | None = None
    ) -> PlantState:
        """The state of numbers as `numbers` returns them; what is moved is at zero without inputs.

        Raises:
            ModelError: No loop can be closed there.
        """
        n = self.free_coordinates
        q, v = np.zeros((2, self.coordinates))
        q[self.free], v[self.free] = numbers[:n], numbers[n : 2 * n]
        if inputs is not None:
            self.put_moved(q, v, np.asarray(inputs, np.float64))
        q = self._reach(q)
        v = self._spread(q) @ v
        return self.state(q.tolist(), v.tolist(), tuple(numbers[2 * n :]), t_s)

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        inputs: Sequence[float],
        temperature_c: float,
    ) -> Loaded:
        """Let forces act on a state, whose moved bodies are where the inputs have them."""
        return self._equations.load(state, virtual_forces_n, inputs, temperature_c)

    def step(self, loaded: Loaded, dt_s: float, inputs_end: Sequence[float]) -> PlantState:
        """Advance the model.

        Args:
            loaded: State at the beginning and the forces on it; virtual forces are held.
            dt_s: Duration; divided into steps that are as short as the steepest force asks for that
                the struts can reach in it, none shorter than `step_s`, and into 10 000 at most.
            inputs_end: Inputs at the end. In between, forces are linear, and motions are the
                smooth polynomials through those at both ends.
        """
        longest_s = self.step_s
        if longest_s < self._smooth_step_s:
            longest_s = self._longest_step_s(loaded, dt_s)
        return self._equations.step(loaded, dt_s, inputs_end, longest_s)

    def _longest_step_s(self, loaded: Loaded, dt_s: float) -> float:
        """Longest step with which the model is stable wherever its struts get to in a duration.

        The fastest pole is at most as large as those of a mass, spring and damper with the largest
        mobility and the steepest slopes (norms of the matrices of `Linearised`).
        """
        stiffness = damping = 0.0
        for (by_height, by_velocity), (z, w), a in zip(
            self._slope_tables,
            loaded.state.struts,
            loaded.accelerations_m_per_s2,
            strict=True,
        ):
            faster = _REACH * abs(a) * dt_s
            farther = (abs(w) + faster) * dt_s
            stiffness = max(stiffness, by_height.largest_within(z - farther, z + farther))
            damping = max(damping, by_velocity.largest_within(w - faster, w + faster))
        mobility = self._mobility_per_kg
        fastest = mobility * damping + math.sqrt(mobility * stiffness)
        return min(self._smooth_step_s, max(self.step_s, stable_for(fastest)))

    def slopes(
        self, state: PlantState, inputs: Sequence[float], temperature_c: float
    ) -> Sequence[tuple[float, float]] | None:
        """Stiffness (N/m) and damping (N·s/m) of each strut's law about a state.

        None where they are the same in every state, where the joints change how a strut acts, or
        where a law has no value next to the state.
        """
        if not self._slopes_vary:
            return None
        try:
            return self._equations.slopes(state, inputs, temperature_c)
        except (ArithmeticError, ValueError):
            return None

    def virtual_sensors(self, sensors: Mapping[str, VirtualSensor]) -> VirtualSensors:
        """Readers of bodies and joints, by the names of virtual sensors.

        Raises:
            ModelError: One names no body or joint.
        """

        def accelerate(loaded: Loaded, virtual_forces_n: Sequence[float]) -> list[float]:
            if tuple(virtual_forces_n) != loaded.virtual_forces_n:
                loaded = self.load(
                    loaded.state, virtual_forces_n, loaded.inputs, loaded.temperature_c
                )
            return np.atleast_1d(loaded.acceleration).tolist()

        return VirtualSensors(self.spec, self._skeleton, self._geometry, sensors, accelerate)

    def jacobians(self, q: Array) -> Jacobians:
        """Heights and Jacobians of the struts at coordinates `q`, shape (n,)."""
        return self._geometry.at(q)

    def mechanics(self, q: Array, v: Array, here: Jacobians | None = None) -> Mechanics:
        """Equations of motion at coordinates `q` with rates `v`, each of shape (n,).

        `here` are the Jacobians at `q` where they are known: masses make no difference to them.
        """
        here, inputs = here or self._geometry.at(q), self._skeleton.inputs
        free, moved = inputs.free, inputs.moved
        every, mass, bias = self._tree_at(q, v)
        columns, by_motion = here.inputs[free], np.zeros((self.struts, 0))
        if moved is not None:
            columns = columns - every[free][:, moved.coordinates] @ here.inputs[moved.coordinates]
            by_motion = here.struts[:, moved.coordinates] * moved.signs
        struts = np.ascontiguousarray(here.struts[:, free])
        mechanics = Mechanics(here.heights_m(q), struts, columns, by_motion, mass, bias)
        loops = self._skeleton.loops
        return mechanics if loops is None else self._with_loops(mechanics, loops, q, here)

    def _tree_at(self, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Mass matrices of all and of the free coordinates, and the bias force on these."""
        dart, free = self._skeleton.dart, self._skeleton.inputs.free
        dart.setPositions(q)
        dart.setVelocities(v)
        dart.setForces(np.zeros(self.coordinates))
        dart.setCommands(np.zeros(self.coordinates))
        dart.computeForwardDynamics()
        every = np.array(dart.getMassMatrix(), dtype=np.float64)
        mass = every[np.ix_(free, free)]
        return every, mass, mass @ np.array(dart.getAccelerations(), dtype=np.float64)[free]

    def _with_loops(self, tree: Mechanics, loops: Loops, q: Array, here: Jacobians) -> Mechanics:
        """The equations of motion on the free coordinates, from those of the tree.

        With ``v = spread @ w`` of free and moved coordinates w, the accelerations are
        ``spread @ w' + curved``, and what the loops carry does no work on w.
        """
        movable, moved = self._skeleton.inputs.free, self._skeleton.inputs.moved
        spread = loops.spread(q)
        curved = np.zeros(self.coordinates)
        own = loops.jacobian(q)[:, loops.dependent]
        curved[loops.dependent] = -np.linalg.solve(own, loops.curvature())
        basis, mass = spread[np.ix_(movable, loops.free)], tree.mass
        inputs, by_motion = tree.inputs, tree.moved
        if moved is not None:
            with_motion = spread[np.ix_(movable, moved.coordinates)]
            inputs = inputs - mass @ with_motion @ here.inputs[moved.coordinates]
            by_motion = by_motion + (tree.struts @ with_motion) * moved.signs
        return Mechanics(
            tree.heights_m,
            tree.struts @ basis,
            basis.T @ inputs,
            by_motion,
            basis.T @ mass @ basis,
            basis.T @ (tree.bias - mass @ curved[movable]),
        )

    def bias_slopes(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Derivatives of the bias force by coordinates (n,) and by their rates (n,).

        The force is that on what is free, and so are the coordinates; shape (n, n).
        """
        return self._bias_slopes(q, v, np.eye(len(q))[self.free])

    def bias_slopes_by_motion(self, q: Array, v: Array) -> tuple[Array, Array]:
        """The same by positions and by velocities of moved bodies, shape (n, motions)."""
        moved = self._skeleton.inputs.moved
        if moved is None:
            return np.zeros((self.free_coordinates, 0)), np.zeros((self.free_coordinates, 0))
        return self._bias_slopes(q, v, moved.signs[:, None] * np.eye(len(q))[moved.coordinates])

    def _bias_slopes(self, q: Array, v: Array, directions: Array) -> tuple[Array, Array]:
        steps = _DIFFERENCE * directions
        by_q = [self._bias_at(q + h, v) - self._bias_at(q - h, v) for h in steps]
        by_v = [self._bias_at(q, v + h) - self._bias_at(q, v - h) for h in steps]
        scale = 2.0 * _DIFFERENCE
        return np.column_stack(by_q) / scale, np.column_stack(by_v) / scale

    def _bias_at(self, q: Array, v: Array) -> Array:
        """Bias force with the free and moved coordinates and rates of `q` and `v`."""
        if self._skeleton.loops is None:
            return self._tree_at(q, v)[2]
        q = self._closed(q)
        return self.mechanics(q, self._spread(q) @ v).bias

    @property
    def is_constant(self) -> bool:
        """Whether mass matrix and Jacobians are the same in every configuration."""
        if self._geometry.constant is None:
            return False
        first, *others = [
            self.mechanics(q, np.zeros_like(q)) for q in sample_positions(self.coordinates)
        ]
        return all(
            np.allclose(first.mass, other.mass, rtol=1e-9, atol=0.0)
            and np.allclose(first.inputs, other.inputs, rtol=1e-9, atol=1e-12)
            for other in others
        )

    def _longest_steps(self) -> tuple[float, float, float]:
        """Longest steps with and without the steepest slopes, and the largest mobility (1/kg)."""
        linear = [(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in self.spec.struts]
        rest = np.zeros(self.coordinates)
        samples = self._sample_places()
        benches = [(self.mechanics(q, rest), *self.bias_slopes(q, rest)) for q in samples]
        exact_s = min(exact_step_s(_linearise(*bench, linear)) for bench in benches)
        if exact_s < SHORTEST_STEP_S:
            fastest_hz = 1.0 / (2.0 * np.pi * exact_s)
            raise ModelError(
                f"model {self.spec.name}: its masses, stiffnesses and dampings require steps of "
                f"{exact_s:.1g} s ({fastest_hz:.1g} Hz), expected a bench for which "
                f"{SHORTEST_STEP_S} s is short enough"
            )
        steepest = [(height.largest, velocity.largest) for height, velocity in self._slope_tables]
        stable_s = min(stable_step_s(_linearise(*bench, steepest)) for bench in benches)
        smooth_s = min(LONGEST_STEP_S, exact_s)
        mobilities = [
            float(np.linalg.norm(here.struts @ np.linalg.solve(here.mass, here.struts.T), 2))
            for here, _, _ in benches
        ]
        return min(smooth_s, max(stable_s, SHORTEST_STEP_S)), smooth_s, max(mobilities)

    def _sample_places(self) -> list[Array]:
        """Generic configurations; with loops those on the way there that they can be closed in."""
        samples = sample_positions(self.coordinates)
        if self._skeleton.loops is None:
            return samples
        return [np.zeros(self.coordinates), *map(self._nearest_closed, samples)]

    def _nearest_closed(self, q: Array) -> Array:
        for _ in range(_HALVINGS):
            try:
                closed = self._reach(q)
                self._spread(closed)
            except ModelError:
                q = 0.5 * q
            else:
                return closed
        return np.zeros_like(q)


def _linearise(
    here: Mechanics, by_q: Array, by_v: Array, struts: Sequence[tuple[float, float]]
) -> Linearised:
    """The bench about one configuration, with a stiffness and a damping of each strut."""
    stiffness, damping = (np.diag(column) for column in zip(*struts, strict=True))
    jacobian = here.struts
    return Linearised(
        here.mass, jacobian.T @ damping @ jacobian - by_v, jacobian.T @ stiffness @ jacobian - by_q
    )
