"""Forward and backward search of laws: first along the motion, then about fitted models.

References:
    Miller, Subset Selection in Regression (2002), 3, forward and backward search.
    Pudil, Novovičová, Kittler, Floating search methods in feature selection, Pattern Recognition
    Letters 15 (1994): the search continues at once from what lowers the residual most.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from dart_model.effects import effect
from dart_model.effects.backlash import LIFT_OFF
from rig.diagnosis.problem.problem import Candidate, StrutEffect, nominal, strut_constants
from rig.diagnosis.progress import Progress, no_progress, within
from rig.diagnosis.search.damper_with_friction import screen_damper_with_friction
from rig.diagnosis.search.fit import law_values, model_for
from rig.diagnosis.search.pool import FULL, Pool, ValidatedModel
from rig.diagnosis.search.score_test import ModelChange
from rig.diagnosis.search.screen import (
    Screening,
    Stage,
    as_screening,
    best_of_each,
    linear_changes,
    no_law,
    rank_laws,
    refine,
    stage_of,
)
from rig.diagnosis.search.validity import find_improbable_linear_part

LawCombination = TypeVar("LawCombination", Screening, ModelChange)
_IMITATED = ("friction", "nonlinear_damping", "hysteresis")
"""Families of which one law may imitate friction together with the valves of a damper."""
_EXPLORED = 0.85
"""Share of a search's progress that its rounds take; in the rest the best models converge."""
_REST_AFTER_TURN = 0.6
"""Share of the work that is left after one more expansion: there are mostly two to four."""


_ALIKE = 2
"""Combinations of the same families that are fitted: of several formulas for one effect the second
best by a regression may be the best in simulation."""
_TIE = 1.05
"""Times the cost that the best change promises, up to which others of the same families are fitted:
a linearisation is not better than that."""
_MUCH = 0.5
"""Share of a model's cost below which a change of it promises much: an RMS of 70 %."""
_SELDOM = 0.01
"""Share of the time in which a strut has to pull for a contact to be lost in it."""


class FirstRound(NamedTuple):
    """Single laws with the linear part along the motion, best first, and no law at all."""

    nothing: Screening
    screenings: tuple[Screening, ...]


def search_along_motion(pool: Pool, progress: Progress) -> FirstRound | None:
    """Find models with laws by their forces along the measured motion.

    The result is the round of single laws, where there was one.
    """
    first = _fit_screened(pool, progress)
    pool.converge_best()
    return first


def search_about_models(pool: Pool, progress: Progress) -> None:
    """Find better models by changing laws of the best ones; along the motion if there are none."""
    if len(pool.fits) == 1:
        _fit_screened(pool, progress)
    else:
        _expand_best(pool, progress)
    known = pool.least().fit.candidate
    _try_damper_with_friction(pool)
    _try_lost_contacts(pool)
    if pool.least().fit.candidate != known:
        # Its other laws were chosen beside a damper or friction that imitated both.
        _expand_best(pool, progress)
    _try_formulas(pool)
    pool.converge_best()


def _fit_screened(pool: Pool, progress: Progress) -> FirstRound | None:
    """Screen combinations of one law, of two, ..., and fit the best of each size."""
    criteria = pool.criteria
    if pool.at_floor(pool.linear):
        return None
    first = _screen_single_laws(pool, progress)
    refined = _refined_level(pool, pool.linear_stage, pool.linear, [first.screenings])
    best = refined.probable[:1]
    if not any(_gains(pool, pool.linear_stage, first.nothing, screening) for screening in best):
        pool.take_every_sample()
        first = _screen_single_laws(pool, progress)
        refined = _refined_level(pool, pool.linear_stage, pool.linear, [first.screenings])
    stage, beam = pool.linear_stage, [first.nothing]
    levels: list[list[Screening]] = []
    for size in range(1, criteria.most_laws + 1):
        begin = _EXPLORED * (size - 1) / criteria.most_laws
        end = _EXPLORED * size / criteria.most_laws
        if levels:
            beam = _diverse(levels[-1], criteria.beam)
            rounds = _screen_rounds(pool, stage, beam, within(progress, begin, 0.5 * (begin + end)))
            refined = _refined_level(pool, stage, pool.linear, rounds)
        level = refined.probable
        if not level or not _gains(
            pool, stage, min(beam, key=lambda screening: screening.validation_cost), level[0]
        ):
            break
        chosen = _choose_for_fitting(pool, refined) + _remove_laws(pool, levels, level[:2])
        levels.append(level)
        part = within(progress, 0.5 * (begin + end), end)
        pool.attempt_screenings(stage, pool.linear, chosen, part)
        # One law may imitate two. The search beyond a pair is about it, not the linear model.
        if pool.at_floor(pool.converge_least()) or (size > 1 and pool.is_formula(pool.least())):
            break
    return first


