"""What was found, as an outcome: verdict on held-out data, intervals, corrected model."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import CATALOGUE, effect
from rig.diagnosis.evaluate import Evaluated, rms
from rig.diagnosis.on_dart import corrected_model
from rig.diagnosis.outcome import (
    BeforeAfter,
    Diagnosis,
    Estimate,
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
from rig.diagnosis.problem.free_run import FreeRun
from rig.diagnosis.problem.linear_part import EFFECTS, PARAMETERS
from rig.diagnosis.problem.prescribed_motion import Prescribed
from rig.diagnosis.problem.problem import (
    LinearParameter,
    Problem,
    ResidualForces,
    middle_m,
    slots_of,
)
from rig.diagnosis.problem.track import forces_along
from rig.diagnosis.recording import Recording
from rig.diagnosis.search.conclude import Found
from rig.diagnosis.search.criteria import SelectionCriteria
from rig.diagnosis.search.fit import UNBOUND, Fit, Spread, effect_variables, is_white, spread

Array = NDArray[np.float64]

_NEARLY = 0.02
"""Share of a preload up to which it counts as brought along by a change of stiffness."""
_CLOCK = 5e-5
"""Half-width that an interval has at least, as a share of the value: clocks of sensors and loggers
run right to 50 ppm (a usual crystal), which shifts a mass as a frequency; integration errs less."""
_HELD = 0.3
"""Share of half a sampling interval within which a delay is what a zero-order hold looks like."""


class Known(NamedTuple):
    """A fit and what it does not know.

    Attributes:
        fit: The fit.
        spread: The covariance of what was searched.
    """

    fit: Fit
    spread: Spread

    def estimate(self, variable: int, nominal: float = 0.0) -> Estimate:
        """A search variable's value, with what it is a change of, and its confidence interval."""
        space, value = self.fit.space, float(self.fit.solution.values[variable])
        half = float(self.spread.half[variable])
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


def written_up(
    problem: Problem,
    found: Found,
    verdict: Verdict,
    results: Sequence[Evaluated],
    runs: Sequence[Recording],
    criteria: SelectionCriteria,
    *,
    blocks: bool,
) -> Result:
    """The outcome of a search.

    Args:
        problem: Model and recordings.
        found: What the search found.
        verdict: What held-out data allow to be said.
        results: Held-out recordings, before and after.
        runs: Recordings that were learnt from.
        criteria: What decides.
        blocks: Whether blocks were held out, since no run was held out.
    """
    chosen = found.chosen.fit
    before = [_forces(problem, k, found.given) for k in range(problem.recordings)]
    after = [_forces(problem, k, chosen) for k in range(problem.recordings)]
    known = Known(chosen, spread(chosen))
    linear = linear_corrections(problem, known)
    effects = _effects(problem, known, after)
    if not effects:
        effects = _linear_effects(problem, known, after)
    held_out = _held_out(results, blocks=blocks)
    floor = NoiseFloor(
        _mean([r.floor.height_rmse_m for r in results]),
        _mean([r.floor.residual_force_rmse_n for r in results]),
    )
    rivals = [name for rival in found.rivals for _, name in rival.fit.candidate.new]
    own = {effect(name).family for _, name in chosen.candidate.new}
    other = tuple(dict.fromkeys(f for f in (effect(n).family for n in rivals) if f not in own))
    ambiguous = verdict == "ambiguous"
    diagnosis = Diagnosis(
        verdict,
        linear,
        effects,
        _existing(problem, found, known),
        found.rejected + _unseen(problem),
        other if ambiguous else (),
        _suggestion(found) if ambiguous else None,
        held_out,
        floor,
        White(
            is_white(problem, found.given, criteria.white),
            is_white(problem, chosen, criteria.white),
        ),
        _notes(problem, found, blocks=blocks),
        tuple(recording.name for recording in runs),
        problem.spec.name,
    )
    series = tuple(
        item
        for k in range(problem.recordings)
        for item in _fitted_series(problem, before[k], after[k])
    )
    return Result(
        diagnosis,
        corrected_model(problem, chosen.candidate, chosen.parts),
        series,
        tuple(item for result in results for item in result.series),
    )


