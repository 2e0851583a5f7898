"""Piecewise cubic curves, evaluated in compiled code."""

from typing import NamedTuple

from rig.simulated_bench.compilation import Floats, Integers, compiled


class Curves(NamedTuple):
    """Piecewise cubic curves, one a strut, straight beyond their ends.

    Attributes:
        first: First segment of each curve, and one past the last, shape (struts + 1,).
        segments: Start and length of each segment, and its coefficients from the cube down to the
            constant, shape (segments, 6).
    """

    first: Integers
    segments: Floats


@compiled
def curve_segment(curves: Curves, curve: int, at: float) -> int:
    """Segment of a curve at, or nearest to, an abscissa."""
    low = int(curves.first[curve])
    high = int(curves.first[curve + 1]) - 1
    while low < high:
        middle = (low + high + 1) // 2
        if curves.segments[middle, 0] <= at:
            low = middle
        else:
            high = middle - 1
    return low


@compiled
def curve_force(curves: Curves, strut: int, at: float) -> float:
    """Force of a curve in N at a height in m or a rate in m/s."""
    segments = curves.segments
    low = curve_segment(curves, strut, at)
    offset = at - segments[low, 0]
    inside = min(max(offset, 0.0), segments[low, 1])
    a = segments[low, 2]
    b = segments[low, 3]
    c = segments[low, 4]
    force_n = ((a * inside + b) * inside + c) * inside + segments[low, 5]
    slope = (3.0 * a * inside + 2.0 * b) * inside + c
    return force_n + slope * (offset - inside)
