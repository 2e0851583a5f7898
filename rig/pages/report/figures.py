"""The plots of a report, as plotly figures."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple, cast

import numpy as np
from plotly import graph_objects, subplots

from rig.diagnosis.outcome import Array, FittedSeries, HeldOutSeries, NoiseFloor
from rig.pages.report.series import Joined, cloud, envelope, excerpt, join, spectrum, surface

_NOISE = "rgba(110, 110, 110, 0.22)"
_LONGEST_MARK = 60
_WIDE_SIGMA = 2.0
_SMOOTHED_BAND = f"±{_WIDE_SIGMA:.0f} standard deviations of the smoothed residual"
_FLOOR_BAND = f"±{_WIDE_SIGMA:.0f} × noise floor"
_DECADES = 5.0

_Panel = tuple[int, int]


class Curve(NamedTuple):
    """What is shown, and how where it lies beside what was measured."""

    name: str
    colour: str
    dash: str
    width: float


# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
_BOTH = (
    Curve("before: nominal model", "#d55e00", "solid", 1.6),
    Curve("after: corrected model", "#0072b2", "dot", 1.6),
)
_MEASURED = Curve("measured", "#111111", "solid", 3.2)


class Plot(NamedTuple):
    """A figure of the page; `json` is plotly's, safe inside a script element."""

    key: str
    title: str
    caption: str
    json: str
    height_px: int


def curves(*, corrected: bool) -> tuple[Curve, ...]:
    """What is shown: before and after, or the nominal model where nothing was corrected."""
    return _BOTH if corrected else _BOTH[:1]


def residual_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[Curve], points: int
) -> Plot:
    """Residual force against height, velocity, time and frequency.

    Args:
        key: Unique name in the page.
        series: One strut along all fitted recordings.
        shown: Curves, from `curves`.
        points: Points of a line; markers are half as many.
    """
    figure = _panels(2, 2, horizontal_spacing=0.11, vertical_spacing=0.16)
    joined = _residuals(series)
    _clouds(figure, joined, shown, points)
    _lines(figure, (2, 1), joined.t_s, list(joined.values.T[2:4]), shown, points)
    _over_time(figure, joined, (2, 1), "residual force / N", _reach_n(joined))
    _spectra(figure, series, shown)
    _band_legend(figure, _SMOOTHED_BAND)
    caption = (
        "The force that would make the residual vanish, smoothed over the whole recording. "
        "Friction steps with the sign of the velocity, a stop rises at one end of the height, a "
        "damper too weak is a line over velocity. A complete model leaves the grey band."
    )
    return _plot(key, "Residual force", caption, figure, 720)


def left_plot(key: str, series: Sequence[FittedSeries], points: int) -> Plot:
    """Residual force of the corrected model against height and velocity, at its own scale."""
    figure = _panels(1, 2, horizontal_spacing=0.11)
    _clouds(figure, _residuals(series), _BOTH, points, first=1)
    _band_legend(figure, _SMOOTHED_BAND)
    caption = (
        "The residual force after the correction, at its own scale: a pattern here is something "
        "that is still missing, an even band is noise."
    )
    return _plot(key, "Residual force of the corrected model", caption, figure, 340)


def surface_plot(key: str, series: Sequence[FittedSeries], shown: Sequence[Curve]) -> Plot | None:
    """Restoring-force surface, or None if nothing moves."""
    found = surface(series)
    if found is None:
        return None
    titles = [curve.name for curve in shown]
    figure = _panels(
        1, len(shown), horizontal_spacing=0.07, shared_yaxes=True, subplot_titles=titles
    )
    forces = (found.before_n, found.after_n)[: len(shown)]
    largest = max(_largest(force) for force in forces) or 1.0
    for index, force in enumerate(forces):
        trace = {
            "type": "heatmap",
            "x": _short(found.height_m * 1e3),
            "y": _short(found.velocity_m_per_s),
            "z": _short(force),
            "customdata": found.samples.astype(np.int32),
            "coloraxis": "coloraxis",
            "hoverongaps": False,
            "hovertemplate": "height %{x:.1f} mm<br>velocity %{y:.3f} m/s<br>"
            "mean residual force %{z:.2f} N<br>%{customdata} samples<extra></extra>",
        }
        figure.add_trace(trace, row=1, col=index + 1)
        figure.update_xaxes(title_text="height / mm", showgrid=False, row=1, col=index + 1)
    figure.update_yaxes(showgrid=False)
    figure.update_yaxes(title_text="velocity / m/s", row=1, col=1)
    bar = {"title": {"text": "mean residual force / N", "side": "right"}, "thickness": 14}
    scale = {"colorscale": "RdBu", "cmin": -largest, "cmax": largest, "colorbar": bar}
    figure.update_layout(coloraxis=scale)
    caption = (
        "Mean residual force over height and velocity: blue pushes the bodies apart, red pulls "
        f"them together. A cell is left empty where it holds fewer than {found.least_count} "
        "samples: there the recordings say nothing."
    )
    return _plot(key, "Restoring-force surface", caption, figure, 430)


