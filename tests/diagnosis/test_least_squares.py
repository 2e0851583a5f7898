"""Least squares for simulations, some of which run away."""

import numpy as np
import pytest

from rig.diagnosis.numerics.least_squares import (
    Differences,
    Effort,
    Exact,
    Space,
    Together,
    solve,
)

FREE = Space(
    low=np.full(2, -1e6), high=np.full(2, 1e6), scale=np.ones(2), logarithmic=np.zeros(2, np.bool_)
)
MATRIX = np.array([[1.0, 0.0], [0.5, 2.0], [-1.0, 1.0], [0.2, 0.1]])
MEASURED = np.array([3.0, 1.0, -2.0, 0.5])


def test_a_linear_problem_has_the_solution_of_the_normal_equations():
    solution = solve(
        Differences(lambda x: MATRIX @ x - MEASURED), np.zeros(2), FREE, Effort(steps=20)
    )
    assert solution is not None
    expected = np.linalg.solve(MATRIX.T @ MATRIX, MATRIX.T @ MEASURED)
    np.testing.assert_allclose(solution.values, expected, rtol=1e-6)
    assert solution.cost == pytest.approx(
        float(np.sum((MATRIX @ expected - MEASURED) ** 2)), rel=1e-9
    )


@pytest.mark.parametrize("runaway", [1e201, np.inf])
def test_a_model_that_runs_away_beyond_a_limit_does_not_end_the_search(runaway):
    """The square of such a residual is beyond what a float holds."""
    away = []

    def residual_of(x):
        if x[0] > 2.5:  # the undamped first step goes to x = 3 at once
            away.append(x[0])
            return np.full(2, runaway)
        return np.array([x[0] ** 2 + 2.0 * x[0] - 8.0, x[1]])

    solution = solve(Differences(residual_of), np.array([0.2, 1.0]), FREE, Effort(steps=50))
    assert away
    assert solution is not None
    np.testing.assert_allclose(solution.values, [2.0, 0.0], atol=1e-3)


@pytest.mark.parametrize("residual", [None, np.full(2, 1e201), np.array([0.0, np.nan])])
def test_a_start_without_a_finite_cost_has_no_solution(residual):
    solution = solve(Differences(lambda _: residual), np.zeros(2), FREE, Effort(steps=5))
    assert solution is None


@pytest.mark.parametrize("parted", [np.nan, np.inf, 1e280, None])
def test_differences_stand_for_a_derivative_without_bound(parted):
    """A derivative that is exact but for one column, or of which there is none."""

    def derivative_of(_):
        if parted is None:
            return None
        columns = MATRIX.copy()
        columns[2:, 1] = parted
        return columns

    function = Exact(derivative_of, Differences(lambda x: MATRIX @ x - MEASURED))
    residual = -MEASURED
    found = function.jacobian(np.zeros(2), residual, FREE, 1)
    np.testing.assert_allclose(found, MATRIX, atol=1e-9)


def test_an_exact_derivative_is_taken_as_it_is():
    slope = np.array([[2.0, 0.0], [0.0, 3.0], [0.0, 0.0], [0.0, 0.0]])
    function = Exact(lambda _: slope, Differences(lambda x: MATRIX @ x - MEASURED))
    np.testing.assert_array_equal(function.jacobian(np.zeros(2), -MEASURED, FREE, 1), slope)


def test_residuals_that_are_had_together_lead_where_single_ones_do():
    """A parameter at its upper bound has a difference on its other side; a fixed one has none."""

    def residual_of(x):
        return np.array([x[0] ** 2 - 2.0, 3.0 * x[1] - x[0], x[2] - 1.0])

    low, high = np.array([0.1, -5.0, 2.0]), np.array([1.0, 5.0, 2.0])
    space = Space(low, high, np.ones(3), np.array([True, False, False]))
    start = np.array([1.0, 4.0, 2.0])
    several = Together(lambda points: np.array([residual_of(x) for x in points]).T)
    each, together = (
        solve(function, start, space, Effort(steps=20, sides=1))
        for function in (Differences(residual_of), several)
    )
    assert each is not None
    assert together is not None
    np.testing.assert_allclose(together.values, [1.0, 1.0 / 3.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(together.jacobian, each.jacobian, atol=1e-9)
    assert np.all(together.jacobian[:, 2] == 0.0)


def test_what_is_not_finite_has_no_derivative_together():
    several = Together(lambda points: np.where(points[:, :1].T > 1.0, np.inf, points.T))
    found = several.jacobian(np.array([1.0, 0.5]), np.array([1.0, 0.5]), FREE, 1)
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.0, 1.0]], atol=1e-9)
    assert several.residual_of(np.array([2.0, 0.0])) is None
