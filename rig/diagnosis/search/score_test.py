"""Laws beside a fitted model, or for one of its own, each simulated once.

Where a strut sticks, a law along the smoothed motion errs by more than what is missing; the model's
own answer to a little of a law does not. How much of the residual this answer could explain, with
all that was fitted free beside it, is the statistic of a score test.

References:
    Rao, Large sample tests of statistical hypotheses concerning several parameters, Math. Proc.
    Cambridge Philos. Soc. 44 (1948).
    Engle, Wald, likelihood ratio, and Lagrange multiplier tests in econometrics, Handbook of
    Econometrics 2 (1984).
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.numerics.compiled import compile_law
from rig.diagnosis.numerics.least_squares import solve
from rig.diagnosis.problem.problem import (
    Candidate,
    Parts,
    Placed,
    Problem,
    Track,
    strut_constants,
)
from rig.diagnosis.problem.track import law_force, linear_forces
from rig.diagnosis.search.fit import Fit, law_space, law_values, parts_for, residual
from rig.diagnosis.search.screen import goes_with, proposed, sized, starts

Array = NDArray[np.float64]

_SMALL = 0.02
"""Force of a law that is tried, as a share of what the linear part leaves over."""
_STEPS = 10
"""Steps by which a law is brought near to another one's force."""
_TINY = 1e-100
"""Stands for nothing in a quotient."""


class Change(NamedTuple):
    """A law that may be added to a model, or stand for a like one.

    Attributes:
        candidate: The changed model.
        parts: Where a fit of it may begin.
        left: Sum of squares that it would leave, as far as the model's tangent says.
    """

    candidate: Candidate
    parts: Parts
    left: float

    @property
    def laws(self) -> tuple[Placed, ...]:
        """The laws that the nominal model lacks."""
        return self.candidate.new


class _Base(NamedTuple):
    """A fitted model, as all that is tried beside it needs it.

    Attributes:
        problem: Model and recordings.
        fit: The fitted model.
        tracks: The motion of recordings.
        constants: The struts' constants as fitted.
        basis: Orthonormal, of what the fitted variables can do, shape (m, k).
        left: The residual without that, shape (m,).
    """

    problem: Problem
    fit: Fit
    tracks: tuple[Track, ...]
    constants: Array
    basis: Array
    left: Array


class _Old(NamedTuple):
    """A law of a model that others may stand for.

    Attributes:
        law: The law.
        values: Its parameters.
        linear: Orthonormal, of what is left to the linear part, shape (N, 3).
        force_n: The law's force along the motion without that, shape (N,).
    """

    law: Placed
    values: Array
    linear: Array
    force_n: Array


def changes(
    problem: Problem, result: Fit, motions: Sequence[tuple[int, Track]], most_laws: int
) -> tuple[Change, ...]:
    """Fitted models with one law more, or a like one for one of theirs, at its best start.

    Args:
        problem: Model and recordings.
        result: The model.
        motions: The motion of recordings, by their index.
        most_laws: Laws that a model may hold.

    Returns:
        The changes, best first.
    """
    constants = strut_constants(problem, result.parts.linear)
    tracks = tuple(track for _, track in motions)
    base = _Base(problem, result, tracks, constants, *_without_fitted(result))
    laws = result.candidate.new
    added = _additions(base) if len(laws) < most_laws else []
    like = list(_likenesses(base))
    for _, name in [*laws, *(at for at, _ in (*added, *like))]:
        compile_law(name)  # here: numba's compiler admits no two threads
    olds = {at: _old(base, at) for at in laws}
    with ThreadPoolExecutor(cpu_count()) as pool:
        tried = [
            *pool.map(lambda job: _with_addition(base, *job), added),
            *pool.map(lambda job: _with_likeness(base, job[0], olds[job[1]]), like),
        ]
    best: dict[Candidate, Change] = {}
    for change in sorted((one for one in tried if one is not None), key=lambda one: one.left):
        best.setdefault(change.candidate, change)
    return tuple(best.values())


def _without_fitted(result: Fit) -> tuple[Array, Array]:
    """An orthonormal basis of what the fitted variables can do, and the residual without it."""
    jacobian, prior = result.solution.jacobian, result.solution.prior
    whole = np.vstack([jacobian, np.diag(np.sqrt(prior))])
    size = np.linalg.norm(whole, axis=0)
    basis = np.linalg.qr(whole[:, size > 0.0] / size[size > 0.0])[0][: len(jacobian)]
    return basis, result.residual - basis @ (basis.T @ result.residual)


