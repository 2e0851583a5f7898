"""Laws along the measured motion, the linear part projected out.

Every law that the bench can show competes for what a reference leaves over, with the changes of
the linear part (but gain and free length), of existing effects and of initial states free beside
it: they enter linearly and are projected out (Golub, Pereyra, SIAM J. Numer. Anal. 10, 1973). A
law whose force is proportional to its size costs one pass a start; the best are then refined
together with all else in their set.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from rig.diagnosis.numerics.compiled import compile_law
from rig.diagnosis.numerics.least_squares import Prior, Space, joined, solve
from rig.diagnosis.problem.problem import (
    Candidate,
    Integers,
    Parts,
    Placed,
    Problem,
    Segment,
    numbered_on,
    placed,
    slots_of,
    strut_constants,
)
from rig.diagnosis.problem.track import most_thinned, segment_forces
from rig.diagnosis.search.fit import law_space, left_out

Array = NDArray[np.float64]

_MOST_SAMPLES = 12_000
"""Samples of all recordings that the regression along the motion looks at: what a law explains is
known to a part in a hundred with far fewer."""
_COARSE_SAMPLES = 4_000
"""Samples on which starts are compared."""
_EVERY_SAMPLE = 1_000_000_000
"""More than a recording may hold, so that none is left out."""
_REFINED_STARTS = 2
"""Starts of a law that are refined: its best one may lie in a side valley."""
_SIDE_VALLEY = 2.0
"""Times a law's least cost up to which another of its starts is refined."""
_REPEATABLE = ("stop", "nonlinear_damping")
"""Families of which a strut may have two: stops at both ends; a damper's valves."""
_FINE = 5
"""Laws of a round that are refined on all samples: one more than `fitted_a_size`."""
_STEPS = 7
_REMEMBERED = 3
"""Answers of a law that are kept for the next difference."""
_RANK = 1e-10
"""Singular values below this share of the largest are rounding."""
_DIFFERENCE = 1e-4
"""Share of a parameter by which it is moved for a tangent."""


class Stage(NamedTuple):
    """The regression along the motion, as all sets of laws share it.

    Attributes:
        problem: Model and recordings.
        segments: Recordings and parts of them.
        constants: Strut constants of the reference, shape (struts, 5).
        nuisance: Answers to the linear part (its counted parameters first), to existing effects'
            parameters and to initial states, shape (m, c).
        counted: Which linear parameters these are.
        goal: What the reference and its laws leave over, shape (m,).
        basis: Orthonormal columns that span `nuisance`, shape (m, c'): no law may claim them.
        target: `goal` with these taken out, shape (m,).
        blocks: Block of each row, shape (m,).
        coarse: The same of the recordings thinned out, where starts are compared; None in itself.
    """

    problem: Problem
    segments: tuple[Segment, ...]
    constants: Array
    nuisance: Array
    counted: tuple[int, ...]
    goal: Array
    basis: Array
    target: Array
    blocks: Integers
    coarse: "Stage | None"


_Start = tuple[float, Array]
"""Cost of a law at a start, and its parameters there."""


class Screening(NamedTuple):
    """Laws along the motion, refined or (without values) at their best start.

    Attributes:
        laws: The laws, each in its strut.
        values: Parameters of each; where it is taken from the strut's free length, then by how much
            that is another one than the reference's.
        cost: Sum of squares that they leave.
        scores: Out-of-sample sum of squares of each block; the cost where nothing was refined.
    """

    laws: tuple[Placed, ...]
    values: tuple[Array, ...]
    cost: float
    scores: Array

    @property
    def score(self) -> float:
        """Out-of-sample sum of squares."""
        return float(self.scores.sum())


def stage_of(problem: Problem, candidate: Candidate, parts: Parts) -> Stage:
    """The regression about a reference: a candidate that was fitted.

    Raises:
        FloatingPointError: The reference runs away.
    """
    thinned = most_thinned(problem.motions)
    coarse = problem.segments(candidate, parts, _COARSE_SAMPLES, thinned)
    fine = problem.segments(candidate, parts, _MOST_SAMPLES, 1)
    return _stage(problem, candidate, parts, fine, _stage(problem, candidate, parts, coarse, None))


