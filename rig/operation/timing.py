"""How well the rate of a run was kept."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 20_000
"""Histograms have bins of 1 µs; the last one takes all that is longer than 20 ms."""


@dataclass(frozen=True)
class Timing:
    """How well the rate was kept; histograms have bins of 1 µs.

    Attributes:
        lateness: Ticks by lateness of the wake-up.
        work: Ticks by time from wake-up to the end of the tick's work.
        extremes_ns: Largest lateness, work and gap between two ticks, in ns.
    """

    lateness: NDArray[np.int64]
    work: NDArray[np.int64]
    extremes_ns: NDArray[np.int64]

    @staticmethod
    def empty() -> "Timing":
        """Before the first tick; written in place from then on."""
        bins = np.zeros((2, BINS), dtype=np.int64)
        return Timing(bins[0], bins[1], np.zeros(3, dtype=np.int64))

    def lateness_us(self) -> dict[str, float]:
        """Percentiles and maximum of the lateness, in µs."""
        return _percentiles(self.lateness, int(self.extremes_ns[0]))

    def work_us(self) -> dict[str, float]:
        """Percentiles and maximum of the work, in µs."""
        return _percentiles(self.work, int(self.extremes_ns[1]))

    def summary(self) -> dict[str, object]:
        """All figures, for `run.yaml`."""
        return {
            "lateness_us": self.lateness_us(),
            "work_us": self.work_us(),
            "longest_gap_us": int(self.extremes_ns[2]) / 1000,
        }


def _percentiles(histogram: NDArray[np.int64], largest_ns: int) -> dict[str, float]:
    # A live run asks for this between two ticks.
    cumulated = np.cumsum(histogram[: largest_ns // 1000 + 1])
    total = int(cumulated[-1])
    if total == 0:
        return {}
    levels = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999}
    result = {
        name: float(np.searchsorted(cumulated, level * total) + 1) for name, level in levels.items()
    }
    return {**result, "max": largest_ns / 1000}
