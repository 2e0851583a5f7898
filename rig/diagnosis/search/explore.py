"""Forward and backward over sets of laws: first along the motion, then about what was fitted.

References:
    Miller, Subset Selection in Regression (2002), 3, forward and backward search.
    Pudil, Novovičová, Kittler, Floating search methods in feature selection, Pattern Recognition
    Letters 15 (1994): what lowers the residual most is gone on from at once.
"""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from dart_model.effects import effect
from rig.diagnosis.problem.problem import Candidate, Placed, nominal
from rig.diagnosis.progress import Progress, within
from rig.diagnosis.search.fit import parts_for
from rig.diagnosis.search.pool import Pool, Scored
from rig.diagnosis.search.score_test import Change
from rig.diagnosis.search.screen import (
    Screening,
    Stage,
    best_of_each,
    plain,
    ranked,
    refined,
    stage_of,
)

Tried = TypeVar("Tried", Screening, Change)
_EXPLORED = 0.85
"""Share of a search's progress that its rounds take; the rest fits the best sets to their end."""


class FirstRound(NamedTuple):
    """Single laws beside the linear part, along the motion.

    Attributes:
        nothing: No law at all.
        screenings: The laws, best first.
    """

    nothing: Screening
    screenings: tuple[Screening, ...]


def explore(pool: Pool, progress: Progress) -> FirstRound | None:
    """Fit sets of laws that may be chosen, about the linear model or the best of several seeds.

    Returns:
        The first round about the linear model, where there was one.
    """
    seen = None
    if len(pool.fits) > 1:
        _about_the_best(pool, progress)
    else:
        seen = _from_nothing(pool, progress)
    pool.settle_best()
    return seen


def _from_nothing(pool: Pool, progress: Progress) -> FirstRound | None:
    """Explore sets of one law, of two, ..., and fit the best of each size."""
    criteria = pool.criteria
    if pool.at_floor(pool.linear):
        return None
    seen = _singles(pool, progress)
    best = _refined([seen.screenings])[:1]
    if not any(_gains(pool, pool.linear_stage, seen.nothing, screening) for screening in best):
        pool.look_closer()
        seen = _singles(pool, progress)
    stage, beam = pool.linear_stage, [seen.nothing]
    rounds: Sequence[Sequence[Screening]] = [seen.screenings]
    levels: list[list[Screening]] = []
    for size in range(1, criteria.most_laws + 1):
        begin = _EXPLORED * (size - 1) / criteria.most_laws
        end = _EXPLORED * size / criteria.most_laws
        if levels:
            beam = _diverse(levels[-1], criteria.beam)
            rounds = _rounds(pool, stage, beam, within(progress, begin, 0.5 * (begin + end)))
        level = _refined(rounds)
        if not level or not _gains(pool, stage, min(beam, key=_score), level[0]):
            break
        chosen = _to_be_fitted(pool, level) + _backward(pool, levels, level[:2])
        levels.append(level)
        _fit_all(pool, stage, pool.linear, chosen, within(progress, 0.5 * (begin + end), end))
        # One law may imitate two. What a pair leaves is looked for about it, not the linear model.
        if pool.at_floor(pool.settled_least()) or (size > 1 and pool.is_formula(pool.least())):
            break
    return seen


def _singles(pool: Pool, progress: Progress) -> FirstRound:
    nothing = plain(pool.linear_stage)
    (screenings,) = _rounds(pool, pool.linear_stage, [nothing], progress)
    return FirstRound(nothing, tuple(screenings))


def _gains(pool: Pool, stage: Stage, before: Screening, after: Screening) -> bool:
    """Whether a further law could be worth its while, as far as is seen along the motion."""
    gain, above = before.score - after.score, before.score - len(stage.target)
    return gain > max(pool.criteria.least_likelihood_gain, pool.criteria.least_share * above)


def _about_the_best(pool: Pool, progress: Progress) -> None:
    """Add to, and exchange laws of, the best set, then of what this finds, and so on."""
    seen: set[Candidate] = set()
    turns = 2 * pool.criteria.most_laws
    for turn in range(turns):
        reference = pool.nearest()
        if pool.at_floor(pool.settled_least()) or reference.fit.candidate in seen:
            return
        seen.add(reference.fit.candidate)
        _exchanged(pool, reference, within(progress, turn / turns, (turn + 1) / turns))


