"""The outcome of a search, put together: effects, intervals, figures, corrected model."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from rig.channels.measured_quantities import LOAD_CELL_FORCE
from rig.diagnosis.acting_range import find_acting_range
from rig.diagnosis.damper_forces import damper_forces
from rig.diagnosis.free_length import notes_of_springs
from rig.diagnosis.open_edges import (
    UnreachedEdge,
    find_unreached_edges,
    open_parameters,
    open_preload,
)
from rig.diagnosis.outcome import (
    IMPROBABLE,
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
    slots_of,
)
from rig.diagnosis.problem.track import force_beyond_spring, forces_along
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import (
    UNBOUND,
    WITH_MEMORY,
    Fit,
    FitCovariance,
    effect_variables,
    fit_covariance,
    is_white,
    law_values,
    spread_over,
)
from rig.diagnosis.search.model_selection import SearchResult
from rig.diagnosis.verdict import HeldOutLaws, confirmations
from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_NEARLY = 0.02
"""Share of a preload up to which it counts as implied by a change of stiffness."""
_CLOCK = 5e-5
"""Half-width that an interval has at least, as a share of the value: clocks of sensors and loggers
run right to 50 ppm (a usual crystal), which shifts a mass as a frequency; integration errs less."""
_OF_SAMPLING = 0.01
"""Half-width that the interval of a delay has at least, as a share of the time between samples:
between them the motion is a cubic, and a law that switches is not."""
_LIKE = 0.01
"""Difference of two shares up to which they count as one, however narrow their intervals."""
_HOLD = 0.3
"""Share of half a sampling interval within which a delay may be that of a zero-order hold."""

_FAR = 3.0
"""Standard deviations from a stated value that one in 370 corrections exceeds by chance."""

_STANDSTILL = 0.02
"""Share of the speed that is exceeded in a twentieth of the time, below which a strut rests."""

_SHORTEST_REST_S = 0.3
"""Time in standstill from which on a strut rests: it passes a turning point in less."""

_LEAST_REST = 0.05
"""Share of the time from which on rests, or motion, are worth a note."""

_MOSTLY = 2.0
"""Ratio of the remaining forces at standstill and in motion from which on the former decides."""

_RISEN = 1.1
"""Ratio of two residual forces from which on one has risen: their floors scatter by a tenth."""
_AT_BOUND = 1e-3
"""Distance from the end of a range, relative, within which a parameter counts as at it."""

_FRICTION_LIKE = 0.2
"""Share of a damper law's RMS that differs from dry friction, below which it acts as that."""


