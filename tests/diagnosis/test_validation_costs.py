"""Sums of squares out of sample: exact for a linear model, expected where nothing is predicted."""

from types import SimpleNamespace

import numpy as np
import pytest

from rig.diagnosis.search import fit as fitting
from rig.diagnosis.search.fit import leave_block_out_costs, validation_costs

BLOCKS, PER_BLOCK, PARAMETERS = 8, 40, 3
NUMBERS = np.repeat(np.arange(BLOCKS), PER_BLOCK)


@pytest.fixture
def line():
    """A straight fit of noise by random columns, with no prior: columns, noise and residual."""
    rng = np.random.default_rng(5)
    columns = rng.standard_normal((BLOCKS * PER_BLOCK, PARAMETERS))
    noise = rng.standard_normal(len(columns))
    return columns, noise, noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0]


def costs_of(monkeypatch, columns, residual):
    """`validation_costs` of a fit with these derivatives."""
    solution = SimpleNamespace(
        prior=np.zeros(columns.shape[1]), jacobian=columns, cost=float(residual @ residual)
    )
    result = SimpleNamespace(solution=solution, residual=residual, blocks=NUMBERS)
    none = np.zeros(columns.shape[1], dtype=np.bool_)
    monkeypatch.setattr(fitting, "start_variables", lambda *_: none)
    return validation_costs(None, result)


def test_without_a_block_a_linear_model_leaves_what_a_fit_to_the_others_leaves(monkeypatch, line):
    columns, noise, residual = line
    costs = costs_of(monkeypatch, columns, residual)
    for block in range(BLOCKS):
        out = block == NUMBERS
        others = np.linalg.lstsq(columns[~out], noise[~out], rcond=None)[0]
        left = noise[out] - columns[out] @ others
        assert costs[block] == pytest.approx(left @ left, rel=1e-9)


def test_where_a_block_predicts_nothing_the_costs_are_those_that_are_expected(monkeypatch, line):
    columns, _, residual = line
    wild = columns.copy()
    wild[NUMBERS == 5] *= (
        1e6  # A free run that parts there: any change of a parameter is amplified.
    )
    sure = leave_block_out_costs(residual, wild, NUMBERS, np.zeros((PARAMETERS,) * 2))
    assert sure.sum() > 1e3 * (residual @ residual)
    costs = costs_of(monkeypatch, wild, residual)
    squares = residual @ residual
    # Mallows: a parameter takes as much off the sum of squares as it adds out of sample.
    assert costs.sum() == pytest.approx(squares * (1.0 + 2.0 * PARAMETERS / len(residual)))
    others = NUMBERS != 5
    assert np.all(costs[:5] >= np.bincount(NUMBERS[others], residual[others] ** 2)[:5])


def test_costs_without_bound_predict_nothing(monkeypatch, line):
    columns, _, residual = line
    monkeypatch.setattr(fitting, "leave_block_out_costs", lambda *_: np.full(BLOCKS, np.nan))
    assert np.all(np.isfinite(costs_of(monkeypatch, columns, residual)))