def whole_stage_of(problem: Problem, candidate: Candidate, parts: Parts) -> Stage:
    """The same about every sample: between those of thinned recordings a brief contact is missed.

    Raises:
        FloatingPointError: The reference runs away.
    """
    every = problem.segments(candidate, parts, _EVERY_SAMPLE, 1)
    return _stage(problem, candidate, parts, every, None)


def _stage(
    problem: Problem,
    candidate: Candidate,
    parts: Parts,
    segments: tuple[Segment, ...],
    coarse: Stage | None,
) -> Stage:
    constants = strut_constants(problem, parts.linear)
    slots = slots_of(problem, candidate).each
    target = [segment.target.copy() for segment in segments]
    tangents: list[list[Array]] = [[] for _ in segments]
    for row, (strut, name) in enumerate(placed(problem, candidate)):
        values = parts.effects[slots[row].parameters]
        # The reference's laws acted along its own motion; those of a screening, along the measured.
        forces = segment_forces(segments, strut, name, values, constants, reference=True)
        if row < len(candidate.kept):
            measured = segment_forces(segments, strut, name, values, constants, reference=False)
            forces = [a - b for a, b in zip(forces, measured, strict=True)]
            if problem.existing[candidate.kept[row]].free:
                new = _tangents(segments, strut, name, values, constants, measured)
                tangents = [old + more for old, more in zip(tangents, new, strict=True)]
        for k, (segment, force) in enumerate(zip(segments, forces, strict=True)):
            target[k] += segment.respond(strut, force)
    stage = _projected(problem, segments, constants, target, tangents, parts.linear)
    return stage._replace(coarse=coarse)


def _tangents(
    segments: Sequence[Segment],
    strut: int,
    name: str,
    values: Array,
    constants: Array,
    forces: Sequence[Array],
) -> list[list[Array]]:
    """Answers of each segment to a small change of each parameter of an existing effect."""
    found: list[list[Array]] = [[] for _ in segments]
    for i, value in enumerate(values):
        moved = values.copy()
        moved[i] += _DIFFERENCE * (abs(value) or 1.0)
        there = segment_forces(segments, strut, name, moved, constants, reference=False)
        for k, segment in enumerate(segments):
            found[k].append(segment.respond(strut, there[k] - forces[k]))
    return found


def _projected(
    problem: Problem,
    segments: tuple[Segment, ...],
    constants: Array,
    target: Sequence[Array],
    tangents: Sequence[Sequence[Array]],
    linear: Array,
) -> Stage:
    rows = [len(segment.target) for segment in segments]
    # The gain of the applied force is degenerate with all else and has a turn of its own.
    counted = [i for i, p in enumerate(problem.linear) if p.kind not in ("gain", "free_length")]
    prior = np.diag([1.0 / problem.linear[i].deviation for i in counted])
    shared = [
        np.column_stack([segment.linear[:, counted], *columns])
        for segment, columns in zip(segments, tangents, strict=True)
    ]
    own = [segment.initial for segment in segments]
    width, initial = shared[0].shape[1], sum(part.shape[1] for part in own)
    whole = np.zeros((sum(rows) + len(counted), width + initial))
    at, column = 0, width
    for part, start, count in zip(shared, own, rows, strict=True):
        whole[at : at + count, :width] = part
        whole[at : at + count, column : column + start.shape[1]] = start
        at, column = at + count, column + start.shape[1]
    whole[at:, : len(counted)] = prior
    size = np.linalg.norm(whole, axis=0)
    scaled = whole[:, size > 0.0] / size[size > 0.0]
    left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = left[:, singular > _RANK * singular[0]] if scaled.shape[1] else left[:, :0]
    deviation = np.array([problem.linear[i].deviation for i in counted])
    y = np.concatenate([*target, -linear[counted] / deviation])
    blocks = numbered_on([segment.blocks for segment in segments])
    blocks = np.concatenate([blocks, np.zeros(len(counted), dtype=np.int64)])
    target_left = y - basis @ (basis.T @ y)
    return Stage(
        problem, segments, constants, whole, tuple(counted), y, basis, target_left, blocks, None
    )


