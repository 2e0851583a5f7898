"""Expected error of the force over the observer's bandwidth, as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from can_dbc.errors import InputError
from rig.files.pictures import new_figure
from rig.tuning.gains import PAPER_HZ
from rig.tuning.tune import TunedStrut

_TOTAL, _NOISE, _LAG, _PAPER = "#1b1f24", "#0072b2", "#d55e00", "#a3458f"


def draw_tuning(tuned: Sequence[TunedStrut], path: Path) -> None:
    """Draw the error by noise, by lag and in total, with chosen and published gains, as PNG.

    Raises:
        InputError: The file cannot be written.
    """
    style = {"axes.grid": True, "grid.alpha": 0.3, "legend.frameon": False}
    with new_figure((7.5, 4.2 * len(tuned)), style) as figure:
        panels = figure.subplots(len(tuned), 1, squeeze=False)[:, 0]
        for axes, strut in zip(panels, tuned, strict=True):
            _draw(axes, strut)
        try:
            figure.savefig(path, dpi=110)
        except (OSError, ValueError) as error:
            raise InputError(f"--plot {path}: cannot be written: {error}") from error


def _draw(axes: Any, strut: TunedStrut) -> None:
    stable = [(hz, item) for hz, item in strut.sweep if np.isfinite(item.force_n)]
    frequency = [hz for hz, _ in stable]
    for name, label, colour, width in (
        ("noise_n", "by the sensor’s noise", _NOISE, 1.2),
        ("lag_n", "by the lag", _LAG, 1.2),
        ("force_n", "both", _TOTAL, 2.0),
    ):
        values = [getattr(item, name) for _, item in stable]
        axes.loglog(frequency, values, color=colour, linewidth=width, label=label)
    chosen = strut.tuned.expected.force_n
    axes.plot(strut.bandwidth_hz, chosen, "o", color=_TOTAL, markersize=9, label="chosen")
    published = strut.published
    if np.isfinite(published.force_n):
        label = "published gains, by mass"
        axes.plot(PAPER_HZ, published.force_n, "X", color=_PAPER, markersize=9, label=label)
    else:
        label = "published gains, by mass: unstable"
        axes.plot([], [], "X", color=_PAPER, markersize=9, label=label)
    axes.set(
        xlabel="bandwidth of the observer / Hz",
        ylabel="expected error of the force, RMS / N",
        title=f"{strut.name}: {chosen:.3g} N at {strut.bandwidth_hz:.3g} Hz",
    )
    axes.legend(fontsize="small")
