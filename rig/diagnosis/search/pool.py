"""Fitted models, and the rules by which one is preferred to another.

A free run with impacts or play may part from the measurement wherever its parameters are not all
but right, and its fit then ends anywhere. A model that is held to the measured motion does not: it
is fitted, and then let go.

References:
    Breiman, Friedman, Olshen, Stone, Classification and Regression Trees (1984), 3.4.3, the
    one-standard-error rule.
    Abarbanel, Creveling, Farsian, Kostuk, Dynamical state and parameter estimation, SIAM J. Appl.
    Dyn. Syst. 8 (2009): models that are coupled to the data, less and less.
    Ljung, System Identification (1999), 3.2: prediction errors of a model with an observer.
"""

import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from dart_model.effects import effect
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    Parts,
    Problem,
    StrutEffect,
    existing_values,
    first_starts,
    free_linear,
    nominal,
    slots_of,
)
from rig.diagnosis.problem.track import forces_along
from rig.diagnosis.progress import Progress, no_progress
from rig.diagnosis.search.criteria import (
    DISSIPATING,
    REMEMBERING,
    STORING,
    SelectionCriteria,
)
from rig.diagnosis.search.fit import Fit, fit, model_for, project_out_fit, validation_costs
from rig.diagnosis.search.score_test import ModelChange, find_changes
from rig.diagnosis.search.screen import (
    Screening,
    Stage,
    law_and_shift,
    linear_changes,
    no_law,
    rank_laws,
    stage_of,
    whole_stage_of,
)
from rig.diagnosis.search.validity import (
    find_defect,
    find_improbable_linear_part,
    new_laws,
    size_in_deviations,
    smooth_tracks,
)

Array = NDArray[np.float64]


_STARTS = Effort(8, 1e-2, 1)
"""Fits of initial states alone."""
ROUGH = Effort(8, 1e-3, 1)
"""Fits that are compared among themselves."""
FULL = Effort(20, 1e-4, 2)
"""Fits that decide."""
FINAL = Effort(15, 1e-6, 2)
"""The fit that is reported; that of a free run once more with finer steps."""


_HELD = (1.0, 0.3, 0.1)
"""Rates at which models are held to the measured motion, as shares of that of their fastest."""
_RIGHT, _PARTED = 100.0, 1e3
"""Mean square of a residual up to which a regression promises a nearly right model, and times that
from which on the fit of its free run has parted from the measurement: what a model lacks is
amplified by less."""
_MISSED = 10.0
"""The same ratio for a regression or linearisation that promises as many times less than the best
model leaves: a fit that comes nowhere near is in another valley."""
_AT_ONCE = 2
"""Fits that go on at a time, the same on every machine: what they reach decides which follow."""
_SURPASSED = 4.0
"""Times the least sum of squares of a valid model from which on a promise is too little. The first
of a batch are fitted whatever they promise: they were chosen beside what there was."""
_STUCK = 2.0
"""Ratio of a converged fit's sum of squares to that of its linearisation from which on it is
stuck: right models end at 1, beside dry friction at 1.2."""
_FAR = 2.0
"""Standard deviations of the model file from which on a linear parameter is looked for nearer to
it: one in twenty is as far."""
_TINY = 1e-100
"""Least divisor."""
_MOVED = 0.01
"""Share by which a fit's sum of squares falls from which on its changes are looked at again."""
_REVERSING = 0.02
"""Velocity, as a share of its RMS, below which friction changes its sign."""


class ValidatedModel(NamedTuple):
    """A fitted model, and its out-of-sample sum of squares of each block."""

    fit: Fit
    block_costs: Array

    @property
    def cost(self) -> float:
        """Out-of-sample sum of squares."""
        return float(self.block_costs.sum())

    @property
    def excess(self) -> float:
        """Out-of-sample sum of squares above that of white noise of the sensors."""
        return self.cost - self.fit.rows

    @property
    def size(self) -> int:
        """Number of laws."""
        return len(self.fit.candidate.new)

    @property
    def families(self) -> tuple[str, ...]:
        """Families of its laws, sorted."""
        return tuple(sorted(effect(name).family for _, name in self.fit.candidate.new))