def _try_damper_with_friction(pool: Pool) -> None:
    """Fit friction and a damper with valves instead of the best model's damper or friction."""
    best = pool.least()
    if pool.at_floor(best):
        return
    laws = best.fit.candidate.new
    imitating = [law for law in laws if effect(law[1]).family in _IMITATED]
    for strut in {strut for strut, _ in imitating}:
        others = [law for law in laws if law[0] != strut or law not in imitating]
        if len(others) + 2 > pool.criteria.most_laws:
            continue
        base = as_screening(others, law_values(pool.problem, best.fit))
        screening = screen_damper_with_friction(pool.linear_stage, base, strut)
        if screening is not None:
            pool.attempt_screening(pool.linear_stage, pool.linear, screening, FULL)


def _try_lost_contacts(pool: Pool) -> None:
    """Fit a contact that lifts off in a strut whose spring and damper would pull.

    The best linear model of such a strut is far from its spring and damper, which the law reads:
    the fit begins at those of the model.
    """
    if pool.at_floor(pool.least()):
        return
    problem = pool.problem
    constants = strut_constants(problem, np.zeros(len(problem.linear)))
    for strut in range(len(problem.motions)):
        law = (strut, LIFT_OFF.name)
        free_m, stiffness, damping = constants[strut, :3]
        pulls = [
            -stiffness * (track.heights_m[strut] - free_m)
            - damping * track.velocities_m_per_s[strut]
            < 0.0
            for _, track in pool.along
        ]
        share = float(np.mean(np.concatenate(pulls)))
        candidate = nominal(problem).with_effects(law)
        if _SELDOM < share < 1.0 and candidate not in pool.converged:
            pool.attempt_at_nominal(candidate, {law: np.array([0.0])})


def _try_formulas(pool: Pool) -> None:
    """Fit the best model with other formulas for one of its laws, until none is much better.

    Near the noise floor a wrong formula is likelier than a missing law, and linearised about the
    model the right one may not stand out: where it is more general, it promises nothing at all.
    Those that promise much come first: about a better model others promise something else.
    """
    for _ in range(2 * pool.criteria.most_laws):
        best = pool.converge_least()
        is_near = best.cost < pool.criteria.settled**2 * pool.highest_at_floor(best)
        if not (best.size and is_near) or pool.at_floor(best):
            return
        laws = best.fit.candidate.new
        exchanges = [it for it in pool.changes(best) if len(it.laws) == len(laws)]
        promising = [it for it in exchanges if it.cost < _MUCH * best.cost]
        pool.attempt_changes(promising, no_progress)
        if not pool.gains_share(pool.least(), best):
            pool.attempt_changes(exchanges, no_progress)
        if not pool.gains_share(pool.least(), best):
            return


def _screen_single_laws(pool: Pool, progress: Progress) -> FirstRound:
    nothing = no_law(pool.linear_stage)
    (screenings,) = _screen_rounds(pool, pool.linear_stage, [nothing], progress)
    return FirstRound(nothing, tuple(screenings))


def _gains(pool: Pool, stage: Stage, before: Screening, after: Screening) -> bool:
    """Whether a further law could gain enough, as far as the motion shows."""
    gain = before.validation_cost - after.validation_cost
    excess = before.validation_cost - len(stage.target)
    return gain > max(pool.criteria.least_likelihood_gain, pool.criteria.least_share * excess)


def _expand_best(pool: Pool, progress: Progress) -> None:
    """Add laws to the best model and exchange its laws; repeat with the new best one.

    A best one that is better by less than a law has to gain is not a step towards another model.
    """
    expanded: dict[Candidate, ValidatedModel] = {}
    for turn in range(2 * pool.criteria.most_laws):
        reference = pool.next_to_expand()
        if pool.at_floor(pool.converge_least()) or reference.fit.candidate in expanded:
            return
        before = [it for known, it in expanded.items() if known not in pool.invalid]
        if before and not pool.gains_share(reference, min(before, key=lambda it: it.cost)):
            return
        expanded[reference.fit.candidate] = reference
        begin, end = 1.0 - _REST_AFTER_TURN**turn, 1.0 - _REST_AFTER_TURN ** (turn + 1)
        _expand(pool, reference, within(progress, begin, end))


