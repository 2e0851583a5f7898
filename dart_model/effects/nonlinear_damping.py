"""Dampers whose force is not proportional to velocity."""

import math
from functools import partial

from dart_model.effects.law import Effect, Motion, Parameter, Start
from dart_model.effects.ranges import (
    Starts,
    always,
    grid,
    height,
    moving,
    of_speed,
    of_stroke,
    within,
)

_FRICTION = "coulomb_friction"
"""What a damper with a knee is where the motion is hardly ever as slow as that."""
_SPEEDS = "velocities that differ by a factor of three or more, in both directions"
_PLACES = "the same velocities at different heights"
_DAMPING = Parameter("damping_n_s_per_m", "N·s/m", -1e12, 1e12, "damping at low velocity")
_KNEE = Parameter("knee_velocity_m_per_s", "m/s", 1e-12, 1e6, "velocity of the knee")
_LOST_DAMPING = Parameter(
    "lost_damping_n_s_per_m", "N·s/m", -1e12, 1e12, "reduction of the damping beyond the knee"
)


def _quadratic(velocity_m_per_s: float, damping_n_s2_per_m2: float) -> float:
    return -damping_n_s2_per_m2 * abs(velocity_m_per_s) * velocity_m_per_s


def _power(velocity_m_per_s: float, force_at_1_m_per_s_n: float, exponent: float) -> float:
    return -force_at_1_m_per_s_n * math.copysign(
        abs(velocity_m_per_s) ** exponent, velocity_m_per_s
    )


def _asymmetric(
    velocity_m_per_s: float, compression_n_s_per_m: float, rebound_n_s_per_m: float
) -> float:
    return (
        -(rebound_n_s_per_m if velocity_m_per_s > 0.0 else compression_n_s_per_m) * velocity_m_per_s
    )


def _directional(
    velocity_m_per_s: float,
    compression_at_1_m_per_s_n: float,
    compression_exponent: float,
    rebound_at_1_m_per_s_n: float,
    rebound_exponent: float,
) -> float:
    if velocity_m_per_s > 0.0:
        return -rebound_at_1_m_per_s_n * velocity_m_per_s**rebound_exponent
    return compression_at_1_m_per_s_n * (-velocity_m_per_s) ** compression_exponent


def _digressive(
    velocity_m_per_s: float, damping_n_s_per_m: float, knee_velocity_m_per_s: float
) -> float:
    ratio = velocity_m_per_s / knee_velocity_m_per_s
    return -damping_n_s_per_m * velocity_m_per_s / math.sqrt(1.0 + ratio * ratio)


def _saturating(
    velocity_m_per_s: float,
    damping_n_s_per_m: float,
    knee_velocity_m_per_s: float,
    sharpness: float,
) -> float:
    ratio = abs(velocity_m_per_s / knee_velocity_m_per_s)
    if ratio < 1e-9:
        return -damping_n_s_per_m * velocity_m_per_s
    return -damping_n_s_per_m * velocity_m_per_s * (1.0 + ratio**sharpness) ** (-1.0 / sharpness)


def _arctan(
    velocity_m_per_s: float, damping_n_s_per_m: float, knee_velocity_m_per_s: float
) -> float:
    return (
        -damping_n_s_per_m
        * knee_velocity_m_per_s
        * math.atan(velocity_m_per_s / knee_velocity_m_per_s)
    )


def _blow_off(
    velocity_m_per_s: float, lost_damping_n_s_per_m: float, knee_velocity_m_per_s: float
) -> float:
    return lost_damping_n_s_per_m * math.copysign(
        max(abs(velocity_m_per_s) - knee_velocity_m_per_s, 0.0), velocity_m_per_s
    )


def _smooth_blow_off(
    velocity_m_per_s: float, lost_damping_n_s_per_m: float, knee_velocity_m_per_s: float
) -> float:
    ratio = velocity_m_per_s / knee_velocity_m_per_s
    return lost_damping_n_s_per_m * velocity_m_per_s * (1.0 - 1.0 / math.sqrt(1.0 + ratio * ratio))


def _valves(
    velocity_m_per_s: float,
    lost_compression_n_s_per_m: float,
    compression_knee_m_per_s: float,
    added_rebound_n_s_per_m: float,
    lost_rebound_n_s_per_m: float,
    rebound_knee_m_per_s: float,
    sharpness: float,
) -> float:
    if velocity_m_per_s > 0.0:
        ratio = velocity_m_per_s / rebound_knee_m_per_s
        share = 1.0 - (1.0 + ratio**sharpness) ** (-1.0 / sharpness)
        return (lost_rebound_n_s_per_m * share - added_rebound_n_s_per_m) * velocity_m_per_s
    ratio = -velocity_m_per_s / compression_knee_m_per_s
    share = 1.0 - (1.0 + ratio**sharpness) ** (-1.0 / sharpness)
    return lost_compression_n_s_per_m * share * velocity_m_per_s


