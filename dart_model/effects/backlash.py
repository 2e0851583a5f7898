"""Free play: a zone of heights in which a spring carries nothing."""

import math

from dart_model.effects.contract import Effect, Floats, Parameter

_BOTH = "heights on both sides of the free play"
_CENTRE = Parameter("centre_height_m", "m", -10.0, 10.0, "middle of the free play")
_GAP = Parameter("gap_m", "m", 1e-5, 2.0, "width of the free play")


def _dead_zone(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    x = height_m - p[2]
    beyond = max(abs(x) - 0.5 * p[1], 0.0)
    return -p[0] * math.copysign(beyond, x)


def _free_play(
    _t_s: float,
    height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    strut: Floats,
) -> float:
    half = 0.5 * p[1]
    return strut[1] * min(max(height_m - p[0], -half), half)


BACKLASH = Effect(
    name="backlash",
    family="backlash",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 1.0, 1e8, "stiffness beyond the free play"),
        _GAP,
        _CENTRE,
    ),
    force=_dead_zone,
    excitation=_BOTH,
    reference="Nordin and Gutman, Automatica 38 (2002), dead-zone model",
)

FREE_PLAY = Effect(
    name="free_play",
    family="backlash",
    parameters=(_CENTRE, _GAP),
    force=_free_play,
    excitation=_BOTH,
    reference="Nordin and Gutman, Automatica 38 (2002), dead-zone model",
    scaled=(),
)
