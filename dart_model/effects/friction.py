"""Dry friction.

Two kinds of law: a sign function rounded off near standstill, which creeps there, and a bristle
that bends by a fraction of a millimetre before it slides, which holds.
"""

import math

from dart_model.effects.law import Effect, Floats, Motion, Parameter, Start, Writable
from dart_model.effects.ranges import crossing_time_s, grid, moving, of_speed, of_stroke, within

_FAMILY = "friction"
_SLIDING = "motion that changes direction, and slow passages"
_COULOMB = Parameter("coulomb_force_n", "N", 0.0, 1e12, "sliding friction")
_STATIC = Parameter("static_to_coulomb", "", 1.0, 5.0, "break-away over sliding friction")
_STRIBECK = Parameter("stribeck_velocity_m_per_s", "m/s", 1e-12, 1e6, "where friction has fallen")
_ROUNDING = Parameter("rounding_velocity_m_per_s", "m/s", 1e-12, 1e6, "width of the rounded sign")
_PRESLIDING = Parameter("presliding_m", "m", 1e-12, 1e4, "deflection at which sliding begins")

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
    # Elastic up to the limit, then sliding. Near the limit it settles instead of stopping: a force
    # that jumped by where in a step it slips would have no derivative by the parameters.
    speed = min(abs(velocity_m_per_s) / p[1], _FASTEST_SETTLING_PER_S)
    if velocity_m_per_s * state[0] > 0.0:
        speed = min(speed, max(_FASTEST_SETTLING_PER_S * (1.0 - abs(state[0])), 0.0))
    out[0] = math.copysign(speed, velocity_m_per_s)


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


@moving
def _coulomb_starts(motion: Motion) -> list[Start]:
    return grid([1.0], [share * motion.speed_m_per_s for share in (0.002, 0.02, 0.1)])


@moving
def _stribeck_starts(motion: Motion) -> list[Start]:
    falls = [share * motion.speed_m_per_s for share in (0.05, 0.1, 0.3, 1.0)]
    roundings = [share * motion.speed_m_per_s for share in (0.01, 0.03)]
    return grid([1.0], [1.3], falls, roundings)


def _bristles_m(motion: Motion) -> list[float]:
    return [share * motion.stroke_m for share in (1e-4, 5e-4, 2e-3, 8e-3)]


@moving
def _bristle_starts(motion: Motion) -> list[Start]:
    return grid([1.0], _bristles_m(motion))


@moving
def _lugre_starts(motion: Motion) -> list[Start]:
    # The bristle itself settles long before the strut has crossed its stroke.
    settling_s = 0.005 * crossing_time_s(motion)
    return [
        (1.0, 1.2, share * motion.speed_m_per_s, bristle_m, settling_s / bristle_m)
        for share in (0.05, 0.2)
        for bristle_m in _bristles_m(motion)[:2]
    ]


_FALLS = of_speed(0.01, 2.0)
# Friction that is rounded off, or bends, by more than this is damping or hysteresis.
_ROUNDINGS = of_speed(5e-4, 0.12)
_DEFLECTIONS = of_stroke(1e-5, 0.012)


COULOMB_FRICTION = Effect(
    name="coulomb_friction",
    family=_FAMILY,
    words="dry friction (Coulomb)",
    parameters=(_COULOMB, _ROUNDING),
    force=_coulomb,
    excitation=_SLIDING,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
    starts=_coulomb_starts,
    bounds=within(rounding_velocity_m_per_s=_ROUNDINGS),
    shown=("coulomb_force_n",),
)

STRIBECK_FRICTION = Effect(
    name="stribeck_friction",
    family=_FAMILY,
    words="dry friction with break-away (Stribeck)",
    parameters=(_COULOMB, _STATIC, _STRIBECK, _ROUNDING),
    force=_stribeck,
    excitation=_SLIDING,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
    starts=_stribeck_starts,
    bounds=within(stribeck_velocity_m_per_s=_FALLS, rounding_velocity_m_per_s=_ROUNDINGS),
    simpler=("coulomb_friction",),
    shown=("coulomb_force_n",),
)

PRESLIDING_FRICTION = Effect(
    name="presliding_friction",
    family=_FAMILY,
    words="dry friction with presliding (Dahl's bristle)",
    parameters=(_COULOMB, _PRESLIDING),
    force=_presliding,
    excitation=_SLIDING,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_presliding_rate,
    state_scales=(1.0,),
    fits_state=True,
    starts=_bristle_starts,
    bounds=within(presliding_m=_DEFLECTIONS),
    simpler=("coulomb_friction",),
    shown=("coulomb_force_n",),
)

ELASTOPLASTIC_FRICTION = Effect(
    name="elastoplastic_friction",
    family=_FAMILY,
    words="dry friction that holds at rest (elastoplastic bristle)",
    parameters=(_COULOMB, _PRESLIDING),
    force=_elastoplastic,
    excitation=_SLIDING,
    reference="Dupont, Hayward, Armstrong, Altpeter, IEEE TAC 47 (2002)",
    rate=_elastoplastic_rate,
    state_scales=(1.0,),
    fits_state=True,
    starts=_bristle_starts,
    bounds=within(presliding_m=_DEFLECTIONS),
    simpler=("coulomb_friction",),
    shown=("coulomb_force_n",),
)

LUGRE_FRICTION = Effect(
    name="lugre_friction",
    family=_FAMILY,
    words="dry friction with break-away and presliding (LuGre)",
    parameters=(
        _COULOMB,
        _STATIC,
        _STRIBECK,
        _PRESLIDING,
        Parameter("bristle_damping_n_s_per_m", "N·s/m", 0.0, 1e12, "damping of the bristle"),
    ),
    force=_lugre,
    excitation=_SLIDING,
    reference="Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40 (1995)",
    rate=_lugre_rate,
    scaled=(0, 4),
    state_scales=(1.0,),
    fits_state=True,
    starts=_lugre_starts,
    bounds=within(stribeck_velocity_m_per_s=_FALLS, presliding_m=_DEFLECTIONS),
    simpler=("presliding_friction", "stribeck_friction"),
    shown=("coulomb_force_n",),
)
