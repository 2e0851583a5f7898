"""Joint fit of effects, linear part and initial states, its covariance and its cross-validation.

References:
    Ljung, System Identification (1999), 9.4, covariance of output-error estimates.
    White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982), for
    intervals where the residual is autocorrelated.
    Rad, Maleki, A scalable estimate of the out-of-sample prediction error via approximate
    leave-one-out, J. R. Stat. Soc. B 82 (2020); here blocks are left out, and a step of Newton's
    method stands for the fit without each.
    Ljung, Box, On a measure of lack of fit in time series models, Biometrika 65 (1978).
"""

import functools
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2
from scipy.stats import t as student

from dart_model.effects import Effect, Motion, effect
from rig.diagnosis.numerics.least_squares import (
    Differences,
    Effort,
    Exact,
    Prior,
    Rows,
    Solution,
    Space,
    concatenate_spaces,
    solve,
)
from rig.diagnosis.problem.channel_delays import SIGNIFICANT, is_undetermined
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    Derivative,
    Integers,
    LinearParameter,
    Parts,
    Problem,
    StrutEffect,
    concatenate_blocks,
    slots_of,
    strut_effects,
)

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_EXISTING_PRIOR = 0.5
"""Prior on the parameters of effects that the nominal model has: half their value, or e^0.5."""
_STATE_PRIOR = 10.0
"""Prior on internal states at the beginning, in units of their scale: wide."""
_TINY = 1e-100
"""Least divisor; its square is still a number."""
_NIL = 1e-2
"""Least scale of a parameter, as a share of the largest one of the same unit."""
USUAL = Effort(15)
"""Fits for which nothing else is given."""
_NEAR = 0.2
"""Share of the range of a delay that is searched without any law: a standard deviation."""
WITH_MEMORY = {"hysteresis", "unmodelled_mode"}
"""Families whose force follows the motion later, as that of a late channel does."""
NO_PREDICTION = 100.0
"""Ratio of the sum of squares that a linearised fit without each block leaves there to that of the
fit, from which on it predicts nothing: with impacts a free run parts from its neighbours, and a
block that is left out moves the parameters by more than their linearisation holds."""
_LAGS = 20
"""Lags of the whiteness test."""


class Fit(NamedTuple):
    """A fitted model.

    Attributes:
        free: Which linear parameters were fitted, shape (L,).
        blocks: Block of each row of data, over all recordings, shape (m,).
        recording: Recording of each row of data, shape (m,).
    """

    model: CandidateModel
    free: Flags
    fits_effects: bool
    solution: Solution
    space: Space
    blocks: Integers
    recording: Integers

    @property
    def candidate(self) -> Candidate:
        """Its effects."""
        return self.model.candidate

    @property
    def parts(self) -> Parts:
        """Its parameters and initial vectors."""
        return self.model.parts

    @property
    def rows(self) -> int:
        """Number of rows of data."""
        return len(self.blocks)

    @property
    def residual(self) -> Array:
        """Whitened residual, shape (m,)."""
        return self.solution.residual

    @property
    def mean_square(self) -> float:
        """Mean square of the whitened residual, 1 at the sensors' noise (`Problem.floor_level`)."""
        return float(np.mean(self.residual**2))


def project_out_fit(result: Fit) -> tuple[Array, Array]:
    """Orthonormal basis (m, k) of responses to the fitted variables; residual (m,) without it."""
    jacobian, prior = result.solution.jacobian, result.solution.prior
    whole = np.vstack([jacobian, np.diag(np.sqrt(prior))])
    size = np.linalg.norm(whole, axis=0)
    basis = np.linalg.qr(whole[:, size > 0.0] / size[size > 0.0])[0][: len(jacobian)]
    return basis, result.residual - basis @ (basis.T @ result.residual)


def whiten_residual(problem: Problem, model: CandidateModel) -> Array | None:
    """Whitened residual of all recordings, shape (m,), or None where the model runs away."""
    residuals: list[Array] = []
    for k in range(problem.recordings):
        residual = problem.residual(k, model)
        if residual is None:
            return None
        residuals.append(residual)
    return np.concatenate(residuals)


def law_space(name: str, motion: Motion, values: Array) -> Space:
    """Bounds and scales of a new effect's parameters, for a search from `values`."""
    item = effect(name)
    narrower = item.bounds(motion)
    low = np.array([max(p.low, narrower.get(p.name, (p.low,))[0]) for p in item.parameters])
    high = np.array([min(p.high, narrower.get(p.name, (0.0, p.high))[1]) for p in item.parameters])
    scale = np.array([_size(item, i, values) for i in range(len(values))])
    for i, parameter in enumerate(item.parameters):
        if parameter.unit == "m":
            scale[i] = motion.stroke_m
        if parameter.unit == "rad":
            scale[i] = 1.0
    return Space(low, np.maximum(high, low), scale, low > 0.0)


