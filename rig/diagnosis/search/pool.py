"""Models that were fitted, and which of them is worth more than another.

Reference: Breiman, Friedman, Olshen, Stone, Classification and Regression Trees (1984), 3.4.3, the
one-standard-error rule.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.problem.problem import (
    Candidate,
    Parts,
    Problem,
    existing_values,
    free_beside,
    nominal,
)
from rig.diagnosis.search.criteria import DISSIPATING, STORING, SelectionCriteria
from rig.diagnosis.search.fit import Fit, block_scores, fit
from rig.diagnosis.search.score_test import Change, changes
from rig.diagnosis.search.screen import (
    Screening,
    Stage,
    law_and_shift,
    linear_beside,
    stage_of,
    whole_stage_of,
)
from rig.diagnosis.search.sound import tracks, unsound

Array = NDArray[np.float64]


class Effort(NamedTuple):
    """How far a fit goes.

    Attributes:
        steps: Most steps.
        gain: Relative gain below which it ends.
        sides: Sides on which its last differences are taken.
    """

    steps: int
    gain: float
    sides: int


_BEGUN = Effort(8, 1e-2, 1)
"""Fits of initial states alone."""
ROUGH = Effort(8, 1e-3, 1)
"""Fits that are compared among themselves."""
FULL = Effort(20, 1e-4, 2)
"""Fits that decide."""
FINAL = Effort(15, 1e-6, 2)
"""The fit that is reported; that of a free run once more with finer steps."""


class Scored(NamedTuple):
    """A fitted model and what it does on blocks that took no part.

    Attributes:
        fit: The model.
        scores: Out-of-sample sum of squares of each block.
    """

    fit: Fit
    scores: Array

    @property
    def score(self) -> float:
        """Out-of-sample sum of squares."""
        return float(self.scores.sum())

    @property
    def size(self) -> int:
        """Number of laws."""
        return len(self.fit.candidate.new)

    @property
    def families(self) -> tuple[str, ...]:
        """Families of its laws."""
        return tuple(sorted(effect(name).family for _, name in self.fit.candidate.new))


class Pool:
    """Models that were fitted, by their effects; of two fits of one the better is kept.

    Args:
        problem: Model and recordings.
        given: The nominal model, initial states fitted.
        seeds: Models to begin with, the best linear one first.
        criteria: What decides.
    """

    def __init__(
        self, problem: Problem, given: Fit, seeds: Sequence[Fit], criteria: SelectionCriteria
    ) -> None:
        self.problem, self.given, self.criteria = problem, given, criteria
        self.along = tracks(problem, given)
        self.fits: dict[Candidate, Scored] = {}
        self.unsound: dict[Candidate, str] = {}
        self.settled: set[Candidate] = set()
        self.floors: dict[Candidate, tuple[Scored, float]] = {}
        self.tested: dict[Candidate, tuple[Scored, tuple[Change, ...]]] = {}
        for seed in seeds:
            self.attempt(seed.candidate, seed.parts)
        base = nominal(problem)
        self.linear = self.fits.setdefault(base, self.scored(given))

    @cached_property
    def linear_stage(self) -> Stage:
        """The regression about the best linear model."""
        return stage_of(self.problem, self.linear.fit.candidate, self.linear.fit.parts)

    def look_closer(self) -> None:
        """Let the regression about the best linear model look at every sample."""
        linear = self.linear.fit
        self.linear_stage = whole_stage_of(self.problem, linear.candidate, linear.parts)

    # --- fits ---------------------------------------------------------------------------------

    def scored(self, result: Fit) -> Scored:
        """A fit with its scores."""
        return Scored(result, block_scores(self.problem, result))

    def refit(
        self, candidate: Candidate, parts: Parts, effort: Effort, most_level: float = np.inf
    ) -> Fit | None:
        """Fit a candidate with all of its linear part that may be free beside it."""
        free = free_beside(self.problem, candidate)
        parts = parts._replace(linear=np.where(free, parts.linear, 0.0))
        return fit(self.problem, candidate, parts, free, *effort, most_level=most_level)

    def attempt(
        self,
        candidate: Candidate,
        parts: Parts,
        effort: Effort = ROUGH,
        most_level: float = np.inf,
    ) -> None:
        """Fit a candidate in simulation and keep the better of this and an earlier fit."""
        result = self.refit(candidate, parts, effort, most_level)
        if effort is FULL:
            self.settled.add(candidate)
        if result is None:
            return
        scored = self.scored(result)
        if candidate in self.fits and scored.score >= self.fits[candidate].score:
            return
        self.fits[candidate] = scored
        self.unsound.pop(candidate, None)
        why = unsound(self.problem, result, self.along, self.criteria)
        if why is not None:
            self.unsound[candidate] = why

    def attempt_screened(
        self, stage: Stage, reference: Scored, screening: Screening, effort: Effort = ROUGH
    ) -> None:
        """Fit a screening's laws in simulation, from what it found along the motion.

        Args:
            stage: Where it was found.
            reference: The model that stage is about.
            screening: The laws.
            effort: How far to go.
        """
        base, known = nominal(self.problem), reference.fit
        existing = existing_values(self.problem, base)
        if known.candidate.kept == base.kept:
            existing = known.parts.effects[: len(existing)]
        values, linear = [existing], known.parts.linear + linear_beside(stage, screening)
        for at, own in sorted(
            zip(screening.laws, screening.values, strict=True), key=lambda law: law[0]
        ):
            parameters, shift = law_and_shift(at[1], own)
            values.append(parameters)
            here = [(p.strut, p.kind) == (at[0], "free_length") for p in self.problem.linear]
            linear = linear + shift * np.array(here)
        least = np.array([p.least for p in self.problem.linear])
        candidate = base.added(*screening.laws)
        parts = self._begun(candidate, np.maximum(linear, least), np.concatenate(values))
        # Priors weigh as they did there: a free run may begin far off with the right parameters.
        self.attempt(candidate, parts, effort, max(1.0, screening.cost / len(stage.target)))

    def _begun(self, candidate: Candidate, linear: Array, effects: Array) -> Parts:
        """With initial states of its own: those of a poorer model make up for what it lacks."""
        recordings = range(self.problem.recordings)
        starts = tuple(self.problem.start(k, candidate) for k in recordings)
        own, none = Parts(linear, effects, starts), np.zeros(len(linear), dtype=np.bool_)
        result = fit(self.problem, candidate, own, none, *_BEGUN, effects=False)
        return own if result is None else result.parts

    def adopt(self, result: Fit) -> None:
        """Fit the laws of a model of other recordings, beginning with what they are there."""
        parts = self._begun(result.candidate, result.parts.linear, result.parts.effects)
        self.attempt(result.candidate, parts)

    def reject(self, candidate: Candidate, why: str) -> None:
        """Leave out a set that its last fit shows to be none that an engineer would use."""
        self.unsound[candidate] = why
        self.settled.add(candidate)

    def settle(self, scored: Scored, best: Scored) -> None:
        """Fit a set to its end if it comes near the best one."""
        candidate = scored.fit.candidate
        if scored.size and self.is_near(scored, best) and candidate not in self.settled:
            self.attempt(candidate, scored.fit.parts, FULL)

    def settle_best(self) -> None:
        """Fit the sets that may be chosen to their end."""
        best = self.best()
        for scored in best:
            self.settle(scored, best[0])

    # --- what may be chosen -------------------------------------------------------------------

    def sound(self) -> Iterable[Scored]:
        """Models that an engineer would use."""
        return (s for c, s in self.fits.items() if c not in self.unsound)

    def least(self) -> Scored:
        """The best sound one."""
        return min(self.sound(), key=lambda s: s.score)

    def nearest(self) -> Scored:
        """The best one to look about: an unsound one that is far better lacks one exchange."""
        best, sound = min(self.fits.values(), key=lambda s: s.score), self.least()
        return sound if self.is_near(sound, best) else best

    def settled_least(self) -> Scored:
        """The best sound one, fitted to its end: whether it is at the floor decides on going on."""
        best = self.least()
        self.settle(best, best)
        return self.least()

    def best(self) -> tuple[Scored, ...]:
        """The best sound sets that come near the best one."""
        order = sorted((s for s in self.sound() if s.size > 0), key=lambda s: s.score)
        near = (s for s in order if self.is_near(s, order[0]))
        return tuple(near)[: self.criteria.fitted_a_size]

    def best_and_less(self) -> list[Scored]:
        """The best sets and what they hold: a smaller one may be all that can be defended."""
        best = [set(s.fit.candidate.new) for s in self.best()]
        return [
            s for s in self.sound() if s.size and any(set(s.fit.candidate.new) <= b for b in best)
        ]

    def chosen(self, most_laws: int) -> Scored:
        """The smallest set that no larger one is worth more than, of so many laws at most."""
        sets = [s for s in self.sound() if s.size <= most_laws]
        current = self.linear
        while True:
            larger = [s for s in sets if s.size > current.size and self.worth(current, s)]
            if not larger:
                return current
            least = min(s.size for s in larger)
            current = self._plainest([s for s in larger if s.size == least])

    def _plainest(self, sets: Sequence[Scored]) -> Scored:
        """Of the sets as good as the best for all the data say, that with the fewest parameters."""
        best = min(sets, key=lambda s: s.score)
        alike = [s for s in sets if self.is_alike(s, best)]
        return min(alike, key=lambda s: (len(s.fit.parts.effects), s.score))

    def changes(self, result: Scored) -> tuple[Change, ...]:
        """What a score test about a fit finds, best first."""
        candidate = result.fit.candidate
        if candidate not in self.tested or self.tested[candidate][0] is not result:
            most = self.criteria.most_laws
            self.tested[candidate] = result, changes(self.problem, result.fit, self.along, most)
        return self.tested[candidate][1]

    # --- whether one model is worth more than another -------------------------------------------

    def worth(self, smaller: Scored, larger: Scored) -> bool:
        """Whether a larger model is worth its further laws."""
        criteria, above = self.criteria, smaller.score - smaller.fit.rows
        if self.at_floor(smaller) and (larger.size > smaller.size or not smaller.size):
            return False
        if (
            larger.size > smaller.size
            and self.is_formula(smaller)
            and not _adds_a_kind(smaller, larger)
            and not self.is_right_beside(larger, smaller)
        ):
            return False
        # A law has to take its share; a better formula for one need only be better.
        share = 0.0 if larger.size == smaller.size > 0 else criteria.least_share
        gain = smaller.score - larger.score
        return (
            gain > criteria.standard_errors * _standard_error(smaller, larger)
            and gain > criteria.least_likelihood_gain
            and gain > share * above
        )

    def at_floor(self, result: Scored) -> bool:
        """Whether nothing is left that a law could be looked for in."""
        first, later = self.criteria.least_above_noise, self.criteria.least_above_noise_later
        share = later if result.size else first
        return result.score < (1.0 + share) * self.floor(result)

    def floor(self, result: Scored) -> float:
        """Sum of squares that a right model leaves: noise of the sensors, and of what drives it."""
        candidate = result.fit.candidate
        if candidate not in self.floors or self.floors[candidate][0] is not result:
            level = self.problem.floor_level(candidate, result.fit.parts)
            self.floors[candidate] = result, level * result.fit.rows
        return self.floors[candidate][1]

    def is_formula(self, result: Scored) -> bool:
        """Whether what laws leave is so little that it may be their formulas' fault."""
        linear = self.linear.score - self.linear.fit.rows
        above = result.score - result.fit.rows
        return bool(result.size) and above < self.criteria.formula**2 * linear

    def is_right_beside(self, larger: Scored, smaller: Scored) -> bool:
        """Whether a set leaves so little of what a smaller one leaves that this imitates it."""
        share = self.criteria.imitation ** (2 * (larger.size - smaller.size))
        most = share * (smaller.score - smaller.fit.rows)
        is_right = self.at_floor(larger) or larger.score - larger.fit.rows < most
        return is_right and not self.is_near(smaller, larger)

    def is_near(self, scored: Scored, best: Scored) -> bool:
        """Whether a set is not hopeless beside the best one."""
        return scored.score <= self.criteria.hopeless * best.score

    def is_alike(self, other: Scored, best: Scored) -> bool:
        """Whether the data cannot distinguish a set from the best one."""
        lost = other.score - best.score
        return lost <= self.criteria.standard_errors * _standard_error(other, best)


def _adds_a_kind(smaller: Scored, larger: Scored) -> bool:
    """Whether what dissipates is added to what stores energy, or the other way round."""
    few, many = Counter(smaller.families), Counter(larger.families)
    old, new = set(few), set(many - few)
    return few < many and (
        (old <= STORING and new <= DISSIPATING) or (old <= DISSIPATING and new <= STORING)
    )


def _standard_error(one: Scored, other: Scored) -> float:
    """Standard error of the difference of two out-of-sample sums over blocks."""
    difference = one.scores - other.scores
    return float(np.sqrt(len(difference)) * np.std(difference, ddof=1))
