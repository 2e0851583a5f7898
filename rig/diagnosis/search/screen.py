"""Laws along the measured motion, the linear part projected out.

Every law that the bench can show is fitted to the residual of a reference, together with changes
of the linear part (but gain and free length), of existing effects and of initial states: these
enter linearly and are projected out (Golub, Pereyra, SIAM J. Numer. Anal. 10, 1973). A law whose
force is proportional to its size costs one pass a start; the best are then refined together with
all other laws of their combination.
"""

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from os import cpu_count
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from dart_model.effects.calling import arguments
from rig.diagnosis.numerics.laws import compile_law
from rig.diagnosis.numerics.least_squares import (
    Effort,
    Prior,
    Space,
    Together,
    concatenate_spaces,
    solve,
)
from rig.diagnosis.problem.problem import (
    CandidateModel,
    Integers,
    Problem,
    Segment,
    StrutEffect,
    concatenate_blocks,
    slots_of,
    strut_constants,
    strut_effects,
)
from rig.diagnosis.problem.track import largest_stride, segment_forces
from rig.diagnosis.search.fit import NO_PREDICTION, law_space, leave_block_out_costs

Array = NDArray[np.float64]

_MOST_SAMPLES = 12_000
"""Samples of all recordings in the regression along the motion: what a law explains is known to a
part in a hundred with far fewer."""
_COARSE_SAMPLES = 4_000
"""Samples on which starts are compared."""
_EVERY_SAMPLE = 1_000_000_000
"""More samples than any recording has, so that all are taken."""
_REFINED_STARTS = 2
"""Starts of a law that are refined: its best one may lie in a side valley."""
_SIDE_VALLEY = 2.0
"""Times a law's least cost up to which another of its starts is refined."""
_REPEATABLE = ("stop", "nonlinear_damping")
"""Families of which a strut may have two: stops at both ends; a damper's zones."""
_FINE = 5
"""Laws of a round that are refined on all samples: one more than `fitted_a_size`."""
_REFINEMENT = Effort(7, 1e-3, 1)
"""Fits of laws along the motion."""
_TOGETHER = 16
"""Starts of a law that are evaluated together: as many columns stay in the processor's cache."""
_RANK = 1e-10
"""Singular values below this share of the largest are rounding."""
_DIFFERENCE = 1e-4
"""Share of a parameter by which it is changed for a derivative."""


