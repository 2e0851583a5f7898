"""Laws beside a fitted model, each simulated at a small size.

Where a strut sticks, a law along the smoothed motion errs by more than what is missing; the model's
own answer to a little of a law does not. How much of the residual this answer could explain, with
all that was fitted free beside it, is the statistic of a score test.

References:
    Rao, Large sample tests of statistical hypotheses concerning several parameters, Math. Proc.
    Cambridge Philos. Soc. 44 (1948).
    Engle, Wald, likelihood ratio, and Lagrange multiplier tests in econometrics, Handbook of
    Econometrics 2 (1984).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from os import cpu_count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.numerics.compiled import law
from rig.diagnosis.numerics.least_squares import solve
from rig.diagnosis.problem.contract import (
    Candidate,
    Parts,
    Placed,
    Problem,
    Track,
    strut_constants,
)
from rig.diagnosis.problem.track import law_force
from rig.diagnosis.search.fit import Fit, law_space, law_values, parts_for, residual
from rig.diagnosis.search.screen import goes_with, proposed, starts

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


class _Job(NamedTuple):
    """A law at a start; where it stands for another one, with what it stands for."""

    law: Placed
    start: Array
    stands_for: Placed | None = None


class _Base(NamedTuple):
    """A fitted model, as all that is tried beside it needs it."""

    problem: Problem
    fit: Fit
    tracks: tuple[Track, ...]
    laws: dict[Placed, Array]
    constants: Array
    basis: Array
    left: Array


def changes(
    problem: Problem, result: Fit, motions: Sequence[tuple[int, Track]]
) -> tuple[Change, ...]:
    """Fitted models with one law more, or a like one for one of theirs, at its best start.

    Args:
        problem: Model and recordings.
        result: The model.
        motions: The motion of recordings, by their index.

    Returns:
        The changes, best first.
    """
    constants = strut_constants(problem, result.parts.linear)
    tracks, laws = tuple(track for _, track in motions), law_values(problem, result)
    base = _Base(problem, result, tracks, laws, constants, *_without_fitted(result))
    jobs = [*_additions(base), *_likenesses(base)]
    for job in jobs:
        law(job.law[1])  # Compiled here: numba's compiler is no place for two threads.
    with ThreadPoolExecutor(cpu_count()) as pool:
        found = [one for one in pool.map(lambda job: _tried(base, job), jobs) if one is not None]
    best: dict[Candidate, Change] = {}
    for change in sorted(found, key=lambda change: change.left):
        best.setdefault(change.candidate, change)
    return tuple(best.values())


def _without_fitted(result: Fit) -> tuple[Array, Array]:
    """An orthonormal basis of what the fitted variables can do, and the residual without it."""
    jacobian, prior = result.solution.jacobian, result.solution.prior
    whole = np.vstack([jacobian, np.diag(np.sqrt(prior))])
    size = np.linalg.norm(whole, axis=0)
    basis = np.linalg.qr(whole[:, size > 0.0] / size[size > 0.0])[0][: len(jacobian)]
    return basis, result.residual - basis @ (basis.T @ result.residual)


def _additions(base: _Base) -> list[_Job]:
    laws = [at for at in proposed(base.problem) if goes_with(at, base.fit.candidate.new)]
    return [_Job(at, start) for at in laws for start in starts(base.problem, at, {})]


def _likenesses(base: _Base) -> list[_Job]:
    """For each law of the model those of its family, and those that degenerate to it."""
    found: list[_Job] = []
    for old in base.laws:
        others = base.fit.candidate.without(old).new
        for at in proposed(base.problem):
            item = effect(at[1])
            is_alike = item.family == effect(old[1]).family or old[1] in item.simpler
            if at[0] == old[0] and at != old and is_alike and goes_with(at, others):
                found += [_Job(at, values, old) for values in _matched(base, at, old)]
    return found


def _matched(base: _Base, at: Placed, old: Placed) -> list[Array]:
    """Parameters with which a law's force is nearest to another one's, but for a linear force."""
    strut, item = at[0], effect(at[1])
    linear = [
        np.concatenate([rows(track)[strut] for track in base.tracks])
        for rows in (attrgetter("heights_m"), attrgetter("velocities_m_per_s"))
    ]
    basis = np.linalg.qr(np.column_stack([np.ones_like(linear[0]), *linear]))[0]
    whole = _forces(base, old, base.laws[old])
    goal = whole - basis @ (basis.T @ whole)
    unit = max(float(np.linalg.norm(goal)), _TINY)

    def missed(values: Array) -> Array:
        force = _forces(base, at, values)
        return (goal - force + basis @ (basis.T @ force)) / unit

    known = dict(zip((p.name for p in effect(old[1]).parameters), base.laws[old], strict=True))
    begins: list[tuple[float, Array]] = []
    for start in starts(base.problem, at, known):
        force = goal / unit - missed(start)
        size = float(force @ goal) / unit / max(float(force @ force), _TINY)
        values = start.copy()
        values[list(item.scaled)] *= size
        left = missed(values)
        begins.append((float(left @ left), values))
    if not begins:
        return []
    first = min(begins, key=lambda begin: begin[0])[1]
    found = solve(missed, first, law_space(at[1], base.problem.motions[strut], first), _STEPS)
    return [] if found is None else [found.values]


def _tried(base: _Base, job: _Job) -> Change | None:
    item, forces = effect(job.law[1]), _forces(base, job.law, job.start)
    power = float(forces @ forces)
    if not np.isfinite(power) or power <= 0.0:
        return None
    values, scaled = job.start.copy(), list(item.scaled)
    candidate, share = base.fit.candidate, 1.0
    if job.stands_for is not None:
        candidate = candidate.without(job.stands_for)
    elif scaled:
        force_n = base.problem.motions[job.law[0]].force_n
        share = _SMALL * force_n / np.sqrt(power / len(forces))
        values[scaled] *= share
    candidate = candidate.added(job.law)
    parts = parts_for(base.problem, base.fit, candidate, {job.law: values})
    there = residual(base.problem, candidate, parts)
    if there is None:
        return None
    column = (base.fit.residual - there) / share
    column = column - base.basis @ (base.basis.T @ column)
    size = float(column @ base.left) / max(float(column @ column), _TINY)
    if scaled and job.stands_for is None:
        values[scaled] = size * job.start[scaled]
    else:
        size = float(np.clip(size, 0.0, 1.0))  # On the way to it, or it.
    if any(not item.parameters[i].low <= values[i] <= item.parameters[i].high for i in scaled):
        return None
    rest = base.left - size * column
    parts = parts_for(base.problem, base.fit, candidate, {job.law: values})
    return Change(candidate, parts, float(rest @ rest))


def _forces(base: _Base, at: Placed, values: Array) -> Array:
    return np.concatenate([law_force(track, *at, values, base.constants) for track in base.tracks])
