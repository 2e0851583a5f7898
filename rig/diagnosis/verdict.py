"""The verdict on a diagnosis: what held-out data show of the chosen model."""

from collections.abc import Sequence

import numpy as np

from rig.diagnosis.outcome import Verdict
from rig.diagnosis.problem.problem import Problem, RunEvaluation, quadratic_mean
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import Fit
from rig.diagnosis.search.model_selection import SearchResult


def are_laws_superfluous(
    problem: Problem, linear: Fit, evaluations: Sequence[RunEvaluation], criteria: SelectionCriteria
) -> bool:
    """Whether all data are at the floor without any law, and laws gain nothing on held-out data.

    A gain below the effect of the applied force's noise counts as none. A law that the data call
    for may not act on held-out ones, as a stop that is not reached: these do not contradict it.
    """
    if not _is_at_floor(problem, linear, criteria):
        return False
    after = quadratic_mean([run.target.after for run in evaluations]) ** 2
    lawless = quadratic_mean([run.linear for run in evaluations]) ** 2
    floor = quadratic_mean([_floor(run) for run in evaluations]) ** 2
    drift = quadratic_mean([run.drift_m for run in evaluations]) ** 2
    least = max(criteria.least_above_noise * floor, criteria.least_share * (lawless - floor), drift)
    return lawless <= criteria.explained**2 * floor and lawless - after <= least


def _is_at_floor(problem: Problem, result: Fit, criteria: SelectionCriteria) -> bool:
    """Whether a fit's residual is noise of the recordings that were learnt from."""
    floor = problem.floor_level(result.model)
    return result.mean_square <= criteria.explained**2 * floor


def find_verdict(
    problem: Problem,
    evaluations: Sequence[RunEvaluation],
    search: SearchResult,
    criteria: SelectionCriteria,
) -> Verdict:
    """What held-out data show.

    A model explains where every held-out run is at the noise floor; it explains partly where laws
    reduce the residual of the best linear model by a good share. The error of the nominal model
    does not count. Nothing is missing only where that holds of what was learnt from, too.
    """
    chosen = search.chosen.fit
    ratios = [run.target.after / max(_floor(run), 1e-300) for run in evaluations]
    if all(ratio <= criteria.explained for ratio in ratios):
        if not (chosen.candidate.new or np.any(chosen.free)):
            at_floor = _is_at_floor(problem, chosen, criteria)
            return "nothing_missing" if at_floor else "not_explained"
        return "ambiguous" if search.rivals else "explained"
    if chosen.candidate.new and all(np.isfinite(ratios)):
        share = 1.0 - criteria.partly
        after = quadratic_mean([run.target.after for run in evaluations])
        linear = quadratic_mean([run.linear for run in evaluations])
        force = quadratic_mean([run.figures.residual_force_rmse_n.after for run in evaluations])
        linear_force = quadratic_mean([run.linear_force_n for run in evaluations])
        # Where heights drift, as those of an axis without a spring do, the force decides.
        by_force = force < share * linear_force and after < criteria.explained * linear
        if after < share * linear or by_force:
            return "partly_explained"
    return "not_explained"


def _floor(run: RunEvaluation) -> float:
    height = run.floor.height_rmse_m
    return height if np.isfinite(height) else run.floor.residual_force_rmse_n
