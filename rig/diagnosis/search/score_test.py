"""Score test of laws added to a fitted model, or in exchange for one of its laws.

Where a strut sticks, a law along the smoothed motion errs by more than the missing force; the
derivative of the model's free run by the law's size does not. How much of the residual this
response explains, all fitted variables remaining free, is the statistic of the score test.

References:
    Rao, Large sample tests of statistical hypotheses concerning several parameters, Math. Proc.
    Cambridge Philos. Soc. 44 (1948).
    Engle, Wald, likelihood ratio, and Lagrange multiplier tests in econometrics, Handbook of
    Econometrics 2 (1984).
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from os import cpu_count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.numerics.laws import compile_law
from rig.diagnosis.numerics.least_squares import Differences, Effort, solve
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    Problem,
    StrutEffect,
    slots_of,
    strut_constants,
)
from rig.diagnosis.problem.track import law_force, linear_forces
from rig.diagnosis.search.fit import (
    Fit,
    law_space,
    law_values,
    model_for,
    project_out_fit,
    whiten_residual,
)
from rig.diagnosis.search.screen import candidate_laws, is_compatible, law_starts, scale_law

Array = NDArray[np.float64]

_TOGETHER = 16
"""Laws whose responses march together: with more, they fill memory."""
_MATCHING = Effort(10, sides=1)
"""Fits of a law to another one's force."""
_TINY = 1e-100
"""Least divisor."""
_UNLIKE = 50.0
"""Times the sum of squares of a model from which on another formula is not fitted that begins with
it, where it is most alike: one that is right differs from that of the model by what this leaves. Of
173 such fits on seven benches, those that came near the best model, to four times its sum of
squares, began within 28 times of it; those from 50 times on took half of the time."""


class ModelChange(NamedTuple):
    """A model with one law added, or with a similar law for one of its laws.

    Attributes:
        model: The changed model, where a fit of it may begin.
        cost: Sum of squares that it would reach, by linearisation about the fitted model.
        unchanged: The same of the fitted model itself, which a fit need not have reached.
    """

    model: CandidateModel
    cost: float
    unchanged: float = np.inf

    @property
    def laws(self) -> tuple[StrutEffect, ...]:
        """The laws that the nominal model lacks."""
        return self.model.candidate.new


class _Base(NamedTuple):
    """A fitted model, with what the test of every change of it needs.

    Attributes:
        basis: Orthonormal basis of the responses to the fitted variables, shape (m, k).
        residual: The residual without its projection on the basis, shape (m,).
        usual: The problem in usual steps, in which laws with internal states are simulated, and the
            model's residual there, shape (m,).
    """

    problem: Problem
    fit: Fit
    tracks: tuple[Track, ...]
    constants: Array
    basis: Array
    residual: Array
    usual: tuple[Problem, Array]


class _ReplacedLaw(NamedTuple):
    """A law of a model that others may replace.

    Attributes:
        linear: Orthonormal basis of the strut's linear forces along the motion, shape (N, 3).
        force_n: The law's force along the motion without its projection on that, shape (N,).
    """

    law: StrutEffect
    values: Array
    linear: Array
    force_n: Array


def find_changes(
    problem: Problem, result: Fit, motions: Sequence[tuple[int, Track]], most_laws: int
) -> tuple[ModelChange, ...]:
    """Changes of a fitted model by one law, each at its best start, best first."""
    constants = strut_constants(problem, result.parts.linear)
    tracks = tuple(track for _, track in motions)
    usual = _in_usual_steps(problem, result)
    base = _Base(problem, result, tracks, constants, *project_out_fit(result), usual)
    laws = result.candidate.new
    additions = _additions(base) if len(laws) < most_laws else []
    exchanges = list(_exchanges(base))
    for _, name in [*laws, *(at for at, _ in (*additions, *exchanges))]:
        compile_law(name)  # Compiled here: numba's compiler is not thread-safe.
    replaced = {at: _remove_law_force(base, at) for at in laws}
    sized = [job for job in additions if effect(job[0][1]).scaled]
    whole = [job for job in additions if not effect(job[0][1]).scaled]
    batches = [sized[i : i + _TOGETHER] for i in range(0, len(sized), _TOGETHER)]
    with ThreadPoolExecutor(cpu_count()) as pool:
        tested = [
            *chain.from_iterable(pool.map(lambda jobs: _test_sized(base, jobs), batches)),
            *pool.map(lambda job: _test_addition(base, *job), whole),
            *pool.map(lambda job: _test_exchange(base, job[0], replaced[job[1]]), exchanges),
        ]
    best: dict[Candidate, ModelChange] = {}
    for change in sorted((c for c in tested if c is not None), key=lambda change: change.cost):
        best.setdefault(change.model.candidate, change)
    return tuple(best.values())


def _in_usual_steps(problem: Problem, result: Fit) -> tuple[Problem, Array]:
    usual = problem.in_usual_steps()
    residual = whiten_residual(usual, result.model)
    return usual, result.residual if residual is None else residual


def _additions(base: _Base) -> list[tuple[StrutEffect, Array]]:
    laws = [at for at in candidate_laws(base.problem) if is_compatible(at, base.fit.candidate.new)]
    return [(at, start) for at in laws for start in law_starts(base.problem, at, {})]


