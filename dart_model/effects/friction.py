"""Dry friction.

Two kinds of law: a sign function rounded off near standstill, which creeps there, and a bristle
that bends by a fraction of a millimetre before it slides, which holds.
"""

import math

from dart_model.effects.contract import Effect, Floats, Parameter, Writable

_FAMILY = "friction"
_SLIDING = "motion that changes direction, and slow passages"
_COULOMB = Parameter("coulomb_force_n", "N", 0.0, 1e5, "sliding friction")
_STATIC = Parameter("static_to_coulomb", "", 1.0, 5.0, "break-away over sliding friction")
_STRIBECK = Parameter("stribeck_velocity_m_per_s", "m/s", 1e-4, 5.0, "where friction has fallen")
_ROUNDING = Parameter("rounding_velocity_m_per_s", "m/s", 1e-4, 0.2, "width of the rounded sign")
_PRESLIDING = Parameter("presliding_m", "m", 1e-6, 2e-2, "deflection at which sliding begins")

# A bristle settles at |velocity| / presliding, without bound; what is faster than this rate (1/s)
# is over before it can be seen, and would only need shorter steps.
_FASTEST_SETTLING_PER_S = 2000.0


def _coulomb(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * math.tanh(velocity_m_per_s / p[1])


def _stribeck(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    _state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    ratio = velocity_m_per_s / p[2]
    level = 1.0 + (p[1] - 1.0) * math.exp(-ratio * ratio)
    return -p[0] * level * math.tanh(velocity_m_per_s / p[3])


def _presliding(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * min(max(state[0], -1.0), 1.0)


def _presliding_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    # The state is the bristle's deflection in units of `presliding_m`.
    speed = min(abs(velocity_m_per_s) / p[1], _FASTEST_SETTLING_PER_S)
    out[0] = math.copysign(speed, velocity_m_per_s) - speed * state[0]


def _elastoplastic(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * min(max(state[0], -1.0), 1.0)


def _elastoplastic_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    # Elastic up to the limit, then sliding; a step that overshoots the limit is led back to it.
    beyond = abs(state[0]) - 1.0
    if beyond > 0.0 and velocity_m_per_s * state[0] > 0.0:
        out[0] = -math.copysign(min(beyond * 300.0, 1e5), state[0])
    else:
        out[0] = velocity_m_per_s / p[1]


def _lugre(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    ratio = velocity_m_per_s / p[2]
    level = 1.0 + (p[1] - 1.0) * math.exp(-ratio * ratio)
    speed = min(abs(velocity_m_per_s) / p[3], _FASTEST_SETTLING_PER_S)
    bending = (math.copysign(speed, velocity_m_per_s) - speed * state[0] / level) * p[3]
    # The bristle's damping fades with speed, else it would act like a viscous damper.
    return -p[0] * state[0] - p[4] * math.exp(-ratio * ratio) * bending


def _lugre_rate(
    _t_s: float,
    _height_m: float,
    velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
    out: Writable,
) -> None:
    ratio = velocity_m_per_s / p[2]
    level = 1.0 + (p[1] - 1.0) * math.exp(-ratio * ratio)
    speed = min(abs(velocity_m_per_s) / p[3], _FASTEST_SETTLING_PER_S)
    out[0] = math.copysign(speed, velocity_m_per_s) - speed * state[0] / level


COULOMB_FRICTION = Effect(
    name="coulomb_friction",
    family=_FAMILY,
    parameters=(_COULOMB, _ROUNDING),
    force=_coulomb,
    excitation=_SLIDING,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
)

STRIBECK_FRICTION = Effect(
    name="stribeck_friction",
    family=_FAMILY,
    parameters=(_COULOMB, _STATIC, _STRIBECK, _ROUNDING),
    force=_stribeck,
    excitation=_SLIDING,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
)

PRESLIDING_FRICTION = Effect(
    name="presliding_friction",
    family=_FAMILY,
    parameters=(_COULOMB, _PRESLIDING),
    force=_presliding,
    excitation=_SLIDING,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_presliding_rate,
    state_size=1,
)

ELASTOPLASTIC_FRICTION = Effect(
    name="elastoplastic_friction",
    family=_FAMILY,
    parameters=(_COULOMB, _PRESLIDING),
    force=_elastoplastic,
    excitation=_SLIDING,
    reference="Dupont, Hayward, Armstrong, Altpeter, IEEE TAC 47 (2002)",
    rate=_elastoplastic_rate,
    state_size=1,
)

LUGRE_FRICTION = Effect(
    name="lugre_friction",
    family=_FAMILY,
    parameters=(
        _COULOMB,
        _STATIC,
        _STRIBECK,
        _PRESLIDING,
        Parameter("bristle_damping_n_s_per_m", "N·s/m", 0.0, 1e4, "damping of the bristle"),
    ),
    force=_lugre,
    excitation=_SLIDING,
    reference="Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40 (1995)",
    rate=_lugre_rate,
    state_size=1,
    scaled=(0, 4),
)
