"""What a small share of a further law does to a model's residual, against two simulations."""

import numpy as np
import pytest

from dart_model.effects import effect
from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.problem.build import build
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import model_for
from tests.diagnosis import little_bench, little_dyno
from tests.diagnosis.test_planted_effects import FrictionAndHardening
from tests.diagnosis.test_prescribed import Orifice

LAWS = {
    "cubic_stiffness": [2e4],
    "quadratic_damping": [30.0],
    "bump_stop": [0.39, 2e3, 5.0],
    "maxwell": [200.0, 0.05],
}
SHARE = 1e-3


def problem_of(bench, force):
    problem = build(bench.model(), [bench.run(force)], CRITERIA.blocks, None)
    return problem, first_fits(problem)[1].model


def by_difference(problem, model, name, values):
    """Change of the residual by a share of a law, over the share."""
    law, share = (0, name), np.array(values)
    share[list(effect(name).scaled)] *= SHARE
    changed = model_for(problem, model, model.candidate.with_effects(law), {law: share})
    return (problem.residual(0, changed) - problem.residual(0, model)) / SHARE


@pytest.mark.parametrize("name", sorted(LAWS))
@pytest.mark.parametrize("in_strides", [False, True])
def test_a_free_run_answers_to_a_law_as_two_simulations_do(name, in_strides):
    problem, model = problem_of(little_bench, FrictionAndHardening())
    if in_strides:
        problem = problem.coarser(model)
    laws = [((0, other), np.array(values)) for other, values in LAWS.items()]
    columns = problem.law_responses(0, model, laws)
    column = columns[:, list(LAWS).index(name)]
    expected = by_difference(problem.in_usual_steps(), model, name, LAWS[name])
    assert np.linalg.norm(expected) > 0.0
    assert np.linalg.norm(column - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.parametrize("name", ["quadratic_damping", "cubic_stiffness"])
def test_a_dyno_answers_to_a_law_with_its_force(name):
    problem, model = problem_of(little_dyno, Orifice())
    column = problem.law_responses(0, model, [((0, name), np.array(LAWS[name]))])[:, 0]
    expected = by_difference(problem, model, name, LAWS[name])
    assert np.linalg.norm(column - expected) < 1e-6 * np.linalg.norm(expected)


def test_a_law_without_a_value_there_answers_with_nothing_and_harms_no_other():
    problem, model = problem_of(little_bench, FrictionAndHardening())
    usual = ((0, "cubic_stiffness"), np.array(LAWS["cubic_stiffness"]))
    endless = ((0, "quadratic_damping"), np.array([np.inf]))
    both = problem.law_responses(0, model, [usual, endless])
    assert not np.any(both[:, 1])
    assert np.array_equal(both[:, 0], problem.law_responses(0, model, [usual])[:, 0])


def test_a_model_that_runs_away_has_no_responses():
    problem, model = problem_of(little_bench, FrictionAndHardening())
    damping = next(i for i, p in enumerate(problem.linear) if p.kind == "damping")
    linear = model.parts.linear.copy()
    linear[damping] -= 1e4
    laws = [((0, "cubic_stiffness"), np.array([1.0]))]
    assert problem.law_responses(0, model.with_linear(linear), laws) is None