def _exchanges(base: _Base) -> Iterator[tuple[StrutEffect, StrutEffect]]:
    """Laws of the family of one of the model's laws, or that degenerate to it; with that law."""
    for old in base.fit.candidate.new:
        others = base.fit.candidate.without(old).new
        for at in candidate_laws(base.problem):
            item = effect(at[1])
            is_alike = item.family == effect(old[1]).family or old[1] in item.simpler
            if at[0] == old[0] and at != old and is_alike and is_compatible(at, others):
                yield at, old


def _test_sized(base: _Base, laws: Sequence[tuple[StrutEffect, Array]]) -> list[ModelChange]:
    """Additions of laws that have a size, by the derivative of the residual by it."""
    problem, model = base.problem, base.fit.model
    parts = [problem.law_responses(k, model, laws) for k in range(problem.recordings)]
    columns = [part for part in parts if part is not None]
    if len(columns) < len(parts):
        return []
    responses = -np.concatenate(columns)
    responses -= base.basis @ (base.basis.T @ responses)
    tested: list[ModelChange] = []
    for (at, start), column in zip(laws, responses.T, strict=True):
        size = _best_size(base, column)
        values = scale_law(at[1], start, size)
        candidate = base.fit.candidate.with_effects(at)
        if values is not None:
            tested.append(_change(base, candidate, at, values, size * column))
    return tested


def _test_addition(base: _Base, at: StrutEffect, start: Array) -> ModelChange | None:
    """Addition of a law without a size, by the response to all of it."""
    candidate = base.fit.candidate.with_effects(at)
    column = _response(base, candidate, at, start)
    if column is None:
        return None
    size = float(np.clip(_best_size(base, column), 0.0, 1.0))
    return _change(base, candidate, at, start, size * column)


def _remove_law_force(base: _Base, at: StrutEffect) -> _ReplacedLaw:
    values = law_values(base.problem, base.fit)[at]
    linear, force_n = linear_forces(base.tracks, at[0]), _forces(base, at, values)
    return _ReplacedLaw(at, values, linear, force_n - linear @ (linear.T @ force_n))


def _test_exchange(base: _Base, at: StrutEffect, old: _ReplacedLaw) -> ModelChange | None:
    """Exchange of a law for another, from where this is most alike; None if it is not alike.

    A law that is more general than the replaced one is that one where it is most alike, and shows
    nothing of what it may gain.
    """
    candidate = base.fit.candidate.without(old.law).with_effects(at)
    begins: list[tuple[float, ModelChange]] = []
    for values in _match_force(base, at, old):
        column = _response(base, candidate, at, values)
        if column is not None:
            # A share of the way from the old law to this one.
            size = float(np.clip(_best_size(base, column), 0.0, 1.0))
            whole = base.residual - column
            change = _change(base, candidate, at, values, size * column)
            begins.append((float(whole @ whole), change))
    if not begins:
        return None
    begin, nearest = min(begins, key=lambda begin: begin[0])
    if begin > _UNLIKE * nearest.unchanged:
        return None
    return nearest._replace(cost=min(change.cost for _, change in begins))


def _match_force(base: _Base, at: StrutEffect, old: _ReplacedLaw) -> list[Array]:
    """Parameters with which a law's force is near another's, up to a linear force.

    Those where it is nearest, and its starts with the nearest size; none where there is no force.
    """
    scaled, unit = list(effect(at[1]).scaled), float(np.linalg.norm(old.force_n))
    if unit <= 0.0:
        return []

    def shape(values: Array) -> Array:
        force_n = _forces(base, at, values)
        return (force_n - old.linear @ (old.linear.T @ force_n)) / unit

    def mismatch(values: Array) -> Array:
        return old.force_n / unit - shape(values)

    begins: list[tuple[float, Array]] = []
    known = effect(old.law[1]).named(old.values.tolist())
    for start in law_starts(base.problem, at, known):
        force, values = shape(start), start.copy()
        values[scaled] *= float(force @ old.force_n) / unit / max(float(force @ force), _TINY)
        residual = mismatch(values)
        begins.append((float(residual @ residual), values))
    if not begins:
        return []
    first = min(begins, key=lambda begin: begin[0])[1]
    space = law_space(at[1], base.problem.motions[at[0]], first)
    solution = solve(Differences(mismatch), first, space, _MATCHING)
    nearest = [] if solution is None else [solution.values]
    return [*nearest, *(np.clip(values, space.low, space.high) for _, values in begins)]


def _response(base: _Base, candidate: Candidate, at: StrutEffect, values: Array) -> Array | None:
    """Decrease of the residual by a changed model, fitted variables projected out, shape (m,).

    None where the model runs away.
    """
    # Both in the same steps: the change is small, and what steps change is not.
    problem, before = base.problem, base.fit.residual
    if any(slots_of(problem, laws).states for laws in (candidate, base.fit.candidate)):
        problem, before = base.usual
    residual = whiten_residual(
        problem, model_for(base.problem, base.fit.model, candidate, {at: values})
    )
    if residual is None:
        return None
    column = before - residual
    return column - base.basis @ (base.basis.T @ column)


def _best_size(base: _Base, column: Array) -> float:
    return float(column @ base.residual) / max(float(column @ column), _TINY)


def _change(
    base: _Base, candidate: Candidate, at: StrutEffect, values: Array, explained: Array
) -> ModelChange:
    rest = base.residual - explained
    model = model_for(base.problem, base.fit.model, candidate, {at: values})
    return ModelChange(model, float(rest @ rest), float(base.residual @ base.residual))


def _forces(base: _Base, at: StrutEffect, values: Array) -> Array:
    return np.concatenate([law_force(track, *at, values, base.constants) for track in base.tracks])
