"""From recordings and a nominal model to a diagnosis."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dart_model.effects import effect
from dart_model.spec import ModelSpec
from rig.diagnosis.evaluate import evaluate_held_out, fit_as_given, weigh_on_held_out
from rig.diagnosis.numerics.blas import with_one_blas_thread
from rig.diagnosis.numerics.laws import SLOTS
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.outcome import RejectedEffect, Result, Verdict
from rig.diagnosis.problem.build import Problems, build_problems, part_of, with_tones
from rig.diagnosis.problem.delay_estimate import search_delays_beyond
from rig.diagnosis.problem.problem import (
    CandidateModel,
    Problem,
    ResidualForces,
    RunEvaluation,
    free_linear,
    nominal,
    quadratic_mean,
    rms,
)
from rig.diagnosis.progress import Progress, no_progress, within
from rig.diagnosis.search.criteria import CRITERIA, SelectionCriteria
from rig.diagnosis.search.explore import FirstRound, search_about_models, search_along_motion
from rig.diagnosis.search.fit import WITH_MEMORY, Fit, fit
from rig.diagnosis.search.model_selection import SearchResult, select_model
from rig.diagnosis.search.pool import Pool, ValidatedModel
from rig.diagnosis.search.surface import fit_surface
from rig.diagnosis.verdict import HeldOutLaws, find_reason_against_laws, find_verdict
from rig.diagnosis.write_up import compose_result
from rig.recordings.recording import Recording, RecordingError

_SEARCHED_NODES = 32_000
"""Nodes of all recordings that are searched, half a minute at 1 kHz; with more than twice as many,
in pieces spread over them."""


_EXPLAINED = ("nothing_missing", "explained", "ambiguous")
"""Verdicts where a model leaves noise alone."""

_MUCH_LESS = 0.5
"""Error of a model with gains over that of one without from which on it counts unless it explains:
a gain of 3 %, where other effects were found in part, made the error 27 times as large."""


_LESS_WITHOUT = "taken back: no law explains the held-out data, and a model without it errs less"


class _Found(NamedTuple):
    """A search's result, with the problems as they are known in the end."""

    problems: Problems
    search: SearchResult
    evaluations: tuple[RunEvaluation, ...]
    laws: HeldOutLaws
    verdict: Verdict


@with_one_blas_thread
def diagnose(
    spec: ModelSpec,
    runs: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    progress: Progress = no_progress,
    criteria: SelectionCriteria = CRITERIA,
) -> Result:
    """Trace what a nominal model lacks to named effects, correct it, and evaluate the correction.

    Args:
        spec: The nominal model.
        runs: Recordings to learn from.
        held_out: Recordings to evaluate on; without them, blocks spread over `runs` are held out.
        progress: Called with what is being done and the share that is done.
        criteria: What decides.

    Raises:
        RecordingError: A recording or the model cannot be used; one line says why.
    """
    if not runs:
        raise RecordingError("no run given, expected at least one")
    existing, most = sum(len(s.effects) for s in spec.struts), SLOTS - criteria.most_laws
    if existing > most:
        raise RecordingError(f"model {spec.name}: {existing} effects, expected at most {most}")
    progress("reading runs", 0.01)
    problems = build_problems(spec, runs, held_out, criteria.blocks, criteria.held_out_every)
    result = _diagnose_problems(problems, criteria, progress)
    progress("done", 1.0)
    gaps = (run.gaps.report(run.name) for run in (*runs, *held_out) if run.gaps)
    diagnosis = result.diagnosis
    return replace(result, diagnosis=replace(diagnosis, notes=(*diagnosis.notes, *gaps)))


def _diagnose_problems(
    problems: Problems, criteria: SelectionCriteria, progress: Progress
) -> Result:
    found = _find(problems, criteria, progress)
    if problems.learnt.height_gains and _may_be_gains(found):
        progress("searching again with gains of the heights", 0.03)
        other = _find(_with_gains(problems), criteria, progress)
        if _is_better(other, found):
            found = other
    problems, search, evaluations, laws, verdict = found
    if verdict == "not_explained":
        progress("tabulating the force that no law explains", 0.97)
        search, evaluations = _least_error_model(problems, search, evaluations)
    return compose_result(
        problems.learnt, search, verdict, evaluations, laws, criteria, by_blocks=problems.by_blocks
    )


