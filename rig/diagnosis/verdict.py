"""The verdict on a diagnosis: what held-out data show of the chosen model."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from dart_model.effects import CATALOGUE, effect
from rig.diagnosis.evaluate import HeldOutLaw
from rig.diagnosis.outcome import Confirmation, Verdict
from rig.diagnosis.problem.problem import (
    Problem,
    RunEvaluation,
    StrutEffect,
    quadratic_mean,
    quadratic_means,
)
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import Fit
from rig.diagnosis.search.model_selection import SearchResult
from rig.diagnosis.search.screen import reads_alone
from rig.diagnosis.search.validity import OVER_HEIGHT

_OVER_VELOCITY = ("friction", "nonlinear_damping")
"""Families whose laws shape the curve of a strut's force over its velocity."""

HeldOutLaws = Mapping[StrutEffect, HeldOutLaw]
"""What held-out data say of each law of the chosen model."""


def confirmation(law: HeldOutLaw, criteria: SelectionCriteria) -> Confirmation:
    """What held-out data show of a law."""
    if law.power < criteria.least_likelihood_gain:
        return "not_exercised"
    return "confirmed" if law.gain > 0.0 else "contradicted"


def confirmations(
    evaluations: Sequence[RunEvaluation],
    search: SearchResult,
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
) -> dict[StrutEffect, Confirmation]:
    """What held-out data show of each law of the chosen model.

    Where the model does not explain, springs, stops and play of a strut are one curve over its
    height, dry friction and damper one over its velocity: of each the law that the data need most
    is confirmed.

    Where the model is far above the noise floor, what is left is no noise, and laws fit a part of
    it whatever it is: at most the one that the data need most is confirmed. What is left may be due
    to its formula then, so that its family has to have others: a periodic force has none. Two laws
    of a strut that are functions of its height alone, or two stops, are one curve, whose parts are
    not confirmed.
    """
    found: dict[StrutEffect, Confirmation] = {
        law: confirmation(it, criteria) for law, it in laws.items()
    }
    ratio = quadratic_mean(_over_floor(evaluations))
    if ratio <= criteria.explained:
        return found
    gains = {law: it.without.log_likelihood for law, it in search.evidence.items()}
    by_need = sorted(gains, key=gains.__getitem__, reverse=True)
    if ratio <= criteria.settled:
        settled = set(found) - _further_curves(by_need)
    elif by_need and _share_of_force_left(evaluations, criteria) < criteria.leading:
        settled = {law for law in by_need[:1] if _may_be_named_alone(law, by_need)}
    else:
        settled = set[StrutEffect]()
    for law in {law for law, it in found.items() if it == "confirmed"} - settled:
        found[law] = "unsettled"
    return found


def _further_curves(by_need: Sequence[StrutEffect]) -> set[StrutEffect]:
    """Laws of struts that have another one over height, or velocity, which the data need more."""
    further = set[StrutEffect]()
    for families in (OVER_HEIGHT, _OVER_VELOCITY):
        curves = [law for law in by_need if effect(law[1]).family in families]
        struts = [strut for strut, _ in curves]
        further |= {law for i, law in enumerate(curves) if law[0] in struts[:i]}
    return further


def _may_be_named_alone(law: StrutEffect, laws: Sequence[StrutEffect]) -> bool:
    """Whether what a law leaves may be due to its formula, and it is no part of a curve."""
    return _has_other_formulas(law[1]) and not _is_part_of_curve(law, laws)


def _has_other_formulas(name: str) -> bool:
    """Whether the catalogue holds another law of a law's family."""
    families = [item.family for item in CATALOGUE.values()]
    return families.count(effect(name).family) > 1


def _is_part_of_curve(law: StrutEffect, laws: Iterable[StrutEffect]) -> bool:
    """Whether a law and another one of its strut are one curve over the height.

    Both are functions of the height alone, or both of one family, as two stops are.
    """
    family, is_curve = effect(law[1]).family, reads_alone(law[1], "height_m")
    return any(
        (family in OVER_HEIGHT and effect(it[1]).family == family)
        or (is_curve and reads_alone(it[1], "height_m"))
        for it in laws
        if it[0] == law[0] and it != law
    )


