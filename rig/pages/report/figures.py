"""Plots of a report: panels of lines, points and cells, as the page's script draws them."""

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from dart_model.effects import effect
from rig.diagnosis.outcome import Array, FittedSeries, FoundEffect, HeldOutSeries, NoiseFloor
from rig.pages.plotted_quantities import (
    FREQUENCY,
    HEIGHT,
    RESIDUAL_DENSITY,
    RESIDUAL_FORCE,
    STRUT_FORCE,
    TIME,
    VELOCITY,
)
from rig.pages.report.series import Joined, cloud, envelope, excerpt, join, spectrum, surface

_WIDE_SIGMA = 2.0
_SMOOTHED_BAND = f"grey: ±{_WIDE_SIGMA:.0f} standard deviations of the smoothed residual"
_FLOOR_BAND = f"grey: ±{_WIDE_SIGMA:.0f} × noise floor"
_DECADES = 5.0


class LineStyle(NamedTuple):
    """Name and look of a line.

    Attributes:
        name: Its name in the legend.
        colour: Name of its colour in the page's style.
        dash: Lengths of dashes and gaps in px; none for a line without gaps.
        width: Width of the line in px.
        is_line: Whether it is a line in a panel of points.
    """

    name: str
    colour: str
    dash: tuple[int, ...]
    width: float
    is_line: bool = False


# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
_BOTH = (
    LineStyle("before: nominal model", "--before", (), 1.6),
    LineStyle("after: corrected model", "--after", (4, 3), 1.6),
)
_MEASURED = LineStyle("measured", "--measured", (), 3.2)


class Panel(NamedTuple):
    """One pair of axes.

    Attributes:
        kind: ``lines`` over a common abscissa, ``points`` in a plane, or ``cells`` of one.
        x_label: Label of the abscissa, with its unit.
        y_label: Label of the ordinate, with its unit.
        x: The common abscissa, shape (N,); that of the cells' middles for ``cells``.
        curves: Style of each line.
        values: Ordinates of each curve, shape (N,); the cells' values, row by row, for ``cells``.
        extra: Further options of the page's script: `title`, `reach` of a grey band about zero,
            `marks` where recordings begin, `acting` parts of the abscissa below the curves, `log`
            for both axes, `y_range`, `gaps` that are bridged, `steps` of a histogram, and
            `largest` and `y` of the cells.
    """

    kind: str
    x_label: str
    y_label: str
    x: Array
    curves: Sequence[LineStyle]
    values: Sequence[Array]
    extra: Mapping[str, object]


class Plot(NamedTuple):
    """A figure of the page.

    Attributes:
        key: Unique name in the page.
        title: Heading.
        caption: What the plot shows, and how it is read.
        panels: Labels of the panels.
        columns: Number of panels in a row.
        json: Input of the page's script, safe inside a script element.
        colour_scale: Text at both ends of a scale of colours; empty without one.
    """

    key: str
    title: str
    caption: str
    panels: Sequence[str]
    columns: int
    json: str
    colour_scale: tuple[str, ...] = ()


def curves(*, corrected: bool) -> tuple[LineStyle, ...]:
    """Lines before and after, or of the nominal model alone where nothing was corrected."""
    return _BOTH if corrected else _BOTH[:1]


