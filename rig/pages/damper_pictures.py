"""Plots of a damper: peak velocity (PVP), force over velocity (CVP), force over displacement (F-x).

They are static drawings, which print as they are seen. A measured force is black; the master is a
green dashed line; a point of a band has the colour and the shape of its verdict. The steps of one
record run from light to dark with their speed, which stands at each curve; several records have a
colour each.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.dyno.characterise import Characteristics
from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.report import DamperReport
from rig.dyno.stroke_force import ANGLES, MeanStroke
from rig.dyno.strokes import Array
from rig.dyno.tolerance import PointVerdict
from rig.files.pictures import new_figure
from rig.pages.html import svg_url
from rig.pages.plotted_quantities import us_units
from rig.pages.report.series import envelope

# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
RECORD_COLOURS = ("#111111", "#0072b2", "#d55e00", "#a3458f", "#007a58", "#7f6000")
_RECORD_DASHES = ("-", "--", "-.", ":")
_MASTER = "#00734f"
_AXIS = "#52606d"
_LIGHT, _DARK = np.array([0.35, 0.60, 0.80]), np.array([0.02, 0.16, 0.36])


class VerdictMark(NamedTuple):
    """Look and words of a verdict: its colour, matplotlib's marker, its sign in a text."""

    colour: str
    marker: str
    sign: str


VERDICT_MARKS = {
    "pass": VerdictMark("#00734f", "o", "●"),
    "open": VerdictMark("#a05a00", "D", "◆"),
    "fail": VerdictMark("#b3261e", "X", "✖"),
    "not measured": VerdictMark("#52606d", "|", "–"),
}

_USES = {"step": "#0072b2", "rest": "#52606d", "rejected": "#b3261e", "transition": ""}
"""Colour behind what a part of a record was used for; empty for none."""

_STYLE = {
    "axes.grid": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "svg.hashsalt": "rig",
    "font.size": 9.5,
}
_MOST_SAMPLES = 4000
"""Samples that are drawn behind the mean curves: more would not be told apart."""

_PARTS = 900
"""Parts of a record of which the least and the largest value are drawn: its width in px."""

_LABEL_SPACE = 0.055
"""Share of an axis within which a second label is left out."""


class PlotUnits(NamedTuple):
    """Units of a plot: factor to and name of that of forces, of velocities and of displacements."""

    force: tuple[float, str]
    velocity: tuple[float, str]
    displacement: tuple[float, str]


_US = us_units()
SYSTEMS = {
    "si": PlotUnits((1.0, "N"), (1.0, "m/s"), (1e3, "mm")),
    "us": PlotUnits(_US["N"], _US["m/s"], _US["m"]),
}
"""Units of both versions of a plot."""


class DamperPictures(NamedTuple):
    """The three plots as SVG in data URLs."""

    peaks: str
    velocities: str
    heights: str


def draw_damper(reports: Sequence[DamperReport]) -> dict[str, DamperPictures]:
    """The plots of one record, or of several superimposed, by system of units.

    Band and master are the first one's.
    """
    return {system: _draw_in(units, reports) for system, units in SYSTEMS.items()}


def draw_account(item: Characteristics) -> dict[str, str]:
    """Height and force of a record with what each second was used for, by system of units."""
    found: dict[str, str] = {}
    for system, units in SYSTEMS.items():
        with new_figure((9.0, 2.6), _STYLE) as figure:
            upper, lower = figure.subplots(2, 1, sharex=True)
            _draw_channel(upper, item, item.record.height_m * units.displacement[0])
            _draw_channel(lower, item, item.record.force_n * units.force[0])
            upper.set(ylabel=f"height / {units.displacement[1]}")
            lower.set(ylabel=f"force / {units.force[1]}", xlabel="time / s")
            for span in item.account:
                if span.use == "step":
                    middle_s = 0.5 * (span.begin_s + span.end_s)
                    at = {"xycoords": ("data", "axes fraction"), "ha": "center", "fontsize": 7.5}
                    upper.annotate(str(span.number), (middle_s, 1.02), **at)
            found[system] = svg_url(figure)
    return found


def _draw_channel(axes: Any, item: Characteristics, values: Array) -> None:
    """A channel over time, thinned by minimum and maximum, over the uses of the record."""
    t_s = item.record.t_s
    kept = envelope(values, 2 * _PARTS)
    axes.plot(t_s[kept], values[kept], color=RECORD_COLOURS[0], linewidth=0.6)
    for span in item.account:
        colour = _USES[span.use]
        if colour:
            axes.axvspan(span.begin_s, span.end_s, color=colour, alpha=0.22, linewidth=0.0)
    axes.set_xlim(float(t_s[0]), float(t_s[-1]))


def _draw_in(units: PlotUnits, reports: Sequence[DamperReport]) -> DamperPictures:
    with new_figure((5.6, 4.2), _STYLE) as figure:
        _draw_peaks(figure.subplots(), reports, units)
        peaks = svg_url(figure)
    loops: list[str] = []
    for draw in (_draw_velocities, _draw_heights):
        with new_figure((4.4, 3.1), _STYLE) as figure:
            axes = figure.subplots()
            axes.axhline(0.0, color=_AXIS, linewidth=0.8)
            draw(axes, [report.characteristics for report in reports], units)
            loops.append(svg_url(figure))
    return DamperPictures(peaks, *loops)


