"""From the fitted models to the reported one: without superfluous laws and corrections."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.calling import arguments
from rig.diagnosis.outcome import RejectedEffect
from rig.diagnosis.problem.channel_delays import is_undetermined
from rig.diagnosis.problem.problem import (
    Candidate,
    CandidateModel,
    LinearParameter,
    Problem,
    StrutEffect,
    mid_stroke_m,
    nominal,
    strut_constants,
)
from rig.diagnosis.progress import Progress
from rig.diagnosis.search.evidence import LeftOutGains, are_by_chance, weigh_laws
from rig.diagnosis.search.explore import FirstRound
from rig.diagnosis.search.fit import CLOCK, Fit, fit, fit_covariance, law_values, model_for
from rig.diagnosis.search.pool import FINAL, FULL, Pool, ValidatedModel, adds_an_imitator
from rig.diagnosis.search.poor_motions import rivals_of_poor_motion, springs_and_dampers
from rig.diagnosis.search.rejections import list_rejections, residual_left
from rig.diagnosis.search.screen import (
    as_screening,
    candidate_laws,
    no_law,
    rank_laws,
    refine,
    scale_law,
)
from rig.diagnosis.search.validity import SCALED_BY_GAIN, find_unidentifiable_law

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_GENERAL = 2
"""Laws of a family that are tried for a simpler one, best along the motion first."""
_MORE_FITS, _STILL_FALLING = 3, 0.95
"""Fits of a simpler model in addition, as long as each reduces its cost by a twentieth."""
_BY_CHANCE = "chance gains as much on blocks left out of the fit, at a level of {:g}"
_TIED, _MOST_TIED = 4.0, 3
"""Statistic up to which two sets of corrections are as likely (two standard deviations), and how
many other sets are fitted."""
_ALIKE = 0.01
"""Difference of two shares up to which they count as one, however narrow their intervals."""


class SearchResult(NamedTuple):
    """The result of a search.

    Attributes:
        given: The nominal model, only initial states fitted.
        lawless: The same with significant corrections alone.
        rivals: Models with other families that the data cannot distinguish from it.
        superfluous: Existing effects, by index, without which the data are as well described.
        left: RMS residual of the chosen model, out of sample, as a share of the best linear one's;
            None where it has no law.
        evidence: Gains by each law of the chosen model on blocks left out of fits.
        gain_alike: Whether a gain of the applied force replaces mass, stiffness and damping, or two
            of them, that changed in one proportion.
        alike: The chosen model, followed by models with another correction for one of its own that
            the data cannot distinguish from it; empty where there are none.
    """

    given: Fit
    linear: ValidatedModel
    lawless: ValidatedModel
    chosen: ValidatedModel
    rivals: tuple[ValidatedModel, ...]
    superfluous: tuple[int, ...]
    rejected: tuple[RejectedEffect, ...]
    left: float | None
    evidence: Mapping[StrutEffect, LeftOutGains]
    gain_alike: bool
    alike: tuple[Fit, ...]

    def rejections(self, problem: Problem, why: str) -> tuple[RejectedEffect, ...]:
        """The chosen laws as rejected ones, for a reason that held-out data give."""
        return tuple(
            RejectedEffect(effect(name).family, name, problem.spec.struts[at].name, why, self.left)
            for at, name in self.chosen.fit.candidate.new
        )

    def with_rejected(
        self, problem: Problem, taken_back: Sequence[RejectedEffect]
    ) -> "SearchResult":
        """The result with laws of larger models, taken back, first among the rejected ones."""
        chosen = {
            (problem.spec.struts[at].name, name) for at, name in self.chosen.fit.candidate.new
        }
        back = {(it.strut, it.name): it for it in taken_back if (it.strut, it.name) not in chosen}
        rest = (it for it in self.rejected if (it.strut, it.name) not in back)
        return self._replace(rejected=(*back.values(), *rest))

    def without_laws(self, problem: Problem, why: str) -> "SearchResult":
        """The result with the laws taken back, for a reason that held-out data give."""
        return self._replace(
            chosen=self.lawless,
            rivals=(),
            rejected=(*self.rejections(problem, why), *self.rejected),
            left=None,
            evidence={},
            alike=(),
        )


def select_model(
    pool: Pool,
    first: Pool,
    first_round: FirstRound | None,
    most_laws: int,
    progress: Progress,
) -> SearchResult:
    """The result of a search; `first` are the models about the linear one, for rejected laws."""
    progress("removing superfluous laws", 0.85)
    is_repeated, rejected = False, ()
    single = [it.laws[-1] for it in first_round.screenings] if first_round else []
    while True:
        best = pool.chosen(most_laws)
        chosen = _without_superfluous_laws(pool, best, progress)
        final, full, is_gain, with_gain = _with_few_corrections(pool, chosen)
        why = find_unidentifiable_law(pool.problem, final.fit) if final.size else None
        if why is not None:
            pool.reject(chosen.fit.candidate, why)
            # Data that do not determine so many laws determine no larger number of others.
            most_laws = chosen.size
            _attempt_plainer(pool, chosen)
            continue
        evidence = weigh_laws(pool, first, single, chosen)
        if are_by_chance(pool, chosen, evidence):
            pool.reject(chosen.fit.candidate, _BY_CHANCE.format(pool.criteria.level))
            most_laws = chosen.size - 1
            continue
        # A rival that was fitted until converged may be the better model.
        known = best.fit.candidate, chosen.fit.candidate
        if is_repeated or pool.chosen(most_laws).fit.candidate in known:
            break
        is_repeated = True
    progress("comparing rivals", 0.9)
    rivals = _rivals(pool, chosen) or rivals_of_poor_motion(pool, final) or with_gain
    superfluous = _superfluous_effects(pool, chosen)
    lawless = _with_few_corrections(pool, pool.linear).model if final.size else final
    alike = () if is_gain else _with_other_corrections(pool, full, final.fit)
    if first_round is not None:
        rejected = list_rejections(pool, first, first_round, final, rivals)
    left = residual_left(pool, final) if final.size else None
    return SearchResult(
        pool.given, pool.linear, lawless, final, rivals, superfluous, rejected, left, evidence,
        is_gain, alike,
    )  # fmt: skip


# --- superfluous laws -------------------------------------------------------------------------


def _without_superfluous_laws(
    pool: Pool, chosen: ValidatedModel, progress: Progress
) -> ValidatedModel:
    """The model with each law removed, or replaced by a simpler one, where that loses nothing.

    A law is also replaced by a better one of another family, if it degenerates to a law of that:
    friction with pre-sliding was found as friction behind play.
    """
    while True:
        laws, most = chosen.fit.candidate.new, cache(partial(_most_promising_cost, pool, chosen))
        smaller = [
            other
            for law in laws
            for other in _smaller_models(pool, chosen, law, most, progress)
            if not pool.prefers(chosen, other)
        ]
        if smaller:
            # Of two formulas for one effect that imitate each other, the better one stays.
            chosen = min(smaller, key=lambda model: model.cost)
            continue
        simpler = (
            other
            for law in laws
            for other in _with_one_of(pool, chosen, law, effect(law[1]).simpler, most, progress)
            # Beside hysteresis friction for a damper is no simpler law, but a part of a formula.
            if not (pool.prefers(chosen, other) or adds_an_imitator(chosen, other))
        )
        better = (
            other
            for law in laws
            for other in _with_one_of(
                pool, chosen, law, _neighbours(pool.problem, law), most, progress
            )
            if pool.prefers(other, chosen)
        )
        other = next(chain(simpler, better), None)
        if other is None:
            return chosen
        chosen = other


def _smaller_models(
    pool: Pool,
    chosen: ValidatedModel,
    law: StrutEffect,
    most: Callable[[], float],
    progress: Progress,
) -> Iterable[ValidatedModel]:
    """Models without a law of a chosen one; fitted on demand.

    `most` is the largest cost along the motion from which on a fit is not tried.
    """
    if chosen.size < 2:
        return
    stage, known = pool.linear_stage, law_values(pool.problem, chosen.fit)
    less = chosen.fit.candidate.without(law)
    progress(f"fitting without {law[1]}", 0.85)
    # Its first fit may have ended in a side valley, which the larger model has left; and the
    # larger model's linear part may suit its laws alone.
    is_fitted = less in pool.fits and pool.is_near(pool.fits[less], chosen)
    is_fitted |= less in pool.converged and less in pool.invalid
    if not is_fitted:
        along = refine(stage, less.new, [known[other] for other in less.new])
        if along is not None and along.promising_cost <= most():
            pool.attempt(model_for(pool.problem, chosen.fit.model, less))
            pool.attempt_screening(stage, pool.linear, along)
    yield from _converge_candidate(pool, less, chosen)
    yield from _with_more_general(pool, less, chosen, progress)


def _with_more_general(
    pool: Pool, less: Candidate, chosen: ValidatedModel, progress: Progress
) -> Iterable[ValidatedModel]:
    """Smaller models with a more general law of a family for one of theirs.

    What a chosen model's laws leave without one of them may be due to their formulas: the valves of
    a damper stood in for what Coulomb's friction lacks of Stribeck's.
    """
    model = pool.fits.get(less)
    if model is None or less in pool.invalid or not pool.is_formula(model):
        return
    known = law_values(pool.problem, model.fit)
    for law in less.new:
        others = less.without(law)
        general = [at for at in candidate_laws(pool.problem) if _is_more_general(at, law)]
        progress(f"fitting more general laws than {law[1]}", 0.85)
        base = as_screening(others.new, known)
        for screening in rank_laws(pool.linear_stage, base, len(general), general)[:_GENERAL]:
            candidate = others.with_effects(screening.laws[-1])
            if screening.values and candidate not in pool.fits:
                pool.attempt_screening(pool.linear_stage, pool.linear, screening, FULL)
            yield from _converge_candidate(pool, candidate, chosen)


def _is_more_general(law: StrutEffect, other: StrutEffect) -> bool:
    a, b = effect(law[1]), effect(other[1])
    return law[0] == other[0] and a.family == b.family and b.name in a.simpler


def _with_one_of(
    pool: Pool,
    chosen: ValidatedModel,
    law: StrutEffect,
    names: Iterable[str],
    most: Callable[[], float],
    progress: Progress,
) -> Iterable[ValidatedModel]:
    """Models with another law for one of a chosen one's, in the same strut; fitted on demand."""
    stage, known = pool.linear_stage, law_values(pool.problem, chosen.fit)
    less = chosen.fit.candidate.without(law)
    for name in names:
        other = (law[0], name)
        if effect(name).linear or other in less.new:
            continue
        candidate = less.with_effects(other)
        progress(f"fitting {name} instead of {law[1]}", 0.85)
        if candidate not in pool.fits:
            for screening in rank_laws(stage, as_screening(less.new, known), 1, [other]):
                if screening.values and screening.promising_cost <= most():
                    pool.attempt_screening(stage, pool.linear, screening, FULL)
            _attempt_about_model_file(pool, chosen, law, other)
        yield from _converge_candidate(pool, candidate, chosen)