class Stage(NamedTuple):
    """The regression along the motion, which all combinations of laws share.

    Attributes:
        constants: Strut constants of the reference, shape (struts, 5).
        nuisance: Responses to the linear part (its counted parameters first), to existing effects'
            parameters and to initial states, shape (m, c).
        goal: Whitened residual without the reference's laws, shape (m,).
        basis: Orthonormal columns that span `nuisance`, shape (m, c').
        target: `goal` without its projection on `basis`, shape (m,).
        blocks: Block of each row, shape (m,).
        coarse: The regression on thinned recordings, where starts are compared; None in itself.
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
    """A combination of laws along the motion, refined or (without values) at its best start.

    Attributes:
        values: Parameters of each; for a law that depends on the strut's free length, followed by
            the change of that against the reference.
        block_costs: Out-of-sample sum of squares of each block; `cost` where nothing was refined.
        share: Sum of squares as a share of that without any law, of the same samples.
    """

    laws: tuple[StrutEffect, ...]
    values: tuple[Array, ...]
    cost: float
    block_costs: Array
    share: float = 1.0

    @property
    def validation_cost(self) -> float:
        """Out-of-sample sum of squares."""
        return float(self.block_costs.sum())

    @property
    def promising_cost(self) -> float:
        """The same, but that of the fit where this predicts nothing: a contact of a single block.

        It decides whether a simulation is tried, which costs little.
        """
        predicts = self.validation_cost <= NO_PREDICTION * self.cost
        return self.validation_cost if predicts else self.cost


def stage_of(problem: Problem, reference: CandidateModel) -> Stage:
    """The regression about a reference: a model that was fitted.

    Raises:
        FloatingPointError: The reference runs away.
    """
    stride = largest_stride(problem.motions)
    coarse = problem.segments(reference, _COARSE_SAMPLES, stride)
    fine = problem.segments(reference, _MOST_SAMPLES, 1)
    return _stage(problem, reference, fine, _stage(problem, reference, coarse, None))


def whole_stage_of(problem: Problem, reference: CandidateModel) -> Stage:
    """The regression with every sample: between thinned samples a brief contact is missed.

    Raises:
        FloatingPointError: The reference runs away.
    """
    segments = problem.segments(reference, _EVERY_SAMPLE, 1)
    return _stage(problem, reference, segments, None)


def _stage(
    problem: Problem, reference: CandidateModel, segments: tuple[Segment, ...], coarse: Stage | None
) -> Stage:
    candidate, parts = reference
    constants = strut_constants(problem, parts.linear)
    slots = slots_of(problem, candidate).each
    target = [segment.target.copy() for segment in segments]
    tangents: list[list[Array]] = [[] for _ in segments]
    for row, at in enumerate(strut_effects(problem, candidate)):
        values = parts.effects[slots[row].parameters]
        # The reference's laws acted along its own motion; those of a screening, along the measured.
        forces = segment_forces(segments, at, values, constants, reference=True)
        if row < len(candidate.kept):
            measured = segment_forces(segments, at, values, constants, reference=False)
            forces = [a - b for a, b in zip(forces, measured, strict=True)]
            if problem.existing[candidate.kept[row]].free:
                new = _tangents(segments, at, values, constants, measured)
                tangents = [old + more for old, more in zip(tangents, new, strict=True)]
        for k, (segment, force) in enumerate(zip(segments, forces, strict=True)):
            target[k] += segment.respond(at[0], force[:, np.newaxis])[:, 0]
    stage = _project_out_nuisance(problem, reference, segments, target, tangents)
    return stage._replace(coarse=coarse)


def _tangents(
    segments: Sequence[Segment],
    at: StrutEffect,
    values: Array,
    constants: Array,
    forces: Sequence[Array],
) -> list[list[Array]]:
    """Responses of each segment to a small change of each parameter of an existing effect."""
    tangents: list[list[Array]] = [[] for _ in segments]
    for i, value in enumerate(values):
        moved = values.copy()
        moved[i] += _DIFFERENCE * (abs(value) or 1.0)
        changed = segment_forces(segments, at, moved, constants, reference=False)
        for k, segment in enumerate(segments):
            change = (changed[k] - forces[k])[:, np.newaxis]
            tangents[k].append(segment.respond(at[0], change)[:, 0])
    return tangents


def _project_out_nuisance(
    problem: Problem,
    reference: CandidateModel,
    segments: tuple[Segment, ...],
    target: Sequence[Array],
    tangents: Sequence[Sequence[Array]],
) -> Stage:
    linear = reference.parts.linear
    rows = [len(segment.target) for segment in segments]
    # The gain of the applied force is degenerate with all others, and is fitted separately.
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
    vectors, singular, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = vectors[:, singular > _RANK * singular[0]] if scaled.shape[1] else vectors[:, :0]
    deviation = np.array([problem.linear[i].deviation for i in counted])
    expected = np.array([problem.linear[i].expected for i in counted])
    y = np.concatenate([*target, (expected - linear[counted]) / deviation])
    blocks = concatenate_blocks([segment.blocks for segment in segments])
    blocks = np.concatenate([blocks, np.zeros(len(counted), dtype=np.int64)])
    constants = strut_constants(problem, linear)
    projected = y - basis @ (basis.T @ y)
    return Stage(
        problem, segments, constants, whole, tuple(counted), y, basis, projected, blocks, None
    )


def _whole_responses(stage: Stage, at: StrutEffect, each: Sequence[Array]) -> Array:
    """Changes of the whitened response by a law with parameters each, shape (m, k)."""
    forces = [np.empty((len(segment.track.t_s), len(each))) for segment in stage.segments]
    for i, values in enumerate(each):
        constants, (parameters, shift) = stage.constants, law_and_shift(at[1], values)
        if shift:
            constants = constants.copy()
            constants[at[0], 0] += shift
        own = segment_forces(stage.segments, at, parameters, constants, reference=False)
        for columns, force in zip(forces, own, strict=True):
            columns[:, i] = force
    parts = [
        segment.respond(at[0], columns)
        for segment, columns in zip(stage.segments, forces, strict=True)
    ]
    priors = len(stage.target) - sum(map(len, parts))
    return np.concatenate([*parts, np.zeros((priors, len(each)))])


def law_and_shift(name: str, values: Array) -> tuple[Array, float]:
    """Parameters of a law in a screening, and the change of the free length."""
    count = len(effect(name).parameters)
    return values[:count], float(values[count]) if len(values) > count else 0.0


def _with_shift(name: str, values: Array) -> Array:
    """Parameters of a law, followed by the change of the free length where it depends on that."""
    parameters, shift = law_and_shift(name, values)
    return np.append(parameters, shift) if effect(name).about_free_length else parameters


def _space(stage: Stage, at: StrutEffect, values: Array) -> tuple[Space, Array]:
    """Bounds and scales of a law's parameters in a screening, and the weights of their priors."""
    strut, name = at
    parameters, _ = law_and_shift(name, values)
    space = law_space(name, stage.problem.motions[strut], parameters)
    if len(values) == len(parameters):
        return space, np.zeros(len(parameters))
    scales = [
        p.deviation for p in stage.problem.linear if (p.strut, p.kind) == (strut, "free_length")
    ]
    endless = np.array([np.inf])
    shift = Space(-endless, endless, np.array(scales), np.array([False]))
    return concatenate_spaces([space, shift]), np.append(np.zeros(len(parameters)), 1.0)


