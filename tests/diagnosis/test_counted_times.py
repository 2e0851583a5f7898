"""Times of sampling by counters, from arrivals that waited."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.recordings.counted_times import counted_times_s

CYCLE_NS = 2_000_000


def arrivals(rng, numbers, drift=0.0, jitter=0.5, offset_ns=123_456):
    true_ns = offset_ns + numbers * CYCLE_NS * (1.0 + drift)
    waits_ns = jitter * CYCLE_NS * rng.random(len(numbers))
    return true_ns, np.maximum.accumulate(np.rint(true_ns + waits_ns)).astype(np.int64)


@given(
    seed=st.integers(0, 1000),
    drift=st.floats(-0.01, 0.01),
    jitter=st.floats(0.0, 0.9),
    lost=st.floats(0.0, 0.3),
)
def test_times_are_the_senders_but_for_the_shortest_wait(seed, drift, jitter, lost):
    rng = np.random.default_rng(seed)
    numbers = np.flatnonzero(rng.random(4000) >= lost)
    true_ns, arrived_ns = arrivals(rng, numbers, drift, jitter)
    times_s = counted_times_s(arrived_ns, (numbers % 16).astype(float), 16, CYCLE_NS)
    assert times_s is not None
    error_ns = 1e9 * times_s - true_ns
    # A hundredth of the waits' range, over 2 800 frames.
    assert np.max(np.abs(error_ns)) < 2.0 + 0.01 * jitter * CYCLE_NS


def test_a_silence_longer_than_the_counter_is_resolved_by_the_arrivals():
    rng = np.random.default_rng(1)
    numbers = np.concatenate([np.arange(1000), np.arange(1337, 3000)])
    true_ns, arrived_ns = arrivals(rng, numbers)
    times_s = counted_times_s(arrived_ns, (numbers % 15).astype(float), 15, CYCLE_NS)
    assert 1e9 * times_s == pytest.approx(true_ns, abs=2e4)


def test_a_sender_that_waits_at_random_between_frames_states_no_time():
    rng = np.random.default_rng(2)
    steps_ns = CYCLE_NS * (0.6 + 0.8 * rng.random(4000))
    arrived_ns = np.cumsum(steps_ns).astype(np.int64)
    counts = (np.arange(4000) % 16).astype(float)
    assert counted_times_s(arrived_ns, counts, 16, CYCLE_NS) is None


def test_few_frames_and_another_cycle_state_no_time():
    numbers = np.arange(2000)
    counts = (numbers % 16).astype(float)
    assert counted_times_s(numbers[:40] * CYCLE_NS, counts[:40], 16, CYCLE_NS) is None
    assert counted_times_s(numbers * 3 * CYCLE_NS, counts, 16, CYCLE_NS) is None