def _attempt_about_model_file(
    pool: Pool, chosen: ValidatedModel, law: StrutEffect, other: StrutEffect
) -> None:
    """Fit a law that reads the strut's spring, with those parameters that another one has too.

    Beside the best linear model's spring it is another law than beside the model file's: that of
    a spring with free play is the spring of play and stroke together.
    """
    known = law_values(pool.problem, chosen.fit)
    item, own = effect(other[1]), effect(law[1]).named(known[law])
    reads_strut = any(read.origin == "strut" for read in arguments(item.force, item))
    if not reads_strut or not all(p.name in own for p in item.parameters):
        return
    values = {at: those for at, those in known.items() if at != law}
    values[other] = np.array([own[p.name] for p in item.parameters])
    candidate = nominal(pool.problem).with_effects(*values)
    pool.attempt_at_nominal(candidate, values, chosen.fit.mean_square)


def _neighbours(problem: Problem, law: StrutEffect) -> list[str]:
    """Other laws of the families, not its own, to which a law degenerates."""
    strut, name = law
    own, simpler = effect(name).family, effect(name).simpler
    families = {effect(other).family for other in simpler if not effect(other).linear} - {own}
    return [
        other
        for at, other in candidate_laws(problem)
        if at == strut and effect(other).family in families and other not in simpler
    ]


