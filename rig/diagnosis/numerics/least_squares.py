"""Bounded nonlinear least squares for residuals that come from simulations.

Levenberg-Marquardt with exact derivatives, or with forward differences; a step that leaves the
bounds is cut off at them, and parameters that must stay positive are searched by their logarithm.

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
_PARTED = 1e3
"""Change by that step, in residuals, from which on a derivative is that of a simulation that parts
from its neighbours: of others it is a small share of the signal, which is ten thousand at most."""
_FIRST_DAMPING = 1e-3
_LARGEST_DAMPING = 1e9
_TRUE = 0.05
"""Share of the change of a residual, squared, up to which an error of its Jacobian is updated."""
_SETTLED = 0.9
"""Least share of the residual's level after a step for which that step can be the last."""
_LARGEST_LOGARITHMIC_STEP = 1.5
"""A factor of 4.5: beyond it a law has another shape, and its Jacobian is no guide."""


class Space(NamedTuple):
    """Bounds and scales of the parameters that are searched, each of shape (k,).

    Attributes:
        scale: Unit of each parameter that is not searched by its logarithm.
        logarithmic: Which are searched by their logarithm.
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
        """The space of some of the parameters."""
        return Space(
            self.low[chosen], self.high[chosen], self.scale[chosen], self.logarithmic[chosen]
        )


def concatenate_spaces(spaces: list[Space]) -> Space:
    """The space of all parameters of several, one after another."""
    return Space(*(np.concatenate(entries) for entries in zip(*spaces, strict=True)))


class Prior(NamedTuple):
    """Prior of the search variables, Gaussian and independent.

    Attributes:
        centre: Their most likely values, shape (k,).
        weight: Inverse standard deviations; zero where there is no prior; shape (k,).
        most_level: Mean square of the residual up to which a prior gains weight with it: the
            residual of a wrong model determines its parameters less than noise would.
    """

    centre: Array
    weight: Array
    most_level: float = np.inf

    def level(self, residual: Array) -> float:
        """Variance of a whitened residual, at least one, the noise floor."""
        return min(max(1.0, float(np.mean(residual**2))), self.most_level)


class Solution(NamedTuple):
    """Result of a fit.

    Attributes:
        values: Parameters, shape (k,).
        residual: Residual there, shape (m,).
        jacobian: Derivative of the residual by the search variables, shape (m, k).
        level: Variance of the residual, see `Prior.level`.
        prior: Precision of the prior in units of that variance, shape (k,).
    """

    values: Array
    residual: Array
    jacobian: Array
    cost: float
    level: float
    prior: Array


class Rows(NamedTuple):
    """The rows of the residual that depend on a parameter.

    Attributes:
        residual_of: Those rows alone as a function of parameters; None where the model runs away.
    """

    first: int
    last: int
    residual_of: ResidualOf


class Effort(NamedTuple):
    """How far a fit goes.

    Attributes:
        steps: Most steps that are accepted.
        gain: Relative gain below which it ends.
        sides: Sides on which its last differences are taken. With two the smaller counts: where a
            law switches, one may catch a jump that is no derivative. With one the last Jacobian of
            the search is kept.
    """

    steps: int
    gain: float = 1e-4
    sides: int = 2


class Differences(NamedTuple):
    """A residual with its derivatives by differences.

    Attributes:
        residual_of: Residual as a function of parameters, or None where there is none.
        rows: Parameters, by index, on which some rows only depend; they then cost less.
    """

    residual_of: ResidualOf
    rows: Mapping[int, Rows] = MappingProxyType({})
    threads: int = 1

    def jacobian(self, x: Array, residual: Array, space: Space, sides: int) -> Array:
        """Derivatives (m, k) at search variables; of two sides the smaller."""
        columns = np.zeros((len(residual), len(x)))
        all_rows = Rows(0, len(residual), self.residual_of)

        def fill(i: int) -> None:
            rows = self.rows.get(i, all_rows)
            part = slice(rows.first, rows.last)
            size = _DIFFERENCE * (1.0 if space.logarithmic[i] else max(1.0, abs(x[i])))
            slopes: list[Array] = []
            for step in (size, -size):
                trial = x.copy()
                trial[i] += step
                difference = space.inner(space.outer(trial))[i] - x[i]
                if abs(difference) < 0.5 * size:
                    continue
                moved = rows.residual_of(space.outer(trial))
                if moved is not None and np.all(np.isfinite(moved)):
                    slopes.append((moved - residual[part]) / difference)
                if len(slopes) == sides:
                    break
            if slopes:
                columns[part, i] = min(slopes, key=_sum_of_squares)

        if self.threads == 1:
            for i in range(len(x)):
                fill(i)
        else:
            # The simulations are machine code, which releases the interpreter's lock.
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(fill, range(len(x))))
        return columns


class Together(NamedTuple):
    """A residual that is had at many points for little more than at one.

    Attributes:
        residuals_of: Residuals (m, t) at parameters (t, k).
    """

    residuals_of: Callable[[Array], Array]

    def residual_of(self, values: Array) -> Array | None:
        """Residual (m,) at parameters (k,), or None where it is not finite."""
        residual = self.residuals_of(values[np.newaxis])[:, 0]
        return residual if np.all(np.isfinite(residual)) else None

    def jacobian(self, x: Array, residual: Array, space: Space, sides: int) -> Array:
        """Derivatives (m, k) at search variables, by differences of the side that has room."""
        del sides
        sizes = _DIFFERENCE * np.where(space.logarithmic, 1.0, np.maximum(1.0, np.abs(x)))
        values = space.outer(x + np.diag(sizes))
        moves = np.diag(space.inner(values)) - x
        narrow = np.abs(moves) < 0.5 * sizes
        values[narrow] = space.outer(x - np.diag(sizes))[narrow]
        moves = np.diag(space.inner(values)) - x
        columns = np.zeros((len(residual), len(x)))
        free = np.abs(moves) >= 0.5 * sizes
        columns[:, free] = (self.residuals_of(values[free]) - residual[:, np.newaxis]) / moves[free]
        columns[:, ~np.all(np.isfinite(columns), axis=0)] = 0.0
        return columns


class Exact(NamedTuple):
    """A residual with its exact derivatives by parameters.

    Where a simulation that switches parts from its neighbours within a few steps, its derivative is
    without bound, or without value, and says nothing of them: there differences stand for it.

    Attributes:
        derivative_of: Its derivative (m, k) by them, where there is one.
        differences: The residual, with differences.
    """

    derivative_of: ResidualOf
    differences: Differences

    @property
    def residual_of(self) -> ResidualOf:
        """Residual as a function of parameters, or None where there is none."""
        return self.differences.residual_of

    def jacobian(self, x: Array, residual: Array, space: Space, sides: int) -> Array:
        """Derivatives (m, k) at search variables; `sides` is that of differences."""
        values = space.outer(x)
        columns = self.derivative_of(values)
        if columns is None:
            return self.differences.jacobian(x, residual, space, sides)
        units = np.where(space.logarithmic, values, space.scale)
        with np.errstate(over="ignore", invalid="ignore"):
            columns = columns * np.where(space.low < space.high, units, 0.0)
            moves = _DIFFERENCE * np.linalg.norm(columns, axis=0)
            parted = ~(moves <= _PARTED * np.linalg.norm(residual))
        if np.any(parted):
            columns[:, parted] = self.differences.jacobian(x, residual, space, sides)[:, parted]
        return columns


def solve(
    function: Exact | Differences | Together,
    start: Array,
    space: Space,
    effort: Effort,
    prior: Prior | None = None,
) -> Solution | None:
    """Least squares from first parameters (k,); None if there is no residual there."""
    x = space.inner(start)
    r = function.residual_of(space.outer(x))
    if r is None or not np.isfinite(_sum_of_squares(r)):
        return None
    known, damping = prior or Prior(np.zeros_like(x), np.zeros_like(x)), _FIRST_DAMPING
    level = known.level(r)
    jacobian, fresh = function.jacobian(x, r, space, 1), True
    for _ in range(effort.steps):
        point = _Point(x, r, known.centre, level * known.weight**2)
        accepted = _lower_cost(function.residual_of, point, space, (jacobian, fresh), damping)
        if accepted is None:
            if fresh:
                break
            jacobian, fresh = function.jacobian(x, r, space, 1), True
            continue
        after, damping = accepted
        change, move = after.residual - r, after.x - x
        error = change - jacobian @ move
        small = point.cost - after.cost < effort.gain * point.cost
        x, r = after.x, after.residual
        # A residual that has fallen gives less weight to the prior: there may be more to gain.
        lower = min(level, known.level(r))
        small, level = small and lower > _SETTLED * level, lower
        if small and fresh:
            break
        if not small and error @ error < _TRUE * (change @ change):
            # The Jacobian is nearly true: Broyden's update costs no simulation.
            jacobian, fresh = jacobian + np.outer(error, move) / float(move @ move), False
        else:
            jacobian, fresh = function.jacobian(x, r, space, 1), True
    if effort.sides > 1 or not fresh:
        jacobian = function.jacobian(x, r, space, effort.sides)
    return Solution(space.outer(x), r, jacobian, _sum_of_squares(r), level, level * known.weight**2)


class _Point(NamedTuple):
    """A point of a search: variables, residual, and the prior with its precision there."""

    x: Array
    residual: Array
    centre: Array
    precision: Array

    @property
    def cost(self) -> float:
        """Sum of squares, the prior's included."""
        offset = self.x - self.centre
        return _sum_of_squares(self.residual) + float(offset @ (self.precision * offset))


