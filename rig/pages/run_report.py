"""The report of a run: what ran, how well, when and with which faults. One file, no network."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from can_dbc.errors import InputError
from rig.log.follower import RunFollower, Stretch
from rig.log.reader import read_header
from rig.pages.report.figures import Curve, Panel, Plot, plot
from rig.pages.report.page import render, write_page
from rig.run.changes import logged_changes
from rig.run.timing import read_histograms

_POINTS = 1500
"""Buckets of a curve: two for each pixel of the page's width are not seen."""

_ALL_STEPS = 1_000_000_000

_MEASURED = Curve("measured", "--measured", (), 2.4)
_MODEL = Curve("model", "--after", (), 1.2)
_CELL = Curve("load cell", "--measured", (), 2.4)
_ESTIMATED = Curve("estimated", "--after", (), 1.2)
_VIRTUAL = Curve("virtual force", "--before", (), 1.2)
_INNOVATION = Curve("innovation", "--before", (), 1.2)
_LATENESS, _WORK = Curve("lateness", "--before", (), 1.4), Curve("work", "--after", (), 1.4)

_STATUS = {
    "done": ("good", "✓", "Ended in order"),
    "safe": ("bad", "✕", "Ended in its safe state"),
    "failed": ("bad", "✕", "Failed"),
}
_KILLED = ("part", "◐", "Killed, or still running")


def write_run_report(folder: Path, path: Path) -> None:
    """Write the report of a run.

    Args:
        folder: Folder of the run.
        path: File to write.

    Raises:
        InputError: It is no run, or one without a tick, or the file cannot be written.
    """
    header = cast("Mapping[str, Any]", read_header(folder))
    follower = RunFollower(folder)
    follower.update(_ALL_STEPS)
    if not follower.steps:
        raise InputError(f"{folder}: holds no tick, expected a run to report on")
    config = cast("Mapping[str, Any]", header.get("config", {}))
    struts = list(cast("Mapping[str, Any]", config.get("observers", {})))
    ending = cast("Mapping[str, Any]", header.get("ending") or {})
    tone, sign, badge = _STATUS.get(str(ending.get("status")), _KILLED)
    text = render(
        "run.html",
        name=folder.resolve().name,
        changes=[(t_ns * 1e-9, assignments) for t_ns, assignments in logged_changes(folder)],
        tone=tone,
        sign=sign,
        badge=badge,
        headline=_headline(header, follower, ending),
        facts=_facts(header, follower, ending),
        counts=_counts(ending),
        timing=_timing(ending) if header.get("granted") is not None else [],
        strut_plots=[
            (strut, _plots(follower, strut, index, with_cell=len(struts) == 1))
            for index, strut in enumerate(struts)
        ],
        timing_plot=_timing_plot(folder),
        versions=header.get("versions", {}),
        files=header.get("files_sha256", {}),
    )
    write_page(text, path)


def _headline(header: Mapping[str, Any], follower: RunFollower, ending: Mapping[str, Any]) -> str:
    begin_s, end_s = follower.span_s
    rate_hz = cast("Mapping[str, Any]", header.get("config", {})).get("rate_hz", "?")
    text = f"{end_s - begin_s:.1f} s at {rate_hz} Hz"
    if not ending:
        return f"{text}; how it ended is not known."
    counts = dict(_counts(ending))
    missed = counts.pop("overruns", 0)
    faults = ", ".join(f"{count} {name}" for name, count in counts.items())
    return f"{text}, {missed or 'no'} ticks missed; counted: {faults or 'no fault'}."


