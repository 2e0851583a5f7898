"""Lateness and computing time of a run's ticks as a picture."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.files.pictures import Figure
from rig.run.logged_run import Ended

TIMING_PICTURE = "timing.png"
"""Its name in the folder of a run."""

_BINS_A_DECADE = 24
_LEVELS = {"p50": ":", "p99": "-.", "p99_9": "--", "max": "-"}


@dataclass(frozen=True)
class Distribution:
    """Histogram of the ticks by a time.

    Attributes:
        what: The time, for its axis.
        ticks: Ticks in bins of 1 µs, shape (bins,).
        levels_us: Percentiles and maximum, in µs, by name.
    """

    what: str
    ticks: NDArray[np.int64]
    levels_us: Mapping[str, float]


def draw_run(ended: Ended) -> Path:
    """Draw lateness and computing time of a run's ticks into its folder; returns the file.

    Raises:
        OSError: It cannot be written.
    """
    timing, granted = ended.timing, ended.granted
    fifo = "granted" if granted is not None and granted.fifo else "not granted"
    title = (
        f"{1e9 / ended.period_ns:g} ticks a second: {ended.ticks} ticks, "
        f"{ended.state.counts.overruns} overruns, "
        f"longest gap {timing.extremes_ns[2] * 1e-6:.2f} ms; SCHED_FIFO {fifo}"
    )
    distributions = (
        Distribution("Lateness: deadline to wake-up", timing.lateness, timing.lateness_us()),
        Distribution("Work: wake-up to the end of the tick", timing.work, timing.work_us()),
    )
    path = ended.folder / TIMING_PICTURE
    draw_timing(path, title, distributions, ended.period_ns / 1000)
    return path


def draw_timing(
    path: Path, title: str, distributions: tuple[Distribution, ...], period_us: float
) -> None:
    """Draw histograms in one column, on logarithmic axes, with the period as a limit, as PNG.

    A histogram without a tick is left empty.

    Raises:
        OSError: The file cannot be written.
    """
    size = (8.0, 2.4 * len(distributions) + 1.0)
    figure: Any = Figure(figsize=size, layout="constrained")
    every = figure.subplots(len(distributions), 1, sharex=True, squeeze=False)[:, 0]
    largest_us = [max(item.levels_us.values(), default=0.0) for item in distributions]
    for axes, item in zip(every, distributions, strict=True):
        _draw(axes, item, period_us)
        axes.set_xlim(0.5, 1.3 * max(period_us, *largest_us))
    every[-1].set_xlabel("time in µs (times below 1 µs are left of 1)")
    figure.suptitle(title, fontsize="medium")
    figure.savefig(path, dpi=120)


def _draw(axes: Any, item: Distribution, period_us: float) -> None:
    edges, ticks = _merge_bins(item.ticks)
    if ticks.any():
        axes.stairs(ticks, edges, fill=True, color="tab:blue", alpha=0.6)
    axes.set(xscale="log", yscale="log", ylabel="ticks", title=item.what)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_ylim(0.5, 2.0 * max(int(ticks.max()), 1))
    axes.grid(alpha=0.3)
    for name, style in _LEVELS.items():
        if name in item.levels_us:
            value_us = item.levels_us[name]
            label = f"{name.replace('_', '.')} {_readable(value_us)}"
            axes.axvline(value_us, color="black", linestyle=style, linewidth=1.2, label=label)
    axes.axvline(period_us, color="tab:red", linewidth=1.2, label=f"period {_readable(period_us)}")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def _readable(value_us: float) -> str:
    return f"{value_us:.0f} µs" if value_us < 10_000 else f"{value_us / 1000:.1f} ms"


def _merge_bins(ticks: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Bins of equal width on a logarithmic axis, of 1 µs or more; the first one is below 1 µs."""
    decades = float(np.log10(len(ticks)))
    steps: NDArray[np.float64] = 10.0 ** np.arange(0.0, decades + 1e-9, 1 / _BINS_A_DECADE)
    edges = np.unique(np.rint(np.append(steps, len(ticks))))
    starts = np.concatenate([[0], edges[:-1]]).astype(np.intp)
    return np.concatenate([[0.5], edges]), np.add.reduceat(ticks, starts)
