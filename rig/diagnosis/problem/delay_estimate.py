"""First estimates of the channels' delays, without a law of any strut."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.numerics.delay_step import DelayStep, ForceOverTime, delay_step
from rig.diagnosis.problem.channel_delays import LONGEST_S
from rig.diagnosis.problem.problem import (
    CandidateModel,
    LinearParameter,
    Problem,
    first_starts,
    nominal,
    nominal_model,
)
from rig.diagnosis.problem.track import strut_forces

Array = NDArray[np.float64]

_ITERATIONS = 6
_STEP_S = 0.5e-3
"""Step of the derivative by a delay, or the time between samples, if that is longer."""
_SIGNIFICANT = 4.0
"""Standard deviations from which on an estimate is where the search begins, instead of zero."""
_WIDTH, _LEAST_WIDTH_S = 5.0, 0.5e-3
"""Standard deviations about an estimate, and least time, within which a delay is searched for: the
functions of the estimate bend less than a stop, whose contact it takes for 0.3 ms."""
_MARGIN = 5
"""Nodes at either end of a recording where the smoothed motion is not used."""
_MOST_SAMPLES = 40_000
"""Samples of all recordings that are taken."""


class DelayEstimate(NamedTuple):
    """Delays in s and their standard deviations, infinite where the recordings show none."""

    delays_s: Array
    stds_s: Array


def estimate_delays(problem: Problem) -> DelayEstimate:
    """The delays among a problem's linear parameters, in their order."""
    which = [i for i, p in enumerate(problem.linear) if p.kind == "delay"]
    delays_s, stds_s = np.zeros(len(which)), np.full(len(which), np.inf)
    for _ in range(_ITERATIONS):
        step = _step(problem, which, delays_s)
        if step is None:
            break
        stds_s = step.stds_s
        before_s, delays_s = delays_s, np.clip(delays_s + step.steps_s, -LONGEST_S, LONGEST_S)
        if np.all(np.abs(delays_s - before_s) < 0.1 * stds_s):
            break
    return DelayEstimate(delays_s, stds_s)


def _step(problem: Problem, which: Sequence[int], delays_s: Array) -> DelayStep | None:
    """A step of Gauss and Newton from some delays; None where the model runs away."""
    difference_s = max(_STEP_S, *(grid.step_s for grid in problem.grids))
    unknown_s = float(np.abs(delays_s).max(initial=0.0)) + difference_s
    here = _forces(problem, which, delays_s, unknown_s)
    if here is None:
        return None
    slopes: list[Array] = []
    for i in range(len(which)):
        moved = np.eye(len(which))[i] * difference_s
        ends = [_forces(problem, which, delays_s + sign * moved, unknown_s) for sign in (1.0, -1.0)]
        if ends[0] is None or ends[1] is None:
            return None
        slopes.append((ends[0].force_n - ends[1].force_n) / (2.0 * difference_s))
    struts = [
        ForceOverTime(
            here.height_m[s][known],
            here.velocity_m_per_s[s][known],
            here.force_n[s][known],
            np.column_stack([slope[s][known] for slope in slopes]),
            here.further[known],
        )
        for s in range(len(here.height_m))
        if (known := np.isfinite(here.force_n[s]) & np.isfinite(slopes[0][s])).any()
    ]
    return delay_step(struts) if struts else None


class _Forces(NamedTuple):
    """Forces along all recordings, each (struts, N), and `further` (N, signals)."""

    height_m: Array
    velocity_m_per_s: Array
    force_n: Array
    further: Array


def _forces(
    problem: Problem, which: Sequence[int], delays_s: Array, unknown_s: float
) -> _Forces | None:
    """The force that the motion takes in each strut, the channels being so late.

    What lies within `unknown_s` of a recording's ends is left out.
    """
    base = nominal_model(problem, first_starts(problem, nominal(problem)))
    linear = base.parts.linear.copy()
    linear[list(which)] = delays_s
    model = CandidateModel(base.candidate, base.parts._replace(linear=linear))
    nodes = sum(len(grid.t_s) for grid in problem.grids)
    stride = max(1, nodes // _MOST_SAMPLES)
    parts: list[_Forces] = []
    for k in range(problem.recordings):
        residual = problem.residual_forces(k, model)
        if residual is None:
            return None
        along = residual.track
        law = strut_forces(problem, model, along, problem.states(k, model))
        # A mass that is not quite known makes a force in proportion to its acceleration.
        accelerations = np.gradient(along.velocities_m_per_s, along.t_s, axis=1)
        further = (
            accelerations.T if problem.bench == "force_given" else np.zeros((len(along.t_s), 0))
        )
        margin = _MARGIN + int(np.ceil(unknown_s / problem.grids[k].step_s))
        used = slice(margin, -margin, stride)
        parts.append(
            _Forces(
                along.heights_m[:, used],
                along.velocities_m_per_s[:, used],
                (residual.force_n + law)[:, used],
                further[used],
            )
        )
    return _Forces(
        np.concatenate([part.height_m for part in parts], axis=1),
        np.concatenate([part.velocity_m_per_s for part in parts], axis=1),
        np.concatenate([part.force_n for part in parts], axis=1),
        np.concatenate([part.further for part in parts]),
    )


def with_estimated_delays(problem: Problem) -> Problem:
    """The problem whose delays are searched about first estimates of them."""
    found = estimate_delays(problem)
    estimates = iter(zip(found.delays_s.tolist(), found.stds_s.tolist(), strict=True))
    linear = [
        _about(item, *next(estimates)) if item.kind == "delay" else item for item in problem.linear
    ]
    return replace(problem, linear=tuple(linear))


def _about(parameter: LinearParameter, delay_s: float, std_s: float) -> LinearParameter:
    """A delay that is searched for about an estimate, of which the recordings know the error."""
    if not np.isfinite(std_s):
        return parameter
    expected_s = delay_s if abs(delay_s) > _SIGNIFICANT * std_s else 0.0
    width_s = max(_WIDTH * std_s, _LEAST_WIDTH_S)
    return parameter._replace(
        expected=expected_s, least=expected_s - width_s, most=expected_s + width_s
    )
