"""The estimated force against its own past and against a load cell."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bridge.estimator import Estimate
from rig.bridge.force_history import NO_HISTORY, ForceComparison
from rig.bridge.mode_supervisor import Event, Supervision, Supervisor
from rig.bridge.supervision_limits import Limit
from rig.bridge.values import Mode, StepInput, StrutOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import LOAD_CELL_FORCE
from tests.bridge.test_modes import Scripted
from tests.faults.trial import BEGIN_MS, trial_with_auxiliary

MS = 1_000_000
STALE_NS = 10 * MS
CELL = Channel(3, Role.BENCH, LOAD_CELL_FORCE, "cell", "cell", -1, 2 * MS)


def strut(force_n):
    return StrutOutput(force_n, 0.0, True, 0.4, 0.0, 0.0, 0.0)


def run(ticks, cell=CELL):
    """History after some ticks: each its time in ms, forces, and samples (ms, N)."""
    comparison, history = ForceComparison(cell, STALE_NS), NO_HISTORY
    for t_ms, forces_n, samples in ticks:
        history = comparison.update(
            history,
            round(t_ms * MS),
            [strut(force_n) for force_n in forces_n],
            [Sample(3, value, round(ms * MS)) for ms, value in samples],
        )
    return history


def test_the_rate_is_the_change_over_the_time_between_two_ticks():
    assert run([(1, (5.0, 1.0), ())]).rates_n_per_s == (0.0, 0.0)
    history = run([(1, (5.0, 1.0), ()), (3, (6.0, -3.0), ())])
    assert history.rates_n_per_s == pytest.approx((500.0, -2000.0))


@given(st.lists(st.floats(0.1, 3.0), min_size=2, max_size=12), st.data(), st.floats(-50.0, 50.0))
def test_a_sample_is_compared_with_the_force_of_its_time(steps, data, error_n):
    """A force that is linear in time is met exactly, however late the sample comes."""
    times = [1.0 + sum(steps[:index]) for index in range(len(steps) + 1)]
    latest = times[-1]
    oldest = max(times[0], latest - STALE_NS / MS)
    sampled = data.draw(st.floats(oldest, latest))
    slope = 7.0
    ticks = [(t, (slope * t, 100.0), ()) for t in times[:-1]]
    cell_n = slope * sampled - error_n
    history = run([*ticks, (latest, (slope * latest, 100.0), [(sampled, cell_n)])])
    # Times are whole nanoseconds.
    assert history.differences_n[0] == pytest.approx(error_n, abs=1e-4)
    assert history.differences_n[1] == pytest.approx(100.0 - cell_n)


def test_a_difference_stays_until_the_next_sample_and_is_unknown_when_that_is_overdue():
    ticks = [(1, (5.0,), [(1, 2.0)]), *((1 + k, (9.0,), ()) for k in range(1, 11))]
    assert run(ticks).differences_n == (3.0,)
    assert math.isnan(run([*ticks, (11.000001, (9.0,), ())]).differences_n[0])


def test_a_slow_load_cell_is_overdue_after_three_of_its_cycles():
    slow = Channel(3, Role.BENCH, LOAD_CELL_FORCE, "cell", "cell", -1, 20 * MS)
    ticks = [(1, (5.0,), [(1, 2.0)]), (61, (9.0,), ())]
    assert run(ticks, slow).differences_n == (3.0,)
    assert math.isnan(run([*ticks, (61.000001, (9.0,), ())], slow).differences_n[0])


def test_without_a_sample_the_difference_is_unknown():
    for cell, samples in ((CELL, ()), (None, [(1, 2.0)])):
        assert math.isnan(run([(1, (5.0,), samples)], cell).differences_n[0])


def test_a_sample_of_before_the_history_or_of_another_channel_is_passed_over():
    ticks = [(t, (5.0,), ()) for t in range(1, 130)]
    assert math.isnan(run([*ticks, (130, (5.0,), [(5, 2.0)])]).differences_n[0])
    other = Channel(4, Role.BENCH, LOAD_CELL_FORCE, "cell", "cell", -1, 2 * MS)
    assert math.isnan(run([(1, (5.0,), [(1, 2.0)])], other).differences_n[0])


def test_an_older_sample_does_not_replace_a_newer_one():
    ticks = [(1, (5.0,), ()), (2, (5.0,), [(2, 2.0)]), (3, (5.0,), [(1, 9.0)])]
    assert run(ticks).differences_n == (3.0,)


def test_of_two_samples_of_one_time_the_last_counts():
    assert run([(0, (5.0,), [(0, 1.0), (0, 2.0)])]).differences_n == (3.0,)


def test_a_step_that_is_taken_again_replaces_what_it_was():
    ticks = [(1, (5.0,), ()), (2, (90.0,), ()), (2, (6.0,), [(2, 4.0)])]
    history = run(ticks)
    assert history.forces == ((2 * MS, (6.0,)), (1 * MS, (5.0,)))
    assert history.rates_n_per_s == pytest.approx((1000.0,))
    assert history.differences_n == (2.0,)


def test_the_history_is_as_long_as_a_sample_may_be_late():
    history = run([(t, (5.0,), ()) for t in range(1, 100)])
    assert history.forces[0][0] == 99 * MS
    assert history.forces[-1][0] == 1 * MS
    history = run([(t, (5.0,), ()) for t in range(1, 200)])
    assert history.forces[-1][0] == 99 * MS
    assert len(run([(t, (5.0,), ()) for t in range(1, 200)], None).forces) == 2


def supervised(*others, **row):
    """Modes of a run of ticks whose force and load cell are given: (force, cell, is settled)."""
    limits = (*others, Limit(**{"low": -10.0, "high": 10.0, "action": "hold"} | row))
    estimator = Scripted()
    supervisor = Supervisor(estimator, Supervision(limits=limits), [limits], CELL)

    def follow(*ticks):
        state, modes = supervisor.init(0), []
        for number, (force_n, cell_n, is_settled) in enumerate(ticks, start=1):
            t_ns = number * MS
            estimator.estimate = Estimate((strut(force_n),), t_ns, is_settled)
            samples = () if cell_n is None else (Sample(3, cell_n, t_ns),)
            state, output, _ = supervisor.step(state, StepInput(t_ns, samples))
            modes.append(output.mode)
        return modes, state

    return follow


def test_an_estimate_that_the_load_cell_contradicts_is_never_valid():
    follow = supervised(value="force_difference_n", clear_s=0.0)
    modes, state = follow((50.0, 45.0, True), (50.0, 61.0, True), (50.0, 59.0, True))
    assert modes == [Mode.RUNNING, Mode.HOLD, Mode.RUNNING]
    modes, state = follow((50.0, 45.0, False), (50.0, 61.0, False), (50.0, 61.0, True))
    assert modes == [Mode.SETTLING, Mode.SETTLING, Mode.HOLD]
    cause = state.cause
    assert (cause.event, cause.quantity) == (Event.BEYOND_HOLD, "force_difference_n")
    assert (cause.value, cause.limit) == (-11.0, -10.0)


def test_a_wrong_force_that_swings_is_not_believed_where_it_crosses_the_right_one():
    """Half a hertz: the slowest whose crossings are less than a second apart."""
    follow = supervised(value="force_difference_n")
    swing = [(60.0 * math.sin(math.pi * ms * 1e-3), 0.0, ms > 500) for ms in range(4000)]
    modes, _ = follow(*swing)
    assert set(modes[:501]) == {Mode.SETTLING}
    assert set(modes[501:]) == {Mode.HOLD}
    right = [(0.0, 0.0, True)] * 1100
    modes, _ = follow(*swing, *right)
    assert modes[4000:].index(Mode.RUNNING) in range(900, 1001)


def test_without_a_fresh_sample_of_the_load_cell_the_limit_counts_as_passed():
    modes, _ = supervised(value="force_difference_n", clear_s=0.0)(
        (50.0, None, True), (50.0, 45.0, True), *[(50.0, None, True)] * 11
    )
    assert modes == [Mode.HOLD, *[Mode.RUNNING] * 11, Mode.HOLD]


def test_a_force_that_changes_too_fast_is_invalid_and_the_start_is_no_change():
    follow = supervised(value="force_rate_n_per_s", low=-2000.0, high=2000.0)
    modes, _ = follow(
        (0.0, None, False),
        (50.0, None, False),
        (51.0, None, True),
        (54.0, None, True),
        (55.0, None, True),
    )
    expected = [Mode.SETTLING, Mode.SETTLING, Mode.RUNNING, Mode.HOLD, Mode.RUNNING]
    assert modes == expected


def test_a_limit_with_a_delay_is_held_against_the_history_too():
    follow = supervised(value="force_difference_n", for_s=0.002)
    modes, _ = follow(*[(50.0, 50.0, True)] * 2, *[(50.0, 0.0, True)] * 4)
    assert modes == [*[Mode.RUNNING] * 3, *[Mode.HOLD] * 3]


def test_a_limit_whose_delay_has_not_gone_by_is_not_named():
    slow = Limit(value="height_m", high=0.1, for_s=0.1, action="hold")
    modes, state = supervised(slow, value="force_n", high=100.0)(
        (50.0, 0.0, True), (101.0, 0, True)
    )
    assert modes == [Mode.RUNNING, Mode.HOLD]
    assert (state.cause.quantity, state.cause.value) == ("force_n", 101.0)


def test_a_limit_whose_delay_has_gone_by_is_named_and_its_severity_counts():
    slow = Limit(value="height_m", high=0.1, for_s=0.002, action="safe")
    modes, state = supervised(slow, value="force_n", high=100.0)(*[(101.0, 0.0, True)] * 3)
    assert modes == [Mode.HOLD, Mode.HOLD, Mode.SAFE]
    cause = state.cause
    assert (cause.event, cause.quantity, cause.value) == (Event.BEYOND_SAFE, "height_m", 0.4)


@pytest.mark.parametrize("late_ms", [0, 1, 3])
def test_a_load_cell_is_compared_where_all_frames_are_read_late(late_ms):
    """As by an adapter that stamps them itself and hands them on in batches."""
    limit = {"value": "force_difference_n", "low": -45.0, "high": 45.0, "action": "hold"}
    trial = trial_with_auxiliary("load_cell_force", limits=[limit], settling_s=0.5)
    queue = []

    def arriving(t_ns, frames):
        queue.extend(frames)
        due = [frame for frame in queue if frame.t_ns <= t_ns - late_ms * MS]
        queue[:] = [frame for frame in queue if frame.t_ns > t_ns - late_ms * MS]
        return due

    ticks = trial.run(BEGIN_MS + 500, arriving)
    assert all(tick.is_valid for tick in ticks[BEGIN_MS:])
