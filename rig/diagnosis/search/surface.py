"""A smooth table of force over height and velocity, for what no law describes.

Reference: Masri and Caughey, A nonparametric identification technique for nonlinear dynamic
problems, J. Appl. Mech. 46 (1979), the restoring-force surface; Eilers and Marx, Flexible smoothing
with B-splines and penalties, Stat. Sci. 11 (1996), for the penalty on second differences.
"""

import numpy as np
from numpy.typing import NDArray

from dart_model.effects.restoring_surface import FIRST_FORCE, HEIGHTS, VELOCITIES
from rig.diagnosis.problem.problem import Parts, Problem, existing_values, nominal
from rig.diagnosis.search.fit import Fit, fit, left_out
from rig.diagnosis.search.screen import Stage, response, stage_of

Array = NDArray[np.float64]

_NAME = "restoring_surface"
_SMOOTHING = np.geomspace(1e-4, 1e4, 9)
"""Weights of the penalty that are tried, in units of the data's own curvature."""


def surface(problem: Problem, linear: Fit) -> Fit | None:
    """The best linear model with a table in the strut where it takes most away.

    Args:
        problem: Model and recordings.
        linear: The best linear model.

    Returns:
        The fit; None where the model runs away with it.
    """
    stage = stage_of(problem, linear.candidate, linear.parts)
    tables = [_table(stage, strut) for strut in range(len(problem.motions))]
    strut = int(np.argmin([score for _, score in tables]))
    candidate = nominal(problem).added((strut, _NAME))
    effects = np.concatenate([existing_values(problem, nominal(problem)), tables[strut][0]])
    parts = Parts(linear.parts.linear, effects, linear.parts.starts)
    return fit(problem, candidate, parts, linear.free, 10, effects=False)


def _table(stage: Stage, strut: int) -> tuple[Array, float]:
    """Parameters of a strut's table, and its out-of-sample sum of squares."""
    motion = stage.problem.motions[strut]
    top = motion.top_speed_m_per_s
    limits = np.array([motion.low_m, motion.high_m, -top, top])
    cells = HEIGHTS * VELOCITIES
    columns = np.empty((len(stage.target), cells))
    for i in range(cells):
        unit = np.zeros(FIRST_FORCE + cells)
        unit[:FIRST_FORCE], unit[FIRST_FORCE + i] = limits, 1.0
        columns[:, i] = response(stage, strut, _NAME, unit)
    bends = _bends()
    gram, score = columns.T @ columns, columns.T @ stage.target
    unit = float(np.trace(gram)) / float(np.trace(bends))
    best, least = np.zeros(cells), np.inf
    for weight in _SMOOTHING * unit:
        values = np.linalg.solve(gram + weight * bends + 1e-12 * unit * np.eye(cells), score)
        left = stage.target - columns @ values
        total = float(left_out(left, -columns, stage.blocks, weight * bends).sum())
        if total < least:
            best, least = values, total
    return np.concatenate([limits, best]), least


def _bends() -> Array:
    """Penalty on second differences along both axes of the table, shape (cells, cells)."""

    def second(count: int) -> Array:
        rows = np.diff(np.eye(count), 2, axis=0)
        return rows.T @ rows

    return np.kron(second(HEIGHTS), np.eye(VELOCITIES)) + np.kron(
        np.eye(HEIGHTS), second(VELOCITIES)
    )