def _size(item: Effect, i: int, values: Array) -> float:
    """Scale of a parameter, at least a share of others of its unit: one may be zero."""
    alike = [
        abs(float(value))
        for parameter, value in zip(item.parameters, values, strict=True)
        if parameter.unit == item.parameters[i].unit
    ]
    return max(abs(float(values[i])), _NIL * max(alike), 1e-12)


def _existing_space(name: str, values: Array, free: bool) -> Space:
    """Bounds and scales of an existing effect's parameters; equal bounds where it is not free."""
    parameters = effect(name).parameters
    low = np.array([p.low for p in parameters])
    high = np.array([p.high for p in parameters])
    if not free:
        low, high = values.copy(), values.copy()
    return Space(low, high, np.maximum(np.abs(values), 1e-12), (low > 0.0) & free)


def linear_bounds(parameter: LinearParameter, candidate: Candidate) -> tuple[float, float]:
    """Lowest and highest change of a linear parameter in a fit of a candidate.

    The first estimate of a delay is that of a strut without memory; a law that has one may itself
    be what was taken for the delay. Then any delay is possible that channels have: longer ones
    would do a part of the law's work. Without any law a delay stays near its estimate: it would
    imitate what is missing, and laws would be sought along another motion than the measured one.
    """
    if parameter.kind != "delay" or is_undetermined(parameter):
        return parameter.least, parameter.most
    families = {effect(name).family for _, name in candidate.new}
    if not families.isdisjoint(WITH_MEMORY):
        usual_s = SIGNIFICANT * parameter.deviation
        return min(parameter.least, -usual_s), max(parameter.most, usual_s)
    share = 1.0 if families else _NEAR
    low, middle, high = parameter.least, parameter.expected, parameter.most
    return middle - share * (middle - low), middle + share * (high - middle)