def _most_promising_cost(pool: Pool, model: ValidatedModel) -> float:
    """Largest cost along the motion, where a fit costs little, of laws that may replace others."""
    stage, known = pool.linear_stage, law_values(pool.problem, model.fit)
    screening = refine(stage, tuple(known), list(known.values()))
    criteria, lawless = pool.criteria, no_law(stage).validation_cost
    near = 0.0 if screening is None else criteria.hopeless * screening.validation_cost
    return max(near, criteria.formula**2 * lawless)


def _converge_candidate(
    pool: Pool, candidate: Candidate, chosen: ValidatedModel
) -> Iterable[ValidatedModel]:
    """A candidate's model, converged if it is near the chosen one; empty without a valid fit."""
    if candidate in pool.fits:
        pool.converge(pool.fits[candidate], chosen)
        _continue_while_it_helps(pool, candidate, chosen)
        if candidate not in pool.invalid:
            yield pool.fits[candidate]


def _continue_while_it_helps(pool: Pool, candidate: Candidate, chosen: ValidatedModel) -> None:
    """Fit a simpler model on, while its steps are short and it is not yet as good as a chosen one.

    Where a contact moves, steps are short for many iterations.
    """
    for _ in range(_MORE_FITS):
        before = pool.fits[candidate]
        if not (pool.is_near(before, chosen) and pool.prefers(chosen, before)):
            return
        pool.attempt(before.fit.model, FULL)
        if pool.fits[candidate].cost > _STILL_FALLING * before.cost:
            return