def needless(
    problem: Problem, linear: Fit, results: Sequence[Evaluated], criteria: SelectionCriteria
) -> bool:
    """Whether all data are at the floor without any law, and held-out ones no nearer with the laws.

    By less than what noise of the applied force alone causes is no nearer. A law that the data call
    for may not act on held-out ones, as a stop that is not reached: they say nothing of it.
    """
    if not _is_left_at_floor(problem, linear, criteria):
        return False
    after = _mean([r.counted.after for r in results]) ** 2
    lawless = _mean([r.linear for r in results]) ** 2
    floor = _mean([_floor(r) for r in results]) ** 2
    drift = _mean([r.drift_m for r in results]) ** 2
    least = max(criteria.least_above_noise * floor, criteria.least_share * (lawless - floor), drift)
    return lawless <= criteria.explained**2 * floor and lawless - after <= least


def _is_left_at_floor(problem: Problem, result: Fit, criteria: SelectionCriteria) -> bool:
    """Whether a model leaves no more than noise of the recordings that were learnt from."""
    floor = problem.floor_level(result.candidate, result.parts)
    return result.mean_square <= criteria.explained**2 * floor


def judgement(
    problem: Problem, results: Sequence[Evaluated], found: Found, criteria: SelectionCriteria
) -> Verdict:
    """What held-out data allow to be said.

    A finding explains where every held-out run is left at the noise floor; it is partial where laws
    take away a good share of what the best linear model leaves there. How bad the nominal model was
    does not count. Nothing is missing only where that holds of what was learnt from, too.
    """
    ratios = [r.counted.after / max(_floor(r), 1e-300) for r in results]
    if all(ratio <= criteria.explained for ratio in ratios):
        if not (found.chosen.fit.candidate.new or np.any(found.chosen.fit.free)):
            at_floor = _is_left_at_floor(problem, found.chosen.fit, criteria)
            return "nothing_missing" if at_floor else "not_explained"
        return "ambiguous" if found.rivals else "explained"
    if found.chosen.fit.candidate.new and all(np.isfinite(ratios)):
        share = 1.0 - criteria.partly
        left, linear = _mean([r.counted.after for r in results]), _mean([r.linear for r in results])
        force = _mean([r.figures.residual_force_rmse_n.after for r in results])
        linear_force = _mean([r.linear_force_n for r in results])
        # Where heights drift, as those of an axis without a spring do, the force is what counts.
        by_force = force < share * linear_force and left < criteria.explained * linear
        if left < share * linear or by_force:
            return "partly_explained"
    return "not_explained"


def _floor(result: Evaluated) -> float:
    height = result.floor.height_rmse_m
    return height if np.isfinite(height) else result.floor.residual_force_rmse_n


