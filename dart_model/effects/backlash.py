"""Free play: a zone of heights in which a spring carries nothing, and contacts that are lost."""

import math

from dart_model.effects.law import Effect, Motion, Parameter, Start
from dart_model.effects.ranges import grid, height, moving, within

_BOTH = "heights on both sides of the free play"
_CENTRE = Parameter("centre_height_m", "m", -1e4, 1e4, "middle of the free play")
_GAP = Parameter("gap_m", "m", 1e-12, 1e4, "width of the free play")


def _dead_zone(
    height_m: float, stiffness_n_per_m: float, gap_m: float, centre_height_m: float
) -> float:
    x = height_m - centre_height_m
    beyond = max(abs(x) - 0.5 * gap_m, 0.0)
    return -stiffness_n_per_m * math.copysign(beyond, x)


def _free_play(
    height_m: float, stiffness_n_per_m: float, centre_height_m: float, gap_m: float
) -> float:
    half = 0.5 * gap_m
    return stiffness_n_per_m * min(max(height_m - centre_height_m, -half), half)


def _lift_off(
    height_m: float,
    velocity_m_per_s: float,
    free_length_m: float,
    stiffness_n_per_m: float,
    damping_n_s_per_m: float,
    holding_force_n: float,
) -> float:
    own = -stiffness_n_per_m * (height_m - free_length_m) - damping_n_s_per_m * velocity_m_per_s
    # Whatever spring and damper would pull by beyond the holding force is taken away.
    return max(-holding_force_n - own, 0.0)


def _centres_m(motion: Motion) -> list[float]:
    # A zone whose middle the strut does not come near is a linear spring.
    low, high = _CENTRES(motion)
    free = [motion.free_length_m] if low <= motion.free_length_m <= high else []
    return [*free, *motion.heights_m(0.3, 0.5, 0.7)]


@moving
def _backlash_starts(motion: Motion) -> list[Start]:
    gaps = [share * motion.stroke_m for share in (0.08, 0.25, 0.5)]
    return grid([1.0], gaps, _centres_m(motion))


@moving
def _free_play_starts(motion: Motion) -> list[Start]:
    gaps = [share * motion.stroke_m for share in (0.03, 0.1, 0.3)]
    return grid(_centres_m(motion), gaps)


@moving
def _lift_off_starts(motion: Motion) -> list[Start]:
    return [(share * motion.force_n,) for share in (-0.1, 0.01, 0.1)]


def _gaps(motion: Motion) -> tuple[float, float]:
    # Play that takes most of the stroke is a pair of stops.
    return 1e-3 * motion.least_stroke_m, 0.6 * motion.stroke_m


_CENTRES = height(-1.0, 2.0)
_BOUNDS = within(centre_height_m=_CENTRES, gap_m=_gaps)


BACKLASH = Effect(
    name="backlash",
    family="backlash",
    words="a further spring with free play, in parallel with the strut (dead zone)",
    parameters=(
        Parameter("stiffness_n_per_m", "N/m", 1e-12, 1e12, "stiffness beyond the free play"),
        _GAP,
        _CENTRE,
    ),
    force=_dead_zone,
    excitation=_BOTH,
    reference="Nordin and Gutman, Automatica 38 (2002), dead-zone model",
    starts=_backlash_starts,
    bounds=_BOUNDS,
    simpler=("free_play", "linear_stiffness"),
    shown=("gap_m",),
    edges=((0.0, -0.5, 1.0), (0.0, 0.5, 1.0)),
)

FREE_PLAY = Effect(
    name="free_play",
    family="backlash",
    words="free play of the strut's spring, in which its force does not change and the damper acts",
    parameters=(_CENTRE, _GAP),
    force=_free_play,
    excitation=_BOTH,
    reference="Nordin and Gutman, Automatica 38 (2002), dead-zone model",
    scaled=(),
    starts=_free_play_starts,
    bounds=_BOUNDS,
    shown=("gap_m",),
    edges=((1.0, -0.5), (1.0, 0.5)),
)

LIFT_OFF = Effect(
    name="lift_off",
    family="backlash",
    words="a contact that is lost and met again: spring and damper push, and do not pull",
    parameters=(
        Parameter(
            "holding_force_n",
            "N",
            -1e12,
            1e12,
            "pull of spring and damper at which the contact is lost: what else pushes the bodies "
            "together, such as a preload",
        ),
    ),
    force=_lift_off,
    excitation="a motion in which the contact is lost several times",
    reference="Goldsmith, Impact (1960), 4; Kelvin-Voigt contact",
    scaled=(),
    starts=_lift_off_starts,
    bounds=within(holding_force_n=lambda m: (-100.0 * m.force_n, 100.0 * m.force_n)),
    about_free_length=True,
    shown=("holding_force_n",),
)
