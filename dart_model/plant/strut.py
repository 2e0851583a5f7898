"""A strut: its spring, damper and effects as one force, without DART."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dart_model.effects import AMBIENT_C, Effect, effect
from dart_model.errors import ModelError
from dart_model.plant.fmu import MockUp
from dart_model.spec import ModelSpec, StrutSpec

_SAMPLED_M, _SAMPLED_M_PER_S = 0.5, 3.0
"""How far from the free length, and how fast, effects are sampled for their steepest slope."""


class _Law(NamedTuple):
    """An effect of a strut, or what an FMU gives beside them.

    Attributes:
        effect: The effect.
        parameters: Its parameters in their order.
        first: Index of its first internal state in the model's.
        end: Index after its last one.
    """

    effect: Effect | MockUp
    parameters: list[float]
    first: int
    end: int


class Strut:
    """Force of a strut over height, velocity and internal states.

    Args:
        spec: The strut.
        first_state: Index of its first internal state in the model's.
        gravity_m_per_s2: Standard gravity, for laws that carry a mass.
        folder: Where an FMU is looked for.
    """

    def __init__(
        self, spec: StrutSpec, first_state: int, gravity_m_per_s2: float, folder: Path
    ) -> None:
        self.name = spec.name
        self._free_length = spec.free_length_m
        self._stiffness = spec.stiffness_n_per_m
        self._damping = spec.damping_n_s_per_m
        self._constants = (
            spec.free_length_m,
            spec.stiffness_n_per_m,
            spec.damping_n_s_per_m,
            gravity_m_per_s2,
        )
        laws: list[_Law] = []
        first = first_state
        for item in spec.effects:
            end = first + effect(item.name).state_size
            laws.append(_Law(effect(item.name), item.values(), first, end))
            first = end
        if spec.fmu is not None:
            unit = MockUp(spec.fmu, folder, gravity_m_per_s2)
            laws.append(_Law(unit, [], first, first + len(unit.state_scales)))
            first = laws[-1].end
        self._laws = tuple(laws)
        self.states = first - first_state
        """Number of internal states."""
        self.mockups = tuple(law.effect for law in laws if isinstance(law.effect, MockUp))
        """FMUs among what gives its force, at most one; its states are the strut's last."""

    def force_n(
        self,
        height_m: float,
        velocity_m_per_s: float,
        internal: Sequence[float],
        t_s: float,
        applied_force_n: float,
        temperature_c: float,
        internal_rates: list[float],
    ) -> float:
        """Force, positive when it pushes the two bodies apart.

        Args:
            height_m: Height.
            velocity_m_per_s: Velocity; positive is rebound.
            internal: Internal states of the whole model.
            t_s: Time, for effects that depend on it.
            applied_force_n: Applied force, for effects that act on it.
            temperature_c: Damper temperature.
            internal_rates: Derivative of `internal`; this strut's part is written.
        """
        force = self._stiffness * (self._free_length - height_m) - self._damping * velocity_m_per_s
        for law, parameters, first, end in self._laws:
            own = internal[first:end]
            given = (t_s, height_m, velocity_m_per_s, applied_force_n, temperature_c, own)
            force += law.force(*given, parameters, self._constants)
            if law.rate is not None:
                rates = [0.0] * (end - first)
                law.rate(*given, parameters, self._constants, rates)
                internal_rates[first:end] = rates
        return force

    def steepest(self) -> tuple[float, float]:
        """Largest stiffness (N/m) and damping (N·s/m) with effects, where a bench can get to.

        Raises:
            ModelError: The parameters of an effect give its law no value.
        """
        if not self._laws:
            return self._stiffness, self._damping
        heights = self._free_length + np.linspace(-_SAMPLED_M, _SAMPLED_M, 501)
        speeds = np.geomspace(1e-6, _SAMPLED_M_PER_S, 60)
        velocities = np.concatenate([-speeds[::-1], speeds])
        internal = [0.0] * self._laws[-1].end
        try:
            by_height = [
                self.force_n(x, 0.0, internal, 0.0, 0.0, AMBIENT_C, internal.copy())
                for x in heights.tolist()
            ]
            by_velocity = [
                self.force_n(self._free_length, v, internal, 0.0, 0.0, AMBIENT_C, internal.copy())
                for v in velocities.tolist()
            ]
        except (ArithmeticError, ValueError) as error:
            names = ", ".join(law.effect.name for law in self._laws)
            raise ModelError(
                f"strut {self.name}: effects {names}: no force with these parameters ({error})"
            ) from error
        # An FMU may refuse what lies outside its range.
        slopes = np.abs(np.diff(by_height) / np.diff(heights))
        rates = np.abs(np.diff(by_velocity) / np.diff(velocities))
        if not (np.any(np.isfinite(slopes)) and np.any(np.isfinite(rates))):
            raise ModelError(f"strut {self.name}: gives no force about its free length")
        stiffness, damping = float(np.nanmax(slopes)), float(np.nanmax(rates))
        return max(self._stiffness, stiffness), max(self._damping, damping)


def struts_of(spec: ModelSpec) -> tuple[Strut, ...]:
    """The struts of a model, their internal states numbered through."""
    struts: list[Strut] = []
    first_state = 0
    for item in spec.struts:
        strut = Strut(item, first_state, spec.gravity_m_per_s2, spec.folder)
        first_state += strut.states
        struts.append(strut)
    return tuple(struts)
