"""Fit of a model that runs alone: parameters and initial states, from the height it misses.

References:
    Ljung, System Identification (1999), 7.2 and 9.4, output error and its covariance.
    White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982), for
    intervals where what remains is coloured.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.identify.least_squares import Rows, Solution, Space, solve
from rig.identify.reduced import Grid, Model, Planted, Trajectory, run
from rig.identify.starts import Motion, space

Array = NDArray[np.float64]

_BLOCK_S = 1.0
_MEMORY_FITTED = frozenset(
    {"bouc_wen", "dahl", "maxwell", "presliding_friction", "elastoplastic_friction",
     "lugre_friction", "hidden_mass", "delay"}
)  # fmt: skip
_MEMORY_SCALE = {"maxwell": 0.01, "hidden_mass": 0.01, "delay": 0.01}


class Fit(NamedTuple):
    """A fitted model.

    Attributes:
        planted: Its effects.
        values: Parameters of all effects, one after another, shape (k,).
        starts: Start vector of each run.
        trajectories: Motion of each run.
        residuals: Measured less simulated heights, NaN where not measured, (N, struts) each.
        solution: The fit itself, or None if nothing was fitted.
        cost: Sum of squares over the noise variances.
        space: Where it was searched.
        samples: Number of measured heights.
    """

    planted: Planted
    values: Array
    starts: tuple[Array, ...]
    trajectories: tuple[Trajectory, ...]
    residuals: tuple[Array, ...]
    solution: Solution | None
    space: Space | None
    cost: float
    samples: int

    @property
    def mean_square(self) -> float:
        """Mean square of the residual over the noise variance; 1 at the noise floor."""
        return self.cost / max(self.samples, 1)


def _unpack(
    model: Model, what: Planted, grids: Sequence[Grid], x: Array, memory: list[int]
) -> tuple[Array, list[Array]]:
    k = what.parameter_count
    n = model.coordinates
    size = 2 * n + len(memory)
    starts: list[Array] = []
    for i in range(len(grids)):
        part = x[k + i * size : k + (i + 1) * size]
        start = np.zeros(2 * n + what.slots.memory_size)
        start[: 2 * n] = part[: 2 * n]
        start[[2 * n + m for m in memory]] = part[2 * n :]
        starts.append(start)
    return x[:k], starts


def _fitted_memory(what: Planted) -> tuple[list[int], list[float]]:
    index: list[int] = []
    scales: list[float] = []
    for row, (_, name) in enumerate(what.effects):
        if name in _MEMORY_FITTED:
            first, last = what.slots.index[row, 3:5]
            index.extend(range(int(first), int(last)))
            scales.extend([_MEMORY_SCALE.get(name, 1.0)] * int(last - first))
    return index, scales


def fit(
    model: Model,
    what: Planted,
    values: Array,
    starts: Sequence[Array],
    grids: Sequence[Grid],
    noise_m2: Array,
    motions: Sequence[Motion],
    iterations: int = 12,
    fixed: bool = False,
    tolerance: float = 1e-4,
) -> Fit | None:
    """Fit parameters and initial states on the reduced model.

    Args:
        model: The bench.
        what: Its effects.
        values: First parameters, shape (k,).
        starts: First start vectors, one a run, each of shape (2 n + memory,); extra memory is
            taken as zero.
        grids: The runs.
        noise_m2: Noise variance of each height, shape (struts,).
        motions: What each strut did, for the bounds.
        iterations: Most steps.
        fixed: Only the initial states are fitted.
        tolerance: Relative gain below which the fit ends.

    Returns:
        The fit, or None if the model runs away at the start.
    """
    memory, memory_scales = _fitted_memory(what)
    n = model.coordinates
    weights = 1.0 / np.sqrt(noise_m2)
    spaces = [
        space(name, motions[strut], values[slice(*what.slots.index[row, 1:3])])
        for row, (strut, name) in enumerate(what.effects)
    ]
    low = [s.low for s in spaces]
    high = [s.high for s in spaces]
    scale = [s.scale for s in spaces]
    logarithmic = [s.logarithmic for s in spaces]
    x = [values]
    for start in starts:
        full = np.zeros(2 * n + what.slots.memory_size)
        full[: len(start)] = start[: len(full)]
        part = np.concatenate([full[: 2 * n], full[[2 * n + m for m in memory]]])
        size = len(part)
        x.append(part)
        low.append(np.full(size, -np.inf))
        high.append(np.full(size, np.inf))
        scale.append(np.concatenate([np.full(n, 1e-3), np.full(n, 1e-2), np.array(memory_scales)]))
        logarithmic.append(np.zeros(size, dtype=np.bool_))
    whole = Space(
        np.concatenate(low),
        np.concatenate(high),
        np.concatenate(scale),
        np.concatenate(logarithmic),
    )
    first = np.concatenate(x)
    free = np.ones(len(first), dtype=np.bool_)
    if fixed:
        free[: len(values)] = False
    partial = Space(whole.low[free], whole.high[free], whole.scale[free], whole.logarithmic[free])

    search = _Search(model, what, tuple(grids), weights, memory, first, free)
    solution = solve(
        search.residual, first[free], partial, iterations, tolerance, _rows(search, len(values))
    )
    if solution is None or not np.isfinite(solution.cost):
        return None
    p, begin = search.whole(solution.values)
    done = [there for k in range(len(grids)) if (there := search.motion(p, begin, k)) is not None]
    if len(done) < len(grids):
        return None
    residuals = _residuals(grids, done)
    return Fit(
        what, p, tuple(begin), tuple(done), residuals, solution, partial,
        solution.cost, len(solution.residual),
    )  # fmt: skip


class _Search(NamedTuple):
    """What a fit varies, and what it misses then.

    Attributes:
        model: The bench.
        what: Its effects.
        grids: The runs.
        weights: One over the standard deviation of each height, shape (struts,).
        memory: Memory states that are fitted at the start.
        first: Parameters and starts at the beginning, shape (m,).
        free: Which of them are varied, shape (m,).
    """

    model: Model
    what: Planted
    grids: tuple[Grid, ...]
    weights: Array
    memory: list[int]
    first: Array
    free: NDArray[np.bool_]

    def whole(self, trial: Array) -> tuple[Array, list[Array]]:
        """Parameters and starts of a trial."""
        full = self.first.copy()
        full[self.free] = trial
        return _unpack(self.model, self.what, self.grids, full, self.memory)

    def motion(self, p: Array, begin: Sequence[Array], k: int) -> Trajectory | None:
        """Motion of one run, or None if it runs away."""
        return run(self.model, self.what, np.ascontiguousarray(p), self.grids[k], begin[k])

    def missed(self, k: int, trial: Array) -> Array | None:
        """What a trial misses of one run, in standard deviations of the noise, flat."""
        there = self.motion(*self.whole(trial), k)
        if there is None:
            return None
        grid = self.grids[k]
        return ((grid.heights_m - there.heights_m)[grid.measured] * self.weights).ravel()

    def residual(self, trial: Array) -> Array | None:
        """What a trial misses of all runs."""
        parts = [
            part for k in range(len(self.grids)) if (part := self.missed(k, trial)) is not None
        ]
        return np.concatenate(parts) if len(parts) == len(self.grids) else None


def _rows(search: _Search, parameters: int) -> dict[int, Rows]:
    """Of each variable of a run's start, the rows that it moves: those of that run."""
    starts = len(search.first) - parameters
    size = starts // len(search.grids)
    begin = int(search.free.sum()) - starts
    found: dict[int, Rows] = {}
    at = 0
    for k, grid in enumerate(search.grids):
        last = at + int(grid.measured.sum()) * grid.heights_m.shape[1]
        rows = Rows(at, last, functools.partial(search.missed, k))
        found.update(dict.fromkeys(range(begin + k * size, begin + (k + 1) * size), rows))
        at = last
    return found


