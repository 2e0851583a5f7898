"""The PI observer of the seed method: innovation in, virtual force out.

    F_v = K_P (z - z_model) + K_I * integral of (z - z_model) dt

Reference: Cuesta, Luque, Mantaras, "A methodology to improve simulation of multibody systems using
estimation techniques" (2021), equations (6) and (7). Anti-windup by conditional integration:
Åström and Hägglund, "Advanced PID Control" (2006), section 3.5.
"""

from msgspec import Struct

from rig.core.types import ObserverState


class ObserverGains(Struct, frozen=True, gc=False):
    """Gains of one observer.

    Attributes:
        proportional_n_per_m: K_P.
        integral_n_per_m_s: K_I.
        force_limit_n: Largest magnitude of the virtual force.
    """

    proportional_n_per_m: float
    integral_n_per_m_s: float
    force_limit_n: float


def update(
    gains: ObserverGains, state: ObserverState, innovation_m: float, measured_ns: int
) -> ObserverState:
    """Observer after a new measurement.

    Args:
        gains: Gains and limit.
        state: Observer before it.
        innovation_m: Measured less model height.
        measured_ns: Time of the measurement.

    Returns:
        Observer with the new virtual force. At the limit the integral grows no further.
    """
    integral = state.integral_m_s + innovation_m * ((measured_ns - state.measured_ns) * 1e-9)
    proportional = gains.proportional_n_per_m * innovation_m
    force = proportional + gains.integral_n_per_m_s * integral
    limit = gains.force_limit_n
    if not -limit <= force <= limit:
        if force * innovation_m > 0.0:
            integral = state.integral_m_s
            force = proportional + gains.integral_n_per_m_s * integral
        force = min(max(force, -limit), limit)
    return ObserverState(integral, innovation_m, force, measured_ns)