def answer(stage: Stage, strut: int, name: str, values: Array) -> Array:
    """What a law adds to the whitened answer, shape (m,)."""
    constants, (own, shift) = stage.constants, law_and_shift(name, values)
    if shift:
        constants = constants.copy()
        constants[strut, 0] += shift
    forces = segment_forces(stage.segments, strut, name, own, constants, reference=False)
    parts = [
        segment.respond(strut, force) for segment, force in zip(stage.segments, forces, strict=True)
    ]
    return np.concatenate([*parts, np.zeros(len(stage.target) - sum(map(len, parts)))])


def law_and_shift(name: str, values: Array) -> tuple[Array, float]:
    """Parameters of a law in a screening, and by how much the free length is another one."""
    count = len(effect(name).parameters)
    return values[:count], float(values[count]) if len(values) > count else 0.0


def _with_shift(name: str, values: Array) -> Array:
    own, shift = law_and_shift(name, values)
    return np.append(own, shift) if effect(name).about_free_length else own


def _space(stage: Stage, at: Placed, values: Array) -> tuple[Space, Array]:
    """Where a law's parameters in a screening are searched, and the weights of their priors."""
    strut, name = at
    own, _ = law_and_shift(name, values)
    space = law_space(name, stage.problem.motions[strut], own)
    if len(values) == len(own):
        return space, np.zeros(len(own))
    scales = [
        p.deviation for p in stage.problem.linear if (p.strut, p.kind) == (strut, "free_length")
    ]
    endless = np.array([np.inf])
    shift = Space(-endless, endless, np.array(scales), np.array([False]))
    return joined([space, shift]), np.append(np.zeros(len(own)), 1.0)


def response(stage: Stage, strut: int, name: str, values: Array) -> Array:
    """What a law adds to the whitened answer, less what the linear part could, shape (m,)."""
    whole = answer(stage, strut, name, values)
    return whole - stage.basis @ (stage.basis.T @ whole)


def linear_beside(stage: Stage, screening: Screening) -> Array:
    """Changes of the linear parameters against the reference beside these laws, shape (L,)."""
    left = stage.goal.copy()
    for (strut, name), values in zip(screening.laws, screening.values, strict=True):
        left -= answer(stage, strut, name, values)
    size = np.maximum(np.linalg.norm(stage.nuisance, axis=0), 1e-300)
    found = np.linalg.lstsq(stage.nuisance / size, left, rcond=_RANK)[0] / size
    changes = np.zeros(len(stage.problem.linear))
    changes[list(stage.counted)] = found[: len(stage.counted)]
    return changes


def plain(stage: Stage) -> Screening:
    """No law at all."""
    return Screening((), (), float(stage.target @ stage.target), _scores(stage, stage.target, None))


def _scores(stage: Stage, residual: Array, jacobian: Array | None) -> Array:
    if jacobian is None:
        count = int(stage.blocks.max()) + 1
        return np.asarray(np.bincount(stage.blocks, residual**2, count), dtype=np.float64)
    return left_out(residual, jacobian, stage.blocks, np.zeros((jacobian.shape[1],) * 2))


def proposed(problem: Problem) -> list[Placed]:
    """Laws that compete: those that this kind of bench can show, in every strut."""
    return [
        (strut, item.name)
        for strut, motion in enumerate(problem.motions)
        for item in CATALOGUE.values()
        if not item.linear and problem.bench in item.benches and item.starts(motion)
    ]


