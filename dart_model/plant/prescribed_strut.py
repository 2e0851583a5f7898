"""A strut whose motion is given, as on a dyno: its law alone, without equations of motion."""

import math
from collections.abc import Callable
from typing import NamedTuple

from dart_model.errors import ModelError
from dart_model.plant.integrator import propagate
from dart_model.plant.strut import struts_of
from dart_model.spec import ModelSpec

_LONGEST_STEP_S = 0.5e-3
"""Half the longest step of a bench, since the midpoint rule is of one order less."""
_MOST_STEPS = 1000
"""Steps of one call: over half a second without a measured height they get longer."""

Motion = Callable[[float], tuple[float, float]]
"""Time in s -> height (m) and velocity (m/s)."""


class PrescribedState(NamedTuple):
    """State of a strut whose motion is given."""

    t_s: float
    internal: tuple[float, ...]


class PrescribedStrut:
    """The only strut of a model, moved as a dyno moves it.

    Raises:
        ModelError: It has more than one strut.
    """

    def __init__(self, spec: ModelSpec) -> None:
        if len(spec.struts) != 1:
            raise ModelError(
                f"model {spec.name}: {len(spec.struts)} struts, expected one for a motion that "
                "is prescribed"
            )
        (self._strut,) = struts_of(spec)

    def init(self, t_s: float) -> PrescribedState:
        """State with internal states of zero."""
        return PrescribedState(t_s, (0.0,) * self._strut.states)

    def step(
        self, state: PrescribedState, t_s: float, motion: Motion, temperature_c: float
    ) -> PrescribedState:
        """State at a later time, by the midpoint rule."""
        internal, duration_s = state.internal, t_s - state.t_s
        if not internal or duration_s <= 0.0:
            return PrescribedState(t_s, internal)
        steps = min(_MOST_STEPS, math.ceil(duration_s / _LONGEST_STEP_S))
        h = duration_s / steps
        for step in range(steps):
            begin_s = state.t_s + step * h
            rates = self._rates(begin_s, motion, internal, temperature_c)
            half = propagate(internal, 0.5 * h, rates)
            rates = self._rates(begin_s + 0.5 * h, motion, half, temperature_c)
            internal = propagate(internal, h, rates)
        return PrescribedState(t_s, internal)

    def force_n(
        self, state: PrescribedState, height_m: float, velocity_m_per_s: float, temperature_c: float
    ) -> float:
        """Force of spring, damper and effects: what a load cell would show."""
        return self._strut.force_n(
            height_m, velocity_m_per_s, state.internal, state.t_s, 0.0, temperature_c
        )

    def _rates(
        self, t_s: float, motion: Motion, internal: tuple[float, ...], temperature_c: float
    ) -> list[float]:
        height_m, velocity_m_per_s = motion(t_s)
        rates = [0.0] * self._strut.states
        self._strut.write_rates(
            height_m, velocity_m_per_s, internal, t_s, 0.0, temperature_c, rates
        )
        return rates
