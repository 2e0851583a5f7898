"""The undeclared effects a bench can carry: their names, parameters and bounds.

The laws themselves are in `rig.simulated_bench.laws`. The order of the parameters
here is the order in which a law reads them.
"""

import math
from types import MappingProxyType
from typing import NamedTuple

from rig.simulated_bench.laws import LawCode

POSITIVE_FLOOR = 1e-300
"""Smallest value of a parameter that has to be positive."""


class EffectParameter(NamedTuple):
    """One parameter of a law.

    Attributes:
        name: Key in the configuration, with its unit.
        low: Smallest value accepted.
        high: Largest value accepted.
        default: Value taken where the configuration gives none; None if it must be given.
    """

    name: str
    low: float = -math.inf
    high: float = math.inf
    default: float | None = None


class EffectKind(NamedTuple):
    """One kind of effect.

    Attributes:
        law: Code of the law.
        parameters: Parameters in the order in which the law reads them.
        states: Number of internal states of the law.
    """

    law: LawCode
    parameters: tuple[EffectParameter, ...]
    states: int = 0


def _positive(name: str, default: float | None = None) -> EffectParameter:
    return EffectParameter(name, low=POSITIVE_FLOOR, default=default)


def _not_negative(name: str, default: float | None = None) -> EffectParameter:
    return EffectParameter(name, low=0.0, default=default)


EFFECT_KINDS: MappingProxyType[str, EffectKind] = MappingProxyType(
    {
        "preload": EffectKind(LawCode.PRELOAD, (EffectParameter("force_n"),)),
        "linear_stiffness": EffectKind(
            LawCode.LINEAR_STIFFNESS, (EffectParameter("stiffness_n_per_m"),)
        ),
        "quadratic_stiffness": EffectKind(
            LawCode.QUADRATIC_STIFFNESS, (EffectParameter("stiffness_n_per_m2"),)
        ),
        "cubic_stiffness": EffectKind(
            LawCode.CUBIC_STIFFNESS, (EffectParameter("stiffness_n_per_m3"),)
        ),
        "progressive_stiffness": EffectKind(
            LawCode.PROGRESSIVE_STIFFNESS, (EffectParameter("force_n"), _positive("length_m"))
        ),
        "gas_spring": EffectKind(
            LawCode.GAS_SPRING,
            (
                EffectParameter("charge_force_n"),
                _positive("gas_length_m"),
                EffectParameter("polytropic_exponent", low=1.0, high=3.0, default=1.3),
            ),
        ),
        "bump_stop": EffectKind(
            LawCode.BUMP_STOP,
            (
                EffectParameter("contact_height_m"),
                _positive("contact_stiffness_n_per_m1_5"),
                _not_negative("dissipation_s_per_m", 0.0),
            ),
        ),
        "rebound_stop": EffectKind(
            LawCode.REBOUND_STOP,
            (
                EffectParameter("contact_height_m"),
                _positive("contact_stiffness_n_per_m1_5"),
                _not_negative("dissipation_s_per_m", 0.0),
            ),
        ),
        "backlash": EffectKind(
            LawCode.BACKLASH,
            (
                EffectParameter("centre_height_m"),
                _not_negative("gap_m"),
                _positive("stiffness_n_per_m"),
            ),
        ),
        "linear_damping": EffectKind(
            LawCode.LINEAR_DAMPING, (EffectParameter("damping_n_s_per_m"),)
        ),
        "quadratic_damping": EffectKind(
            LawCode.QUADRATIC_DAMPING, (EffectParameter("damping_n_s2_per_m2"),)
        ),
        "asymmetric_damping": EffectKind(
            LawCode.ASYMMETRIC_DAMPING,
            (EffectParameter("compression_n_s_per_m"), EffectParameter("rebound_n_s_per_m")),
        ),
        "digressive_damping": EffectKind(
            LawCode.DIGRESSIVE_DAMPING,
            (EffectParameter("damping_n_s_per_m"), _positive("knee_velocity_m_per_s")),
        ),
        "position_dependent_damping": EffectKind(
            LawCode.POSITION_DEPENDENT_DAMPING,
            (EffectParameter("damping_n_s_per_m"), _positive("length_m")),
        ),
        "friction": EffectKind(
            LawCode.FRICTION,
            (
                _positive("coulomb_force_n"),
                _positive("presliding_m", 2e-4),
                EffectParameter("static_to_coulomb", low=1.0, high=10.0, default=1.0),
                _positive("stribeck_velocity_m_per_s", 0.05),
                _not_negative("bristle_damping_n_s_per_m", 0.0),
            ),
            states=1,
        ),
        "bouc_wen": EffectKind(
            LawCode.BOUC_WEN,
            (
                _positive("stiffness_n_per_m"),
                _positive("yield_m"),
                EffectParameter("exponent", low=1.0, high=20.0, default=1.0),
                EffectParameter("shape", low=0.5, high=1.0, default=0.5),
            ),
            states=1,
        ),
        "maxwell": EffectKind(
            LawCode.MAXWELL,
            (_positive("stiffness_n_per_m"), _positive("relaxation_time_s")),
            states=1,
        ),
        "periodic_force": EffectKind(
            LawCode.PERIODIC_FORCE,
            (
                EffectParameter("amplitude_n"),
                _positive("frequency_hz"),
                EffectParameter("phase_rad", default=0.0),
            ),
        ),
        "temperature_fade": EffectKind(
            LawCode.TEMPERATURE_FADE,
            (EffectParameter("fraction_per_k"), EffectParameter("reference_c", default=20.0)),
        ),
        "time_fade": EffectKind(
            LawCode.TIME_FADE, (_not_negative("final_fraction"), _positive("time_constant_s"))
        ),
        "hidden_mass": EffectKind(
            LawCode.HIDDEN_MASS,
            (
                _positive("mass_kg"),
                _positive("stiffness_n_per_m"),
                _not_negative("damping_n_s_per_m", 0.0),
            ),
            states=2,
        ),
        "added_mass": EffectKind(LawCode.ADDED_MASS, (EffectParameter("mass_kg"),)),
        "input_gain": EffectKind(LawCode.INPUT_GAIN, (EffectParameter("gain"),)),
        "delay": EffectKind(LawCode.DELAY, (EffectParameter("delay_s", low=0.0, high=1.0),)),
    }
)
"""Every kind of effect by its name in the configuration."""

