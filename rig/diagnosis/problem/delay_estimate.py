"""First estimates of the channels' delays, without a law of any strut."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.numerics.delay_step import DelayStep, ForceOverTime, delay_step
from rig.diagnosis.problem.channel_delays import LONGEST_S, SIGNIFICANT, is_undetermined
from rig.diagnosis.problem.problem import (
    LinearParameter,
    Problem,
    first_starts,
    nominal,
    nominal_model,
)

Array = NDArray[np.float64]

_ITERATIONS = 6
"""Most steps; the fit that follows searches about what they reach."""
_WIDTH = 5.0
"""Standard deviations about an estimate within which a delay is searched for."""
LEAST_WIDTH_S = 1e-3
"""Least time for which that is, and least delay that counts where no model explains the data: the
functions of the estimate bend less than a stop, whose contact they take for 0.1 ms; a tone was
taken for 0.8 ms, a damper that warms up for 0.5 ms; on a car's posts a delay that all channels of
one corner have in common was estimated with errors of 0.6 ms."""
_VAGUE_S = 0.05e-3
"""Standard deviation from which on an estimate is vague: of heights that are late by 8 ms or not at
all (45 benches with one effect), those with less err by up to 0.05 ms, and those with more by up to
15 ms (friction, tones, hung masses)."""
_AT_END = 0.01
"""Share of the width from an end up to which a fitted delay is at it."""
_MARGIN_S = 0.01
"""Time at either end of a recording where the smoothed motion is not used."""
_MOST_SAMPLES = 40_000
"""Samples of all recordings that are taken."""


def with_estimated_delays(problem: Problem) -> Problem:
    """The problem whose delays are searched about first estimates of them."""
    found = estimate_delays(problem)
    linear = tuple(
        _about(p, *found[p.channel]) if p.channel in found else p for p in problem.linear
    )
    return replace(problem, linear=linear)


def search_delays_beyond(problem: Problem, linear: Array) -> Problem:
    """The problem whose delays are searched as far again beyond an end at which a fit left them.

    Before a tone is known, or a stop, the first estimate may be off by more than its width: a tone
    made 10.6 ms of 9.4. `linear` are the fit's corrections, shape (L,).
    """
    beyond: list[LinearParameter] = []
    for p, value in zip(problem.linear, linear.tolist(), strict=True):
        width_s, least, most = p.most - p.least, p.least, p.most
        if p.kind == "delay" and not is_undetermined(p):
            least -= width_s * (value - least < _AT_END * width_s)
            most += width_s * (most - value < _AT_END * width_s)
        beyond.append(p._replace(least=least, most=most))
    return replace(problem, linear=tuple(beyond))


def estimate_delays(problem: Problem) -> dict[str, tuple[float, float]]:
    """First estimates of the delays that the recordings determine, by their channels.

    Each is an estimate and its standard deviation in s.
    """
    which = [i for i, p in enumerate(problem.linear) if p.kind == "delay"]
    delays_s, stds_s = np.zeros(len(which)), np.full(len(which), np.inf)
    for _ in range(_ITERATIONS if which else 0):
        step = _step(problem, which, delays_s)
        if step is None:
            break
        stds_s = step.stds_s
        before_s, delays_s = delays_s, np.clip(delays_s + step.steps_s, -LONGEST_S, LONGEST_S)
        if np.all(np.abs(delays_s - before_s) < 0.1 * stds_s):
            break
    estimates = zip(which, delays_s.tolist(), stds_s.tolist(), strict=True)
    return {problem.linear[i].channel: (d, std) for i, d, std in estimates if np.isfinite(std)}


def _about(parameter: LinearParameter, delay_s: float, std_s: float) -> LinearParameter:
    """A delay that is searched for from an estimate on, of which the recordings know the error.

    About a vague estimate zero remains possible, and what usual channels add to it: no more than
    four deviations of the prior.
    """
    expected_s = delay_s if abs(delay_s) > SIGNIFICANT * std_s else 0.0
    width_s = max(_WIDTH * std_s, LEAST_WIDTH_S)
    least, most = expected_s - width_s, expected_s + width_s
    if std_s > _VAGUE_S:
        farthest_s = SIGNIFICANT * parameter.deviation
        least = max(min(least, -LEAST_WIDTH_S), min(expected_s, 0.0) - farthest_s)
        most = min(max(most, LEAST_WIDTH_S), max(expected_s, 0.0) + farthest_s)
    return parameter._replace(expected=expected_s, least=least, most=most)


def _step(problem: Problem, which: Sequence[int], delays_s: Array) -> DelayStep | None:
    """A step of Gauss and Newton from some delays; None where the model runs away."""
    base = nominal_model(problem, first_starts(problem, nominal(problem)))
    linear = base.parts.linear.copy()
    linear[list(which)] = delays_s
    model = base.with_linear(linear)
    stride = max(1, sum(len(grid.t_s) for grid in problem.grids) // _MOST_SAMPLES)
    recordings: list[Sequence[ForceOverTime]] = []
    for k, grid in enumerate(problem.grids):
        forces = problem.forces_over_time(k, model, which)
        if forces is None:
            return None
        left_out_s = _MARGIN_S + float(np.abs(delays_s).max(initial=0.0))
        inner = (grid.t_s > grid.t_s[0] + left_out_s) & (grid.t_s < grid.t_s[-1] - left_out_s)
        used = np.flatnonzero(inner)[::stride]
        recordings.append([ForceOverTime(*(part[used] for part in force)) for force in forces])
    struts = [
        ForceOverTime(*(np.concatenate(parts) for parts in zip(*of_strut, strict=True)))
        for of_strut in zip(*recordings, strict=True)
    ]
    return delay_step(struts)