def responses(stage: Stage, at: StrutEffect, each: Sequence[Array]) -> Array:
    """Changes of the whitened response by a law with parameters each, shape (m, k).

    The linear part is projected out.
    """
    whole = _whole_responses(stage, at, each)
    return whole - stage.basis @ (stage.basis.T @ whole)


def linear_changes(stage: Stage, screening: Screening) -> Array:
    """Changes of the linear parameters against the reference together with laws, shape (L,)."""
    residual = stage.goal.copy()
    for at, values in zip(screening.laws, screening.values, strict=True):
        residual -= _whole_responses(stage, at, [values])[:, 0]
    size = np.maximum(np.linalg.norm(stage.nuisance, axis=0), 1e-300)
    solution = np.linalg.lstsq(stage.nuisance / size, residual, rcond=_RANK)[0] / size
    changes = np.zeros(len(stage.problem.linear))
    changes[list(stage.counted)] = solution[: len(stage.counted)]
    return changes


def no_law(stage: Stage) -> Screening:
    """The combination without any law."""
    cost = float(stage.target @ stage.target)
    return Screening((), (), cost, _block_costs(stage, stage.target, None))


def as_screening(laws: Sequence[StrutEffect], known: Mapping[StrutEffect, Array]) -> Screening:
    """Fitted laws as a combination to which others are added."""
    return Screening(tuple(laws), tuple(known[law] for law in laws), 0.0, np.zeros(1))


def _block_costs(stage: Stage, residual: Array, jacobian: Array | None) -> Array:
    if jacobian is None:
        count = int(stage.blocks.max()) + 1
        return np.asarray(np.bincount(stage.blocks, residual**2, count), dtype=np.float64)
    no_prior = np.zeros((jacobian.shape[1],) * 2)
    return leave_block_out_costs(residual, jacobian, stage.blocks, no_prior)


def candidate_laws(problem: Problem) -> list[StrutEffect]:
    """Laws that this kind of bench can show, in every strut."""
    return [
        (strut, item.name)
        for strut, motion in enumerate(problem.motions)
        for item in CATALOGUE.values()
        if not item.linear and problem.bench in item.benches and item.starts(motion)
    ]


class Round(NamedTuple):
    """One law more for a combination: what the comparison of all starts shares.

    Attributes:
        residual: Its residual on the coarse regression, tangents projected out, shape (m,).
        basis: Orthonormal basis of those tangents, shape (m, k).
    """

    stage: Stage
    coarse: Stage
    base: Screening
    residual: Array
    basis: Array

    def columns(self, at: StrutEffect, each: Sequence[Array]) -> Array:
        """Responses of a law on the coarse regression, tangents projected out, shape (m, k)."""
        columns = responses(self.coarse, at, each)
        return columns - self.basis @ (self.basis.T @ columns)

    def starts(self, at: StrutEffect, known: Mapping[str, float]) -> list[_Start]:
        """Starts of a law, best first."""
        every = law_starts(self.stage.problem, at, known)
        starts = [
            start
            for first in range(0, len(every), _TOGETHER)
            for start in _evaluate_starts(self, at, every[first : first + _TOGETHER])
        ]
        return sorted(starts, key=lambda start: start[0])

    def refine_coarsely(self, job: tuple[StrutEffect, Array]) -> Screening | None:
        """The combination with a law from a start, refined on the coarse regression."""
        laws, values = (*self.base.laws, job[0]), (*self.base.values, job[1])
        return refine(self.coarse, laws, values)

    def refine(self, screening: Screening) -> Screening | None:
        """A combination refined on all samples."""
        return refine(self.stage, screening.laws, screening.values)


