"""End stops, which push but never pull."""

from collections.abc import Callable, Sequence
from functools import partial

from dart_model.effects.law import Effect, Motion, Parameter, Start
from dart_model.effects.ranges import (
    Starts,
    crossing_time_s,
    dissipation,
    grid,
    height,
    moving,
    slowness_s_per_m,
    within,
)

_CONTACT = Parameter("contact_height_m", "m", -1e4, 1e4, "height at which the stop is touched")
_BUMP = "several contacts at the bump stop"
_REBOUND = "several contacts at the rebound stop"
_HUNT_CROSSLEY = "Hunt and Crossley, J. Appl. Mech. 42 (1975)"
_KELVIN_VOIGT = "Goldsmith, Impact (1960), 4; Kelvin-Voigt contact"


def _bump(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    stiffness_n_per_m: float,
    damping_n_s_per_m: float,
) -> float:
    depth = contact_height_m - height_m
    if depth <= 0.0:
        return 0.0
    return max(stiffness_n_per_m * depth - damping_n_s_per_m * velocity_m_per_s, 0.0)


def _rebound(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    stiffness_n_per_m: float,
    damping_n_s_per_m: float,
) -> float:
    depth = height_m - contact_height_m
    if depth <= 0.0:
        return 0.0
    return -max(stiffness_n_per_m * depth + damping_n_s_per_m * velocity_m_per_s, 0.0)


def _hertz_bump(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    contact_stiffness_n_per_m1_5: float,
    dissipation_s_per_m: float,
) -> float:
    depth = contact_height_m - height_m
    if depth <= 0.0:
        return 0.0
    return max(
        contact_stiffness_n_per_m1_5 * depth**1.5 * (1.0 - dissipation_s_per_m * velocity_m_per_s),
        0.0,
    )


def _hertz_rebound(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    contact_stiffness_n_per_m1_5: float,
    dissipation_s_per_m: float,
) -> float:
    depth = height_m - contact_height_m
    if depth <= 0.0:
        return 0.0
    return -max(
        contact_stiffness_n_per_m1_5 * depth**1.5 * (1.0 + dissipation_s_per_m * velocity_m_per_s),
        0.0,
    )


def _power_bump(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    force_at_10_mm_n: float,
    exponent: float,
    dissipation_s_per_m: float,
) -> float:
    depth = contact_height_m - height_m
    if depth <= 0.0:
        return 0.0
    return max(
        force_at_10_mm_n
        * (depth / 0.01) ** exponent
        * (1.0 - dissipation_s_per_m * velocity_m_per_s),
        0.0,
    )


def _power_rebound(
    height_m: float,
    velocity_m_per_s: float,
    contact_height_m: float,
    force_at_10_mm_n: float,
    exponent: float,
    dissipation_s_per_m: float,
) -> float:
    depth = height_m - contact_height_m
    if depth <= 0.0:
        return 0.0
    return -max(
        force_at_10_mm_n
        * (depth / 0.01) ** exponent
        * (1.0 + dissipation_s_per_m * velocity_m_per_s),
        0.0,
    )


def _ends(
    height_m: float,
    velocity_m_per_s: float,
    low_contact_height_m: float,
    high_contact_height_m: float,
    stiffness_n_per_m: float,
    damping_n_s_per_m: float,
) -> float:
    low = low_contact_height_m - height_m
    high = height_m - high_contact_height_m
    force = 0.0
    if low > 0.0:
        force += max(stiffness_n_per_m * low - damping_n_s_per_m * velocity_m_per_s, 0.0)
    if high > 0.0:
        force -= max(stiffness_n_per_m * high + damping_n_s_per_m * velocity_m_per_s, 0.0)
    return force


