"""DART as a black box: state in, forces in, state out.

    skeleton      bodies and joints in DART
    geometry      heights and Jacobians of the struts
    strut         spring, damper and effects as one force
    fmu           a force that a functional mock-up unit computes
    admitted_programs    FMUs that may run on this machine
    backend       the acceleration, by DART
    integrator    Kutta's method, and how long its steps may be
    equations_of_motion  struts on joints
    state         arguments and results
    prescribed_strut     a strut whose motion is given, as on a dyno

Reference: Featherstone, "Rigid Body Dynamics Algorithms" (2008).
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import null_space  # pyright: ignore[reportUnknownVariableType]

from dart_model.effects import AMBIENT_C
from dart_model.errors import ModelError
from dart_model.plant.backend import ManyCoordinates, OneCoordinate
from dart_model.plant.equations_of_motion import EquationsOfMotion
from dart_model.plant.fmu import MockUp
from dart_model.plant.geometry import Array, Geometry, Jacobians, sample_positions
from dart_model.plant.integrator import (
    LONGEST_STEP_S,
    SHORTEST_STEP_S,
    Linearised,
    exact_step_s,
    stable_step_s,
)
from dart_model.plant.prescribed_strut import PrescribedStrut
from dart_model.plant.skeleton import build
from dart_model.plant.state import Loaded, Mechanics, PlantState
from dart_model.plant.strut import struts_of
from dart_model.spec import ModelSpec

__all__ = ["LONGEST_STEP_S", "DartPlant", "PlantState", "PrescribedStrut"]

_RESTING_STEPS, _RESTING_STEP, _RESTED, _LONGEST_MOVE, _SPRINGLESS = 50, 1e-6, 1e-9, 0.1, 1e-9
"""Newton's method for a bench at rest: steps, difference and end (m or rad), longest move, and the
share of the largest stiffness below which a direction counts as free."""
_FARTHEST = 1.0
"""Distance of a rest (m or rad) beyond which nothing holds the bench: no strut is as long."""
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
        if self.coordinates == 1 and self._geometry.constant is not None:
            one = OneCoordinate(self._skeleton)
            self._equations = EquationsOfMotion[float](one, self._struts, self._geometry)
        else:
            many = ManyCoordinates(self._skeleton)
            self._equations = EquationsOfMotion[Array](many, self._struts, self._geometry)
        self._slopes_vary = self._geometry.constant is not None and not all(
            strut.is_linear for strut in self._struts
        )
        self.step_s = self._longest_step_s()
        """Longest step of the integrator."""

    @property
    def struts(self) -> int:
        """Number of struts."""
        return len(self._struts)

    @property
    def coordinates(self) -> int:
        """Number of joint coordinates."""
        return self._skeleton.coordinates

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
    ) -> PlantState:
        """State with given strut heights and velocities; internal states are zero.

        The model rests under its weight in the directions that the heights leave free.

        Args:
            heights_m: One height a strut; NaN where none is given.
            velocities_m_per_s: One velocity a strut; at rest if absent.
            t_s: Time.

        Raises:
            ModelError: The joints cannot reach the heights.
        """
        q = self._geometry.reaching(np.asarray(heights_m, np.float64), np.zeros(self.coordinates))
        v = np.zeros(self.coordinates)
        given = np.isfinite(heights_m)
        if not given.all():
            q = self._resting(q, np.asarray(heights_m, np.float64))
        if velocities_m_per_s is not None:
            struts = self._geometry.at(q).struts[given]
            v = np.linalg.lstsq(struts, np.asarray(velocities_m_per_s)[given], rcond=None)[0]
        return self.state(q.tolist(), v.tolist(), (0.0,) * self.internal_states, t_s)

    def _resting(self, q: Array, heights_m: Array) -> Array:
        """Coordinates with the given heights, at rest in the directions that these leave free.

        Where there is no such rest within a metre, these directions stay as they are.
        """
        start = q
        for _ in range(_RESTING_STEPS):
            given = self._geometry.at(q).struts[np.isfinite(heights_m)]
            free: Array = null_space(given)
            if not free.size:
                return q
            force = free.T @ self._force_at_rest(q)
            slopes = [
                self._force_at_rest(q + _RESTING_STEP * direction)
                - self._force_at_rest(q - _RESTING_STEP * direction)
                for direction in free.T
            ]
            stiffness = -free.T @ np.column_stack(slopes) / (2.0 * _RESTING_STEP)
            # No spring holds some directions: they stay where they are.
            move = np.linalg.lstsq(stiffness, force, rcond=_SPRINGLESS)[0]
            move *= min(1.0, _LONGEST_MOVE / max(float(np.abs(move).max()), 1e-300))
            q = self._geometry.reaching(heights_m, q + free @ move)
            if np.abs(move).max() < _RESTED:
                return q if np.abs(q - start).max() < _FARTHEST else start
        return start

    def _force_at_rest(self, q: Array) -> Array:
        """Generalised force of weight and struts at coordinates `q` at rest, shape (n,)."""
        zeros = np.zeros(self.coordinates)
        here = self.mechanics(q, zeros)
        state = self.state(q.tolist(), zeros.tolist(), (0.0,) * self.internal_states, 0.0)
        forces_n = self.load(state, (0.0,) * self.struts, 0.0, AMBIENT_C).forces_n
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
        """A state as numbers without its time, to differentiate a step."""
        return (*state.positions, *state.velocities, *state.internal)

    def state_of(self, numbers: Sequence[float], t_s: float = 0.0) -> PlantState:
        """The state of numbers as `numbers` returns them."""
        n = self.coordinates
        return self.state(numbers[:n], numbers[n : 2 * n], tuple(numbers[2 * n :]), t_s)

    def load(
        self,
        state: PlantState,
        virtual_forces_n: Sequence[float],
        applied_force_n: float,
        temperature_c: float,
    ) -> Loaded:
        """Let forces act on a state."""
        return self._equations.load(state, virtual_forces_n, applied_force_n, temperature_c)

    def step(self, loaded: Loaded, dt_s: float, applied_force_end_n: float) -> PlantState:
        """Advance the model.

        Args:
            loaded: State at the beginning and the forces on it; virtual forces are held.
            dt_s: Duration; divided into steps of at most `step_s`, and into 10 000 at most.
            applied_force_end_n: Applied force at the end; it is linear in between.
        """
        return self._equations.step(loaded, dt_s, applied_force_end_n, self.step_s)

    def slopes(
        self, state: PlantState, applied_force_n: float, temperature_c: float
    ) -> Sequence[tuple[float, float]] | None:
        """Stiffness (N/m) and damping (N·s/m) of each strut's law about a state.

        None where they are the same in every state, where the joints change how a strut acts, or
        where a law has no value next to the state.
        """
        if not self._slopes_vary:
            return None
        try:
            return self._equations.slopes(state, applied_force_n, temperature_c)
        except (ArithmeticError, ValueError):
            return None

    def jacobians(self, q: Array) -> Jacobians:
        """Heights and Jacobians of the struts at coordinates `q`, shape (n,)."""
        return self._geometry.at(q)

    def mechanics(self, q: Array, v: Array) -> Mechanics:
        """Equations of motion at coordinates `q` with rates `v`, each of shape (n,)."""
        here, dart = self._geometry.at(q), self._skeleton.dart
        dart.setPositions(q)
        dart.setVelocities(v)
        dart.setForces(np.zeros(self.coordinates))
        dart.computeForwardDynamics()
        mass = np.array(dart.getMassMatrix(), dtype=np.float64)
        bias = mass @ np.array(dart.getAccelerations(), dtype=np.float64)
        return Mechanics(here.heights_m(q), here.struts, here.applied, mass, bias)

    def bias_slopes(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Derivatives (n, n) of the bias force by coordinates (n,) and by their rates (n,)."""
        steps = _DIFFERENCE * np.eye(len(q))
        by_q = [self.mechanics(q + h, v).bias - self.mechanics(q - h, v).bias for h in steps]
        by_v = [self.mechanics(q, v + h).bias - self.mechanics(q, v - h).bias for h in steps]
        scale = 2.0 * _DIFFERENCE
        return np.column_stack(by_q) / scale, np.column_stack(by_v) / scale

    @property
    def is_constant(self) -> bool:
        """Whether mass matrix and Jacobians are the same in every configuration."""
        if self._geometry.constant is None:
            return False
        first, *others = [
            self.mechanics(q, np.zeros_like(q)).mass for q in sample_positions(self.coordinates)
        ]
        return all(np.allclose(first, other, rtol=1e-9, atol=0.0) for other in others)

    def _longest_step_s(self) -> float:
        linear = [(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in self.spec.struts]
        rest = np.zeros(self.coordinates)
        samples = sample_positions(self.coordinates)
        benches = [(self.mechanics(q, rest), *self.bias_slopes(q, rest)) for q in samples]
        exact_s = min(exact_step_s(_linearise(*bench, linear)) for bench in benches)
        if exact_s < SHORTEST_STEP_S:
            fastest_hz = 1.0 / (2.0 * np.pi * exact_s)
            raise ModelError(
                f"model {self.spec.name}: its masses, stiffnesses and dampings require steps of "
                f"{exact_s:.1g} s ({fastest_hz:.1g} Hz), expected a bench for which "
                f"{SHORTEST_STEP_S} s is short enough"
            )
        steepest = [strut.steepest() for strut in self._struts]
        stable_s = min(stable_step_s(_linearise(*bench, steepest)) for bench in benches)
        return min(LONGEST_STEP_S, exact_s, max(stable_s, SHORTEST_STEP_S))


def _linearise(
    here: Mechanics, by_q: Array, by_v: Array, struts: Sequence[tuple[float, float]]
) -> Linearised:
    """The bench about one configuration, with a stiffness and a damping of each strut."""
    stiffness, damping = (np.diag(column) for column in zip(*struts, strict=True))
    jacobian = here.struts
    return Linearised(
        here.mass, jacobian.T @ damping @ jacobian - by_v, jacobian.T @ stiffness @ jacobian - by_q
    )