def _exchanged(pool: Pool, reference: Scored, progress: Progress) -> None:
    """Sets with one law more than a set, or with another one for one of its laws."""
    laws = reference.fit.candidate.new
    bases = [tuple(other for other in laws if other != law) for law in laws]
    # What is nearly right more likely has a wrong formula than one law too few.
    bases.insert(len(bases) if pool.is_formula(reference) else 0, laws)
    for i, base in enumerate(bases):
        begin, end = _EXPLORED * i / len(bases), _EXPLORED * (i + 1) / len(bases)
        part = within(progress, begin, end)
        if base:
            _in_simulation(pool, reference, base, part)
        else:
            _along_the_motion(pool, reference, part)
        is_left_behind = not pool.is_near(reference, pool.nearest())
        if is_left_behind or pool.at_floor(pool.settled_least()):
            return


def _along_the_motion(pool: Pool, reference: Scored, progress: Progress) -> None:
    """Single laws as the regression about a model's motion ranks them."""
    stage = stage_of(pool.problem, reference.fit.candidate, reference.fit.parts)
    rounds = _rounds(pool, stage, [plain(stage)], within(progress, 0.0, 0.5))
    level = [t for t in _refined(rounds) if t.laws != reference.fit.candidate.new]
    _fit_all(pool, stage, reference, _to_be_fitted(pool, level), within(progress, 0.5, 1.0))


def _in_simulation(
    pool: Pool, reference: Scored, base: Sequence[Placed], progress: Progress
) -> None:
    """Some laws of a set with a further or a like one, as a score test about their fit ranks."""
    candidate = nominal(pool.problem).added(*base)
    if candidate != reference.fit.candidate:
        # Its own fit may have ended in a side valley, which the larger set has left.
        pool.attempt(candidate, parts_for(pool.problem, reference.fit, candidate))
    # What explains nothing alone has the linear model's tangent, and that had its round.
    if candidate not in pool.fits or not pool.worth(pool.linear, pool.fits[candidate]):
        return
    progress("screening laws", 0.0)
    model = pool.fits[candidate]
    least = model.fit.solution.cost - pool.criteria.least_likelihood_gain
    known = {c: scored.fit.solution.cost for c, scored in pool.fits.items()}
    found = [
        change
        for change in pool.changes(model)
        if change.left < min(least, known.get(change.candidate, least))
    ]
    for change in _diverse(found, pool.criteria.fitted_a_size):
        progress(f"fitting {', '.join(name for _, name in change.laws)}", 0.5)
        pool.attempt(change.candidate, change.parts)


def _rounds(
    pool: Pool, stage: Stage, beam: Sequence[Screening], progress: Progress
) -> list[list[Screening]]:
    """For each set of a beam, that set with one law more, best first."""
    found: list[list[Screening]] = []
    for i, base in enumerate(beam):
        progress("screening laws", i / len(beam))
        found.append(ranked(stage, base, pool.criteria.screened))
    return found


def _refined(rounds: Sequence[Sequence[Screening]]) -> list[Screening]:
    """Sets that were refined along the motion, each at its best, best first."""
    return best_of_each(
        screening for screenings in rounds for screening in screenings if screening.values
    )


def _backward(
    pool: Pool, levels: Sequence[Sequence[Screening]], best: Sequence[Screening]
) -> list[Screening]:
    """The best sets less one of their laws, where that set is hopeful and has not been tried."""
    found: list[Screening] = []
    for screening in best:
        if len(screening.laws) < 2:
            continue
        less = levels[len(screening.laws) - 2]
        known = {frozenset(t.laws) for t in less}
        for i in range(len(screening.laws)):
            laws = screening.laws[:i] + screening.laws[i + 1 :]
            if frozenset(laws) in known:
                continue
            values = screening.values[:i] + screening.values[i + 1 :]
            smaller = refined(pool.linear_stage, laws, values)
            if smaller is not None and smaller.score <= pool.criteria.hopeless * less[0].score:
                found.append(smaller)
    return found


def _fit_all(
    pool: Pool, stage: Stage, reference: Scored, screenings: Sequence[Screening], progress: Progress
) -> None:
    for i, screening in enumerate(screenings):
        progress(f"fitting {', '.join(name for _, name in screening.laws)}", i / len(screenings))
        pool.attempt_screened(stage, reference, screening)


def _to_be_fitted(pool: Pool, level: Sequence[Screening]) -> list[Screening]:
    least = pool.criteria.hopeless * min((screening.score for screening in level), default=0.0)
    return [
        screening
        for screening in _diverse(level, pool.criteria.fitted_a_size)
        if screening.score <= least
    ]


def _diverse(level: Sequence[Tried], count: int) -> list[Tried]:
    """The best sets, at most two of which are of the same families."""
    chosen: list[Tried] = []
    seen: dict[tuple[str, ...], int] = {}
    for screening in level:
        if len(chosen) >= count:
            break
        families = tuple(sorted(effect(name).family for _, name in screening.laws))
        if seen.get(families, 0) < 2:
            chosen.append(screening)
            seen[families] = seen.get(families, 0) + 1
    return chosen


def _score(screening: Screening) -> float:
    return screening.score