def _attempt_plainer(pool: Pool, unidentified: ValidatedModel) -> None:
    """Fit laws of the same families with fewer parameters, of which data determine more."""
    known = law_values(pool.problem, unidentified.fit)
    most = _most_promising_cost(pool, unidentified)
    for law in unidentified.fit.candidate.new:
        less = unidentified.fit.candidate.without(law).new
        base = as_screening(less, known)
        plainer = [at for at in candidate_laws(pool.problem) if _is_plainer(at, law)]
        for screening in rank_laws(pool.linear_stage, base, len(plainer), plainer)[
            : pool.criteria.fitted_a_size
        ]:
            if screening.values and screening.promising_cost <= most:
                pool.attempt_screening(pool.linear_stage, pool.linear, screening, FULL)


def _is_plainer(law: StrutEffect, other: StrutEffect) -> bool:
    a, b = effect(law[1]), effect(other[1])
    alike = law[0] == other[0] and a.family == b.family
    return alike and len(a.parameters) < len(b.parameters)


def _rivals(pool: Pool, chosen: ValidatedModel) -> tuple[ValidatedModel, ...]:
    """Models of the same size and other families that the data cannot distinguish from a model."""
    rivals: dict[tuple[str, ...], ValidatedModel] = {}
    for other in sorted(pool.valid(), key=lambda model: model.cost):
        if other.size != chosen.size or other.families in (chosen.families, *rivals):
            continue
        if not _is_degenerate(other, chosen) and pool.is_rival(other, chosen):
            rivals[other.families] = other
    return tuple(rivals.values())


def _is_degenerate(other: ValidatedModel, chosen: ValidatedModel) -> bool:
    """Whether a model is the chosen one but for laws that degenerate to its laws."""
    more = set(other.fit.candidate.new) - set(chosen.fit.candidate.new)
    less = set(chosen.fit.candidate.new) - set(other.fit.candidate.new)
    return all(any(at == s and n in _simpler_names(name) for s, n in less) for at, name in more)


def _simpler_names(name: str) -> set[str]:
    direct = set(effect(name).simpler)
    return direct.union(*(_simpler_names(other) for other in direct)) if direct else direct


