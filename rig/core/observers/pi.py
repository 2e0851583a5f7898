"""The PI observer of the published method: innovation in, virtual force out.

    F_v = K_P (z - z_model) + K_I * integral of (z - z_model) dt

Reference: Cuesta, Luque, Mantaras, "A methodology to improve simulation of multibody systems using
estimation techniques" (2021), equations (6) and (7). Anti-windup by conditional integration:
Åström and Hägglund, "Advanced PID Control" (2006), section 3.5.
"""

from collections.abc import Sequence
from typing import Literal

from msgspec import Struct
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from rig.core.contract import Measurement
from rig.inputs.yaml_file import NotNegative, Positive


class PiState(Struct, frozen=True, gc=False):
    """State of a PI observer.

    Attributes:
        integral_m_s: Integral of the innovation.
        innovation_m: Last innovation.
        virtual_force_n: Virtual force, constant until the next measurement.
        measured_ns: Time of the last measurement.
    """

    integral_m_s: float
    innovation_m: float
    virtual_force_n: float
    measured_ns: int


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class PiObserver:
    """Gains of one strut's observer; the defaults are those of the reference case.

    Attributes:
        kind: Tag of this observer in a configuration.
        proportional_n_per_m: K_P.
        integral_n_per_m_s: K_I.
        force_limit_n: Largest magnitude of the virtual force.
    """

    kind: Literal["pi"] = "pi"
    proportional_n_per_m: NotNegative = 1.0e5
    integral_n_per_m_s: NotNegative = 1.0e4
    force_limit_n: Positive = 1.0e4

    def init(self, measured: Measurement) -> PiState:
        """State at the first measurement."""
        return PiState(0.0, 0.0, 0.0, measured.t_ns)

    def step(
        self,
        state: PiState,
        t_ns: int,
        height_m: float,
        velocity_m_per_s: float,
        measured: Measurement | None,
    ) -> PiState:
        """State after a tick; arguments as of `Observer.step`.

        Between measurements the virtual force is constant. At the limit the integral grows no
        further.
        """
        if measured is None:
            return state
        # The model's height when the measurement was true, to first order.
        model_m = height_m - velocity_m_per_s * (t_ns - measured.t_ns) * 1e-9
        innovation_m = measured.height_m - model_m
        elapsed_s = (measured.t_ns - state.measured_ns) * 1e-9
        integral_m_s = state.integral_m_s + innovation_m * elapsed_s
        proportional_n = self.proportional_n_per_m * innovation_m
        force_n = proportional_n + self.integral_n_per_m_s * integral_m_s
        limit_n = self.force_limit_n
        if not -limit_n <= force_n <= limit_n:
            if force_n * innovation_m > 0.0:
                integral_m_s = state.integral_m_s
                force_n = proportional_n + self.integral_n_per_m_s * integral_m_s
            force_n = min(max(force_n, -limit_n), limit_n)
        return PiState(integral_m_s, innovation_m, force_n, measured.t_ns)

    def numbers(self, state: PiState) -> tuple[float, float]:
        """Integral and virtual force: what the next state depends on."""
        return state.integral_m_s, state.virtual_force_n

    def state_of(self, numbers: Sequence[float]) -> PiState:
        """The state of what `numbers` gave, last measured at time zero."""
        integral_m_s, virtual_force_n = numbers
        return PiState(integral_m_s, 0.0, virtual_force_n, 0)