def _sum_of_squares(residual: Array) -> float:
    """Infinite where it overflows: a model that runs away has no lower cost than any other."""
    with np.errstate(over="ignore"):
        return float(residual @ residual)


def _lower_cost(
    residual_of: ResidualOf,
    point: _Point,
    space: Space,
    tangent: tuple[Array, bool],
    damping: float,
) -> tuple[_Point, float] | None:
    """A step with as little damping as lowers the cost, and the damping to begin the next with.

    With a Jacobian (of `tangent`) that was not taken here, a single damping is tried.
    """
    jacobian, fresh = tangent
    with np.errstate(over="ignore", invalid="ignore"):  # No step is taken from what overflows.
        products = jacobian.T @ jacobian + np.diag(point.precision)
        gradient = jacobian.T @ point.residual + point.precision * (point.x - point.centre)
    diagonal = np.maximum(np.diag(products), 1e-300)
    largest = np.where(space.logarithmic, _LARGEST_LOGARITHMIC_STEP, np.inf)
    free = ~_at_active_bound(point.x, gradient, space)
    while damping < _LARGEST_DAMPING:
        step = _step(products, gradient, diagonal * damping, free)
        if step is None:
            return None
        trial = space.inner(space.outer(point.x + np.clip(step, -largest, largest)))
        residual = residual_of(space.outer(trial))
        if residual is not None:
            after = point._replace(x=trial, residual=residual)
            if after.cost < point.cost:
                return after, max(damping * 0.1, 1e-12)
        if not fresh:
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


def _at_active_bound(x: Array, gradient: Array, space: Space) -> NDArray[np.bool_]:
    """Which variables are at a bound that the step would leave, shape (k,)."""
    values = space.outer(x)
    return ((values <= space.low) & (gradient > 0.0)) | ((values >= space.high) & (gradient < 0.0))
