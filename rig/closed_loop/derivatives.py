"""Derivatives by central differences: a model is known by its responses alone."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def central_differences(function: Callable[[Array], Array], widths: Sequence[float]) -> Array:
    """Derivatives of a function about zero, one column per argument.

    Args:
        function: Takes arguments of shape (n,), gives values of shape (m,).
        widths: Step of each argument.

    Returns:
        Shape (m, n).
    """
    columns: list[Array] = []
    for step, width in zip(np.diag(np.asarray(widths, np.float64)), widths, strict=True):
        columns.append((function(step) - function(-step)) / (2.0 * width))
    return np.column_stack(columns)