def _superfluous_effects(pool: Pool, chosen: ValidatedModel) -> tuple[int, ...]:
    """Existing effects, by index, that act on the recordings and can be removed without loss."""
    superfluous: list[int] = []
    problem, reference = pool.problem, chosen.fit
    for i in reference.candidate.kept:
        if not problem.existing[i].free:
            continue
        kept = tuple(j for j in reference.candidate.kept if j != i)
        candidate = Candidate(kept, reference.candidate.new)
        result = pool.refit(model_for(problem, reference.model, candidate), effort=FULL)
        if result is not None and not pool.prefers(chosen, pool.validate(result)):
            superfluous.append(i)
    return tuple(superfluous)


# --- insignificant linear corrections ---------------------------------------------------------


class _FewCorrections(NamedTuple):
    """A model with significant linear corrections alone.

    Attributes:
        full: The fit with all corrections.
        is_gain: Whether a gain of the applied force replaces other corrections.
        rivals: The model with such a gain, where it replaces as much, but the mass is then farther
            from the model file's.
    """

    model: ValidatedModel
    full: Fit
    is_gain: bool
    rivals: tuple[ValidatedModel, ...] = ()


def _with_few_corrections(pool: Pool, chosen: ValidatedModel) -> _FewCorrections:
    """The chosen model, converged, with significant linear corrections alone."""
    problem = pool.problem
    converged = fit(problem, chosen.fit.model, chosen.fit.free, FINAL)
    if converged is not None:
        chosen = pool.validate(converged)
    result = _with_significant_corrections(pool, chosen)
    if not result.size and not pool.prefers(result, as_given := pool.validate(pool.given)):
        # Corrections that differ from zero and change nothing that can be measured.
        return _FewCorrections(as_given, chosen.fit, is_gain=False)
    few = _FewCorrections(result, chosen.fit, is_gain=False)
    begun = _begin_with_gain(problem, result.fit, chosen.fit)
    refitted = None if begun is None else fit(problem, *begun, FINAL)
    if begun is None or refitted is None:
        return few
    before, after = result.fit.parts.linear, begun[0].parts.linear
    replaced = [
        1.0 + before[i] / p.nominal
        for i, p in enumerate(problem.linear)
        if p.kind in SCALED_BY_GAIN and result.fit.free[i] and not begun[1][i]
    ]
    apart = (max(replaced) - min(replaced)) / max(replaced)
    lean = pool.validate(refitted)
    if apart > CLOCK and pool.prefers(result, lean):
        return few
    if not _contradicts_prior(problem, before, after, pool.criteria.significant):
        return few._replace(model=_with_significant_corrections(pool, lean), is_gain=True)
    # What is as improbable as that two changes are alike to a hundredth by chance is a rival.
    return few._replace(rivals=(lean,)) if apart < _ALIKE else few


def _with_significant_corrections(pool: Pool, chosen: ValidatedModel) -> ValidatedModel:
    """A model with those of its linear corrections alone that differ from zero.

    They are looked at again once others are gone: what offset these may then be zero itself.
    """
    significant = _significant_corrections(pool, chosen.fit)
    while True:
        candidate, parts = chosen.fit.model
        parts = parts._replace(linear=np.where(significant, parts.linear, 0.0))
        fewer = fit(pool.problem, CandidateModel(candidate, parts), significant, FINAL)
        if fewer is None or pool.prefers(chosen, lean := pool.validate(fewer)):
            return chosen
        significant = _significant_corrections(pool, fewer)
        if np.array_equal(significant, fewer.free):
            return lean
        chosen = lean


def _significant_corrections(pool: Pool, result: Fit) -> Flags:
    """Which of a fit's linear parameters a model keeps, shape (L,).

    A correction that is finer than a clock is none.
    """
    significant = _significant_parameters(result, pool.criteria.significant)
    nominals = np.array([p.nominal for p in pool.problem.linear])
    corrections = result.parts.linear
    significant &= np.abs(corrections) > CLOCK * np.abs(nominals + corrections)
    # Where the data do not show a delay, spring and damper are known no better than it.
    for i, p in enumerate(pool.problem.linear):
        significant[i] |= is_undetermined(p) and bool(springs_and_dampers(pool, significant))
    return significant


