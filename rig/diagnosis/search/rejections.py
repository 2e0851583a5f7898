"""Laws that were not chosen: what each leaves of the residual, and one reason that agrees."""

from collections.abc import Sequence

import numpy as np

from dart_model.effects import effect
from rig.diagnosis.outcome import RejectedEffect
from rig.diagnosis.problem.problem import StrutEffect, nominal
from rig.diagnosis.search.explore import FirstRound
from rig.diagnosis.search.pool import Pool, ValidatedModel, standard_error
from rig.diagnosis.search.screen import Screening

_NEAR = 1.1
"""Ratio of two residuals up to which it is stated with a further digit."""
_SAME = 1.0005
"""Ratio up to which two residuals are the same."""
_TIED = "these data cannot distinguish it from the chosen model"


def residual_left(pool: Pool, model: ValidatedModel) -> float:
    """RMS residual of a model, out of sample, as a share of that of the best linear model."""
    return min(float(np.sqrt(model.cost / max(pool.linear.cost, 1e-300))), 1.0)


def list_rejections(
    pool: Pool,
    first: Pool,
    first_round: FirstRound,
    chosen: ValidatedModel,
    rivals: Sequence[ValidatedModel],
) -> tuple[RejectedEffect, ...]:
    """Laws that were not chosen, best first; `first` are models of the search about no law."""
    screenings, laws = first_round.screenings, set(chosen.fit.candidate.new)
    tied = {law for rival in rivals for law in rival.fit.candidate.new}
    # What is not believed itself is no reason against another law.
    believed = (s for s in screenings if not _is_defective(pool, first, s.laws[-1]))
    best = min(believed, key=lambda screening: screening.share, default=None)
    rejected: dict[StrutEffect, RejectedEffect] = {}
    for screening in screenings:
        law = screening.laws[-1]
        if law in laws or law in rejected:
            continue
        source = _fitted_in(pool, first, chosen, law)
        if source is None:
            left, why = _along_motion(screening, best)
        else:
            left, why = _in_simulation(pool, source, chosen, law)
        (strut, name), spec = law, pool.problem.spec
        rejected[law] = RejectedEffect(
            effect(name).family,
            name,
            spec.struts[strut].name,
            _TIED if law in tied else why,
            left,
        )
    return tuple(sorted(rejected.values(), key=lambda item: item.left or 0.0))


def _is_defective(pool: Pool, first: Pool, law: StrutEffect) -> bool:
    candidate = nominal(pool.problem).with_effects(law)
    return candidate in pool.invalid or candidate in first.invalid


def _fitted_in(pool: Pool, first: Pool, chosen: ValidatedModel, law: StrutEffect) -> Pool | None:
    """The models among which a law alone was fitted in simulation.

    One that seems as good as the chosen model, which the first search cannot tell, is fitted again.
    """
    candidate = nominal(pool.problem).with_effects(law)
    if candidate in pool.fits or candidate not in first.fits:
        return pool if candidate in pool.fits else None
    model = first.fits[candidate]
    if candidate in first.invalid or residual_left(first, model) > residual_left(pool, chosen):
        return first
    pool.adopt([model.fit])
    return pool if candidate in pool.fits else first


def _in_simulation(
    pool: Pool, source: Pool, chosen: ValidatedModel, law: StrutEffect
) -> tuple[float, str]:
    candidate = nominal(pool.problem).with_effects(law)
    model = source.fits[candidate]
    left, least = residual_left(source, model), residual_left(pool, chosen)
    if candidate in source.invalid:
        return left, source.invalid[candidate]
    if not chosen.size:
        if pool.at_floor(chosen):
            return left, "without any law the residual is at the noise floor"
        return left, _too_little(source, model)
    ratio = f"{left / least:.3f}" if left < _NEAR * least else f"{left / least:.3g}"
    is_plainer = len(model.fit.parts.effects) <= len(chosen.fit.parts.effects)
    more = "" if is_plainer else ", with more parameters"
    if left < least / _SAME:
        return left, (
            f"its residual is {ratio} times that of the chosen model, which differs by no more "
            f"than chance{more}"
        )
    if left < _SAME * least:
        return left, f"it fits no better{more}"
    alone = "alone, " if chosen.size > 1 else ""
    return left, f"{alone}its residual is {ratio} times that of the chosen model"


def _too_little(pool: Pool, model: ValidatedModel) -> str:
    """What a law alone takes off the mean square residual of the linear model, and has to."""
    gain = pool.linear.cost - model.cost
    if gain <= 0.0:
        return "it does not reduce the residual of the linear model"
    share = gain / max(pool.linear.cost, 1e-300)
    scatter = standard_error(model, pool.linear) / max(pool.linear.cost, 1e-300)
    text = f"it takes {100.0 * share:.3g} % off the linear model's mean square residual"
    if share <= pool.criteria.standard_errors * scatter:
        return f"{text}, which scatters by {100.0 * scatter:.3g} % between parts of the recordings"
    if not pool.gains_share(model, pool.linear):
        return f"{text}; a law has to take {100.0 * pool.criteria.least_share:.3g} % off"
    return text


def _along_motion(screening: Screening, best: Screening | None) -> tuple[float, str]:
    left = min(float(np.sqrt(max(screening.share, 0.0))), 1.0)
    if best is None or best.share >= screening.share:
        return left, "along the motion it reduces the residual too little to be fitted"
    words, least = effect(best.laws[-1][1]).words, float(np.sqrt(max(best.share, 0.0)))
    return left, f"along the motion {words} leaves less: {100.0 * least:.3g} %"