def held_out_plot(
    key: str,
    series: Sequence[HeldOutSeries],
    floor: NoiseFloor,
    shown: Sequence[Curve],
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
    scale, unit, reach = 1e3, "height / mm", floor.height_rmse_m
    if of_force:
        scale, unit, reach = 1.0, "strut force / N", floor.residual_force_rmse_n
    over_time = 1 + of_force
    rows = over_time + len(shown)
    specs: list[object] = [[{"colspan": 2}, None]] * rows
    specs[:of_force] = [[{}, {}]] * of_force
    figure = _panels(rows, 2, vertical_spacing=0.38 / rows, horizontal_spacing=0.11, specs=specs)
    worst = max(series, key=lambda item: _largest(item.before - item.measured))
    part = excerpt(worst)
    against = [((over_time, 1), "time / s", worst.t_s)]
    if of_force:
        against.append(((1, 1), "velocity / m/s", worst.velocity_m_per_s))
        against.append(((1, 2), "height / mm", 1e3 * worst.height_m))
    # An envelope is of a series over time, and would tear a loop.
    thin = slice(part.start, part.stop, max(1, (part.stop - part.start) // points))
    models = list(zip(shown, (worst.before, worst.after), strict=False))
    for panel, title, x in against:
        _axes(figure, panel, title, unit)
        for curve, values in [(_MEASURED, worst.measured), *models]:
            style = {"color": curve.colour, "dash": curve.dash, "width": curve.width}
            y, legend = scale * values[thin], panel == (1, 1)
            _trace(figure, panel, x[thin], y, curve.name, legend=legend, line=style)
    errors = [
        scale * np.column_stack([run.before - run.measured, run.after - run.measured])
        for run in series
    ]
    joined = join(series, errors)
    title = unit.replace(" /", " error /")
    for row in range(over_time + 1, rows + 1):
        # The last panel shows the last curve alone, at its own scale, where it can be judged.
        first = row - over_time - 1
        columns = list(joined.values.T[first:])
        _lines(figure, (row, 1), joined.t_s, columns, shown[first:], points)
        _over_time(figure, joined, (row, 1), title, _WIDE_SIGMA * scale * reach, _LONGEST_MARK)
    _band_legend(figure, _FLOOR_BAND)
    what = (
        "Load cell and model along prescribed motions that are held-out data. A loop over velocity "
        "is an internal state or a spring, a loop over height is what the damper dissipates."
        if of_force
        else "Heights that are held-out data; the applied force is the model's only input."
    )
    last = " and, last, the error after the correction at its own scale" if len(shown) > 1 else ""
    caption = (
        f"{what} First a few periods of “{worst.run}” where the nominal model errs most, then the "
        f"error (model less measured) over all held-out data{last}."
    )
    kind = "force along the prescribed motion" if of_force else "free-run simulation"
    return _plot(key, f"Held-out data: {kind}", caption, figure, 120 + 230 * rows)


def _residuals(series: Sequence[FittedSeries]) -> Joined:
    columns: list[Array] = []
    for run in series:
        residuals = run.residual_before_n, run.residual_after_n, run.residual_std_n
        columns.append(np.column_stack([run.height_m * 1e3, run.velocity_m_per_s, *residuals]))
    return join(series, columns)


def _reach_n(joined: Joined) -> float:
    finite = joined.values[np.isfinite(joined.values[:, 4]), 4]
    return _WIDE_SIGMA * float(np.median(finite)) if len(finite) else 0.0


def _clouds(
    figure: Any, joined: Joined, shown: Sequence[Curve], points: int, *, first: int = 0
) -> None:
    there = np.flatnonzero(np.all(np.isfinite(joined.values[:, :4]), axis=1))
    for column, title in enumerate(("height / mm", "velocity / m/s")):
        panel = (1, column + 1)
        _axes(figure, panel, title, "residual force / N")
        _band(figure, panel, _reach_n(joined))
        if len(there) == 0:
            continue
        against = joined.values[:, column]
        kept = there[cloud(against[there], joined.values[there, 2:4], points // 2)]
        for index, curve in enumerate(shown[first:], first):
            style = {"marker": {"size": 3.2, "color": curve.colour, "opacity": 0.55}}
            x, y = against[kept], joined.values[kept, 2 + index]
            _trace(figure, panel, x, y, curve.name, legend=column == 0, **style)


def _spectra(figure: Any, series: Sequence[FittedSeries], shown: Sequence[Curve]) -> None:
    _axes(figure, (2, 2), "frequency / Hz", "residual force / N/√Hz", type="log", dtick=1)
    found = spectrum(series)
    if found is None:
        return
    densities = (found.before_n_per_sqrt_hz, found.after_n_per_sqrt_hz)[: len(shown)]
    _lines(figure, (2, 2), found.frequency_hz, densities, shown, len(densities[0]))
    highest = max(_largest(density) for density in densities)
    if highest > 0.0:
        # Far below the peak, a smoothed residual only shows the smoother's own roll-off.
        top = math.log10(highest) + 0.3
        figure.update_yaxes(range=[top - _DECADES, top], row=2, col=2)


def _over_time(
    figure: Any,
    joined: Joined,
    panel: _Panel,
    title: str,
    reach: float,
    room: int = _LONGEST_MARK // 2,
) -> None:
    """Axes, band, and where each recording begins."""
    several = len(joined.names) > 1
    _axes(figure, panel, f"time / s{' (one after another)' if several else ''}", title)
    _band(figure, panel, reach)
    if not several:
        return
    row, col = panel
    ends = (*joined.begins[1:], float(joined.t_s[-1]))
    whole_s = max(ends[-1] - joined.begins[0], 1e-9)
    for begin_s, end_s, name in zip(joined.begins, ends, joined.names, strict=True):
        # A short run has little room above it; names that run into each other say nothing.
        length = int(2.0 * room * (end_s - begin_s) / whole_s)
        short = name if len(name) <= length else f"{name[: max(length - 1, 1)]}…"
        figure.add_vline(x=begin_s, line={"color": "#9aa5b1", "width": 1}, row=row, col=col)
        figure.add_annotation(
            x=begin_s, y=1.0, yref="y domain", text=escape(short, quote=False), showarrow=False,
            xanchor="left", yanchor="bottom", font={"size": 10}, row=row, col=col,
        )  # fmt: skip


def _band(figure: Any, panel: _Panel, reach: float) -> None:
    if not (math.isfinite(reach) and reach > 0.0):
        return
    place = {"y0": -reach, "y1": reach, "row": panel[0], "col": panel[1]}
    for layer, fill, width in (("below", _NOISE, 0), ("above", "rgba(0,0,0,0)", 1)):
        line = {"width": width, "color": "#52606d", "dash": "dash"}
        figure.add_hrect(fillcolor=fill, line=line, layer=layer, **place)


def _band_legend(figure: Any, name: str) -> None:
    marker = {"symbol": "square", "size": 12, "color": _NOISE}
    nowhere = {"x": [None], "y": [None], "mode": "markers"}
    figure.add_trace({"type": "scatter", **nowhere, "name": name, "marker": marker})


def _lines(
    figure: Any,
    panel: _Panel,
    x: Array,
    columns: Sequence[Array],
    shown: Sequence[Curve],
    points: int,
) -> None:
    for curve, values in zip(shown, columns, strict=False):
        kept, style = envelope(values, points), {"color": curve.colour, "width": 1.1}
        _trace(figure, panel, x[kept], values[kept], curve.name, line=style)


def _trace(
    figure: Any, panel: _Panel, x: Array, y: Array, name: str, *, legend: bool = False, **style: Any
) -> None:
    mode = "lines" if "line" in style else "markers"
    points = {"type": "scatter", "mode": mode, "x": _short(x), "y": _short(y), **style}
    labels = {"name": name, "legendgroup": name, "showlegend": legend}
    figure.add_trace(points | labels, row=panel[0], col=panel[1])


def _axes(figure: Any, panel: _Panel, x: str, y: str, **options: object) -> None:
    figure.update_xaxes(title_text=x, row=panel[0], col=panel[1], **options)
    figure.update_yaxes(title_text=y, row=panel[0], col=panel[1], **options)


def _panels(rows: int, cols: int, **options: object) -> Any:
    return cast("Any", subplots).make_subplots(rows=rows, cols=cols, **options)


def _largest(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.max(finite)) if len(finite) else 0.0


def _short(values: Array) -> Any:
    # Half the bytes, and still far more digits than a screen has pixels.
    return values.astype(np.float32)


def _plot(key: str, title: str, caption: str, figure: Any, height_px: int) -> Plot:
    axis = {
        "gridcolor": "#e4e7eb", "linecolor": "#9aa5b1", "zeroline": False, "showline": True,
        "ticks": "outside", "tickcolor": "#9aa5b1", "title_standoff": 6,
    }  # fmt: skip
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    legend = {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "itemsizing": "constant"}
    figure.update_layout(
        template="none",
        height=height_px,
        margin={"l": 66, "r": 16, "t": 44, "b": 52},
        font={"family": "system-ui, sans-serif", "size": 12.5, "color": "#1f2933"},
        paper_bgcolor="#ffffff",
        plot_bgcolor="#ffffff",
        legend=legend,
        hoverlabel={"font": {"size": 12}},
    )
    text = cast("str", cast("Any", graph_objects).Figure(figure).to_json())
    # Plotly escapes what could end a script element; this holds whatever it does.
    return Plot(key, title, caption, text.replace("<", "\\u003c"), height_px)
