"""The report of a run: configuration, timing, faults and curves. One file, no network."""

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from dart_model.virtual_sensors import QUANTITIES
from rig.bridge.values import Mode
from rig.log.checksums import Damage, find_damage, refuse_damage
from rig.log.follower import FORCE_ERROR, RunFollower
from rig.log.reader import Ending, RunHeader, read_header
from rig.pages.html import render_report, write_page
from rig.pages.identity import identity_rows
from rig.pages.mode_band import last_entry, list_events, make_band, read_events, time_s
from rig.pages.mode_words import COUNT_WORDS, LoggedEvent, describe_cause
from rig.pages.number_formats import number, percent, quantity
from rig.pages.plotted_quantities import (
    LOAD_CELL,
    TICK_CURVES,
    TICK_TIME,
    TIME,
    TIME_PLOTS,
    VIRTUAL_FORCE_PLOT,
    Origin,
    PlottedQuantity,
)
from rig.pages.report.figures import LineStyle, Panel, Plot, plot
from rig.run.changed_settings import read_changes
from rig.run.timing import read_histograms

_POINTS = 1500
"""Buckets of a curve: about as many as the page has pixels in its width."""

_ALL_STEPS = 1_000_000_000

_STYLES = {
    Origin.MEASURED: ("--measured", 2.4),
    Origin.MODEL: ("--after", 1.2),
    Origin.ESTIMATED: ("--after", 1.2),
    Origin.OBSERVER: ("--virtual", 1.2),
    Origin.ERROR: ("--error", 1.2),
}
"""Colour and width in px of a line, by where its values come from."""

_TICK_COLOURS = ("--before", "--after")

_STATUS = {
    "done": ("good", "✓", "Ended in order"),
    "safe": ("bad", "✕", "Ended in its safe state"),
    "waiting": ("bad", "✕", "No valid height arrived"),
    "failed": ("bad", "✕", "Failed"),
}
_KILLED = ("part", "◐", "Killed, or still running")
_NOT_ALWAYS_VALID = ("part", "◐", "Ended in order, not valid all the time")
_MOST_COMPARED = 3_600_000
"""Cycles at the end of a run over which the force error is computed: an hour at 1 kHz."""
_CYCLES_AT_ONCE = 60_000
"""Cycles that are held in memory for it."""

_LOST_MODES = ("HOLD", "SAFE")


def write_run_report(
    folder: Path, path: Path, labels: Mapping[str, str] | None = None
) -> tuple[Damage, ...]:
    """Write the report of a run's folder; returns what of the run is damaged.

    `labels` are rows of the report's head, such as an operator's name.

    Raises:
        DamageError: Frames or steps are not what was written; what is merely cut off is reported.
        InputError: The folder holds no run, or a run without a tick, or the file cannot be written.
    """
    header, damage = read_header(folder), find_damage(folder)
    if not all(item.is_readable for item in damage):
        refuse_damage(folder, damage)
    follower = RunFollower(folder)
    follower.update(_ALL_STEPS)
    if not follower.steps:
        refuse_damage(folder, damage)
        raise InputError(f"{folder}: holds no tick, expected a run to report on")
    struts = list(header.get("config", {}).get("observers", {}))
    ending = header.get("ending") or {}
    tone, sign, badge = _badge(ending)
    events = read_events(folder)
    listed, further = list_events(events, with_strut=len(struts) > 1)
    text = render_report(
        "run.html",
        name=folder.resolve().name,
        identity=identity_rows(labels or {}),
        changes=[(t_ns * 1e-9, assignments) for t_ns, assignments in read_changes(folder)],
        tone=tone,
        sign=sign,
        badge=badge,
        accuracy=_accuracy(follower),
        cause=_cause_of_end(events, ending, with_strut=len(struts) > 1),
        headline=_headline(header, follower, ending) + _lost(damage),
        band=make_band(events, *follower.span_s),
        span_s=follower.span_s,
        events=listed,
        further_events=further,
        start=np.datetime64(int(header.get("epoch_ns", 0)), "ns").astype("datetime64[s]"),
        header=header,
        ending=ending,
        number=number,
        duration_s=follower.span_s[1] - follower.span_s[0],
        steps=follower.steps,
        counts=_counts(ending),
        timing=_timing(ending) if header.get("granted") is not None else [],
        strut_plots=[
            (strut, _plots(follower, strut, index, is_only=len(struts) == 1))
            for index, strut in enumerate(struts)
        ],
        sensor_plot=_sensor_plot(follower, header),
        timing_plot=_timing_plot(folder),
    )
    write_page(text, path)
    return damage


