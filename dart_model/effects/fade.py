"""A damper that loses its damping as it warms up, or with time or work."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter, Writable

_FAMILY = "fade"
_REFERENCE = "Dixon, The Shock Absorber Handbook (2007), 7.12, temperature effects"
_FINAL = Parameter("final_fraction", "", 0.0, 3.0, "share of the damping that stays")
_COLD = Parameter("reference_c", "°C", -100.0, 300.0, "temperature with full damping")
_LARGEST_EXPONENT = 40.0


def _temperature(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    exponent = -p[0] * (temperature_c - p[1])
    return strut[2] * velocity_m_per_s * (1.0 - math.exp(min(exponent, _LARGEST_EXPONENT)))


def _linear_temperature(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    return strut[2] * velocity_m_per_s * p[0] * (temperature_c - p[1])


def _time(
    t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    return strut[2] * velocity_m_per_s * (1.0 - p[0]) * (1.0 - math.exp(-max(t_s, 0.0) / p[1]))


def _energy(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    return strut[2] * velocity_m_per_s * (1.0 - p[0]) * (1.0 - math.exp(-state[0] / p[1]))


def _energy_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    strut: Floats,
    out: Writable,
) -> None:
    # The state is the work that the damper has turned into heat, in J.
    left = p[0] + (1.0 - p[0]) * math.exp(-state[0] / p[1])
    out[0] = strut[2] * left * velocity_m_per_s * velocity_m_per_s


TEMPERATURE_FADE = Effect(
    name="temperature_fade",
    family=_FAMILY,
    parameters=(
        Parameter("fraction_per_k", "1/K", -0.2, 0.2, "share of the damping lost per kelvin"),
        _COLD,
    ),
    force=_temperature,
    excitation="a measured temperature that changes by several kelvin",
    reference=_REFERENCE,
    scaled=(),
)

LINEAR_TEMPERATURE_FADE = Effect(
    name="linear_temperature_fade",
    family=_FAMILY,
    parameters=(
        Parameter("fraction_per_k", "1/K", -0.2, 0.2, "share of the damping lost per kelvin"),
        _COLD,
    ),
    force=_linear_temperature,
    excitation="a measured temperature that changes by several kelvin",
    reference=_REFERENCE,
)

TIME_FADE = Effect(
    name="time_fade",
    family=_FAMILY,
    parameters=(
        _FINAL,
        Parameter("time_constant_s", "s", 0.1, 1e5, "time in which the damper warms up"),
    ),
    force=_time,
    excitation="a long run with the same motion at its beginning and end",
    reference=_REFERENCE,
    scaled=(),
)

ENERGY_FADE = Effect(
    name="energy_fade",
    family=_FAMILY,
    parameters=(
        _FINAL,
        Parameter("energy_j", "J", 1e-3, 1e7, "work in which the damper warms up"),
    ),
    force=_energy,
    excitation="a long run with the same motion at its beginning and end",
    reference=_REFERENCE,
    rate=_energy_rate,
    state_size=1,
    scaled=(),
)