_BOUND = "clipped: at least this"


def _draw_peaks(axes: Any, reports: Sequence[DamperReport], units: PlotUnits) -> None:
    """Force at peak velocity over peak velocity, with band and master."""
    first, points = reports[0], reports[0].points
    _draw_band(axes, points, units)
    if first.master is not None:
        for side in SIDES:
            speeds, forces_n, _ = _peaks(first.master, side, units)
            name = f"master: {first.master.name}" if side == SIDES[0] else None
            style = {"color": _MASTER, "dashes": (5, 3), "linewidth": 1.8, "label": name}
            axes.plot(speeds, forces_n, **style)
    for index, report in enumerate(reports):
        item, (colour, dash) = report.characteristics, _look(index)
        for side, marker in zip(SIDES, ("o", "s"), strict=True):
            speeds, forces_n, halves_n = _peaks(item, side, units)
            is_bound = ~np.isfinite(halves_n).all(axis=0)
            halves_n = np.where(np.isfinite(halves_n), halves_n, 0.0)
            name = item.name if side == SIDES[0] else None
            axes.errorbar(
                speeds, forces_n, yerr=halves_n, color=colour, linestyle=dash, capsize=2.5,
                linewidth=1.4, marker="." if report.points else marker, markersize=5, label=name,
            )  # fmt: skip
            if is_bound.any():
                has_bound = _BOUND in axes.get_legend_handles_labels()[1]
                arrow = {"marker": "^" if side == SIDES[0] else "v", "markersize": 9}
                axes.plot(
                    speeds[is_bound], forces_n[is_bound], color=colour, linestyle="", **arrow,
                    label="" if has_bound else _BOUND,
                )  # fmt: skip
    _draw_verdicts(axes, points, units)
    axes.axhline(0.0, color=_AXIS, linewidth=0.8)
    axes.set_xlim(left=0.0)
    axes.locator_params(axis="x", nbins=7)
    axes.set(
        title="Force at peak velocity over peak velocity (PVP)",
        xlabel=f"peak velocity / ({units.velocity[1]})",
        ylabel=f"force / {units.force[1]}     ← rebound · compression →",
    )
    axes.legend(fontsize="small", loc="best")


def _peaks(item: Characteristics, side: str, units: PlotUnits) -> tuple[Array, Array, Array]:
    """Peak velocities, forces there, and how far their intervals reach below and above, (2, n)."""
    steps = sorted(item.steps, key=lambda step: step.peak_speed_m_per_s)
    sides = [getattr(step, side) for step in steps]
    figures = [each.force_at_peak_velocity_n for each in sides]
    return (
        units.velocity[0] * np.array([each.peak_velocity_m_per_s.value for each in sides]),
        units.force[0] * np.array([figure.value for figure in figures]),
        units.force[0] * np.array([[f.value - f.low, f.high - f.value] for f in figures]).T,
    )


def _draw_band(axes: Any, points: Sequence[PointVerdict], units: PlotUnits) -> None:
    """Draw the band of each side; a band of one point is a bar."""
    for side in SIDES:
        mine = [point for point in points if point.side == side]
        speeds = [units.velocity[0] * point.velocity_m_per_s for point in mine]
        low = [units.force[0] * point.low_n for point in mine]
        high = [units.force[0] * point.high_n for point in mine]
        name = "tolerance" if side == SIDES[0] else None
        style = {"color": "#8794a1", "alpha": 0.28, "label": name, "zorder": 0}
        if len(mine) > 1:
            axes.fill_between(speeds, low, high, **style)
        elif mine:
            axes.vlines(speeds, low, high, linewidth=9.0, **style)


def _draw_verdicts(axes: Any, points: Sequence[PointVerdict], units: PlotUnits) -> None:
    """Draw each point of the band that was measured, and how far those beyond it are off."""
    for verdict, mark in VERDICT_MARKS.items():
        mine = [point for point in points if point.verdict == verdict]
        known = [
            (units.velocity[0] * point.velocity_m_per_s, units.force[0] * point.force.value)
            for point in mine
            if point.force is not None
        ]
        if not known:
            continue
        speeds, forces_n = zip(*known, strict=True)
        axes.plot(
            speeds, forces_n, linestyle="", marker=mark.marker, markersize=8, color=mark.colour,
            markeredgecolor="white", label=verdict, zorder=5,
        )  # fmt: skip
        if verdict == "fail":
            for point, place in zip(mine, known, strict=True):
                offset = (7, -11) if point.side == SIDES[0] else (7, 4)
                axes.annotate(
                    f"−{-units.force[0] * (point.margin_n or 0.0):.3g} {units.force[1]}", place,
                    xytext=offset,
                    textcoords="offset points", color=mark.colour, fontsize="small",
                )  # fmt: skip