def _badge(ending: Ending) -> tuple[str, str, str]:
    """Tone, sign and words of how a run ended, and whether it lost its estimate before."""
    status = str(ending.get("status"))
    lost_s = sum(ending.get("time_in_mode_s", {}).get(mode, 0.0) for mode in _LOST_MODES)
    if status == "done" and (lost_s or ending.get("dropped_steps")):
        return _NOT_ALWAYS_VALID
    return _STATUS.get(status, _KILLED)


def _accuracy(follower: RunFollower) -> str:
    """How far the valid estimates were from the load cell, as a sentence."""
    if LOAD_CELL.column not in follower.columns:
        return "No load cell was logged: the accuracy of the estimated force is not known."
    columns = [follower.columns.index(name) for name in (FORCE_ERROR, LOAD_CELL.column)]
    squares_n2, count, peak_n = 0.0, 0, 0.0
    for begin in range(max(0, follower.steps - _MOST_COMPARED), follower.steps, _CYCLES_AT_ONCE):
        error, cell = follower.rows(begin, begin + _CYCLES_AT_ONCE)[:, columns].T
        error = error[np.isfinite(error)]
        squares_n2, count = squares_n2 + float(error @ error), count + len(error)
        peak_n = float(np.fmax.reduce(np.abs(cell), initial=peak_n))
    if not count:
        return "No valid estimate coincides with a sample of the load cell."
    rms_n = math.sqrt(squares_n2 / count)
    share = f" ({percent(rms_n / peak_n, 1)} of the peak, {quantity(peak_n, 'N')})" * (peak_n > 0)
    return f"Estimated force within {quantity(rms_n, 'N')} RMS{share} of the load cell."


def _cause_of_end(events: Sequence[LoggedEvent], ending: Ending, *, with_strut: bool) -> str:
    """When and why a run entered the safe state in which it ended; empty where it did not."""
    if ending.get("status") != "safe":
        return ""
    last = last_entry(events, Mode.SAFE)
    if last is None:
        return ""
    return f"SAFE at {time_s(last):.1f} s: {describe_cause(last, with_strut=with_strut)}."


def _modes(ending: Ending) -> str:
    """How long the estimate was valid, and what it was else."""
    times_s = dict(ending.get("time_in_mode_s", {}))
    if not times_s:
        return ""
    valid_s = times_s.pop("RUNNING", 0.0)
    others = ", ".join(f"{mode} {time_s:.3g} s" for mode, time_s in times_s.items())
    lacks = ending.get("dropped_steps")
    lost = f" The log lacks {lacks} ticks." if lacks else ""
    return f" Valid for {valid_s:.1f} s; {others or 'all the time'}.{lost}"


def _lost(damage: Sequence[Damage]) -> str:
    return "".join(f" Damaged: {item.text}." for item in damage)


def _headline(header: RunHeader, follower: RunFollower, ending: Ending) -> str:
    begin_s, end_s = follower.span_s
    rate_hz = header.get("config", {}).get("rate_hz", math.nan)
    text = f"{end_s - begin_s:.1f} s at {rate_hz:g} Hz"
    if not ending:
        return f"{text}; its end is not recorded."
    faults = "; ".join(f"{count} {name}" for name, count in _counts(ending))
    return f"{text}; {faults or 'no faults'}.{_modes(ending)}"


