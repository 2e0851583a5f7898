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
    """One kind of effect: its law, parameters in the law's order, number of internal states.

    Attributes:
        words: Its meaning, for the guide.
    """

    law: LawCode
    words: str
    parameters: tuple[EffectParameter, ...]
    states: int


def _positive(name: str, default: float | None = None) -> EffectParameter:
    return EffectParameter(name, low=POSITIVE_FLOOR, default=default)


def _not_negative(name: str, default: float | None = None) -> EffectParameter:
    return EffectParameter(name, low=0.0, default=default)


_STOP = (
    EffectParameter("contact_height_m"),
    _positive("contact_stiffness_n_per_m1_5"),
    _not_negative("dissipation_s_per_m", 0.0),
)

_PARAMETERS: dict[LawCode, tuple[EffectParameter, ...]] = {
    LawCode.PRELOAD: (EffectParameter("force_n"),),
    LawCode.LINEAR_STIFFNESS: (EffectParameter("stiffness_n_per_m"),),
    LawCode.QUADRATIC_STIFFNESS: (EffectParameter("stiffness_n_per_m2"),),
    LawCode.CUBIC_STIFFNESS: (EffectParameter("stiffness_n_per_m3"),),
    LawCode.PROGRESSIVE_STIFFNESS: (EffectParameter("force_n"), _positive("length_m")),
    LawCode.GAS_SPRING: (
        EffectParameter("charge_force_n"),
        _positive("gas_length_m"),
        EffectParameter("polytropic_exponent", low=1.0, high=3.0, default=1.3),
    ),
    LawCode.BUMP_STOP: _STOP,
    LawCode.REBOUND_STOP: _STOP,
    LawCode.BACKLASH: (
        EffectParameter("centre_height_m"),
        _not_negative("gap_m"),
        _positive("stiffness_n_per_m"),
    ),
    LawCode.LINEAR_DAMPING: (EffectParameter("damping_n_s_per_m"),),
    LawCode.QUADRATIC_DAMPING: (EffectParameter("damping_n_s2_per_m2"),),
    LawCode.ASYMMETRIC_DAMPING: (
        EffectParameter("compression_n_s_per_m"),
        EffectParameter("rebound_n_s_per_m"),
    ),
    LawCode.DIGRESSIVE_DAMPING: (
        EffectParameter("damping_n_s_per_m"),
        _positive("knee_velocity_m_per_s"),
    ),
    LawCode.POSITION_DEPENDENT_DAMPING: (
        EffectParameter("damping_n_s_per_m"),
        _positive("length_m"),
    ),
    LawCode.FRICTION: (
        _positive("coulomb_force_n"),
        _positive("presliding_m", 2e-4),
        EffectParameter("static_to_coulomb", low=1.0, high=10.0, default=1.0),
        _positive("stribeck_velocity_m_per_s", 0.05),
        _not_negative("bristle_damping_n_s_per_m", 0.0),
    ),
    LawCode.BOUC_WEN: (
        _positive("stiffness_n_per_m"),
        _positive("yield_m"),
        EffectParameter("exponent", low=1.0, high=20.0, default=1.0),
        EffectParameter("shape", low=0.5, high=1.0, default=0.5),
    ),
    LawCode.MAXWELL: (_positive("stiffness_n_per_m"), _positive("relaxation_time_s")),
    LawCode.PERIODIC_FORCE: (
        EffectParameter("amplitude_n"),
        _positive("frequency_hz"),
        EffectParameter("phase_rad", default=0.0),
    ),
    LawCode.TEMPERATURE_FADE: (
        EffectParameter("fraction_per_k"),
        EffectParameter("reference_c", default=20.0),
    ),
    LawCode.TIME_FADE: (_not_negative("final_fraction"), _positive("time_constant_s")),
    LawCode.HIDDEN_MASS: (
        _positive("mass_kg"),
        _positive("stiffness_n_per_m"),
        _not_negative("damping_n_s_per_m", 0.0),
    ),
    LawCode.ADDED_MASS: (EffectParameter("mass_kg"),),
    LawCode.INPUT_GAIN: (EffectParameter("gain"),),
    LawCode.DELAY: (EffectParameter("delay_s", low=0.0, high=1.0),),
}
_WORDS: dict[LawCode, str] = {
    LawCode.PRELOAD: "constant force",
    LawCode.LINEAR_STIFFNESS: "linear spring whose force is zero at the free length",
    LawCode.QUADRATIC_STIFFNESS: "force -`stiffness_n_per_m2` * deflection², with the same sign "
    "on both sides of the free length",
    LawCode.CUBIC_STIFFNESS: "restoring force proportional to the cube of the deflection",
    LawCode.PROGRESSIVE_STIFFNESS: "spring with the restoring force `force_n` * (sinh(x) - x), "
    "where x = deflection / `length_m`",
    LawCode.GAS_SPRING: "polytropic gas spring with the force `charge_force_n` at the free length, "
    "at which the gas column is `gas_length_m` long",
    LawCode.BUMP_STOP: "stop in compression (Hunt-Crossley)",
    LawCode.REBOUND_STOP: "stop in rebound (Hunt-Crossley)",
    LawCode.BACKLASH: "additional spring with free play: no force within ± `gap_m`/2 of "
    "`centre_height_m`",
    LawCode.LINEAR_DAMPING: "linear damper",
    LawCode.QUADRATIC_DAMPING: "damping force proportional to the square of the velocity, against "
    "the motion",
    LawCode.ASYMMETRIC_DAMPING: "linear damper, different in compression and rebound",
    LawCode.DIGRESSIVE_DAMPING: "damper whose force approaches a constant above the knee",
    LawCode.POSITION_DEPENDENT_DAMPING: "damping proportional to the square of the "
    "deflection: `damping_n_s_per_m` at a deflection of `length_m`",
    LawCode.FRICTION: "dry friction (LuGre)",
    LawCode.BOUC_WEN: "hysteresis (Bouc-Wen)",
    LawCode.MAXWELL: "spring and damper in series",
    LawCode.PERIODIC_FORCE: "sine force",
    LawCode.TEMPERATURE_FADE: "factor on the damper curve: exp(-`fraction_per_k` * (temperature - "
    "`reference_c`))",
    LawCode.TIME_FADE: "factor on the damper curve that changes exponentially from 1 to "
    "`final_fraction`, with the time constant `time_constant_s`",
    LawCode.HIDDEN_MASS: "additional mass that a spring and a damper connect to the upper body",
    LawCode.ADDED_MASS: "additional mass on the upper body",
    LawCode.INPUT_GAIN: "ratio of the force that acts on the body to the measured applied force (1 "
    "changes nothing)",
    LawCode.DELAY: "time by which the force that acts on the body lags the measured applied force",
}
_STATES = {LawCode.FRICTION: 1, LawCode.BOUC_WEN: 1, LawCode.MAXWELL: 1, LawCode.HIDDEN_MASS: 2}

EFFECT_KINDS: MappingProxyType[str, EffectKind] = MappingProxyType(
    {
        law.name.lower(): EffectKind(law, _WORDS[law], parameters, _STATES.get(law, 0))
        for law, parameters in _PARAMETERS.items()
    }
)
"""Every kind of effect by its name in the configuration, which is that of its law."""

PARAMETER_COUNT = max(len(kind.parameters) for kind in EFFECT_KINDS.values())
"""Width of the parameter table that the compiled equations read."""


def parameter_error(name: str, given: dict[str, float]) -> str | None:
    """First error in the parameters of one of `EFFECT_KINDS`, as configured; None without one.

    It is one line naming key, value and expectation.
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
            return f"{parameter.name} is missing, {name} requires it"
    return None


def parameter_values(name: str, given: dict[str, float]) -> tuple[float, ...]:
    """Parameters of one of `EFFECT_KINDS` in the order in which its law reads them.

    Defaults are filled in; `given` is as configured, without error.
    """
    return tuple(
        given.get(parameter.name, parameter.default or 0.0)
        for parameter in EFFECT_KINDS[name].parameters
    )