def _mean(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _forces(problem: Problem, k: int, result: Fit) -> ResidualForces | None:
    return problem.residual_forces(k, result.candidate, result.parts)


def linear_corrections(problem: Problem, known: Known) -> tuple[LinearCorrection, ...]:
    """The linear parameters that a fit left free, with their intervals."""
    found: list[LinearCorrection] = []
    for variable, p in enumerate(_free(problem, known.fit)):
        nominal_value = p.nominal + (_existing_preload(problem, p) if p.kind == "preload" else 0.0)
        about = p.kind in ("stiffness", "preload")
        found.append(
            LinearCorrection(
                problem.spec.struts[p.strut].name,
                PARAMETERS[p.kind],
                nominal_value,
                known.estimate(variable, nominal_value),
                middle_m(problem.motions[p.strut]) if about else None,
            )
        )
    return tuple(found)


def _free(problem: Problem, result: Fit) -> list[LinearParameter]:
    return [p for p, free in zip(problem.linear, result.free, strict=True) if free]


def _existing_preload(problem: Problem, parameter: LinearParameter) -> float:
    return sum(
        e.values[0] for e in problem.existing if e.strut == parameter.strut and e.name == "preload"
    )


def _effects(
    problem: Problem, known: Known, after: Sequence[ResidualForces | None]
) -> tuple[FoundEffect, ...]:
    model, there = known.fit, [(k, f) for k, f in enumerate(after) if f is not None]
    first = len(model.candidate.kept)
    tracks = [(k, f.track) for k, f in there]
    forces = forces_along(problem, model.candidate, model.parts, tracks)
    found: list[FoundEffect] = []
    for row, (strut, name) in enumerate(model.candidate.new, first):
        left = np.concatenate([f.force_n[strut] for _, f in there])
        estimates = estimates_of(problem, known, row, name)
        found.append(_found(problem, strut, name, left, forces[row][1], estimates))
    return tuple(sorted(found, key=lambda item: -item.force_rms_n))


def _found(
    problem: Problem,
    strut: int,
    name: str,
    left: Array,
    force: Array,
    estimates: dict[str, Estimate],
) -> FoundEffect:
    """An effect by its force and by what is left with it."""
    there = np.isfinite(left)
    without = float(np.mean((left + force)[there] ** 2))
    share = 1.0 - float(np.mean(left[there] ** 2)) / max(without, 1e-300)
    where = problem.spec.struts[strut].name
    return FoundEffect(
        effect(name).family, name, where, float(np.clip(share, 0.0, 1.0)), rms(force), estimates
    )


def estimates_of(problem: Problem, known: Known, row: int, name: str) -> dict[str, Estimate]:
    """Parameters of an effect by name; those of a table have no interval."""
    result = known.fit
    variables = effect_variables(problem, result).get(row)
    if variables is not None:
        return effect(name).named(known.estimate(int(v)) for v in variables)
    slot = slots_of(problem, result.candidate).each[row]
    values = result.parts.effects[slot.parameters]
    return effect(name).named(Estimate(float(value), None, None) for value in values)


def _linear_effects(
    problem: Problem, known: Known, after: Sequence[ResidualForces | None]
) -> tuple[FoundEffect, ...]:
    """Linear corrections as effects, where they are all that was found."""
    result = known.fit
    found: list[FoundEffect] = []
    places = np.flatnonzero(result.free)
    implied = _implied_preloads(problem, known)
    for variable, (place, p) in enumerate(zip(places, _free(problem, result), strict=True)):
        if variable in implied or p.kind not in EFFECTS:
            continue
        linear = result.parts.linear.copy()
        linear[place] = 0.0
        parts = result.parts._replace(linear=linear)
        forces: list[Array] = []
        left: list[Array] = []
        for k, there in enumerate(after):
            without = problem.residual_forces(k, result.candidate, parts)
            if there is not None and without is not None:
                forces.append(without.force_n[p.strut] - there.force_n[p.strut])
                left.append(there.force_n[p.strut])
        name = EFFECTS[p.kind]
        estimates = {effect(name).parameters[0].name: known.estimate(variable)}
        all_left, force = (np.concatenate(rows) if rows else np.zeros(1) for rows in (left, forces))
        found.append(_found(problem, p.strut, name, all_left, force, estimates))
    return tuple(sorted(found, key=lambda item: -item.force_rms_n))


def _implied_preloads(problem: Problem, known: Known) -> set[int]:
    """Preloads about mid-stroke that a change of stiffness about the free length brings along."""
    free = _free(problem, known.fit)
    found: set[int] = set()
    for i, preload in enumerate(free):
        for j, spring in enumerate(free):
            if (preload.kind, spring.kind) != ("preload", "stiffness"):
                continue
            if preload.strut != spring.strut:
                continue
            strut = problem.spec.struts[spring.strut]
            lever = middle_m(problem.motions[spring.strut]) - strut.free_length_m
            covariance = known.spread.covariance
            weights = np.zeros(len(covariance))
            weights[i], weights[j] = preload.deviation, lever * spring.deviation
            values = known.fit.solution.values
            left = float(values[i] + lever * values[j])
            half = known.spread.factor * float(np.sqrt(max(weights @ covariance @ weights, 0.0)))
            if abs(left) < max(half, _NEARLY * abs(float(values[i]))):
                found.add(i)
    return found


def _existing(problem: Problem, found: Found, known: Known) -> tuple[ExistingEffect, ...]:
    """Existing effects that are superfluous, or whose file values lie outside their intervals."""
    result = known.fit
    variables = effect_variables(problem, result)
    listed: list[ExistingEffect] = []
    for row, kept in enumerate(result.candidate.kept):
        item = problem.existing[kept]
        nominal_values = effect(item.name).named(item.values)
        strut = problem.spec.struts[item.strut].name
        if kept in found.superfluous:
            listed.append(ExistingEffect(item.name, strut, "superfluous", nominal_values, {}))
        elif row in variables:
            estimates = estimates_of(problem, known, row, item.name)
            if any(_outside(estimates[name], value) for name, value in nominal_values.items()):
                listed.append(
                    ExistingEffect(item.name, strut, "refitted", nominal_values, estimates)
                )
    return tuple(listed)


def _outside(estimate: Estimate, value: float) -> bool:
    if estimate.low is None or estimate.high is None:
        return False
    return not estimate.low <= value <= estimate.high


def _unseen(problem: Problem) -> tuple[RejectedEffect, ...]:
    """Effects that this kind of bench does not show."""
    bench = "a prescribed motion" if problem.bench == "motion_given" else "this kind of bench"
    strut, why = problem.spec.struts[0].name, f"{bench} does not show it"
    return tuple(
        RejectedEffect(item.family, item.name, strut, why, None)
        for item in CATALOGUE.values()
        if problem.bench not in item.benches
    )


def _suggestion(found: Found) -> str:
    candidates = [found.chosen, *found.rivals]
    names = [name for scored in candidates for _, name in scored.fit.candidate.new]
    wanted = dict.fromkeys(effect(name).excitation for name in names)
    return "a run with " + "; and ".join(wanted)


def _held_out(results: Sequence[Evaluated], *, blocks: bool) -> HeldOut:
    figures = [result.figures for result in results]

    def mean(pairs: Sequence[BeforeAfter | None]) -> BeforeAfter:
        there = [pair for pair in pairs if pair is not None]
        return BeforeAfter(_mean([p.before for p in there]), _mean([p.after for p in there]))

    cells = [f.strut_force_rmse_n for f in figures]
    return HeldOut(
        mean([f.height_rmse_m for f in figures]),
        mean([f.residual_force_rmse_n for f in figures]),
        mean(cells) if any(cell is not None for cell in cells) else None,
        tuple(figures),
        "blocks" if blocks else "runs",
    )


def _fitted_series(
    problem: Problem, before: ResidualForces | None, after: ResidualForces | None
) -> list[FittedSeries]:
    if before is None or after is None:
        return []
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
        )
        for i, strut in enumerate(problem.spec.struts)
        if np.all(np.isfinite(after.force_n[i]))
    ]