class Begin(NamedTuple):
    """Where a fit begins.

    Attributes:
        most_level: As of `rig.diagnosis.search.fit.fit`.
        promised: Mean square of the residual that it reaches, as a regression shows; infinite where
            nothing is known of it.
    """

    model: CandidateModel
    most_level: float = np.inf
    promised: float = np.inf

    @property
    def key(self) -> Hashable:
        """What fits that begin alike have in common."""
        candidate, parts = self.model
        arrays = parts.linear, parts.effects, *parts.starts
        return candidate, self.most_level, self.promised, tuple(it.tobytes() for it in arrays)


class _Job(NamedTuple):
    """A fit to be done: its candidate, where it begins, and what it promises, as in `Begin`."""

    candidate: Candidate
    begin_at: Callable[[], Begin]
    promised: float = np.inf


class Pool:
    """Fitted models by candidate; of two fits of one candidate the better is kept.

    Args:
        given: The nominal model, initial states fitted.
        seeds: First models, the best linear one first.
    """

    def __init__(
        self, problem: Problem, given: Fit, seeds: Sequence[Fit], criteria: SelectionCriteria
    ) -> None:
        self.problem, self.given, self.criteria = problem, given, criteria
        self.along = smooth_tracks(problem, given)
        self.fits: dict[Candidate, ValidatedModel] = {}
        self.invalid: dict[Candidate, str] = {}
        self.converged: set[Candidate] = set()
        self.floors: dict[Candidate, tuple[ValidatedModel, float]] = {}
        self.tested: dict[Candidate, tuple[ValidatedModel, tuple[ModelChange, ...]]] = {}
        self.begun: set[Hashable] = set()
        self.stuck: set[Candidate] = set()
        self.attempt_all([seed.model for seed in seeds])
        base = nominal(problem)
        self.linear = self.fits.setdefault(base, self.validate(given))

    @cached_property
    def linear_stage(self) -> Stage:
        """The regression about the best linear model."""
        return stage_of(self.problem, self.linear.fit.model)

    @cached_property
    def linear_of_file(self) -> Array:
        """Linear parameters as the model file, and delays as an estimate, have them, shape (L,)."""
        return np.array([p.expected for p in self.problem.linear])

    @cached_property
    def held(self) -> tuple[Problem, ...]:
        """Problems of models that are held to the measured motion, less and less."""
        problems = (self.problem.held_to(self.along, share) for share in _HELD)
        return tuple(problem for problem in problems if problem is not None)

    def take_every_sample(self) -> None:
        """Take every sample in the regression about the best linear model."""
        self.linear_stage = whole_stage_of(self.problem, self.linear.fit.model)

    # --- fits ---------------------------------------------------------------------------------

    def validate(self, result: Fit) -> ValidatedModel:
        """A fit with its cross-validation."""
        return ValidatedModel(result, validation_costs(self.problem, result))

    def refit(self, model: CandidateModel, effort: Effort) -> Fit | None:
        """Fit a model with all linear parameters that may be fitted together with its laws."""
        return self._refit(self.problem, Begin(model), effort)

    def _refit(self, problem: Problem, begin: Begin, effort: Effort) -> Fit | None:
        candidate, parts = begin.model
        free = free_linear(problem, candidate)
        parts = parts._replace(linear=np.where(free, parts.linear, 0.0))
        first = CandidateModel(candidate, parts)
        return fit(problem, first, free, effort, most_level=begin.most_level)

    def attempt(self, model: CandidateModel, effort: Effort = ROUGH) -> None:
        """Fit a model in simulation and keep the better of this and an earlier fit."""
        self.attempt_all([model], effort)

    def attempt_all(
        self,
        models: Sequence[CandidateModel],
        effort: Effort = ROUGH,
        progress: Progress = no_progress,
    ) -> None:
        """Fit models in simulation, as `attempt` does, some at a time."""
        jobs = [_Job(model.candidate, partial(Begin, model)) for model in models]
        self._fit_each(jobs, effort, progress)

    def attempt_changes(self, changes: Sequence[ModelChange], progress: Progress) -> None:
        """Fit changed models in simulation, some at a time."""
        begins = [
            Begin(change.model, promised=change.cost / self.linear.fit.rows) for change in changes
        ]
        self._fit_each([_job_of(begin) for begin in begins], ROUGH, progress)

    def _fit_each(self, jobs: Sequence[_Job], effort: Effort, progress: Progress) -> None:
        """Fit candidates from where they begin, and keep each that is better than an earlier fit.

        Fits that go on at once take a thread each; what is kept of them is kept after all of them.
        """
        for job in jobs:
            # Compiled here: numba's compiler admits one thread.
            slots_of(self.problem, job.candidate).compile_slopes()
        left = list(jobs)
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            while left:
                some, left = left[:_AT_ONCE], left[_AT_ONCE:]
                laws = ", ".join(name for _, name in some[0].candidate.new)
                done = 1.0 - (len(some) + len(left)) / len(jobs)
                progress(f"fitting {laws or 'the linear part'}", done)
                fit_one = partial(self._fit_one, effort, self._least_cost())
                for job, model in zip(some, list(threads.map(fit_one, some)), strict=True):
                    if effort is FULL:
                        self.converged.add(job.candidate)
                    if model is not None:
                        self._keep(job.candidate, model)
                left = [job for job in left if not self._is_surpassed(job)]
        candidates = [job.candidate for job in jobs]
        self._converge_promising(candidates)
        self._leave_out_weakest(candidates, effort)

    def _least_cost(self) -> float:
        """The least sum of squares of a valid model, infinite where there is none."""
        return min((model.fit.solution.cost for model in self.valid()), default=np.inf)

    def _fit_one(self, effort: Effort, least: float, job: _Job) -> ValidatedModel | None:
        result = self._fit_from(job.begin_at(), effort, least)
        return None if result is None else self.validate(result)

    def _is_surpassed(self, job: _Job) -> bool:
        """Whether a fit promises more than some times what the best valid model leaves."""
        is_known = math.isfinite(job.promised)
        most = _SURPASSED * self._least_cost()
        return is_known and job.promised * self.linear.fit.rows > most

    def _converge_promising(self, candidates: Sequence[Candidate]) -> None:
        """Converge models that leave much less than the valid ones, but do not count as best.

        A rough fit may have ended on its way: its defect is then that of where it ended, and so is
        its error on blocks left out, which is linearised there.
        """
        for candidate in dict.fromkeys(candidates):
            model = self.fits.get(candidate)
            if model is None or not model.size or candidate in self.converged:
                continue
            is_best = candidate not in self.invalid and model is self.least()
            if not is_best and self._leaves_much_less(candidate):
                self.attempt(model.fit.model, FULL)

    def _leaves_much_less(self, candidate: Candidate) -> bool:
        """Whether a fit leaves less than every valid other one by what a law has to gain."""
        valid = [it for it in self.valid() if it.fit.candidate != candidate]
        if not valid:
            return False
        least = min(it.fit.solution.cost for it in valid)
        enough = self.criteria.least_share * (least - valid[0].fit.rows)
        gain = least - self.fits[candidate].fit.solution.cost
        return gain > max(self.criteria.least_likelihood_gain, enough)

    def _leave_out_weakest(self, candidates: Sequence[Candidate], effort: Effort) -> None:
        """Fit models that are better than all valid ones, but invalid, without their weakest law.

        It was a step towards a better formula of another law, beside which it is superfluous.
        """
        for candidate in candidates:
            model, valid = self.fits.get(candidate), list(self.valid())
            if model is None or model.size < 2 or candidate not in self.invalid or not valid:
                continue
            if model.cost < min(other.cost for other in valid):
                sizes = size_in_deviations(self.problem, model.fit)
                if sizes:
                    smaller = candidate.without(min(sizes, key=sizes.__getitem__))
                    if smaller not in self.converged:
                        self.attempt(model_for(self.problem, model.fit.model, smaller), effort)

    def _fit_from(self, begin: Begin, effort: Effort, least: float) -> Fit | None:
        """Fit a model; where its linear part ends far from the file's, once more from there.

        A law that imitates a part of inertia, spring or damper does so along a valley, a long one
        where the motion is one orbit of a sine. A fit that decides comes from both ends of it.
        `least` is the sum of squares of the best model before. None, too, where a fit began there
        before: its result is known.
        """
        key = begin.key, effort
        if key in self.begun:
            return None
        self.begun.add(key)
        result = self._fit_or_let_go(begin, effort, least)
        if result is None or not self._is_far_from_file(result, effort):
            return result
        other = self._fit_from_file(result.model)
        if other is None or self._is_likelier(result, other):
            return result
        return other if effort is ROUGH else self._refit(self.problem, Begin(other.model), effort)

    def _is_far_from_file(self, result: Fit, effort: Effort) -> bool:
        """Whether a fit's linear part is improbable, or that of one that decides not the file's."""
        if effort is FULL and bool(np.any(np.abs(self._deviations(result)) > _FAR)):
            return True
        best = self.fits.get(nominal(self.problem))
        lawless = (self.given if best is None else best.fit).parts.linear
        why = find_improbable_linear_part(
            self.problem, result.candidate.new, result.parts.linear, lawless, self.criteria
        )
        return why is not None

    def _fit_from_file(self, model: CandidateModel) -> Fit | None:
        """Fit a model from the file's linear part on, its laws alone before."""
        at_file = model.with_linear(self.linear_of_file)
        none_free = np.zeros(len(self.linear_of_file), dtype=np.bool_)
        alone = fit(self.problem, at_file, none_free, ROUGH)
        return None if alone is None else self._refit(self.problem, Begin(alone.model), ROUGH)

    def _deviations(self, result: Fit) -> Array:
        """Standard deviations of a fit's linear parameters from what the file says, shape (L,)."""
        offsets = result.parts.linear - self.linear_of_file
        return offsets / np.array([p.deviation for p in self.problem.linear])

    def _is_likelier(self, one: Fit, other: Fit) -> bool:
        """Whether a fit is likelier than another one, priors of the linear part included."""
        level = max(1.0, min(one.mean_square, other.mean_square))
        first, second = (
            result.solution.cost + level * float(np.sum(self._deviations(result) ** 2))
            for result in (one, other)
        )
        return first < second

    def _fit_or_let_go(self, begin: Begin, effort: Effort, least: float) -> Fit | None:
        """Fit a model in free run; where that parts or is stuck, once more from one that is let go.

        One that is not near its promise even where it is held is given up: free it would be farther
        off. So is one that is stuck after it was let go once, without a gain that leads elsewhere.
        """
        result = self._refit(self.problem, begin, effort)
        reached = np.inf if result is None else result.mean_square
        parted = reached > _PARTED * begin.promised and begin.promised <= _RIGHT
        missed = reached > _MISSED * begin.promised < least / self.linear.fit.rows
        is_stuck = effort is FULL and result is not None and _is_stuck(result, least)
        if not (parted or missed or (is_stuck and begin.model.candidate not in self.stuck)):
            return result
        other = self._let_go(begin, effort)
        if is_stuck and (other is None or other.mean_square > reached / _STUCK):
            self.stuck.add(begin.model.candidate)
        return result if other is None or reached < other.mean_square else other

    def _let_go(self, begin: Begin, effort: Effort) -> Fit | None:
        """Fit a model that is held to the measured motion, less and less, and then free.

        None where it cannot be held, or is not near its promise even there.
        """
        if not self.held:
            return None
        for problem in self.held:
            held = self._refit(problem, begin, ROUGH)
            if held is not None and held.mean_square > _MISSED * begin.promised:
                return None
            begin = begin if held is None else begin._replace(model=held.model)
        return self._refit(self.problem, begin, effort)

    def _keep(self, candidate: Candidate, model: ValidatedModel) -> None:
        if candidate in self.fits and model.cost >= self.fits[candidate].cost:
            return
        self.fits[candidate] = model
        self.invalid.pop(candidate, None)
        lawless = self.fits.get(nominal(self.problem), model).fit
        why = find_defect(self.problem, model.fit, lawless, self.along, self.criteria)
        if why is not None:
            self.invalid[candidate] = why

    def attempt_screening(
        self, stage: Stage, reference: ValidatedModel, screening: Screening, effort: Effort = ROUGH
    ) -> None:
        """Fit a screening's laws in simulation, from their parameters along the motion."""
        self.attempt_screenings(stage, reference, [screening], no_progress, effort)

    def attempt_screenings(
        self,
        stage: Stage,
        reference: ValidatedModel,
        screenings: Sequence[Screening],
        progress: Progress,
        effort: Effort = ROUGH,
    ) -> None:
        """Fit the laws of screenings, as `attempt_screening` does, some at a time."""
        base = nominal(self.problem)
        jobs = [
            _Job(
                base.with_effects(*screening.laws),
                partial(self._begin_at, stage, reference, screening),
                _promised_level(stage, screening),
            )
            for screening in screenings
        ]
        self._fit_each(jobs, effort, progress)

    def _begin_at(self, stage: Stage, reference: ValidatedModel, screening: Screening) -> Begin:
        """Where a fit of a screening's laws begins: at their parameters along the motion."""
        base, known = nominal(self.problem), reference.fit
        existing = existing_values(self.problem, base)
        if known.candidate.kept == base.kept:
            existing = known.parts.effects[: len(existing)]
        values, linear = [existing], known.parts.linear + linear_changes(stage, screening)
        for at, law_values in sorted(
            zip(screening.laws, screening.values, strict=True), key=lambda law: law[0]
        ):
            parameters, shift = law_and_shift(at[1], law_values)
            values.append(parameters)
            shifted = [(p.strut, p.kind) == (at[0], "free_length") for p in self.problem.linear]
            linear = linear + shift * np.array(shifted)
        least = np.array([p.least for p in self.problem.linear])
        candidate = base.with_effects(*screening.laws)
        most = np.array([p.most for p in self.problem.linear])
        linear = np.clip(linear, least, most)
        model = self._fit_starts(candidate, linear, np.concatenate(values))
        # Priors weigh as in the regression: a free run may begin far off with right parameters.
        level = _promised_level(stage, screening)
        return Begin(model, level, level)

    def _fit_starts(self, candidate: Candidate, linear: Array, effects: Array) -> CandidateModel:
        """A model with fitted initial states; those of a poorer model compensate its error."""
        parts = Parts(linear, effects, first_starts(self.problem, candidate))
        model, none_free = CandidateModel(candidate, parts), np.zeros(len(linear), dtype=np.bool_)
        result = fit(self.problem, model, none_free, _STARTS, effects=False)
        return model if result is None else result.model

    def attempt_at_nominal(
        self, candidate: Candidate, laws: Mapping[StrutEffect, Array], promised: float = np.inf
    ) -> None:
        """Fit laws in simulation, from the linear part of the nominal model on.

        `promised` is as of `Begin`.
        """
        values = [existing_values(self.problem, nominal(self.problem))]
        values += [laws[law] for law in candidate.new]
        model = self._fit_starts(candidate, self.linear_of_file, np.concatenate(values))
        self._fit_each([_job_of(Begin(model, promised=promised))], FULL, no_progress)

    def adopt(self, results: Sequence[Fit], progress: Progress = no_progress) -> None:
        """Fit the laws of models of other recordings, starting from their parameters."""

        def begin_at(candidate: Candidate, parts: Parts) -> Begin:
            return Begin(self._fit_starts(candidate, parts.linear, parts.effects))

        jobs = [_Job(it.candidate, partial(begin_at, it.candidate, it.parts)) for it in results]
        self._fit_each(jobs, ROUGH, progress)

    def screen_and_attempt(self, laws: Sequence[StrutEffect]) -> None:
        """Fit laws in simulation from where the regression along the motion puts them."""
        stage = self.linear_stage
        screening = no_law(stage)
        for law in laws:
            ranked = rank_laws(stage, screening, 1, [law])
            if not ranked:
                return
            screening = ranked[0]
        if laws:
            self.attempt_screening(stage, self.linear, screening)

    def reject(self, candidate: Candidate, why: str) -> None:
        """Mark a candidate as invalid, for a reason that its last fit shows."""
        self.invalid[candidate] = why
        self.converged.add(candidate)

    def converge(self, model: ValidatedModel, best: ValidatedModel) -> None:
        """Fit a model until converged if it comes near the best one."""
        if self._may_fall(model, best):
            self.attempt(model.fit.model, FULL)

    def _may_fall(self, model: ValidatedModel, best: ValidatedModel) -> bool:
        """Whether a model of laws that comes near the best one has not converged yet."""
        return bool(
            model.size and self.is_near(model, best) and model.fit.candidate not in self.converged
        )

    def converge_best(self) -> None:
        """Fit the models that may be chosen until converged."""
        best = self.best()
        self.attempt_all([m.fit.model for m in best if self._may_fall(m, best[0])], FULL)

    # --- what may be chosen -------------------------------------------------------------------

    def valid(self) -> Iterable[ValidatedModel]:
        """Models without a defect that rules them out."""
        return (model for c, model in self.fits.items() if c not in self.invalid)

    def least(self) -> ValidatedModel:
        """The best valid model."""
        return min(self.valid(), key=lambda model: model.cost)

    def next_to_expand(self) -> ValidatedModel:
        """The model to expand next.

        An invalid model with a much smaller cost is kept, because one swap of a law often makes it
        valid.
        """
        best, valid = min(self.fits.values(), key=lambda model: model.cost), self.least()
        return valid if self.is_near(valid, best) else best

    def converge_least(self) -> ValidatedModel:
        """The best valid model, fitted until converged: the search ends if it is at the floor."""
        best = self.least()
        self.converge(best, best)
        return self.least()

    def best(self) -> tuple[ValidatedModel, ...]:
        """The best valid models with laws that come near the best one."""
        order = sorted((m for m in self.valid() if m.size > 0), key=lambda model: model.cost)
        near = (model for model in order if self.is_near(model, order[0]))
        return tuple(near)[: self.criteria.fitted_a_size]

    def best_and_subsets(self) -> list[ValidatedModel]:
        """The best models and those with a subset of their laws, which may suffice."""
        best = [set(model.fit.candidate.new) for model in self.best()]
        return [
            model
            for model in self.valid()
            if model.size and any(set(model.fit.candidate.new) <= laws for laws in best)
        ]

    def chosen(self, most_laws: int) -> ValidatedModel:
        """The smallest model that no larger one of at most `most_laws` laws is preferred to."""
        models = [model for model in self.valid() if model.size <= most_laws]
        current = self.linear
        while True:
            larger = [m for m in models if m.size > current.size and self.prefers(m, current)]
            if not larger:
                return current
            least = min(model.size for model in larger)
            current = self._plainest([model for model in larger if model.size == least])

    def _plainest(self, models: Sequence[ValidatedModel]) -> ValidatedModel:
        """The model with the fewest parameters of those indistinguishable from the best."""
        best = min(models, key=lambda model: model.cost)
        alike = [model for model in models if self.is_alike(model, best)]
        return min(alike, key=lambda model: (len(model.fit.parts.effects), model.cost))

    def changes(self, model: ValidatedModel) -> tuple[ModelChange, ...]:
        """Changes of a model by one law, as a score test about its fit ranks them."""
        candidate = model.fit.candidate
        known = self.tested.get(candidate)
        if known is None or model.cost < (1.0 - _MOVED) * known[0].cost:
            most = self.criteria.most_laws
            known = model, find_changes(self.problem, model.fit, self.along, most)
            self.tested[candidate] = known
        return known[1]

    # --- whether one model is preferred to another ------------------------------------------------

    def prefers(self, larger: ValidatedModel, smaller: ValidatedModel) -> bool:
        """Whether a larger model gains enough to be preferred to a smaller one."""
        criteria = self.criteria
        if self.at_floor(smaller) and (larger.size > smaller.size or not smaller.size):
            return False
        if (
            larger.size > smaller.size
            and (self.is_formula(smaller) or adds_an_imitator(smaller, larger))
            and not _adds_a_kind(smaller, larger)
            and not self.is_imitated(larger, smaller)
            and not self.adds_dry_friction(smaller, larger)
            and not self.adds_tone(smaller, larger)
        ):
            return False
        # A law has to gain its share; a better formula for one need only be better.
        share = 0.0 if larger.size == smaller.size > 0 else criteria.least_share
        gain = smaller.cost - larger.cost
        return (
            gain > criteria.standard_errors * standard_error(smaller, larger)
            and gain > criteria.least_likelihood_gain
            and gain > share * smaller.excess
        )

    def gains_share(self, model: ValidatedModel, before: ValidatedModel) -> bool:
        """Whether a model is better than another by the least share that a law has to gain."""
        return before.cost - model.cost > self.criteria.least_share * before.excess

    def at_floor(self, model: ValidatedModel) -> bool:
        """Whether a model is at the noise floor, so that a law could explain nothing more."""
        return model.fit.solution.cost < self.highest_at_floor(model)

    def highest_at_floor(self, model: ValidatedModel) -> float:
        """Sum of squares below which a model is at the noise floor."""
        first, later = self.criteria.least_above_noise, self.criteria.least_above_noise_later
        share = later if model.size else first
        share += self.criteria.scatter * math.sqrt(2.0 / model.fit.rows)
        return (1.0 + share) * self.floor(model)

    def floor(self, model: ValidatedModel) -> float:
        """Sum of squares of a right model: noise of the sensors, and of the applied force."""
        candidate = model.fit.candidate
        if candidate not in self.floors or self.floors[candidate][0] is not model:
            level = self.problem.floor_level(model.fit.model)
            self.floors[candidate] = model, level * model.fit.rows
        return self.floors[candidate][1]

    def is_formula(self, model: ValidatedModel) -> bool:
        """Whether the residual of laws is so small that it may be due to their formulas."""
        return bool(model.size) and (model.excess < self.criteria.formula**2 * self.linear.excess)

    def is_imitated(self, larger: ValidatedModel, smaller: ValidatedModel) -> bool:
        """Whether a larger model explains so much more that a smaller one only imitates it."""
        share = self.criteria.imitation ** (2 * (larger.size - smaller.size))
        is_right = self.at_floor(larger) or larger.excess < share * smaller.excess
        return is_right and not self.is_near(smaller, larger)

    def adds_tone(self, smaller: ValidatedModel, larger: ValidatedModel) -> bool:
        """Whether a periodic force alone is added, and leaves noise.

        What a formula lacks is no single sine, unless the drive is one: its multiples are refused.
        """
        few, many = Counter(smaller.families), Counter(larger.families)
        is_tone = many - few == Counter(["periodic_force"]) and not few - many
        return is_tone and self.at_floor(larger)

    def adds_dry_friction(self, smaller: ValidatedModel, larger: ValidatedModel) -> bool:
        """Whether friction alone is added, and acts where a damper hardly does: at low velocity.

        Beside friction or hysteresis, which act there themselves, it corrects their formula.
        """
        few, many = Counter(smaller.families), Counter(larger.families)
        acts_there = not REMEMBERING.isdisjoint(few)
        if many - few != Counter(["friction"]) or few - many or acts_there:
            return False
        (row,) = (row for row, name in new_laws(larger.fit) if effect(name).family == "friction")
        strut, force = forces_along(self.problem, larger.fit.model, self.along)[row]
        speed = np.concatenate([np.abs(track.velocities_m_per_s[strut]) for _, track in self.along])
        share = speed / max(float(np.sqrt(np.mean(speed**2))), 1e-100)
        slow = (share > _REVERSING) & (share < self.criteria.slow)
        usual = share >= 1.0
        if not (np.any(slow) and np.any(usual)):
            return False
        force = np.abs(force)
        return float(np.mean(force[slow])) > self.criteria.dry * float(np.mean(force[usual]))

    def is_near(self, model: ValidatedModel, best: ValidatedModel) -> bool:
        """Whether a model's cost is not hopeless compared with the best one's."""
        return model.cost <= self.criteria.hopeless * best.cost

    def is_alike(self, other: ValidatedModel, best: ValidatedModel) -> bool:
        """Whether a model is as good as the best one, so that the plainer is taken."""
        loss = other.cost - best.cost
        return loss <= self.criteria.standard_errors * standard_error(other, best)

    def is_rival(self, other: ValidatedModel, best: ValidatedModel) -> bool:
        """Whether the data cannot distinguish a model from the best one."""
        return error_ratio(other, best, self.criteria.level).low <= 1.0


