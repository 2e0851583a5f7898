"""Estimates with confidence intervals of what a fit determines, and the laws that it contains."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.open_edges import UnreachedEdge, find_unreached_edges, open_parameters
from rig.diagnosis.outcome import Estimate
from rig.diagnosis.problem.problem import (
    LinearParameter,
    Problem,
    ResidualForces,
    mid_stroke_m,
    slots_of,
)
from rig.diagnosis.problem.track import forces_along
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import (
    CLOCK,
    UNBOUND,
    Fit,
    FitCovariance,
    effect_variables,
    law_values,
)

Array = NDArray[np.float64]

_NEARLY = 0.02
"""Share of a preload up to which it counts as implied by a change of stiffness."""
AT_BOUND = 1e-3
"""Distance from the end of a range, relative, within which a parameter counts as at it."""


class FitEstimates(NamedTuple):
    """A fit with its covariance, from which estimates with confidence intervals follow."""

    fit: Fit
    covariance: FitCovariance

    def estimate(self, variable: int, nominal: float = 0.0) -> Estimate:
        """Value of a search variable, added to its nominal value, with its confidence interval.

        It has none where the data say nothing of it, and no prior does: the velocity of a Stribeck
        curve that is flat.
        """
        solution, space = self.fit.solution, self.fit.space
        value = float(solution.values[variable])
        if not (np.any(solution.jacobian[:, variable]) or solution.prior[variable]):
            return Estimate(value + nominal, None, None)
        half = float(self.covariance.half[variable])
        low, high = float(space.low[variable]), float(space.high[variable])
        if space.logarithmic[variable]:
            if half > np.log(UNBOUND):
                return Estimate(value, None, None)
            growth = float(np.exp(np.hypot(half, CLOCK)))
            return Estimate(value, max(value / growth, low), min(value * growth, high))
        half *= float(space.scale[variable])
        if half > UNBOUND * max(abs(value), 1e-300) and half > 0.5 * (high - low):
            return Estimate(value + nominal, None, None)
        half = float(np.hypot(half, CLOCK * abs(value + nominal)))
        return Estimate(
            value + nominal, max(value - half, low) + nominal, min(value + half, high) + nominal
        )

    def estimate_of_law(self, variable: int) -> Estimate:
        """The same of a law's parameter; open where that is at the end of its range."""
        found = self.estimate(variable)
        match self.end_of_range(variable):
            case "lower":
                return replace(found, low=None)
            case "upper":
                return replace(found, high=None)
            case _:
                return found

    def end_of_range(self, variable: int) -> str | None:
        """The end of the range, `lower` or `upper`, at which a search variable is; none is zero."""
        space = self.fit.space
        low, high = float(space.low[variable]), float(space.high[variable])
        value = float(self.fit.solution.values[variable])
        near = AT_BOUND * (abs(value) if low > 0.0 else float(space.scale[variable]))
        for name, bound in (("lower", low), ("upper", high)):
            if low < high and bound and abs(value - bound) <= near:
                return name
        return None

    def half_of(self, variables: NDArray[np.intp], weights: Sequence[Sequence[float]]) -> Array:
        """Half-widths of the intervals of sums of parameters, shape (n,).

        Args:
            variables: Search variables of the parameters, shape (k,).
            weights: Of the parameters in each sum, shape (n, k).
        """
        space, values = self.fit.space, self.fit.solution.values
        units = np.where(space.logarithmic, values, space.scale)[variables]
        rows = np.array(weights) * units
        covariance = self.covariance.covariance[np.ix_(variables, variables)]
        variances = np.einsum("ij,jk,ik->i", rows, covariance, rows)
        return np.asarray(self.covariance.factor * np.sqrt(np.maximum(variances, 0.0)))


def free_parameters(problem: Problem, result: Fit) -> list[LinearParameter]:
    """Linear parameters that a fit left free, in the order of its search variables."""
    return [p for p, free in zip(problem.linear, result.free, strict=True) if free]


def estimates_of(
    problem: Problem, estimates: FitEstimates, row: int, name: str
) -> dict[str, Estimate]:
    """Parameters of an effect by name; those of a table have no interval."""
    result = estimates.fit
    variables = effect_variables(problem, result).get(row)
    if variables is not None:
        return effect(name).named(estimates.estimate_of_law(int(v)) for v in variables)
    slot = slots_of(problem, result.candidate).each[row]
    values = result.parts.effects[slot.parameters]
    return effect(name).named(Estimate(float(value), None, None) for value in values)


def find_preload_of_springs(problem: Problem, estimates: FitEstimates) -> set[int]:
    """Preloads about mid-stroke that a change of stiffness about the free length implies."""
    free = free_parameters(problem, estimates.fit)
    implied: set[int] = set()
    for i, preload in enumerate(free):
        for j, spring in enumerate(free):
            if (preload.kind, spring.kind) != ("preload", "stiffness"):
                continue
            if preload.strut != spring.strut:
                continue
            strut = problem.spec.struts[spring.strut]
            lever = mid_stroke_m(problem.motions[spring.strut]) - strut.free_length_m
            covariance = estimates.covariance.covariance
            weights = np.zeros(len(covariance))
            weights[i], weights[j] = preload.deviation, lever * spring.deviation
            values = estimates.fit.solution.values
            rest = float(values[i] + lever * values[j])
            variance = max(weights @ covariance @ weights, 0.0)
            half = estimates.covariance.factor * float(np.sqrt(variance))
            if abs(rest) < max(half, _NEARLY * abs(float(values[i]))):
                implied.add(i)
    return implied


class LawFound(NamedTuple):
    """A chosen law along the recordings.

    Attributes:
        force_n: Its force.
        residual_n: What is left in its strut; NaN where it is not known.
        unreached: Its edges that the motion did not reach.
    """

    strut: int
    name: str
    force_n: Array
    residual_n: Array
    parameters: dict[str, Estimate]
    unreached: tuple[UnreachedEdge, ...]


def find_laws(
    problem: Problem,
    estimates: FitEstimates,
    after: Sequence[ResidualForces | None],
    criteria: SelectionCriteria,
) -> list[LawFound]:
    """The chosen laws with their estimates."""
    fit, residuals = estimates.fit, [(k, f) for k, f in enumerate(after) if f is not None]
    tracks, values = [f.track for _, f in residuals], law_values(problem, fit)
    forces = forces_along(problem, fit.model, [(k, f.track) for k, f in residuals])
    found: list[LawFound] = []
    for row, law in enumerate(fit.candidate.new, len(fit.candidate.kept)):
        parameters = estimates_of(problem, estimates, row, law[1])
        unreached = find_unreached_edges(problem, fit, law, tracks, criteria.bounded**2)
        if unreached:
            half_m = estimates.half_of(effect_variables(problem, fit)[row], effect(law[1]).edges)
            parameters = open_parameters(law[1], values[law], half_m, unreached, parameters)
        residual_n = np.concatenate([f.force_n[law[0]] for _, f in residuals])
        found.append(LawFound(*law, forces[row][1], residual_n, parameters, unreached))
    return found
