"""Forces with an internal state: they depend on where the strut has been."""

import math

from dart_model.effects.law import Effect, Floats, Motion, Parameter, Start, Writable
from dart_model.effects.ranges import geometric, grid, moving, of_least_stroke, of_stroke, within

_FAMILY = "hysteresis"
_LOOPS = "loops of different amplitude and frequency"
# A loop that turned the other way would make energy out of nothing.
_LIMIT = Parameter("yield_force_n", "N", 0.0, 1e12, "force at which the loop is fully bent")
_BEND = Parameter("yield_displacement_m", "m", 1e-12, 1e4, "travel from rest to full force")

ELEMENTS = 8
"""Slip elements of the Iwan model."""

# See friction.py: what settles faster (1/s) cannot be seen.
_FASTEST_SETTLING_PER_S = 2000.0
_LARGEST_RATIO = 1e3


def _bouc_wen(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * state[0]


def _bouc_wen_rate(
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
    # The state is the force in units of `yield_force_n`.
    speed = velocity_m_per_s / p[1]
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    ratio = min(abs(state[0]), 1.5) ** p[2]
    same_way = 1.0 if velocity_m_per_s * state[0] > 0.0 else -1.0
    out[0] = limited * (1.0 - ratio * (p[3] * same_way + 1.0 - p[3]))


def _dahl(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    return -p[0] * state[0]


def _dahl_rate(
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
    speed = velocity_m_per_s / p[1]
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    rest = 1.0 - math.copysign(state[0], state[0] * velocity_m_per_s)
    out[0] = limited * math.copysign(abs(rest) ** p[2], rest)


def _iwan(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    total = 0.0
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        total += min(max(state[i], -limit), limit)
    return -p[0] * total


def _iwan_rate(
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
    # Elements of equal stiffness slip one after another; each state is an element's share of the
    # force, elastic up to its limit. Near there it settles instead of stopping: a force that jumped
    # by where in a step it slips would have no derivative by the parameters.
    speed = velocity_m_per_s / (p[1] * ELEMENTS)
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        room = math.inf
        if velocity_m_per_s * state[i] > 0.0:
            room = max(_FASTEST_SETTLING_PER_S * (limit - abs(state[i])), 0.0)
        out[i] = math.copysign(min(abs(speed), room), speed)


def _maxwell(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    # The state is the spring's deflection in m.
    return -p[0] * state[0]


def _maxwell_rate(
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
    out[0] = velocity_m_per_s - state[0] / p[1]


def _general_bouc_wen(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    # The state is the deflection of the spring that carries the force, in m.
    return -p[0] * state[0]


def _general_bouc_wen_rate(
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
    # beta = cos(angle) is not negative, so that a loop takes energy (Erlicher and Point). With
    # gamma = sin(angle) below -beta, the slope grows without bound: both ratio and rate are held.
    speed = velocity_m_per_s / p[1]
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    ratio = min(abs(state[0] / p[1]), _LARGEST_RATIO) ** p[2]
    same_way = 1.0 if velocity_m_per_s * state[0] > 0.0 else -1.0
    rate = limited * (1.0 - ratio * (math.cos(p[3]) * same_way + math.sin(p[3])))
    out[0] = p[1] * min(max(rate, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)


def _behind_play(
    _t_s: float,
    _height_m: float,
    _velocity_m_per_s: float,
    _applied_force_n: float,
    _temperature_c: float,
    state: Floats,
    p: Floats,
    _strut: Floats,
) -> float:
    beyond = max(abs(state[0]) - 0.5 * p[1], 0.0) / p[2]
    return -p[0] * math.copysign(min(beyond, 1.0), state[0])


def _behind_play_rate(
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
    # The state is the deflection of play and elastic travel together, in m. It follows the strut
    # except while the slider is pushed further, when it is the slider that gives way.
    beyond = max(abs(state[0]) - 0.5 * p[1], 0.0) / p[2]
    if beyond <= 0.0 or velocity_m_per_s * state[0] <= 0.0:
        out[0] = velocity_m_per_s
    elif beyond > 1.0:
        # A step that overshoots full force is led back to it.
        back = min((beyond - 1.0) * 300.0, _FASTEST_SETTLING_PER_S)
        out[0] = -math.copysign(back * p[2], state[0])
    else:
        fastest = _FASTEST_SETTLING_PER_S * p[2]
        limited = min(max(velocity_m_per_s, -fastest), fastest)
        out[0] = limited * (1.0 - beyond ** p[3])


def _bends_m(motion: Motion) -> list[float]:
    return [share * motion.stroke_m for share in (0.03, 0.1, 0.3)]


def _shortest_m(motion: Motion) -> float:
    return 0.015 * motion.least_stroke_m


@moving
def _bouc_wen_starts(motion: Motion) -> list[Start]:
    loops = grid([1.0], _bends_m(motion), [1.0, 2.0], [0.5, 0.9])
    return [(1.0, _shortest_m(motion), 1.0, 0.5), *loops]


@moving
def _general_bouc_wen_starts(motion: Motion) -> list[Start]:
    softening = grid([1.0], _bends_m(motion), [1.0, 2.0], [0.25 * math.pi, -0.3])
    # A hardening loop that bends within a small share of the stroke would run away.
    longer = [share * motion.stroke_m for share in (0.1, 0.3, 1.0)]
    return [*softening, *grid([1.0], longer, [1.0, 2.0], [-0.95])]


@moving
def _behind_play_starts(motion: Motion) -> list[Start]:
    gaps = [share * motion.least_stroke_m for share in (0.03, 0.08, 0.2)]
    travels = [share * motion.stroke_m for share in (0.02, 0.1)]
    return grid([1.0], gaps, travels, [1.0])


@moving
def _dahl_starts(motion: Motion) -> list[Start]:
    return grid([1.0], [_shortest_m(motion), *_bends_m(motion)], [1.0])


@moving
def _iwan_starts(motion: Motion) -> list[Start]:
    return grid([1.0], geometric(_shortest_m(motion), 0.5 * motion.stroke_m, 8))


@moving
def _maxwell_starts(motion: Motion) -> list[Start]:
    return grid([1.0], geometric(3.0 * motion.step_s, 0.1 * motion.duration_s, 9))


def _bends(motion: Motion) -> tuple[float, float]:
    # A loop that bends within less is friction.
    return 0.012 * motion.least_stroke_m, 3.0 * motion.stroke_m


def _relaxation_times(motion: Motion) -> tuple[float, float]:
    return motion.step_s, motion.duration_s


BOUC_WEN = Effect(
    name="bouc_wen",
    family=_FAMILY,
    words="hysteresis (Bouc-Wen)",
    parameters=(
        _LIMIT,
        _BEND,
        Parameter("exponent", "", 0.8, 10.0, "sharpness of the bend"),
        Parameter("shape", "", 0.0, 1.0, "0.5: unloading is elastic"),
    ),
    force=_bouc_wen,
    excitation=_LOOPS,
    reference="Ikhouane and Rodellar, Systems with Hysteresis (2007)",
    rate=_bouc_wen_rate,
    state_scales=(1.0,),
    fits_state=True,
    starts=_bouc_wen_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("dahl", "presliding_friction", "coulomb_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

DAHL = Effect(
    name="dahl",
    family=_FAMILY,
    words="hysteresis (Dahl)",
    parameters=(_LIMIT, _BEND, Parameter("exponent", "", 0.3, 4.0, "sharpness of the bend")),
    force=_dahl,
    excitation=_LOOPS,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_dahl_rate,
    state_scales=(1.0,),
    fits_state=True,
    starts=_dahl_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("presliding_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

GENERAL_BOUC_WEN = Effect(
    name="general_bouc_wen",
    family=_FAMILY,
    words="hysteresis (Bouc-Wen, general: it may harden)",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 1e-12, 1e12, "stiffness at the start of a loop"),
        Parameter("bend_m", "m", 1e-12, 1e4, "travel by which the loop bends"),
        Parameter("exponent", "", 0.5, 5.0, "sharpness of the bend"),
        Parameter(
            "angle_rad",
            "rad",
            -1.5707963,
            1.5707963,
            "ratio of the two shape terms as an angle; below -pi/4 the loop hardens",
        ),
    ),
    force=_general_bouc_wen,
    excitation=_LOOPS,
    reference="Wen, J. Eng. Mech. 102 (1976); Erlicher and Point, C. R. Mecanique 332 (2004)",
    rate=_general_bouc_wen_rate,
    state_scales=(1e-3,),
    fits_state=True,
    starts=_general_bouc_wen_starts,
    bounds=within(bend_m=_bends),
    simpler=("bouc_wen",),
    shown=("stiffness_n_per_m", "bend_m"),
)

FRICTION_BEHIND_PLAY = Effect(
    name="friction_behind_play",
    family=_FAMILY,
    words="friction behind play (pinching)",
    parameters=(
        Parameter("coulomb_force_n", "N", 0.0, 1e12, "sliding friction"),
        Parameter("gap_m", "m", 1e-12, 1e4, "width of the play"),
        Parameter("travel_m", "m", 1e-12, 1e4, "elastic travel to full force"),
        Parameter("exponent", "", 0.3, 4.0, "sharpness of the bend"),
    ),
    force=_behind_play,
    excitation=_LOOPS,
    reference="Baber and Noori, J. Eng. Mech. 111 (1985), pinching; Nordin and Gutman (2002)",
    rate=_behind_play_rate,
    state_scales=(1e-3,),
    fits_state=True,
    starts=_behind_play_starts,
    bounds=within(gap_m=of_least_stroke(1e-3, 0.8), travel_m=of_stroke(1e-3, 1.0)),
    simpler=("dahl", "elastoplastic_friction", "bouc_wen"),
    shown=("coulomb_force_n", "gap_m"),
)

IWAN = Effect(
    name="iwan",
    family=_FAMILY,
    words="hysteresis (Iwan)",
    parameters=(_LIMIT, _BEND),
    force=_iwan,
    excitation=_LOOPS,
    reference="Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33 (1966)",
    rate=_iwan_rate,
    state_scales=(1.0,) * ELEMENTS,
    starts=_iwan_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("elastoplastic_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

MAXWELL = Effect(
    name="maxwell",
    family=_FAMILY,
    words="hysteresis (a Maxwell branch)",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 0.0, 1e12, "spring in series with a damper"),
        Parameter("relaxation_time_s", "s", 1e-6, 1e9, "damping over stiffness"),
    ),
    force=_maxwell,
    excitation="frequencies above and below the inverse of the relaxation time",
    reference="Flügge, Viscoelasticity (1975), 1.2",
    rate=_maxwell_rate,
    state_scales=(0.01,),
    fits_state=True,
    starts=_maxwell_starts,
    bounds=within(relaxation_time_s=_relaxation_times),
    simpler=("linear_damping", "linear_stiffness"),
    shown=("stiffness_n_per_m",),
)