class _Layout:
    """How the search variables of a fit are ordered in a model's parts."""

    def __init__(self, problem: Problem, model: CandidateModel, free: Flags, effects: bool) -> None:
        candidate, first = model
        self.problem, self.candidate, self.first, self.free = problem, candidate, first, free
        linear = problem.linear
        deviation = np.array([p.deviation for p in linear])
        bounds = [linear_bounds(p, candidate) for p in linear]
        spaces = [
            Space(
                np.array([low for low, _ in bounds]),
                np.array([high for _, high in bounds]),
                deviation,
                np.zeros(len(linear), dtype=np.bool_),
            )
        ]
        slots = slots_of(problem, candidate).each
        varied = [free]
        for row, (strut, name) in enumerate(strut_effects(problem, candidate)):
            values = first.effects[slots[row].parameters]
            if row < len(candidate.kept):
                is_free = problem.existing[candidate.kept[row]].free
                spaces.append(_existing_space(name, values, is_free))
                varied.append(np.full(len(values), is_free and effects))
            else:
                spaces.append(law_space(name, problem.motions[strut], values))
                varied.append(np.full(len(values), effects))
        scales, fitted = problem.start_scales(candidate)
        endless = np.full(len(scales), np.inf)
        for _ in first.starts:
            spaces.append(Space(-endless, endless, scales, np.zeros(len(scales), dtype=np.bool_)))
            varied.append(fitted)
        self.whole = concatenate_spaces(spaces)
        self.varied = np.concatenate(varied)
        self.space = self.whole.part(self.varied)
        self.full = np.concatenate([first.linear, first.effects, *first.starts])
        self.start_size = len(scales)
        self.prior = self._prior(len(linear), scales)

    def _prior(self, linear: int, scales: Array) -> Prior:
        weight = np.zeros(len(self.full))
        weight[:linear] = 1.0
        existing = sum(len(self.problem.existing[i].values) for i in self.candidate.kept)
        weight[linear : linear + existing] = 1.0 / _EXISTING_PRIOR
        states = len(scales) - (self.start_size - slots_of(self.problem, self.candidate).states)
        for k in range(len(self.first.starts)):
            last = len(self.full) - (len(self.first.starts) - 1 - k) * self.start_size
            weight[last - states : last] = 1.0 / _STATE_PRIOR
        centre = np.zeros(len(self.full))
        centre[:linear] = [p.expected for p in self.problem.linear]
        values = [v for i in self.candidate.kept for v in self.problem.existing[i].values]
        centre[linear : linear + existing] = values
        inner = self.whole.inner(np.clip(centre, self.whole.low, self.whole.high))
        return Prior(np.where(weight > 0.0, inner, 0.0)[self.varied], weight[self.varied])

    def model(self, x: Array) -> CandidateModel:
        """The model of search variables, shape (k,)."""
        full = self.full.copy()
        full[self.varied] = x
        linear = len(self.first.linear)
        effects = len(self.first.effects)
        starts = full[linear + effects :].reshape(len(self.first.starts), self.start_size)
        parts = Parts(
            full[:linear],
            np.ascontiguousarray(full[linear : linear + effects]),
            tuple(np.ascontiguousarray(row) for row in starts),
        )
        return CandidateModel(self.candidate, parts)

    def residual_of(self, k: int, x: Array) -> Array | None:
        return self.problem.residual(k, self.model(x))

    def residual(self, x: Array) -> Array | None:
        return whiten_residual(self.problem, self.model(x))

    def derivative(self, derivative: Derivative, x: Array) -> Array | None:
        """Derivative of the residual by the search variables' parameters, shape (m, k)."""
        model, problem = self.model(x), self.problem
        shared = len(self.first.linear) + len(self.first.effects)
        slots_of(problem, model.candidate).compile_slopes()  # Here: numba's compiler admits one.

        def own(k: int) -> Array | None:
            first = shared + k * self.start_size
            start = self.varied[first : first + self.start_size]
            return derivative(k, model, np.concatenate([self.varied[:shared], start]))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            parts = [part for part in pool.map(own, range(problem.recordings)) if part is not None]
        if len(parts) < problem.recordings:
            return None
        common = int(self.varied[:shared].sum())
        whole = np.zeros((sum(map(len, parts)), len(x)))
        row, column = 0, common
        for part in parts:
            more = part.shape[1] - common
            whole[row : row + len(part), :common] = part[:, :common]
            whole[row : row + len(part), column : column + more] = part[:, common:]
            row, column = row + len(part), column + more
        return whole

    def rows(self, blocks: list[Integers]) -> dict[int, Rows]:
        """The rows that depend on each variable of an initial vector: those of its recording."""
        if len(blocks) < 2:
            return {}
        rows_by_variable: dict[int, Rows] = {}
        varied = np.flatnonzero(self.varied)
        before = len(self.first.linear) + len(self.first.effects)
        at = 0
        for k, block in enumerate(blocks):
            rows = Rows(at, at + len(block), functools.partial(self.residual_of, k))
            low, high = before + k * self.start_size, before + (k + 1) * self.start_size
            for i in np.flatnonzero((varied >= low) & (varied < high)):
                rows_by_variable[int(i)] = rows
            at += len(block)
        return rows_by_variable


def fit(
    problem: Problem,
    first: CandidateModel,
    free: Flags,
    effort: Effort = USUAL,
    *,
    effects: bool = True,
    most_level: float = np.inf,
) -> Fit | None:
    """Fit a model; None if it runs away where it begins.

    Args:
        problem: Model and recordings.
        first: Where to begin.
        free: Which linear parameters are fitted, shape (L,); the others stay as in `first`.
        effort: How far to go.
        effects: Whether effects' parameters are fitted.
        most_level: Variance of the residual up to which priors gain weight with it. A prior that is
            weighted by the residual where a fit begins would hold it there.
    """
    layout = _Layout(problem, first, free, effects)
    blocks = [problem.blocks(k) for k in range(problem.recordings)]
    differences = Differences(layout.residual, layout.rows(blocks), os.cpu_count() or 1)
    solution = solve(
        differences
        if problem.derivative is None
        else Exact(functools.partial(layout.derivative, problem.derivative), differences),
        layout.full[layout.varied],
        layout.space,
        effort,
        layout.prior._replace(most_level=most_level),
    )
    if solution is None:
        return None
    return Fit(
        layout.model(solution.values),
        free,
        effects,
        solution,
        layout.space,
        concatenate_blocks(blocks),
        np.concatenate([np.full(len(block), k) for k, block in enumerate(blocks)]),
    )


def _scale_columns(jacobian: Array, prior: Array) -> tuple[Array, Array]:
    """A Jacobian (m, k) in columns of unit size, and the priors' precision (k, k) likewise."""
    size = np.sqrt(np.maximum(np.sum(jacobian**2, axis=0) + np.diag(prior), _TINY))
    return jacobian / size, prior / np.outer(size, size)