def _may_be_gains(found: _Found) -> bool:
    """Whether gains of heights may be what a model lacks, or stands in for.

    They are considered where no law explains, and where one with an internal state does: a further
    mass of 2 % of the body was named for a gain that is wrong by 2 %.
    """
    families = {effect(name).family for _, name in found.search.chosen.fit.candidate.new}
    return found.verdict not in _EXPLAINED or not families.isdisjoint(WITH_MEMORY)


def _is_better(other: _Found, found: _Found) -> bool:
    """Whether a model with gains replaces one without: it explains, or errs much less."""
    if found.verdict in _EXPLAINED:
        return other.verdict in _EXPLAINED and other.search.chosen.size < found.search.chosen.size
    if other.verdict in _EXPLAINED:
        return True
    return _error(other.evaluations) < _MUCH_LESS * _error(found.evaluations)


def _with_gains(problems: Problems) -> Problems:
    """The problems with the gains of all heights among what is corrected."""
    linear = (*problems.learnt.linear, *problems.learnt.height_gains)
    return problems._replace(
        learnt=replace(problems.learnt, linear=linear),
        held_out=replace(problems.held_out, linear=linear),
    )


def _find(problems: Problems, criteria: SelectionCriteria, progress: Progress) -> _Found:
    """What a search finds, and what held-out data show of it.

    Laws that held-out data take back give way to the best model of fewer.
    """
    explored = _explore(problems.learnt, criteria, progress)
    problem = explored.last.problem
    held_out = replace(problems.held_out, motions=problem.motions)
    problems = problems._replace(learnt=problem, held_out=held_out)
    most_laws, taken_back = criteria.most_laws, list[RejectedEffect]()
    while True:
        search = _select(explored, most_laws, progress)
        progress("evaluating on held-out data", 0.95)
        linear = search.linear.fit
        evaluations = evaluate_held_out(problems, linear, search.chosen.fit)
        laws = weigh_on_held_out(problems, search.chosen.fit)
        why = find_reason_against_laws(problem, linear, evaluations, laws, criteria)
        if not search.chosen.size or why is None:
            break
        taken_back += search.rejections(problem, why)
        most_laws = search.chosen.size - 1
    search = search.with_rejected(problem, taken_back)
    verdict = find_verdict(problem, evaluations, search, laws, criteria)
    return _Found(problems, search, evaluations, laws, verdict)


def _least_error_model(
    problems: Problems, search: SearchResult, evaluations: tuple[RunEvaluation, ...]
) -> tuple[SearchResult, tuple[RunEvaluation, ...]]:
    """The model with the least held-out error where no law explains: laws, a table, or neither."""
    table = fit_surface(problems.learnt, search.linear.fit)
    for other in (*([] if table is None else [table]), search.lawless.fit, search.given):
        others = evaluate_held_out(problems, search.linear.fit, other)
        if _error(others) < _error(evaluations):
            if search.evidence:
                search = search.without_laws(problems.learnt, _LESS_WITHOUT)
            evaluations = others
            search = search._replace(chosen=search.chosen._replace(fit=other), alike=())
    return search, evaluations


def _error(evaluations: Sequence[RunEvaluation]) -> float:
    return quadratic_mean([run.target.after for run in evaluations])


class _Explored(NamedTuple):
    """Models that were fitted in a search.

    Attributes:
        first: Those about the linear model.
        last: Those about the best model, of all recordings, with noise and tones as they are known
            in the end.
        first_round: Single laws along the motion, where they were searched.
    """

    first: Pool
    last: Pool
    first_round: FirstRound | None


def _explore(problem: Problem, criteria: SelectionCriteria, progress: Progress) -> _Explored:
    """Search, long recordings in pieces."""
    progress("fitting the linear part", 0.03)
    fits = first_fits(problem)
    problem = with_noise_of_least_force(problem, fits)
    part = part_of(problem, _SEARCHED_NODES)
    quick = problem.coarser(fits[1].model)
    if part is problem:
        return _explore_twice(quick, fits, criteria, within(progress, 0.05, 0.85))
    of_part = first_fits(part)
    explored = _explore_twice(
        part.coarser(of_part[1].model), of_part, criteria, within(progress, 0.05, 0.6)
    )
    last = _fit_to_all(quick, fits, explored.last, within(progress, 0.6, 0.85))
    return explored._replace(last=last)


def _select(explored: _Explored, most_laws: int, progress: Progress) -> SearchResult:
    """The model that is chosen of those with so many laws at most."""
    first, last, first_round = explored
    result = select_model(last, first, first_round, most_laws, progress)
    return result._replace(chosen=_refit_with_finer_steps(last.problem, result.chosen))