def _expand(pool: Pool, reference: ValidatedModel, progress: Progress) -> None:
    """Fit models with one law more than a model, or with another law for one of its laws."""
    laws = reference.fit.candidate.new
    bases = [tuple(other for other in laws if other != law) for law in laws]
    # A model that is nearly right more likely has a wrong formula than one law too few.
    is_last = pool.is_formula(reference) and len(laws) < pool.criteria.most_laws
    bases.insert(len(bases) if is_last else 0, laws)
    for i, base in enumerate(bases):
        begin, end = _EXPLORED * i / len(bases), _EXPLORED * (i + 1) / len(bases)
        part = within(progress, begin, end)
        if base:
            _expand_in_simulation(pool, reference, base, part)
        else:
            _expand_along_motion(pool, reference, part)
        is_surpassed = not pool.is_near(reference, pool.next_to_expand())
        if is_surpassed or pool.at_floor(pool.converge_least()):
            return


def _expand_along_motion(pool: Pool, reference: ValidatedModel, progress: Progress) -> None:
    """Fit single laws in the order of the regression about a model's motion."""
    stage = stage_of(pool.problem, reference.fit.model)
    rounds = _screen_rounds(pool, stage, [no_law(stage)], within(progress, 0.0, 0.5))
    level = _refined_level(pool, stage, reference, rounds)
    chosen = [s for s in _choose_for_fitting(pool, level) if s.laws != reference.fit.candidate.new]
    pool.attempt_screenings(stage, reference, chosen, within(progress, 0.5, 1.0))


def _expand_in_simulation(
    pool: Pool, reference: ValidatedModel, base: Sequence[StrutEffect], progress: Progress
) -> None:
    """Fit some laws of a model with a further or similar one, in the order of a score test."""
    candidate = nominal(pool.problem).with_effects(*base)
    if candidate != reference.fit.candidate:
        # Its first fit may have ended in a side valley, which the larger model has left.
        pool.attempt(model_for(pool.problem, reference.fit.model, candidate))
    # Laws that explain nothing alone have the linear model's tangent, which is searched already.
    if candidate not in pool.fits or not pool.prefers(pool.fits[candidate], pool.linear):
        return
    progress("screening laws", 0.0)
    model = pool.fits[candidate]
    # What a linearisation promises is wrong by a factor, too.
    hopeless = pool.criteria.hopeless**2 * pool.least().fit.solution.cost
    least = min(model.fit.solution.cost - pool.criteria.least_likelihood_gain, hopeless)
    known = {c: fitted.fit.solution.cost for c, fitted in pool.fits.items()}
    at_floor = pool.highest_at_floor(model)
    changes = [
        change
        for change in pool.changes(model)
        if change.cost < min(least, known.get(change.model.candidate, least))
        # A model that the linearisation shows at the floor lacks a better fit or formula, no law.
        and (change.unchanged > at_floor or not set(base) <= set(change.laws))
    ]
    changes = _plainest_first(changes, at_floor)
    enough = model.fit.solution.cost - pool.criteria.least_share * model.excess
    chosen = _promising(changes, candidate.new, pool.criteria.fitted_a_size, enough)
    pool.attempt_changes(chosen, within(progress, 0.5, 1.0))


def _plainest_first(changes: Sequence[ModelChange], at_floor: float) -> list[ModelChange]:
    """Changes that promise the noise floor, with the fewest parameters first; then the others.

    A linearisation cannot distinguish formulas that are all as good as the noise permits. Exchanges
    come in the order of where their fits begin.
    """

    def order(change: ModelChange) -> tuple[bool, int, float]:
        is_at_floor = change.cost < at_floor
        parameters = len(change.model.parts.effects) if is_at_floor else 0
        return not is_at_floor, parameters, change.begin

    return sorted(changes, key=order)


