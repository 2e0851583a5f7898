"""Bounded nonlinear least squares for residuals that come from simulations.

Levenberg-Marquardt with forward differences; a step that leaves the bounds is cut off at them, and
parameters that must stay positive are searched by their logarithm.

References:
    Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comput. 19
    (1965), for the update of a Jacobian that is still nearly true.
    Moré, The Levenberg-Marquardt algorithm, Lecture Notes in Mathematics 630 (1978).
    Kanzow, Yamashita, Fukushima, J. Comput. Appl. Math. 172 (2004), projected variant.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ResidualOf = Callable[[Array], Array | None]

_DIFFERENCE = 1e-4
"""Step of the forward differences in units of the search."""
_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e9
_TRUE = 0.05
"""Share of the change of a residual, squared, that its tangent may miss and still be mended."""
_SETTLED = 0.9
"""Share of a residual's level that is left by a step that is called the last."""
_LARGEST_LOGARITHMIC_STEP = 1.5
"""A factor of 4.5: beyond it a law's shape is another one, and its tangent says nothing."""


class Space(NamedTuple):
    """Where parameters are searched.

    Attributes:
        low: Lowest values, shape (k,).
        high: Highest values, shape (k,).
        scale: What counts as a change of one that is searched as it is, shape (k,).
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
        exponent = np.where(self.logarithmic, np.clip(inner, -700.0, 700.0), 0.0)
        values = np.where(self.logarithmic, np.exp(exponent), inner * self.scale)
        return np.clip(values, self.low, self.high)

    def part(self, chosen: NDArray[np.bool_]) -> "Space":
        """Some of the parameters."""
        return Space(
            self.low[chosen], self.high[chosen], self.scale[chosen], self.logarithmic[chosen]
        )


def joined(spaces: list[Space]) -> Space:
    """Spaces one after another."""
    return Space(*(np.concatenate(entries) for entries in zip(*spaces, strict=True)))


class Prior(NamedTuple):
    """What is known of the search variables before.

    Attributes:
        centre: Their most likely values, shape (k,).
        weight: Inverse standard deviations; zero where nothing is known; shape (k,).
        most_level: Mean square of the residual up to which a prior gains weight with it: what a
            wrong model leaves tells less of its parameters than noise would.
    """

    centre: Array
    weight: Array
    most_level: float = np.inf

    def level(self, residual: Array) -> float:
        """Variance that a whitened residual stands for, one at the noise floor."""
        return min(max(1.0, float(np.mean(residual**2))), self.most_level)


class Solution(NamedTuple):
    """Result of a fit.

    Attributes:
        values: Parameters, shape (k,).
        residual: Residual there, shape (m,).
        jacobian: Derivative of the residual by the search variables, shape (m, k).
        cost: Sum of squares.
        level: Variance that the residual stands for.
        prior: Precision of the prior in units of that variance, shape (k,).
    """

    values: Array
    residual: Array
    jacobian: Array
    cost: float
    level: float
    prior: Array


class Rows(NamedTuple):
    """Rows of the residual that are all that one parameter moves.

    Attributes:
        first: First row.
        last: Past the last row.
        residual_of: Those rows alone, of parameters, or None where there are none.
    """

    first: int
    last: int
    residual_of: ResidualOf


def solve(
    residual_of: ResidualOf,
    start: Array,
    space: Space,
    iterations: int,
    tolerance: float = 1e-4,
    rows: Mapping[int, Rows] = MappingProxyType({}),
    threads: int = 1,
    prior: Prior | None = None,
    sides: int = 1,
) -> Solution | None:
    """Least squares from a start.

    Args:
        residual_of: Residual of parameters, or None where there is none.
        start: First parameters, shape (k,).
        space: Where to search.
        iterations: Most steps that are accepted.
        tolerance: Relative gain below which the search ends.
        rows: Parameters, by index, that move some rows only; their derivatives then cost less.
        threads: Differences that are taken at a time.
        prior: What is known before; nothing if absent.
        sides: Sides on which the last differences are taken. With two the smaller counts: where a
            law switches, one may catch a jump that is no derivative. With one the last tangent of
            the search is kept.

    Returns:
        The solution, or None if there is no residual at the start.
    """
    x = space.inner(start)
    begin = residual_of(space.outer(x))
    if begin is None or not np.all(np.isfinite(begin)):
        return None
    r, damping = begin, _FIRST_DAMPING
    known = prior or Prior(np.zeros_like(x), np.zeros_like(x))
    level = known.level(r)

    def tangent(sides: int = 1) -> Array:
        return _jacobian(residual_of, x, r, space, rows, threads, sides)

    jacobian, fresh = tangent(), True
    for _ in range(iterations):
        precision = level * known.weight**2
        here = _Point(x, r, known.centre, precision)
        moved = _moved(residual_of, here, space, jacobian, damping, patient=fresh)
        if moved is None:
            if fresh:
                break
            jacobian, fresh = tangent(), True
            continue
        there, damping = moved
        change, move = there.residual - r, there.x - x
        error = change - jacobian @ move
        small = here.cost - there.cost < tolerance * here.cost
        x, r = there.x, there.residual
        # A residual that has fallen leaves less weight to the prior: there may be more to gain.
        lower = min(level, known.level(r))
        small, level = small and lower > _SETTLED * level, lower
        if small and fresh:
            break
        if not small and error @ error < _TRUE * (change @ change):
            # Near to the truth: a rank of one mends it, at the cost of nothing.
            jacobian, fresh = jacobian + np.outer(error, move) / float(move @ move), False
        else:
            jacobian, fresh = tangent(), True
    precision = level * known.weight**2
    if sides > 1 or not fresh:
        jacobian = tangent(sides)
    return Solution(space.outer(x), r, jacobian, float(r @ r), level, precision)


class _Point(NamedTuple):
    """Where a search is."""

    x: Array
    residual: Array
    centre: Array
    precision: Array

    @property
    def cost(self) -> float:
        """Sum of squares, the prior's with it."""
        away = self.x - self.centre
        return float(self.residual @ self.residual + away @ (self.precision * away))


