"""Sample times against senders whose clock, waits and pauses are known."""

from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.bridge.sample_times import FrameTime, SenderClock, compile_follower

MS = 1_000_000


def follow(arrivals_ns: Iterable[int], cycle_ns: int = MS, lost: int = 0) -> list[SenderClock]:
    """Clock at each frame; behind the first one `lost` frames are missing."""
    follower, clock, found = compile_follower(cycle_ns), None, []
    for number, arrival_ns in enumerate(arrivals_ns):
        clock = follower(clock, int(arrival_ns), 1 + (lost if number == 1 else 0))
        found.append(clock)
    return found


def sampled_ns(frames: int, drift_ppm: float = 0.0, cycle_ns: int = MS) -> np.ndarray:
    return 5 * MS + np.round(np.arange(frames) * cycle_ns * (1 + 1e-6 * drift_ppm)).astype(np.int64)


def dues(clocks: Sequence[SenderClock]) -> np.ndarray:
    return np.array([clock.due_ns for clock in clocks])


@given(st.integers(-9_000, 9_000), st.sampled_from([MS, 2 * MS, 10 * MS]))
def test_a_sender_that_does_not_wait_is_due_when_it_arrives(drift_ppm, cycle_ns):
    arrivals_ns = np.arange(400) * (cycle_ns + cycle_ns * drift_ppm // 1_000_000)
    clocks = follow(arrivals_ns, cycle_ns)
    assert dues(clocks).tolist() == arrivals_ns.tolist()
    assert {clock.timing for clock in clocks} == {FrameTime.IN_TIME}


@given(st.lists(st.integers(0, 30 * MS), min_size=2, max_size=300))
def test_no_sample_is_newer_than_its_frame(steps_ns):
    arrivals_ns = np.cumsum(steps_ns)
    used = [clock for clock in follow(arrivals_ns) if clock.timing is FrameTime.IN_TIME]
    assert all(clock.due_ns <= clock.arrival_ns for clock in used)


@pytest.mark.parametrize("drift_ppm", [-200.0, 0.0, 80.0, 5000.0])
@pytest.mark.parametrize("wait_ms", [0.05, 0.12, 0.4])
def test_waits_at_random(drift_ppm, wait_ms):
    rng = np.random.default_rng(4)
    true_ns = sampled_ns(2000, drift_ppm)
    arrivals_ns = true_ns + rng.uniform(0.0, wait_ms * MS, 2000).astype(np.int64)
    clocks = follow(np.maximum.accumulate(arrivals_ns))
    assert {clock.timing for clock in clocks[200:]} == {FrameTime.IN_TIME}
    errors_ns = dues(clocks)[200:] - true_ns[200:]
    # The least of 64 waits is a 65th of their range in the mean, and its slope as uncertain.
    assert np.sqrt(np.mean(errors_ns**2)) < wait_ms * MS / 16
    assert np.sqrt(np.mean(errors_ns**2)) < 0.3 * np.std(arrivals_ns - true_ns)


@pytest.mark.parametrize("held", [2, 5, 12])
def test_frames_that_are_held_back_keep_their_times(held):
    true_ns = sampled_ns(3000, 60.0)
    arrivals_ns = true_ns.copy()
    for begin in range(500, 3000, 250):
        arrivals_ns[begin : begin + held] = true_ns[begin + held]
    clocks = follow(arrivals_ns)
    late = [item.timing is FrameTime.LATE for item in clocks]
    # The first of each batch alone: the next ones show that it had waited.
    assert sum(late) == (10 if held > 1 else 0)
    assert {item.timing for item in clocks} == {FrameTime.IN_TIME, FrameTime.LATE}
    assert np.abs(dues(clocks) - true_ns)[200:].max() <= 1000


def test_a_queue_at_the_start_states_no_times():
    arrivals_ns = np.concatenate([np.full(200, 5 * MS), 6 * MS + np.arange(100) * MS])
    timings = [clock.timing for clock in follow(arrivals_ns)]
    assert FrameTime.IN_TIME not in timings[1:201]
    assert set(timings[201:]) == {FrameTime.IN_TIME}


def test_a_gap_beyond_the_counters_round():
    # 20 frames held back: the counter went round, and 15 of them look lost.
    true_ns = sampled_ns(600)
    arrivals_ns = true_ns.copy()
    arrivals_ns[400:420] = true_ns[420]
    follower, clock, timings = compile_follower(MS), None, []
    for number, arrival_ns in enumerate(arrivals_ns):
        clock = follower(clock, int(arrival_ns), 16 if number == 400 else 1)
        timings.append(clock.timing)
    assert FrameTime.IN_TIME not in timings[400:422]
    assert set(timings[422:]) == {FrameTime.IN_TIME}
    assert clock.due_ns == arrivals_ns[-1]


def test_a_first_frame_that_waited():
    arrivals_ns = sampled_ns(100)
    arrivals_ns[0] += MS * 2 // 3
    clocks = follow(arrivals_ns)
    assert [clock.timing for clock in clocks[1:3]] == [FrameTime.EARLY] * 2
    assert {clock.timing for clock in clocks[3:]} == {FrameTime.IN_TIME}
    assert dues(clocks)[3:].tolist() == arrivals_ns[3:].tolist()


def test_a_sender_that_pauses_is_followed_again():
    arrivals_ns = sampled_ns(600)
    arrivals_ns[300:] += 3 * MS
    clocks = follow(arrivals_ns)
    timings = [clock.timing for clock in clocks]
    assert set(timings[300:307]) == {FrameTime.LATE}
    assert set(timings[307:]) == {FrameTime.IN_TIME}
    assert dues(clocks)[307:].tolist() == arrivals_ns[307:].tolist()


def test_a_sender_that_waits_between_frames_has_no_clock():
    rng = np.random.default_rng(5)
    arrivals_ns = np.cumsum(MS + rng.exponential(0.08 * MS, 3000).astype(np.int64))
    clocks = follow(arrivals_ns)
    is_arrival = dues(clocks)[1000:] == arrivals_ns[1000:]
    assert is_arrival.mean() > 0.8
    assert sum(clock.timing is not FrameTime.IN_TIME for clock in clocks[1000:]) < 20


def test_a_frame_of_another_sender_leaves_the_clock_as_it_is():
    follower, clock = compile_follower(MS), None
    for number in range(100):
        clock = follower(clock, number * MS, 1)
    # One with a right CRC by chance, a third of a cycle later, and the two that it has refused.
    clock = follower(clock, 99 * MS + MS // 3, 3)
    assert clock.timing is FrameTime.EARLY
    clock = follower(clock, 103 * MS, 1)
    assert (clock.timing, clock.due_ns) == (FrameTime.IN_TIME, 103 * MS)


def test_lost_frames_are_no_wait():
    true_ns = sampled_ns(300)
    kept = np.concatenate([true_ns[:1], true_ns[6:]])
    assert dues(follow(kept, lost=5)).tolist() == kept.tolist()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_quick_and_slow_senders_alike(seed):
    """Times scale with the cycle: 500 Hz with waits of 0.12 ms as 1 kHz with those of 0.06 ms."""
    waits = np.random.default_rng(seed).integers(0, 60_000, 300)
    slow = follow(sampled_ns(300, cycle_ns=2 * MS) + 2 * waits, 2 * MS)
    quick = follow(sampled_ns(300) + waits)
    assert np.abs((dues(slow) - 5 * MS) - 2 * (dues(quick) - 5 * MS)).max() <= 300
