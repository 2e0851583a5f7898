"""Whole test days with faults: a part of the study, whose seed is its own."""

import numpy as np
import pytest

from can_dbc.errors import InputError
from rig.dyno.characterise import characterise_record
from rig.dyno.figures import ForceRecord
from tests.dyno.many_days import FIGURES, drawn, study


@pytest.mark.long
def test_intervals_hold_whatever_the_fault():
    """Of some 40 days: each figure within five standard deviations of 93 % and above."""
    found = study(40, 5)
    for name in FIGURES:
        hits = [hit for by_name, _, _ in found.values() for hit in by_name[name]]
        assert np.mean(hits) > 0.93 - 5.0 * (0.93 * 0.07 / len(hits)) ** 0.5, name
    missing, steps = (sum(pair[i] for _, pair, _ in found.values()) for i in (0, 1))
    assert missing < 0.1 * steps


@pytest.mark.slow
@pytest.mark.parametrize("number", range(12))
def test_no_step_is_lost_without_its_line(number):
    """A step that is not reported overlaps with a stretch that is rejected with its reason."""
    day, _ = drawn(np.random.default_rng([77, number]))
    try:
        found = characterise_record(ForceRecord("day", *day.record(number)))
    except InputError:  # no step at all, which it says
        return
    rejected = [span for span in found.account if span.use == "rejected"]
    for begin_s, step in zip(day.starts_s(), day.steps, strict=True):
        end_s = begin_s + step.length_s
        is_there = any(begin_s < it.begin_s + 0.1 < end_s for it in found.steps)
        assert is_there or any(it.begin_s < end_s and it.end_s > begin_s for it in rejected)
