"""The record of a run's modes: a line a change."""

import json
from types import SimpleNamespace

from rig.bridge.mode_supervisor import Cause, Event
from rig.bridge.values import Mode
from rig.run.mode_events import ModeEvents


def noted(*ticks):
    """Lines after ticks of a mode and its cause, 1 s apart."""
    lines = []
    events = ModeEvents(lines.append, ["left", "right"], ["encoder"])
    for second, (mode, cause) in enumerate(ticks):
        supervised = SimpleNamespace(t_ns=second * 10**9, mode=mode, cause=cause, first_cause=cause)
        events.update(SimpleNamespace(supervised=supervised))
    return [json.loads(line) for line in lines], events.ticks


def test_a_cause_that_returns_at_every_tick_is_noted_once():
    """A tick that catches up may leave a mode and come back to it."""
    overloaded = [
        (Mode.HOLD, Cause(Event.OVERLOADED, -1, "missed_share", share, 0.5)) for share in (0.6, 0.7)
    ]
    lines, ticks = noted((Mode.RUNNING, Cause(Event.SETTLED)), *overloaded, *overloaded)
    assert [(line["from"], line["to"]) for line in lines] == [
        ("INIT", "RUNNING"),
        ("RUNNING", "HOLD"),
    ]
    assert (lines[1]["t_s"], lines[1]["value"], lines[1]["limit"]) == (1.0, 0.6, 0.5)
    assert (ticks[Mode.RUNNING], ticks[Mode.HOLD]) == (1, 4)


def test_another_cause_of_one_mode_is_another_line():
    held = [
        Cause(Event.BEYOND_HOLD, 0, "height_m", 0.8, 0.7),
        Cause(Event.BEYOND_HOLD, 1, "height_m", 0.8, 0.7),
        Cause(Event.BEYOND_HOLD, 1, "force_n", 800.0, 700.0),
        Cause(Event.DEVICE_FAULT, device=0),
    ]
    lines, _ = noted(*((Mode.HOLD, cause) for cause in held))
    assert [line["cause"] for line in lines] == ["beyond_hold"] * 3 + ["device_fault"]
    assert [line.get("strut") for line in lines] == ["left", "right", "right", None]
    assert lines[-1]["device"] == "encoder"
