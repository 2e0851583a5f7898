"""The plots of a report, as plotly figures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple, cast

import numpy as np
from plotly import graph_objects, subplots

from rig.identify.report.inputs import Array, FittedSeries, HeldOutForce, HeldOutSeries
from rig.identify.report.series import Joined, cloud, envelope, excerpt, join, spectrum, surface

# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
_BEFORE = "#d55e00"
_AFTER = "#0072b2"
_MEASURED = "#111111"
_NOISE = "rgba(110, 110, 110, 0.22)"
_GRID = "#e4e7eb"
_INK = "#1f2933"
_LONGEST_MARK = 60
_WIDE_SIGMA = 2.0
_SMOOTHED_BAND = f"±{_WIDE_SIGMA:.0f} standard deviations of the smoothed residual"
_FLOOR_BAND = f"±{_WIDE_SIGMA:.0f} × noise floor"
_DECADES = 5.0


class _Curve(NamedTuple):
    name: str
    colour: str


_BOTH = (
    _Curve("before: model as given", _BEFORE),
    _Curve("after: corrected model", _AFTER),
)
_GIVEN = (_Curve("model as given", _BEFORE),)


def curves(*, corrected: bool) -> tuple[_Curve, ...]:
    """What is shown: before and after, or the model as given where nothing was corrected."""
    return _BOTH if corrected else _GIVEN


@dataclass(frozen=True)
class Plot:
    """A figure of the page.

    Attributes:
        key: Unique name in the page.
        title: Heading.
        caption: What to see, one or two sentences.
        json: The figure as plotly's JSON, safe inside a script element.
        height_px: Height.
    """

    key: str
    title: str
    caption: str
    json: str
    height_px: int


def residual_plot(
    key: str, series: Sequence[FittedSeries], shown: Sequence[_Curve], points: int
) -> Plot:
    """Residual against height, velocity, time and frequency.

    Args:
        key: Unique name in the page.
        series: One strut along all fitted runs.
        shown: Curves, from `curves`.
        points: Points of a line; markers are half as many.
    """
    figure = cast("Any", subplots).make_subplots(
        rows=2, cols=2, horizontal_spacing=0.11, vertical_spacing=0.16
    )
    joined = _residuals(series)
    for column in (0, 1):
        _markers(figure, joined, column, shown, points // 2)
    for index, curve in enumerate(shown):
        style = {"color": curve.colour, "width": 1.1}
        values = joined.values[:, 2 + index]
        _line(figure, joined.t_s, values, curve.name, style, points, (2, 1), legend=False)
    _run_marks(figure, joined, 2, _LONGEST_MARK // 2)
    figure.update_xaxes(title_text=_time_title(joined), row=2, col=1)
    for row, col in ((1, 1), (1, 2), (2, 1)):
        _band(figure, _reach_n(joined), row, col)
        figure.update_yaxes(title_text="residual force / N", row=row, col=col)
    _spectra(figure, series, shown)
    _band_legend(figure, _SMOOTHED_BAND)
    return Plot(
        key,
        "What force is missing",
        "The force that the model lacks, smoothed over the whole run. Friction steps with the sign "
        "of the velocity, a stop rises at one end of the height, a missing damper is a line over "
        "velocity. A complete model leaves the grey band.",
        _json(figure, 720),
        720,
    )


def left_plot(key: str, series: Sequence[FittedSeries], points: int) -> Plot:
    """Residual of the corrected model against height and velocity, at its own scale."""
    figure = cast("Any", subplots).make_subplots(rows=1, cols=2, horizontal_spacing=0.11)
    joined = _residuals(series)
    for column in (0, 1):
        _markers(figure, joined, column, _BOTH, points // 2, first=1)
        _band(figure, _reach_n(joined), 1, column + 1)
        figure.update_yaxes(title_text="residual force / N", row=1, col=column + 1)
    _band_legend(figure, _SMOOTHED_BAND)
    return Plot(
        key,
        "What force is left",
        "The same residual after the correction, at its own scale: a pattern here is something "
        "that is still missing, an even band is noise.",
        _json(figure, 340),
        340,
    )


def surface_plot(key: str, series: Sequence[FittedSeries], shown: Sequence[_Curve]) -> Plot | None:
    """Restoring-force surface, or None if nothing moves."""
    found = surface(series)
    if found is None:
        return None
    figure = cast("Any", subplots).make_subplots(
        rows=1, cols=len(shown), horizontal_spacing=0.07, shared_yaxes=True,
        subplot_titles=[curve.name for curve in shown],
    )  # fmt: skip
    forces = (found.before_n, found.after_n)[: len(shown)]
    largest = max(_largest(force) for force in forces) or 1.0
    for index, force in enumerate(forces):
        figure.add_trace(
            {
                "type": "heatmap",
                "x": _short(found.height_m * 1e3),
                "y": _short(found.velocity_m_per_s),
                "z": _short(force),
                "customdata": found.samples.astype(np.int32),
                "coloraxis": "coloraxis",
                "hoverongaps": False,
                "hovertemplate": "height %{x:.1f} mm<br>velocity %{y:.3f} m/s<br>"
                "mean residual %{z:.2f} N<br>%{customdata} samples<extra></extra>",
            },
            row=1,
            col=index + 1,
        )
        figure.update_xaxes(title_text="height / mm", showgrid=False, row=1, col=index + 1)
    figure.update_yaxes(showgrid=False)
    figure.update_yaxes(title_text="velocity / m/s", row=1, col=1)
    figure.update_layout(
        coloraxis={
            "colorscale": "RdBu",
            "cmin": -largest,
            "cmax": largest,
            "colorbar": {"title": {"text": "mean residual / N", "side": "right"}, "thickness": 14},
        }
    )
    return Plot(
        key,
        "Restoring-force surface",
        "Mean missing force over height and velocity: blue pushes the bodies apart, red pulls them "
        "together. A cell is left empty where it holds fewer than "
        f"{found.least_count} samples: there the runs say nothing.",
        _json(figure, 430),
        430,
    )


def held_out_plot(
    key: str,
    series: Sequence[HeldOutSeries],
    floor_m: float,
    shown: Sequence[_Curve],
    points: int,
) -> Plot:
    """Open-loop heights and their errors on held-out data.

    Args:
        key: Unique name in the page.
        series: One strut along all held-out runs.
        floor_m: Noise floor of the height, RMS.
        shown: Curves, from `curves`.
        points: Points of a line.
    """
    rows = 1 + len(shown)
    height_px = 120 + 230 * rows
    figure = cast("Any", subplots).make_subplots(rows=rows, cols=1, vertical_spacing=0.38 / rows)
    worst = max(series, key=lambda item: _largest(item.height_before_m - item.height_m))
    _heights(figure, worst, shown, points)
    joined = join(series, [1e3 * _errors(item) for item in series])
    for index, curve in enumerate(shown):
        # The last panel shows the last curve alone, at its own scale, where it can be judged.
        style = {"color": curve.colour, "width": 1.1}
        for row in sorted({2, 2 + index}):
            values = joined.values[:, index]
            _line(figure, joined.t_s, values, curve.name, style, points, (row, 1), legend=False)
    for row in range(2, rows + 1):
        _run_marks(figure, joined, row, _LONGEST_MARK)
        _band(figure, _WIDE_SIGMA * floor_m * 1e3, row, 1)
        figure.update_yaxes(title_text="height error / mm", row=row, col=1)
        figure.update_xaxes(title_text=_time_title(joined), row=row, col=1)
    _band_legend(figure, _FLOOR_BAND)
    last = " and, last, the error after the correction at its own scale" if rows > 2 else ""
    return Plot(
        key,
        "Held-out data: the model running alone",
        "Heights that had no part in the choice; the applied force is the model's only input. "
        f"First a few periods of “{worst.run}” where the model as given errs most, then the error "
        f"(model less measured) over all held-out data{last}.",
        _json(figure, height_px),
        height_px,
    )


def held_out_force_plot(
    key: str,
    series: Sequence[HeldOutForce],
    floor_n: float,
    shown: Sequence[_Curve],
    points: int,
) -> Plot:
    """Forces along held-out imposed motions: over velocity and height, over time, and their errors.

    Args:
        key: Unique name in the page.
        series: One strut along all held-out runs.
        floor_n: Noise floor of the force, RMS.
        shown: Curves, from `curves`.
        points: Points of a line.
    """
    figure = cast("Any", subplots).make_subplots(
        rows=3, cols=2, horizontal_spacing=0.11, vertical_spacing=0.12,
        specs=[[{}, {}], [{"colspan": 2}, None], [{"colspan": 2}, None]],
    )  # fmt: skip
    worst = max(series, key=lambda item: _largest(item.force_before_n - item.force_n))
    part = excerpt(worst)
    loops = (
        ("velocity / m/s", worst.velocity_m_per_s[part], 1),
        ("height / mm", 1e3 * worst.height_m[part], 2),
    )
    for title, against, column in loops:
        _forces(figure, worst, part, against, shown, points, (1, column))
        figure.update_xaxes(title_text=title, row=1, col=column)
    _forces(figure, worst, part, worst.t_s[part], shown, points, (2, 1))
    figure.update_xaxes(title_text="time / s", row=2, col=1)
    joined = join(
        series,
        [
            np.column_stack([item.force_before_n, item.force_after_n]) - item.force_n[:, np.newaxis]
            for item in series
        ],
    )
    for index, curve in enumerate(shown):
        style = {"color": curve.colour, "width": 1.1}
        values = joined.values[:, index]
        _line(figure, joined.t_s, values, curve.name, style, points, (3, 1), legend=False)
    _run_marks(figure, joined, 3, _LONGEST_MARK)
    _band(figure, _WIDE_SIGMA * floor_n, 3, 1)
    figure.update_yaxes(title_text="force error / N", row=3, col=1)
    figure.update_xaxes(title_text=_time_title(joined), row=3, col=1)
    _band_legend(figure, _FLOOR_BAND)
    return Plot(
        key,
        "Held-out data: force along the imposed motion",
        "Load cell and model, driven along motions that had no part in the choice. First a few "
        f"periods of “{worst.run}” where the model as given errs most, over velocity, height and "
        "time, then the error (model less load cell) over all held-out data. A loop over velocity "
        "is memory or a spring, a loop over height is what the damper dissipates.",
        _json(figure, 860),
        860,
    )


def _forces(
    figure: Any,
    run: HeldOutForce,
    part: slice,
    against: Array,
    shown: Sequence[_Curve],
    points: int,
    panel: tuple[int, int],
) -> None:
    legend = panel == (1, 1)
    measured: dict[str, object] = {"color": _MEASURED, "width": 3.2}
    every = max(1, len(against) // points)
    thin = slice(None, None, every)
    x, force = against[thin], run.force_n[part][thin]
    _line(figure, x, force, "measured", measured, len(x), panel, legend=legend)
    for curve, model_n, dash in zip(
        shown, (run.force_before_n, run.force_after_n), ("solid", "dot"), strict=False
    ):
        style = {"color": curve.colour, "width": 1.6, "dash": dash}
        _line(figure, x, model_n[part][thin], curve.name, style, len(x), panel, legend=legend)
    figure.update_yaxes(title_text="strut force / N", row=panel[0], col=panel[1])


def _heights(figure: Any, run: HeldOutSeries, shown: Sequence[_Curve], points: int) -> None:
    part = excerpt(run)
    measured: dict[str, object] = {"color": _MEASURED, "width": 3.2}
    _line(figure, run.t_s[part], run.height_m[part] * 1e3, "measured", measured, points, (1, 1))
    for curve, height_m, dash in zip(
        shown, (run.height_before_m, run.height_after_m), ("solid", "dot"), strict=False
    ):
        style = {"color": curve.colour, "width": 1.6, "dash": dash}
        _line(figure, run.t_s[part], height_m[part] * 1e3, curve.name, style, points, (1, 1))
    figure.update_yaxes(title_text="height / mm", row=1, col=1)
    figure.update_xaxes(title_text="time / s", row=1, col=1)


def _errors(run: HeldOutSeries) -> Array:
    return np.column_stack([run.height_before_m - run.height_m, run.height_after_m - run.height_m])


def _residuals(series: Sequence[FittedSeries]) -> Joined:
    columns = [
        np.column_stack(
            [
                item.height_m * 1e3,
                item.velocity_m_per_s,
                item.residual_before_n,
                item.residual_after_n,
                item.residual_std_n,
            ]
        )
        for item in series
    ]
    return join(series, columns)


def _reach_n(joined: Joined) -> float:
    finite = joined.values[np.isfinite(joined.values[:, 4]), 4]
    return _WIDE_SIGMA * float(np.median(finite)) if len(finite) else 0.0


def _band(figure: Any, reach: float, row: int, col: int) -> None:
    if not (math.isfinite(reach) and reach > 0.0):
        return
    for layer, fill, width in (("below", _NOISE, 0), ("above", "rgba(0,0,0,0)", 1)):
        line = {"width": width, "color": "#52606d", "dash": "dash"}
        figure.add_hrect(
            y0=-reach, y1=reach, fillcolor=fill, line=line, layer=layer, row=row, col=col
        )


def _band_legend(figure: Any, name: str) -> None:
    figure.add_trace(
        {
            "type": "scatter",
            "x": [None],
            "y": [None],
            "mode": "markers",
            "name": name,
            "marker": {"symbol": "square", "size": 12, "color": _NOISE},
        }
    )


def _markers(
    figure: Any,
    joined: Joined,
    column: int,
    shown: Sequence[_Curve],
    points: int,
    *,
    first: int = 0,
) -> None:
    title = ("height / mm", "velocity / m/s")[column]
    figure.update_xaxes(title_text=title, row=1, col=column + 1)
    against = joined.values[:, column]
    there = np.flatnonzero(np.all(np.isfinite(joined.values[:, :4]), axis=1))
    if len(there) == 0:
        return
    kept = there[cloud(against[there], joined.values[there, 2:4], points)]
    for index, curve in enumerate(shown):
        if index < first:
            continue
        figure.add_trace(
            {
                "type": "scatter",
                "mode": "markers",
                "x": _short(against[kept]),
                "y": _short(joined.values[kept, 2 + index]),
                "name": curve.name,
                "legendgroup": curve.name,
                "showlegend": column == 0,
                "marker": {"size": 3.2, "color": curve.colour, "opacity": 0.55},
            },
            row=1,
            col=column + 1,
        )


def _line(
    figure: Any,
    t_s: Array,
    values: Array,
    name: str,
    style: Mapping[str, object],
    points: int,
    panel: tuple[int, int],
    *,
    legend: bool = True,
) -> None:
    kept = envelope(values, points)
    figure.add_trace(
        {
            "type": "scatter",
            "mode": "lines",
            "x": _short(t_s[kept]),
            "y": _short(values[kept]),
            "name": name,
            "legendgroup": name,
            "showlegend": legend,
            "line": dict(style),
        },
        row=panel[0],
        col=panel[1],
    )


def _run_marks(figure: Any, joined: Joined, row: int, room: int) -> None:
    if len(joined.names) < 2:
        return
    ends = (*joined.begins[1:], float(joined.t_s[-1]))
    whole_s = max(ends[-1] - joined.begins[0], 1e-9)
    for begin_s, end_s, name in zip(joined.begins, ends, joined.names, strict=True):
        # A short run has little room above it; names that run into each other say nothing.
        length = int(2.0 * room * (end_s - begin_s) / whole_s)
        short = name if len(name) <= length else f"{name[: max(length - 1, 1)]}…"
        figure.add_vline(x=begin_s, line={"color": "#9aa5b1", "width": 1}, row=row, col=1)
        figure.add_annotation(
            x=begin_s, y=1.0, yref="y domain", text=escape(short, quote=False), showarrow=False,
            xanchor="left", yanchor="bottom", font={"size": 10}, row=row, col=1,
        )  # fmt: skip


def _spectra(figure: Any, series: Sequence[FittedSeries], shown: Sequence[_Curve]) -> None:
    figure.update_xaxes(title_text="frequency / Hz", type="log", dtick=1, row=2, col=2)
    figure.update_yaxes(title_text="residual force / N/√Hz", type="log", dtick=1, row=2, col=2)
    found = spectrum(series)
    if found is None:
        return
    densities = (found.before_n_per_sqrt_hz, found.after_n_per_sqrt_hz)[: len(shown)]
    for curve, density in zip(shown, densities, strict=True):
        style = {"color": curve.colour, "width": 1.3}
        limit = len(density)
        _line(figure, found.frequency_hz, density, curve.name, style, limit, (2, 2), legend=False)
    highest = max(_largest(density) for density in densities)
    if highest > 0.0:
        # Far below the peak, a smoothed residual only shows the smoother's own roll-off.
        top = math.log10(highest) + 0.3
        figure.update_yaxes(range=[top - _DECADES, top], row=2, col=2)


def _time_title(joined: Joined) -> str:
    return "time / s" if len(joined.names) < 2 else "time / s (runs one after another)"


def _largest(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.max(finite)) if len(finite) else 0.0


def _short(values: Array) -> Any:
    # Half the bytes, and still far more digits than a screen has pixels.
    return values.astype(np.float32)


def _json(figure: Any, height_px: int) -> str:
    axis = {
        "gridcolor": _GRID, "linecolor": "#9aa5b1", "zeroline": False, "showline": True,
        "ticks": "outside", "tickcolor": "#9aa5b1", "title_standoff": 6,
    }  # fmt: skip
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    figure.update_layout(
        template="none",
        height=height_px,
        margin={"l": 66, "r": 16, "t": 44, "b": 52},
        font={"family": "system-ui, sans-serif", "size": 12.5, "color": _INK},
        paper_bgcolor="#ffffff",
        plot_bgcolor="#ffffff",
        legend={
            "orientation": "h",
            "x": 0,
            "y": 1.02,
            "yanchor": "bottom",
            "itemsizing": "constant",
        },
        hoverlabel={"font": {"size": 12}},
    )
    text = cast("str", cast("Any", graph_objects).Figure(figure).to_json())
    # Plotly escapes what could end a script element; this holds whatever it does.
    return text.replace("<", "\\u003c")
