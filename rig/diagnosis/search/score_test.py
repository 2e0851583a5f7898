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
from rig.diagnosis.problem.linear_part import strut_force
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
    linear_bounds,
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
_RANK = 1e-6
"""Least singular value, as a share of the largest one, of a linear force that is distinguished from
others."""
_UNLIKE = 2.0
"""Times the sum of squares of a model from which on another formula is not fitted that begins with
it, where it is most alike: one that is right differs from that of the model by what this leaves. Of
201 such fits on sixteen benches, those that came near the best model, to 1.3 times its sum of
squares, began within 1.5 times of it, and those that were better within 1.2 times."""
_NEAR = 3.0
"""The same ratio of the simulation where it begins, up to which it is fitted without a promise."""
_PROMISING = 0.97
"""Share of a model's sum of squares below which another formula promises to be better. Those that
neither began so near nor promised so much took two thirds of the time of these fits; one of 155 was
better, two stops at the same end of the stroke."""


class ModelChange(NamedTuple):
    """A model with one law added, or with a similar law for one of its laws.

    Attributes:
        model: The changed model, where a fit of it may begin.
        cost: Sum of squares that it would reach, by linearisation about the fitted model.
        begin: The same where its fit would begin: of an exchange all of it, up to which `cost` is a
            share of the way.
        unchanged: The same of the fitted model itself, but for `missed`.
        missed: How many times as much the fitted model has, by which `cost` and `begin` are
            multiplied.
    """

    model: CandidateModel
    cost: float
    begin: float
    unchanged: float = np.inf
    missed: float = 1.0

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
        force_n: The law's force along the motion, shape (N,).
        bent_n: That without its projection on the linear forces.
    """

    law: StrutEffect
    values: Array
    linear: Array
    force_n: Array
    bent_n: Array


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
    problem, fitted = base.problem, base.fit.model
    parts = [problem.law_responses(k, fitted, laws) for k in range(problem.recordings)]
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
            model = model_for(base.problem, base.fit.model, candidate, {at: values})
            tested.append(_change(base, model, size * column))
    return tested


def _test_addition(base: _Base, at: StrutEffect, start: Array) -> ModelChange | None:
    """Addition of a law without a size, by the response to all of it."""
    candidate = base.fit.candidate.with_effects(at)
    model = model_for(base.problem, base.fit.model, candidate, {at: start})
    response = _response(base, model)
    if response is None:
        return None
    column, _ = response
    size = float(np.clip(_best_size(base, column), 0.0, 1.0))
    return _change(base, model, size * column)


def _remove_law_force(base: _Base, at: StrutEffect) -> _ReplacedLaw:
    values = law_values(base.problem, base.fit)[at]
    linear, force_n = linear_forces(base.tracks, at[0]), _forces(base, at, values)
    return _ReplacedLaw(at, values, linear, force_n, force_n - linear @ (linear.T @ force_n))


def _test_exchange(base: _Base, at: StrutEffect, old: _ReplacedLaw) -> ModelChange | None:
    """Exchange of a law for another, from where this is most alike.

    None if it is not alike, or promises nothing and does not begin near the model either: a law
    that is more general than the replaced one is that one where it is most alike, and shows nothing
    of what it may gain.
    """
    values = _match_force(base, at, old)
    if values is None:
        return None
    model = _replace_law(base, at, values, old)
    response = _response(base, model)
    if response is None:
        return None
    column, ratio = response
    # A share of the way from the old law to this one.
    size = float(np.clip(_best_size(base, column), 0.0, 1.0))
    change, whole = _change(base, model, size * column), _change(base, model, column)
    reached = change.missed * change.unchanged
    promises = change.cost < _PROMISING * reached
    if whole.cost > _UNLIKE * reached or not (promises or ratio <= _NEAR):
        return None
    return change._replace(begin=whole.cost)


def _match_force(base: _Base, at: StrutEffect, old: _ReplacedLaw) -> Array | None:
    """Parameters with which a law's force is nearest to another's, up to a linear force.

    None where there is no force.
    """
    scaled, unit = list(effect(at[1]).scaled), float(np.linalg.norm(old.bent_n))
    if unit <= 0.0:
        return None

    def shape(values: Array) -> Array:
        force_n = _forces(base, at, values)
        return (force_n - old.linear @ (old.linear.T @ force_n)) / unit

    def mismatch(values: Array) -> Array:
        return old.bent_n / unit - shape(values)

    begins: list[tuple[float, Array]] = []
    known = effect(old.law[1]).named(old.values.tolist())
    for start in law_starts(base.problem, at, known):
        force, values = shape(start), start.copy()
        values[scaled] *= float(force @ old.bent_n) / unit / max(float(force @ force), _TINY)
        residual = mismatch(values)
        begins.append((float(residual @ residual), values))
    if not begins:
        return None
    first = min(begins, key=lambda begin: begin[0])[1]
    space = law_space(at[1], base.problem.motions[at[0]], first)
    solution = solve(Differences(mismatch), first, space, _MATCHING)
    return np.clip(first, space.low, space.high) if solution is None else solution.values


def _replace_law(base: _Base, at: StrutEffect, values: Array, old: _ReplacedLaw) -> CandidateModel:
    """A model with another law in place of one, and with the linear force that these differ by."""
    problem, fitted = base.problem, base.fit.model
    candidate = fitted.candidate.without(old.law).with_effects(at)
    model = model_for(problem, fitted, candidate, {at: values})
    forces_n = _linear_part_forces(base, at[0])
    size = np.linalg.norm(forces_n, axis=0)
    acting = size > 0.0
    lacking_n = old.force_n - _forces(base, at, values)
    columns = forces_n[:, acting] / size[acting]
    changes = np.zeros(len(size))
    changes[acting] = np.linalg.lstsq(columns, lacking_n, rcond=_RANK)[0] / size[acting]
    low, high = np.array([linear_bounds(p, candidate) for p in problem.linear]).reshape(-1, 2).T
    return model.with_linear(np.clip(fitted.parts.linear + changes, low, high))


def _linear_part_forces(base: _Base, strut: int) -> Array:
    """Force of a strut by each linear parameter along the motion, shape (N, L).

    Zero by those that are not fitted, are of another strut, or are no force of a strut.
    """
    heights_m = np.concatenate([track.heights_m[strut] for track in base.tracks])
    velocities = np.concatenate([track.velocities_m_per_s[strut] for track in base.tracks])
    forces_n = np.zeros((len(heights_m), len(base.problem.linear)))
    for i, parameter in enumerate(base.problem.linear):
        if parameter.strut == strut and base.fit.free[i]:
            motion = base.problem.motions[strut]
            forces_n[:, i] = strut_force(parameter.kind, heights_m, velocities, motion)
    return forces_n


def _response(base: _Base, model: CandidateModel) -> tuple[Array, float] | None:
    """Decrease of the residual by a changed model, fitted variables projected out, shape (m,).

    With how many times the fitted model's sum of squares it has in simulation. None where the model
    runs away.
    """
    # Both in the same steps: the change is small, and what steps change is not.
    problem, before = base.problem, base.fit.residual
    if any(slots_of(problem, laws).states for laws in (model.candidate, base.fit.candidate)):
        problem, before = base.usual
    residual = whiten_residual(problem, model)
    if residual is None:
        return None
    column = before - residual
    ratio = float(residual @ residual) / max(float(before @ before), _TINY)
    return column - base.basis @ (base.basis.T @ column), ratio


def _best_size(base: _Base, column: Array) -> float:
    return float(column @ base.residual) / max(float(column @ column), _TINY)


def _change(base: _Base, model: CandidateModel, explained: Array) -> ModelChange:
    rest, unchanged = base.residual - explained, float(base.residual @ base.residual)
    missed = max(1.0, base.fit.solution.cost / max(unchanged, _TINY))
    cost = missed * float(rest @ rest)
    return ModelChange(model, cost, cost, unchanged, missed)


def _forces(base: _Base, at: StrutEffect, values: Array) -> Array:
    return np.concatenate([law_force(track, *at, values, base.constants) for track in base.tracks])
