"""Edges of play and stops that the motion did not reach: their intervals are open on that side.

Of a free play of which one edge was met, the data say that it is at least as wide as what was
crossed of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.outcome import Estimate
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.problem import (
    CandidateModel,
    Problem,
    StrutEffect,
    slots_of,
    strut_constants,
)
from rig.diagnosis.problem.track import law_force
from rig.diagnosis.search.fit import Fit

Array = NDArray[np.float64]

_ROUNDING = 1e-6
"""Share of a law's force below which a constant force is rounding."""


@dataclass(frozen=True)
class UnreachedEdge:
    """An edge of a law that the motion did not reach.

    Attributes:
        side: -1 of the lower edge, 1 of the upper one.
        at_m: Where the fit has it.
        nearest_m: Where it is, or beyond.
        force_n_per_m: Constant force by which the law's is less along the motion, per metre by
            which the edge is farther away: a preload replaces it.
    """

    side: int
    at_m: float
    nearest_m: float
    force_n_per_m: float


def find_unreached_edges(
    problem: Problem, result: Fit, law: StrutEffect, tracks: Sequence[Track], least_gain: float
) -> tuple[UnreachedEdge, ...]:
    """The edges of a fitted law that the data do not show: farther away they fit as well.

    Args:
        problem: That of the fit.
        result: The fit.
        law: The law.
        tracks: The motion.
        least_gain: Gain in the sum of squares, over the mean square, by which an edge shows.
    """
    edges = np.array(effect(law[1]).edges)
    if not len(edges):
        return ()
    heights_m = np.concatenate([track.heights_m[law[0]] for track in tracks])
    stroke_m = float(np.ptp(heights_m))
    values = result.parts.effects[_slot(problem, result, law)]
    most_cost = _cost(problem, result.model) + least_gain * max(result.mean_square, 1.0)
    found: list[UnreachedEdge] = []
    for row, side in enumerate((-1, 1)):
        away = np.zeros(2)
        away[row] = side * stroke_m
        moved = values + np.linalg.lstsq(edges, away, rcond=None)[0]
        # Where the motion is farthest from the edge, the edge decides about a constant at most.
        constant_n = _less_n(problem, result, law, moved, tracks)[np.argmin(side * heights_m)]
        other = _with_values(problem, result, law, moved, constant_n)
        if _cost(problem, other) > most_cost:
            continue
        at_m, end_m = float(edges[row] @ values), float((side * heights_m).max())
        nearest_m = side * min(side * at_m, end_m)
        found.append(UnreachedEdge(side, at_m, nearest_m, float(constant_n) / stroke_m))
    return tuple(found)


def _slot(problem: Problem, result: Fit, law: StrutEffect) -> slice:
    row = len(result.candidate.kept) + result.candidate.new.index(law)
    return slots_of(problem, result.candidate).each[row].parameters


def _less_n(
    problem: Problem, result: Fit, law: StrutEffect, values: Array, tracks: Sequence[Track]
) -> Array:
    """How much less a law's force is along the motion with other parameters, shape (N,)."""
    constants = strut_constants(problem, result.parts.linear)
    own = result.parts.effects[_slot(problem, result, law)]
    before, after = (
        np.concatenate([law_force(track, *law, parameters, constants) for track in tracks])
        for parameters in (own, values)
    )
    less_n = before - after
    is_rounding = np.abs(less_n) < _ROUNDING * float(np.abs(before).max())
    return np.asarray(np.where(is_rounding, 0.0, less_n))


def _with_values(
    problem: Problem, result: Fit, law: StrutEffect, values: Array, preload_n: float
) -> CandidateModel:
    """The model with other parameters of a law, and a further preload where that is fitted."""
    effects, linear = result.parts.effects.copy(), result.parts.linear.copy()
    effects[_slot(problem, result, law)] = values
    for index, parameter in enumerate(problem.linear):
        if result.free[index] and (parameter.kind, parameter.strut) == ("preload", law[0]):
            linear[index] += preload_n
    parts = result.parts._replace(linear=linear, effects=effects)
    return CandidateModel(result.candidate, parts)


def _cost(problem: Problem, model: CandidateModel) -> float:
    """Sum of squares of a model's residual; infinite if it runs away."""
    cost = 0.0
    for k in range(problem.recordings):
        residual = problem.residual(k, model)
        cost += np.inf if residual is None else float(residual @ residual)
    return cost


def open_parameters(
    law: str,
    values: Array,
    half_m: Array,
    unreached: Sequence[UnreachedEdge],
    estimates: Mapping[str, Estimate],
) -> dict[str, Estimate]:
    """Estimates of a law, open where an edge that was not reached decides.

    Args:
        law: Its name.
        values: Its parameters.
        half_m: Half the 95 % intervals of its edges, shape (2,).
        unreached: Edges that were not reached.
        estimates: Its estimates by name.
    """
    edges, opened = np.array(effect(law).edges), dict(estimates)
    at_m = edges @ values
    ends_m = np.column_stack([at_m - half_m, at_m + half_m])
    rows = [int(edge.side > 0) for edge in unreached]
    for row, edge in zip(rows, unreached, strict=True):
        ends_m[row] = sorted((edge.nearest_m, edge.side * np.inf))
    # Two parameters decide about two edges; their intervals are those of sums of what lies in two.
    decide = np.flatnonzero(np.any(edges, axis=0))
    for index, of_edges in zip(decide.tolist(), np.linalg.inv(edges[:, decide]), strict=True):
        if np.any(of_edges[rows]):
            name = effect(law).parameters[index].name
            terms = [np.sort(w * ends) for w, ends in zip(of_edges, ends_m, strict=True) if w]
            opened[name] = _open(estimates[name].value, np.sum(terms, axis=0))
    return opened


def open_preload(preload: Estimate, unreached: Sequence[UnreachedEdge]) -> Estimate:
    """A strut's preload beside a law, open where an edge that was not reached decides."""
    for edge in unreached:
        if edge.force_n_per_m:
            nearer_m = edge.side * (edge.nearest_m - edge.at_m)
            nearest_n = preload.value + edge.force_n_per_m * nearer_m
            ends = np.sort([nearest_n, np.copysign(np.inf, edge.force_n_per_m)])
            preload = _open(preload.value, ends)
    return preload


def _open(value: float, ends: Array) -> Estimate:
    low, high = (float(end) if np.isfinite(end) else None for end in ends)
    return Estimate(value, low, high)
