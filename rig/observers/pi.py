"""The PI observer of the published method: innovation in, virtual force out.

    F_v = K_P (z - z_model) + K_I * integral of (z - z_model) dt

Reference: Cuesta, Luque, Mantaras, "A methodology to improve simulation of multibody systems using
estimation techniques" (2021), equations (6) and (7). Anti-windup by conditional integration:
Åström and Hägglund, "Advanced PID Control" (2006), section 3.5. With a `filter` the innovation is
predicted for the present from one that is some milliseconds old; and with a derivative gain its
rate damps the loop, which the published method leaves to the model.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from math import nan
from typing import ClassVar, Literal

import numpy as np
from msgspec import Struct, structs
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from can_dbc.yaml_file import NotNegative, Positive
from rig.observers.error_filter import ErrorFilter, ErrorState
from rig.observers.protocol import (
    AnyObserver,
    Innovation,
    Remark,
    Search,
    SensorStep,
    Start,
    TuningTask,
    Vector,
)

_COARSE_OF_WEIGHT = 0.01
"""Force of one step of the height sensor over the model's weight from which it is warned of: the
published method errs by 1.1 % of the strut's peak force in all."""

_LONGEST_GAP = 5
"""Time in measurement intervals for which the virtual force may stay as it is: for longer it is far
from the true one."""

_GAIN_MARGIN = 2.0
"""Usual for a PI loop."""

_NATURAL_FREQUENCIES = 8
"""That a search may begin at, its bounds among them: an octave and more apart. The fast ones keep
their margin with strong damping and a filter well above them only."""

_SEARCH_STARTS = 2
"""Local searches among them."""

_INTEGRAL_SHARE_PER_S = 0.1
"""K_I over K_P, as in the reference case: slow, it takes what is constant."""

PUBLISHED_PER_S2, PUBLISHED_PER_S3 = 1.0e4, 1.0e3
"""Gains of the reference case over its mass of 10 kg."""


