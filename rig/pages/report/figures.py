"""The plots of a report: panels of lines, points and cells, as the page's script draws them."""

import base64
import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.diagnosis.outcome import Array, FittedSeries, HeldOutSeries, NoiseFloor
from rig.pages.report.series import Joined, cloud, envelope, excerpt, join, spectrum, surface

_LONGEST_MARK = 60
_WIDE_SIGMA = 2.0
_SMOOTHED_BAND = f"grey: ±{_WIDE_SIGMA:.0f} standard deviations of the smoothed residual"
_FLOOR_BAND = f"grey: ±{_WIDE_SIGMA:.0f} × noise floor"
_DECADES = 5.0


class Curve(NamedTuple):
    """What is shown, and how where it lies beside what was measured.

    Attributes:
        name: Its name in the legend.
        colour: Name of its colour in the page's style.
        dash: Lengths of dashes and gaps in px; none for a line without gaps.
        width: Width of the line in px.
    """

    name: str
    colour: str
    dash: tuple[int, ...]
    width: float


# Okabe and Ito's colours, which stay apart for colour-blind readers and in grey print.
_BOTH = (
    Curve("before: nominal model", "--before", (), 1.6),
    Curve("after: corrected model", "--after", (4, 3), 1.6),
)
_MEASURED = Curve("measured", "--measured", (), 3.2)


class Panel(NamedTuple):
    """One pair of axes.

    Attributes:
        kind: ``lines`` over a common abscissa, ``points`` in a plane, or ``cells`` of one.
        x_label: What the abscissa is, with its unit.
        y_label: The same of the ordinate.
        x: The common abscissa, shape (N,); that of the cells' middles for ``cells``.
        curves: How each is shown.
        values: Ordinates of each curve, shape (N,); the cells' values, row by row, for ``cells``.
        extra: What else the page's script is given: `title`, `reach` of a grey band about zero,
            `marks` where recordings begin, `log` for both axes, `y_range`, `gaps` that are bridged,
            `steps` of a histogram, and `largest` and `y` of the cells.
    """

    kind: str
    x_label: str
    y_label: str
    x: Array
    curves: Sequence[Curve]
    values: Sequence[Array]
    extra: dict[str, Any]


class Plot(NamedTuple):
    """A figure of the page.

    Attributes:
        key: Unique name in the page.
        title: Heading.
        caption: What is seen, and how it is read.
        panels: Labels of the panels.
        columns: How many panels stand beside one another.
        json: What the page's script draws, safe inside a script element.
    """

    key: str
    title: str
    caption: str
    panels: Sequence[str]
    columns: int
    json: str


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
    joined = _residuals(series)
    over_time = _over_time(
        joined, list(joined.values.T[2:4]), shown, points, "residual force / N", _reach_n(joined)
    )
    panels = [*_clouds(joined, shown, points), over_time, *_spectra(series, shown)]
    caption = (
        "The force that would make the residual vanish, smoothed over the whole recording "
        f"({_SMOOTHED_BAND}). Friction steps with the sign of the velocity, a stop rises at one "
        "end of the height, a damper too weak is a line over velocity. A complete model leaves the "
        "grey band."
    )
    return plot(key, "Residual force", caption, panels, 2)


def left_plot(key: str, series: Sequence[FittedSeries], points: int) -> Plot:
    """Residual force of the corrected model against height and velocity, at its own scale."""
    panels = _clouds(_residuals(series), _BOTH, points, first=1)
    caption = (
        "The residual force after the correction, at its own scale: a pattern here is something "
        f"that is still missing, an even band is noise ({_SMOOTHED_BAND})."
    )
    return plot(key, "Residual force of the corrected model", caption, panels, 2)


