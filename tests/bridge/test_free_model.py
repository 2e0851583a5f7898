"""How a free model collects what a start requires, and where it starts."""

import numpy as np
import pytest
from msgspec.structs import replace

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.free_model import (
    FreeModelEstimator,
    _belong_together,  # pyright: ignore[reportPrivateUsage]
    start_of_motion,
)
from rig.bridge.values import StepInput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE
from tests.bridge.cores import GAINS, MS, applied_force, bench_sample, channels, settle_at_once

QUARTER_CAR = load_model(MODELS / "quarter_car.yaml")


def estimator(struts=2):
    plant = DartPlant(QUARTER_CAR)
    bench = channels(struts)
    return FreeModelEstimator(
        plant, [GAINS] * struts, bench, applied_force(bench), 10 * MS, settle_at_once
    )


def at(t_ms, *samples):
    return StepInput(t_ms * MS, samples)


@pytest.mark.parametrize("later_ms", [0, 7])
@pytest.mark.parametrize("count", [3, 12])
def test_a_start_is_on_the_parabola_at_the_tick(count, later_ms):
    t_s = np.arange(1 - count, 1) * 2e-3
    heights = 0.4 - 0.3 * t_s + 5.0 * t_s**2
    samples = [Sample(0, float(h), round(t * 1e9)) for h, t in zip(heights, t_s, strict=True)]
    later_s = later_ms * 1e-3
    expected = (0.4 - 0.3 * later_s + 5.0 * later_s**2, -0.3 + 10.0 * later_s)
    assert start_of_motion(samples, later_ms * MS) == pytest.approx(expected, abs=1e-8)


def samples_at(*times_ms):
    return [Sample(0, 0.4, round(t_ms * MS)) for t_ms in times_ms]


@pytest.mark.parametrize(
    ("times_ms", "do"),
    [
        ((5,), True),
        (range(12), True),
        (range(1000, 1012), True),
        # Slower than the DBC says, all of them.
        (range(0, 60, 5), True),
        # Three intervals without one, and more.
        ((0, 1, 2, 5, 6, 7), True),
        ((0, 1, 2, 5.1, 6, 7), False),
        # One late and the next early, and five that came at once.
        ((0, 1, 2.9, 3, 4, 5, 6), True),
        ((0, 1, 2, 2, 2, 2, 2, 7), False),
        ((1000, 1001, 1002, 1002, 1002, 1002, 1002, 1003), False),
    ],
)
def test_measurements_belong_together_without_a_gap_and_without_a_queue(times_ms, do):
    assert _belong_together(samples_at(*times_ms), MS) == do


def test_a_start_collects_the_newest_of_each_strut_and_of_the_bench():
    core = estimator()
    state = core.init(0)
    for number in range(40):
        t_ns = number * MS
        state, can_start = core.collect(
            state,
            at(
                number,
                Sample(0, 0.3 + number, t_ns),
                Sample(1, 0.4 + number, t_ns),
                *([bench_sample(2, APPLIED_FORCE, 5.0, t_ns)] if number == 20 else []),
                *([bench_sample(2, TEMPERATURE, 35.0, t_ns)] if number == 30 else []),
                bench_sample(2, LOAD_CELL_FORCE, 77.0, t_ns),
            ),
        )
        needed = GAINS.measurements_to_start
        # The applied force is part of the bench: without one nothing starts, and it may be old.
        assert can_start == (20 <= number <= 30 and number >= needed - 1)
        assert state.temperature_c == (35.0 if number >= 30 else 20.0)
    assert [[sample.value for sample in first] for first in state.first] == [
        [height + number for number in range(40 - needed, 40)] for height in (0.3, 0.4)
    ]
    (applied,) = state.inputs
    assert applied.value == 5.0


def test_a_restart_keeps_what_the_observers_and_the_bench_are():
    core = estimator()
    state = core.init(0)
    for number in range(40):
        t_ns = number * MS
        given = at(
            number,
            Sample(0, 0.3, t_ns),
            Sample(1, 0.4, t_ns),
            bench_sample(2, APPLIED_FORCE, 5.0, t_ns),
            bench_sample(2, TEMPERATURE, 35.0, t_ns),
        )
        state, _ = core.step(state, given)
    assert state.model is not None
    assert len(core.heights_m(state)) == 2
    again = core.restart(state, 50 * MS)
    assert again.model is None
    assert core.heights_m(again) == ()
    assert (again.t_ns, again.temperature_c) == (50 * MS, 35.0)
    assert again.first == ((), ())
    assert again.observers == state.observers
    assert again.inputs == state.inputs
    assert not again.is_settled
    assert core.discard(state, again) == replace(state, t_ns=50 * MS)


def test_an_observer_is_that_of_one_strut():
    with pytest.raises(ValueError, match="1 observers for 2 struts, expected one each"):
        estimator(1)
