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
from os import cpu_count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.numerics.compiled import law
from rig.diagnosis.problem.contract import (
    Candidate,
    Parts,
    Placed,
    Problem,
    Track,
    strut_constants,
)
from rig.diagnosis.problem.track import law_force
from rig.diagnosis.search.fit import Fit, law_values, parts_for, residual
from rig.diagnosis.search.screen import goes_with, proposed, starts

Array = NDArray[np.float64]

_SMALL = 0.02
"""Force of a law that is tried, as a share of what the linear part leaves over."""
_TINY = 1e-100
"""Stands for nothing in a quotient."""


class Change(NamedTuple):
    """A law that may be added to a model, or stand for one that degenerates to it.

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
    """Fitted models with one law more, or a more general one, each at its best start, best first.

    Args:
        problem: Model and recordings.
        result: The model.
        motions: The motion of recordings, by their index.
    """
    constants = strut_constants(problem, result.parts.linear)
    tracks, laws = tuple(track for _, track in motions), law_values(problem, result)
    base = _Base(problem, result, tracks, laws, constants, *_without_fitted(result))
    jobs = [*_additions(base), *_generalisations(base)]
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


def _generalisations(base: _Base) -> list[_Job]:
    found: list[_Job] = []
    for simple, values in base.laws.items():
        known = dict(zip((p.name for p in effect(simple[1]).parameters), values, strict=True))
        others = base.fit.candidate.without(simple).new
        for at in proposed(base.problem):
            is_general = at[0] == simple[0] and simple[1] in effect(at[1]).simpler
            if is_general and goes_with(at, others):
                found += [_Job(at, start, simple) for start in starts(base.problem, at, known)]
    return found


def _tried(base: _Base, job: _Job) -> Change | None:
    item, forces = effect(job.law[1]), _forces(base, job.law, job.start)
    power = float(forces @ forces)
    if not np.isfinite(power) or power <= 0.0:
        return None
    values, scaled = job.start.copy(), list(item.scaled)
    candidate, share = base.fit.candidate, 1.0
    if job.stands_for is not None:
        candidate = candidate.without(job.stands_for)
        replaced = _forces(base, job.stands_for, base.laws[job.stands_for])
        values[scaled] *= float(forces @ replaced) / power
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