class FitEstimates(NamedTuple):
    """A fit with its covariance, from which estimates with confidence intervals follow."""

    fit: Fit
    covariance: FitCovariance

    def estimate(self, variable: int, nominal: float = 0.0) -> Estimate:
        """Value of a search variable, added to its nominal value, with its confidence interval.

        It has none where the data say nothing of it, and no prior does: the velocity of a Stribeck
        curve that is flat.
        """
        solution, space = self.fit.solution, self.fit.space
        value = float(solution.values[variable])
        if not (np.any(solution.jacobian[:, variable]) or solution.prior[variable]):
            return Estimate(value + nominal, None, None)
        half = float(self.covariance.half[variable])
        low, high = float(space.low[variable]), float(space.high[variable])
        if space.logarithmic[variable]:
            if half > np.log(UNBOUND):
                return Estimate(value, None, None)
            growth = float(np.exp(np.hypot(half, _CLOCK)))
            return Estimate(value, max(value / growth, low), min(value * growth, high))
        half *= float(space.scale[variable])
        if half > UNBOUND * max(abs(value), 1e-300) and half > 0.5 * (high - low):
            return Estimate(value + nominal, None, None)
        half = float(np.hypot(half, _CLOCK * abs(value + nominal)))
        return Estimate(
            value + nominal, max(value - half, low) + nominal, min(value + half, high) + nominal
        )

    def half_of(self, variables: NDArray[np.intp], weights: Sequence[Sequence[float]]) -> Array:
        """Half-widths of the intervals of sums of parameters, shape (n,).

        Args:
            variables: Search variables of the parameters, shape (k,).
            weights: Of the parameters in each sum, shape (n, k).
        """
        space, values = self.fit.space, self.fit.solution.values
        units = np.where(space.logarithmic, values, space.scale)[variables]
        rows = np.array(weights) * units
        covariance = self.covariance.covariance[np.ix_(variables, variables)]
        variances = np.einsum("ij,jk,ik->i", rows, covariance, rows)
        return np.asarray(self.covariance.factor * np.sqrt(np.maximum(variances, 0.0)))


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
    estimates = FitEstimates(chosen, covariance)
    corrected = spec_with_corrections(problem, chosen.model)
    found = _find_laws(problem, estimates, after, criteria)
    tracks = [forces.track for forces in after if forces is not None]
    held_out = _held_out(evaluations, by_blocks=by_blocks)
    others = _other_families(search) if verdict in ("ambiguous", "partly_explained") else ()
    is_explained = verdict in ("explained", "ambiguous")
    channels = channel_corrections(problem, estimates, is_explained=is_explained)
    floors = [run.floor for run in evaluations]
    diagnosis = Diagnosis(
        verdict,
        _open_preloads(problem, linear_corrections(problem, estimates), found),
        _effects(problem, found, tracks, _evidence(search, evaluations, laws, criteria))
        + _linear_effects(problem, estimates, after, channels),
        _list_changes_of_effects(problem, search, estimates),
        search.rejected + _effects_hidden_from_bench(problem),
        others,
        _suggestion(search) if others or verdict == "ambiguous" else None,
        held_out,
        NoiseFloor(
            quadratic_mean([floor.height_rmse_m for floor in floors]),
            quadratic_mean([floor.residual_force_rmse_n for floor in floors]),
        ),
        White(
            is_white(problem, search.given, criteria.white),
            is_white(problem, chosen, criteria.white),
        ),
        _notes(problem, search, found, by_blocks=by_blocks)
        + _notes_of_zero_and_gain(problem, estimates)
        + notes_of_springs(problem, chosen, estimates.covariance, corrected.struts)
        + _notes_of_channels(channels)
        + _notes_of_bounds(problem, estimates)
        + _notes_of_edges(problem, found)
        + _notes_of_friction_like_laws(problem, chosen, after)
        + _notes_of_standstill(problem, after)
        + notes_of_opposite_errors(held_out),
        tuple({grid.recording: grid.name for grid in problem.grids}.values()),
        problem.spec.name,
        damper_forces(problem, chosen, estimates.covariance, after),
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


def _other_families(search: SearchResult) -> tuple[str, ...]:
    """Families of the rivals that the chosen model lacks."""
    rivals = [effect(name).family for r in search.rivals for _, name in r.fit.candidate.new]
    if any(r.fit.candidate == search.chosen.fit.candidate for r in search.rivals):
        rivals.append("delay")
    chosen = set(search.chosen.families)
    return tuple(dict.fromkeys(family for family in rivals if family not in chosen))


def linear_corrections(problem: Problem, estimates: FitEstimates) -> tuple[LinearCorrection, ...]:
    """The linear parameters that a fit left free, with their intervals."""
    corrections: list[LinearCorrection] = []
    for variable, p in enumerate(_free(problem, estimates.fit)):
        if p.channel:
            continue
        nominal_value = p.nominal + (_existing_preload(problem, p) if p.kind == "preload" else 0.0)
        about = p.kind in ("stiffness", "preload")
        corrections.append(
            LinearCorrection(
                problem.spec.struts[p.strut].name,
                PARAMETERS[p.kind],
                nominal_value,
                estimates.estimate(variable, nominal_value),
                mid_stroke_m(problem.motions[p.strut]) if about else None,
                float(estimates.fit.solution.values[variable]) / p.deviation,
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
    for i, p in enumerate(_free(problem, estimates.fit)):
        is_gain = p.kind == "height_gain"
        if not p.channel or is_undetermined(p):
            continue
        found = estimates.estimate(i, p.nominal)
        value = found.value - p.nominal
        is_shown = is_seen_without and min(abs(p.expected), abs(value)) > LEAST_WIDTH_S
        if not (is_explained or is_gain or is_shown):
            continue
        is_at_end = min(value - space.low[i], space.high[i] - value) < _AT_BOUND * abs(value)
        if found.low is None or found.high is None or is_at_end:
            found = Estimate(found.value, None, None)
        else:
            least = 0.0 if is_gain else least_s
            halves = [math.hypot(end - found.value, least) for end in (found.low, found.high)]
            found = Estimate(found.value, found.value - halves[0], found.value + halves[1])
        corrections.append(ChannelCorrection(p.channel, PARAMETERS[p.kind], p.nominal, found))
    cells = problem.delays_of_cells(estimates.fit.model) if is_explained else {}
    for strut, (delay_s, std_s) in cells.items():
        if abs(delay_s) > SIGNIFICANT * std_s:
            channel = f"{LOAD_CELL_FORCE.column}:{problem.spec.struts[strut].name}"
            half_s = math.hypot(estimates.covariance.factor * std_s, least_s)
            found = Estimate(delay_s, delay_s - half_s, delay_s + half_s)
            corrections.append(ChannelCorrection(channel, PARAMETERS["delay"], 0.0, found))
    return tuple(corrections)


def _free(problem: Problem, result: Fit) -> list[LinearParameter]:
    return [p for p, free in zip(problem.linear, result.free, strict=True) if free]


def _existing_preload(problem: Problem, parameter: LinearParameter) -> float:
    return sum(
        e.values[0] for e in problem.existing if e.strut == parameter.strut and e.name == "preload"
    )


def _evidence(
    search: SearchResult,
    evaluations: Sequence[RunEvaluation],
    laws: HeldOutLaws,
    criteria: SelectionCriteria,
) -> dict[StrutEffect, Evidence]:
    """The evidence for each chosen law."""
    shown = confirmations(evaluations, search, laws, criteria)
    return {
        law: Evidence(*search.evidence[law], shown[law], 0.5 * found.gain)
        for law, found in laws.items()
        if law in search.evidence
    }


class _LawFound(NamedTuple):
    """A chosen law along the recordings.

    Attributes:
        force_n: Its force.
        residual_n: What is left in its strut; NaN where it is not known.
        unreached: Its edges that the motion did not reach.
    """

    strut: int
    name: str
    force_n: Array
    residual_n: Array
    parameters: dict[str, Estimate]
    unreached: tuple[UnreachedEdge, ...]


def _find_laws(
    problem: Problem,
    estimates: FitEstimates,
    after: Sequence[ResidualForces | None],
    criteria: SelectionCriteria,
) -> list[_LawFound]:
    """The chosen laws with their estimates."""
    fit, residuals = estimates.fit, [(k, f) for k, f in enumerate(after) if f is not None]
    tracks, values = [f.track for _, f in residuals], law_values(problem, fit)
    forces = forces_along(problem, fit.model, [(k, f.track) for k, f in residuals])
    found: list[_LawFound] = []
    for row, law in enumerate(fit.candidate.new, len(fit.candidate.kept)):
        parameters = estimates_of(problem, estimates, row, law[1])
        unreached = find_unreached_edges(problem, fit, law, tracks, criteria.bounded**2)
        if unreached:
            half_m = estimates.half_of(effect_variables(problem, fit)[row], effect(law[1]).edges)
            parameters = open_parameters(law[1], values[law], half_m, unreached, parameters)
        residual_n = np.concatenate([f.force_n[law[0]] for _, f in residuals])
        found.append(_LawFound(*law, forces[row][1], residual_n, parameters, unreached))
    return found


def _effects(
    problem: Problem,
    laws: Sequence[_LawFound],
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
    problem: Problem, corrections: Sequence[LinearCorrection], laws: Sequence[_LawFound]
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


def estimates_of(
    problem: Problem, estimates: FitEstimates, row: int, name: str
) -> dict[str, Estimate]:
    """Parameters of an effect by name; those of a table have no interval."""
    result = estimates.fit
    variables = effect_variables(problem, result).get(row)
    if variables is not None:
        return effect(name).named(estimates.estimate(int(v)) for v in variables)
    slot = slots_of(problem, result.candidate).each[row]
    values = result.parts.effects[slot.parameters]
    return effect(name).named(Estimate(float(value), None, None) for value in values)


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
    implied = _find_preload_of_springs(problem, estimates)
    for variable, (index, p) in enumerate(zip(indices, _free(problem, result), strict=True)):
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


def _find_preload_of_springs(problem: Problem, estimates: FitEstimates) -> set[int]:
    """Preloads about mid-stroke that a change of stiffness about the free length implies."""
    free = _free(problem, estimates.fit)
    implied: set[int] = set()
    for i, preload in enumerate(free):
        for j, spring in enumerate(free):
            if (preload.kind, spring.kind) != ("preload", "stiffness"):
                continue
            if preload.strut != spring.strut:
                continue
            strut = problem.spec.struts[spring.strut]
            lever = mid_stroke_m(problem.motions[spring.strut]) - strut.free_length_m
            covariance = estimates.covariance.covariance
            weights = np.zeros(len(covariance))
            weights[i], weights[j] = preload.deviation, lever * spring.deviation
            values = estimates.fit.solution.values
            rest = float(values[i] + lever * values[j])
            variance = max(weights @ covariance @ weights, 0.0)
            half = estimates.covariance.factor * float(np.sqrt(variance))
            if abs(rest) < max(half, _NEARLY * abs(float(values[i]))):
                implied.add(i)
    return implied


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


def _suggestion(search: SearchResult) -> str:
    """A recording that would distinguish the chosen model and its rivals."""
    models = [search.chosen, *search.rivals]
    names = [name for model in models for _, name in model.fit.candidate.new]
    if any(rival.fit.candidate == search.chosen.fit.candidate for rival in search.rivals):
        names.append("delay")
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


def notes_of_opposite_errors(held_out: HeldOut) -> tuple[str, ...]:
    """Whether the force that is missing grows while the height error falls, and what that means."""
    heights, force = held_out.height_rmse_m, held_out.residual_force_rmse_n
    if not (heights.after < heights.before and force.after > _RISEN * force.before):
        return ()
    return (
        f"The height error falls, but the residual force along the motion rises from "
        f"{force.before:.3g} to {force.after:.3g} N RMS: the laws fit the motion, not the force. "
        "Compare the force with a load cell before it is used.",
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


def _notes(
    problem: Problem, search: SearchResult, laws: Sequence[_LawFound], *, by_blocks: bool
) -> tuple[str, ...]:
    notes = [*problem.assumptions]
    if outliers := sum({grid.recording: grid.outliers for grid in problem.grids}.values()):
        notes.append(f"{outliers} heights are outliers and were removed.")
    if search.gain_alike:
        notes.append(
            "In these data a gain of the applied force is indistinguishable from a change of mass, "
            "stiffness and damping in one proportion. Weigh the mass to separate the two."
        )
    if len(search.chosen.fit.candidate.new) > 1:
        notes.append(
            "Several effects act together: fewer than 95 % of such intervals contain the true "
            "value. The diagnosis of another run shows by how much the values differ."
        )
    has_mass = any(p.kind == "mass" for p in _free(problem, search.chosen.fit))
    if has_mass and problem.is_driven_by_force and not search.gain_alike:
        notes.append(
            "The intervals assume that the scale of the applied force is right: where that is "
            "wrong by 1 %, masses, stiffnesses, damping and forces are, too."
        )
    notes += _notes_of_tolerances(problem, search.chosen.fit, laws)
    if _resembles_hold(problem, search.chosen.fit):
        notes.append(
            "The delay is half a sampling interval, which a zero-order hold of the applied force "
            "causes. If the bench has such a hold, its applied force is not late."
        )
    if by_blocks:
        notes.append(
            "No run was held out: blocks spread over the recordings took no part in the search; "
            "the initial states are those of the fit."
        )
    return tuple(notes)


def _notes_of_zero_and_gain(problem: Problem, estimates: FitEstimates) -> tuple[str, ...]:
    """Corrections of the model that a wrong zero or gain of a channel would cause as well."""
    notes: list[str] = []
    is_dyno = problem.bench == "motion_given"
    free, implied = _free(problem, estimates.fit), _find_preload_of_springs(problem, estimates)
    if any(p.kind == "preload" and i not in implied for i, p in enumerate(free)):
        channel = "the load cell" if is_dyno else "the applied force or the height"
        notes.append(
            f"A preload has the same effect as a wrong zero of {channel}: check the zero before "
            "the preload is believed."
        )
    shares: dict[int, list[tuple[float, float]]] = {}
    for variable, p in enumerate(free if is_dyno else ()):
        if p.kind in ("stiffness", "damping") and p.nominal > 0.0:
            value = float(estimates.fit.solution.values[variable])
            half = float(estimates.covariance.half[variable]) * p.deviation
            shares.setdefault(p.strut, []).append((value / p.nominal, half / p.nominal))
    for strut, found in shares.items():
        if len(found) == 2 and abs(found[0][0] - found[1][0]) < max(
            found[0][1] + found[1][1], _LIKE
        ):
            share = float(np.mean([item for item, _ in found]))
            notes.append(
                f"Stiffness and damping of strut {problem.spec.struts[strut].name} differ by the "
                f"same share ({100.0 * share:+.2g} %): a load cell whose gain is wrong by it has "
                "the same effect."
            )
    return tuple(notes)


def _notes_of_tolerances(problem: Problem, result: Fit, laws: Sequence[_LawFound]) -> list[str]:
    """Corrections that are far beyond the accuracy that the model file states, or a usual one.

    A preload that an edge decides which was not reached is not known.
    """
    notes: list[str] = []
    is_open = {law.strut for law in laws if any(edge.force_n_per_m for edge in law.unreached)}
    for parameter, change in zip(problem.linear, result.parts.linear, strict=True):
        if parameter.kind == "preload" and parameter.strut in is_open:
            continue
        times, key = abs(float(change)) / parameter.deviation, PARAMETERS[parameter.kind]
        is_stated = getattr(problem.spec.tolerance, key, None) is not None
        if times > (_FAR if is_stated else IMPROBABLE):
            known = "that the model file states" if is_stated else "of usual model files"
            notes.append(
                f"The correction of {key} is {times:.2g} times the standard deviation {known}: is "
                "its value right, and do the effects describe the strut?"
            )
    return notes


def _notes_of_channels(channels: Sequence[ChannelCorrection]) -> tuple[str, ...]:
    """What to do about a late channel, or one with a wrong gain."""
    notes: list[str] = []
    for item in channels:
        if not item.is_wrong:
            continue
        if item.parameter == PARAMETERS["height_gain"]:
            notes.append(
                f"{item.channel} shows {item.total.value:.4g} times the motion that is consistent "
                "with the measured motion of the base and with the other heights: correct its "
                "scaling (in the DBC or the mapping). The corrected model does not contain it."
            )
            continue
        if item.total.value > 0.0:
            what = f"state `delay_s: {item.total.value:.3g}` for it"
        else:
            what = (
                f"it is early, so state `delay_s: {-item.total.value:.3g}` for the channel that it "
                "is compared with"
            )
        notes.append(
            f"{item.channel} is not simultaneous: {what} in the configuration of the bench. The "
            "corrected model does not contain it."
        )
    return tuple(notes)


def _notes_of_bounds(problem: Problem, estimates: FitEstimates) -> tuple[str, ...]:
    """Parameters of laws at the end of the range in which they are searched, other than zero."""
    fit, space = estimates.fit, estimates.fit.space
    names = [problem.existing[index].name for index in fit.candidate.kept]
    names += [name for _, name in fit.candidate.new]
    notes: list[str] = []
    for row, variables in effect_variables(problem, fit).items():
        law = effect(names[row])
        for variable, parameter in zip(variables.tolist(), law.parameters, strict=True):
            low, high = float(space.low[variable]), float(space.high[variable])
            value = float(fit.solution.values[variable])
            near = _AT_BOUND * (abs(value) if low > 0.0 else float(space.scale[variable]))
            ends = {low: "lower", high: "upper"} if low < high else {}
            at = [end for bound, end in ends.items() if bound and abs(value - bound) <= near]
            if at and estimates.estimate(variable).low is not None:
                text = f"{value:.3g} {parameter.unit}".rstrip()
                notes.append(
                    f"{parameter.name} of {law.name} is at the {at[0]} end of its range "
                    f"({text}): the data may require a value beyond it, and "
                    "its interval is not to be relied on."
                )
    return tuple(notes)


def _notes_of_edges(problem: Problem, laws: Sequence[_LawFound]) -> tuple[str, ...]:
    """Edges of play and stops that the motion did not reach."""
    notes: list[str] = []
    for law in laws:
        for edge in law.unreached:
            which, beyond = ("upper", "above") if edge.side > 0 else ("lower", "below")
            notes.append(
                f"The {which} edge of {law.name} of strut {problem.spec.struts[law.strut].name} "
                f"was not reached: it is at {edge.nearest_m:.4g} m or {beyond}. A run with "
                f"{effect(law.name).excitation} shows it."
            )
    return tuple(notes)


def _notes_of_standstill(
    problem: Problem, after: Sequence[ResidualForces | None]
) -> tuple[str, ...]:
    """Where the force that remains is that of rests and holds, during which friction creeps."""
    notes: list[str] = []
    known = [forces for forces in after if forces is not None]
    for index, strut in enumerate(problem.spec.struts):
        if not known:
            break
        force_n = np.concatenate([forces.force_n[index] for forces in known])
        rests = np.concatenate(
            [find_rests(f.track.t_s, np.abs(f.track.velocities_m_per_s[index])) for f in known]
        )
        is_known = np.isfinite(force_n)
        if not is_known.any():
            continue
        force_n, rests = force_n[is_known], rests[is_known]
        if not _LEAST_REST < float(np.mean(rests)) < 1.0 - _LEAST_REST:
            continue
        at_rest_n, moving_n = rms(force_n[rests]), rms(force_n[~rests])
        if at_rest_n > _MOSTLY * moving_n:
            notes.append(
                f"The force that remains in strut {strut.name} is {at_rest_n:.3g} N RMS at "
                f"standstill ({float(np.mean(rests)):.0%} of the time) and {moving_n:.3g} N in "
                "motion: during rests and holds the way in which friction creeps decides. A "
                "recording of motion alone evaluates the other laws better."
            )
    return tuple(notes)


def find_rests(t_s: Array, speed_m_per_s: Array) -> NDArray[np.bool_]:
    """Samples at which a strut stands still, all of shape (N,): not those of a turning point."""
    is_slow = speed_m_per_s < _STANDSTILL * float(np.quantile(speed_m_per_s, 0.95))
    for stretch in find_stretches(is_slow):
        if t_s[stretch][-1] - t_s[stretch][0] < _SHORTEST_REST_S:
            is_slow[stretch] = False
    return is_slow


def _notes_of_friction_like_laws(
    problem: Problem, result: Fit, after: Sequence[ResidualForces | None]
) -> tuple[str, ...]:
    """Laws of dampers whose force is that of dry friction along the recordings."""
    candidate = result.candidate
    names = [problem.existing[index].name for index in candidate.kept]
    names += [name for _, name in candidate.new]
    tracks = [(k, forces.track) for k, forces in enumerate(after) if forces is not None]
    if not tracks:
        return ()
    notes: list[str] = []
    for name, (strut, force) in zip(
        names, forces_along(problem, result.model, tracks), strict=True
    ):
        velocity = np.concatenate([track.velocities_m_per_s[strut] for _, track in tracks])
        friction_n = find_friction_n(force, velocity)
        if effect(name).family == "nonlinear_damping" and friction_n is not None:
            notes.append(
                f"{name} of strut {problem.spec.struts[strut].name} acts as dry friction of "
                f"{friction_n:.3g} N along these runs: its knee is below nearly all speeds."
            )
    return tuple(notes)


def find_friction_n(force_n: Array, velocity_m_per_s: Array) -> float | None:
    """Dry friction in N that a force is along a motion, both of shape (n,); None if it is none."""
    direction = np.sign(velocity_m_per_s)
    friction_n = -float(np.mean(force_n * direction))
    is_friction = rms(force_n + friction_n * direction) <= _FRICTION_LIKE * rms(force_n)
    return friction_n if is_friction and friction_n > 0.0 else None


def _resembles_hold(problem: Problem, result: Fit) -> bool:
    """Whether there is a delay that a zero-order hold of the applied force would cause."""
    half_s = 0.5 * problem.motions[0].step_s
    return any(
        p.kind == "delay" and abs(float(change) / half_s - 1.0) < _HOLD
        for p, change in zip(problem.linear, result.parts.linear, strict=True)
    )