def _over_stroke(
    height_m: float, velocity_m_per_s: float, free_length_m: float, damping_n_s_per_m2: float
) -> float:
    return -damping_n_s_per_m2 * (height_m - free_length_m) * velocity_m_per_s


def _over_squared_stroke(
    height_m: float, velocity_m_per_s: float, free_length_m: float, damping_n_s_per_m3: float
) -> float:
    x = height_m - free_length_m
    return -damping_n_s_per_m3 * x * x * velocity_m_per_s


def _zone(
    height_m: float,
    velocity_m_per_s: float,
    damping_n_s_per_m: float,
    centre_height_m: float,
    width_m: float,
) -> float:
    ratio = (height_m - centre_height_m) / width_m
    return -damping_n_s_per_m * math.exp(-ratio * ratio) * velocity_m_per_s


def _end_zone(
    height_m: float, velocity_m_per_s: float, damping_n_s_per_m2: float, zone_height_m: float
) -> float:
    return -damping_n_s_per_m2 * max(zone_height_m - height_m, 0.0) * velocity_m_per_s


def _knees(*shares: float) -> Starts:
    def starts(motion: Motion) -> list[Start]:
        return [(1.0, share * motion.speed_m_per_s) for share in shares]

    return moving(starts)


@moving
def _valve_starts(motion: Motion) -> list[Start]:
    # Lost in compression, added and lost in rebound: alike, and more or less in rebound.
    shapes = [(1.0, 0.0, 1.0), (1.0, 1.0, 2.0), (2.0, -1.0, 1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)]
    return [
        (compression, share * motion.speed_m_per_s, added, lost, share * motion.speed_m_per_s, 3.0)
        for compression, added, lost in shapes
        for share in (0.2, 0.6)
    ]


@moving
def _saturating_starts(motion: Motion) -> list[Start]:
    return grid([1.0], [0.3 * motion.speed_m_per_s, motion.speed_m_per_s], [1.0, 4.0])


@moving
def _zone_starts(motion: Motion) -> list[Start]:
    widths = [0.1 * motion.stroke_m, 0.3 * motion.stroke_m]
    return grid([1.0], motion.heights_m(0.1, 0.3, 0.5, 0.7, 0.9), widths)


@moving
def _end_zone_starts(motion: Motion) -> list[Start]:
    # A zone that begins below all heights is never entered.
    free = [motion.free_length_m] if motion.free_length_m > motion.low_m else []
    return grid([1.0], [*free, *motion.heights_m(0.2, 0.4, 0.6, 0.8)])


def _zone_heights(motion: Motion) -> tuple[float, float]:
    margin = 0.02 * motion.stroke_m
    return motion.low_m - margin, max(motion.high_m, motion.free_length_m) + margin


_damper = partial(
    Effect, family="nonlinear_damping", excitation=_SPEEDS, simpler=("linear_damping",)
)

QUADRATIC_DAMPING = _damper(
    name="quadratic_damping",
    words="a non-linear damper (quadratic, orifice flow)",
    parameters=(
        Parameter(
            "damping_n_s2_per_m2",
            "N·s²/m²",
            -1e18,
            1e18,
            "force against the motion per squared velocity",
        ),
    ),
    force=_quadratic,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.9, orifice flow",
    starts=always((1.0,)),
    shown=("damping_n_s2_per_m2",),
)

POWER_DAMPING = _damper(
    name="power_damping",
    words="a non-linear damper (power law)",
    parameters=(
        Parameter("force_at_1_m_per_s_n", "N", -1e18, 1e18, "force against the motion at 1 m/s"),
        Parameter("exponent", "", 0.3, 4.0, "exponent of the velocity"),
    ),
    force=_power,
    reference="Symans et al., J. Struct. Eng. 134 (2008), non-linear viscous damper",
    starts=always((1.0, 0.5), (1.0, 1.5), (1.0, 2.5)),
    simpler=("linear_damping", "quadratic_damping"),
    shown=("force_at_1_m_per_s_n",),
)

