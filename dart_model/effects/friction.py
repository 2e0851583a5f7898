"""Dry friction.

Two kinds of law: a sign function rounded off near standstill, which creeps there, and a bristle
that bends by a fraction of a millimetre before it slides, which holds.
"""

import math
from functools import partial

from dart_model.effects.law import Effect, Motion, Parameter, Start, State
from dart_model.effects.ranges import crossing_time_s, grid, moving, of_speed, of_stroke, within

_SLIDING = "motion that reverses, with slow phases"
_COULOMB = Parameter("coulomb_force_n", "N", 0.0, 1e12, "sliding friction")
_STATIC = Parameter("static_to_coulomb", "", 1.0, 5.0, "ratio of break-away to sliding friction")
_STRIBECK = Parameter(
    "stribeck_velocity_m_per_s",
    "m/s",
    1e-12,
    1e6,
    "velocity scale of the fall from break-away to sliding friction",
)
_LOAD_SHARE = Parameter("load_share", "", 0.0, 10.0, "friction as a share of the load")
_ROUNDING = Parameter(
    "rounding_velocity_m_per_s",
    "m/s",
    1e-12,
    1e6,
    "velocity scale over which the change of sign is rounded",
)
_PRESLIDING = Parameter(
    "presliding_m", "m", 1e-12, 1e4, "deflection at which the bristle carries the sliding friction"
)

# A bristle settles at |velocity| / presliding, without bound; beyond this rate (1/s) a step of the
# integrator would have to be shorter. With the rate limited the deflection lags behind its sliding
# value by more than it should, in the ratio of the two rates: forces take the excess off. Without
# that, bristles of 27 µm left an error of 2 µm in a free run, with it 0.5 µm.
_FASTEST_SETTLING_PER_S = 2000.0
_DEFLECTION = State("deflection", 1.0)
"""Of a bristle, in units of `presliding_m`."""


def _coulomb(
    velocity_m_per_s: float, coulomb_force_n: float, rounding_velocity_m_per_s: float
) -> float:
    return -coulomb_force_n * math.tanh(velocity_m_per_s / rounding_velocity_m_per_s)


def _under_load(
    velocity_m_per_s: float,
    applied_force_n: float,
    coulomb_force_n: float,
    load_share: float,
    rounding_velocity_m_per_s: float,
) -> float:
    level = coulomb_force_n + load_share * abs(applied_force_n)
    return -level * math.tanh(velocity_m_per_s / rounding_velocity_m_per_s)


def _under_spring(
    height_m: float,
    velocity_m_per_s: float,
    free_length_m: float,
    stiffness_n_per_m: float,
    coulomb_force_n: float,
    load_share: float,
    rounding_velocity_m_per_s: float,
) -> float:
    level = coulomb_force_n + load_share * abs(stiffness_n_per_m * (height_m - free_length_m))
    return -level * math.tanh(velocity_m_per_s / rounding_velocity_m_per_s)


def _stribeck(
    velocity_m_per_s: float,
    coulomb_force_n: float,
    static_to_coulomb: float,
    stribeck_velocity_m_per_s: float,
    rounding_velocity_m_per_s: float,
) -> float:
    ratio = velocity_m_per_s / stribeck_velocity_m_per_s
    level = 1.0 + (static_to_coulomb - 1.0) * math.exp(-ratio * ratio)
    return -coulomb_force_n * level * math.tanh(velocity_m_per_s / rounding_velocity_m_per_s)


def _bristle(deflection: float, coulomb_force_n: float) -> float:
    return -coulomb_force_n * min(max(deflection, -1.0), 1.0)


def _presliding(
    velocity_m_per_s: float, deflection: float, coulomb_force_n: float, presliding_m: float
) -> float:
    limit = _FASTEST_SETTLING_PER_S * presliding_m
    excess = 1.0 - limit / max(abs(velocity_m_per_s), limit)
    lag = math.copysign(1.0, velocity_m_per_s) - deflection
    return -coulomb_force_n * min(max(deflection + excess * lag, -1.0), 1.0)


def _presliding_rate(velocity_m_per_s: float, deflection: float, presliding_m: float) -> float:
    speed = min(abs(velocity_m_per_s) / presliding_m, _FASTEST_SETTLING_PER_S)
    return math.copysign(speed, velocity_m_per_s) - speed * deflection


def _elastoplastic_rate(velocity_m_per_s: float, deflection: float, presliding_m: float) -> float:
    # Elastic up to the limit, then sliding. The deflection approaches the limit gradually: if it
    # stopped there within a step, the force would have no derivative by the parameters.
    speed = min(abs(velocity_m_per_s) / presliding_m, _FASTEST_SETTLING_PER_S)
    ahead = 1.0 - math.copysign(deflection, velocity_m_per_s * deflection)
    return math.copysign(min(speed, max(_FASTEST_SETTLING_PER_S * ahead, 0.0)), velocity_m_per_s)


def _lugre(
    velocity_m_per_s: float,
    deflection: float,
    coulomb_force_n: float,
    static_to_coulomb: float,
    stribeck_velocity_m_per_s: float,
    presliding_m: float,
    bristle_damping_n_s_per_m: float,
) -> float:
    ratio = velocity_m_per_s / stribeck_velocity_m_per_s
    level = 1.0 + (static_to_coulomb - 1.0) * math.exp(-ratio * ratio)
    speed = min(abs(velocity_m_per_s) / presliding_m, _FASTEST_SETTLING_PER_S)
    bending = (math.copysign(speed, velocity_m_per_s) - speed * deflection / level) * presliding_m
    lag = math.copysign(level, velocity_m_per_s) - deflection
    limit = _FASTEST_SETTLING_PER_S * presliding_m
    excess = 1.0 - limit / max(abs(velocity_m_per_s), limit)
    # The bristle's damping falls with speed: otherwise it would act like a viscous damper.
    return (
        -coulomb_force_n * (deflection + excess * lag)
        - bristle_damping_n_s_per_m * math.exp(-ratio * ratio) * bending
    )