def _job_of(begin: Begin) -> _Job:
    """A fit whose begin is known."""
    return _Job(begin.model.candidate, lambda: begin, begin.promised)


def _promised_level(stage: Stage, screening: Screening) -> float:
    """Mean square of the residual that a screening promises, at least that of noise."""
    return max(1.0, screening.cost / len(stage.target))


def _is_stuck(result: Fit, least: float) -> bool:
    """Whether a converged fit is far above what its linearisation promises: less than `least`.

    Where impacts amplify what they are given, the sum of squares has valleys beside valleys.
    """
    _, rest = project_out_fit(result)
    promised = float(rest @ rest)
    return promised < least and result.solution.cost > _STUCK * promised


def _adds_a_kind(smaller: ValidatedModel, larger: ValidatedModel) -> bool:
    """Whether dissipating laws are added to storing ones, or the other way round."""
    few, many = Counter(smaller.families), Counter(larger.families)
    old, new = set(few), set(many - few)
    return few < many and (
        (old <= STORING and new <= DISSIPATING) or (old <= DISSIPATING and new <= STORING)
    )


def adds_an_imitator(before: ValidatedModel, after: ValidatedModel) -> bool:
    """Whether friction is added to hysteresis, or vice versa: each corrects the other's formula."""
    return set(after.families) >= REMEMBERING and len(REMEMBERING & set(before.families)) == 1