def begin_round(stage: Stage, base: Screening) -> Round:
    """What the comparison of further laws for a combination shares."""
    coarse = stage.coarse or stage
    columns = _law_tangents(coarse, base)
    basis = np.linalg.qr(columns)[0] if columns.shape[1] else columns
    residual = _residual(coarse, base.laws, base.values)
    return Round(stage, coarse, base, residual - basis @ (basis.T @ residual), basis)


def rank_laws(
    stage: Stage, base: Screening, screened: int, only: Sequence[StrutEffect] | None = None
) -> list[Screening]:
    """A combination with each further law (of `only`), best first; `screened` are refined."""
    laws = candidate_laws(stage.problem) if only is None else only
    laws = [at for at in laws if is_compatible(at, base.laws)]
    for _, name in laws:
        compile_law(name)  # Compiled here: numba's compiler is not thread-safe.
    this = begin_round(stage, base)
    with ThreadPoolExecutor(cpu_count()) as pool:
        starts = list(pool.map(lambda at: this.starts(at, MappingProxyType({})), laws))
        order = sorted((s[0][0], i) for i, s in enumerate(starts) if s)
        jobs = [
            (laws[i], values)
            for least, i in order[:screened]
            for cost, values in starts[i][:_REFINED_STARTS]
            if cost < _SIDE_VALLEY * least
        ]
        coarse = best_of_each(pool.map(this.refine_coarsely, jobs))
        # A law begins no worse than a simpler one that is known.
        general = pool.map(
            lambda job: (job[0], this.starts(*job)[:1]), _more_general_laws(coarse, laws)
        )
        jobs = [(at, values) for at, best in list(general) for _, values in best]
        coarse = best_of_each([*coarse, *pool.map(this.refine_coarsely, jobs)])
        fine = [s for s in pool.map(this.refine, coarse[:_FINE]) if s is not None]
    with np.errstate(over="ignore"):  # an infinite sum of squares makes each share zero
        nothing, coarse_nothing = (
            max(float(target @ target), 1e-300) for target in (stage.target, this.coarse.target)
        )
    fine = [s._replace(share=s.cost / nothing) for s in fine]
    # Coarse costs in terms of fine ones, for laws that are not refined there.
    scale = len(stage.target) / len(this.coarse.target)
    fine += [
        Screening(s.laws, s.values, scale * s.cost, scale * s.block_costs, s.cost / coarse_nothing)
        for s in coarse[_FINE:]
    ]
    rest = [
        Screening(
            (*base.laws, laws[i]),
            (),
            scale * cost,
            np.array([scale * cost]),
            cost / coarse_nothing,
        )
        for cost, i in order[screened:]
    ]
    return [*sorted(fine, key=lambda screening: screening.validation_cost), *rest]


def best_of_each(screenings: Iterable[Screening | None]) -> list[Screening]:
    """Each combination of laws at its best, best first; None where a refinement failed."""
    best: dict[frozenset[StrutEffect], Screening] = {}
    for screening in screenings:
        if screening is None:
            continue
        key = frozenset(screening.laws)
        if key not in best or screening.validation_cost < best[key].validation_cost:
            best[key] = screening
    return sorted(best.values(), key=lambda screening: screening.validation_cost)


def law_starts(problem: Problem, at: StrutEffect, known: Mapping[str, float]) -> list[Array]:
    """A law's starts, with those of its parameters that are known; its size is fitted anyway."""
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


def _more_general_laws(
    screenings: Sequence[Screening], laws: Sequence[StrutEffect]
) -> list[tuple[StrutEffect, dict[str, float]]]:
    """Laws that have a refined one as their simpler case, with the parameters of that one."""
    general: list[tuple[StrutEffect, dict[str, float]]] = []
    for screening in screenings:
        strut, name = screening.laws[-1]
        values, _ = law_and_shift(name, screening.values[-1])
        known = effect(name).named(values.tolist())
        general += [(at, known) for at in laws if at[0] == strut and name in effect(at[1]).simpler]
    return general


def is_compatible(at: StrutEffect, laws: Sequence[StrutEffect]) -> bool:
    """Whether a law may be combined with others: two formulas of one family imitate a third."""
    item = effect(at[1])
    alike = [effect(name) for strut, name in laws if strut == at[0]]
    alike = [other for other in alike if other.family == item.family]
    if item.family not in _REPEATABLE:
        return not alike
    # A damper has one force over velocity; what acts in a part of the stroke may be added to it.
    curves = sum(reads_alone(it.name, "velocity_m_per_s") for it in (item, *alike))
    return item not in alike and curves < 2