def _counts(ending: Ending) -> list[tuple[str, int]]:
    """Faults that occurred in words, with their counts, the most frequent first."""
    counts = ending.get("counts") or {}
    occurred = [
        (COUNT_WORDS.get(name, name.replace("_", " ")), count)
        for name, count in counts.items()
        if count > 0 and name != "started"
    ]
    return sorted(occurred, key=lambda item: -item[1])


def _timing(ending: Ending) -> list[tuple[str, dict[str, float]]]:
    timing = ending.get("timing") or {}
    keys = {name: f"{name}_us" for name in TICK_CURVES}
    return [(name.capitalize(), timing[key]) for name, key in keys.items() if timing.get(key)]


def _plots(follower: RunFollower, strut: str, index: int, *, is_only: bool) -> list[Plot]:
    """Plots of a strut over the time of a run; `is_only` if the model has no other strut."""
    shown = (*TIME_PLOTS, VIRTUAL_FORCE_PLOT)
    columns = [curve.column_of(strut) for item in shown for curve in item.curves]
    window = follower.window(columns, *follower.span_s, _POINTS)
    values = dict(zip(columns, window.values, strict=True))
    panels: list[Panel] = []
    for item in shown:
        styles, curves = list[LineStyle](), list[NDArray[np.float64]]()
        for curve in item.curves:
            column = values[curve.column_of(strut)]
            if curve.is_of_strut or (is_only and np.isfinite(column).any()):
                colour, width = _STYLES[curve.origin]
                styles.append(LineStyle(curve.label, colour, (), width))
                curves.append(column * item.quantity.factor)
        if not curves:
            continue
        labels = TIME.label, item.quantity.label
        panels.append(Panel("lines", *labels, window.t_s, styles, curves, {"gaps": True}))
    caption = (
        "Thinned by minimum and maximum: no peak is lost. The height error (innovation) is the "
        "measured less the predicted height, the force error is the estimated force less that of "
        "the load cell while the estimate is valid; the virtual force is what the model lacks."
    )
    return [plot(f"run-{index}", "The run", caption, panels, 1)]


def _sensor_plot(follower: RunFollower, header: RunHeader) -> Plot | None:
    """Plot of the virtual sensors over the time of a run; None where it has none."""
    names: Collection[str] = header.get("config", {}).get("virtual_sensors") or {}
    columns = [
        column
        for column in follower.columns
        if column.partition(".")[0] in names and column.partition(".")[2] in QUANTITIES
    ]
    if not columns:
        return None
    window = follower.window(columns, *follower.span_s, _POINTS)
    colour, width = _STYLES[Origin.ESTIMATED]
    panels: list[Panel] = []
    for column, values in zip(columns, window.values, strict=True):
        name, _, suffix = column.partition(".")
        unit = QUANTITIES[suffix].dimension.value.replace("^2", "²").replace("*", "·")
        quantity = PlottedQuantity(suffix.partition("_")[0], unit, unit)
        style = LineStyle(name, colour, (), width)
        labels = TIME.label, f"{name}: {quantity.label}"
        panels.append(Panel("lines", *labels, window.t_s, [style], [values], {"gaps": True}))
    caption = (
        "Variables of the model that follows the bench, which no sensor measured. Thinned by "
        "minimum and maximum: no peak is lost."
    )
    return plot("sensors", "Virtual sensors", caption, panels, 1)


def _timing_plot(folder: Path) -> Plot | None:
    histograms = read_histograms(folder)
    if histograms is None:
        return None
    edges_us = np.maximum(np.array(histograms["edges_us"], np.float64), 0.5)
    counts = [np.array(histograms[name], np.float64) for name in TICK_CURVES]
    styles = [LineStyle(*line, (), 1.4) for line in zip(TICK_CURVES, _TICK_COLOURS, strict=True)]
    shown = [np.where(count > 0, count, np.nan) for count in counts]
    options = {"log": True, "steps": True}
    panel = Panel("lines", TICK_TIME.label, "ticks", edges_us, styles, shown, options)
    caption = "Ticks by lateness of their wake-up and by the time of their work."
    return plot("timing", "Timing", caption, [panel], 1)