def _expected_costs(residual: Array, jacobian: Array, blocks: Integers, prior: Array) -> Array:
    """Sum of squares of each block, shape (blocks,), with what a fit is expected to take off it.

    Arguments as of `leave_block_out_costs`. Twice the share of each block in the number of
    parameters, times the mean square (Mallows, Some comments on Cp, Technometrics 15, 1973).
    """
    count = int(blocks.max()) + 1
    scaled, prior = _scale_columns(jacobian, prior)
    inverse = np.linalg.pinv(scaled.T @ scaled + prior, hermitian=True)
    leverage = np.einsum("ij,jk,ik->i", scaled, inverse, scaled, optimize=True)
    squares = residual**2 + 2.0 * float(np.mean(residual**2)) * leverage
    return np.asarray(np.bincount(blocks, squares, count), dtype=np.float64)


def leave_block_out_costs(
    residual: Array, jacobian: Array, blocks: Integers, prior: Array
) -> Array:
    """Sum of squares of each block's residual in a fit to the other blocks, shape (blocks,).

    Residual (m,) and Jacobian (m, k) are those at the solution, the priors' precision is (k, k).
    """
    count = int(blocks.max()) + 1
    scaled, prior = _scale_columns(jacobian, prior)
    grams = np.zeros((count, *prior.shape))
    gradients = np.zeros((count, len(prior)))
    squares = np.bincount(blocks, residual**2, count)
    for b in range(count):
        part = blocks == b
        grams[b] = scaled[part].T @ scaled[part]
        gradients[b] = scaled[part].T @ residual[part]
    whole = grams.sum(axis=0) + prior
    costs = np.empty(count)
    for b in range(count):
        step = np.linalg.lstsq(whole - grams[b], gradients[b], rcond=1e-9)[0]
        costs[b] = squares[b] + 2.0 * step @ gradients[b] + step @ grams[b] @ step
    return costs


def validation_costs(problem: Problem, result: Fit) -> Array:
    """Out-of-sample sum of squares of each block, shape (blocks,).

    Initial states are fixed, since they belong to the block that begins a recording.
    """
    starts = start_variables(problem, result)
    prior = np.diag(result.solution.prior[~starts])
    parts = result.residual, result.solution.jacobian[:, ~starts], result.blocks, prior
    costs, cost = leave_block_out_costs(*parts), result.solution.cost
    # Written so that costs without bound are no prediction either.
    return costs if costs.sum() <= NO_PREDICTION * cost else _expected_costs(*parts)


def start_variables(problem: Problem, result: Fit) -> Flags:
    """Which search variables are those of initial vectors."""
    _, fitted = problem.start_scales(result.candidate)
    count = int(fitted.sum()) * problem.recordings
    flags = np.zeros(result.solution.jacobian.shape[1], dtype=np.bool_)
    flags[len(flags) - count :] = True
    return flags


CLOCK = 5e-5
"""Half-width that an interval has at least, as a share of the value: clocks of sensors and loggers
run right to 50 ppm (a usual crystal), which shifts a mass as a frequency; integration errs less."""
UNBOUND = 30.0
"""Factor, or multiple of a value, from which on a parameter is not identifiable."""


class FitCovariance(NamedTuple):
    """Covariance (k, k) of search variables; half a 95 % interval in deviations (Student's)."""

    covariance: Array
    factor: float

    @property
    def half(self) -> Array:
        """Half-widths of the search variables' intervals, shape (k,)."""
        return self.factor * np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def wider_by(self, covariance: Array) -> "FitCovariance":
        """With a further covariance (k, k) from another source."""
        return self._replace(covariance=self.covariance + covariance)