def _hertz_ends(
    height_m: float,
    velocity_m_per_s: float,
    low_contact_height_m: float,
    high_contact_height_m: float,
    contact_stiffness_n_per_m1_5: float,
    dissipation_s_per_m: float,
) -> float:
    low = low_contact_height_m - height_m
    high = height_m - high_contact_height_m
    force = 0.0
    if low > 0.0:
        force += max(
            contact_stiffness_n_per_m1_5
            * low**1.5
            * (1.0 - dissipation_s_per_m * velocity_m_per_s),
            0.0,
        )
    if high > 0.0:
        force -= max(
            contact_stiffness_n_per_m1_5
            * high**1.5
            * (1.0 + dissipation_s_per_m * velocity_m_per_s),
            0.0,
        )
    return force


def _contacts(
    shares: Sequence[float],
    usual: Callable[[Motion], float],
    factors: Sequence[float],
    *exponents: Sequence[float],
) -> Starts:
    """Contacts at shares of the stroke, with factors of a usual damping or dissipation."""

    def starts(motion: Motion) -> list[Start]:
        dissipations = [factor * usual(motion) for factor in factors]
        return grid(motion.heights_m(*shares), [1.0], *exponents, dissipations)

    return moving(starts)


def _both_ends_m(motion: Motion) -> list[tuple[float, float]]:
    lows, highs = motion.heights_m(0.04, 0.1, 0.18), motion.heights_m(0.96, 0.9, 0.82)
    return list(zip(lows, highs, strict=True))


@moving
def _ends_starts(motion: Motion) -> list[Start]:
    return [(*ends, 1.0, 0.02 * crossing_time_s(motion)) for ends in _both_ends_m(motion)]


@moving
def _hertz_ends_starts(motion: Motion) -> list[Start]:
    return [(*ends, 1.0, 0.05 * slowness_s_per_m(motion)) for ends in _both_ends_m(motion)]


# A stop that is never touched has no force. One that is touched over more than half of the stroke
# is a spring there, and belongs to no end.
_TOUCHED_BELOW = height(-0.02, 0.5)
_TOUCHED_ABOVE = height(0.5, 1.02)
_LOW_END = height(-0.02, 0.3)
_HIGH_END = height(0.7, 1.02)


_LOW = Parameter("low_contact_height_m", "m", -1e4, 1e4, "height of the bump stop")
_HIGH = Parameter("high_contact_height_m", "m", -1e4, 1e4, "height of the rebound stop")
_EDGES = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0))

_LINEAR = (
    _CONTACT,
    Parameter("stiffness_n_per_m", "N/m", 1e-12, 1e12, "stiffness in contact"),
    Parameter("damping_n_s_per_m", "N·s/m", 0.0, 1e12, "damping in contact"),
)
_HERTZ = (
    _CONTACT,
    Parameter("contact_stiffness_n_per_m1_5", "N/m^1.5", 1e-12, 1e18, "Hertzian stiffness"),
    Parameter(
        "dissipation_s_per_m",
        "s/m",
        0.0,
        1e12,
        "relative increase of the force per m/s of closing speed",
    ),
)
_POWER = (
    _CONTACT,
    Parameter("force_at_10_mm_n", "N", 1e-12, 1e24, "force at a depth of 10 mm"),
    Parameter("exponent", "", 0.8, 4.0, "exponent of the depth"),
    Parameter(
        "dissipation_s_per_m",
        "s/m",
        0.0,
        1e12,
        "relative increase of the force per m/s of closing speed",
    ),
)

_stop = partial(Effect, family="stop", scaled=(1,))

BUMP_STOP = _stop(
    name="bump_stop",
    words="a bump stop",
    parameters=_LINEAR,
    force=_bump,
    excitation=_BUMP,
    reference=_KELVIN_VOIGT,
    scaled=(1, 2),
    starts=_contacts((0.03, 0.07, 0.12, 0.18, 0.26, 0.36), crossing_time_s, (0.01, 0.1)),
    bounds=within(contact_height_m=_TOUCHED_BELOW),
    shown=("contact_height_m", "stiffness_n_per_m"),
)

REBOUND_STOP = _stop(
    name="rebound_stop",
    words="a rebound stop",
    parameters=_LINEAR,
    force=_rebound,
    excitation=_REBOUND,
    reference=_KELVIN_VOIGT,
    scaled=(1, 2),
    starts=_contacts((0.97, 0.93, 0.88, 0.82, 0.74, 0.64), crossing_time_s, (0.01, 0.1)),
    bounds=within(contact_height_m=_TOUCHED_ABOVE),
    shown=("contact_height_m", "stiffness_n_per_m"),
)

