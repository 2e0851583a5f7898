"""A smooth table of force over height and velocity, for a missing force that no law describes.

Reference: Masri and Caughey, A nonparametric identification technique for nonlinear dynamic
problems, J. Appl. Mech. 46 (1979), the restoring-force surface; Eilers and Marx, Flexible smoothing
with B-splines and penalties, Stat. Sci. 11 (1996), for the penalty on second differences.
"""

import numpy as np
from numpy.typing import NDArray

from dart_model.effects.restoring_surface import HEIGHTS, VELOCITIES
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.problem import CandidateModel, Parts, Problem, existing_values, nominal
from rig.diagnosis.search.fit import Fit, fit, leave_block_out_costs
from rig.diagnosis.search.screen import Stage, responses, stage_of

Array = NDArray[np.float64]

_NAME = "restoring_surface"
_SMOOTHING = np.geomspace(1e-4, 1e4, 9)
"""Weights of the penalty that are tried, in units of the data's own curvature."""


def fit_surface(problem: Problem, linear: Fit) -> Fit | None:
    """The best linear model with a table in the strut where that explains most.

    None where it runs away.
    """
    stage = stage_of(problem, linear.model)
    tables = [_table(stage, strut) for strut in range(len(problem.motions))]
    strut = int(np.argmin([cost for _, cost in tables]))
    candidate = nominal(problem).with_effects((strut, _NAME))
    effects = np.concatenate([existing_values(problem, nominal(problem)), tables[strut][0]])
    parts = Parts(linear.parts.linear, effects, linear.parts.starts)
    first = CandidateModel(candidate, parts)
    return fit(problem, first, linear.free, Effort(10), effects=False)


def _table(stage: Stage, strut: int) -> tuple[Array, float]:
    """Parameters of a strut's table, and its out-of-sample sum of squares."""
    motion = stage.problem.motions[strut]
    top = motion.top_speed_m_per_s
    limits = np.array([motion.low_m, motion.high_m, -top, top])
    cells = HEIGHTS * VELOCITIES
    units = [np.concatenate([limits, unit]) for unit in np.eye(cells)]
    columns = responses(stage, (strut, _NAME), units)
    bends = _bends()
    gram, gradient = columns.T @ columns, columns.T @ stage.target
    unit = float(np.trace(gram)) / float(np.trace(bends))
    best, least = np.zeros(cells), np.inf
    for weight in _SMOOTHING * unit:
        values = np.linalg.solve(gram + weight * bends + 1e-12 * unit * np.eye(cells), gradient)
        residual = stage.target - columns @ values
        costs = leave_block_out_costs(residual, -columns, stage.blocks, weight * bends)
        if float(costs.sum()) < least:
            best, least = values, float(costs.sum())
    return np.concatenate([limits, best]), least


def _bends() -> Array:
    """Penalty on second differences along both axes of the table, shape (cells, cells)."""

    def second(count: int) -> Array:
        rows = np.diff(np.eye(count), 2, axis=0)
        return rows.T @ rows

    return np.kron(second(HEIGHTS), np.eye(VELOCITIES)) + np.kron(
        np.eye(HEIGHTS), second(VELOCITIES)
    )
