"""Which laws are missing: forward and backward over a beam, decided on blocks that took no part.

References:
    Breiman, Friedman, Olshen, Stone, Classification and Regression Trees (1984), 3.4.3, the
    one-standard-error rule.
    Miller, Subset Selection in Regression (2002), 3, forward and backward search.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.problem.contract import (
    Candidate,
    Parts,
    Placed,
    Problem,
    existing_values,
    free_beside,
    nominal,
    slots_of,
)
from rig.diagnosis.search.criteria import KINDS, SelectionCriteria
from rig.diagnosis.search.fit import Fit, block_scores, fit, spread
from rig.diagnosis.search.screen import (
    Stage,
    Trial,
    law_and_shift,
    linear_beside,
    plain,
    proposed,
    ranked,
    refined,
    stage_of,
)
from rig.diagnosis.search.sound import tracks, unsound

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Progress = Callable[[str, float], None]


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


_BEGUN, _ROUGH = Effort(8, 1e-2, 1), Effort(8, 1e-3, 1)
_FULL, _FINAL = Effort(20, 1e-4, 2), Effort(15, 1e-6, 2)
"""Fits of initial states alone, fits that are compared among themselves, fits that decide, and the
one that is reported."""


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


class Rejected(NamedTuple):
    """A law that was not chosen.

    Attributes:
        placed: The law.
        why: One line.
        left: Residual with it beside the linear part along the motion, as a share of the residual
            of the linear part alone.
    """

    placed: Placed
    why: str
    left: float | None


class Found(NamedTuple):
    """What a search found.

    Attributes:
        given: The nominal model, only initial states fitted.
        linear: The best linear model.
        plain: The same with those corrections alone that the data call for.
        chosen: The model that was chosen.
        rivals: Models with other families that the data cannot tell from it.
        superfluous: Existing effects, by index, without which the data are as well described.
        rejected: Laws that were not chosen, best first.
        gain_alike: Whether mass, stiffness and damping changed in one proportion, as they would by
            a change of the applied force's gain.
    """

    given: Fit
    linear: Scored
    plain: Scored
    chosen: Scored
    rivals: tuple[Scored, ...]
    superfluous: tuple[int, ...]
    rejected: tuple[Rejected, ...]
    gain_alike: bool


class Seed(NamedTuple):
    """A model to begin with.

    Attributes:
        candidate: Its effects.
        parts: Its parameters and initial vectors.
    """

    candidate: Candidate
    parts: Parts


class Search:
    """A search for what a nominal model lacks.

    Args:
        problem: Model and recordings.
        given: The nominal model, initial states fitted.
        seeds: Models to begin with, the best linear one first. With others beside it the search
            goes on from the best of them.
        criteria: What decides.
        progress: Told what is being done and the share that is done.
    """

    def __init__(
        self,
        problem: Problem,
        given: Fit,
        seeds: Sequence[Seed],
        criteria: SelectionCriteria,
        progress: Progress,
    ) -> None:
        self.problem, self.given, self.criteria, self.progress = problem, given, criteria, progress
        self.along = tracks(problem, given)
        self.fits: dict[Candidate, Scored] = {}
        self.unsound: dict[Candidate, str] = {}
        self.settled: set[Candidate] = set()
        for seed in seeds:
            self._try(seed.candidate, seed.parts)
        base = nominal(problem)
        self.linear = self.fits[base] if base in self.fits else self._scored(given)
        self.fits[base] = self.linear
        self.first_round: list[Trial] = []
        self.nothing: Trial | None = None
        self.linear_stage: Stage | None = None

    def explore(self) -> None:
        """Fit sets of laws that may be chosen, about the linear model or the best seed."""
        if len(self.fits) > 1:
            self._about_the_best()
        else:
            self._from_nothing()
        best = self.best()
        for scored in best:
            self._settle(scored, best[0])

    def found(self, first: "Search") -> Found:
        """What was found, once explored.

        Args:
            first: The search about the linear model, for what was not chosen.
        """
        chosen = self._without_needless(self.chosen())
        self.progress("comparing rivals", 0.85)
        rivals = self._rivals(chosen)
        superfluous = self._superfluous(chosen)
        chosen, alike = self._with_few_linear(chosen)
        plain_model = self._with_few_linear(self.linear)[0] if chosen.size else chosen
        rejected = first.rejected(chosen, rivals)
        return Found(
            self.given, self.linear, plain_model, chosen, rivals, superfluous, rejected, alike
        )

    def _scored(self, result: Fit) -> Scored:
        return Scored(result, block_scores(self.problem, result))

    # --- whether one model is worth more than another ---------------------------------------------

    def _worth(self, smaller: Scored, larger: Scored) -> bool:
        """Whether a larger model is worth its further laws."""
        criteria, above = self.criteria, smaller.score - smaller.fit.rows
        if self._at_floor(smaller) and (larger.size > smaller.size or not smaller.size):
            return False
        if (
            larger.size > smaller.size
            and self._is_formula(smaller)
            and not _adds_a_kind(smaller, larger)
        ):
            return False
        gain = smaller.score - larger.score
        return (
            gain > criteria.standard_errors * _standard_error(smaller, larger)
            and gain > criteria.least_likelihood_gain
            and gain > criteria.least_share * above
        )

    def _at_floor(self, result: Scored) -> bool:
        """Whether nothing is left that a law could be looked for in."""
        first, later = self.criteria.least_above_noise, self.criteria.least_above_noise_later
        share = later if result.size else first
        return result.score - result.fit.rows < share * result.fit.rows

    def _is_formula(self, result: Scored) -> bool:
        """Whether what laws leave is so little that it may be their formulas' fault."""
        linear = self.linear.score - self.linear.fit.rows
        above = result.score - result.fit.rows
        return bool(result.size) and above < self.criteria.formula**2 * linear

    # --- the search ---------------------------------------------------------------------------

    def _from_nothing(self) -> None:
        """Explore sets of one law, of two, ..., and fit the best of each size in full."""
        reference = self.linear
        if self._at_floor(reference):
            return
        stage = self._linear_stage()
        self.nothing = plain(stage)
        beam, most = [self.nothing], self.criteria.most_laws
        levels: list[list[Trial]] = []
        for size in range(1, most + 1):
            begin, end = 0.85 * (size - 1) / most, 0.85 * size / most
            level = self._next_level(stage, beam, begin, 0.5 * (begin + end))
            if not level:
                return
            finalists = self._finalists(level)
            finalists += self._backward(stage, levels, level[:2])
            levels.append(level)
            self._fit_all(stage, reference, finalists, 0.5 * (begin + end), end)
            before = min(beam, key=_score).score
            if self._at_floor(self._settled_best()):
                return
            if before - level[0].score < self.criteria.least_likelihood_gain:
                return
            if self._is_formula(self._least()):
                return  # Nearly right: what is left is looked for about it, not the linear model.
            beam = _diverse(level, self.criteria.beam)

    def _about_the_best(self) -> None:
        """Add to, and exchange laws of, the best set: its free run is near the measurement."""
        reference = self._least()
        if self._at_floor(reference):
            return
        stage = stage_of(self.problem, reference.fit.candidate, reference.fit.parts)
        self.nothing = self.nothing or plain(stage)
        values = _values(self.problem, reference.fit)
        laws = reference.fit.candidate.new
        bases = [tuple(other for other in laws if other != law) for law in laws]
        if len(laws) < self.criteria.most_laws:
            # What is nearly right more likely has a wrong formula than one law too few.
            bases.insert(len(bases) if self._is_formula(reference) else 0, laws)
        for i, base in enumerate(bases):
            trial = Trial(base, tuple(values[law] for law in base), 0.0, np.zeros(1))
            begin, end = 0.85 * i / len(bases), 0.85 * (i + 1) / len(bases)
            level = self._next_level(stage, [trial], begin, 0.5 * (begin + end))
            finalists = self._finalists(level)
            self._fit_all(stage, reference, finalists, 0.5 * (begin + end), end)
            if self._at_floor(self._settled_best()):
                return

    def _fit_all(
        self, stage: Stage, reference: Scored, trials: Sequence[Trial], begin: float, end: float
    ) -> None:
        for i, trial in enumerate(trials):
            names = ", ".join(name for _, name in trial.laws)
            self.progress(f"fitting {names}", begin + (end - begin) * i / len(trials))
            self._fitted(stage, reference, trial)

    def _finalists(self, level: Sequence[Trial]) -> list[Trial]:
        least = self.criteria.hopeless * min(trial.score for trial in level) if level else 0.0
        return [trial for trial in _diverse(level, self.criteria.finalists) if trial.score <= least]

    def _linear_stage(self) -> Stage:
        if self.linear_stage is None:
            linear = self.linear.fit
            self.linear_stage = stage_of(self.problem, linear.candidate, linear.parts)
        return self.linear_stage

    def _least(self) -> Scored:
        return min(self._sound(), key=lambda s: s.score)

    def _settled_best(self) -> Scored:
        """The best set, fitted to its end: whether it is at the floor decides on going on."""
        best = self._least()
        self._settle(best, best)
        return self._least()

    def best(self) -> tuple[Scored, ...]:
        """The best sound sets that come near the best one."""
        order = sorted((s for s in self._sound() if s.size > 0), key=lambda s: s.score)
        near = (s for s in order if self._is_near(s, order[0]))
        return tuple(near)[: self.criteria.finalists]

    def _sound(self) -> Iterable[Scored]:
        return (s for c, s in self.fits.items() if c not in self.unsound)

    def _next_level(
        self, stage: Stage, beam: Sequence[Trial], begin: float, end: float
    ) -> list[Trial]:
        """Sets of one law more than those of a beam, refined along the motion, best first."""
        found: dict[frozenset[Placed], Trial] = {}
        for i, base in enumerate(beam):
            self.progress("screening laws", begin + (end - begin) * i / len(beam))
            trials = ranked(stage, base, self.criteria.screened, self._open_to(base))
            self.first_round = self.first_round or trials
            for trial in trials:
                if trial.values:
                    _keep(found, trial)
        return sorted(found.values(), key=_score)

    def _open_to(self, base: Trial) -> list[Placed]:
        """Laws that may be added to a set: where it is nearly right, those of other kinds alone."""
        everything = proposed(self.problem)
        known = self.fits.get(nominal(self.problem).added(*base.laws))
        if known is None or not self._is_formula(known):
            return everything
        taken = set().union(*(_kinds(effect(name).family) for _, name in base.laws))
        return [at for at in everything if not _kinds(effect(at[1]).family) & taken]

    def _backward(
        self, stage: Stage, levels: Sequence[Sequence[Trial]], best: Sequence[Trial]
    ) -> list[Trial]:
        """The best sets less one of their laws, where that set has not been tried."""
        found: list[Trial] = []
        for trial in best:
            if len(trial.laws) < 2:
                continue
            known = {frozenset(t.laws) for t in levels[len(trial.laws) - 2]}
            for i in range(len(trial.laws)):
                laws = trial.laws[:i] + trial.laws[i + 1 :]
                if frozenset(laws) not in known:
                    less = refined(stage, laws, trial.values[:i] + trial.values[i + 1 :])
                    if less is not None:
                        found.append(less)
        return found

    def _fitted(
        self, stage: Stage, reference: Scored, trial: Trial, effort: Effort = _ROUGH
    ) -> None:
        """Fit a trial's laws in simulation, from what it found along the motion."""
        order = sorted(range(len(trial.laws)), key=lambda i: trial.laws[i])
        base = nominal(self.problem)
        candidate = base.added(*trial.laws)
        values = [
            existing_values(self.problem, base)
            if reference.fit.candidate.kept != base.kept
            else reference.fit.parts.effects[: len(existing_values(self.problem, base))]
        ]
        linear = reference.fit.parts.linear + linear_beside(stage, trial)
        for i in order:
            own, shift = law_and_shift(trial.laws[i][1], trial.values[i])
            values.append(own)
            linear = linear + [
                shift * ((p.strut, p.kind) == (trial.laws[i][0], "free_length"))
                for p in self.problem.linear
            ]
        least = np.array([p.least for p in self.problem.linear])
        parts = self._begun(
            candidate,
            Parts(np.maximum(linear, least), np.concatenate(values), reference.fit.parts.starts),
        )
        # Priors weigh as they did there: a free run may begin far off with the right parameters.
        self._try(candidate, parts, effort, max(1.0, trial.cost / len(stage.target)))

    def _begun(self, candidate: Candidate, parts: Parts) -> Parts:
        """The same with initial states of its own: those of a poorer model make up for it."""
        recordings = range(self.problem.recordings)
        own = parts._replace(starts=tuple(self.problem.start(k, candidate) for k in recordings))
        none = np.zeros(len(self.problem.linear), dtype=np.bool_)
        result = fit(self.problem, candidate, own, none, *_BEGUN, effects=False)
        return own if result is None else result.parts

    def _starts(self, reference: Fit, candidate: Candidate) -> tuple[Array, ...]:
        """Initial vectors of a reference, for another candidate: internal states at zero."""
        states = slots_of(self.problem, reference.candidate).states
        found: list[Array] = []
        for k, start in enumerate(reference.parts.starts):
            new = self.problem.start(k, candidate)
            motion = len(start) - states
            new[:motion] = start[:motion]
            found.append(new)
        return tuple(found)

    def _fit(
        self, candidate: Candidate, parts: Parts, effort: Effort, most_level: float = np.inf
    ) -> Fit | None:
        free = free_beside(self.problem, candidate)
        parts = parts._replace(linear=np.where(free, parts.linear, 0.0))
        return fit(self.problem, candidate, parts, free, *effort, most_level=most_level)

    def _settle(self, scored: Scored, best: Scored) -> None:
        """Fit a set to its end if it comes near the best one."""
        candidate = scored.fit.candidate
        is_near = self._is_near(scored, best)
        if scored.size and is_near and candidate not in self.settled:
            self._try(candidate, scored.fit.parts, _FULL)

    def _is_near(self, scored: Scored, best: Scored) -> bool:
        return scored.score <= self.criteria.hopeless * best.score

    def _try(
        self,
        candidate: Candidate,
        parts: Parts,
        effort: Effort = _ROUGH,
        most_level: float = np.inf,
    ) -> Scored | None:
        """Fit a candidate in simulation and keep the better of this and an earlier fit."""
        result = self._fit(candidate, parts, effort, most_level)
        if effort is _FULL:
            self.settled.add(candidate)
        if result is None:
            return self.fits.get(candidate)
        scored = self._scored(result)
        if candidate not in self.fits or scored.score < self.fits[candidate].score:
            self.fits[candidate] = scored
            why = unsound(self.problem, result, self.along, self.criteria)
            self.unsound.pop(candidate, None)
            if why is not None:
                self.unsound[candidate] = why
        return self.fits[candidate]

    # --- the choice ---------------------------------------------------------------------------

    def chosen(self) -> Scored:
        """The smallest set that no larger one is worth more than."""
        current = self.linear
        while True:
            larger = [s for s in self._sound() if s.size > current.size and self._worth(current, s)]
            if not larger:
                return current
            least = min(s.size for s in larger)
            current = self._plainest([s for s in larger if s.size == least])

    def _plainest(self, sets: Sequence[Scored]) -> Scored:
        """Of the sets that the data cannot tell from the best, that with the fewest parameters."""
        best = min(sets, key=lambda s: s.score)
        alike = [s for s in sets if self._is_alike(s, best)]
        return min(alike, key=lambda s: (len(s.fit.parts.effects), s.score))

    def _is_alike(self, other: Scored, best: Scored) -> bool:
        lost = other.score - best.score
        return lost <= self.criteria.standard_errors * _standard_error(other, best)

    def _without_needless(self, chosen: Scored) -> Scored:
        """Each law left out, or replaced by a simpler one, where that loses nothing."""
        again = True
        while again:
            again = False
            for placed in chosen.fit.candidate.new:
                for rival in self._simpler(chosen, placed):
                    if not self._worth(rival, chosen):
                        chosen, again = rival, True
                        break
                if again:
                    break
        return chosen

    def _simpler(self, chosen: Scored, placed: Placed) -> Iterable[Scored]:
        less = chosen.fit.candidate.without(placed)
        if chosen.size > 1:
            yield from self._refit(chosen, less)
        for name in effect(placed[1]).simpler:
            other = (placed[0], name)
            if effect(name).linear or other in less.new:
                continue
            candidate = less.added(other)
            if candidate not in self.fits:
                self._fit_beside(chosen, less, other)
            if candidate in self.fits:
                self._settle(self.fits[candidate], chosen)
                if candidate not in self.unsound:
                    yield self.fits[candidate]

    def _fit_beside(self, chosen: Scored, less: Candidate, placed: Placed) -> None:
        """Fit a law beside those of a chosen set less another, from the best linear model on."""
        stage = self._linear_stage()
        kept = _values(self.problem, chosen.fit)
        base = Trial(less.new, tuple(kept[law] for law in less.new), 0.0, np.zeros(1))
        for trial in ranked(stage, base, 1, [placed]):
            if trial.values and self._is_near_along(chosen, trial):
                self._fitted(stage, self.linear, trial, _FULL)

    def _may_do(self, chosen: Scored, candidate: Candidate) -> bool:
        """Whether fewer laws are not hopeless along the motion."""
        known = _values(self.problem, chosen.fit)
        laws = candidate.new
        trial = refined(self._linear_stage(), laws, [known[law] for law in laws])
        return trial is not None and self._is_near_along(chosen, trial)

    def _is_near_along(self, chosen: Scored, trial: Trial) -> bool:
        known = _values(self.problem, chosen.fit)
        laws = chosen.fit.candidate.new
        whole = refined(self._linear_stage(), laws, [known[law] for law in laws])
        return whole is not None and trial.score <= self.criteria.hopeless * whole.score

    def _refit(self, chosen: Scored, candidate: Candidate) -> Iterable[Scored]:
        """Fewer laws, from where the chosen set has them."""
        known = _values(self.problem, chosen.fit)
        if candidate not in self.fits and self._may_do(chosen, candidate):
            first = slots_of(self.problem, nominal(self.problem)).parameters
            effects = [chosen.fit.parts.effects[:first], *(known[law] for law in candidate.new)]
            starts = self._starts(chosen.fit, candidate)
            parts = Parts(chosen.fit.parts.linear, np.concatenate(effects), starts)
            self._try(candidate, parts)
        if candidate in self.fits:
            self._settle(self.fits[candidate], chosen)
        if candidate in self.fits and candidate not in self.unsound:
            yield self.fits[candidate]

    def _rivals(self, chosen: Scored) -> tuple[Scored, ...]:
        """Sets of the same size and other families that the data cannot tell from the chosen."""
        families = _families(chosen)
        found: dict[tuple[str, ...], Scored] = {}
        for other in sorted(self._sound(), key=lambda s: s.score):
            if other.size != chosen.size or _families(other) == families:
                continue
            if _degenerate(other, chosen) or _families(other) in found:
                continue
            if self._is_alike(other, chosen):
                found[_families(other)] = other
        return tuple(found.values())

    def _superfluous(self, chosen: Scored) -> tuple[int, ...]:
        """Existing effects that act on the recordings and without which nothing is lost."""
        found: list[int] = []
        values = _existing(self.problem, chosen.fit)
        new = slots_of(self.problem, nominal(self.problem)).parameters
        for i in chosen.fit.candidate.kept:
            if not self.problem.existing[i].free:
                continue
            kept = tuple(j for j in chosen.fit.candidate.kept if j != i)
            candidate = Candidate(kept, chosen.fit.candidate.new)
            effects = [values[j] for j in kept] + [chosen.fit.parts.effects[new:]]
            starts = self._starts(chosen.fit, candidate)
            parts = Parts(chosen.fit.parts.linear, np.concatenate(effects), starts)
            result = self._fit(candidate, parts, _FULL)
            if result is not None and not self._worth(self._scored(result), chosen):
                found.append(i)
        return tuple(found)

    # --- the linear part ----------------------------------------------------------------------

    def _with_few_linear(self, chosen: Scored) -> tuple[Scored, bool]:
        """The chosen model, fitted to its end, with those linear corrections that data call for."""
        settled = fit(
            self.problem, chosen.fit.candidate, chosen.fit.parts, chosen.fit.free, *_FINAL
        )
        if settled is not None:
            chosen = self._scored(settled)
        needed = self._needed(chosen.fit)
        parts = chosen.fit.parts._replace(linear=np.where(needed, chosen.fit.parts.linear, 0.0))
        fewer = fit(self.problem, chosen.fit.candidate, parts, needed, *_FINAL)
        result = chosen
        if fewer is not None and not self._worth(self._scored(fewer), chosen):
            result = self._scored(fewer)
        as_given = self._scored(self.given)
        if not result.size and not self._worth(as_given, result):
            # Corrections that are away from nothing and change nothing that can be measured.
            return as_given, False
        share = _alike(self.problem, result.fit)
        if share is None:
            return result, False
        only = np.array([p.kind == "gain" for p in self.problem.linear], dtype=np.bool_)
        start = result.fit.parts._replace(linear=np.where(only, 1.0 / (1.0 + share) - 1.0, 0.0))
        gain = fit(self.problem, chosen.fit.candidate, start, only)
        if gain is not None and not self._worth(self._scored(gain), result):
            return self._scored(gain), True
        return result, True

    def _needed(self, result: Fit) -> Flags:
        """Backward elimination by Wald's test with the covariance of a coloured residual."""
        variables = np.flatnonzero(result.free)
        count = len(variables)
        known = spread(result).covariance[:count, :count].copy()
        x = result.space.inner(result.solution.values)[:count].copy()
        left = list(range(count))
        while left:
            part = np.array(left)
            sizes = np.abs(x[part]) / np.sqrt(np.maximum(np.diag(known)[part], 1e-300))
            worst = int(part[np.argmin(sizes)])
            if float(np.min(sizes)) >= self.criteria.significant:
                break
            # The others, given that this one is nothing.
            x = x - known[:, worst] / max(known[worst, worst], 1e-300) * x[worst]
            outer = np.outer(known[:, worst], known[worst]) / max(known[worst, worst], 1e-300)
            known = known - outer
            left.remove(worst)
        needed = np.zeros_like(result.free)
        needed[variables[left]] = True
        return needed

    # --- what was not chosen ------------------------------------------------------------------

    def rejected(self, chosen: Scored, rivals: Sequence[Scored]) -> tuple[Rejected, ...]:
        """Laws that were not chosen, with one line each, best first."""
        found: dict[Placed, Rejected] = {}
        taken = set(chosen.fit.candidate.new)
        tied = {placed for rival in rivals for placed in rival.fit.candidate.new} - taken
        for trial in self.first_round:
            placed = trial.laws[-1]
            if placed in taken or placed in found or self.nothing is None:
                continue
            left = float(np.sqrt(max(trial.cost, 0.0) / max(self.nothing.cost, 1e-300)))
            why = self._why(chosen, placed, left, placed in tied)
            found[placed] = Rejected(placed, why, min(left, 1.0))
        return tuple(sorted(found.values(), key=lambda r: 1.0 if r.left is None else r.left))

    def _why(self, chosen: Scored, placed: Placed, left: float, tied: bool) -> str:
        if tied:
            return "cannot be told from what was chosen by these data"
        candidate = nominal(self.problem).added(placed)
        if candidate in self.unsound:
            return self.unsound[candidate]
        if candidate in self.fits and chosen.size > 0:
            alone = self.fits[candidate]
            ratio = float(np.sqrt(alone.score / max(chosen.score, 1e-300)))
            if chosen.size == 1:
                return f"its out-of-sample residual is {ratio:.3g} times that of the chosen model"
            return f"alone it leaves {ratio:.3g} times the out-of-sample residual of the chosen set"
        share = 100.0 * (1.0 - min(left, 1.0))
        return f"along the motion it takes {share:.3g} % off the residual of the linear model"