def _moved(
    residual_of: ResidualOf,
    here: _Point,
    space: Space,
    jacobian: Array,
    damping: float,
    *,
    patient: bool,
) -> tuple[_Point, float] | None:
    """A step with as little damping as lowers the cost; without patience one is tried."""
    with np.errstate(over="ignore", invalid="ignore"):  # No step is taken from what overflows.
        products = jacobian.T @ jacobian + np.diag(here.precision)
        gradient = jacobian.T @ here.residual + here.precision * (here.x - here.centre)
    diagonal = np.maximum(np.diag(products), 1e-300)
    largest = np.where(space.logarithmic, _LARGEST_LOGARITHMIC_STEP, np.inf)
    free = ~_pressed(here.x, gradient, space)
    while damping < _LARGEST_DAMPING:
        step = _step(products, gradient, diagonal * damping, free)
        if step is None:
            return None
        trial = space.inner(space.outer(here.x + np.clip(step, -largest, largest)))
        residual = residual_of(space.outer(trial))
        if residual is not None:
            there = here._replace(x=trial, residual=residual)
            if there.cost < here.cost:
                return there, max(damping * 0.1, 1e-12)
        if not patient:
            return None
        damping *= 10.0
    return None


def _step(
    products: Array, gradient: Array, damping: Array, free: NDArray[np.bool_]
) -> Array | None:
    step = np.zeros_like(gradient)
    part = products[np.ix_(free, free)] + np.diag(damping[free])
    if not np.all(np.isfinite(part)):
        return None
    # To unit diagonal: parameters differ by many orders of magnitude.
    size = np.sqrt(np.maximum(np.diag(part), 1e-300))
    scaled = part / np.outer(size, size)
    step[free] = -np.linalg.lstsq(scaled, gradient[free] / size, rcond=None)[0] / size
    return step


def _pressed(x: Array, gradient: Array, space: Space) -> NDArray[np.bool_]:
    """Which variables the gradient presses against a bound."""
    values = space.outer(x)
    return ((values <= space.low) & (gradient > 0.0)) | ((values >= space.high) & (gradient < 0.0))


def _jacobian(
    residual_of: ResidualOf,
    x: Array,
    r: Array,
    space: Space,
    rows: Mapping[int, Rows],
    threads: int,
    sides: int,
) -> Array:
    """Derivatives (m, k) by differences; of two sides the smaller."""
    columns = np.zeros((len(r), len(x)))
    everything = Rows(0, len(r), residual_of)

    def fill(i: int) -> None:
        there = rows.get(i, everything)
        part = slice(there.first, there.last)
        size = _DIFFERENCE * (1.0 if space.logarithmic[i] else max(1.0, abs(x[i])))
        found: list[Array] = []
        for step in (size, -size):
            trial = x.copy()
            trial[i] += step
            moved_by = space.inner(space.outer(trial))[i] - x[i]
            if abs(moved_by) < 0.5 * size:
                continue
            moved = there.residual_of(space.outer(trial))
            if moved is not None and np.all(np.isfinite(moved)):
                found.append((moved - r[part]) / moved_by)
            if len(found) == sides:
                break
        if found:
            with np.errstate(over="ignore"):  # A column that overflows is the larger one.
                columns[part, i] = min(found, key=lambda column: float(column @ column))

    if threads == 1:
        for i in range(len(x)):
            fill(i)
    else:
        # The simulations are machine code, which lets go of the interpreter.
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(fill, range(len(x))))
    return columns