def ranked(
    stage: Stage,
    base: Screening,
    screened: int,
    only: Sequence[Placed] | None = None,
) -> list[Screening]:
    """A set of laws with one more, for the best laws that there are; best first.

    Args:
        stage: The regression.
        base: The set.
        screened: How many laws are refined.
        only: Laws that compete; all if absent.
    """
    coarse = stage.coarse or stage
    columns = _columns(coarse, base)
    basis = np.linalg.qr(columns)[0] if columns.shape[1] else columns
    residual = _residual(coarse, base.laws, base.values)
    residual = residual - basis @ (basis.T @ residual)
    laws = proposed(stage.problem) if only is None else only
    laws = [at for at in laws if goes_with(at, base.laws)]
    for _, name in laws:
        compile_law(name)  # here: numba's compiler admits no two threads

    def first(at: Placed, known: Mapping[str, float] = MappingProxyType({})) -> list[_Start]:
        found = [
            _first(coarse, at, start, residual, basis) for start in starts(stage.problem, at, known)
        ]
        return sorted((one for one in found if one is not None), key=lambda one: one[0])

    with ThreadPoolExecutor(cpu_count()) as pool:
        tried = list(pool.map(first, laws))
        order = sorted((t[0][0], i) for i, t in enumerate(tried) if t)[:screened]
        jobs = [
            (laws[i], values)
            for least, i in order
            for cost, values in tried[i][:_REFINED_STARTS]
            if cost < _SIDE_VALLEY * least
        ]

        def roughly(job: tuple[Placed, Array]) -> Screening | None:
            return refined(coarse, (*base.laws, job[0]), (*base.values, job[1]))

        def refine(screening: Screening) -> Screening | None:
            return refined(stage, screening.laws, screening.values)

        rough = best_of_each(
            screening for screening in pool.map(roughly, jobs) if screening is not None
        )
        # A law begins no worse than a simpler one that is known.
        nested = list(pool.map(lambda job: (job[0], first(*job)[:1]), _nested(rough, laws)))
        jobs = [(at, values) for at, starts in nested for _, values in starts]
        rough = best_of_each([*rough, *(t for t in pool.map(roughly, jobs) if t is not None)])
        best = [screening for screening in pool.map(refine, rough[:_FINE]) if screening is not None]
    # Coarse costs in terms of fine ones, for laws that are not refined there.
    scale = len(stage.target) / len(coarse.target)
    best += [t._replace(cost=scale * t.cost, scores=scale * t.scores) for t in rough[_FINE:]]
    rest = [
        Screening((*base.laws, laws[i]), (), scale * cost, np.array([scale * cost]))
        for cost, i in sorted((t[0][0], i) for i, t in enumerate(tried) if t)[screened:]
    ]
    return [*sorted(best, key=lambda screening: screening.score), *rest]


def best_of_each(screenings: Iterable[Screening]) -> list[Screening]:
    """Each set of laws at its best, best first."""
    found: dict[frozenset[Placed], Screening] = {}
    for screening in screenings:
        key = frozenset(screening.laws)
        if key not in found or screening.score < found[key].score:
            found[key] = screening
    return sorted(found.values(), key=lambda screening: screening.score)


def starts(problem: Problem, at: Placed, known: Mapping[str, float]) -> list[Array]:
    """A law's starts, with those of its parameters that are known; its size is found anyway."""
    item = effect(at[1])
    fixed = {
        i: known[parameter.name]
        for i, parameter in enumerate(item.parameters)
        if i not in item.scaled and parameter.name in known
    }
    starts = {
        tuple(fixed.get(i, value) for i, value in enumerate(start))
        for start in item.starts(problem.motions[at[0]])
    }
    return [np.array(start) for start in sorted(starts)]


def _nested(
    screenings: Sequence[Screening], laws: Sequence[Placed]
) -> list[tuple[Placed, dict[str, float]]]:
    """Laws that have a refined one as their simpler case, with what this one's parameters are."""
    found: list[tuple[Placed, dict[str, float]]] = []
    for screening in screenings:
        strut, name = screening.laws[-1]
        values, _ = law_and_shift(name, screening.values[-1])
        known = effect(name).named(values.tolist())
        found += [(at, known) for at in laws if at[0] == strut and name in effect(at[1]).simpler]
    return found


