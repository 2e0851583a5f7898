"""Punctuality of a run's ticks."""

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rig.log.file_names import HISTOGRAMS_FILE

BINS = 20_000
"""Histograms have bins of 1 µs; the last one takes all that is longer than 20 ms."""

_EDGES = np.unique(np.geomspace(1, BINS, 96).astype(np.intp) - 1)
"""First bins of those in the file: as wide as they are read, and few enough for a live run."""


@dataclass(frozen=True)
class Timing:
    """Punctuality of the ticks; histograms have bins of 1 µs.

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
        """Timing before the first tick; its arrays are written from then on."""
        bins = np.zeros((2, BINS), dtype=np.int64)
        return Timing(bins[0], bins[1], np.zeros(3, dtype=np.int64))

    def lateness_us(self) -> dict[str, float]:
        """Percentiles and maximum of the lateness, in µs."""
        return _percentiles(self.lateness, int(self.extremes_ns[0]))

    def work_us(self) -> dict[str, float]:
        """Percentiles and maximum of the work, in µs."""
        return _percentiles(self.work, int(self.extremes_ns[1]))

    def histograms(self) -> bytes:
        """Content of `HISTOGRAMS_FILE`: lower edges in µs, and ticks of each bin."""
        content = {
            "edges_us": _EDGES.tolist(),
            "lateness": np.add.reduceat(self.lateness, _EDGES).tolist(),
            "work": np.add.reduceat(self.work, _EDGES).tolist(),
            "longest_gap_us": int(self.extremes_ns[2]) / 1000,
        }
        return json.dumps(content).encode()

    def summary(self) -> dict[str, object]:
        """All figures, for `run.yaml`."""
        return {
            "lateness_us": self.lateness_us(),
            "work_us": self.work_us(),
            "longest_gap_us": int(self.extremes_ns[2]) / 1000,
        }


def _percentiles(histogram: NDArray[np.int64], largest_ns: int) -> dict[str, float]:
    # A live run computes this between two ticks.
    cumulated = np.cumsum(histogram[: largest_ns // 1000 + 1])
    total = int(cumulated[-1])
    if total == 0:
        return {}
    levels = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999}
    result = {
        name: float(np.searchsorted(cumulated, level * total) + 1) for name, level in levels.items()
    }
    return {**result, "max": largest_ns / 1000}


def read_histograms(folder: Path) -> dict[str, object] | None:
    """Content of a run's `HISTOGRAMS_FILE`; None if it has none."""
    with contextlib.suppress(OSError, ValueError):
        content: object = json.loads((folder / HISTOGRAMS_FILE).read_text("utf-8"))
        return cast("dict[str, object]", content) if isinstance(content, dict) else None
    return None
