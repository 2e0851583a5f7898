"""The knee of a damper and the slopes on both sides of it, from all steps of a test day."""

from dataclasses import replace

import pytest

from rig.dyno.characterise import characterise_record
from rig.dyno.figures import ForceRecord
from tests.dyno.days import Step, usual


def damper_of(day, seed=1):
    return characterise_record(ForceRecord("day", *day.record(seed))).damper


def day_at(*speeds):
    return replace(usual(), steps=tuple(Step(0.025, speed, 8) for speed in speeds), rate_hz=2000.0)


@pytest.mark.parametrize("speeds", [(0.05, 0.1, 0.2, 0.4, 0.8), (0.05, 0.1, 1.0), (0.05, 0.4)])
@pytest.mark.parametrize("has_slow", [True, False])
def test_slow_and_fast_steps_determine_knee_and_slopes(speeds, has_slow):
    """Without a slow step the bend of the gas spring stays in the forces: 3 % of the slopes."""
    day = day_at(*speeds)
    if has_slow:
        day = replace(day, steps=(Step(0.025, 0.003, 1), *day.steps))
    found, true = damper_of(day), day.damper
    for side, knee, below, above in (
        ("compression", true.opens, true.below, true.above),
        ("rebound", true.opens_up, true.below_up, true.above_up),
    ):
        figure = found.knee_m_per_s[side]
        assert figure.value == pytest.approx(knee, rel=0.04 if has_slow else 0.1)
        assert figure.high - figure.low < 0.15 * knee
        slopes = [slope.value for slope in found.slopes_n_s_per_m[side]]
        assert slopes == pytest.approx([below, above], rel=0.03 if has_slow else 0.1)


def test_a_knee_beyond_all_speeds_is_not_reported():
    found = damper_of(day_at(0.03, 0.06))
    assert found.knee_m_per_s == {"compression": None, "rebound": None}
    assert found.slopes_n_s_per_m == {}
    assert any(note.startswith("no knee") for note in found.notes)
