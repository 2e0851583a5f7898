"""Corrections of the linear part that tie, and what they add to intervals."""

import numpy as np
import pytest

from rig.diagnosis.numerics.least_squares import Solution, Space
from rig.diagnosis.problem.problem import Candidate, CandidateModel, Parts
from rig.diagnosis.search.fit import Fit, FitCovariance
from rig.diagnosis.search.model_selection import _tied_corrections

ROWS, BLOCKS = 4000, 32


def full_fit(alike):
    """Fit of three columns, of which the first two are as alike as stated, to the first one."""
    rng = np.random.default_rng(1)
    columns = rng.standard_normal((ROWS, 3))
    columns[:, 1] = alike * columns[:, 0] + np.sqrt(1.0 - alike**2) * columns[:, 1]
    goal = columns[:, 0] + rng.standard_normal(ROWS)
    values = np.linalg.lstsq(columns, goal, rcond=None)[0]
    residual = goal - columns @ values
    endless = np.full(3, np.inf)
    space = Space(-endless, endless, np.ones(3), np.zeros(3, dtype=bool))
    solution = Solution(values, residual, -columns, float(residual @ residual), 1.0, np.zeros(3))
    model = CandidateModel(Candidate((), ()), Parts(values, np.zeros(0), ()))
    blocks = np.arange(ROWS) * BLOCKS // ROWS
    return Fit(model, np.ones(3, dtype=bool), True, solution, space, blocks, 0 * blocks)


def test_another_correction_ties_where_it_has_the_same_effect():
    kept = np.array([True, False, False])
    tied = _tied_corrections(full_fit(0.9999), kept)
    assert [flags.tolist() for flags in tied] == [[False, True, False]]


def test_none_ties_where_the_data_distinguish_them():
    assert _tied_corrections(full_fit(0.9), np.array([True, False, False])) == []


def test_a_further_covariance_adds_to_the_squares_of_the_intervals():
    one = FitCovariance(np.diag([9.0, 1.0]), 2.0)
    assert one.wider_by(np.diag([16.0, 0.0])).half == pytest.approx([10.0, 2.0])
