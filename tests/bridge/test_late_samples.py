"""Frames that come later than their steps: used in these, as if they had been in time."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from rig.bridge.late_samples import PastStep, arrival_ns, remember, steps_of, use_late_samples
from rig.bridge.values import Mode
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import HEIGHT, TEMPERATURE
from rig.observers.kalman import KalmanObserver
from tests.faults.trial import BEGIN_MS, BEGIN_NS, MS, Gateway, Trial, after

END_MS = BEGIN_MS + 1000


@pytest.fixture(scope="module")
def undisturbed():
    return Trial().run(END_MS)


@pytest.mark.slow
@pytest.mark.parametrize("held", [1, 2, 3, 5, 9, 13])
def test_behind_frames_that_were_held_back_all_is_as_if_they_had_not_been(held, undisturbed):
    gateway, holding = Gateway(held, 250), []

    def inject(t_ns, frames):
        arriving = gateway(t_ns, frames)
        holding.append(gateway.is_holding)
        return arriving

    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, inject))
    assert ticks[-1].counts.untimed == 0
    compared = 0
    for tick, other, is_held in zip(ticks[BEGIN_MS:], undisturbed[BEGIN_MS:], holding, strict=True):
        if not is_held:
            # To the last bit; a limit on what was published meanwhile changes no estimate.
            assert tick.force_n == other.force_n
            assert tick.result.output.struts[0].height_m == other.result.output.struts[0].height_m
            compared += 1
    assert compared > 900


OBSERVERS = {"published": None, "noise-aware": KalmanObserver.before_tuning(1e-6, MS)}
LONG_MS = BEGIN_MS + 6500


def errors_n(ticks):
    """Error of the force where it is valid, from the beginning of the fault on."""
    valid = [tick for tick in ticks if tick.t_ns >= BEGIN_NS and tick.is_valid]
    return np.array([abs(tick.force_n - tick.truth_n) for tick in valid])


@pytest.fixture(scope="module")
def settled_n():
    return {
        name: errors_n(Trial(observer=observer).run(LONG_MS)).max()
        for name, observer in OBSERVERS.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("held", [2, 8, 20, 200])
@pytest.mark.parametrize("name", OBSERVERS)
def test_no_valid_force_is_far_from_the_truth(name, held, settled_n):
    trial = Trial(observer=OBSERVERS[name])
    ticks = trial.run(LONG_MS, after(BEGIN_NS, Gateway(held, 3000)))
    found = errors_n(ticks)
    assert found.max() <= 3.0 * settled_n[name]
    assert ticks[-1].mode is Mode.RUNNING
    assert len(found) > 1900


def test_what_comes_too_late_is_refused():
    trial = Trial()
    ticks = trial.run(END_MS, after(BEGIN_NS, Gateway(40, 500)))
    assert ticks[-1].counts.untimed > 20


def test_a_queue_before_the_first_tick_is_not_taken_as_new():
    queued = []

    def inject(t_ns, frames):
        queued.extend(frames)
        if t_ns < 200 * MS:
            return []
        kept = [replace(frame, t_ns=t_ns) for frame in queued]
        queued.clear()
        return kept

    ticks = Trial().run(END_MS, inject)
    first = next(tick for tick in ticks if tick.mode is not Mode.WAITING)
    assert first.t_ns >= 208 * MS
    assert ticks[-1].counts.untimed > 190


CHANNELS = (
    Channel(0, Role.HEIGHT, HEIGHT, "first", "", 0, MS, delay_ns=3),
    Channel(1, Role.HEIGHT, HEIGHT, "second", "", 1, MS),
    Channel(2, Role.SENSOR, HEIGHT, "first.sensor", "", 0, MS, delay_ns=40),
    Channel(3, Role.BENCH, TEMPERATURE, "temperature", "", -1, MS),
)
HEIGHTS = (0, 1)


def arriving(*due_ns_of_channels):
    """Samples by channel and time of arrival; no two have the same value."""
    return [
        Sample(channel, float(number), due_ns - CHANNELS[channel].delay_ns)
        for number, (channel, due_ns) in enumerate(due_ns_of_channels)
    ]


class Recorder:
    """An estimator whose state is all that it was given."""

    def step(self, state, step_input):
        return (*state, step_input), None


def test_a_sample_arrives_its_channels_delay_after_it_was_true():
    assert [arrival_ns(CHANNELS, Sample(index, 0.5, 100)) for index in range(4)] == [
        103,
        100,
        140,
        100,
    ]


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(1, 99)), max_size=20))
def test_each_step_uses_one_sample_of_a_height_and_no_step_is_more_than_needed(arrivals):
    samples = arriving(*sorted(arrivals, key=lambda item: item[1]))
    steps = list(steps_of(CHANNELS, samples, 100, 0))
    used = [item for step in steps for item in step.samples]
    assert sorted(used, key=lambda item: item.value) == samples
    of_height = [Counter(item.channel for item in step.samples) for step in steps]
    assert all(number[index] <= 1 for number in of_height for index in HEIGHTS)
    # A step ends where a further sample of a height that it has comes, and nowhere else.
    firsts = [next(x for x in step.samples if x.channel in HEIGHTS) for step in steps[1:]]
    assert all(
        first.channel in number for first, number in zip(firsts, of_height[:-1], strict=True)
    )
    assert [step.t_ns for step in steps] == sorted(step.t_ns for step in steps)
    assert steps[-1].t_ns == 100
    for step in steps[:-1]:
        heights = [item for item in step.samples if item.channel in HEIGHTS]
        assert step.t_ns == max(arrival_ns(CHANNELS, item) for item in heights)


def test_a_step_between_is_at_the_newest_of_its_heights_and_never_before_the_last_step():
    heights = arriving((0, 20), (1, 25), (3, 27), (0, 30), (0, 40))
    times_ns = [[step.t_ns for step in steps_of(CHANNELS, heights, 50, ns)] for ns in (10, 35)]
    assert times_ns == [[25, 30, 50], [35, 35, 50]]


def test_a_sensors_sample_waits_for_the_first_step_that_is_not_before_it():
    # What the bench sends once goes with the heights that it came behind.
    told = arriving((0, 20), (2, 60), (2, 61), (3, 21), (0, 30))
    first, last = steps_of(CHANNELS, told, 50, 10)
    assert first.samples == (told[0], told[1], told[3])
    assert last.samples == (told[2], told[4])


TICKS = 8


@given(
    st.lists(st.tuples(st.integers(0, 3), st.booleans()), min_size=1, max_size=25),
    st.randoms(use_true_random=False),
)
def test_late_samples_leave_the_state_that_they_had_left_in_time(chosen, rng):
    dues_ns = sorted(rng.sample(range(1, 10 * TICKS + 1), len(chosen)))
    samples = arriving(*((channel, due) for (channel, _), due in zip(chosen, dues_ns, strict=True)))
    late = [sample for sample, (_, is_late) in zip(samples, chosen, strict=True) if is_late]

    def run(given_samples):
        state, past = (), []
        for index in range(TICKS):
            since_ns, t_ns = 10 * index, 10 * (index + 1)
            used = tuple(x for x in given_samples if since_ns < arrival_ns(CHANNELS, x) <= t_ns)
            past.append(PastStep(since_ns, t_ns, state, used))
            for step_input in steps_of(CHANNELS, used, t_ns, since_ns):
                state, _ = Recorder().step(state, step_input)
        return state, tuple(past)

    _, past = run([sample for sample in samples if sample not in late])
    if late:
        rng.shuffle(late)
        assert use_late_samples(Recorder(), CHANNELS, past, late) == run(samples)


def test_steps_before_the_oldest_late_sample_are_not_taken_again():
    taken = []

    class Watched(Recorder):
        def step(self, state, step_input):
            taken.append(step_input.t_ns)
            return super().step(state, step_input)

    past = tuple(PastStep(10 * i, 10 * (i + 1), (), ()) for i in range(5))
    use_late_samples(Watched(), CHANNELS, past, arriving((1, 40), (1, 30)))
    assert taken == [30, 40, 50]


def past_steps(number):
    return tuple(PastStep(10 * i, 10 * (i + 1), (), ()) for i in range(number))


@pytest.mark.parametrize("awaited_ns", [0, 1, 9, 10, 11, 25, 30, 39, 40, 50, 99])
def test_steps_are_remembered_from_the_first_that_a_sample_may_still_come_for(awaited_ns):
    *past, step = past_steps(6)
    expected = [item for item in past if item.t_ns > awaited_ns]
    assert remember(tuple(past), step, awaited_ns) == (*expected, step)


def test_no_more_than_five_hundred_steps_are_remembered():
    past = ()
    for count, step in enumerate(past_steps(504), 1):
        past = remember(past, step, 0)
        assert past[-1] is step
        assert len(past) == min(count, 500)
