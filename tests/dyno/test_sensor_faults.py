"""Sensors are judged before a figure is given; lag and drift are removed where they are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from can_dbc.errors import InputError
from rig.dyno.characterise import characterise_record
from rig.dyno.figures import ForceRecord
from rig.dyno.request import FigureRequest
from tests.dyno import days
from tests.dyno.days import Step
from tests.dyno.many_days import rate_of
from tests.dyno.population import Damper


def usual(**changes):
    return days.usual(rate_hz=500.0, **changes)


def characterised(day, requested=None, seed=1):
    record = ForceRecord("day", *day.record(seed))
    return characterise_record(record, *([] if requested is None else [requested]))


def at_peak(step):
    return step.compression.force_at_peak_velocity_n, step.rebound.force_at_peak_velocity_n


def assert_right(found, day, wider_n=0.0):
    """Every force at peak velocity is in its interval, or bounded on the right side."""
    assert len(found.steps) == len(day.steps)
    for index, step in enumerate(found.steps):
        for figure, truth_n in zip(at_peak(step), day.truth(index), strict=True):
            assert figure.low - wider_n <= truth_n <= figure.high + wider_n


@pytest.mark.parametrize("clips_noise", [False, True])
@pytest.mark.parametrize("clips_n", [350.0, 600.0, 900.0])
def test_what_is_clipped_is_a_bound(clips_n, clips_noise):
    """Also with noise behind the clipping, whose samples never stay at one value."""
    day = usual(clips_n=clips_n, clips_noise=clips_noise)
    found = characterised(day)
    assert_right(found, day)
    for index, step in enumerate(found.steps):
        for figure, truth_n in zip(at_peak(step), day.truth(index), strict=True):
            is_clipped = abs(truth_n) > 1.02 * clips_n
            assert math.isfinite(figure.low if truth_n < 0.0 else figure.high) != is_clipped
    assert "clipped" in " ".join(found.quality)
    assert found.damper.asymmetry is None
    # Compression and rebound bend at 0.12 and 0.15 m/s, at 584 and -740 N.
    for side, place, bends_n in (("compression", 0.12, 584.0), ("rebound", 0.15, 740.0)):
        knee = found.damper.knee_m_per_s[side]
        if clips_n < 0.95 * bends_n:
            assert knee is None
        elif knee is not None:
            assert knee.low <= place <= knee.high


@pytest.mark.parametrize("above", [0.04, 0.08, 0.2])
def test_a_valve_that_blows_off_is_not_called_clipped(above):
    damper = replace(Damper(), above=above * 3200.0, above_up=above * 5200.0)
    found = characterised(usual(damper=damper))
    assert "clipped" not in " ".join(found.quality)
    assert all(figure.is_bounded for step in found.steps for figure in at_peak(step))


def test_spikes_are_removed_and_counted():
    day = usual(spikes=4)
    found, clean = characterised(day), characterised(replace(day, spikes=0))
    assert any("4 spikes were removed from the force" in text for text in found.quality)
    for spiked, plain in zip(found.steps, clean.steps, strict=True):
        for one, other in zip(at_peak(spiked), at_peak(plain), strict=True):
            assert one.value == pytest.approx(other.value, abs=0.05)


def test_a_jump_of_the_force_is_no_spike():
    """The machine stops at full speed; the last sample before it is no spike, nor the first."""
    found = characterised(usual(lag_s=0.005, drift_n=-60.0))
    assert "spike" not in " ".join(found.quality)


def test_a_record_in_other_units_is_refused():
    t_s, height_m, force_n = usual().record(1)
    with pytest.raises(InputError, match=r"heights over a range of 50.03 m, expected at most 5 m"):
        characterise_record(ForceRecord("mm", t_s, 1e3 * height_m, force_n))


@pytest.mark.slow
@pytest.mark.parametrize("lag_s", [-0.002, 0.002, 0.01])
def test_a_lag_of_the_cell_is_found_and_removed(lag_s):
    """Without it the spring rate rises with speed, and forces at peak speed are too small."""
    day = usual(lag_s=lag_s)
    found = characterised(day)
    assert found.corrections.removed_lag_s == pytest.approx(lag_s, abs=3e-5)
    assert_right(found, day, wider_n=0.5)
    rates = [step.spring_rate_n_per_m for step in found.steps]
    assert max(rate.value for rate in rates) < 1.01 * min(rate.value for rate in rates)
    kept = characterised(day, FigureRequest(lag_s=0.0))
    assert kept.corrections.removed_lag_s == 0.0
    assert "not removed" in " ".join(kept.quality)
    shown = [step.spring_rate_n_per_m.value for step in kept.steps]
    assert max(shown) > 1.1 * min(shown)


@pytest.mark.parametrize("give_m_per_n", [0.3e-6, 1e-6])
def test_air_in_the_oil_is_no_lag(give_m_per_n):
    """It delays the force, too, but by another time in each step."""
    found = characterised(usual(damper=Damper(give_m_per_n=give_m_per_n)))
    assert found.corrections.removed_lag_s == 0.0


def test_a_record_without_lag_and_drift_is_left_as_it_is():
    found = characterised(usual())
    assert not found.corrections.removes_drift
    assert found.corrections.removed_lag_s == 0.0
    assert not found.quality


@pytest.mark.slow
@pytest.mark.parametrize("drift_n", [-60.0, 100.0])
@pytest.mark.parametrize("lag_s", [0.0, 0.005])
def test_a_drift_of_the_zero_is_removed(drift_n, lag_s):
    day = usual(drift_n=drift_n, lag_s=lag_s)
    found = characterised(day)
    assert found.corrections.removes_drift
    assert found.corrections.drift.largest.value == pytest.approx(drift_n, rel=0.05)
    # What the zero is at the first rest is not known.
    assert_right(found, day, wider_n=0.01 * abs(drift_n))
    kept = characterised(day, FigureRequest(zero=False))
    assert not kept.corrections.removes_drift
    assert ": not removed" in " ".join(kept.quality)


def test_friction_that_holds_another_way_is_no_drift():
    """The force at rest changes between two rests, and the cycles between do not."""
    day = replace(usual(), steps=(Step(0.025, 0.1, 8, 1.0), Step(0.025, 0.2, 8, 1.0)))
    t_s, height_m, force_n = day.record(1)
    last = t_s > day.length_s - 1.0
    held_n = force_n + np.where(last, 18.0, 0.0)
    found = characterise_record(ForceRecord("held", t_s, height_m, held_n))
    assert found.corrections.drift is not None
    assert not found.corrections.removes_drift
    assert "friction that holds another way" in " ".join(found.quality)


@pytest.mark.parametrize("lag_s", [0.0, 0.002, 0.006])
@pytest.mark.parametrize("speeds", [(0.4,), (0.1, 0.4)])
def test_a_lag_that_few_steps_do_not_determine_is_in_the_intervals(lag_s, speeds):
    """One step does not distinguish a spring from a lag: both figures contain their true values."""
    steps = tuple(Step(0.025, speed, 8) for speed in speeds)
    day = replace(usual(lag_s=lag_s), steps=steps)
    found = characterised(day)
    lag = found.corrections.lag
    assert found.corrections.removed_lag_s == 0.0
    assert (lag.kind, lag.figure.low) == ("open", 0.0)
    assert lag.figure.high >= lag_s
    assert_right(found, day, wider_n=0.0)
    rate_n_per_m = rate_of(day)
    for step in found.steps:
        rate = step.spring_rate_n_per_m
        assert 0.999 * rate.low <= rate_n_per_m <= 1.001 * rate.high
    stated = characterised(day, FigureRequest(lag_s=lag_s))
    assert_right(stated, day, wider_n=0.5)
    widths = [
        [step.compression.force_at_peak_velocity_n.half for step in it.steps]
        for it in (stated, found)
    ]
    assert all(known <= 1.1 * unknown for known, unknown in zip(*widths, strict=True))


@pytest.mark.parametrize("drift_n", [0.0, 1.0])
def test_a_drift_that_no_rest_shows_is_in_the_intervals(drift_n):
    steps = (Step(0.025, 0.8, 8, 0.0),)
    day = replace(usual(drift_n=drift_n, first_rest_s=0.0), steps=steps)
    found = characterised(day)
    assert found.corrections.drift.kind == "unseen"
    assert "without two rests at one height" in " ".join(found.quality)
    assert_right(found, day, wider_n=0.0)
    stated = characterised(day, FigureRequest(zero=False))
    width_n, known_n = (
        it.steps[0].compression.force_at_peak_velocity_n.half for it in (found, stated)
    )
    assert width_n > known_n


def test_drift_and_clipping_together_leave_bounds_that_are_right():
    day = usual(drift_n=60.0, clips_n=700.0)
    found = characterised(day)
    assert found.corrections.removes_drift
    assert_right(found, day, wider_n=1.0)