def _notes(problem: Problem, found: Found, *, blocks: bool) -> tuple[str, ...]:
    notes: list[str] = []
    if problem.bench == "force_given":
        notes.append(
            "The initial state of every recording is fitted, for both models; between samples the "
            "applied force is a cubic spline."
        )
        grids = [run.grid for run in problem.runs] if isinstance(problem, FreeRun) else []
    else:
        notes.append("The motion is smoothed over the whole recording.")
        grids = [drive.grid for drive in problem.drives] if isinstance(problem, Prescribed) else []
    if outliers := sum(grid.outliers for grid in grids):
        notes.append(f"{outliers} heights were found to be outliers and left out.")
    if found.gain_alike:
        notes.append(
            "A gain of the applied force looks the same as a change of mass, stiffness and damping "
            "in one proportion: these data cannot separate the two; weighing the mass would."
        )
    if _looks_held(problem, found.chosen.fit):
        notes.append(
            "The delay found is half a sampling interval: that is what an applied force looks like "
            "under a zero-order hold. If the bench has one, nothing is wrong with it."
        )
    if blocks:
        notes.append(
            "No run was held out: blocks spread over the recordings took no part in the search; "
            "the initial states are those of the fit."
        )
    return tuple(notes)


def _looks_held(problem: Problem, result: Fit) -> bool:
    """Whether a delay was found that a zero-order hold of the force would feign."""
    half_s = 0.5 * problem.motions[0].step_s
    slots = slots_of(problem, result.candidate).each[len(result.candidate.kept) :]
    return any(
        name == "delay" and abs(result.parts.effects[slot.parameters][0] / half_s - 1.0) < _HELD
        for (_, name), slot in zip(result.candidate.new, slots, strict=True)
    )