class PiState(Struct, frozen=True, gc=False):
    """State of a PI observer: the virtual force is the estimate; `error` is that of the filter."""

    integral_m_s: float
    innovation_m: float
    virtual_force_n: float
    measured_ns: int
    start: Start
    error: ErrorState | None = None
    is_disturbed: bool = False

    @property
    def residual_force_n(self) -> float:
        return self.virtual_force_n

    @property
    def force_std_n(self) -> float:
        return nan

    @property
    def left_out(self) -> tuple[int, ...]:
        return ()


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class PiObserver:
    """Gains of one strut's observer; the defaults are those of the reference case.

    Attributes:
        kind: `pi`: the PI observer (default).
        proportional_n_per_m: Proportional gain K_P.
        integral_n_per_m_s: Integral gain K_I.
        derivative_n_s_per_m: Derivative gain, on the time derivative of the innovation; requires
            `filter`.
        force_limit_n: Largest magnitude of the virtual force.
        filter: Kalman filter of the model's error, which predicts the present innovation; if
            absent, the last innovation is used.
    """

    fuses_sensors: ClassVar[bool] = False
    is_joinable: ClassVar[bool] = False
    knows_std: ClassVar[bool] = False
    estimates_force: ClassVar[bool] = True

    kind: Literal["pi"] = "pi"
    proportional_n_per_m: NotNegative = 1.0e5
    integral_n_per_m_s: NotNegative = 1.0e4
    derivative_n_s_per_m: NotNegative = 0.0
    force_limit_n: Positive = 1.0e4
    filter: ErrorFilter | None = None

    def __post_init__(self) -> None:
        """Refuse a derivative of the raw innovation: that is noise."""
        if self.derivative_n_s_per_m and self.filter is None:
            raise ValueError(f"derivative_n_s_per_m {self.derivative_n_s_per_m:g}: requires filter")

    @property
    def requires_height(self) -> bool:
        return True

    @property
    def height_std_m(self) -> None:
        return None

    @property
    def force_filter(self) -> None:
        return None

    @property
    def measurements_to_start(self) -> int:
        """Enough for height and velocity: a parabola through twelve of them."""
        return 12

    def init(self, start: Start) -> PiState:
        error = None if self.filter is None else self.filter.init(start)
        return PiState(0.0, 0.0, 0.0, start.t_ns, start, error)

    def restart(self, state: PiState, start: Start) -> PiState:
        del state
        return self.init(start)

    def steady_state(self, start: Start) -> PiState:
        error = None if self.filter is None else self.filter.steady_state(start)
        return PiState(0.0, 0.0, 0.0, start.t_ns, start, error)

    def step(self, state: PiState, t_ns: int, innovation: Innovation | None) -> PiState:
        """Between measurements the force is constant; at the limit the integral does not grow."""
        if innovation is None:
            return state
        error, innovation_m, rate_m_per_s = state.error, innovation.value, 0.0
        if self.filter is not None and error is not None:
            error = self.filter.update(error, innovation)
            innovation_m, rate_m_per_s, *_ = self.filter.predict(error, t_ns)
        elapsed_s = (innovation.t_ns - state.measured_ns) * 1e-9
        integral_m_s = state.integral_m_s + innovation_m * elapsed_s
        proportional_n = self.proportional_n_per_m * innovation_m
        if self.derivative_n_s_per_m:
            proportional_n += self.derivative_n_s_per_m * rate_m_per_s
        force_n = proportional_n + self.integral_n_per_m_s * integral_m_s
        limit_n = self.force_limit_n
        if not -limit_n <= force_n <= limit_n:
            if force_n * innovation_m > 0.0:
                integral_m_s = state.integral_m_s
                force_n = proportional_n + self.integral_n_per_m_s * integral_m_s
            force_n = min(max(force_n, -limit_n), limit_n)
        if self.filter is not None and error is not None:
            acceleration = -force_n * error.start.mobility_per_kg
            error = self.filter.with_input(error, t_ns, acceleration)
        is_disturbed = not -limit_n < force_n < limit_n
        if self.filter is not None and error is not None:
            is_disturbed = is_disturbed or not self.filter.is_steady(error, t_ns)
        return PiState(
            integral_m_s,
            innovation.value,
            force_n,
            innovation.t_ns,
            state.start,
            error,
            is_disturbed,
        )

    def with_slopes(
        self, state: PiState, stiffness_n_per_m: float, damping_n_s_per_m: float
    ) -> PiState:
        del stiffness_n_per_m, damping_n_s_per_m
        return state

    def longest_gap_ns(self, interval_ns: int) -> int:
        return _LONGEST_GAP * interval_ns

    def settling_ns(self, decay_ns: int) -> int:
        return decay_ns

    def numbers(self, state: PiState) -> tuple[float, ...]:
        """Integral, virtual force and filter, all in m: what the next state depends on."""
        interval_s, moved = _scales(state.start)
        own = state.integral_m_s / interval_s, state.virtual_force_n * moved
        if self.filter is None or state.error is None:
            return own
        return (*own, *self.filter.numbers(state.error))

    def with_numbers(self, state: PiState, numbers: Sequence[float]) -> PiState:
        interval_s, moved = _scales(state.start)
        integral, force, *others = numbers
        error = state.error
        if self.filter is not None and error is not None:
            error = self.filter.with_numbers(error, others)
        return structs.replace(
            state,
            integral_m_s=integral * interval_s,
            virtual_force_n=force / moved,
            error=error,
        )

    def can_continue(self, other: AnyObserver) -> bool:
        """Whether the other one has the same filter, whose state it continues."""
        return type(other) is PiObserver and other.filter == self.filter

    def remark_on_step(self, step: SensorStep) -> Remark:
        """Force that one step of the height sensor makes."""
        force_n = step.step_m * self.proportional_n_per_m
        text = f"each {force_n:.3g} N at K_P"
        if step.weight_n is None or force_n <= _COARSE_OF_WEIGHT * step.weight_n:
            return Remark(text, is_warning=False)
        return Remark(f"{text}: more than 1 % of the model's weight; see rig tune", is_warning=True)

    def remark_on_rate(self, rate_hz: float) -> Remark | None:
        return None if self.filter is None else self.filter.remark_on_rate(rate_hz)

    @classmethod
    def search(cls, task: TuningTask) -> Search:
        """Search over the logarithms of natural frequency, damping ratio and filter corner."""
        low, high = ErrorFilter.corners(task.interval_s)

        def observer(x: Vector) -> PiObserver:
            natural, damping, corner = (float(value) for value in x)
            proportional = task.mass_kg * math.exp(2.0 * natural)
            return PiObserver(
                proportional_n_per_m=proportional,
                integral_n_per_m_s=_INTEGRAL_SHARE_PER_S * proportional,
                derivative_n_s_per_m=2.0 * task.mass_kg * math.exp(natural + damping),
                force_limit_n=task.force_limit_n,
                filter=ErrorFilter.with_corner(math.exp(corner), task),
            )

        naturals = np.linspace(math.log(low), math.log(high), _NATURAL_FREQUENCIES)[1:-1].tolist()
        candidates = [
            [natural, math.log(damping), natural + above]
            for natural, damping, above in itertools.product(naturals, (0.3, 1.0), (0.3, 1.5))
        ]
        return Search(observer, candidates, _SEARCH_STARTS, _GAIN_MARGIN)

    def bandwidth_hz(self, mobility_per_kg: float) -> float:
        """Natural frequency of the loop."""
        return math.sqrt(self.proportional_n_per_m * mobility_per_kg) / (2.0 * math.pi)

    def with_bandwidth(self, factor: float) -> "PiObserver":
        return replace(
            self,
            proportional_n_per_m=factor**2 * self.proportional_n_per_m,
            integral_n_per_m_s=factor**2 * self.integral_n_per_m_s,
            derivative_n_s_per_m=factor * self.derivative_n_s_per_m,
            filter=None if self.filter is None else self.filter.with_bandwidth(factor),
        )

    def to_four_digits(self) -> "PiObserver":
        return replace(
            self,
            proportional_n_per_m=float(f"{self.proportional_n_per_m:.4g}"),
            integral_n_per_m_s=float(f"{self.integral_n_per_m_s:.4g}"),
            derivative_n_s_per_m=float(f"{self.derivative_n_s_per_m:.4g}"),
            filter=None if self.filter is None else self.filter.to_four_digits(),
        )


def paper_observer(mobility_per_kg: float, force_limit_n: float) -> PiObserver:
    """The published gains, scaled by the effective mass."""
    return PiObserver(
        proportional_n_per_m=PUBLISHED_PER_S2 / mobility_per_kg,
        integral_n_per_m_s=PUBLISHED_PER_S3 / mobility_per_kg,
        force_limit_n=force_limit_n,
    )


def _scales(start: Start) -> tuple[float, float]:
    """Time between measurements, and how far a newton moves the strut meanwhile."""
    interval_s = start.interval_ns * 1e-9
    return interval_s, start.mobility_per_kg * interval_s**2