def _with_other_corrections(pool: Pool, full: Fit, lean: Fit) -> tuple[Fit, ...]:
    """A model with another correction in place of one of its own, where the data cannot say which.

    A stiffness may be replaced by a free length if a law is about that. What follows for the laws
    belongs to their uncertainty: which corrections are significant was chosen by the same data.
    `full` is the model with all corrections.
    """
    fits: list[Fit] = []
    for free in _tied_corrections(full, lean.free):
        linear = np.where(free, full.parts.linear, 0.0)
        first = CandidateModel(lean.candidate, lean.parts._replace(linear=linear))
        other = fit(pool.problem, first, free, FINAL)
        if (
            other is not None
            and other.solution.cost < lean.solution.cost + _TIED * lean.solution.level
        ):
            fits.append(other)
    return (lean, *fits) if fits else ()


def _tied_corrections(full: Fit, kept: Flags) -> list[Flags]:
    """Sets with another correction for one that is kept, and as small a loss; best first.

    The loss is Wald's statistic of what is left out, each kept set of shape (L,).
    """
    variables = np.flatnonzero(full.free)
    count = len(variables)
    covariance = fit_covariance(full).covariance[:count, :count]
    x = full.space.inner(full.solution.values)[:count]

    def loss(free: Flags) -> float:
        out = np.flatnonzero(~free[variables])
        return float(x[out] @ np.linalg.pinv(covariance[np.ix_(out, out)]) @ x[out])

    most = loss(kept) + _TIED
    tied: list[tuple[float, int, Flags]] = []
    for i in np.flatnonzero(kept & full.free).tolist():
        for j in np.flatnonzero(full.free & ~kept).tolist():
            other = kept.copy()
            other[i], other[j] = False, True
            if (other_loss := loss(other)) < most:
                tied.append((other_loss, len(tied), other))
    return [flags for _, _, flags in sorted(tied)[:_MOST_TIED]]


def _significant_parameters(result: Fit, significant: float) -> Flags:
    """Which linear parameters differ from zero, shape (L,).

    Backward elimination by Wald's test with the covariance of an autocorrelated residual.
    """
    variables = np.flatnonzero(result.free)
    count = len(variables)
    covariance = fit_covariance(result).covariance[:count, :count].copy()
    x = result.space.inner(result.solution.values)[:count].copy()
    remaining = list(range(count))
    while remaining:
        part = np.array(remaining)
        sizes = np.abs(x[part]) / np.sqrt(np.maximum(np.diag(covariance)[part], 1e-300))
        worst = int(part[np.argmin(sizes)])
        if float(np.min(sizes)) >= significant:
            break
        # The others, given that this one is zero.
        x = x - covariance[:, worst] / max(covariance[worst, worst], 1e-300) * x[worst]
        outer = np.outer(covariance[:, worst], covariance[worst])
        covariance = covariance - outer / max(covariance[worst, worst], 1e-300)
        remaining.remove(worst)
    needed = np.zeros_like(result.free)
    needed[variables[remaining]] = True
    return needed


def _begin_with_gain(
    problem: Problem, result: Fit, full: Fit
) -> tuple[CandidateModel, Flags] | None:
    """Where a fit with a gain in place of other corrections begins, and what is free in it, (L,).

    None where a gain saves none. `full` is the fit with all corrections.
    """
    gain = _corrections_as_gain(problem, result, full)
    if gain is None:
        return None
    linear, free = gain
    (factor,) = (1.0 + linear[i] for i, p in enumerate(problem.linear) if p.kind == "gain")
    # All forces were in the wrong proportion to the applied one: the laws', too.
    laws: dict[int | StrutEffect, Array] = {}
    for law, values in law_values(problem, result).items():
        scaled = scale_law(law[1], values, float(factor))
        if scaled is None:
            return None
        laws[law] = scaled
    bare = model_for(problem, result.model, Candidate(result.candidate.kept, ()))
    return model_for(problem, bare.with_linear(linear), result.candidate, laws), free


