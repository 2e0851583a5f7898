"""The PI observer of the published method: innovation in, virtual force out.

    F_v = K_P (z - z_model) + K_I * integral of (z - z_model) dt

Reference: Cuesta, Luque, Mantaras, "A methodology to improve simulation of multibody systems using
estimation techniques" (2021), equations (6) and (7). Anti-windup by conditional integration:
Åström and Hägglund, "Advanced PID Control" (2006), section 3.5. With a `filter` the innovation is
that of now, predicted from one that is some milliseconds old; and with a derivative gain its rate
damps the loop, which the published method leaves to the model.
"""

from collections.abc import Sequence
from math import nan
from typing import Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from can_dbc.yaml_file import NotNegative, Positive
from rig.bridge.contract import Innovation, Start
from rig.observers.error_filter import ErrorFilter, ErrorState


class PiState(Struct, frozen=True, gc=False):
    """State of a PI observer.

    Attributes:
        integral_m_s: Integral of the innovation.
        innovation_m: Last innovation.
        virtual_force_n: Virtual force, constant until the next measurement.
        measured_ns: Time of the last measurement.
        start: What the observer was started with.
        error: State of the filter; None without one.
    """

    integral_m_s: float
    innovation_m: float
    virtual_force_n: float
    measured_ns: int
    start: Start
    error: ErrorState | None = None

    @property
    def residual_force_n(self) -> float:
        """The virtual force: it is the estimate."""
        return self.virtual_force_n

    @property
    def force_std_n(self) -> float:
        """Not known."""
        return nan


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class PiObserver:
    """Gains of one strut's observer; the defaults are those of the reference case.

    Attributes:
        kind: Tag of this observer in a configuration.
        proportional_n_per_m: K_P.
        integral_n_per_m_s: K_I.
        derivative_n_s_per_m: Gain of the innovation's rate; wants `filter`.
        force_limit_n: Largest magnitude of the virtual force.
        filter: Tells the innovation of now; without one the last is taken as it is.
    """

    kind: Literal["pi"] = "pi"
    proportional_n_per_m: NotNegative = 1.0e5
    integral_n_per_m_s: NotNegative = 1.0e4
    derivative_n_s_per_m: NotNegative = 0.0
    force_limit_n: Positive = 1.0e4
    filter: ErrorFilter | None = None

    def __post_init__(self) -> None:
        """Refuse a derivative of the raw innovation: that is noise."""
        if self.derivative_n_s_per_m and self.filter is None:
            raise ValueError(
                f"derivative_n_s_per_m {self.derivative_n_s_per_m:g}: expected filter beside it"
            )

    @property
    def first_measurements(self) -> int:
        """The model starts at rest, at the first measured height."""
        return 1

    def init(self, start: Start) -> PiState:
        """State at the model's start."""
        error = None if self.filter is None else self.filter.init(start)
        return PiState(0.0, 0.0, 0.0, start.t_ns, start, error)

    def settled(self, start: Start) -> PiState:
        """State after a long time at rest."""
        error = None if self.filter is None else self.filter.settled(start)
        return PiState(0.0, 0.0, 0.0, start.t_ns, start, error)

    def step(self, state: PiState, t_ns: int, innovation: Innovation | None) -> PiState:
        """State after a tick; arguments as of `Observer.step`.

        Between measurements the virtual force is constant. At the limit the integral grows no
        further.
        """
        if innovation is None:
            return state
        error, innovation_m, rate_m_per_s = state.error, innovation.value_m, 0.0
        if self.filter is not None and error is not None:
            error = self.filter.updated(error, innovation)
            innovation_m, rate_m_per_s, *_ = self.filter.predicted(error, t_ns)
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
        measured_ns = innovation.t_ns
        return PiState(integral_m_s, innovation.value_m, force_n, measured_ns, state.start, error)

    def numbers(self, state: PiState) -> tuple[float, ...]:
        """Integral, virtual force and filter, all in m: what the next state depends on."""
        interval_s, moved = _scales(state.start)
        own = state.integral_m_s / interval_s, state.virtual_force_n * moved
        if self.filter is None or state.error is None:
            return own
        return (*own, *self.filter.numbers(state.error))

    def with_numbers(self, state: PiState, numbers: Sequence[float]) -> PiState:
        """The state with other numbers, as `numbers` gives them."""
        interval_s, moved = _scales(state.start)
        integral, force, *others = numbers
        error = state.error
        if self.filter is not None and error is not None:
            error = self.filter.with_numbers(error, others)
        return PiState(
            integral * interval_s,
            state.innovation_m,
            force / moved,
            state.measured_ns,
            state.start,
            error,
        )


def _scales(start: Start) -> tuple[float, float]:
    """Time between measurements, and how far a newton moves the strut meanwhile."""
    interval_s = start.interval_ns * 1e-9
    return interval_s, start.mobility_per_kg * interval_s**2