def _lugre_rate(
    velocity_m_per_s: float,
    deflection: float,
    static_to_coulomb: float,
    stribeck_velocity_m_per_s: float,
    presliding_m: float,
) -> float:
    ratio = velocity_m_per_s / stribeck_velocity_m_per_s
    level = 1.0 + (static_to_coulomb - 1.0) * math.exp(-ratio * ratio)
    speed = min(abs(velocity_m_per_s) / presliding_m, _FASTEST_SETTLING_PER_S)
    return math.copysign(speed, velocity_m_per_s) - speed * deflection / level


@moving
def _coulomb_starts(motion: Motion) -> list[Start]:
    return grid([1.0], [share * motion.speed_m_per_s for share in (0.002, 0.02, 0.1)])


@moving
def _load_starts(motion: Motion) -> list[Start]:
    roundings = [share * motion.speed_m_per_s for share in (0.002, 0.02)]
    return grid([motion.force_n], [0.1, 1.0, 10.0], roundings)


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


_friction = partial(
    Effect,
    family="friction",
    excitation=_SLIDING,
    simpler=("coulomb_friction",),
    shown=("coulomb_force_n",),
)

COULOMB_FRICTION = _friction(
    name="coulomb_friction",
    words="dry friction (Coulomb)",
    parameters=(_COULOMB, _ROUNDING),
    force=_coulomb,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
    starts=_coulomb_starts,
    bounds=within(rounding_velocity_m_per_s=_ROUNDINGS),
    simpler=(),
)

_friction_under = partial(
    _friction,
    parameters=(_COULOMB, _LOAD_SHARE, _ROUNDING),
    scaled=(0, 1),
    starts=_load_starts,
    bounds=within(rounding_velocity_m_per_s=_ROUNDINGS),
    shown=("coulomb_force_n", "load_share"),
)

LOAD_FRICTION = _friction_under(
    name="load_friction",
    words="dry friction that grows with the applied force",
    force=_under_load,
    excitation="motion that reverses while the applied force is large, and while it is small",
    reference="Waiboer, Aarts, Jonker, Velocity dependence of joint friction in robotic "
    "manipulators with gear transmissions, Multibody Dynamics (2005): a gear's grows with its load",
    benches=("force_given",),
)

SPRING_LOAD_FRICTION = _friction_under(
    name="spring_load_friction",
    words="dry friction that grows with the force of the spring",
    force=_under_spring,
    excitation="motion that reverses at several heights",
    reference="Dixon, The Shock Absorber Handbook (2007), 1: the side load of a strut, and with it "
    "the friction of its guides, is proportional to the force of its spring",
    about_free_length=True,
)

STRIBECK_FRICTION = _friction(
    name="stribeck_friction",
    words="dry friction with break-away (Stribeck)",
    parameters=(_COULOMB, _STATIC, _STRIBECK, _ROUNDING),
    force=_stribeck,
    reference="Armstrong-Hélouvry, Dupont, Canudas de Wit, Automatica 30 (1994)",
    starts=_stribeck_starts,
    bounds=within(stribeck_velocity_m_per_s=_FALLS, rounding_velocity_m_per_s=_ROUNDINGS),
)

PRESLIDING_FRICTION = _friction(
    name="presliding_friction",
    words="dry friction with presliding (Dahl's bristle)",
    parameters=(_COULOMB, _PRESLIDING),
    force=_presliding,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_presliding_rate,
    states=(_DEFLECTION,),
    fits_state=True,
    starts=_bristle_starts,
    bounds=within(presliding_m=_DEFLECTIONS),
)

ELASTOPLASTIC_FRICTION = _friction(
    name="elastoplastic_friction",
    words="dry friction that holds at rest (elastoplastic bristle)",
    parameters=(_COULOMB, _PRESLIDING),
    force=_bristle,
    reference="Dupont, Hayward, Armstrong, Altpeter, IEEE TAC 47 (2002)",
    rate=_elastoplastic_rate,
    states=(_DEFLECTION,),
    fits_state=True,
    starts=_bristle_starts,
    bounds=within(presliding_m=_DEFLECTIONS),
)

LUGRE_FRICTION = _friction(
    name="lugre_friction",
    words="dry friction with break-away and presliding (LuGre)",
    parameters=(
        _COULOMB,
        _STATIC,
        _STRIBECK,
        _PRESLIDING,
        Parameter("bristle_damping_n_s_per_m", "N·s/m", 0.0, 1e12, "damping of the bristle"),
    ),
    force=_lugre,
    reference="Canudas de Wit, Olsson, Åström, Lischinsky, IEEE TAC 40 (1995)",
    rate=_lugre_rate,
    scaled=(0, 4),
    states=(_DEFLECTION,),
    fits_state=True,
    starts=_lugre_starts,
    bounds=within(stribeck_velocity_m_per_s=_FALLS, presliding_m=_DEFLECTIONS),
    simpler=("presliding_friction", "stribeck_friction"),
)
