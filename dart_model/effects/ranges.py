"""Where a search begins and ends, in shares of what a strut did.

Nothing here is absolute in metres, seconds or newtons: a search that is given the same recording in
other units, or the recording of a bench of another size, takes the same steps.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from types import MappingProxyType

from dart_model.effects.law import Bounds, Motion, Start

Starts = Callable[[Motion], list[Start]]

Span = Callable[[Motion], tuple[float, float]]
"""Lowest and highest value of one parameter, for a motion."""


def grid(*axes: Sequence[float]) -> list[Start]:
    """Every combination of the values of each parameter."""
    return list(itertools.product(*axes))


def geometric(low: float, high: float, count: int) -> list[float]:
    """Values in constant ratio from `low` to `high`; none where they are not in that order."""
    if not 0.0 < low < high:
        return []
    return [low * math.pow(high / low, i / (count - 1)) for i in range(count)]


def slowness_s_per_m(motion: Motion) -> float:
    """Inverse of the usual speed; zero where nothing moved."""
    return 1.0 / motion.speed_m_per_s if motion.speed_m_per_s > 0.0 else 0.0


def crossing_time_s(motion: Motion) -> float:
    """Time in which the strut crosses its stroke at its usual speed; zero where nothing moved."""
    return motion.stroke_m * slowness_s_per_m(motion)


def moving(starts: Starts) -> Starts:
    """The same starts, of which a strut at rest has none."""

    def where_it_moves(motion: Motion) -> list[Start]:
        if motion.stroke_m <= 0.0 or motion.least_stroke_m <= 0.0 or motion.speed_m_per_s <= 0.0:
            return []
        return starts(motion)

    return where_it_moves


def always(*starts: Start) -> Starts:
    """Starts that hold for every motion: forces of arbitrary size, and numbers without a unit."""

    def fixed(_: Motion) -> list[Start]:
        return list(starts)

    return moving(fixed)


def within(**spans: Span) -> Callable[[Motion], Bounds]:
    """Bounds of the parameters that are named."""

    def bounds(motion: Motion) -> Bounds:
        return MappingProxyType({name: span(motion) for name, span in spans.items()})

    return bounds


def of_stroke(low: float, high: float) -> Span:
    """Shares of the stroke."""
    return lambda motion: (low * motion.stroke_m, high * motion.stroke_m)


def of_least_stroke(low: float, high: float) -> Span:
    """Shares of the stroke of the recording with the smallest one."""
    return lambda motion: (low * motion.least_stroke_m, high * motion.least_stroke_m)


def of_speed(low: float, high: float) -> Span:
    """Shares of the usual speed."""
    return lambda motion: (low * motion.speed_m_per_s, high * motion.speed_m_per_s)


def height(low: float, high: float) -> Span:
    """Heights at shares of the stroke."""
    return lambda motion: (
        motion.low_m + low * motion.stroke_m,
        motion.low_m + high * motion.stroke_m,
    )


def dissipation(motion: Motion) -> tuple[float, float]:
    """Bounds of a contact's dissipation: up to ten times its force at the usual speed."""
    return 0.0, 10.0 * slowness_s_per_m(motion)