def _score(trial: Trial) -> float:
    return trial.score


def _keep(found: dict[frozenset[Placed], Trial], trial: Trial) -> None:
    key = frozenset(trial.laws)
    if key not in found or trial.score < found[key].score:
        found[key] = trial


def _diverse(level: Sequence[Trial], count: int) -> list[Trial]:
    """The best sets, at most two of which are of the same families."""
    chosen: list[Trial] = []
    seen: dict[tuple[str, ...], int] = {}
    for trial in level:
        if len(chosen) >= count:
            break
        families = tuple(sorted(effect(name).family for _, name in trial.laws))
        if seen.get(families, 0) < 2:
            chosen.append(trial)
            seen[families] = seen.get(families, 0) + 1
    return chosen


def _standard_error(one: Scored, other: Scored) -> float:
    """Standard error of the difference of two out-of-sample sums over blocks."""
    difference = one.scores - other.scores
    return float(np.sqrt(len(difference)) * np.std(difference, ddof=1))


def _families(scored: Scored) -> tuple[str, ...]:
    return tuple(sorted(effect(name).family for _, name in scored.fit.candidate.new))


def _kinds(family: str) -> set[int]:
    """What a family's force follows, by number; what is in no list is a kind of its own."""
    return {i for i, kind in enumerate(KINDS) if family in kind} or {len(KINDS)}