def _residuals(grids: Sequence[Grid], done: Sequence[Trajectory]) -> tuple[Array, ...]:
    return tuple(
        np.where(grid.measured[:, np.newaxis], grid.heights_m - r.heights_m, np.nan)
        for grid, r in zip(grids, done, strict=True)
    )


def with_solution(model: Model, result: Fit, grids: Sequence[Grid], values: Array) -> Fit | None:
    """A fit of all parameters and starts, moved to other values of its search.

    Args:
        model: The bench.
        result: A fit in which nothing was fixed.
        grids: Its runs.
        values: Parameters and starts in the order of `Fit.solution`.

    Returns:
        The same fit there, with its sensitivities as they were; None if the model runs away.
    """
    assert result.solution is not None
    memory, _ = _fitted_memory(result.planted)
    p, begin = _unpack(model, result.planted, grids, values, memory)
    runs = [
        run(model, result.planted, np.ascontiguousarray(p), grid, start)
        for grid, start in zip(grids, begin, strict=True)
    ]
    done = [r for r in runs if r is not None]
    if len(done) < len(runs):
        return None
    return result._replace(
        values=p,
        starts=tuple(begin),
        trajectories=tuple(done),
        residuals=_residuals(grids, done),
        solution=result.solution._replace(values=values),
    )


