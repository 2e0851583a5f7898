"""Forces of struts that move each other, so that each observer has its strut to itself.

An observer takes the force of its strut, and the force by which the model's law errs because the
model is not where the bench is, w = k x + c dx/dt, to act on its height alone, with an acceleration
of mobility times force. Where struts share bodies, as tyre and suspension do, each force moves the
other heights as well, nearly as much as its own. The forces

    F = M^-1 D (f + w) - w

give each height the acceleration that its observer expects, M the mobility matrix of the struts
(acceleration of each height per newton in each strut), D its diagonal, f the observers' forces. The
residual forces of the struts follow from the observers' in the same way.

Reference: Skogestad and Postlethwaite, "Multivariable Feedback Control" (2005), 3.4 (decoupling).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.protocol import AnyPlant
from rig.closed_loop.strut_response import mobility_matrix
from rig.observers.protocol import AnyObserver

Array = NDArray[np.float64]
Matrix = tuple[tuple[float, ...], ...]
"""Rows of the transformation from observers' forces to the struts'; empty for the same."""

_ALONE = 1e-9
"""Share of a strut's own mobility up to which another strut does not move it."""


def decouple(
    plant: AnyPlant, observers: Sequence[AnyObserver], heights_m: Sequence[float]
) -> Matrix:
    """The transformation of observers' forces, at rest at some heights.

    Struts whose observers give forces of their own are left as they are. Where there are more
    struts than coordinates, the smallest forces are taken.
    """
    which = [index for index, item in enumerate(observers) if item.asks_for_acceleration]
    if len(which) < 2:
        return ()
    mobility = mobility_matrix(plant, heights_m)[np.ix_(which, which)]
    own = np.diag(mobility)
    if np.all(np.abs(mobility - np.diag(own)) <= _ALONE * np.abs(own)[:, np.newaxis]):
        return ()
    matrix = np.eye(len(observers))
    matrix[np.ix_(which, which)] = np.linalg.pinv(mobility, rcond=1e-9) * own
    return tuple(tuple(row) for row in matrix.tolist())


def combine(
    matrix: Matrix, forces_n: Sequence[float], law_errors_n: Sequence[float]
) -> list[float]:
    """Forces of the struts, by those of the observers and by the errors of the model's laws."""
    if not matrix:
        return list(forces_n)
    asked_n = [force_n + error_n for force_n, error_n in zip(forces_n, law_errors_n, strict=True)]
    return [
        sum([share * force_n for share, force_n in zip(row, asked_n, strict=True)]) - error_n
        for row, error_n in zip(matrix, law_errors_n, strict=True)
    ]


def combine_stds(matrix: Matrix, stds_n: Sequence[float]) -> list[float]:
    """Standard deviations of the struts' forces, by those of observers whose errors are apart."""
    if not matrix:
        return list(stds_n)
    return [
        sum([(share * std_n) ** 2 for share, std_n in zip(row, stds_n, strict=True) if share])
        ** 0.5
        for row in matrix
    ]