def _adds_a_kind(smaller: Scored, larger: Scored) -> bool:
    """Whether a larger set is the smaller one, in its families, with a law of a further kind."""
    few, many = set(_families(smaller)), set(_families(larger))
    kinds = set().union(*(_kinds(family) for family in few))
    return few < many and any(not _kinds(family) & kinds for family in many - few)


def _degenerate(other: Scored, chosen: Scored) -> bool:
    """Whether a set is the chosen one with a law that only degenerates to one of its laws."""
    more = set(other.fit.candidate.new) - set(chosen.fit.candidate.new)
    less = set(chosen.fit.candidate.new) - set(other.fit.candidate.new)
    return all(any(at == s and n in _simpler_names(name) for s, n in less) for at, name in more)


def _simpler_names(name: str) -> set[str]:
    direct = set(effect(name).simpler)
    return direct.union(*(_simpler_names(other) for other in direct)) if direct else direct


def _values(problem: Problem, result: Fit) -> dict[Placed, Array]:
    """Parameters of the laws that the nominal model lacks."""
    index = slots_of(problem, result.candidate).index[len(result.candidate.kept) :]
    return {
        law: result.parts.effects[slot[1] : slot[2]]
        for law, slot in zip(result.candidate.new, index, strict=True)
    }


def _existing(problem: Problem, result: Fit) -> dict[int, Array]:
    index = slots_of(problem, result.candidate).index
    return {
        kept: result.parts.effects[slot[1] : slot[2]]
        for kept, slot in zip(result.candidate.kept, index, strict=False)
    }


def _alike(problem: Problem, result: Fit) -> float | None:
    """Share by which mass, stiffness and damping all changed, if it is one within intervals."""
    if not any(p.kind == "gain" for p in problem.linear):
        return None
    known = spread(result)
    free = [p for p, is_free in zip(problem.linear, result.free, strict=True) if is_free]
    changes = result.solution.values[: len(free)]
    deviations = np.sqrt(np.maximum(np.diag(known.covariance)[: len(free)], 0.0))
    shares: list[tuple[float, float]] = []
    for i, p in enumerate(free):
        if p.kind in ("mass", "stiffness", "damping") and p.nominal > 0.0:
            shares.append(
                (changes[i] / p.nominal, deviations[i] * p.deviation / p.nominal * known.factor)
            )
    least = sum(1 for p in problem.linear if p.kind in ("mass", "stiffness", "damping"))
    if len(shares) < least:
        return None
    middle = float(np.median([share for share, _ in shares]))
    is_one = all(abs(share - middle) < max(half, 0.01) for share, half in shares)
    return middle if is_one else None
