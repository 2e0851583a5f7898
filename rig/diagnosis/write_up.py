"""The outcome of a search, put together: effects, intervals, figures, corrected model."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from rig.channels.measured_quantities import LOAD_CELL_FORCE
from rig.diagnosis.acting_range import find_acting_range
from rig.diagnosis.damper_forces import damper_forces
from rig.diagnosis.estimates import (
    AT_BOUND,
    FitEstimates,
    LawFound,
    estimates_of,
    find_laws,
    find_preload_of_springs,
    free_parameters,
)
from rig.diagnosis.notes import notes_on
from rig.diagnosis.one_sided_damping import CommonDamping, separate_common_damping
from rig.diagnosis.open_edges import UnreachedEdge, open_preload
from rig.diagnosis.outcome import (
    ChannelCorrection,
    Diagnosis,
    Estimate,
    Evidence,
    ExistingEffect,
    FittedSeries,
    FoundEffect,
    HeldOut,
    LinearCorrection,
    NoiseFloor,
    RejectedEffect,
    Result,
    Verdict,
    White,
)
from rig.diagnosis.problem.channel_delays import SIGNIFICANT, is_undetermined
from rig.diagnosis.problem.delay_estimate import LEAST_WIDTH_S
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.linear_part import EFFECTS, PARAMETERS
from rig.diagnosis.problem.on_dart import spec_with_corrections
from rig.diagnosis.problem.problem import (
    CandidateModel,
    LinearParameter,
    Problem,
    ResidualForces,
    RunEvaluation,
    StrutEffect,
    mid_stroke_m,
    quadratic_mean,
    quadratic_means,
    rms,
)
from rig.diagnosis.problem.track import force_beyond_spring
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import (
    WITH_MEMORY,
    effect_variables,
    fit_covariance,
    is_white,
    spread_over,
)
from rig.diagnosis.search.model_selection import SearchResult
from rig.diagnosis.verdict import HeldOutLaws, confirmations

Array = NDArray[np.float64]

_OF_SAMPLING = 0.01
"""Half-width that the interval of a delay has at least, as a share of the time between samples:
between them the motion is a cubic, and a law that switches is not."""


def compose_result(
    problem: Problem,
    search: SearchResult,
    verdict: Verdict,
    evaluations: Sequence[RunEvaluation],
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
    *,
    by_blocks: bool,
) -> Result:
    """The outcome of a search; `laws` is what held-out data say of the chosen ones."""
    chosen = search.chosen.fit
    recordings = range(problem.recordings)
    before = [problem.residual_forces(k, search.given.model) for k in recordings]
    after = [problem.residual_forces(k, chosen.model) for k in recordings]
    covariance = fit_covariance(chosen).wider_by(spread_over(problem, chosen, search.alike))
    estimates, common = separate_common_damping(
        problem, FitEstimates(chosen, covariance), criteria.significant
    )
    corrected = spec_with_corrections(problem, estimates.fit.model)
    found = find_laws(problem, estimates, after, criteria)
    tracks = [forces.track for forces in after if forces is not None]
    held_out = _held_out(evaluations, by_blocks=by_blocks)
    others = (
        _other_families(problem, search) if verdict in ("ambiguous", "partly_explained") else ()
    )
    is_explained = verdict in ("explained", "ambiguous")
    channels = channel_corrections(problem, estimates, is_explained=is_explained)
    floors = [run.floor for run in evaluations]
    diagnosis = Diagnosis(
        verdict,
        _open_preloads(problem, linear_corrections(problem, estimates, common), found),
        _effects(problem, found, tracks, _evidence(search, evaluations, laws, criteria))
        + _linear_effects(problem, estimates, after, channels),
        _list_changes_of_effects(problem, search, estimates),
        search.rejected + _effects_hidden_from_bench(problem),
        others,
        _suggestion(problem, search) if others or verdict == "ambiguous" else None,
        held_out,
        NoiseFloor(
            quadratic_mean([floor.height_rmse_m for floor in floors]),
            quadratic_mean([floor.residual_force_rmse_n for floor in floors]),
        ),
        White(
            is_white(problem, search.given, criteria.white),
            is_white(problem, chosen, criteria.white),
        ),
        notes_on(problem, search, estimates, found, channels, corrected, after, held_out),
        tuple({grid.recording: grid.name for grid in problem.grids}.values()),
        problem.spec.name,
        damper_forces(problem, chosen, covariance, after),
        channels,
        search.left,
        criteria.level,
    )
    models = search.given.model, chosen.model
    series = (_collect_series(problem, k, models, (before[k], after[k])) for k in recordings)
    return Result(
        diagnosis,
        corrected,
        tuple(item for items in series for item in items),
        tuple(item for run in evaluations for item in run.series),
    )


def _linear_rivals(problem: Problem, search: SearchResult) -> list[str]:
    """Effects by which rivals of the same laws replace corrections: a gain, or a delay."""
    gain = np.array([p.kind == "gain" for p in problem.linear], dtype=np.bool_)
    return [
        EFFECTS["gain" if np.any(rival.fit.free & gain) else "delay"]
        for rival in search.rivals
        if rival.fit.candidate == search.chosen.fit.candidate
    ]


def _other_families(problem: Problem, search: SearchResult) -> tuple[str, ...]:
    """Families of the rivals that the chosen model lacks."""
    rivals = [effect(name).family for r in search.rivals for _, name in r.fit.candidate.new]
    rivals += [effect(name).family for name in _linear_rivals(problem, search)]
    chosen = set(search.chosen.families)
    return tuple(dict.fromkeys(family for family in rivals if family not in chosen))


def linear_corrections(
    problem: Problem, estimates: FitEstimates, common: Sequence[CommonDamping] = ()
) -> tuple[LinearCorrection, ...]:
    """The linear parameters that a fit left free, and those in `common`, with their intervals."""
    changes = {item.parameter: (item.total, item.change) for item in common}
    for variable, index in enumerate(np.flatnonzero(estimates.fit.free).tolist()):
        p = problem.linear[index]
        total = estimates.estimate(variable, _nominal_value(problem, p))
        changes[index] = total, float(estimates.fit.solution.values[variable])
    corrections: list[LinearCorrection] = []
    for index, (total, change) in sorted(changes.items()):
        p = problem.linear[index]
        if p.channel:
            continue
        about = p.kind in ("stiffness", "preload")
        corrections.append(
            LinearCorrection(
                problem.spec.struts[p.strut].name,
                PARAMETERS[p.kind],
                _nominal_value(problem, p),
                total,
                mid_stroke_m(problem.motions[p.strut]) if about else None,
                change / p.deviation,
            )
        )
    return tuple(corrections)


def channel_corrections(
    problem: Problem, estimates: FitEstimates, *, is_explained: bool
) -> tuple[ChannelCorrection, ...]:
    """The delays and gains that a fit left free, with their intervals.

    A delay at the end of its range is not what the data determine. Where no model explains the
    data, only one counts that they show without a model, and that is longer than what such an
    estimate was wrong by: another imitates what is missing. Beside a law with memory none does: the
    memory is seen as a delay without a model, too. Gains are only free where without them much more
    is left.
    """
    families = {effect(name).family for _, name in estimates.fit.candidate.new}
    is_seen_without = families.isdisjoint(WITH_MEMORY)
    least_s = _OF_SAMPLING * max(grid.step_s for grid in problem.grids)
    space, corrections = estimates.fit.space, list[ChannelCorrection]()
    for i, p in enumerate(free_parameters(problem, estimates.fit)):
        is_gain = p.kind == "height_gain"
        if not p.channel or is_undetermined(p):
            continue
        found = estimates.estimate(i, p.nominal)
        value = found.value - p.nominal
        is_shown = is_seen_without and min(abs(p.expected), abs(value)) > LEAST_WIDTH_S
        if not (is_explained or is_gain or is_shown):
            continue
        is_at_end = min(value - space.low[i], space.high[i] - value) < AT_BOUND * abs(value)
        if found.low is None or found.high is None or is_at_end:
            found = Estimate(found.value, None, None)
        else:
            least = 0.0 if is_gain else least_s
            halves = [math.hypot(end - found.value, least) for end in (found.low, found.high)]
            found = Estimate(found.value, found.value - halves[0], found.value + halves[1])
        corrections.append(ChannelCorrection(p.channel, PARAMETERS[p.kind], p.nominal, found))
    cells = problem.delays_of_cells(estimates.fit.model) if is_explained else {}
    for strut, (nominal_s, total_s, std_s) in cells.items():
        if abs(total_s - nominal_s) > SIGNIFICANT * std_s:
            channel = f"{LOAD_CELL_FORCE.column}:{problem.spec.struts[strut].name}"
            half_s = math.hypot(estimates.covariance.factor * std_s, least_s)
            found = Estimate(total_s, total_s - half_s, total_s + half_s)
            corrections.append(ChannelCorrection(channel, PARAMETERS["delay"], nominal_s, found))
    return tuple(corrections)


def _nominal_value(problem: Problem, parameter: LinearParameter) -> float:
    """Value of a linear parameter in the model file, a preload with the effects that state it."""
    if parameter.kind != "preload":
        return parameter.nominal
    stated = [e for e in problem.existing if (e.strut, e.name) == (parameter.strut, "preload")]
    return parameter.nominal + sum(e.values[0] for e in stated)


def _evidence(
    search: SearchResult,
    evaluations: Sequence[RunEvaluation],
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
) -> dict[StrutEffect, Evidence]:
    """The evidence for each chosen law."""
    shown = confirmations(evaluations, search, laws, criteria)
    return {
        law: Evidence(gains.without, gains.rival, shown[law], 0.5 * found.gain)
        for law, found in laws.items()
        if (gains := search.evidence.get(law)) is not None
    }


def _effects(
    problem: Problem,
    laws: Sequence[LawFound],
    tracks: Sequence[Track],
    evidence: Mapping[StrutEffect, Evidence],
) -> tuple[FoundEffect, ...]:
    """The chosen laws, strongest first."""
    effects: list[FoundEffect] = []
    for law in laws:
        at = law.strut, law.name
        found = _describe_effect(problem, at, law.residual_n, law.force_n, law.parameters)
        heights_m = np.concatenate([track.heights_m[law.strut] for track in tracks])
        velocities = np.concatenate([track.velocities_m_per_s[law.strut] for track in tracks])
        where = find_acting_range(heights_m, velocities, law.force_n, law.residual_n)
        effects.append(replace(found, evidence=evidence.get(at), where=where))
    return tuple(sorted(effects, key=lambda item: -item.force_rms_n))


def _open_preloads(
    problem: Problem, corrections: Sequence[LinearCorrection], laws: Sequence[LawFound]
) -> tuple[LinearCorrection, ...]:
    """Corrections with the intervals of preloads that an edge which was not reached decides."""
    unreached: dict[str, tuple[UnreachedEdge, ...]] = {}
    for law in laws:
        strut = problem.spec.struts[law.strut].name
        unreached[strut] = unreached.get(strut, ()) + law.unreached
    return tuple(
        replace(item, total=open_preload(item.total, unreached.get(item.strut, ())))
        if item.parameter == PARAMETERS["preload"]
        else item
        for item in corrections
    )


def _describe_effect(
    problem: Problem,
    strut_effect: StrutEffect,
    residual: Array,
    force: Array,
    parameters: dict[str, Estimate],
) -> FoundEffect:
    """An effect with the share of the residual force that it explains."""
    strut, name = strut_effect
    known = np.isfinite(residual)
    without = float(np.mean((residual + force)[known] ** 2))
    share = 1.0 - float(np.mean(residual[known] ** 2)) / max(without, 1e-300)
    where = problem.spec.struts[strut].name
    return FoundEffect(
        effect(name).family, name, where, float(np.clip(share, 0.0, 1.0)), rms(force), parameters
    )


def _linear_effects(
    problem: Problem,
    estimates: FitEstimates,
    after: Sequence[ResidualForces | None],
    channels: Sequence[ChannelCorrection],
) -> tuple[FoundEffect, ...]:
    """Delays and gains as effects, and where nothing else was found, all linear corrections."""
    result = estimates.fit
    wrong = {(item.channel, item.parameter) for item in channels if item.is_wrong}
    effects: list[FoundEffect] = []
    indices = np.flatnonzero(result.free)
    implied = find_preload_of_springs(problem, estimates)
    for variable, (index, p) in enumerate(
        zip(indices, free_parameters(problem, result), strict=True)
    ):
        if p.channel:
            is_effect = (p.channel, PARAMETERS[p.kind]) in wrong
        else:
            is_alone = not (result.candidate.new or wrong)
            is_effect = is_alone and p.kind in EFFECTS and variable not in implied
        if not is_effect:
            continue
        linear = result.parts.linear.copy()
        linear[index] = 0.0
        nominal = result.model.with_linear(linear)
        forces: list[Array] = []
        residuals: list[Array] = []
        for k, corrected in enumerate(after):
            without = problem.residual_forces(k, nominal)
            if corrected is not None and without is not None:
                forces.append(without.force_n[p.strut] - corrected.force_n[p.strut])
                residuals.append(corrected.force_n[p.strut])
        name = EFFECTS[p.kind]
        parameters = {effect(name).parameters[0].name: estimates.estimate(variable)}
        residual, force = (
            np.concatenate(rows) if rows else np.zeros(1) for rows in (residuals, forces)
        )
        effects.append(_describe_effect(problem, (p.strut, name), residual, force, parameters))
    return tuple(sorted(effects, key=lambda item: -item.force_rms_n))


def _list_changes_of_effects(
    problem: Problem, search: SearchResult, estimates: FitEstimates
) -> tuple[ExistingEffect, ...]:
    """Existing effects that are superfluous, or whose file values lie outside their intervals."""
    result = estimates.fit
    variables = effect_variables(problem, result)
    changed: list[ExistingEffect] = []
    for row, kept in enumerate(result.candidate.kept):
        item = problem.existing[kept]
        nominal_values = effect(item.name).named(item.values)
        strut = problem.spec.struts[item.strut].name
        if kept in search.superfluous:
            changed.append(ExistingEffect(item.name, strut, "superfluous", nominal_values, {}))
        elif row in variables:
            refitted = estimates_of(problem, estimates, row, item.name)
            if any(_outside(refitted[name], value) for name, value in nominal_values.items()):
                changed.append(
                    ExistingEffect(item.name, strut, "refitted", nominal_values, refitted)
                )
    return tuple(changed)


def _outside(estimate: Estimate, value: float) -> bool:
    if estimate.low is None or estimate.high is None:
        return False
    return not estimate.low <= value <= estimate.high


def _effects_hidden_from_bench(problem: Problem) -> tuple[RejectedEffect, ...]:
    """Effects that this kind of bench cannot show."""
    bench = "a prescribed motion" if problem.bench == "motion_given" else "this kind of bench"
    strut, why = problem.spec.struts[0].name, f"{bench} cannot show it"
    return tuple(
        RejectedEffect(item.family, item.name, strut, why, None)
        for item in CATALOGUE.values()
        if problem.bench not in item.benches
    )


def _suggestion(problem: Problem, search: SearchResult) -> str:
    """A recording that would distinguish the chosen model and its rivals."""
    linear = _linear_rivals(problem, search)
    if EFFECTS["gain"] in linear:
        return "none; weigh what the applied force moves, or calibrate its sensor"
    models = [search.chosen, *search.rivals]
    names = [name for model in models for _, name in model.fit.candidate.new]
    names += linear
    excitations = dict.fromkeys(effect(name).excitation for name in names)
    return "a run with " + "; and ".join(excitations)


def _held_out(evaluations: Sequence[RunEvaluation], *, by_blocks: bool) -> HeldOut:
    figures = [run.figures for run in evaluations]
    cells = [f.strut_force_rmse_n for f in figures if f.strut_force_rmse_n is not None]
    return HeldOut(
        quadratic_means([f.height_rmse_m for f in figures]),
        quadratic_means([f.residual_force_rmse_n for f in figures]),
        quadratic_means(cells) if cells else None,
        tuple(figures),
        "blocks" if by_blocks else "runs",
    )


def _collect_series(
    problem: Problem,
    k: int,
    models: tuple[CandidateModel, CandidateModel],
    forces: tuple[ResidualForces | None, ResidualForces | None],
) -> list[FittedSeries]:
    """Series of a recording, by the nominal and the corrected model."""
    before, after = forces
    if before is None or after is None:
        return []
    damper_n = [
        force_beyond_spring(problem, model, after.track, problem.states(k, model))
        for model in models
    ]
    return [
        FittedSeries(
            after.name,
            strut.name,
            after.track.t_s,
            after.track.heights_m[i],
            after.track.velocities_m_per_s[i],
            before.force_n[i],
            after.force_n[i],
            after.deviation_n[i],
            *(force[i] for force in damper_n),
        )
        for i, strut in enumerate(problem.spec.struts)
        if np.all(np.isfinite(after.force_n[i]))
    ]
