"""Page of damper characteristics: PVP, CVP and F-x plots, and tables."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rig.dyno.characterise import Characteristics
from rig.dyno.faults import MasterComparison
from rig.dyno.figures import SIDES
from rig.dyno.report import DamperReport
from rig.dyno.stroke_force import ANGLES, Figure
from rig.dyno.tolerance import PointVerdict
from rig.files.pictures import new_figure
from rig.pages.html import render_report, svg_url, write_page

# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#a3458f", "#56b4e9", "#7f6000")
_SIGNS = (
    "Forces are positive when the strut pushes its ends apart: compression damping is positive, "
    "rebound damping negative. Velocity and height are positive in rebound."
)
_MOST_SAMPLES = 4000
KIND_WORDS = {
    "warm_up": "warm-up",
    "quasi_static": "quasi-static",
    "velocity_step": "velocity step",
}
"""Name of a kind of step in a sentence."""


def write_characteristics_page(
    reports: Sequence[DamperReport], path: Path, serial: str | None = None
) -> None:
    """Write the HTML page of one record, or of several superimposed, with their serial number.

    Raises:
        InputError: The file cannot be written.
    """
    records = [report.characteristics for report in reports]
    points = [report.points for report in reports]
    text = render_report(
        "characteristics.html",
        names=[item.name for item in records],
        signs=_SIGNS,
        picture=_draw(records, points),
        serial=serial,
        badge=_badge(points, [report.against_master for report in reports]),
        reports=reports,
        kinds=KIND_WORDS,
        damper_rows=damper_rows,
        with_half=with_half,
    )
    write_page(text, path)


def _badge(
    points: Sequence[Sequence[PointVerdict]], namings: Sequence[MasterComparison | None]
) -> tuple[str, str, str] | None:
    """Tone, sign and words of the overall verdict; None without a band and a master."""
    verdicts = {point.verdict for of in points for point in of}
    against = [naming for naming in namings if naming is not None]
    if any(not naming.passes for naming in against) and "fail" not in verdicts:
        return "bad", "✕", "Not as its master"
    if not verdicts:
        return ("good", "✓", "As its master") if against else None
    if "fail" in verdicts:
        return "bad", "✕", "Out of tolerance"
    return ("good", "✓", "In tolerance") if verdicts == {"pass"} else ("part", "?", "Not proven")


def _draw(records: Sequence[Characteristics], points: Sequence[Sequence[PointVerdict]]) -> str:
    """Force at peak velocity over peak velocity, force over velocity and over displacement."""
    style = {
        "axes.grid": True,
        "grid.alpha": 0.3,
        "legend.frameon": False,
        "svg.hashsalt": "rig",
        "font.size": 9,
    }
    with new_figure((12.5, 4.4), style) as figure:
        peaks, velocities, heights = figure.subplots(1, 3)
        for index, item in enumerate(records):
            colour = _COLOURS[index % len(_COLOURS)]
            _draw_peaks(peaks, item, colour)
            _draw_loops(velocities, heights, item, colour, with_samples=len(records) == 1)
        _draw_band(peaks, points)
        for axes in (peaks, velocities, heights):
            axes.axhline(0.0, color="#52606d", linewidth=0.8)
        fastest = max(step.peak_speed_m_per_s for item in records for step in item.steps)
        peaks.set_xlim(0.0, 1.08 * fastest)
        for axes in (peaks, velocities):
            axes.locator_params(axis="x", nbins=6)
        peaks.set(
            title="Force at peak velocity over peak velocity (PVP)",
            xlabel="peak velocity / (m/s)",
            ylabel="force / N     ← rebound · compression →",
        )
        velocities.axvline(0.0, color="#52606d", linewidth=0.8)
        velocities.set(
            title="Force over velocity (CVP)",
            xlabel="velocity / (m/s)     ← compression · rebound →",
            ylabel="force / N",
        )
        heights.set(
            title="Force over displacement (F-x)",
            xlabel="displacement from mid-stroke / mm",
            ylabel="force / N",
        )
        peaks.legend(fontsize="small")
        return svg_url(figure)


def _draw_peaks(axes: Any, item: Characteristics, colour: str) -> None:
    steps = sorted(item.steps, key=lambda step: step.peak_speed_m_per_s)
    for number, (side, marker) in enumerate((("compression", "o"), ("rebound", "s"))):
        sides = [(step.compression, step.rebound)[number] for step in steps]
        speeds = [each.peak_velocity_m_per_s.value for each in sides]
        figures = [each.force_at_peak_velocity_n for each in sides]
        values = np.array([figure.value for figure in figures])
        errors = np.array([[f.value - f.low, f.high - f.value] for f in figures]).T
        label = f"{item.name}: {side}" if number == 0 else side
        axes.errorbar(
            speeds, values, yerr=errors, color=colour, marker=marker, markersize=4, capsize=2,
            linewidth=1.3, label=label,
        )  # fmt: skip


def _draw_band(axes: Any, points: Sequence[Sequence[PointVerdict]]) -> None:
    """Draw the tolerance band of each side."""
    for side in SIDES:
        mine = [point for point in points[0] if point.side == side]
        if mine:
            speeds = [point.velocity_m_per_s for point in mine]
            low, high = [point.low_n for point in mine], [point.high_n for point in mine]
            label = "tolerance" if side == SIDES[0] else None
            axes.fill_between(speeds, low, high, color="#8794a1", alpha=0.3, label=label, zorder=0)


def _draw_loops(
    velocities: Any, heights: Any, item: Characteristics, colour: str, *, with_samples: bool
) -> None:
    for number, step in enumerate(item.steps):
        middle_m = step.middle_m
        if with_samples and number == len(item.steps) - 1:
            every = max(1, len(item.record.height_m) // _MOST_SAMPLES)
            heights.plot(
                1e3 * (item.record.height_m[::every] - middle_m), item.record.force_n[::every], ".",
                color="#9aa5b1", markersize=1.5, zorder=1,
            )  # fmt: skip
        for index, stroke in enumerate(step.strokes):
            x_mm = 1e3 * (
                stroke.middle_m - middle_m + stroke.sign * stroke.amplitude_m * np.sin(ANGLES)
            )
            name = item.name if number == 0 and index == 0 else None
            style = {"color": colour, "linewidth": 1.3, "label": name}
            velocities.plot(stroke.velocity_m_per_s, stroke.force_n, **style)
            heights.plot(x_mm, stroke.force_n, **style)


def damper_rows(item: Characteristics) -> list[tuple[str, str, str, str]]:
    """Figures over all steps and at rest: name, value, interval and method."""
    damper = item.damper
    named = [
        ("gas force", damper.gas_force_n, "N"),
        ("gas spring rate", damper.gas_rate_n_per_m, "N/m"),
        ("friction", damper.friction_n, "N"),
        *[(f"knee, {side}", figure, "m/s") for side, figure in damper.knee_m_per_s.items()],
        ("rebound over compression", damper.asymmetry, ""),
        *[
            (f"change per kelvin, {side}", figure, "N/K")
            for side, figure in damper.force_per_kelvin_n_per_k.items()
        ],
    ]
    named += [
        (f"force at rest, {1e3 * hold.height_m:.1f} mm, at {hold.begin_s:.1f} s", hold.force_n, "N")
        for hold in item.holds
    ]
    return [_row(name, figure, unit) for name, figure, unit in named if figure is not None]


def _row(name: str, figure: Figure, unit: str) -> tuple[str, str, str, str]:
    half = _half(figure)
    interval = f"{_digits(figure.low, half)} to {_digits(figure.high, half)}"
    return name, f"{_digits(figure.value, half)} {unit}", interval, figure.method


def with_half(figure: Figure) -> str:
    """A figure with half of its interval, with the digits that the interval justifies."""
    half = _half(figure)
    return f"{_digits(figure.value, half)} ± {half:.2g}"


def _half(figure: Figure) -> float:
    return 0.5 * (figure.high - figure.low)


def _digits(value: float, half: float) -> str:
    """A value to a tenth of its interval, of which the half is given."""
    if not half > 0.0:
        return f"{value:.5g}"
    decimals = max(0, 1 - int(np.floor(np.log10(half))))
    return f"{value:.{min(decimals, 9)}f}"
