"""Each number that decides does so: an absurd one turns a right answer into another."""

import warnings
from dataclasses import fields, replace
from functools import cache

import pytest

from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.problem.build import build
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.explore import search_along_motion
from rig.diagnosis.search.pool import Pool
from tests.criteria_study.cases import CASES, answer

ABSURD = [
    ("blocks", 2, "kept_back"),
    ("held_out_every", 1, "kept_back"),
    ("screened", 0, "one_kind"),
    ("most_laws", 0, "hardening"),
    ("most_laws", 1, "two_kinds"),
    ("fitted_a_size", 0, "exponential"),
    ("hopeless", 1e-9, "hardening"),
    ("standard_errors", 1e9, "hardening"),
    ("level", 0.0, "hardening"),
    ("least_likelihood_gain", 1e12, "hardening"),
    ("least_share", 2.0, "hardening"),
    ("least_above_noise", 1e9, "hardening"),
    ("least_above_noise_later", 1e9, "two_kinds"),
    ("scatter", 1e9, "hardening"),
    ("bounded", 1e9, "hardening"),
    ("significant", 1e9, "stiffness"),
    ("significant", 0.0, "stiffness"),
    ("cancelling", 1.0, "two_kinds"),
    ("leftover", 1.0, "hardening"),
    ("passive", -1.0, "hardening"),
    ("passive", 1e9, "driven"),
    ("dissipating_to", 1.0, "driven_if_faster"),
    ("explained", 1e-3, "hardening"),
    ("explained", 1e9, "most_left"),
    ("partly", 1.5, "some_left"),
    ("partly", -1.0, "most_left"),
    ("white", 1.0, "nothing"),
    ("white", 0.0, "hardening"),
]
"""Criterion, absurd value, and a case whose answer depends on it."""


@cache
def usual(case):
    return answer(case, CRITERIA)


def test_every_criterion_has_an_absurd_value():
    absurd = {name for name, _, _ in ABSURD}
    tested_alone = {
        "beam", "formula", "imitation", "improbable", "slow", "dry", "settled", "leading"
    }  # fmt: skip
    assert absurd | tested_alone == {field.name for field in fields(CRITERIA)}


@pytest.mark.slow
@pytest.mark.parametrize("case", sorted({case for _, _, case in ABSURD}))
def test_the_usual_criteria_give_the_right_answer(case):
    assert usual(case) == CASES[case].right


@pytest.mark.long
@pytest.mark.parametrize(("name", "value", "case"), ABSURD)
def test_an_absurd_criterion_gives_another_answer(name, value, case):
    with warnings.catch_warnings():
        # A deviation over two blocks or one is no number.
        warnings.simplefilter("ignore", RuntimeWarning)
        found = answer(case, replace(CRITERIA, **{name: value}))
    assert found != CASES[case].right
    assert usual(case) == CASES[case].right


def explored(criteria):
    """What a first search of a case with two laws of one kind has fitted."""
    spec, runs, _ = CASES["one_kind"].make()
    problem = build(spec, runs, criteria.blocks, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], criteria)
    search_along_motion(pool, lambda _what, _share: None)
    return pool


@pytest.mark.slow
def test_without_a_beam_no_pair_is_looked_for():
    assert max(model.size for model in explored(CRITERIA).fits.values()) == 2
    assert max(model.size for model in explored(replace(CRITERIA, beam=0)).fits.values()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("absurd", "worth"), [({}, False), ({"imitation": 1e9}, True), ({"formula": 0.0}, True)]
)
def test_a_pair_that_is_but_a_better_formula_for_one_law_is_not_worth_it(absurd, worth):
    pool = explored(replace(CRITERIA, **absurd))
    pair = next(s for s in pool.fits.values() if s.size == 2 and not pool.invalid)
    one = next(s for s in pool.fits.values() if s.size and set(s.families) < set(pair.families))
    rows = one.fit.rows

    def leaving(model, above):
        share = (rows + above) / model.block_costs.sum()
        solution = model.fit.solution._replace(cost=rows + above)
        fitted = model.fit._replace(solution=solution)
        return model._replace(fit=fitted, block_costs=share * model.block_costs)

    nearly = leaving(one, 1e-3 * pool.linear.cost)
    assert pool.is_formula(nearly) is ("formula" not in absurd)
    better = leaving(pair, 0.1 * nearly.excess)
    assert not pool.at_floor(better)
    assert pool.prefers(better, nearly) is worth
    assert pool.prefers(leaving(pair, 1e-3 * nearly.excess), nearly)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("one", "other", "worth"),
    [
        ("cubic_stiffness", "quadratic_damping", True),
        ("coulomb_friction", "free_play", True),
        ("coulomb_friction", "quadratic_damping", False),
        ("coulomb_friction", "hidden_mass", False),
    ],
)
def test_beside_a_nearly_right_law_storing_and_dissipating_ones_take_a_share(one, other, worth):
    pool = explored(CRITERIA)
    fitted = pool.linear
    candidate = fitted.fit.candidate

    def leaving(laws, above):
        rows = fitted.fit.rows
        other = candidate._replace(new=tuple((0, law) for law in laws))
        fit = fitted.fit._replace(model=fitted.fit.model._replace(candidate=other))
        share = (rows + above) / fitted.cost
        return fitted._replace(fit=fit, block_costs=share * fitted.block_costs)

    above = 5e-3 * fitted.cost
    assert pool.is_formula(leaving([one], above))
    pair = leaving([one, other], 0.5 * above)
    assert pool.prefers(pair, leaving([one], above)) is worth