@cache
def reads_alone(name: str, quantity: str) -> bool:
    """Whether a law's force is a function of one quantity of the motion alone."""
    item = effect(name)
    read = {it.name for it in arguments(item.force, item) if it.origin in ("motion", "states")}
    return read == {quantity}


@np.errstate(over="ignore", invalid="ignore")  # No start is taken from what overflows.
def _evaluate_starts(this: Round, at: StrutEffect, starts: Sequence[Array]) -> list[_Start]:
    """Costs and parameters of a law at its starts, its size by least squares where it has one."""
    columns = this.columns(at, starts)
    powers, matches = np.sum(columns**2, axis=0), this.residual @ columns
    nothing = float(this.residual @ this.residual)
    evaluated: list[_Start] = []
    for start, power, match in zip(starts, powers.tolist(), matches.tolist(), strict=True):
        if not np.isfinite(power) or power <= 0.0:
            continue
        size = match / power if effect(at[1]).scaled else 1.0
        values = scale_law(at[1], start, size)
        if values is not None:
            evaluated.append((nothing - size * (2.0 * match - size * power), values))
    return evaluated


def scale_law(name: str, values: Array, size: float) -> Array | None:
    """Parameters of a law with `size` times its force; None where they would leave their bounds."""
    item, scaled = effect(name), values.copy()
    for i in item.scaled:
        scaled[i] *= size
        if not item.parameters[i].low <= scaled[i] <= item.parameters[i].high:
            return None
    return scaled


def _residual(stage: Stage, laws: Sequence[StrutEffect], values: Sequence[Array]) -> Array:
    total = stage.target
    for at, parameters in zip(laws, values, strict=True):
        total = total - responses(stage, at, [parameters])[:, 0]
    return total


@np.errstate(over="ignore")  # A column that overflows has no direction, and becomes zero.
def _law_tangents(stage: Stage, base: Screening) -> Array:
    """Derivatives of the response by the parameters of a combination's laws, shape (m, k)."""
    columns: list[Array] = []
    for at, values in zip(base.laws, base.values, strict=True):
        space, _ = _space(stage, at, values)
        inner = space.inner(values)
        moved = inner + np.diag(_DIFFERENCE * np.maximum(1.0, np.abs(inner)))
        unmoved, *changed = responses(stage, at, [values, *map(space.outer, moved)]).T
        columns += [column - unmoved for column in changed]
    used = [column / size for column in columns if (size := float(np.linalg.norm(column))) > 0.0]
    return np.column_stack(used) if used else np.zeros((len(stage.target), 0))


@np.errstate(over="ignore", invalid="ignore")  # No step is taken from what overflows.
def refine(stage: Stage, laws: Sequence[StrutEffect], values: Sequence[Array]) -> Screening | None:
    """All parameters of a combination of laws, fitted together along the motion."""
    values = [_with_shift(name, own) for (_, name), own in zip(laws, values, strict=True)]
    ends = np.cumsum([len(own) for own in values])[:-1]
    known: list[dict[bytes, Array]] = [{} for _ in laws]
    """Responses of each law of the last call, by its parameters."""

    def residuals_of(points: Array) -> Array:
        residuals = np.repeat(stage.target[:, np.newaxis], len(points), axis=1)
        for i, (at, own) in enumerate(zip(laws, np.split(points, ends, axis=1), strict=True)):
            # A difference changes one parameter: the other laws respond as before.
            each = {point.tobytes(): point for point in own}
            new = [key for key in each if key not in known[i]]
            columns = responses(stage, at, [each[key] for key in new]).T if new else ()
            every = known[i] | dict(zip(new, columns, strict=True))
            known[i] = {key: every[key] for key in each}
            residuals -= np.column_stack([known[i][point.tobytes()] for point in own])
        return residuals

    spaces = [_space(stage, at, own) for at, own in zip(laws, values, strict=True)]
    weights = np.concatenate([weight for _, weight in spaces])
    prior = Prior(np.zeros(len(weights)), weights, 1.0)
    space = concatenate_spaces([space for space, _ in spaces])
    solution = solve(Together(residuals_of), np.concatenate(values), space, _REFINEMENT, prior)
    if solution is None:
        return None
    block_costs = _block_costs(stage, solution.residual, solution.jacobian)
    refined = tuple(np.split(solution.values, ends))
    return Screening(tuple(laws), refined, solution.cost, block_costs)