class Ratio(NamedTuple):
    """Ratio of two models' RMS residuals out of sample, and the ends of its interval."""

    value: float
    low: float
    high: float


def error_ratio(other: ValidatedModel, best: ValidatedModel, level: float) -> Ratio:
    """RMS residual of a model over that of another; beyond each end with a probability of `level`.

    The scatter is that of the logarithm when each block is left out (jackknife): a stop that is
    reached in few blocks makes the sums of squares scatter as much as they differ. Where one block
    has all but all of them, nothing remains to estimate a scatter by: the ratio is then that in the
    blocks, each by itself (geometric mean), if its interval lies higher.
    """
    costs = [np.maximum(model.block_costs, _TINY) for model in (other, best)]
    blocks = len(costs[0])
    left_out = [np.maximum(cost.sum() - cost, _TINY) for cost in costs]
    jackknifed, each = (0.5 * np.log(a / b) for a, b in (left_out, costs))
    whole = 0.5 * math.log(costs[0].sum() / costs[1].sum())
    ratios = (
        (whole, math.sqrt((blocks - 1) * float(np.var(jackknifed)))),
        (float(np.mean(each)), float(np.std(each, ddof=1)) / math.sqrt(blocks)),
    )
    quantile = float(student.isf(level, blocks - 1))
    middle, error = max(ratios, key=lambda ratio: ratio[0] - quantile * ratio[1])
    half = quantile * error
    return Ratio(*(math.exp(middle + change) for change in (0.0, -half, half)))


def standard_error(a: ValidatedModel, b: ValidatedModel) -> float:
    """Standard error of the difference of two out-of-sample sums over blocks."""
    difference = a.block_costs - b.block_costs
    return float(np.sqrt(len(difference)) * np.std(difference, ddof=1))