def colour(residual: Array) -> float:
    """Share of a residual's mean square that is not white: 1 less von Neumann's ratio over two.

    Args:
        residual: One column, NaN where not measured, shape (N,).

    Reference:
        von Neumann, Ann. Math. Stat. 12 (1941).
    """
    steps = np.diff(residual)
    both = np.isfinite(steps)
    square = float(np.nanmean(residual**2))
    if square <= 0.0 or not np.any(both):
        return 0.0
    return 1.0 - float(np.mean(steps[both] ** 2)) / (2.0 * square)


def numerical_shift(model: Model, result: Fit, grids: Sequence[Grid], noise_m2: Array) -> Array:
    """How far a fit's parameters may be off because of steps and samples, shape (k,).

    Two sources, each by what it changes of the motion: steps half as long, and the error of the
    applied force between its samples. In the units of the search.

    Args:
        model: The bench.
        result: A fit in which nothing was fixed.
        grids: Its runs.
        noise_m2: Noise variance of each height, shape (struts,).
    """
    assert result.solution is not None
    jacobian = result.solution.jacobian
    weights = 1.0 / np.sqrt(noise_m2)
    total = np.zeros(len(result.values))
    for other in ([g.finer() for g in grids], [g.input_moved() for g in grids]):
        changes: list[Array] = []
        for grid, moved, start, there in zip(
            grids, other, result.starts, result.trajectories, strict=True
        ):
            again = run(model, result.planted, result.values, moved, start)
            if again is None:
                return np.full(len(total), np.inf)
            change = (again.heights_m - there.heights_m)[grid.measured] * weights
            changes.append(change.ravel())
        shift = np.linalg.lstsq(jacobian, np.concatenate(changes), rcond=None)[0]
        total += shift[: len(total)] ** 2
    return np.sqrt(total)


def intervals(
    result: Fit, grids: Sequence[Grid], shift: Array | None = None
) -> tuple[Array, Array, Array]:
    """95 % intervals of the parameters.

    The covariance takes what remains as it is: block sums of the score stand for its colour
    (White's sandwich), and the smaller white-noise covariance is a lower limit.

    Args:
        result: A fit in which nothing was fixed.
        grids: Its runs.
        shift: From `numerical_shift`; added as one standard deviation.

    Returns:
        Covariance of the parameters (k, k), and the intervals' ends, each of shape (k,).
    """
    solution, bounds = result.solution, result.space
    assert solution is not None
    assert bounds is not None
    jacobian, residual = solution.jacobian, solution.residual
    gram = jacobian.T @ jacobian
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(size, size), rcond=1e-12) / np.outer(size, size)
    white = inverse * max(1.0, float(residual @ residual) / max(len(residual) - len(size), 1))
    blocks = np.zeros_like(gram)
    first = 0
    count = 0
    for grid in grids:
        samples = int(grid.measured.sum()) * grid.heights_m.shape[1]
        length = max(8, int(_BLOCK_S / grid.step_s) * grid.heights_m.shape[1])
        for at in range(first, first + samples, length):
            part = slice(at, min(at + length, first + samples))
            score = jacobian[part].T @ residual[part]
            blocks += np.outer(score, score)
            count += 1
        first += samples
    robust = inverse @ blocks @ inverse * (count / max(count - len(size), 1))
    k = len(result.values)
    variance = np.maximum(np.diag(white), np.diag(robust))[:k]
    variance = np.maximum(variance, 0.0) + (0.0 if shift is None else shift**2)
    deviation = np.sqrt(variance)
    logarithmic = bounds.logarithmic[:k]
    reach = 2.0 * deviation
    growth = np.exp(np.minimum(reach, 50.0))
    low = np.where(logarithmic, result.values / growth, result.values - reach * bounds.scale[:k])
    high = np.where(logarithmic, result.values * growth, result.values + reach * bounds.scale[:k])
    return robust[:k, :k], np.maximum(low, bounds.low[:k]), np.minimum(high, bounds.high[:k])