def _additions(base: _Base) -> list[tuple[Placed, Array]]:
    laws = [at for at in proposed(base.problem) if goes_with(at, base.fit.candidate.new)]
    return [(at, start) for at in laws for start in starts(base.problem, at, {})]


def _likenesses(base: _Base) -> Iterator[tuple[Placed, Placed]]:
    """Laws of the family of one of the model's, or that degenerate to it; with that one."""
    for old in base.fit.candidate.new:
        others = base.fit.candidate.without(old).new
        for at in proposed(base.problem):
            item = effect(at[1])
            is_alike = item.family == effect(old[1]).family or old[1] in item.simpler
            if at[0] == old[0] and at != old and is_alike and goes_with(at, others):
                yield at, old


def _with_addition(base: _Base, at: Placed, start: Array) -> Change | None:
    item, share, few = effect(at[1]), 1.0, start.copy()
    if item.scaled:
        mean_square = float(np.mean(_forces(base, at, start) ** 2))
        if not 0.0 < mean_square < np.inf:
            return None
        share = _SMALL * base.problem.motions[at[0]].force_n / np.sqrt(mean_square)
        few[list(item.scaled)] *= share
    candidate = base.fit.candidate.added(at)
    column = _answer(base, candidate, at, few)
    if column is None:
        return None
    column = column / share
    size = _best_size(base, column)
    if not item.scaled:
        size = float(np.clip(size, 0.0, 1.0))
    values = sized(at[1], start, size)
    return None if values is None else _change(base, candidate, at, values, size * column)


def _old(base: _Base, at: Placed) -> _Old:
    values = law_values(base.problem, base.fit)[at]
    linear, force_n = linear_forces(base.tracks, at[0]), _forces(base, at, values)
    return _Old(at, values, linear, force_n - linear @ (linear.T @ force_n))


def _with_likeness(base: _Base, at: Placed, old: _Old) -> Change | None:
    values = _matched(base, at, old)
    if values is None:
        return None
    candidate = base.fit.candidate.without(old.law).added(at)
    column = _answer(base, candidate, at, values)
    if column is None:
        return None
    # On the way from the old law to this one.
    size = float(np.clip(_best_size(base, column), 0.0, 1.0))
    return _change(base, candidate, at, values, size * column)


def _matched(base: _Base, at: Placed, old: _Old) -> Array | None:
    """Parameters with which a law's force is nearest to another one's, but for a linear force."""
    scaled, unit = list(effect(at[1]).scaled), float(np.linalg.norm(old.force_n))
    if unit <= 0.0:
        return None

    def shape(values: Array) -> Array:
        force_n = _forces(base, at, values)
        return (force_n - old.linear @ (old.linear.T @ force_n)) / unit

    def missed(values: Array) -> Array:
        return old.force_n / unit - shape(values)

    begins: list[tuple[float, Array]] = []
    known = effect(old.law[1]).named(old.values.tolist())
    for start in starts(base.problem, at, known):
        force, values = shape(start), start.copy()
        values[scaled] *= float(force @ old.force_n) / unit / max(float(force @ force), _TINY)
        left = missed(values)
        begins.append((float(left @ left), values))
    if not begins:
        return None
    first = min(begins, key=lambda begin: begin[0])[1]
    space = law_space(at[1], base.problem.motions[at[0]], first)
    found = solve(missed, first, space, _STEPS)
    return None if found is None else found.values


def _answer(base: _Base, candidate: Candidate, at: Placed, values: Array) -> Array | None:
    """What a changed model takes off the residual beyond what was fitted; None if it runs away."""
    parts = parts_for(base.problem, base.fit, candidate, {at: values})
    there = residual(base.problem, candidate, parts)
    if there is None:
        return None
    column = base.fit.residual - there
    return column - base.basis @ (base.basis.T @ column)


def _best_size(base: _Base, column: Array) -> float:
    return float(column @ base.left) / max(float(column @ column), _TINY)


def _change(
    base: _Base, candidate: Candidate, at: Placed, values: Array, taken_off: Array
) -> Change:
    rest = base.left - taken_off
    parts = parts_for(base.problem, base.fit, candidate, {at: values})
    return Change(candidate, parts, float(rest @ rest))


def _forces(base: _Base, at: Placed, values: Array) -> Array:
    return np.concatenate([law_force(track, *at, values, base.constants) for track in base.tracks])