def surface_plot(key: str, series: Sequence[FittedSeries], shown: Sequence[Curve]) -> Plot | None:
    """Restoring-force surface, or None if nothing moves."""
    found = surface(series)
    if found is None:
        return None
    forces = (found.before_n, found.after_n)[: len(shown)]
    largest = max(_largest(force) for force in forces) or 1.0
    panels = [
        Panel(
            "cells",
            "height / mm",
            "velocity / (m/s)",
            found.height_m * 1e3,
            (curve,),
            (force.ravel(),),
            {
                "title": curve.name,
                "y": _packed(found.velocity_m_per_s),
                "largest": largest,
            },
        )
        for curve, force in zip(shown, forces, strict=True)
    ]
    caption = (
        f"Mean residual force over height and velocity: blue pushes the bodies apart, up to "
        f"{largest:.3g} N, red pulls them together. A cell is left empty where it holds fewer than "
        f"{found.least_count} samples: there the recordings say nothing."
    )
    return plot(key, "Restoring-force surface", caption, panels, len(shown))


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
            ("velocity / (m/s)", worst.velocity_m_per_s),
            ("height / mm", 1e3 * worst.height_m),
        ]
        panels += [Panel("loops", title, unit, x[thin], both, values, {}) for title, x in against]
    panels.append(Panel("lines", "time / s", unit, worst.t_s[thin], both, values, {}))
    errors = [
        scale * np.column_stack([run.before - run.measured, run.after - run.measured])
        for run in series
    ]
    joined, title = join(series, errors), unit.replace(" /", " error /")
    for first in range(len(shown)):
        # The last panel shows the last curve alone, at its own scale, where it can be judged.
        columns = list(joined.values.T[first : len(shown)])
        wide = _WIDE_SIGMA * scale * reach
        panels.append(_over_time(joined, columns, shown[first:], points, title, wide))
    what = (
        "Load cell and model along prescribed motions that are held-out data. A loop over velocity "
        "is an internal state or a spring, a loop over height is what the damper dissipates."
        if of_force
        else "Heights that are held-out data; the applied force is the model's only input."
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
        columns.append(np.column_stack([run.height_m * 1e3, run.velocity_m_per_s, *residuals]))
    return join(series, columns)


def _reach_n(joined: Joined) -> float:
    finite = joined.values[np.isfinite(joined.values[:, 4]), 4]
    return _WIDE_SIGMA * float(np.median(finite)) if len(finite) else 0.0


def _clouds(joined: Joined, shown: Sequence[Curve], points: int, *, first: int = 0) -> list[Panel]:
    there = np.flatnonzero(np.all(np.isfinite(joined.values[:, :4]), axis=1))
    panels: list[Panel] = []
    for column, title in enumerate(("height / mm", "velocity / (m/s)")):
        against = joined.values[:, column]
        kept = there[cloud(against[there], joined.values[there, 2:4], points // 2)]
        values = [joined.values[kept, 2 + index] for index in range(first, len(shown))]
        extra = {"reach": _finite(_reach_n(joined))}
        panels.append(
            Panel(
                "points", title, "residual force / N", against[kept], shown[first:], values, extra
            )
        )
    return panels


def _spectra(series: Sequence[FittedSeries], shown: Sequence[Curve]) -> list[Panel]:
    found = spectrum(series)
    if found is None:
        return []
    densities = (found.before_n_per_sqrt_hz, found.after_n_per_sqrt_hz)[: len(shown)]
    extra: dict[str, Any] = {"log": True}
    highest = max(_largest(density) for density in densities)
    if highest > 0.0:
        # Far below the peak, a smoothed residual only shows the smoother's own roll-off.
        top = math.log10(highest) + 0.3
        extra["y_range"] = [10.0 ** (top - _DECADES), 10.0**top]
    label = "residual force / (N/√Hz)"
    thin = [_thin(curve) for curve in shown]
    return [Panel("lines", "frequency / Hz", label, found.frequency_hz, thin, densities, extra)]


def _over_time(
    joined: Joined,
    columns: Sequence[Array],
    shown: Sequence[Curve],
    points: int,
    label: str,
    reach: float,
) -> Panel:
    """Lines over the time of all recordings, with a band and marks where each begins."""
    several = len(joined.names) > 1
    kept = np.unique(
        np.concatenate([envelope(column, points // len(columns)) for column in columns])
    )
    extra: dict[str, Any] = {"reach": _finite(reach)}
    if several:
        ends = (*joined.begins[1:], float(joined.t_s[-1]))
        extra["marks"] = [
            {"begin": begin, "end": end, "name": name}
            for begin, end, name in zip(joined.begins, ends, joined.names, strict=True)
        ]
    return Panel(
        "lines",
        f"time / s{' (one after another)' if several else ''}",
        label,
        joined.t_s[kept],
        [_thin(curve) for curve in shown],
        [column[kept] for column in columns],
        extra,
    )


def _thin(curve: Curve) -> Curve:
    return curve._replace(dash=(), width=1.1)


def _finite(reach: float) -> float:
    return reach if math.isfinite(reach) and reach > 0.0 else 0.0


def _largest(values: Array) -> float:
    finite = np.abs(values[np.isfinite(values)])
    return float(np.max(finite)) if len(finite) else 0.0


def _packed(values: Array) -> str:
    # Half the bytes, and still far more digits than a screen has pixels.
    return base64.b64encode(values.astype("<f4").tobytes()).decode("ascii")


def plot(key: str, title: str, caption: str, panels: Sequence[Panel], columns: int) -> Plot:
    """A figure of panels, `columns` of them beside one another."""
    drawn = [
        {
            "kind": panel.kind,
            "xLabel": panel.x_label,
            "yLabel": panel.y_label,
            "x": base64.b64encode(panel.x.astype("<f8").tobytes()).decode("ascii"),
            "curves": [curve._asdict() for curve in panel.curves],
            "values": [_packed(values) for values in panel.values],
            **panel.extra,
        }
        for panel in panels
    ]
    labels = [f"{panel.y_label} over {panel.x_label}" for panel in panels]
    # What could end a script element is written so that it cannot.
    text = json.dumps(drawn, allow_nan=False).replace("<", "\\u003c")
    return Plot(key, title, caption, labels, columns, text)
