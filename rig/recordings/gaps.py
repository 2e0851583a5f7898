"""Gaps and bursts of frames in a recording.

Short gaps of an input are interpolated; at long ones a recording is divided.

Measured on a simulated bench of 31 kg (500 Hz, multisine up to 8 Hz, three nonlinear laws) with one
gap a second: the error of the right model in free run is 1.00 times the noise floor with gaps over
which the force changes by 0.25 of its standard deviation (10 ms), 1.26 times with 0.39 (16 ms), 2.7
times with 0.57 (24 ms) and 59 times with 80 ms.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TWO_MISSING = 2.5
"""Usual intervals between samples beyond which at least two samples are missing."""

_BURST = 0.5
"""Usual intervals; frames that come closer together are a burst."""

_LARGEST_CHANGE = 0.3
"""RMS change of the force over the length of a gap, as a share of its standard deviation, up to
which the gap is interpolated."""

_LAGS = 100
"""Lengths that are tried, spread evenly by their logarithm."""


_ENOUGH_S = 3.0
"""Length of a part that holds three periods of 1 Hz."""


class Gaps(NamedTuple):
    """Gaps of two samples or more in what drives a bench.

    Attributes:
        intervals_s: Begin and end of each.
        longest_interpolated_s: Length up to which gaps are interpolated.
        duration_s: Of the recording.
    """

    intervals_s: tuple[tuple[float, float], ...]
    longest_interpolated_s: float
    duration_s: float

    @property
    def long_s(self) -> tuple[tuple[float, float], ...]:
        """Begin and end of those at which the recording is divided."""
        most_s = self.longest_interpolated_s
        return tuple(both for both in self.intervals_s if both[1] - both[0] > most_s)

    def report(self, run: str) -> str:
        """What the gaps mean for a diagnosis of a run, in one line."""
        lengths_s = [end - begin for begin, end in self.intervals_s]
        number, long = len(lengths_s), len(self.long_s)
        text = (
            f"{run}: what drives the bench is missing in {number} gap{'s' * (number > 1)} of two "
            f"samples or more ({100.0 * sum(lengths_s) / self.duration_s:.2g} % of the run, up to "
            f"{max(lengths_s):.2g} s)"
        )
        if not long:
            return f"{text}. They are short enough to be interpolated."
        mean_s = self.duration_s / (long + 1)
        return (
            f"{text}. In {long} of them it changes too much to be interpolated (longer than "
            f"{self.longest_interpolated_s:.2g} s): a diagnosis divides the run there, into parts "
            f"of {mean_s:.2g} s on average, of each of which two initial states are fitted. Parts "
            f"of {_ENOUGH_S:g} s are enough for motions faster than 1 Hz; for shorter ones record "
            "it again, with less load on the computer and the bus."
        )

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "number": len(self.intervals_s),
            "long": len(self.long_s),
            "missing_s": sum(end - begin for begin, end in self.intervals_s),
            "longest_s": max(end - begin for begin, end in self.intervals_s),
        }


def combine_gaps(parts: Sequence[Gaps]) -> Gaps:
    """Gaps of several inputs as those of one."""
    return Gaps(
        tuple(sorted({interval for part in parts for interval in part.intervals_s})),
        min(part.longest_interpolated_s for part in parts),
        max(part.duration_s for part in parts),
    )


def find_gaps(t_s: Array, values: Array) -> Gaps | None:
    """Gaps of an input between its samples, both of shape (n,), times increasing; None for none."""
    steps_s = np.diff(t_s)
    if not len(steps_s) or not float(steps_s.sum()) > 0.0:
        return None
    usual_s = float(np.median(steps_s))
    begins = np.flatnonzero(steps_s > _TWO_MISSING * usual_s)
    if not len(begins):
        return None
    intervals = tuple((float(t_s[k]), float(t_s[k + 1])) for k in begins)
    longest_s = usual_s * _longest_lag(values)
    return Gaps(intervals, longest_s, float(t_s[-1] - t_s[0]))


def are_timed(t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether the arrival of each frame of a message is about the time of its sample, shape (n,).

    Frames that come in a burst have waited, or their values were taken late; which of the two is
    not known. The last one of a burst is as old as any other frame.

    Args:
        t_ns: Arrivals, increasing.
    """
    if len(t_ns) < 2:
        return np.ones(len(t_ns), dtype=np.bool_)
    steps_ns = np.diff(t_ns)
    return np.append(steps_ns > _BURST * np.median(steps_ns), True)


def _longest_lag(force_n: Array) -> int:
    """About the most samples over which a force changes little."""
    most_n = _LARGEST_CHANGE * float(force_n.std())
    longest = 1
    for lag in np.unique(np.geomspace(1, max(len(force_n) // 2, 1), _LAGS).astype(int)).tolist():
        change_n = force_n[lag:] - force_n[:-lag]
        if not float(np.sqrt(np.mean(change_n**2))) <= most_n:
            break
        longest = lag
    return longest
