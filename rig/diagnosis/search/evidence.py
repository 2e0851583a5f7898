"""How much better data that were left out of a fit are described with a law than without it.

References:
    Stone, Cross-validatory choice and assessment of statistical predictions, J. R. Stat. Soc. B 36
    (1974).
    Miller, Simultaneous Statistical Inference (1981), 1.2, Bonferroni's bound: the best of many
    laws gains by chance what one of them would at the level over their number.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dart_model.effects import effect
from rig.diagnosis.outcome import Estimate, LikelihoodGain
from rig.diagnosis.problem.problem import StrutEffect
from rig.diagnosis.search.fit import model_for
from rig.diagnosis.search.pool import Pool, ValidatedModel, error_ratio
from rig.diagnosis.search.screen import candidate_laws


class LeftOutGains(NamedTuple):
    """Gains by a law: over the best model of the others, and over the best without its family.

    Attributes:
        is_better: Whether one law alone gains less by chance, at the level of the criteria.
    """

    without: LikelihoodGain
    rival: LikelihoodGain | None
    is_better: bool = True

    @property
    def is_by_chance(self) -> bool:
        """Whether the best of all laws gains as much by chance, at the level of the criteria."""
        low = self.without.error_ratio.low
        return low is None or low <= 1.0


def weigh_laws(
    pool: Pool, first: Pool, single: Sequence[StrutEffect], chosen: ValidatedModel
) -> dict[StrutEffect, LeftOutGains]:
    """The gains by each law of a model; models that it takes and that were not fitted yet are.

    `first` are models of a search about the linear one, and `single` are its single laws, best
    along the motion first.
    """
    return {law: _weigh(pool, first, single, chosen, law) for law in chosen.fit.candidate.new}


def are_by_chance(
    pool: Pool, chosen: ValidatedModel, evidence: Mapping[StrutEffect, LeftOutGains]
) -> bool:
    """Whether chance gains as much as one of a model's laws.

    Beyond some times the noise floor no law is named but the one that the data need most: the
    others are candidates, which predict better, but for one by itself that does so by chance.
    """
    gains = sorted(evidence.values(), key=lambda it: it.without.log_likelihood, reverse=True)
    if chosen.cost <= pool.criteria.settled**2 * pool.floor(chosen):
        return any(it.is_by_chance for it in gains)
    return any(it.is_by_chance for it in gains[:1]) or not all(it.is_better for it in gains)


def _weigh(
    pool: Pool,
    first: Pool,
    single: Sequence[StrutEffect],
    chosen: ValidatedModel,
    law: StrutEffect,
) -> LeftOutGains:
    less = chosen.fit.candidate.without(law)
    if less not in pool.fits:
        pool.attempt(model_for(pool.problem, chosen.fit.model, less))
    kept = set(less.new)
    subsets = [m for m in pool.fits.values() if set(m.fit.candidate.new) <= kept]
    earlier = _nearest_rival(first, chosen, law)
    if earlier is not None and earlier.fit.candidate not in pool.fits:
        pool.adopt([earlier.fit])
    elif earlier is None and chosen.size == 1:
        others = (at for at in single if _family(at) != _family(law))
        if (next_best := next(others, None)) is not None:
            pool.screen_and_attempt([next_best])
    rival = _nearest_rival(pool, chosen, law)
    if rival is not None:
        pool.converge(rival, chosen)
        rival = _nearest_rival(pool, chosen, law)
    least, level = min(subsets, key=lambda model: model.cost), pool.criteria.level
    return LeftOutGains(
        _gain(chosen, least, level / len(candidate_laws(pool.problem))),
        None if rival is None else _gain(chosen, rival, level),
        error_ratio(least, chosen, level).low > 1.0,
    )


def _nearest_rival(pool: Pool, chosen: ValidatedModel, law: StrutEffect) -> ValidatedModel | None:
    """The best model that has other laws, and none of a law's family in its strut."""
    others = set(chosen.fit.candidate.new) - {law}
    rivals = (
        model
        for model in pool.valid()
        if 0 < model.size <= chosen.size
        and not set(model.fit.candidate.new) <= others
        and _family(law) not in map(_family, model.fit.candidate.new)
    )
    return min(rivals, key=lambda model: model.cost, default=None)


def _family(law: StrutEffect) -> StrutEffect:
    """Strut and family of a law."""
    return law[0], effect(law[1]).family


def _gain(chosen: ValidatedModel, other: ValidatedModel, level: float) -> LikelihoodGain:
    variance = max(1.0, chosen.cost / chosen.fit.rows)
    return LikelihoodGain(
        tuple(name for _, name in other.fit.candidate.new),
        0.5 * (other.cost - chosen.cost) / variance,
        Estimate(*error_ratio(other, chosen, level)),
    )
