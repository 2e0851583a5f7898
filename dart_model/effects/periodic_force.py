"""A force that nobody applied: unbalance or motor ripple."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter


def _force(
    t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return p[0] * math.sin(2.0 * math.pi * p[1] * t_s + p[2])


PERIODIC_FORCE = Effect(
    name="periodic_force",
    family="periodic_force",
    parameters=(
        Parameter("amplitude_n", "N", 0.0, 1e5, "amplitude"),
        Parameter("frequency_hz", "Hz", 0.01, 2000.0, "frequency"),
        Parameter("phase_rad", "rad", -100.0, 100.0, "phase of the sine at time zero"),
    ),
    force=_force,
    excitation="many of its periods, at another frequency than the applied force",
    reference="Rao, Mechanical Vibrations (2017), 3.7, rotating unbalance",
)