def find_reason_against_laws(
    problem: Problem,
    linear: Fit,
    evaluations: Sequence[RunEvaluation],
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
) -> str | None:
    """The reason for which laws are taken back in favour of the best linear model, if any.

    All data are at the floor without any law, and laws gain nothing on held-out data; or they lose
    there. Laws that do not act on held-out data, as a stop that is not reached, lose nothing.
    """
    if _is_at_floor(problem, linear, criteria) and _gain_nothing(evaluations, criteria):
        return "taken back: the best linear model is at the noise floor without it"
    if not any(confirmation(law, criteria) != "not_exercised" for law in laws.values()):
        return None
    errors = quadratic_means([run.target for run in evaluations])
    if errors.after < errors.linear or _explain_partly(evaluations, criteria):
        return None
    ratio = _divide(errors.after, errors.linear)
    return (
        "taken back: the error on held-out data is no less than that of the best linear model "
        f"({ratio:.3g} times)"
    )


def _gain_nothing(evaluations: Sequence[RunEvaluation], criteria: SelectionCriteria) -> bool:
    """Whether laws gain nothing on held-out data, where the linear model is at the floor.

    A gain below the effect of the applied force's noise counts as none.
    """
    errors = quadratic_means([run.target for run in evaluations])
    lawless = errors.linear**2
    floor = quadratic_mean([run.target_floor for run in evaluations]) ** 2
    drift = quadratic_mean([run.drift_m for run in evaluations]) ** 2
    least = max(criteria.least_above_noise * floor, criteria.least_share * (lawless - floor), drift)
    return lawless <= criteria.explained**2 * floor and lawless - errors.after**2 <= least


def _is_at_floor(problem: Problem, result: Fit, criteria: SelectionCriteria) -> bool:
    """Whether a fit's residual is noise of the recordings that were learnt from."""
    floor = problem.floor_level(result.model)
    return result.mean_square <= criteria.explained**2 * floor


def _explain_partly(evaluations: Sequence[RunEvaluation], criteria: SelectionCriteria) -> bool:
    """Whether laws reduce the error of the best linear model by a good share."""
    return _share_left(evaluations, criteria) < 1.0 - criteria.partly


def _share_left(evaluations: Sequence[RunEvaluation], criteria: SelectionCriteria) -> float:
    """Share of the best linear model's error that is left.

    Where heights drift, as those of an axis without a spring do, the force decides, heights being
    about as good.
    """
    errors = quadratic_means([run.target for run in evaluations])
    share = _divide(errors.after, errors.linear)
    if share >= criteria.explained:
        return share
    return min(share, _force_ratio(evaluations))


def _share_of_force_left(
    evaluations: Sequence[RunEvaluation], criteria: SelectionCriteria
) -> float:
    """Share of the best linear model's residual force that is left.

    Of the error where that is larger than the linear model's, or no force is known. Laws that stand
    in for another fit heights, which are smooth, rather than the force.
    """
    left, force = _share_left(evaluations, criteria), _force_ratio(evaluations)
    return left if left >= criteria.explained or np.isnan(force) else force


def _force_ratio(evaluations: Sequence[RunEvaluation]) -> float:
    """Residual force of the chosen model over that of the best linear one."""
    force = quadratic_means([run.figures.residual_force_rmse_n for run in evaluations])
    return _divide(force.after, force.linear)


def _over_floor(evaluations: Sequence[RunEvaluation]) -> list[float]:
    """Error of the chosen model over its noise floor, of each run."""
    return [_divide(run.target.after, run.target_floor) for run in evaluations]


def _divide(error: float, reference: float) -> float:
    return error / max(reference, 1e-300)


def find_verdict(
    problem: Problem,
    evaluations: Sequence[RunEvaluation],
    search: SearchResult,
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
) -> Verdict:
    """What held-out data show.

    A model explains where every held-out run is at the noise floor; it explains partly where laws
    reduce the residual of the best linear model by a good share. The error of the nominal model
    does not count. Nothing is missing only where that holds of what was learnt from, too. It is
    ambiguous where rivals explain as well, or held-out data confirm none of its laws.
    """
    chosen = search.chosen.fit
    ratios = _over_floor(evaluations)
    if all(ratio <= criteria.explained for ratio in ratios):
        if not (chosen.candidate.new or np.any(chosen.free)):
            at_floor = _is_at_floor(problem, chosen, criteria)
            return "nothing_missing" if at_floor else "not_explained"
        is_any_confirmed = any(confirmation(law, criteria) == "confirmed" for law in laws.values())
        is_certain = not search.rivals and (is_any_confirmed or not laws)
        return "explained" if is_certain else "ambiguous"
    is_finite = all(np.isfinite(ratios))
    if chosen.candidate.new and is_finite and _explain_partly(evaluations, criteria):
        return "partly_explained"
    return "not_explained"
