"""Reasons against laws that were not chosen agree with the figures that stand beside them."""

import re

import numpy as np
import pytest

from dart_model.effects import effect
from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.problem.build import build
from rig.diagnosis.problem.problem import nominal
from rig.diagnosis.progress import no_progress
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.explore import search_along_motion
from rig.diagnosis.search.pool import Pool, ValidatedModel
from rig.diagnosis.search.rejections import list_rejections, residual_left
from tests.diagnosis import little_dyno
from tests.diagnosis.test_prescribed import Orifice


@pytest.fixture(scope="module")
def searched():
    """A dyno with an orifice, searched, with the first round of laws."""
    problem = build(little_dyno.model(), [little_dyno.run(Orifice())], CRITERIA.blocks, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    return pool, search_along_motion(pool, no_progress)


def test_a_reason_says_what_the_figure_beside_it_shows(searched):
    pool, first_round = searched
    chosen = pool.chosen(CRITERIA.most_laws)
    least = residual_left(pool, chosen)
    rejected = list_rejections(pool, pool, first_round, chosen, ())
    lefts = [item.left for item in rejected]
    assert lefts == sorted(lefts)
    named = {name for _, name in chosen.fit.candidate.new}
    assert rejected
    assert named.isdisjoint(item.name for item in rejected)
    for item in rejected:
        assert item.family == effect(item.name).family
        stated = re.search(r"residual is ([0-9.]+) times that of the chosen model", item.why)
        if stated:
            assert float(stated[1]) == pytest.approx(item.left / least, rel=0.01)
            assert ("by no more than chance" in item.why) == (item.left < least)
        if "fits no better" in item.why:
            assert item.left == pytest.approx(least, rel=1e-3)


@pytest.mark.parametrize(
    ("gains", "reason"),
    [
        (-1.0, "does not reduce"),
        (np.tile([16.0, -14.0], 16), "scatters by"),
        (1.0, "a law has to take 19 % off"),
    ],
)
def test_a_law_that_gains_too_little_without_another_is_told_what_it_has_to_gain(
    searched, gains, reason
):
    pool, first_round = searched
    lawless = pool.fits[nominal(pool.problem)]
    law = next(s.laws[-1] for s in first_round.screenings)
    candidate = nominal(pool.problem).with_effects(law)
    costs = lawless.block_costs * (1.0 - 0.02 * np.asarray(gains))
    changed = Pool(pool.problem, pool.given, [lawless.fit], CRITERIA)
    known = next(m.fit for m in pool.fits.values() if m.size)
    changed.fits[candidate] = ValidatedModel(known, costs)
    rejected = list_rejections(changed, changed, first_round, lawless, ())
    (why,) = (item.why for item in rejected if item.name == law[1])
    assert reason in why
