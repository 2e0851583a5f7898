"""Bounded nonlinear least squares for residuals that come from simulations.

Levenberg-Marquardt with forward differences; a step that leaves the bounds is cut off at them, and
parameters that must stay positive are searched by their logarithm.

References:
    Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978).
    Kanzow, Yamashita, Fukushima, J. Comput. Appl. Math. 172 (2004), projected variant.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.identify.compiled import gram

Array = NDArray[np.float64]

_DIFFERENCE = 1e-4
_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e9
_WORTH_THREADS = 10_000
_THREADS = 2


class Space(NamedTuple):
    """Where parameters are searched.

    Attributes:
        low: Lowest values, shape (k,).
        high: Highest values, shape (k,).
        scale: What counts as a change of one of those searched as they are, shape (k,).
        logarithmic: Which are searched by their logarithm, shape (k,).
    """

    low: Array
    high: Array
    scale: Array
    logarithmic: NDArray[np.bool_]

    def inner(self, values: Array) -> Array:
        """Search variables of parameters."""
        inside = np.clip(values, self.low, self.high)
        safe = np.where(self.logarithmic, inside, 1.0)
        return np.where(self.logarithmic, np.log(safe), inside / self.scale)

    def outer(self, inner: Array) -> Array:
        """Parameters of search variables, within the bounds."""
        exponent = np.where(self.logarithmic, np.minimum(inner, 200.0), 0.0)
        values = np.where(self.logarithmic, np.exp(exponent), inner * self.scale)
        return np.clip(values, self.low, self.high)


class Solution(NamedTuple):
    """Result of a fit.

    Attributes:
        values: Parameters, shape (k,).
        residual: Residual there, shape (m,).
        jacobian: Derivative of the residual by the search variables, shape (m, k).
        cost: Sum of squares.
    """

    values: Array
    residual: Array
    jacobian: Array
    cost: float


class Rows(NamedTuple):
    """Rows of the residual that are all that one parameter moves.

    Attributes:
        first: First row.
        last: Past the last row.
        residual_of: Those rows alone, of parameters, or None where there are none.
    """

    first: int
    last: int
    residual_of: Callable[[Array], Array | None]


def solve(
    residual_of: Callable[[Array], Array | None],
    start: Array,
    space: Space,
    iterations: int,
    tolerance: float = 1e-4,
    rows: Mapping[int, Rows] = MappingProxyType({}),
) -> Solution | None:
    """Least squares from a start.

    Args:
        residual_of: Residual of parameters, or None where there is none.
        start: First parameters, shape (k,).
        space: Where to search.
        iterations: Most steps that are accepted.
        tolerance: Relative gain below which the search ends.
        rows: Parameters, by index, that move some rows only; their derivatives then cost less.

    Returns:
        The solution, or None if there is no residual at the start.
    """
    x = space.inner(start)
    r = residual_of(space.outer(x))
    if r is None:
        return None
    cost = float(r @ r)
    damping = _FIRST_DAMPING
    jacobian = _jacobian(residual_of, x, r, space, rows)
    for _ in range(iterations):
        products, gradient = _gram(jacobian), jacobian.T @ r
        diagonal = np.diag(products).copy()
        diagonal[diagonal <= 0.0] = 1e-300
        before = cost
        while damping < _LARGEST_DAMPING:
            free = ~_pressed(x, gradient, space)
            step = np.zeros_like(x)
            part = products[np.ix_(free, free)] + damping * np.diag(diagonal[free])
            if not np.all(np.isfinite(part)):
                return Solution(space.outer(x), r, jacobian, cost)
            step[free] = -np.linalg.lstsq(part, gradient[free], rcond=None)[0]
            step = np.clip(step, -_largest(space), _largest(space))
            trial = space.inner(space.outer(x + step))
            moved = residual_of(space.outer(trial))
            if moved is not None and float(moved @ moved) < cost:
                x, r, cost = trial, moved, float(moved @ moved)
                damping = max(damping * 0.1, 1e-12)
                break
            damping *= 10.0
        else:
            break
        if before - cost < tolerance * before:
            break
        jacobian = _jacobian(residual_of, x, r, space, rows)
    return Solution(space.outer(x), r, jacobian, cost)


def _largest(space: Space) -> Array:
    return np.where(space.logarithmic, 1.5, np.inf)


def _pressed(x: Array, gradient: Array, space: Space) -> NDArray[np.bool_]:
    """Which variables the gradient presses against a bound."""
    values = space.outer(x)
    return ((values <= space.low) & (gradient > 0.0)) | ((values >= space.high) & (gradient < 0.0))


def _jacobian(
    residual_of: Callable[[Array], Array | None],
    x: Array,
    r: Array,
    space: Space,
    rows: Mapping[int, Rows],
) -> Array:
    columns = np.zeros((len(r), len(x)))
    everything = Rows(0, len(r), residual_of)

    def fill(i: int) -> None:
        there = rows.get(i, everything)
        part = slice(there.first, there.last)
        size = _DIFFERENCE * (1.0 if space.logarithmic[i] else max(1.0, abs(x[i])))
        for step in (size, -size):
            trial = x.copy()
            trial[i] += step
            moved_by = space.inner(space.outer(trial))[i] - x[i]
            if abs(moved_by) < 0.5 * size:
                continue
            moved = there.residual_of(space.outer(trial))
            if moved is not None:
                columns[part, i] = (moved - r[part]) / moved_by
                return

    if len(r) < _WORTH_THREADS:
        for i in range(len(x)):
            fill(i)
    else:
        # The simulations are machine code, which lets go of the interpreter.
        with ThreadPoolExecutor(_THREADS) as pool:
            list(pool.map(fill, range(len(x))))
    return columns


def _gram(jacobian: Array) -> Array:
    out = np.empty((jacobian.shape[1], jacobian.shape[1]))
    gram(np.ascontiguousarray(jacobian.T), out)
    return out
