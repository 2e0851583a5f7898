"""Every second of a test day is accounted for, and no step is lost between rests."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from rig.dyno.characterise import characterise_record
from rig.dyno.figures import ForceRecord
from tests.dyno.days import Step, usual


def characterised(day, seed=1):
    return characterise_record(ForceRecord("day", *day.record(seed)))


SPEEDS = (0.1, 0.2, 0.4)


def day_with(rest_s, ramp=False, cycles=7):
    steps = tuple(Step(0.025, speed, cycles, rest_s) for speed in SPEEDS)
    return replace(usual(), steps=steps, ramp=ramp, rate_hz=500.0)


@pytest.mark.parametrize("rest_s", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 2.0])
@pytest.mark.parametrize("ramp", [False, True])
def test_no_step_is_lost_whatever_the_rest_between(rest_s, ramp):
    """Half a cycle, a rest and half a cycle may last as long as a stroke."""
    day = day_with(rest_s, ramp)
    found = characterised(day)
    assert [step.peak_speed_m_per_s for step in found.steps] == pytest.approx(SPEEDS, rel=1e-3)
    for step, begin_s, planned in zip(found.steps, day.starts_s(), day.steps, strict=True):
        assert begin_s - 0.01 <= step.begin_s
        assert step.end_s <= begin_s + planned.length_s + 0.01
        assert step.cycles >= planned.cycles - (3.0 if ramp else 1.0)


def test_six_perfect_cycles_stay_where_one_stroke_of_another_step_is_alike():
    for rest_s in np.arange(0.30, 0.52, 0.05):
        day = replace(usual(), steps=(Step(0.025, 0.05, 6, rest_s), Step(0.025, 0.1, 6, rest_s)))
        assert len(characterised(replace(day, rate_hz=200.0)).steps) == 2


@pytest.mark.parametrize("cycles", [1, 2, 3])
def test_a_slow_test_of_one_cycle_gives_friction_and_gas(cycles):
    day = replace(usual(), steps=(Step(0.025, 0.003, cycles, 1.0), Step(0.025, 0.2, 6, 1.0)))
    day = replace(day, rate_hz=200.0, noise_n=0.5)
    damper = characterised(day).damper
    assert damper.gas_force_n.value == pytest.approx(day.damper.gas_n, abs=1.0)
    assert damper.friction_n.value == pytest.approx(day.damper.friction_n, abs=1.0)


@pytest.mark.parametrize("rest_s", [0.0, 0.7, 2.0])
def test_the_whole_record_is_accounted_for(rest_s):
    day = day_with(rest_s)
    t_s, *_ = day.record(1)
    found = characterised(day)
    spans = found.account
    assert spans[0].begin_s == t_s[0]
    assert spans[-1].end_s == t_s[-1]
    assert all(a.end_s == b.begin_s for a, b in itertools.pairwise(spans))
    steps = [span for span in spans if span.use == "step"]
    assert [span.number for span in steps] == [1, 2, 3]
    for span, step in zip(steps, found.steps, strict=True):
        assert span.begin_s == step.begin_s
        assert span.end_s == pytest.approx(step.end_s, abs=0.01)
    assert sum(span.use == "rest" for span in spans) >= (3 if rest_s >= 0.5 else 0)
    assert not any(span.use == "rejected" for span in spans)


def test_strokes_that_do_not_repeat_are_listed_with_the_reason():
    rng = np.random.default_rng(3)
    t_s, height_m, force_n = day_with(1.0).record(1)
    more_s = np.arange(2500) / 500.0
    smooth = np.exp(-0.5 * (np.arange(-150, 151) / 40.0) ** 2)
    x_m = np.convolve(rng.standard_normal(len(more_s) + 300), smooth, "valid")
    x_m = 0.35 + 0.02 * x_m / np.std(x_m)
    record = ForceRecord(
        "day and noise",
        np.concatenate([t_s, t_s[-1] + 0.002 + more_s]),
        np.concatenate([height_m, x_m]),
        np.concatenate([force_n, -1000.0 * np.gradient(x_m, more_s)]),
    )
    found = characterise_record(record)
    assert len(found.steps) == 3
    assert any(span.use == "rejected" and "changes" in span.why for span in found.account)
    assert any("gave no step" in text for text in found.quality)