def _promising(
    changes: Sequence[ModelChange], laws: Sequence[StrutEffect], count: int, enough: float
) -> list[ModelChange]:
    """The best changes of a model that add a law, and those that exchange each of its laws.

    Two like laws of each are fitted, and what promises as much as the best one: a damper's formula
    is not to be left because a better one for its friction comes first. Additions that do not come
    below `enough`, what a law has to gain, promise as much as others by chance.
    """
    additions = [change for change in changes if set(laws) <= set(change.laws)]
    chosen = _diverse(additions, count)
    known = {change.laws for change in chosen}
    gaining = [it for it in additions if it.laws not in known and it.cost < enough]
    chosen += [it for it in gaining if _ties(it, chosen[0])]
    for law in laws:
        others = [change for change in changes if law not in change.laws]
        chosen += [it for i, it in enumerate(others) if i < _ALIKE or _ties(it, others[0])]
    return chosen


def _ties(change: ModelChange, best: ModelChange) -> bool:
    """Whether a change is as good as the best one where it begins, its laws of the same families.

    Additions begin at what they promise, exchanges at what leads there.
    """
    return change.begin < _TIE * best.begin and _families(change.laws) == _families(best.laws)


def _families(laws: Sequence[StrutEffect]) -> tuple[str, ...]:
    return tuple(sorted(effect(name).family for _, name in laws))


def _screen_rounds(
    pool: Pool, stage: Stage, beam: Sequence[Screening], progress: Progress
) -> list[list[Screening]]:
    """For each combination of a beam, that with one law more, best first."""
    rounds: list[list[Screening]] = []
    for i, base in enumerate(beam):
        progress("screening laws", i / len(beam))
        rounds.append(rank_laws(stage, base, pool.criteria.screened))
    return rounds


class _Level(NamedTuple):
    """Combinations of one size that were refined along the motion, best first.

    Attributes:
        probable: Those that leave the linear part where the model file admits it; all where none
            does.
        better: The best other one, if it is better than all of these.
    """

    probable: list[Screening]
    better: list[Screening]


def _refined_level(
    pool: Pool, stage: Stage, reference: ValidatedModel, rounds: Sequence[Sequence[Screening]]
) -> _Level:
    """Combinations that were refined about a reference, each at its best."""
    refined = best_of_each(
        screening for screenings in rounds for screening in screenings if screening.values
    )
    lawless, about = pool.linear.fit.parts.linear, reference.fit.parts.linear
    probable = [
        screening
        for screening in refined
        if find_improbable_linear_part(
            pool.problem,
            screening.laws,
            about + linear_changes(stage, screening),
            lawless,
            pool.criteria,
        )
        is None
    ]
    if not probable or probable[0] is refined[0]:
        return _Level(probable or refined, [])
    return _Level(probable, refined[:1])


def _remove_laws(
    pool: Pool, levels: Sequence[Sequence[Screening]], best: Sequence[Screening]
) -> list[Screening]:
    """Promising combinations that lack one law of the best and have not been screened."""
    smaller: list[Screening] = []
    for larger in best:
        if len(larger.laws) < 2:
            continue
        less = levels[len(larger.laws) - 2]
        known = {frozenset(screening.laws) for screening in less}
        for i in range(len(larger.laws)):
            laws = larger.laws[:i] + larger.laws[i + 1 :]
            if frozenset(laws) in known:
                continue
            values = larger.values[:i] + larger.values[i + 1 :]
            screening = refine(pool.linear_stage, laws, values)
            least = pool.criteria.hopeless * less[0].validation_cost
            if screening is not None and screening.validation_cost <= least:
                smaller.append(screening)
    return smaller


def _choose_for_fitting(pool: Pool, level: _Level) -> list[Screening]:
    """Combinations to be fitted; one that is not probable may lead to one that is."""
    least = pool.criteria.hopeless * min((s.validation_cost for s in level.probable), default=0.0)
    diverse = _diverse(level.probable, pool.criteria.fitted_a_size)
    return [*level.better, *(s for s in diverse if s.validation_cost <= least)]


def _diverse(level: Sequence[LawCombination], count: int) -> list[LawCombination]:
    """The best combinations, at most two of which are of the same families."""
    chosen: list[LawCombination] = []
    counts: dict[tuple[str, ...], int] = {}
    for screening in level:
        if len(chosen) >= count:
            break
        families = _families(screening.laws)
        if counts.get(families, 0) < _ALIKE:
            chosen.append(screening)
            counts[families] = counts.get(families, 0) + 1
    return chosen
