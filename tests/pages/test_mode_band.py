"""The band of modes and the table of events in a run's report."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bridge.values import Mode
from rig.pages.mode_band import list_events, make_band, read_events


def change(t_s, mode, **more):
    return {"t_s": t_s, "from": "INIT", "to": mode, **more}


def test_the_stretches_are_the_modes_over_the_run():
    events = [change(0.0, "WAITING"), change(1.0, "SETTLING"), change(2.5, "RUNNING")]
    band = make_band(events, 0.0, 10.0)
    assert [(it.mode, it.tone) for it in band] == [
        ("WAITING", "wait"),
        ("SETTLING", "part"),
        ("RUNNING", "good"),
    ]
    assert [it.begin_percent for it in band] == pytest.approx([0.0, 10.0, 25.0], abs=0.11)
    assert sum(it.percent for it in band) == pytest.approx(100.0)


def test_a_mode_of_one_tick_is_seen():
    events = [change(0.0, "RUNNING"), change(500.0, "HOLD"), change(500.001, "RUNNING")]
    band = make_band(events, 0.0, 1000.0)
    assert [it.mode for it in band] == ["RUNNING", "HOLD", "RUNNING"]
    assert band[1].percent == pytest.approx(0.1)


@given(
    st.lists(st.tuples(st.floats(0.0, 50.0), st.sampled_from([it.name for it in Mode])), min_size=1)
)
def test_every_stretch_is_a_mode_of_the_run_and_together_they_are_all_of_it(drawn):
    events = [change(t_s, mode) for t_s, mode in sorted(drawn)]
    band = make_band(events, 0.0, 50.0)
    modes = {mode for _, mode in drawn}
    assert {it.mode for it in band} <= modes | {"RUNNING"}
    assert "SAFE" not in modes or any(it.mode == "SAFE" for it in band)
    assert sum(it.percent for it in band) == pytest.approx(100.0)


def test_without_events_or_time_there_is_no_band():
    assert make_band([], 0.0, 10.0) == []
    assert make_band([change(0.0, "WAITING")], 1.0, 1.0) == []


def test_events_are_in_words_with_their_causes():
    first = {"cause": "stale", "quantity": "age_s", "value": 0.0101, "limit": 0.01}
    events = [
        change(1.0, "HOLD", cause="stale", quantity="age_s", value=0.0101, limit=0.01),
        change(2.0, "SAFE", cause="beyond_safe", strut="front", first_cause=first),
        {"t_s": 2.5, "mark": "valve opened", "by": "anna"},
        {"t_s": 3.0, "request": "acknowledge", "by": "anna", "refused": True},
        {"t_s": 4.0, "machine": "clock_set", "by_s": 3600.0},
    ]
    listed, further = list_events(events)
    assert [(it.what, it.why) for it in listed] == [
        ("INIT → HOLD", "no valid measurement for 10.1\u00a0ms (limit 10\u00a0ms)"),
        (
            "INIT → SAFE",
            "a limit was passed, strut front; at first: "
            "no valid measurement for 10.1\u00a0ms (limit 10\u00a0ms)",
        ),
        ("“valve opened”", "by anna"),
        ("acknowledge, refused", "by anna"),
        ("clock set", "by_s 3600.0"),
    ]
    assert further == 0
    assert list_events(events * 100)[1] == 300


def test_lines_that_are_cut_off_or_wrong_are_left_out(tmp_path):
    cut = '{"t_s": 2.0, "to": "SA'
    lines = [json.dumps(change(1.0, "HOLD")), "[1]", '{"t_s": "now"}', "{}", cut]
    (tmp_path / "events.jsonl").write_text("\n".join(lines))
    assert read_events(tmp_path) == [change(1.0, "HOLD")]
    assert read_events(tmp_path / "other") == []