ASYMMETRIC_DAMPING = _damper(
    name="asymmetric_damping",
    words="a non-linear damper (rebound and compression differ)",
    parameters=(
        Parameter("compression_n_s_per_m", "N·s/m", -1e12, 1e12, "damping in compression"),
        Parameter("rebound_n_s_per_m", "N·s/m", -1e12, 1e12, "damping in rebound"),
    ),
    force=_asymmetric,
    reference="Dixon, The Shock Absorber Handbook (2007), 7.2",
    scaled=(0, 1),
    starts=always((1.0, 0.0), (0.0, 1.0), (1.0, -1.0)),
    shown=("compression_n_s_per_m", "rebound_n_s_per_m"),
)

DIRECTIONAL_DAMPING = _damper(
    name="directional_damping",
    words="a non-linear damper (rebound and compression, each by a power law)",
    parameters=(
        Parameter("compression_at_1_m_per_s_n", "N", -1e18, 1e18, "force in compression at 1 m/s"),
        Parameter("compression_exponent", "", 0.3, 4.0, "exponent of the velocity in compression"),
        Parameter("rebound_at_1_m_per_s_n", "N", -1e18, 1e18, "pull in rebound at 1 m/s"),
        Parameter("rebound_exponent", "", 0.3, 4.0, "exponent of the velocity in rebound"),
    ),
    force=_directional,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.9 and 7.2, valves of each direction",
    scaled=(0, 2),
    starts=always(
        (1.0, 0.5, 1.0, 2.0),
        (1.0, 2.0, 1.0, 0.5),
        (1.0, 0.5, 0.0, 1.0),
        (0.0, 1.0, 1.0, 0.5),
        (1.0, 2.0, 0.0, 1.0),
        (0.0, 1.0, 1.0, 2.0),
    ),
    simpler=("asymmetric_damping", "power_damping"),
    shown=("compression_at_1_m_per_s_n", "rebound_at_1_m_per_s_n"),
)

DIGRESSIVE_DAMPING = _damper(
    name="digressive_damping",
    words="a non-linear damper (digressive, towards a constant force)",
    parameters=(_DAMPING, _KNEE),
    force=_digressive,
    reference="Dixon, The Shock Absorber Handbook (2007), 7.3",
    starts=_knees(0.2, 0.6, 1.5),
    bounds=within(knee_velocity_m_per_s=of_speed(0.08, 6.0)),
    simpler=("linear_damping", _FRICTION),
    shown=("damping_n_s_per_m",),
)

SATURATING_DAMPING = _damper(
    name="saturating_damping",
    words="a non-linear damper (saturating)",
    parameters=(_DAMPING, _KNEE, Parameter("sharpness", "", 0.5, 12.0, "sharpness of the knee")),
    force=_saturating,
    reference="Dixon, The Shock Absorber Handbook (2007), 7.3",
    starts=_saturating_starts,
    bounds=within(knee_velocity_m_per_s=of_speed(0.08, 6.0)),
    simpler=("linear_damping", _FRICTION, "digressive_damping"),
    shown=("damping_n_s_per_m",),
)

ARCTAN_DAMPING = _damper(
    name="arctan_damping",
    words="a non-linear damper (arctangent)",
    parameters=(_DAMPING, _KNEE),
    force=_arctan,
    reference="Duym, Vehicle Syst. Dyn. 33 (2000), simulation tools for shock absorbers",
    starts=_knees(0.2, 0.6, 1.5),
    bounds=within(knee_velocity_m_per_s=of_speed(0.08, 6.0)),
    simpler=("linear_damping", _FRICTION),
    shown=("damping_n_s_per_m",),
)

BLOW_OFF_DAMPING = _damper(
    name="blow_off_damping",
    words="a non-linear damper (blow-off valve, smaller slope above a sharp knee)",
    parameters=(_LOST_DAMPING, _KNEE),
    force=_blow_off,
    reference="Dixon, The Shock Absorber Handbook (2007), 7.3, blow-off valve",
    starts=_knees(0.2, 0.5, 1.0, 1.8),
    bounds=within(knee_velocity_m_per_s=of_speed(0.08, 6.0)),
    simpler=("linear_damping", _FRICTION),
    shown=("lost_damping_n_s_per_m",),
)

SMOOTH_BLOW_OFF_DAMPING = _damper(
    name="smooth_blow_off_damping",
    words="a non-linear damper (blow-off valve, smaller slope above a rounded knee)",
    parameters=(_LOST_DAMPING, _KNEE),
    force=_smooth_blow_off,
    reference="Dixon, The Shock Absorber Handbook (2007), 7.3, blow-off valve",
    starts=_knees(0.2, 0.6, 1.5),
    bounds=within(knee_velocity_m_per_s=of_speed(0.08, 6.0)),
    simpler=("linear_damping", _FRICTION),
    shown=("lost_damping_n_s_per_m",),
)

