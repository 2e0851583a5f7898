"""Forces with an internal state: they depend on where the strut has been."""

import math
from functools import partial

from dart_model.effects.law import Effect, Floats, Motion, Parameter, Start, State, Writable
from dart_model.effects.ranges import geometric, grid, moving, of_least_stroke, of_stroke, within

_LOOPS = "loops of different amplitude and frequency"
# A loop that turned the other way would make energy out of nothing.
_LIMIT = Parameter("yield_force_n", "N", 0.0, 1e12, "largest force of the loop")
_BEND = Parameter(
    "yield_displacement_m", "m", 1e-12, 1e4, "ratio of the yield force to the initial stiffness"
)

ELEMENTS = 8
"""Slip elements of the Iwan model."""

# See friction.py: what settles faster (1/s) cannot be seen.
_FASTEST_SETTLING_PER_S = 2000.0
_LARGEST_RATIO = 1e3


def _yielding(force_ratio: float, yield_force_n: float) -> float:
    return -yield_force_n * force_ratio


def _bouc_wen_rate(
    velocity_m_per_s: float,
    force_ratio: float,
    yield_displacement_m: float,
    exponent: float,
    shape: float,
) -> float:
    speed = velocity_m_per_s / yield_displacement_m
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    ratio = min(abs(force_ratio), 1.5) ** exponent
    same_way = 1.0 if velocity_m_per_s * force_ratio > 0.0 else -1.0
    return limited * (1.0 - ratio * (shape * same_way + 1.0 - shape))


def _dahl_rate(
    velocity_m_per_s: float, force_ratio: float, yield_displacement_m: float, exponent: float
) -> float:
    speed = velocity_m_per_s / yield_displacement_m
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    rest = 1.0 - math.copysign(force_ratio, force_ratio * velocity_m_per_s)
    return limited * math.copysign(abs(rest) ** exponent, rest)


def _iwan(elements: Floats, yield_force_n: float) -> float:
    # Each state is the share of the yield force that an element carries.
    total = 0.0
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        total += min(max(elements[i], -limit), limit)
    return -yield_force_n * total


def _iwan_rate(
    velocity_m_per_s: float, elements: Floats, yield_displacement_m: float, rates: Writable
) -> None:
    # Elements of equal stiffness slip one after another, each elastic up to its limit, which it
    # approaches gradually: if it stopped there within a step, the force would have no derivative
    # by the parameters.
    speed = velocity_m_per_s / (yield_displacement_m * ELEMENTS)
    for i in range(ELEMENTS):
        limit = 2.0 * (i + 1.0) / (ELEMENTS * (ELEMENTS + 1.0))
        ahead = limit - math.copysign(elements[i], speed * elements[i])
        rates[i] = math.copysign(min(abs(speed), max(_FASTEST_SETTLING_PER_S * ahead, 0.0)), speed)


def _spring(spring_deflection_m: float, stiffness_n_per_m: float) -> float:
    return -stiffness_n_per_m * spring_deflection_m


def _maxwell_rate(
    velocity_m_per_s: float, spring_deflection_m: float, relaxation_time_s: float
) -> float:
    return velocity_m_per_s - spring_deflection_m / relaxation_time_s


