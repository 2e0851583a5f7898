"""Derivatives by central differences: a model is known by its responses alone."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def central_differences(function: Callable[[Array], Array], widths: Sequence[float]) -> Array:
    """Derivatives about zero of a function of shape (n,) -> (m,), by a step for each argument.

    The result has the shape (m, n).
    """
    columns: list[Array] = []
    for step, width in zip(np.diag(np.asarray(widths, np.float64)), widths, strict=True):
        columns.append((function(step) - function(-step)) / (2.0 * width))
    return np.column_stack(columns)