def _facts(
    header: Mapping[str, Any], follower: RunFollower, ending: Mapping[str, Any]
) -> list[tuple[str, str]]:
    config = cast("Mapping[str, Any]", header.get("config", {}))
    bus = cast("Mapping[str, Any]", config.get("bus", {}))
    begin_s, end_s = follower.span_s
    begun = np.datetime64(int(header.get("epoch_ns", 0)), "ns").astype("datetime64[s]")
    is_real = header.get("granted") is not None
    facts = [
        ("Begun", f"{str(begun).replace('T', ' ')} UTC" if is_real else "in simulated time"),
        ("Duration", f"{end_s - begin_s:.3f} s, {follower.steps} ticks"),
        ("Rate", f"{config.get('rate_hz', '?')} Hz"),
        ("Model", str(config.get("model", "?"))),
        (
            "Bus",
            f"{bus.get('interface', '?')} {bus.get('channel', '')}, {bus.get('bitrate')} bit/s",
        ),
        ("Configuration", str(header.get("config_source", "?"))),
    ]
    if ending.get("log_fault"):
        facts.append(("Log", f"{ending['log_fault']}; {ending.get('dropped_steps', 0)} ticks lost"))
    diverged = cast("Mapping[str, Any] | None", ending.get("diverged"))
    if diverged:
        facts.append(("Diverged", f"strut {diverged['strut']} at {diverged['t_s']:.3f} s"))
    if header.get("forced"):
        facts.append(("Forced", "errors of the check were passed over"))
    return facts


def _counts(ending: Mapping[str, Any]) -> list[tuple[str, int]]:
    """What was counted, worst first; what never happened is left out."""
    counts = cast("Mapping[str, int]", ending.get("counts") or {})
    found = [
        (name.replace("_", " "), count)
        for name, count in counts.items()
        if count > 0 and name != "started"
    ]
    return sorted(found, key=lambda item: -item[1])


def _timing(ending: Mapping[str, Any]) -> list[tuple[str, dict[str, float]]]:
    timing = cast("Mapping[str, Any]", ending.get("timing") or {})
    named = (("Lateness", "lateness_us"), ("Work", "work_us"))
    return [(name, timing[key]) for name, key in named if timing.get(key)]


def _plots(follower: RunFollower, strut: str, number: int, *, with_cell: bool) -> list[Plot]:
    # With several struts the log does not say whose force the cell measured.
    names = ("measured_height_m", "height_m", "force_n", "virtual_force_n", "innovation_m")
    columns = [f"{strut}.{name}" for name in names]
    found = follower.window([*columns, "strut_force_n"], *follower.span_s, _POINTS)
    measured, model, force, virtual, innovation, cell = found.values
    of_cell = with_cell and bool(np.isfinite(cell).any())
    forces = ([_CELL] if of_cell else []) + [_ESTIMATED]
    panels = [
        _panel(found, "height / mm", [_MEASURED, _MODEL], [measured * 1e3, model * 1e3]),
        _panel(found, "strut force / N", forces, ([cell] if of_cell else []) + [force]),
        _panel(found, "virtual force / N", [_VIRTUAL], [virtual]),
        _panel(found, "innovation / mm", [_INNOVATION], [innovation * 1e3]),
    ]
    caption = (
        "Thinned by minimum and maximum: no peak is lost. The virtual force is what the model "
        "lacks; the innovation is measured less predicted height."
    )
    return [plot(f"run-{number}", "The run", caption, panels, 1)]


def _panel(found: Stretch, label: str, curves: Sequence[Curve], values: Sequence[Any]) -> Panel:
    return Panel("lines", "time / s", label, found.t_s, curves, values, {"gaps": True})


def _timing_plot(folder: Path) -> Plot | None:
    found = read_histograms(folder)
    if found is None:
        return None
    edges_us = np.maximum(np.array(found["edges_us"], np.float64), 0.5)
    ticks = [np.array(found[name], np.float64) for name in ("lateness", "work")]
    shown = [np.where(count > 0, count, np.nan) for count in ticks]
    panel = Panel(
        "lines",
        "time / µs",
        "ticks",
        edges_us,
        (_LATENESS, _WORK),
        shown,
        {"log": True, "steps": True},
    )
    caption = "Ticks by lateness of their wake-up and by the time of their work."
    return plot("timing", "Timing", caption, [panel], 1)