@np.errstate(over="ignore", invalid="ignore")
def fit_covariance(result: Fit) -> FitCovariance:
    """Covariance of a fit whose residual may be autocorrelated (White's sandwich).

    The covariance under white noise is a lower limit.
    """
    jacobian, residual = result.solution.jacobian, result.solution.residual
    prior = result.solution.prior
    size: Array = np.sqrt(np.maximum(np.sum(jacobian**2, axis=0) + prior, _TINY))
    scaled = jacobian / size
    inverse = np.linalg.pinv(scaled.T @ scaled + np.diag(prior / size**2), rcond=1e-13)
    count = int(result.blocks.max()) + 1
    # The uncertainty of the prior itself.
    meat = np.diag(result.solution.level * prior / size**2)
    for b in range(count):
        part = np.flatnonzero(result.blocks == b)
        score = scaled[part].T @ residual[part]
        meat += np.outer(score, score)
    variables = inverse.shape[0]
    robust = inverse @ meat @ inverse * (count / max(count - min(variables, count // 2), 1))
    white = inverse * max(1.0, result.mean_square)
    # Where the sandwich is the smaller one, it is stretched to the variance of white noise.
    ratio = np.maximum(np.diag(white), 0.0) / np.maximum(np.diag(robust), _TINY)
    stretch = np.sqrt(np.maximum(ratio, 1.0))
    covariance = robust * np.outer(stretch, stretch) / np.outer(size, size)
    return FitCovariance(covariance, float(student.ppf(0.975, max(count - 1, 2))))


def spread_over(problem: Problem, result: Fit, alike: Sequence[Fit]) -> Array:
    """Covariance (k, k) of a fit's search variables over models that are as likely.

    It is taken about the first of them, which has the same parameters; zero where there are none.
    """
    count, slots = int(result.free.sum()), slots_of(problem, result.candidate).each
    size = len(result.solution.values)

    def variables_of(model: Fit) -> Array:
        values = result.solution.values.copy()
        values[:count] = model.parts.linear[result.free]
        for row, variables in effect_variables(problem, result).items():
            values[variables] = model.parts.effects[slots[row].parameters]
        return result.space.inner(values)

    changes = [variables_of(other) - variables_of(alike[0]) for other in alike[1:]]
    return sum((np.outer(c, c) / len(alike) for c in changes), np.zeros((size, size)))


def effect_variables(problem: Problem, result: Fit) -> dict[int, Integers]:
    """Search variables of each fitted effect, by its index among all of the candidate."""
    slots = slots_of(problem, result.candidate).each
    variables: dict[int, Integers] = {}
    at = int(result.free.sum())
    if not result.fits_effects:
        return variables
    for row, slot in enumerate(slots):
        if row < len(result.candidate.kept):
            kept = problem.existing[result.candidate.kept[row]]
            if not kept.free:
                continue
        count = slot.parameters.stop - slot.parameters.start
        variables[row] = np.arange(at, at + count)
        at += count
    return variables


def is_white(problem: Problem, result: Fit, level: float) -> bool:
    """Whether the residual passes the test of Ljung and Box, recording by recording.

    The bound of the test knows the number of samples; the worst recording decides, at a level that
    allows for their number.
    """
    struts = max(1, len(problem.spec.struts))
    for k in range(problem.recordings):
        rows = result.residual[result.recording == k]
        columns = rows.reshape(-1, struts) if len(rows) % struts == 0 else rows[:, np.newaxis]
        for column in columns.T:
            n = len(column)
            lags = min(_LAGS, n // 4)
            centred = column - column.mean()
            power = float(centred @ centred)
            correlations = np.array(
                [float(centred[lag:] @ centred[:-lag]) / power for lag in range(1, lags + 1)]
            )
            statistic = n * (n + 2) * np.sum(correlations**2 / (n - np.arange(1, lags + 1)))
            if float(chi2.sf(statistic, lags)) < level / (problem.recordings * columns.shape[1]):
                return False
    return True


def law_values(problem: Problem, result: Fit) -> dict[StrutEffect, Array]:
    """Parameters of the laws that the nominal model lacks."""
    slots = slots_of(problem, result.candidate).each[len(result.candidate.kept) :]
    return {
        law: result.parts.effects[slot.parameters]
        for law, slot in zip(result.candidate.new, slots, strict=True)
    }


def model_for(
    problem: Problem,
    model: CandidateModel,
    candidate: Candidate,
    further: Mapping[int | StrutEffect, Array] = MappingProxyType({}),
) -> CandidateModel:
    """A model with the effects of another candidate, further laws starting at rest.

    `further` are parameters of laws that the model lacks.
    """
    (before, parts), new = model, slots_of(problem, candidate)
    old = slots_of(problem, before)
    known = dict(zip((*before.kept, *before.new), old.each, strict=True))
    effects: list[Array] = []
    states: list[Array] = [np.zeros((problem.recordings, 0))]
    internal = np.array([start[len(start) - old.states :] for start in parts.starts])
    for key, slot in zip((*candidate.kept, *candidate.new), new.each, strict=True):
        if key in known:
            effects.append(parts.effects[known[key].parameters])
            states.append(internal[:, known[key].states])
        else:
            effects.append(further[key])
            states.append(np.zeros((problem.recordings, slot.states.stop - slot.states.start)))
    motions = (start[: len(start) - old.states] for start in parts.starts)
    starts = (np.append(*both) for both in zip(motions, np.hstack(states), strict=True))
    values = np.concatenate([np.zeros(0), *effects])
    return CandidateModel(candidate, Parts(parts.linear, values, tuple(starts)))