def _explore_twice(
    problem: Problem, fits: tuple[Fit, Fit], criteria: SelectionCriteria, progress: Progress
) -> _Explored:
    """Search, and search again about the best model: its free run is nearer to the measurement.

    The noise, too, is only known once a model is near: the residual of a poor one is smooth.
    """
    given, linear = fits
    first = Pool(problem, given, [linear], criteria)
    first_round = search_along_motion(first, within(progress, 0.0, 0.3))
    found = first.chosen(criteria.most_laws).fit
    problem = search_delays_beyond(_with_residual_noise(problem, found), found.parts.linear)
    seeds = [model.fit for model in (first.linear, *first.best_and_subsets())]
    second = Pool(problem, given, seeds, criteria)
    search_about_models(second, within(progress, 0.3, 1.0))
    return _Explored(first, second, first_round)


def _fit_to_all(
    problem: Problem, fits: tuple[Fit, Fit], searched: Pool, progress: Progress
) -> Pool:
    """The models of a search in pieces fitted to all; the search continues unless one is right."""
    criteria, (given, linear) = searched.criteria, fits
    found = searched.chosen(criteria.most_laws).fit
    problem = search_delays_beyond(problem, found.parts.linear)
    pool = Pool(problem, given, [linear], criteria)
    pool.adopt([found])
    # In the pieces a law may have come to rest where it is a simpler one, or beside its optimum.
    pool.screen_and_attempt(found.candidate.new)
    first = pool.chosen(criteria.most_laws).fit
    problem = _with_residual_noise(problem, first)
    pool = Pool(problem, given, [linear, first], criteria)
    models = [model.fit for model in searched.best_and_subsets()]
    pool.adopt(models, within(progress, 0.0, 0.5))
    pool.converge_best()
    if not pool.is_formula(pool.least()):
        search_about_models(pool, within(progress, 0.5, 1.0))
    return pool


def _refit_with_finer_steps(problem: Problem, chosen: ValidatedModel) -> ValidatedModel:
    """The chosen model, fitted with finer steps: intervals are narrower than usual steps err."""
    finer = problem.finer()
    if finer is None:
        return chosen
    result = fit(finer, chosen.fit.model, chosen.fit.free, Effort(10, 1e-6))
    return chosen if result is None else chosen._replace(fit=result)


def first_fits(problem: Problem) -> tuple[Fit, Fit]:
    """The nominal model with its initial states fitted, and the best linear model.

    Raises:
        RecordingError: The nominal model runs away on the recordings.
    """
    base, given = nominal(problem), fit_as_given(problem)
    free = free_linear(problem, base)
    expected = given.parts._replace(linear=np.array([p.expected for p in problem.linear]))
    begun = CandidateModel(base, expected)
    near = fit(problem, begun, free, Effort(12), most_level=1.0) or given
    first = CandidateModel(base, near.parts)
    return given, fit(problem, first, free, Effort(12)) or near


def with_noise_of_least_force(problem: Problem, fits: tuple[Fit, Fit]) -> Problem:
    """The problem with the noise and the tones of the given or linear model's residual.

    Of that with the smaller force: the best linear model of a bench that resonates with a tone
    makes up for it by three times the mass. Its heights are nearer, its residual force is larger,
    and does not show the tone.
    """
    given, linear = fits
    residuals = [(result, _residual_forces(problem, result)) for result in (linear, given)]
    result, forces = min(residuals, key=lambda it: _force_rms_n(it[1]))
    return _with_noise_of(problem, result, forces)


def _force_rms_n(residual: Sequence[ResidualForces]) -> float:
    """RMS of residual forces; infinite where there are none."""
    every = [forces.force_n.ravel() for forces in residual]
    return rms(np.concatenate(every)) if every else np.inf


def _residual_forces(problem: Problem, result: Fit) -> list[ResidualForces]:
    """Residual forces of the recordings that have one."""
    every = (problem.residual_forces(k, result.model) for k in range(problem.recordings))
    return [forces for forces in every if forces is not None]


def _with_residual_noise(problem: Problem, result: Fit) -> Problem:
    """The problem with the noise and the tones of a fit's residual."""
    return _with_noise_of(problem, result, _residual_forces(problem, result))


def _with_noise_of(problem: Problem, result: Fit, forces: Sequence[ResidualForces]) -> Problem:
    """The same, of a fit whose residual forces are known."""
    motions = with_tones(problem, forces) if forces else problem.motions
    return replace(problem.with_noise_of(result.model), motions=motions)
