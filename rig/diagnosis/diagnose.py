"""From recordings and a nominal model to a diagnosis."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from dart_model.spec import ModelSpec
from rig.diagnosis.evaluate import Evaluated, evaluated, models_of
from rig.diagnosis.numerics.compiled import SLOTS
from rig.diagnosis.outcome import Result
from rig.diagnosis.problem.build import (
    build,
    build_held_out,
    is_prescribed,
    part_of,
    with_noise,
    with_tones,
)
from rig.diagnosis.problem.free_run import FreeRun
from rig.diagnosis.problem.prescribed_motion import Prescribed
from rig.diagnosis.problem.problem import Parts, Problem, existing_values, free_beside, nominal
from rig.diagnosis.progress import Progress, within
from rig.diagnosis.recording import Recording, RecordingError
from rig.diagnosis.search.conclude import Found, conclude
from rig.diagnosis.search.criteria import CRITERIA, SelectionCriteria
from rig.diagnosis.search.explore import FirstRound, explore
from rig.diagnosis.search.fit import Fit, fit
from rig.diagnosis.search.pool import Pool, Scored
from rig.diagnosis.search.surface import surface
from rig.diagnosis.write_up import judgement, needless, written_up

_SEARCHED_NODES = 32_000
"""Nodes of all recordings that are searched, half a minute at 1 kHz; with more than twice as many,
in pieces spread over them."""


def _quiet(_what: str, _share: float) -> None:
    return


def diagnose(
    spec: ModelSpec,
    runs: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    progress: Progress = _quiet,
    criteria: SelectionCriteria = CRITERIA,
) -> Result:
    """Trace what a nominal model lacks to named effects, correct it, and judge the correction.

    Args:
        spec: The nominal model.
        runs: Recordings to learn from.
        held_out: Recordings to judge on; without them, blocks spread over `runs` are held out.
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
    is_prescribed((*runs, *held_out))
    progress("reading runs", 0.01)
    kept_every = None if held_out else criteria.kept_every
    problem = build(spec, runs, criteria.blocks, kept_every)
    judged = build_held_out(problem, held_out) if held_out else problem
    found, problem = _searched(problem, criteria, progress)
    progress("judging on held-out data", 0.95)
    judged = replace(judged, motions=problem.motions)
    recordings = tuple(held_out or runs)

    def figures(chosen: Fit) -> tuple[Evaluated, ...]:
        models = models_of(problem, found.linear.fit, chosen)
        variance = np.nanmean(problem.noise_n**2) if isinstance(problem, Prescribed) else np.nan
        left_n = float(np.sqrt(chosen.mean_square * variance))
        return evaluated(judged, models, recordings, left_n, kept=not held_out)

    results = figures(found.chosen.fit)
    if found.chosen.size and needless(problem, found.linear.fit, results, criteria):
        found = found._replace(chosen=found.plain, rivals=())
        results = figures(found.chosen.fit)
    verdict = judgement(problem, results, found, criteria)
    if verdict == "not_explained":
        progress("tabulating what has no name", 0.97)
        found, results = _erring_least(problem, found, results, figures)
    result = written_up(problem, found, verdict, results, runs, criteria, blocks=not held_out)
    progress("done", 1.0)
    return result


def _erring_least(
    problem: Problem,
    found: Found,
    results: tuple[Evaluated, ...],
    figures: Callable[[Fit], tuple[Evaluated, ...]],
) -> tuple[Found, tuple[Evaluated, ...]]:
    """What errs least on held-out data where no law explains: the laws, a table, or neither."""
    table = surface(problem, found.linear.fit)
    for offered in (*([] if table is None else [table]), found.plain.fit, found.given):
        there = figures(offered)
        if _error(there) < _error(results):
            results = there
            found = found._replace(chosen=found.chosen._replace(fit=offered), rivals=())
    return found, results


def _error(results: Sequence[Evaluated]) -> float:
    return float(np.sqrt(np.mean([result.counted.after**2 for result in results])))


