"""Piecewise cubic curves, evaluated in compiled code."""

from typing import NamedTuple

import numpy as np

from rig.simulated_bench.compilation import Floats, Integers, jit_compile


class Curves(NamedTuple):
    """Piecewise cubic curves, one a strut, straight beyond their ends.

    Attributes:
        first: First segment of each curve, and one past the last, shape (struts + 1,).
        segments: Start and length of each segment, and its coefficients from the cube down to the
            constant, shape (segments, 6).
    """

    first: Integers
    segments: Floats


@jit_compile
def curve_segment(curves: Curves, curve: int, at: float) -> int:
    """Segment of a curve at, or nearest to, an abscissa."""
    first = int(curves.first[curve])
    starts = curves.segments[first : int(curves.first[curve + 1]), 0]
    return first + max(int(np.searchsorted(starts, at, side="right")) - 1, 0)


@jit_compile
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