HERTZ_BUMP_STOP = _stop(
    name="hertz_bump_stop",
    words="a bump stop (Hertzian contact)",
    parameters=_HERTZ,
    force=_hertz_bump,
    excitation=_BUMP,
    reference=_HUNT_CROSSLEY,
    starts=_contacts((0.04, 0.1, 0.16, 0.24, 0.36), slowness_s_per_m, (0.01, 0.1)),
    bounds=within(contact_height_m=_TOUCHED_BELOW, dissipation_s_per_m=dissipation),
    shown=("contact_height_m",),
)

HERTZ_REBOUND_STOP = _stop(
    name="hertz_rebound_stop",
    words="a rebound stop (Hertzian contact)",
    parameters=_HERTZ,
    force=_hertz_rebound,
    excitation=_REBOUND,
    reference=_HUNT_CROSSLEY,
    starts=_contacts((0.96, 0.9, 0.84, 0.76, 0.64), slowness_s_per_m, (0.01, 0.1)),
    bounds=within(contact_height_m=_TOUCHED_ABOVE, dissipation_s_per_m=dissipation),
    shown=("contact_height_m",),
)

POWER_BUMP_STOP = _stop(
    name="power_bump_stop",
    words="a bump stop (power law, like rubber)",
    parameters=_POWER,
    force=_power_bump,
    excitation=_BUMP,
    reference=_HUNT_CROSSLEY,
    starts=_contacts((0.05, 0.15, 0.3), slowness_s_per_m, (0.03,), (1.0, 2.0)),
    bounds=within(contact_height_m=_TOUCHED_BELOW, dissipation_s_per_m=dissipation),
    simpler=("bump_stop", "hertz_bump_stop"),
    shown=("contact_height_m", "force_at_10_mm_n"),
)

POWER_REBOUND_STOP = _stop(
    name="power_rebound_stop",
    words="a rebound stop (power law, like rubber)",
    parameters=_POWER,
    force=_power_rebound,
    excitation=_REBOUND,
    reference=_HUNT_CROSSLEY,
    starts=_contacts((0.95, 0.85, 0.7), slowness_s_per_m, (0.03,), (1.0, 2.0)),
    bounds=within(contact_height_m=_TOUCHED_ABOVE, dissipation_s_per_m=dissipation),
    simpler=("rebound_stop", "hertz_rebound_stop"),
    shown=("contact_height_m", "force_at_10_mm_n"),
)

END_STOPS = _stop(
    name="end_stops",
    words="a bump stop and a rebound stop",
    parameters=(_LOW, _HIGH, *_LINEAR[1:]),
    force=_ends,
    excitation="several contacts at both stops",
    reference=_KELVIN_VOIGT,
    scaled=(2, 3),
    starts=_ends_starts,
    bounds=within(low_contact_height_m=_LOW_END, high_contact_height_m=_HIGH_END),
    simpler=("bump_stop", "rebound_stop"),
    shown=("low_contact_height_m", "high_contact_height_m", "stiffness_n_per_m"),
    edges=_EDGES,
)

HERTZ_END_STOPS = _stop(
    name="hertz_end_stops",
    words="a bump stop and a rebound stop (Hertzian contact)",
    parameters=(_LOW, _HIGH, *_HERTZ[1:]),
    force=_hertz_ends,
    excitation="several contacts at both stops",
    reference=_HUNT_CROSSLEY,
    scaled=(2,),
    starts=_hertz_ends_starts,
    bounds=within(
        low_contact_height_m=_LOW_END,
        high_contact_height_m=_HIGH_END,
        dissipation_s_per_m=dissipation,
    ),
    simpler=("hertz_bump_stop", "hertz_rebound_stop"),
    shown=("low_contact_height_m", "high_contact_height_m"),
    edges=_EDGES,
)