def finding_plot(
    key: str,
    series: Sequence[FittedSeries],
    points: int,
    acting: FoundEffect | None,
    *,
    corrected: bool,
) -> Plot | None:
    """Residual force over the coordinate that shows it best, its correction and what is left.

    The correction is the mean over the recordings at each height, or at each velocity; where
    nothing was corrected, it is that of the residual force. A bar is where `acting` shows.
    """
    joined = _residuals(series)
    there = np.flatnonzero(np.all(np.isfinite(joined.values[:, :4]), axis=1))
    if len(there) < _BINS:
        return None
    before, after = joined.values[there, 2], joined.values[there, 3]
    sought = before - after if corrected else before
    means = [_mean_over(joined.values[there, i], sought) for i in (0, 1)]

    def left_n2(i: int) -> float:
        rest: Array = before - means[i]
        return float(rest @ rest)

    column = min((0, 1), key=left_n2)
    mean = means[column]
    against: Array = joined.values[there, column]
    kept = cloud(against, np.column_stack([before, after]), points // 2)
    kept = kept[np.argsort(against[kept], kind="stable")]
    quantity = (HEIGHT, VELOCITY)[column]
    points_of = LineStyle("residual force", "--before", (), 1.6), before[kept]
    left = LineStyle("left after the correction", "--after", (), 1.6), after[kept]
    name = "correction, mean" if corrected else "mean"
    line = LineStyle(name, "--law", (7, 4), 2.4, is_line=True), mean[kept]
    styles, values = zip(
        *((points_of, left, line) if corrected else (points_of, line)), strict=True
    )
    panel = Panel(
        "points",
        quantity.label,
        RESIDUAL_FORCE.label,
        against[kept],
        styles,
        values,
        {"reach": _finite(_reach_n(joined)), "acting": _acting_parts(acting, column)},
    )
    caption = f"The force that the nominal model lacks, over {quantity.name} ({_SMOOTHED_BAND})."
    if acting is not None:
        caption += f" The bar below is where the recordings show {effect(acting.name).words}."
    return plot(key, "Residual force", caption, [panel], 1)


def _acting_parts(acting: FoundEffect | None, column: int) -> list[list[float]]:
    """Parts of the height, or of the velocity, in the figure's units."""
    if acting is None or acting.where is None:
        return []
    parts = (acting.where.height_m, acting.where.velocity_m_per_s)[column]
    factor = (HEIGHT, VELOCITY)[column].factor
    return [[factor * low, factor * high] for low, high in parts]


_BINS = 60
"""Bins of a mean over height or velocity: some hundred samples in each."""


def _mean_over(against: Array, values: Array) -> Array:
    """Mean of values in the bin of a coordinate that each is in, shape (N,)."""
    low, high = float(against.min()), float(against.max())
    bins = np.minimum(
        (_BINS * (against - low) / max(high - low, 1e-300)).astype(np.intp), _BINS - 1
    )
    sums, counts = np.bincount(bins, values, _BINS), np.bincount(bins, minlength=_BINS)
    centres = low + (np.arange(_BINS) + 0.5) * (high - low) / _BINS
    filled = counts > 0
    return np.interp(against, centres[filled], sums[filled] / counts[filled])


def residual_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[LineStyle], points: int
) -> Plot:
    """Residual force of a strut, over height, velocity, time and frequency.

    Args:
        key: Unique name in the page.
        series: The strut along each fitted recording.
        shown: Curves, from `curves`.
        points: Points of a line; markers are half as many.
    """
    joined = _residuals(series)
    over_time = _over_time(
        joined, joined.values.T[2:4], shown, points, RESIDUAL_FORCE.label, _reach_n(joined)
    )
    panels = [*_clouds(joined, shown, points), over_time]
    caption = (
        "The force that would make the residual vanish, smoothed over the whole recording "
        f"({_SMOOTHED_BAND}). Friction steps with the sign of the velocity, a stop rises at one "
        "end of the height, a damper too weak is a line over velocity. A complete model leaves the "
        "grey band."
    )
    return plot(key, "Residual force", caption, panels, 2)


def spectrum_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[LineStyle]
) -> Plot | None:
    """Amplitude density of the residual force; None of recordings too short for one."""
    panels = _spectra(series, shown)
    caption = (
        "Amplitude density of the residual force. Far below the peak, it shows the smoother's own "
        "roll-off."
    )
    return plot(key, "Spectrum of the residual force", caption, panels, 1) if panels else None


def corrected_residual_plot(key: str, series: Sequence[FittedSeries], points: int) -> Plot:
    """Residual force of the corrected model against height and velocity, at its own scale."""
    panels = _clouds(_residuals(series), _BOTH, points, first=1)
    caption = (
        "The residual force after the correction, at its own scale: an even band is noise, a "
        "pattern is a force that the law does not describe, however small. The verdict depends on "
        f"the error of the height ({_SMOOTHED_BAND})."
    )
    return plot(key, "Residual force of the corrected model", caption, panels, 2)


def damper_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[LineStyle], points: int
) -> Plot:
    """Force of the model's strut without its linear spring, over velocity and height."""
    columns = [
        np.column_stack(
            [
                run.height_m * HEIGHT.factor,
                run.velocity_m_per_s,
                run.damper_before_n,
                run.damper_after_n,
                np.zeros(len(run.t_s)),
            ]
        )
        for run in series
    ]
    panels = _clouds(join(series, columns), shown, points, label="damper force / N")
    caption = (
        "The force of the model's strut along the recordings, without linear spring and preload: "
        "damper, friction and stops together, positive when they push the bodies apart. Where "
        "several laws describe one damper, their parameters overlap, and this sum is what the "
        "recordings determine."
    )
    return plot(key, "Damper force of the model", caption, panels[::-1], 2)


