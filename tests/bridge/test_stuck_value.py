"""Repeats of a value: what is usual is learnt, a stuck sensor is seen, a bench at rest is not."""

import numpy as np
import pytest

from rig.bridge.stuck_value import Repeats, update_repeats

MS = 1_000_000
STEP_N = 0.1


def follow(values, witnesses, state=None, begin=0):
    """Each state after values and witnesses, a millisecond apart."""
    state, states = state or Repeats(), []
    last = values[0]
    for number, (value, witness) in enumerate(zip(values, witnesses, strict=True), start=begin):
        state = update_repeats(state, value == last, witness, STEP_N, number * MS)
        last = value
        states.append(state)
    return states


def wave(count, period_ms=250.0):
    return 100.0 * np.sin(2.0 * np.pi * np.arange(count) / period_ms)


def test_a_value_that_has_never_changed_may_rest():
    states = follow([0.3] * 5000, wave(5000))
    assert not any(state.is_stuck for state in states)


@pytest.mark.parametrize("quiet_ms", [0, 30, 62, 125])
def test_a_frozen_value_is_stuck_from_its_fourth_repeat_on(quiet_ms):
    """Wherever the witness is in its period, and for as long as it moves."""
    moving = list(wave(1000 + quiet_ms)[quiet_ms:])
    values = [*moving, *[moving[-1]] * 5000]
    states = follow(values, wave(len(values)))
    stuck = [number - len(moving) for number, state in enumerate(states) if state.is_stuck]
    assert 3 <= stuck[0] <= 12
    assert stuck == list(range(stuck[0], 5000))


def test_a_value_is_not_stuck_where_its_witness_rests():
    rng = np.random.default_rng(1)
    for noise_n in (0.0, 3.0):
        witness = np.concatenate([wave(1000), np.zeros(20_000)])
        witness += rng.normal(0.0, noise_n, len(witness))
        states = follow([*wave(1000), *[0.0] * 20_000], witness)
        # A noisy witness is known after some of its values.
        assert sum(state.is_stuck for state in states) <= (1100 if noise_n else 0)
        assert not any(state.is_stuck for state in states[2200:])


def test_a_witness_that_comes_to_rest_releases_a_value_after_a_second():
    values = [*wave(1000), *[0.0] * 4000]
    states = follow(values, [*wave(2000), *np.zeros(3000)])
    stuck = [number for number, state in enumerate(states) if state.is_stuck]
    assert stuck[-1] == pytest.approx(3000, abs=10)


def test_what_repeats_itself_as_motion_turns_becomes_usual():
    """A coarse sensor: a period has two turns, in which it shows the same for long."""
    values = np.round(wave(5000, 1000.0) / 10.0)
    states = follow(values, wave(5000, 1000.0))
    stuck = [number for number, state in enumerate(states) if state.is_stuck]
    longest = max(state.count for state in states)
    assert states[-1].usual == longest
    assert stuck[-1] < 1300


def test_a_sensor_that_was_stuck_makes_twice_as_many_usual_at_most():
    values = [*wave(1000), *[0.0] * 3000, *(1.0 + wave(1000))]
    states = follow(values, wave(5000))
    assert states[3999].is_stuck
    assert states[-1].usual <= 2 * states[999].usual + 3
    assert not states[-1].is_stuck
