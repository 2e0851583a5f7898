"""Ticks on a clock that only these tests move: nobody sleeps, and nobody measures this machine."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.run.loop import Tick, regular_ticks
from rig.run.timing import Timing

PERIOD_NS = 1_000_000


class HandClock:
    """A clock that wakes up as late as it is told, and is moved on by the work of a tick."""

    epoch_ns = 0

    def __init__(self, lateness_ns: Iterator[int]) -> None:
        self.t_ns = 0
        self.asked: list[int] = []
        self._lateness_ns = lateness_ns

    def epoch_now_ns(self) -> int:
        return self.epoch_ns

    def now_ns(self) -> int:
        return self.t_ns

    def wait_until(self, t_ns: int) -> int:
        self.asked.append(t_ns)
        self.t_ns = max(self.t_ns, t_ns) + next(self._lateness_ns, 0)
        return self.t_ns


def ticks(
    work_ns: list[int], lateness_ns: list[int] | None = None, count: int | None = None
) -> tuple[list[Tick], HandClock, Timing]:
    """Ticks whose work takes the given times."""
    clock, timing = HandClock(iter(lateness_ns or [])), Timing.empty()
    works = iter(work_ns)
    found: list[Tick] = []
    for tick in regular_ticks(clock, PERIOD_NS, count, lambda: len(found) >= len(work_ns), timing):
        found.append(tick)
        clock.t_ns += next(works)
    return found, clock, timing


def test_deadlines_are_absolute_so_that_nothing_drifts():
    found, clock, timing = ticks([300_000] * 5000, [7_000, 80_000] * 2500)
    assert [tick.t_ns for tick in found] == [k * PERIOD_NS for k in range(5000)]
    assert clock.asked == [k * PERIOD_NS for k in range(5000)]
    assert not any(tick.overruns for tick in found)
    assert timing.lateness[7] == timing.lateness[80] == 2500
    assert timing.work[300] == 5000


def test_missed_ticks_are_skipped_and_counted_and_never_made_up():
    # The second tick's work lasts until 4.2 ms: ticks 2, 3 are missed, tick 4 is late.
    found, _, timing = ticks([100_000, 3_200_000, 100_000, 100_000])
    assert found == [
        Tick(0, 0),
        Tick(1 * PERIOD_NS, 0),
        Tick(4 * PERIOD_NS, 2),
        Tick(5 * PERIOD_NS, 0),
    ]
    assert timing.extremes_ns.tolist() == [2_200_000, 3_200_000, 3_200_000]


def test_a_tick_that_is_late_by_less_than_a_period_is_not_missed():
    found, _, _ = ticks([1_999_999, 0])
    assert found == [Tick(0, 0), Tick(PERIOD_NS, 0)]


@given(
    work_ns=st.lists(st.integers(0, 5 * PERIOD_NS), min_size=1, max_size=60),
    lateness_ns=st.lists(st.integers(0, 3 * PERIOD_NS), max_size=60),
)
def test_every_tick_of_the_grid_is_either_run_or_counted(work_ns, lateness_ns):
    found, _, timing = ticks(work_ns, lateness_ns)
    expected = 0
    for tick in found:
        expected += tick.overruns
        assert tick.t_ns == expected * PERIOD_NS
        expected += 1
    assert timing.lateness.sum() == len(found)
    assert timing.work.sum() == len(found)


def test_the_grid_ends_after_its_count_even_where_the_end_is_missed():
    assert len(ticks([0] * 50, count=20)[0]) == 20
    found, _, _ = ticks([0, 0, 10 * PERIOD_NS, 0], count=8)
    assert [tick.t_ns for tick in found] == [0, PERIOD_NS, 2 * PERIOD_NS]


def test_a_request_to_stop_is_seen_before_the_next_tick():
    assert len(ticks([0] * 7)[0]) == 7


def test_longer_than_the_histogram_is_counted_in_its_last_bin():
    _, _, timing = ticks([70_000_000, 0])
    assert timing.work[-1] == 1
    assert timing.lateness[-1] == 1
    assert timing.summary()["work_us"]["max"] == pytest.approx(70_000.0)


@given(us=st.lists(st.integers(0, 900), min_size=1, max_size=200))
def test_percentiles_are_the_ends_of_their_bins(us):
    _, _, timing = ticks([value * 1000 for value in us])
    work = timing.summary()["work_us"]
    ordered = sorted(us)
    assert work["p50"] == ordered[-(-len(us) // 2) - 1] + 1
    assert work["max"] == ordered[-1]
    assert work["p99_9"] <= ordered[-1] + 1


def test_without_a_tick_there_are_no_percentiles():
    summary = Timing.empty().summary()
    assert summary == {"lateness_us": {}, "work_us": {}, "longest_gap_us": 0.0}


def test_what_is_set_up_before_the_first_tick_makes_no_tick_late():
    clock, timing = HandClock(iter([])), Timing.empty()
    clock.t_ns = 7 * PERIOD_NS + 1
    found = list(regular_ticks(clock, PERIOD_NS, 3, lambda: False, timing))
    assert found == [Tick(number * PERIOD_NS, 0) for number in (8, 9, 10)]
    assert timing.extremes_ns.tolist() == [0, 0, PERIOD_NS]
