"""How long model and observers need until the estimate has forgotten how it began.

What begins a transient, a start, a gap or other gains, is for the published force a step of the
residual force that the observer does not know yet. The linear loop gives its response.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 3.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.protocol import AnyPlant
from rig.closed_loop.loop import POLE_ROUNDING, LinearLoop, Loop, SampleTiming
from rig.observers.protocol import AnyObserver

Array = NDArray[np.float64]

REMAINING_SHARE = 0.01
"""Share of a step of the residual force that a settled loop may still err by: that of the error
with which the published gains follow the reference case."""

_BLOCK = 256
"""Intervals that are computed at once."""

_LONGEST_S = 60.0
"""A loop that takes longer is of no use on a bench, and is taken to settle never."""


def settling_times_ns(
    plant: AnyPlant,
    observers: Sequence[AnyObserver],
    heights_m: Sequence[float],
    timing: SampleTiming,
) -> list[int | None]:
    """Settling time of each strut's estimate, about rest at some heights; None if it never does."""
    loop = Loop(plant, observers, heights_m, timing)
    times_ns: list[int | None] = [0] * len(observers)
    observed = [strut for strut, observer in enumerate(observers) if observer.estimates_force]
    if not observed:
        return times_ns
    for strut, linear in zip(observed, loop.linear_each(observed), strict=True):
        decay_ns = decay_time_ns(linear)
        times_ns[strut] = None if decay_ns is None else observers[strut].settling_ns(decay_ns)
    return times_ns


def decay_time_ns(loop: LinearLoop) -> int | None:
    """Time after which a step of the residual force leaves no more than the remaining share.

    None if the loop is unstable, or takes longer than a minute.
    """
    slowest = max(np.abs(np.linalg.eigvals(loop.a)), default=0.0)
    if slowest > 1.0 + POLE_ROUNDING:
        return None
    longest = round(_LONGEST_S / loop.interval_s)
    count = longest
    # An integrator that is switched off leaves a pole at exactly 1, which no error shows.
    if slowest < 1.0 - POLE_ROUNDING:
        # Behind this the slowest pole has decayed to a thousandth of the share.
        count = min(count, int(np.log(1e-3 * REMAINING_SHARE) / np.log(max(slowest, 0.01))) + 1)
    last = -1
    for first, errors in _step_response(loop, count):
        large = np.flatnonzero(np.abs(errors) > REMAINING_SHARE)
        if len(large):
            last = first + int(large[-1])
    last = min(last + 1, count)
    return None if last >= longest else round(last * loop.interval_s * 1e9)


def _step_response(loop: LinearLoop, count: int) -> Iterator[tuple[int, Array]]:
    """Errors after a unit step of the residual force, in blocks, each with its first index."""
    size = len(loop.a)
    # With the step as a state that does not change, the response is one of powers alone.
    step = np.zeros((size + 1, size + 1))
    step[:size, :size], step[:size, size], step[size, size] = loop.a, loop.b[:, 1], 1.0
    rows = [np.append(loop.c, loop.d[1])]
    for _ in range(_BLOCK - 1):
        rows.append(rows[-1] @ step)
    block, over_block = np.array(rows), np.linalg.matrix_power(step, _BLOCK)
    x = np.append(np.zeros(size), 1.0)
    for first in range(0, count, _BLOCK):
        yield first, block @ x
        x = over_block @ x
