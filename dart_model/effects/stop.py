"""End stops, which push but never pull."""

from dart_model.effects.contract import Effect, Floats, Parameter

_FAMILY = "stop"
_CONTACT = Parameter("contact_height_m", "m", -10.0, 10.0, "height at which the stop is touched")
_BUMP = "heights below the bump stop's contact, several times"
_REBOUND = "heights above the rebound stop's contact, several times"
_HUNT_CROSSLEY = "Hunt and Crossley, J. Appl. Mech. 42 (1975)"
_KELVIN_VOIGT = "Goldsmith, Impact (1960), 4; Kelvin-Voigt contact"


def _bump(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = p[0] - height_m
    if depth <= 0.0:
        return 0.0
    return max(p[1] * depth - p[2] * velocity_m_per_s, 0.0)


def _rebound(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = height_m - p[0]
    if depth <= 0.0:
        return 0.0
    return -max(p[1] * depth + p[2] * velocity_m_per_s, 0.0)


def _hertz_bump(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = p[0] - height_m
    if depth <= 0.0:
        return 0.0
    return max(p[1] * depth**1.5 * (1.0 - p[2] * velocity_m_per_s), 0.0)


def _hertz_rebound(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = height_m - p[0]
    if depth <= 0.0:
        return 0.0
    return -max(p[1] * depth**1.5 * (1.0 + p[2] * velocity_m_per_s), 0.0)


def _power_bump(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = p[0] - height_m
    if depth <= 0.0:
        return 0.0
    return max(p[1] * (depth / 0.01) ** p[2] * (1.0 - p[3] * velocity_m_per_s), 0.0)


def _power_rebound(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    depth = height_m - p[0]
    if depth <= 0.0:
        return 0.0
    return -max(p[1] * (depth / 0.01) ** p[2] * (1.0 + p[3] * velocity_m_per_s), 0.0)


def _ends(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    low = p[0] - height_m
    high = height_m - p[1]
    force = 0.0
    if low > 0.0:
        force += max(p[2] * low - p[3] * velocity_m_per_s, 0.0)
    if high > 0.0:
        force -= max(p[2] * high + p[3] * velocity_m_per_s, 0.0)
    return force


def _hertz_ends(
    _t_s: float,
    height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    low = p[0] - height_m
    high = height_m - p[1]
    force = 0.0
    if low > 0.0:
        force += max(p[2] * low**1.5 * (1.0 - p[3] * velocity_m_per_s), 0.0)
    if high > 0.0:
        force -= max(p[2] * high**1.5 * (1.0 + p[3] * velocity_m_per_s), 0.0)
    return force


_LOW = Parameter("low_contact_height_m", "m", -10.0, 10.0, "height of the bump stop")
_HIGH = Parameter("high_contact_height_m", "m", -10.0, 10.0, "height of the rebound stop")

_LINEAR = (
    _CONTACT,
    Parameter("stiffness_n_per_m", "N/m", 10.0, 1e8, "stiffness in contact"),
    Parameter("damping_n_s_per_m", "N·s/m", 0.0, 1e6, "damping in contact"),
)
_HERTZ = (
    _CONTACT,
    Parameter("contact_stiffness_n_per_m1_5", "N/m^1.5", 10.0, 1e10, "Hertzian stiffness"),
    Parameter("dissipation_s_per_m", "s/m", 0.0, 20.0, "dissipation by closing speed"),
)
_POWER = (
    _CONTACT,
    Parameter("force_at_10_mm_n", "N", 0.01, 1e7, "force at a depth of 10 mm"),
    Parameter("exponent", "", 0.8, 4.0, "exponent of the depth"),
    Parameter("dissipation_s_per_m", "s/m", 0.0, 20.0, "dissipation by closing speed"),
)

BUMP_STOP = Effect(
    name="bump_stop",
    family=_FAMILY,
    parameters=_LINEAR,
    force=_bump,
    excitation=_BUMP,
    reference=_KELVIN_VOIGT,
    scaled=(1, 2),
)

REBOUND_STOP = Effect(
    name="rebound_stop",
    family=_FAMILY,
    parameters=_LINEAR,
    force=_rebound,
    excitation=_REBOUND,
    reference=_KELVIN_VOIGT,
    scaled=(1, 2),
)

HERTZ_BUMP_STOP = Effect(
    name="hertz_bump_stop",
    family=_FAMILY,
    parameters=_HERTZ,
    force=_hertz_bump,
    excitation=_BUMP,
    reference=_HUNT_CROSSLEY,
    scaled=(1,),
)

HERTZ_REBOUND_STOP = Effect(
    name="hertz_rebound_stop",
    family=_FAMILY,
    parameters=_HERTZ,
    force=_hertz_rebound,
    excitation=_REBOUND,
    reference=_HUNT_CROSSLEY,
    scaled=(1,),
)

POWER_BUMP_STOP = Effect(
    name="power_bump_stop",
    family=_FAMILY,
    parameters=_POWER,
    force=_power_bump,
    excitation=_BUMP,
    reference=_HUNT_CROSSLEY,
    scaled=(1,),
)

POWER_REBOUND_STOP = Effect(
    name="power_rebound_stop",
    family=_FAMILY,
    parameters=_POWER,
    force=_power_rebound,
    excitation=_REBOUND,
    reference=_HUNT_CROSSLEY,
    scaled=(1,),
)

END_STOPS = Effect(
    name="end_stops",
    family=_FAMILY,
    parameters=(_LOW, _HIGH, *_LINEAR[1:]),
    force=_ends,
    excitation="heights beyond both stops, several times",
    reference=_KELVIN_VOIGT,
    scaled=(2, 3),
)

HERTZ_END_STOPS = Effect(
    name="hertz_end_stops",
    family=_FAMILY,
    parameters=(_LOW, _HIGH, *_HERTZ[1:]),
    force=_hertz_ends,
    excitation="heights beyond both stops, several times",
    reference=_HUNT_CROSSLEY,
    scaled=(2,),
)
