"""A damper whose directions differ, as its linear damping and a law of one direction.

The damping that both directions have in common may stand in the linear part or in the law; the
force is the same. Where a search held the linear part, the law contains what is wrong there: a
negative damping in both directions, say, where the model file's is too large.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.estimates import FitEstimates
from rig.diagnosis.outcome import Estimate
from rig.diagnosis.problem.problem import Parts, Problem, slots_of
from rig.diagnosis.search.fit import effect_variables

_LAW = "asymmetric_damping"

Integers = NDArray[np.int64]


class CommonDamping(NamedTuple):
    """The change of a strut's linear damping that an asymmetric law contained.

    Attributes:
        parameter: Index of the linear damping among the linear parameters.
        total: Corrected damping in N·s/m.
        change: The change in N·s/m.
    """

    parameter: int
    total: Estimate
    change: float


class Separated(NamedTuple):
    """Estimates whose asymmetric laws act in one direction, and what they contained beside."""

    estimates: FitEstimates
    common: tuple[CommonDamping, ...]


def separate_common_damping(
    problem: Problem, estimates: FitEstimates, significant: float
) -> Separated:
    """The estimates with the damping that both directions have in common in the linear part.

    That of the direction which is damped less, so that the law damps the other one more, where it
    differs from the model file's by `significant` standard deviations. A linear damping that the
    fit left free contains it already.
    """
    fit, common = estimates.fit, list[CommonDamping]()
    variables = effect_variables(problem, fit)
    for row, (strut, name) in enumerate(fit.candidate.new, len(fit.candidate.kept)):
        dampings = (
            i for i, p in enumerate(problem.linear) if (p.kind, p.strut) == ("damping", strut)
        )
        index = next(dampings, None)
        if name != _LAW or index is None or fit.free[index]:
            continue
        own = variables[row]
        less = int(own[np.argmin(fit.solution.values[own])])
        change, nominal = float(fit.solution.values[less]), problem.linear[index].nominal
        std = np.sqrt(estimates.covariance.covariance[less, less]) * fit.space.scale[less]
        if abs(change) < significant * std or nominal + change < 0.0:
            continue
        common.append(CommonDamping(index, estimates.estimate(less, nominal), change))
        slot = slots_of(problem, fit.candidate).each[row].parameters
        estimates = _without(estimates, own, less, _moved(fit.parts, index, slot, change))
        fit = estimates.fit
    return Separated(estimates, tuple(common))


def _moved(parts: Parts, index: int, law: slice, change: float) -> Parts:
    """Parts of which a change moves from a law to a linear parameter."""
    linear, effects = parts.linear.copy(), parts.effects.copy()
    linear[index] += change
    effects[law] -= change
    return parts._replace(linear=linear, effects=effects)


def _without(estimates: FitEstimates, own: Integers, less: int, parts: Parts) -> FitEstimates:
    """Estimates of a law's parameters as differences from one of them."""
    fit, scale = estimates.fit, estimates.fit.space.scale
    values = fit.solution.values.copy()
    values[own] -= values[less]
    difference = np.eye(len(values))
    difference[own, less] -= scale[less] / scale[own]
    covariance = difference @ estimates.covariance.covariance @ difference.T
    return FitEstimates(
        fit._replace(
            model=fit.model._replace(parts=parts), solution=fit.solution._replace(values=values)
        ),
        estimates.covariance._replace(covariance=covariance),
    )
