"""Laws that were steps towards a model, and that it does not need."""

import numpy as np
import pytest

from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.problem.problem import nominal
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.pool import Pool
from rig.diagnosis.search.validity import size_in_deviations
from tests.diagnosis.test_derivatives import model_with
from tests.diagnosis.test_held_models import problem_of
from tests.diagnosis.test_one_orbit import Cubic

SPRING, VALVE = (0, "cubic_stiffness"), (0, "quadratic_damping")


@pytest.fixture(scope="module")
def pool():
    """Fits to a bench with a cubic spring; they begin with a quadratic damper as well."""
    problem = problem_of(Cubic())
    given, linear = first_fits(problem)
    found = Pool(problem, given, [linear], CRITERIA)
    begun = model_with(problem, {SPRING: np.array([3e5]), VALVE: np.array([0.5])}, {})
    found.attempt(begun)
    return found


def test_a_model_that_is_invalid_but_the_best_is_fitted_without_its_weakest_law(pool):
    base = nominal(pool.problem)
    assert "quadratic_damping" in pool.invalid[base.with_effects(SPRING, VALVE)]
    least = pool.least()
    assert least.fit.candidate == base.with_effects(SPRING)
    assert least.fit.mean_square < 1.1
    assert least.fit.parts.effects == pytest.approx([Cubic.stiffness_n_per_m3], rel=1e-2)


def test_the_size_of_a_law_counts_in_deviations_from_zero(pool):
    both = pool.fits[nominal(pool.problem).with_effects(SPRING, VALVE)]
    sizes = size_in_deviations(pool.problem, both.fit)
    assert sizes[VALVE] < CRITERIA.bounded < sizes[SPRING]