def _draw_velocities(axes: Any, records: Sequence[Characteristics], units: PlotUnits) -> None:
    axes.axvline(0.0, color=_AXIS, linewidth=0.8)
    for _, step, style in _curves(records):
        for stroke in step.strokes:
            velocity = units.velocity[0] * stroke.velocity_m_per_s
            axes.plot(velocity, units.force[0] * stroke.force_n, **style)
            style.pop("label", None)
    axes.locator_params(axis="x", nbins=6)
    _label_steps(axes, records, _fastest_point, units)
    axes.set(
        title="Force over velocity (CVP)",
        xlabel=f"velocity / ({units.velocity[1]})     ← compression · rebound →",
        ylabel=f"force / {units.force[1]}",
    )
    _add_legend(axes, records)


def _draw_heights(axes: Any, records: Sequence[Characteristics], units: PlotUnits) -> None:
    if len(records) == 1:
        record, step = records[0].record, records[0].steps[-1]
        every = max(1, len(record.height_m) // _MOST_SAMPLES)
        displacement = units.displacement[0] * (record.height_m[::every] - step.middle_m)
        style = {"color": "#9aa5b1", "markersize": 1.3, "zorder": 1, "rasterized": True}
        axes.plot(displacement, units.force[0] * record.force_n[::every], ".", **style)
    for _, step, style in _curves(records):
        for stroke in step.strokes:
            displacement = units.displacement[0] * _displacement_m(step, stroke)
            axes.plot(displacement, units.force[0] * stroke.force_n, **style)
            style.pop("label", None)
    axes.locator_params(axis="x", nbins=5)
    _label_steps(axes, records, _middle_point, units)
    axes.set(
        title="Force over displacement (F-x)",
        xlabel=f"displacement from mid-stroke / {units.displacement[1]}",
        ylabel=f"force / {units.force[1]}",
    )
    _add_legend(axes, records)


def _curves(
    records: Sequence[Characteristics],
) -> Iterable[tuple[Characteristics, DynoStep, dict[str, object]]]:
    """Each step of each record with the style of its curves; a record's first step has its name."""
    for index, item in enumerate(records):
        colour, dash = _look(index)
        steps = sorted(item.steps, key=lambda step: step.peak_speed_m_per_s)
        for number, step in enumerate(steps):
            share = number / max(len(steps) - 1, 1)
            ramp = tuple(((1.0 - share) * _LIGHT + share * _DARK).tolist())
            style: dict[str, object] = {"color": ramp if len(records) == 1 else colour}
            style |= {"linestyle": dash, "linewidth": 1.4}
            if number == 0:
                style["label"] = item.name
            yield item, step, style


def _look(index: int) -> tuple[str, str]:
    """Colour and dashes of a record's curves."""
    return (
        RECORD_COLOURS[index % len(RECORD_COLOURS)],
        _RECORD_DASHES[index % len(_RECORD_DASHES)],
    )


def _displacement_m(step: DynoStep, stroke: MeanStroke) -> Array:
    sine = stroke.sign * stroke.amplitude_m * np.sin(ANGLES)
    return stroke.middle_m - step.middle_m + sine


def _fastest_point(step: DynoStep, units: PlotUnits) -> tuple[float, float]:
    """Velocity and force at the peak velocity of rebound."""
    stroke = step.strokes[1]
    at = int(np.argmax(np.abs(stroke.velocity_m_per_s)))
    velocity = units.velocity[0] * stroke.velocity_m_per_s[at]
    return float(velocity), units.force[0] * float(stroke.force_n[at])


def _middle_point(step: DynoStep, units: PlotUnits) -> tuple[float, float]:
    """Displacement and force at mid-stroke of compression."""
    stroke = step.strokes[0]
    at = len(ANGLES) // 2
    displacement = units.displacement[0] * _displacement_m(step, stroke)[at]
    return float(displacement), units.force[0] * float(stroke.force_n[at])


def _label_steps(
    axes: Any,
    records: Sequence[Characteristics],
    point: Callable[[DynoStep, PlotUnits], tuple[float, float]],
    units: PlotUnits,
) -> None:
    """Write the speed of each step at its curve, the fastest first, where there is room."""
    if len(records) > 1:
        return
    spans = [max(float(np.ptp(axis)), 1e-300) for axis in (axes.get_xlim(), axes.get_ylim())]
    placed: list[tuple[float, float]] = []
    for step in sorted(records[0].steps, key=lambda it: -it.peak_speed_m_per_s):
        x, y = point(step, units)
        is_free = all(
            abs(y - other[1]) > _LABEL_SPACE * spans[1]
            or abs(x - other[0]) > 2.5 * _LABEL_SPACE * spans[0]
            for other in placed
        )
        if is_free:
            placed.append((x, y))
            axes.annotate(
                f"{units.velocity[0] * step.peak_speed_m_per_s:.2g} {units.velocity[1]}", (x, y),
                xytext=(3, 4),
                textcoords="offset points", fontsize="x-small", color="#1f2933",
            )  # fmt: skip


def _add_legend(axes: Any, records: Sequence[Characteristics]) -> None:
    if len(records) > 1:
        axes.legend(fontsize="small")
