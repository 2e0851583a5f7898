"""Times of sampling by the counter in a message's frames, over a whole recording.

A sender that samples every cycle numbers its frames; a frame may wait on its way, but never comes
early. The arrivals over their numbers therefore lie on or above a line, which is the lower envelope
of all: of the lines below every arrival the one with the least sum of waits. It has the sender's
clock, its offset but for the shortest wait, and its drift. The bridge follows the same line, frame
by frame (`rig.bridge.sample_times`).

Reference: Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements" (INFOCOM 1999).
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_FEWEST = 64
"""Frames below which the line errs by too much of a wait."""

_LARGEST_DRIFT = 0.05
"""Share of the cycle time by which the sender's may differ."""

_BLOCKS = 16
"""Parts of a recording whose shortest waits are compared."""

_SCATTER = 0.4
"""Largest median of the parts' shortest waits, over the mean wait: about a hundredth where frames
wait on their way, and more than a half where the sender itself waits at random between frames: its
counter then states no time."""


def counted_times_s(
    arrivals_ns: Integers, counts: Array, modulus: int, cycle_ns: int
) -> Array | None:
    """Times of sampling in s, shape (n,); None where the counter states no time.

    Args:
        arrivals_ns: Arrivals of the frames, increasing, shape (n,).
        counts: Their counters, shape (n,).
        modulus: Number of values after which the counter starts again.
        cycle_ns: Cycle time of the message, as the DBC has it.
    """
    if len(arrivals_ns) < _FEWEST:
        return None
    numbers = _numbers(arrivals_ns, counts, modulus, cycle_ns)
    if np.any(np.diff(numbers) <= 0):
        return None
    since_ns = (arrivals_ns - arrivals_ns[0]).astype(np.float64)
    offset_ns, step_ns = _line_below(numbers.astype(np.float64), since_ns)
    waits_ns = since_ns - offset_ns - step_ns * numbers
    if abs(step_ns - cycle_ns) > _LARGEST_DRIFT * cycle_ns:
        return None
    shortest = [float(part.min()) for part in np.array_split(waits_ns, _BLOCKS)]
    # A thousandth of a cycle is the resolution of a clock, not a scatter.
    if float(np.median(shortest)) > max(_SCATTER * float(waits_ns.mean()), 1e-3 * cycle_ns):
        return None
    times_ns = float(arrivals_ns[0]) + offset_ns + step_ns * numbers
    return np.asarray(1e-9 * times_ns, dtype=np.float64)


def _numbers(arrivals_ns: Integers, counts: Array, modulus: int, cycle_ns: int) -> Integers:
    """Number of each frame since the first, lost ones counted."""
    steps = np.rint(np.diff(counts)).astype(np.int64) % modulus
    # After a silence the counter has gone round: as often as comes nearest to the arrival.
    apart = np.diff(arrivals_ns) / cycle_ns
    rounds = np.maximum(np.rint((apart - steps) / modulus).astype(np.int64), 0)
    return np.concatenate([[0], np.cumsum(steps + rounds * modulus)])


def _line_below(x: Array, y: Array) -> tuple[float, float]:
    """Offset and slope of the line below all points that has the least sum of distances.

    It is the edge of the lower convex hull below the mean of x (Andrew's monotone chain).
    """
    hull: list[int] = []
    for i in range(len(x)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[i] - y[a]) > (y[b] - y[a]) * (x[i] - x[a]):
                break
            hull.pop()
        hull.append(i)
    at = int(np.searchsorted(x[hull], float(x.mean())))
    at = min(max(at, 1), len(hull) - 1)
    a, b = hull[at - 1], hull[at]
    slope = float((y[b] - y[a]) / (x[b] - x[a]))
    return float(y[a]) - slope * float(x[a]), slope
