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


def runs(*lengths):
    """Values that are repeated so often in a row, under a witness that moves all the time."""
    values = [number for number, length in enumerate(lengths) for _ in range(length + 1)]
    return follow(values, [1000.0 * number for number in range(len(values))])


@pytest.mark.parametrize("usual", [0, 1, 2, 5, 9])
def test_a_value_is_stuck_after_more_than_twice_its_usual_repeats_and_three(usual):
    """Whatever it did before its first change."""
    longest = [length for length in (3, 8, 9) if length < usual]
    states = runs(7, *longest, usual, 100)
    counts = [state.count for state in states if state.is_stuck]
    assert states[-1].usual == usual
    assert counts == list(range(2 * usual + 4, 101))


def test_what_is_usual_at_most_doubles_with_a_run_and_never_falls():
    for lengths, usual in (
        ((0, 100, 0), 3),
        ((0, 100, 100, 0), 9),
        ((0, 2, 100, 0), 7),
        ((0, 2, 1, 0), 2),
        ((0, 2, 0, 0), 2),
        ((50, 0, 0), 0),
    ):
        assert runs(*lengths)[-1].usual == usual


def test_a_witness_is_calm_a_second_after_it_has_moved():
    witness = np.where(np.arange(2000) < 500, 0.0, 1000.0)
    states = follow([0, 1, *[2] * 1998], witness)
    assert [n for n, state in enumerate(states) if state.is_stuck] == list(range(500, 1500))


@pytest.mark.parametrize(("share", "is_stuck"), [(0.98, False), (1.04, True)])
def test_a_witness_moves_beyond_a_step_and_eight_deviations_of_its_noise(share, is_stuck):
    """One that alternates between 1 and -1 has second differences of 4, as noise of 1.63 has."""
    noise = [(-1.0) ** number for number in range(4000)]
    bound = STEP_N + 8.0 * 4.0 / np.sqrt(6.0)
    values = [0, 1, *[2] * 4002]
    states = follow(values, [0.0, 0.0, 0.0, *noise, noise[0] + share * bound])
    assert not any(state.is_stuck for state in states[:-1])
    assert states[-1].is_stuck == is_stuck


def test_a_sensor_that_was_stuck_makes_twice_as_many_usual_at_most():
    values = [*wave(1000), *[0.0] * 3000, *(1.0 + wave(1000))]
    states = follow(values, wave(5000))
    assert states[3999].is_stuck
    assert states[-1].usual <= 2 * states[999].usual + 3
    assert not states[-1].is_stuck