def _general_bouc_wen_rate(
    velocity_m_per_s: float,
    spring_deflection_m: float,
    bend_m: float,
    exponent: float,
    angle_rad: float,
) -> float:
    # beta = cos(angle) is not negative, so that a loop dissipates energy (Erlicher and Point). With
    # gamma = sin(angle) below -beta, the slope would be unbounded: ratio and rate are limited.
    speed = velocity_m_per_s / bend_m
    limited = min(max(speed, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)
    ratio = min(abs(spring_deflection_m / bend_m), _LARGEST_RATIO) ** exponent
    same_way = 1.0 if velocity_m_per_s * spring_deflection_m > 0.0 else -1.0
    rate = limited * (1.0 - ratio * (math.cos(angle_rad) * same_way + math.sin(angle_rad)))
    return bend_m * min(max(rate, -_FASTEST_SETTLING_PER_S), _FASTEST_SETTLING_PER_S)


def _behind_play(
    deflection_m: float, coulomb_force_n: float, gap_m: float, travel_m: float
) -> float:
    beyond = max(abs(deflection_m) - 0.5 * gap_m, 0.0) / travel_m
    return -coulomb_force_n * math.copysign(min(beyond, 1.0), deflection_m)


def _behind_play_rate(
    velocity_m_per_s: float, deflection_m: float, gap_m: float, travel_m: float, exponent: float
) -> float:
    # The state is the deflection of play and elastic travel together, in m. It follows the strut
    # unless the slider slips.
    beyond = max(abs(deflection_m) - 0.5 * gap_m, 0.0) / travel_m
    if beyond <= 0.0 or velocity_m_per_s * deflection_m <= 0.0:
        return velocity_m_per_s
    if beyond > 1.0:
        # After a step that overshoots full force, the deflection returns to it.
        back = min((beyond - 1.0) * 300.0, _FASTEST_SETTLING_PER_S)
        return -math.copysign(back * travel_m, deflection_m)
    fastest = _FASTEST_SETTLING_PER_S * travel_m
    limited = min(max(velocity_m_per_s, -fastest), fastest)
    return limited * (1.0 - beyond**exponent)


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


_hysteresis = partial(Effect, family="hysteresis", excitation=_LOOPS, fits_state=True)

BOUC_WEN = _hysteresis(
    name="bouc_wen",
    words="hysteresis (Bouc-Wen)",
    parameters=(
        _LIMIT,
        _BEND,
        Parameter("exponent", "", 0.8, 10.0, "sharpness of the transition to the largest force"),
        Parameter("shape", "", 0.0, 1.0, "shape of the loop; 0.5: it unloads elastically"),
    ),
    force=_yielding,
    reference="Ikhouane and Rodellar, Systems with Hysteresis (2007)",
    rate=_bouc_wen_rate,
    states=(State("force_ratio", 1.0),),  # force over `yield_force_n`
    starts=_bouc_wen_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("dahl", "presliding_friction", "coulomb_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

DAHL = _hysteresis(
    name="dahl",
    words="hysteresis (Dahl)",
    parameters=(
        _LIMIT,
        _BEND,
        Parameter(
            "exponent",
            "",
            0.3,
            4.0,
            "the smaller it is, the sharper is the transition to the largest force",
        ),
    ),
    force=_yielding,
    reference="Dahl, Solid friction damping of mechanical vibrations, AIAA J. 14 (1976)",
    rate=_dahl_rate,
    states=(State("force_ratio", 1.0),),  # force over `yield_force_n`
    starts=_dahl_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("presliding_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

GENERAL_BOUC_WEN = _hysteresis(
    name="general_bouc_wen",
    words="hysteresis (generalised Bouc-Wen, with hardening or softening loops)",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 1e-12, 1e12, "stiffness at the start of a loop"),
        Parameter("bend_m", "m", 1e-12, 1e4, "deflection scale of the yielding"),
        Parameter("exponent", "", 0.5, 5.0, "sharpness of the transition to the largest force"),
        Parameter(
            "angle_rad",
            "rad",
            -1.5707963,
            1.5707963,
            "arctangent of gamma over beta, the two shape factors; below -pi/4 the loop hardens",
        ),
    ),
    force=_spring,
    reference="Wen, J. Eng. Mech. 102 (1976); Erlicher and Point, C. R. Mecanique 332 (2004)",
    rate=_general_bouc_wen_rate,
    states=(State("spring_deflection_m", 1e-3),),
    starts=_general_bouc_wen_starts,
    bounds=within(bend_m=_bends),
    simpler=("bouc_wen",),
    shown=("stiffness_n_per_m", "bend_m"),
)

FRICTION_BEHIND_PLAY = _hysteresis(
    name="friction_behind_play",
    words="friction in series with free play (pinched hysteresis loop)",
    parameters=(
        Parameter("coulomb_force_n", "N", 0.0, 1e12, "sliding friction"),
        Parameter("gap_m", "m", 1e-12, 1e4, "width of the play"),
        Parameter("travel_m", "m", 1e-12, 1e4, "elastic deflection at full force"),
        Parameter("exponent", "", 0.3, 4.0, "sharpness of the transition to the largest force"),
    ),
    force=_behind_play,
    reference="Baber and Noori, J. Eng. Mech. 111 (1985), pinching; Nordin and Gutman (2002)",
    rate=_behind_play_rate,
    states=(State("deflection_m", 1e-3),),
    starts=_behind_play_starts,
    bounds=within(gap_m=of_least_stroke(1e-3, 0.8), travel_m=of_stroke(1e-3, 1.0)),
    simpler=("dahl", "elastoplastic_friction", "bouc_wen"),
    shown=("coulomb_force_n", "gap_m"),
)

IWAN = _hysteresis(
    name="iwan",
    words="hysteresis (Iwan)",
    parameters=(_LIMIT, _BEND),
    force=_iwan,
    reference="Iwan, A distributed-element model for hysteresis, J. Appl. Mech. 33 (1966)",
    rate=_iwan_rate,
    states=tuple(State(f"element_{i + 1}", 1.0, group="elements") for i in range(ELEMENTS)),
    fits_state=False,
    starts=_iwan_starts,
    bounds=within(yield_displacement_m=_bends),
    simpler=("elastoplastic_friction", "linear_stiffness"),
    shown=("yield_force_n",),
)

MAXWELL = _hysteresis(
    name="maxwell",
    words="hysteresis (a Maxwell branch)",
    parameters=(
        Parameter(
            "stiffness_n_per_m",
            "N/m",
            0.0,
            1e12,
            "stiffness of the spring that is in series with a damper",
        ),
        Parameter(
            "relaxation_time_s", "s", 1e-6, 1e9, "ratio of this damper's damping to the stiffness"
        ),
    ),
    force=_spring,
    excitation="frequencies above and below 1/(2π × relaxation time)",
    reference="Flügge, Viscoelasticity (1975), 1.2",
    rate=_maxwell_rate,
    states=(State("spring_deflection_m", 0.01),),
    starts=_maxwell_starts,
    bounds=within(relaxation_time_s=lambda m: (m.step_s, m.duration_s)),
    simpler=("linear_damping", "linear_stiffness"),
    shown=("stiffness_n_per_m",),
)
