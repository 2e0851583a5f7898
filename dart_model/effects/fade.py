"""A damper that loses its damping as it warms up, or with time or work."""

import math
from functools import partial

from dart_model.effects.law import Effect, Motion, Parameter, Start, State
from dart_model.effects.ranges import Starts, grid, moving, within

_REFERENCE = "Dixon, The Shock Absorber Handbook (2007), 7.12, temperature effects"
_FINAL = Parameter(
    "final_fraction",
    "",
    0.0,
    3.0,
    "share of the damping that remains in the end (above 1: it has grown)",
)
_LOSS = Parameter(
    "fraction_per_k",
    "1/K",
    -0.2,
    0.2,
    "relative loss of damping per kelvin, at the reference temperature",
)
_COLD = Parameter(
    "reference_c", "°C", -273.15, 2000.0, "temperature at which the damping is that of the model"
)
AMBIENT_C = 20.0
"""Damper temperature where none is measured: that of a bench hall, and the reference of ISO 1."""

_LARGEST_EXPONENT = 40.0


def _temperature(
    velocity_m_per_s: float,
    temperature_c: float,
    damping_n_s_per_m: float,
    fraction_per_k: float,
    reference_c: float,
) -> float:
    exponent = -fraction_per_k * (temperature_c - reference_c)
    return damping_n_s_per_m * velocity_m_per_s * (1.0 - math.exp(min(exponent, _LARGEST_EXPONENT)))


def _linear_temperature(
    velocity_m_per_s: float,
    temperature_c: float,
    damping_n_s_per_m: float,
    fraction_per_k: float,
    reference_c: float,
) -> float:
    return damping_n_s_per_m * velocity_m_per_s * fraction_per_k * (temperature_c - reference_c)


def _time(
    t_s: float,
    velocity_m_per_s: float,
    damping_n_s_per_m: float,
    final_fraction: float,
    time_constant_s: float,
) -> float:
    return (
        damping_n_s_per_m
        * velocity_m_per_s
        * (1.0 - final_fraction)
        * (1.0 - math.exp(-max(t_s, 0.0) / time_constant_s))
    )


def _energy(
    velocity_m_per_s: float,
    work_j: float,
    damping_n_s_per_m: float,
    final_fraction: float,
    energy_j: float,
) -> float:
    return (
        damping_n_s_per_m
        * velocity_m_per_s
        * (1.0 - final_fraction)
        * (1.0 - math.exp(-work_j / energy_j))
    )


def _energy_rate(
    velocity_m_per_s: float,
    work_j: float,
    damping_n_s_per_m: float,
    final_fraction: float,
    energy_j: float,
) -> float:
    # The state is the work that the damper has turned into heat, in J.
    left = final_fraction + (1.0 - final_fraction) * math.exp(-work_j / energy_j)
    return damping_n_s_per_m * left * velocity_m_per_s * velocity_m_per_s


def _temperature_starts(*fractions_per_k: float) -> Starts:
    def starts(motion: Motion) -> list[Start]:
        cold, hot = motion.temperatures_c
        return grid(fractions_per_k, [AMBIENT_C]) if hot - cold >= 1.0 else []

    return moving(starts)


def _standard(_: Motion) -> tuple[float, float]:
    # Another reference temperature is another damping: no data distinguish the two.
    return AMBIENT_C, AMBIENT_C


@moving
def _time_starts(motion: Motion) -> list[Start]:
    if motion.damping_n_s_per_m <= 0.0:
        return []
    return grid([0.9, 0.5], [share * motion.duration_s for share in (0.1, 0.3, 1.0)])


def _work_j(motion: Motion) -> float:
    # What the damper turns into heat over the longest recording.
    return motion.damping_n_s_per_m * motion.speed_m_per_s**2 * motion.duration_s


@moving
def _energy_starts(motion: Motion) -> list[Start]:
    work_j = _work_j(motion)
    if work_j <= 0.0:
        return []
    return grid([0.9, 0.5], [share * work_j for share in (0.1, 0.3, 1.0)])


_fade = partial(Effect, family="fade", reference=_REFERENCE, simpler=("linear_damping",), scaled=())

TEMPERATURE_FADE = _fade(
    name="temperature_fade",
    words="fade of the damper with temperature",
    parameters=(_LOSS, _COLD),
    force=_temperature,
    excitation="a measured temperature that changes by several kelvin",
    starts=_temperature_starts(0.003, 0.015, -0.005),
    bounds=within(reference_c=_standard),
    simpler=("linear_damping", "linear_temperature_fade"),
    shown=("fraction_per_k",),
)

LINEAR_TEMPERATURE_FADE = _fade(
    name="linear_temperature_fade",
    words="fade of the damper with temperature (linear)",
    parameters=(_LOSS, _COLD),
    force=_linear_temperature,
    scaled=(0,),
    excitation="a measured temperature that changes by several kelvin",
    starts=_temperature_starts(0.01),
    bounds=within(reference_c=_standard),
    shown=("fraction_per_k",),
)

TIME_FADE = _fade(
    name="time_fade",
    words="fade of the damper with time",
    parameters=(
        _FINAL,
        Parameter("time_constant_s", "s", 1e-9, 1e12, "time constant of the fade"),
    ),
    force=_time,
    excitation="a long duration, with the same motion at the beginning and at the end",
    starts=_time_starts,
    bounds=within(time_constant_s=lambda m: (0.01 * m.duration_s, 10.0 * m.duration_s)),
    shown=("final_fraction",),
)

ENERGY_FADE = _fade(
    name="energy_fade",
    words="fade of the damper with dissipated energy",
    parameters=(
        _FINAL,
        Parameter(
            "energy_j",
            "J",
            1e-12,
            1e12,
            "dissipated energy after which 63 % of the fade has taken place",
        ),
    ),
    force=_energy,
    excitation="a long duration, with the same motion at the beginning and at the end",
    rate=_energy_rate,
    states=(State("work_j", 1.0),),
    starts=_energy_starts,
    bounds=within(energy_j=lambda m: (0.01 * _work_j(m), 10.0 * _work_j(m))),
    shown=("final_fraction",),
)
