"""Each number that decides does so: an absurd one turns a right answer into another."""

import warnings
from dataclasses import fields, replace
from functools import cache

import pytest

from rig.diagnosis.search.criteria import CRITERIA
from tests.criteria_study.cases import CASES, answer

ABSURD = [
    ("blocks", 2, "kept_back"),
    ("kept_every", 1, "kept_back"),
    ("screened", 0, "one_kind"),
    ("beam", 0, "three_kinds"),
    ("most_laws", 0, "hardening"),
    ("most_laws", 1, "two_kinds"),
    ("finalists", 0, "exponential"),
    ("hopeless", 1e-9, "hardening"),
    ("standard_errors", 1e9, "hardening"),
    ("least_likelihood_gain", 1e12, "hardening"),
    ("least_share", 2.0, "hardening"),
    ("least_above_noise", 1e9, "hardening"),
    ("least_above_noise_later", 1e9, "two_kinds"),
    ("formula", 1e9, "one_kind"),
    ("bounded", 1e9, "hardening"),
    ("significant", 1e9, "stiffness"),
    ("significant", 0.0, "stiffness"),
    ("cancelling", 1.0, "two_kinds"),
    ("leftover", 1.0, "hardening"),
    ("passive", -1.0, "hardening"),
    ("passive", 1e9, "driven"),
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
    assert {name for name, _, _ in ABSURD} == {field.name for field in fields(CRITERIA)}


@pytest.mark.parametrize("case", sorted({case for _, _, case in ABSURD}))
def test_the_usual_criteria_give_the_right_answer(case):
    assert usual(case) == CASES[case].right


@pytest.mark.parametrize(("name", "value", "case"), ABSURD)
def test_an_absurd_criterion_gives_another_answer(name, value, case):
    with warnings.catch_warnings():
        # A deviation over two blocks or one is no number.
        warnings.simplefilter("ignore", RuntimeWarning)
        found = answer(case, replace(CRITERIA, **{name: value}))
    assert found != CASES[case].right
    assert usual(case) == CASES[case].right
