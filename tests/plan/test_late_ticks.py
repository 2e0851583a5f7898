"""Why ticks were missed, from rows whose story is known."""

import random

import pytest

from can_dbc.errors import InputError
from rig.machine.clock import VirtualClock
from rig.run.late_ticks import LossCause, find_late_ticks
from rig.run.trace import Trace, TraceRow, read_trace

MS = 1_000_000


def rows(late, *, ticks=400, stolen_ns=0):
    """A trace at 1 kHz: tick -> how its wait or the work before it went wrong."""
    found = []
    counters = {"voluntary": 0, "involuntary": 0, "minor_faults": 0, "major_faults": 0}
    run_delay_ns = missed_until = 0
    for tick in range(1, ticks):
        if tick < missed_until:
            continue
        story = late.get(tick, {})
        counters = {key: value + story.get(key, 0) for key, value in counters.items()}
        counters["voluntary"] += 1
        run_delay_ns += story.get("run_delay_ns", 2_000)
        deadline = tick * MS
        asleep = deadline - 920_000 + story.get("busy_ns", 0)
        woke = max(asleep, deadline) + 1_000 + story.get("overslept_ns", 0)
        missed_until = woke // MS + 1
        marks = [woke + part for part in (8_000, 30_000, 40_000, 45_000)]
        steal_ns = stolen_ns if tick > ticks // 2 else 0
        log_busy = story.get("log_busy", 0)
        row = TraceRow(
            deadline, asleep, woke, *marks, **counters, run_delay_ns=run_delay_ns,
            steal_ns=steal_ns, log_busy=log_busy,
        )  # fmt: skip
        found.append(row)
    return found


@pytest.mark.parametrize(
    ("story", "part", "cause"),
    [
        ({"overslept_ns": 3 * MS, "run_delay_ns": 2 * MS}, "wait", LossCause.OTHER_THREAD),
        ({"overslept_ns": 3 * MS, "major_faults": 1}, "wait", LossCause.DISK),
        ({"overslept_ns": 3 * MS, "voluntary": 1, "log_busy": 1}, "wait", LossCause.INTERPRETER),
        ({"overslept_ns": 3 * MS, "voluntary": 1}, "wait", LossCause.UNACCOUNTED),
        ({"overslept_ns": 3 * MS, "involuntary": 1}, "wait", LossCause.KERNEL),
        ({"overslept_ns": 3 * MS, "minor_faults": 400}, "wait", LossCause.FAULTS),
        ({"overslept_ns": 3 * MS}, "wait", LossCause.UNACCOUNTED),
        ({"busy_ns": 4 * MS, "involuntary": 1}, "between", LossCause.KERNEL),
    ],
)
def test_each_account_is_told_from_the_others(story, part, cause):
    (found,) = find_late_ticks(rows({100: story}), MS)
    assert (found.part, found.cause) == (part, cause)
    assert found.t_ns == 100 * MS
    assert found.missed in (3, 4)
    longer_ns = story.get("overslept_ns", 0) + story.get("busy_ns", 0)
    assert found.excess_ns == pytest.approx(longer_ns, abs=0.1 * MS)


def test_a_trace_in_which_nothing_was_late_has_no_gaps():
    assert find_late_ticks(rows({}), MS) == []
    assert find_late_ticks([], MS) == []


def test_gaps_in_phase_with_a_tenth_of_a_second_are_the_hosts_quota():
    ends_ms = (50, 150, 250, 350)
    late = {end - 2: {"overslept_ns": 2 * MS + 300 * k} for k, end in enumerate(ends_ms)}
    late[203] = {"overslept_ns": 3 * MS}
    found = find_late_ticks(rows(late), MS)
    assert [item.cause for item in found] == [
        LossCause.QUOTA, LossCause.QUOTA, LossCause.UNACCOUNTED, LossCause.QUOTA, LossCause.QUOTA
    ]  # fmt: skip


@pytest.mark.slow
def test_gaps_at_random_times_are_not_put_down_to_a_quota():
    random.seed(3)
    wrong = 0
    for _ in range(200):
        ticks = random.sample(range(10, 1990, 6), 8)
        found = find_late_ticks(rows({k: {"overslept_ns": 2 * MS} for k in ticks}, ticks=2000), MS)
        wrong += any(item.cause is LossCause.QUOTA for item in found)
    assert wrong < 20


def test_what_was_stolen_as_long_as_nobody_accounts_for_is_the_hosts():
    late = {k: {"overslept_ns": 2 * MS} for k in (31, 77, 140, 263)}
    causes = {item.cause for item in find_late_ticks(rows(late, stolen_ns=10 * MS), MS)}
    assert causes == {LossCause.HOST}


def test_a_trace_keeps_late_ticks_with_the_one_before(tmp_path):
    clock, trace = VirtualClock(), Trace(MS)
    traced = trace.clock(clock)
    for tick in range(1, 3000):
        traced.wait_until(tick * MS)
        if tick == 2000:
            clock.wait_until(tick * MS + 5 * MS)
        trace.nothing_done()
    trace.write(tmp_path)
    found = read_trace(tmp_path)
    assert [row.deadline_ns // MS for row in found[:1000]] == list(range(1, 1001))
    kept = [row.deadline_ns // MS for row in found[1000:]]
    assert kept[0] == 1999
    assert kept[1] == 2000
    assert found == sorted(found)


def test_a_run_without_a_trace_is_told_in_one_line(tmp_path):
    with pytest.raises(InputError, match="expected a run made with --trace"):
        read_trace(tmp_path)
    (tmp_path / "trace.arrow").write_bytes(b"no arrow")
    with pytest.raises(InputError, match="is not a trace"):
        read_trace(tmp_path)


def test_a_run_without_a_tick_on_time_has_its_gaps_all_the_same():
    late = {k: {"overslept_ns": 3 * MS} for k in range(1, 60, 4)}
    found = find_late_ticks(rows(late, ticks=60), MS)
    assert len(found) == 14
    assert {item.part for item in found} == {"wait"}