def _corrections_as_gain(problem: Problem, result: Fit, full: Fit) -> tuple[Array, Flags] | None:
    """Fewer corrections, one of which is the gain of the applied force; None where it saves none.

    The gain is degenerate with mass, stiffness and damping changed in one proportion. Those of them
    that changed so, within their intervals, are then nominal. With several struts a mass carries
    others, and there is no such degeneracy.

    The result is where to begin, and which linear parameters are free, shapes (L,).
    """
    linear = problem.linear
    if len(problem.motions) > 1 or not any(p.kind == "gain" for p in linear):
        return None
    scaled = {i for i, p in enumerate(linear) if p.kind in SCALED_BY_GAIN and p.nominal > 0.0}
    shares, all_shares = (_shares_of_nominal(problem, it, scaled) for it in (result, full))
    alike: set[int] = set()
    for middle, _ in shares.values():
        same = {i for i, (share, known) in shares.items() if abs(share - middle) < known}
        alike = max(alike, same, key=len)
    share = float(np.median([shares[i][0] for i in alike])) if alike else 0.0
    # For the gain to replace the others, those that did not change would have to: those that are
    # known not to have changed as much, beside laws that do not stand for them.
    unchanged = 0
    for i in scaled - set(np.flatnonzero(result.free).tolist()):
        middle, known = all_shares.get(i, (0.0, _ALIKE))
        unchanged += abs(middle - share) > known
    if len(alike) < 2 + unchanged:
        return None
    changes, free = result.parts.linear.copy(), result.free.copy()
    for i, p in enumerate(linear):
        if p.kind == "gain":
            changes[i], free[i] = 1.0 / (1.0 + share) - 1.0, True
        elif i in alike:
            changes[i], free[i] = 0.0, False
        elif p.kind not in ("free_length", "delay", "height_gain"):
            whole = p.nominal if i in scaled else _force_at_mid_stroke(problem, p)
            changes[i] = (whole + changes[i]) / (1.0 + share) - whole
            free[i] |= p.kind == "preload"
    return changes, free


def _shares_of_nominal(
    problem: Problem, result: Fit, indices: Collection[int]
) -> dict[int, tuple[float, float]]:
    """Corrections as shares of the nominal values, by index, and how well each is known."""
    half, values = fit_covariance(result).half, result.solution.values
    shares: dict[int, tuple[float, float]] = {}
    for i, index in enumerate(np.flatnonzero(result.free).tolist()):
        p = problem.linear[index]
        if index in indices and values[i] > p.least:
            known = max(half[i] * p.deviation / p.nominal, _ALIKE)
            shares[index] = float(values[i]) / p.nominal, float(known)
    return shares


def _force_at_mid_stroke(problem: Problem, parameter: LinearParameter) -> float:
    """Force in N of the spring where its stiffness is corrected, for a preload; else zero."""
    if parameter.kind != "preload":
        return 0.0
    constants = strut_constants(problem, np.zeros(len(problem.linear)))
    free_m, stiffness = constants[parameter.strut, :2]
    middle_m = mid_stroke_m(problem.motions[parameter.strut])
    return float(parameter.nominal - stiffness * (middle_m - free_m))


def _contradicts_prior(problem: Problem, before: Array, after: Array, significant: float) -> bool:
    """Whether corrections are farther from the model's tolerances: of a mass, or all together.

    The gain counts if the model file states its tolerance: it replaces several corrections.
    """
    stated = problem.spec.tolerance
    is_gain_known = stated is not None and stated.input_gain is not None
    counts = [p.kind != "gain" or is_gain_known for p in problem.linear]
    deviations = np.where(counts, [p.deviation for p in problem.linear], np.inf)
    masses = [p.kind == "mass" for p in problem.linear]
    if np.any(np.abs(after[masses]) > np.abs(before[masses])):
        return True
    farther = np.sum((after / deviations) ** 2) - np.sum((before / deviations) ** 2)
    return bool(farther > significant**2)