def goes_with(at: Placed, laws: Sequence[Placed]) -> bool:
    """Whether a law may stand beside others: two formulas of one family imitate a third."""
    family = effect(at[1]).family
    return at not in laws and (
        family in _REPEATABLE
        or all(strut != at[0] or effect(name).family != family for strut, name in laws)
    )


def _first(stage: Stage, at: Placed, start: Array, residual: Array, basis: Array) -> _Start | None:
    """Cost and parameters of a law at a start, its size by least squares where it has one."""
    column = response(stage, *at, start)
    column = column - basis @ (basis.T @ column)
    power = float(column @ column)
    if not np.isfinite(power) or power <= 0.0:
        return None
    if effect(at[1]).scaled:
        size = float(column @ residual) / power
        values = sized(at[1], start, size)
        return None if values is None else (float(residual @ residual) - size**2 * power, values)
    left = residual - column
    return float(left @ left), start


def sized(name: str, values: Array, size: float) -> Array | None:
    """A law with so many times its force; None where its parameters may not be so large."""
    item, scaled = effect(name), values.copy()
    for i in item.scaled:
        scaled[i] *= size
        if not item.parameters[i].low <= scaled[i] <= item.parameters[i].high:
            return None
    return scaled


def _residual(stage: Stage, laws: Sequence[Placed], values: Sequence[Array]) -> Array:
    total = stage.target
    for (strut, name), own in zip(laws, values, strict=True):
        total = total - response(stage, strut, name, own)
    return total


def _columns(stage: Stage, base: Screening) -> Array:
    """Answers to small changes of the parameters of a set's laws, shape (m, k)."""
    found: list[Array] = []
    for (strut, name), values in zip(base.laws, base.values, strict=True):
        here = response(stage, strut, name, values)
        space, _ = _space(stage, (strut, name), values)
        inner = space.inner(values)
        for i in range(len(values)):
            moved = inner.copy()
            moved[i] += _DIFFERENCE * max(1.0, abs(inner[i]))
            found.append(response(stage, strut, name, space.outer(moved)) - here)
    used = [column / size for column in found if (size := float(np.linalg.norm(column))) > 0.0]
    return np.column_stack(used) if used else np.zeros((len(stage.target), 0))


def refined(stage: Stage, laws: Sequence[Placed], values: Sequence[Array]) -> Screening | None:
    """All parameters of a set of laws, fitted together along the motion."""
    values = [_with_shift(name, own) for (_, name), own in zip(laws, values, strict=True)]
    lengths = np.cumsum([0, *(len(own) for own in values)])
    known: list[dict[bytes, Array]] = [{} for _ in laws]

    def split(x: Array) -> list[Array]:
        return [x[a:b] for a, b in itertools.pairwise(lengths)]

    def one(i: int, own: Array) -> Array:
        # A difference moves one parameter: the other laws answer as before.
        key = own.tobytes()
        if key not in known[i]:
            if len(known[i]) > _REMEMBERED:
                known[i].clear()
            known[i][key] = response(stage, *laws[i], own)
        return known[i][key]

    def residual(x: Array) -> Array | None:
        there = stage.target - np.sum([one(i, own) for i, own in enumerate(split(x))], axis=0)
        return there if np.all(np.isfinite(there)) else None

    spaces = [_space(stage, at, own) for at, own in zip(laws, values, strict=True)]
    weights = np.concatenate([weight for _, weight in spaces])
    prior = Prior(np.zeros(len(weights)), weights, 1.0)
    space = joined([space for space, _ in spaces])
    found = solve(residual, np.concatenate(values), space, _STEPS, 1e-3, prior=prior)
    if found is None:
        return None
    scores = _scores(stage, found.residual, found.jacobian)
    return Screening(tuple(laws), tuple(split(found.values)), found.cost, scores)