def surface_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[LineStyle]
) -> Plot | None:
    """Restoring-force surface, or None if nothing moves."""
    mean = surface(series)
    if mean is None:
        return None
    forces = (mean.before_n, mean.after_n)[: len(shown)]
    largest = max(_largest(force) for force in forces) or 1.0
    panels = [
        Panel(
            "cells",
            HEIGHT.label,
            VELOCITY.label,
            mean.height_m * HEIGHT.factor,
            (curve,),
            (force.ravel(),),
            {
                "title": curve.name,
                "y": _base64_floats(mean.velocity_m_per_s),
                "largest": largest,
            },
        )
        for curve, force in zip(shown, forces, strict=True)
    ]
    caption = (
        f"Mean residual force over height and velocity: blue pushes the bodies apart, up to "
        f"{largest:.3g} N, red pulls them together. A cell is empty where it holds fewer than "
        f"{mean.least_count} samples: the recordings hardly reach it."
    )
    ends = tuple(f"{sign}{largest:.3g} N" for sign in ("\u2212", "+"))
    drawn = plot(key, "Restoring-force surface", caption, panels, len(shown))
    return drawn._replace(colour_scale=(ends[0], "0", ends[1]))


def held_out_plot(
    key: str,
    series: Sequence[HeldOutSeries],
    floor: NoiseFloor,
    shown: Sequence[LineStyle],
    points: int,
) -> Plot:
    """Held-out heights of a free run, or forces along a prescribed motion, and their errors.

    Args:
        key: Unique name in the page.
        series: One strut along all held-out runs.
        floor: Noise floor.
        shown: Curves, from `curves`.
        points: Points of a line.
    """
    of_force = series[0].unit == "N"
    quantity = STRUT_FORCE if of_force else HEIGHT
    reach = floor.residual_force_rmse_n if of_force else floor.height_rmse_m
    scale, label = quantity.factor, quantity.label
    worst = max(series, key=lambda item: _largest(item.before - item.measured))
    part = excerpt(worst)
    # An envelope is of a series over time, and would tear a loop.
    thin = slice(part.start, part.stop, max(1, (part.stop - part.start) // points))
    both = (_MEASURED, *shown)
    values = [scale * item[thin] for item in (worst.measured, worst.before, worst.after)]
    values = values[: len(both)]
    panels: list[Panel] = []
    if of_force:
        against = [
            (VELOCITY.label, worst.velocity_m_per_s),
            (HEIGHT.label, HEIGHT.factor * worst.height_m),
        ]
        panels += [Panel("loops", title, label, x[thin], both, values, {}) for title, x in against]
    panels.append(Panel("lines", TIME.label, label, worst.t_s[thin], both, values, {}))
    errors = [
        scale * np.column_stack([run.before - run.measured, run.after - run.measured])
        for run in series
    ]
    joined, title = join(series, errors), label.replace(" /", " error /")
    for first in range(len(shown)):
        # The last panel shows the last curve alone, at a scale at which it can be read.
        columns = joined.values.T[first : len(shown)]
        wide = _WIDE_SIGMA * scale * reach
        panels.append(_over_time(joined, columns, shown[first:], points, title, wide))
    what = (
        "Load cell and model along prescribed motions that are held-out data. A loop over velocity "
        "is an internal state or a spring, a loop over height is what the damper dissipates."
        if of_force
        else "Heights that are held-out data; the measured inputs alone drive the model."
    )
    last = " and, last, the error after the correction at its own scale" if len(shown) > 1 else ""
    caption = (
        f"{what} First a few periods of “{worst.run}” where the nominal model errs most, then the "
        f"error (model less measured) over all held-out data{last} ({_FLOOR_BAND})."
    )
    kind = "force along the prescribed motion" if of_force else "free-run simulation"
    return plot(key, f"Held-out data: {kind}", caption, panels, 1 + of_force)


def _residuals(series: Sequence[FittedSeries]) -> Joined:
    columns: list[Array] = []
    for run in series:
        residuals = run.residual_before_n, run.residual_after_n, run.residual_std_n
        height = run.height_m * HEIGHT.factor
        columns.append(np.column_stack([height, run.velocity_m_per_s, *residuals]))
    return join(series, columns)


def _reach_n(joined: Joined) -> float:
    finite = joined.values[np.isfinite(joined.values[:, 4]), 4]
    return _WIDE_SIGMA * float(np.median(finite)) if len(finite) else 0.0


def _clouds(
    joined: Joined,
    shown: Sequence[LineStyle],
    points: int,
    *,
    first: int = 0,
    label: str = RESIDUAL_FORCE.label,
) -> list[Panel]:
    there = np.flatnonzero(np.all(np.isfinite(joined.values[:, :4]), axis=1))
    panels: list[Panel] = []
    for column, quantity in enumerate((HEIGHT, VELOCITY)):
        against = joined.values[:, column]
        kept = there[cloud(against[there], joined.values[there, 2:4], points // 2)]
        values = [joined.values[kept, 2 + index] for index in range(first, len(shown))]
        extra = {"reach": _finite(_reach_n(joined))}
        labels = quantity.label, label
        panels.append(Panel("points", *labels, against[kept], shown[first:], values, extra))
    return panels


def _spectra(series: Sequence[FittedSeries], shown: Sequence[LineStyle]) -> list[Panel]:
    mean = spectrum(series)
    if mean is None:
        return []
    densities = (mean.before_n_per_sqrt_hz, mean.after_n_per_sqrt_hz)[: len(shown)]
    extra: dict[str, object] = {"log": True}
    highest = max(_largest(density) for density in densities)
    if highest > 0.0:
        # Far below the peak, a smoothed residual only shows the smoother's own roll-off.
        top = math.log10(highest) + 0.3
        peaks = [peak for density in densities if (peak := _largest(density)) > 0.0]
        bottom = min(top - _DECADES, math.log10(min(peaks)) - 1.0)
        extra["y_range"] = [10.0**bottom, 10.0**top]
    labels = FREQUENCY.label, RESIDUAL_DENSITY.label
    thin = [_thin(curve) for curve in shown]
    return [Panel("lines", *labels, mean.frequency_hz, thin, densities, extra)]


def _over_time(
    joined: Joined,
    columns: Sequence[Array] | Array,
    shown: Sequence[LineStyle],
    points: int,
    label: str,
    reach: float,
) -> Panel:
    """Lines over the time of all recordings, with a band and marks where each begins."""
    several = len(joined.names) > 1
    kept = np.unique(
        np.concatenate([envelope(column, points // len(columns)) for column in columns])
    )
    extra: dict[str, object] = {"reach": _finite(reach)}
    if several:
        ends = (*joined.begins[1:], float(joined.t_s[-1]))
        extra["marks"] = [
            {"begin": begin, "end": end, "name": name}
            for begin, end, name in zip(joined.begins, ends, joined.names, strict=True)
        ]
    return Panel(
        "lines",
        f"{TIME.label}{' (one after another)' if several else ''}",
        label,
        joined.t_s[kept],
        [_thin(curve) for curve in shown],
        [column[kept] for column in columns],
        extra,
    )


def _thin(style: LineStyle) -> LineStyle:
    return style._replace(dash=(), width=1.1)


def _finite(reach: float) -> float:
    return reach if math.isfinite(reach) and reach > 0.0 else 0.0


def _largest(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.max(finite)) if len(finite) else 0.0


def _base64_floats(values: Array) -> str:
    # Half the bytes, and still far more digits than a screen has pixels.
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


def plot(key: str, title: str, caption: str, panels: Sequence[Panel], columns: int) -> Plot:
    """A figure of panels, `columns` of them in a row."""
    drawn = [
        {
            "kind": panel.kind,
            "xLabel": panel.x_label,
            "yLabel": panel.y_label,
            "x": base64.b64encode(panel.x.astype("<f8").tobytes()).decode("ascii"),
            "curves": [curve._asdict() for curve in panel.curves],
            "values": [_base64_floats(values) for values in panel.values],
            **panel.extra,
        }
        for panel in panels
    ]
    labels = [f"{panel.y_label} over {panel.x_label}" for panel in panels]
    # What could end a script element is written so that it cannot.
    text = json.dumps(drawn, allow_nan=False).replace("<", "\\u003c")
    return Plot(key, title, caption, labels, columns, text)