def _searched(
    problem: Problem, criteria: SelectionCriteria, progress: Progress
) -> tuple[Found, Problem]:
    """Search, long recordings in pieces, and conclude on all of them."""
    progress("fitting the linear part", 0.03)
    given, linear = first_fits(problem)
    problem = _sharpened(problem, linear)
    part = part_of(problem, _SEARCHED_NODES)
    share = within(progress, 0.05, 0.85 if part is problem else 0.6)
    fits = (given, linear) if part is problem else first_fits(part)
    first, last, seen = _explored(part, *fits, criteria, share)
    if part is not problem:
        last = _on_all(problem, given, linear, last, within(progress, 0.6, 0.85))
    found = conclude(last, first, seen, progress)
    if isinstance(last.problem, FreeRun):
        found = found._replace(chosen=_polished(last.problem, found.chosen))
    return found, last.problem


def _explored(
    problem: Problem,
    given: Fit,
    linear: Fit,
    criteria: SelectionCriteria,
    progress: Progress,
) -> tuple[Pool, Pool, FirstRound | None]:
    """Search, and once more about what was found: its free run is nearer to the measurement.

    The noise, too, is only known once a model follows: what a poor one leaves is smooth and noise.
    """
    first = Pool(problem, given, [linear], criteria)
    seen = explore(first, within(progress, 0.0, 0.55))
    problem = _sharpened(problem, first.chosen(criteria.most_laws).fit)
    seeds = [scored.fit for scored in (first.linear, *first.best_and_less())]
    second = Pool(problem, given, seeds, criteria)
    explore(second, within(progress, 0.55, 1.0))
    return first, second, seen


def _on_all(problem: Problem, given: Fit, linear: Fit, searched: Pool, progress: Progress) -> Pool:
    """What was found in pieces, fitted to all; searched on where more than a formula is missing."""
    criteria = searched.criteria
    pool = Pool(problem, given, [linear], criteria)
    pool.adopt(searched.chosen(criteria.most_laws).fit)
    problem = _sharpened(problem, pool.chosen(criteria.most_laws).fit)
    pool = Pool(problem, given, [linear], criteria)
    for i, scored in enumerate(sets := searched.best_and_less()):
        progress("fitting all of the recordings", 0.5 * i / len(sets))
        pool.adopt(scored.fit)
    pool.settle_best()
    if not pool.is_formula(pool.least()):
        explore(pool, within(progress, 0.5, 1.0))
    return pool


def _polished(problem: FreeRun, chosen: Scored) -> Scored:
    """What was chosen, fitted with finer steps: intervals are narrower than the usual ones err."""
    model = chosen.fit
    result = fit(problem.finer(), model.candidate, model.parts, model.free, 10, 1e-6)
    return chosen if result is None else chosen._replace(fit=result)


def first_fits(problem: Problem) -> tuple[Fit, Fit]:
    """The nominal model with its initial states fitted, and the best linear model.

    Raises:
        RecordingError: The nominal model runs away on the recordings.
    """
    base = nominal(problem)
    starts = tuple(problem.start(k, base) for k in range(problem.recordings))
    first = Parts(np.zeros(len(problem.linear)), existing_values(problem, base), starts)
    none = np.zeros(len(problem.linear), dtype=np.bool_)
    given = fit(problem, base, first, none, 8, effects=False)
    if given is None:
        raise RecordingError(
            f"model {problem.spec.name}: runs away on the recordings, expected one that stays "
            "near them: check its stiffness, its free length and the sign of the applied force"
        )
    free = free_beside(problem, base)
    near = fit(problem, base, given.parts, free, 12, most_level=1.0) or given
    return given, fit(problem, base, near.parts, free, 12) or near


def _sharpened(problem: Problem, result: Fit) -> Problem:
    """The problem with the noise and the tones that a fit leaves."""
    forces = [
        there
        for k in range(problem.recordings)
        if (there := problem.residual_forces(k, result.candidate, result.parts)) is not None
    ]
    motions = with_tones(problem, forces) if forces else problem.motions
    if isinstance(problem, FreeRun):
        problem = with_noise(problem, result.candidate, result.parts)
    return replace(problem, motions=motions)