PARAMETER_COUNT = max(len(kind.parameters) for kind in EFFECT_KINDS.values())
"""Width of the parameter table that the compiled equations read."""


def parameter_error(name: str, given: dict[str, float]) -> str | None:
    """First error in an effect's parameters.

    Args:
        name: Name of the effect, one of `EFFECT_KINDS`.
        given: Parameters as configured.

    Returns:
        One line naming key, value and expectation, or None if nothing is wrong.
    """
    parameters = {parameter.name: parameter for parameter in EFFECT_KINDS[name].parameters}
    for key, value in given.items():
        parameter = parameters.get(key)
        if parameter is None:
            return f"{key} is not a parameter of {name}, expected {', '.join(parameters)}"
        if not parameter.low <= value <= parameter.high:
            low = "above 0" if parameter.low == POSITIVE_FLOOR else f"at least {parameter.low:g}"
            high = "" if math.isinf(parameter.high) else f" and at most {parameter.high:g}"
            return f"{key} = {value:g}, expected a value {low}{high}"
    for parameter in parameters.values():
        if parameter.default is None and parameter.name not in given:
            return f"{parameter.name} is missing, {name} needs it"
    return None


def parameter_values(name: str, given: dict[str, float]) -> tuple[float, ...]:
    """An effect's parameters in the order in which its law reads them.

    Args:
        name: Name of the effect, one of `EFFECT_KINDS`.
        given: Parameters as configured, without error.

    Returns:
        The values, defaults filled in.
    """
    return tuple(
        given.get(parameter.name, parameter.default or 0.0)
        for parameter in EFFECT_KINDS[name].parameters
    )