VALVE_DAMPING = _damper(
    name="valve_damping",
    words="a non-linear damper (a blow-off valve in each direction)",
    parameters=(
        Parameter(
            "lost_compression_n_s_per_m", "N·s/m", -1e12, 1e12,
            "reduction of the damping beyond the knee in compression",
        ),
        Parameter(
            "compression_knee_m_per_s", "m/s", 1e-12, 1e6, "velocity of the knee in compression"
        ),
        Parameter(
            "added_rebound_n_s_per_m", "N·s/m", -1e12, 1e12,
            "damping at low velocity in rebound less that in compression",
        ),
        Parameter(
            "lost_rebound_n_s_per_m", "N·s/m", -1e12, 1e12,
            "reduction of the damping beyond the knee in rebound",
        ),
        Parameter("rebound_knee_m_per_s", "m/s", 1e-12, 1e6, "velocity of the knee in rebound"),
        Parameter("sharpness", "", 2.0, 12.0, "sharpness of both knees"),
    ),
    force=_valves,
    reference="Dixon, The Shock Absorber Handbook (2007), 6.9 and 7.3, valves of each direction",
    scaled=(0, 2, 3),
    starts=_valve_starts,
    bounds=within(
        compression_knee_m_per_s=of_speed(0.08, 6.0), rebound_knee_m_per_s=of_speed(0.08, 6.0)
    ),
    simpler=("asymmetric_damping", "blow_off_damping", "smooth_blow_off_damping"),
    shown=("lost_compression_n_s_per_m", "added_rebound_n_s_per_m", "lost_rebound_n_s_per_m"),
)  # fmt: skip

STROKE_DAMPING = _damper(
    name="stroke_damping",
    words="a non-linear damper (damping proportional to the deflection)",
    parameters=(
        Parameter(
            "damping_n_s_per_m2",
            "N·s/m²",
            -1e18,
            1e18,
            "damping per metre of height above the free length",
        ),
    ),
    force=_over_stroke,
    excitation=_PLACES,
    reference="Dixon, The Shock Absorber Handbook (2007), 8.3, position-dependent damping",
    starts=always((1.0,)),
    shown=("damping_n_s_per_m2",),
)

POSITION_DEPENDENT_DAMPING = _damper(
    name="position_dependent_damping",
    words="a non-linear damper (damping proportional to the squared deflection)",
    parameters=(
        Parameter("damping_n_s_per_m3", "N·s/m³", -1e18, 1e18, "damping per squared deflection"),
    ),
    force=_over_squared_stroke,
    excitation=_PLACES,
    reference="van der Pol, Phil. Mag. 2 (1926); Dixon (2007), 8.3",
    starts=always((1.0,)),
    shown=("damping_n_s_per_m3",),
    about_free_length=True,
)

ZONE_DAMPING = _damper(
    name="zone_damping",
    words="a non-linear damper (in a zone of the travel)",
    parameters=(
        Parameter("damping_n_s_per_m", "N·s/m", -1e12, 1e12, "damping in the middle of the zone"),
        Parameter("centre_height_m", "m", -1e4, 1e4, "middle of the zone"),
        Parameter(
            "width_m",
            "m",
            1e-12,
            1e4,
            "distance from the middle at which the damping has fallen to 37 %",
        ),
    ),
    force=_zone,
    excitation=_PLACES,
    reference="Dixon, The Shock Absorber Handbook (2007), 8.3, position-dependent damping",
    starts=_zone_starts,
    bounds=within(centre_height_m=height(-1.0, 2.0), width_m=of_stroke(0.03, 1.5)),
    shown=("damping_n_s_per_m",),
)

END_ZONE_DAMPING = _damper(
    name="end_zone_damping",
    words="a non-linear damper (hydraulic end stop)",
    parameters=(
        Parameter(
            "damping_n_s_per_m2", "N·s/m²", -1e18, 1e18, "damping per metre of depth in the zone"
        ),
        Parameter(
            "zone_height_m", "m", -1e4, 1e4, "height at which the zone begins; it extends downwards"
        ),
    ),
    force=_end_zone,
    excitation=_PLACES,
    reference="Dixon, The Shock Absorber Handbook (2007), 8.3, hydraulic bump stop",
    starts=_end_zone_starts,
    bounds=within(zone_height_m=_zone_heights),
    shown=("damping_n_s_per_m2",),
)
