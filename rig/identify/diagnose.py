"""From records to a diagnosis."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.spec import ModelSpec
from rig.identify.attribute import Attribution, Candidate, Progress, attribute
from rig.identify.correct import corrected_model, fitted_on_dart
from rig.identify.diagnosis import (
    BeforeAfter,
    Diagnosis,
    Estimate,
    FoundEffect,
    HeldOut,
    NoiseFloor,
    RejectedEffect,
    RunFigures,
    Verdict,
    White,
)
from rig.identify.evaluate import (
    RunResult,
    evaluate_run,
    missing_force,
    rms,
    smoothed_motion,
    strut_forces,
)
from rig.identify.imposed import diagnose_imposed, is_imposed
from rig.identify.judge import coloured, first_motion
from rig.identify.output_error import Fit, intervals, numerical_shift
from rig.identify.records import Record, RecordError
from rig.identify.reduced import Grid, Model, grid_of, planted, reduced_model, start_of
from rig.identify.report import FittedSeries, HeldOutSeries, Ranked, sentence
from rig.identify.result import Result
from rig.identify.settle import Settled, settle
from rig.identify.smoother import estimate_noise
from rig.identify.verdict import confirmed

Array = NDArray[np.float64]

_KEPT_BACK = 0.2
_WHITE = 0.1
_IMPLAUSIBLE = 5.0
_EXPLAINED = 0.25
_MOST_LAWS = 2
_HELD = 0.3
_LONGEST_DURATION_S = 600.0


def _quiet(_what: str, _share: float) -> None:
    return


def diagnose(
    spec: ModelSpec,
    runs: Sequence[Record],
    held_out: Sequence[Record] = (),
    progress: Progress = _quiet,
) -> Result:
    """Trace what a model lacks to named effects, correct it, and judge the correction.

    Args:
        spec: The model.
        runs: Runs to learn from.
        held_out: Runs to judge on; if there are none, the last fifth of the last run is kept back.
        progress: Told what is being done and the share that is done.

    Raises:
        RecordError: A record or the model cannot be used; one line says why.
    """
    if not runs:
        raise RecordError("no run given, expected at least one")
    if is_imposed((*runs, *held_out)):
        return diagnose_imposed(spec, runs, held_out, progress)
    model = reduced_model(spec)
    for record in (*runs, *held_out):
        _check_fits(record, model)
    progress("reading runs", 0.02)
    grids = [grid_of(record, model) for record in runs]
    judged = [(grid_of(record, model), record.strut_force_n) for record in held_out]
    source = "runs"
    if not judged:
        grids, kept_back = _kept_back(grids)
        judged = [(kept_back, None)]
        source = "end of the run"
    _check_excitation(model, grids)
    found = attribute(model, grids, progress)
    progress("comparing rivals", 0.8)
    settled = settle(found)
    progress("fitting on DART", 0.85)
    final, _ = fitted_on_dart(model, settled.final, grids, found.judge.noise_m2)
    settled = settled._replace(final=final)
    progress("judging on held-out data", 0.92)
    result = _written_up(spec, model, grids, judged, source, found, settled, runs)
    progress("done", 1.0)
    return result


def _check_fits(record: Record, model: Model) -> None:
    struts = model.rows.shape[0]
    if record.heights_m.shape[1] != struts:
        raise RecordError(
            f"{record.name}: {record.heights_m.shape[1]} heights, model {model.spec.name} has "
            f"{struts} struts, expected one height for each"
        )
    if record.duration_s > _LONGEST_DURATION_S:
        raise RecordError(
            f"{record.name}: {record.duration_s:.0f} s long, "
            f"expected at most {_LONGEST_DURATION_S:.0f} s: cut it"
        )


def _kept_back(grids: Sequence[Grid]) -> tuple[list[Grid], Grid]:
    last = grids[-1]
    cut = int(len(last.t_s) * (1.0 - _KEPT_BACK))
    kept = last.rows(cut, len(last.t_s))._replace(name=f"{last.name} (last fifth)")
    return [*grids[:-1], last.rows(0, cut)], kept


def _check_excitation(model: Model, grids: Sequence[Grid]) -> None:
    """Refuse columns that cannot be what their names say."""
    for grid in grids:
        for i, column in enumerate(grid.heights_m.T):
            swing = float(np.nanstd(column))
            noise = float(np.sqrt(estimate_noise(grid.t_s, column).variance))
            if swing < 5.0 * noise:
                raise RecordError(
                    f"{grid.name}: height_m moves by {swing:.3g} m RMS and its noise is "
                    f"{noise:.3g} m, expected a run with more motion: apply a larger force"
                )
            _check_columns(model, grid, i, column)


def _check_columns(model: Model, grid: Grid, strut: int, height_m: Array) -> None:
    free_length, stiffness = float(model.struts[strut, 0]), float(model.struts[strut, 1])
    if stiffness <= 0.0:
        return
    load = float(np.max(np.abs(grid.applied_n))) + float(np.max(np.abs(model.gravity_n)))
    reach = abs(free_length) + load / stiffness
    if float(np.nanmedian(np.abs(height_m - free_length))) > _IMPLAUSIBLE * reach:
        raise RecordError(
            f"{grid.name}: height_m is {np.nanmedian(height_m):.3g} m in the middle of the run, "
            f"but a load of at most {load:.3g} N bends the model's strut by "
            f"{load / stiffness:.3g} m: "
            "expected heights near its free length: are the columns swapped, or the units wrong?"
        )


def _written_up(
    spec: ModelSpec,
    model: Model,
    grids: Sequence[Grid],
    judged: Sequence[tuple[Grid, Array | None]],
    source: str,
    found: Attribution,
    settled: Settled,
    runs: Sequence[Record],
) -> Result:
    final, motions = settled.final, settled.motions
    results: list[tuple[RunResult, Array | None]] = []
    for grid, cell in judged:
        guess = _guess(model, grid)
        there = evaluate_run(model, final, grid, guess, found.judge.noise_m2, motions)
        if there is None:
            raise RecordError(
                f"{grid.name}: the model runs away on this run, expected one that stays near the "
                "motion it was learnt from"
            )
        results.append((there, cell))
    fitted, forces, missing = _fitted_series(model, grids, found, final)
    shift = None
    if final.planted.effects:
        shift = numerical_shift(model, final, grids, found.judge.noise_m2)
    effects = _effects(model, final, grids, forces, missing, shift)
    white = White(
        coloured(found.whole, found.judge.noise_m2, found.judge.input_m2) < _WHITE,
        coloured(final, found.judge.noise_m2, found.judge.input_m2) < _WHITE,
    )
    floor = NoiseFloor(
        float(np.sqrt(np.mean(found.judge.noise_m2))),
        rms(np.concatenate([s.residual_std_n for s in fitted])),
    )
    held_out = _held_out(results, source)
    floor_m = max(floor.height_rmse_m, _height_noise_m([grid for grid, _ in judged]))
    verdict = confirmed(_verdict(found, settled), held_out.height_rmse_m, floor_m)
    families = tuple(dict.fromkeys(effect(c.name).family for c in settled.rivals))
    diagnosis = Diagnosis(
        verdict,
        effects,
        _rejected(model, found, settled),
        families if verdict == "ambiguous" else (),
        _suggestion(settled) if verdict == "ambiguous" else None,
        held_out,
        floor,
        white,
        "",
        tuple(record.name for record in runs),
        spec.name,
    )
    diagnosis = replace(diagnosis, sentence=sentence(diagnosis, len(spec.struts)))
    return Result(
        diagnosis,
        corrected_model(model, final),
        fitted,
        tuple(series for there, _ in results for series in _held_out_series(model, there)),
        _ranking(model, found, settled),
        _assumptions(source, final, grids, found.judge.along),
    )


def _guess(model: Model, grid: Grid) -> Array:
    heights, velocities = first_motion(grid)
    return start_of(model, heights, velocities, 0)


def _fitted_series(
    model: Model, grids: Sequence[Grid], found: Attribution, final: Fit
) -> tuple[tuple[FittedSeries, ...], list[list[Array]], list[Array]]:
    series: list[FittedSeries] = []
    forces: list[list[Array]] = []
    left: list[Array] = []
    for k, grid in enumerate(grids):
        wide = smoothed_motion(grid, found.whole.trajectories[k], None)
        nothing, none = planted(()), np.zeros(0)
        before = missing_force(model, nothing, none, found.whole.starts[k], grid, wide)
        after = before
        if final.planted.effects:
            motion = smoothed_motion(grid, final.trajectories[k], None)
            after = missing_force(model, final.planted, final.values, final.starts[k], grid, motion)
            forces.append(
                strut_forces(model, final.planted, final.values, final.starts[k], grid, motion)[1]
            )
        left.append(after.force_n)
        for i, strut in enumerate(model.spec.struts):
            series.append(
                FittedSeries(
                    grid.name,
                    strut.name,
                    grid.t_s,
                    wide.heights_m[:, i],
                    wide.velocities_m_per_s[:, i],
                    before.force_n[:, i],
                    after.force_n[:, i],
                    before.deviation_n[:, i],
                )
            )
    return tuple(series), forces, left


def _effects(
    model: Model,
    final: Fit,
    grids: Sequence[Grid],
    forces: Sequence[Sequence[Array]],
    missing: Sequence[Array],
    shift: Array | None,
) -> tuple[FoundEffect, ...]:
    if not final.planted.effects:
        return ()
    _, low, high = intervals(final, grids, shift)
    listed: list[FoundEffect] = []
    for row, (strut, name) in enumerate(final.planted.effects):
        item = effect(name)
        force = np.concatenate([parts[row] for parts in forces])
        left = np.concatenate([m[:, strut] for m in missing])
        with_it, without_it = float(np.mean(left**2)), float(np.mean((left + force) ** 2))
        first = int(final.planted.slots.index[row, 1])
        estimates = {
            parameter.name: Estimate(
                float(final.values[first + i]), float(low[first + i]), float(high[first + i])
            )
            for i, parameter in enumerate(item.parameters)
        }
        listed.append(
            FoundEffect(
                item.family,
                name,
                model.spec.struts[strut].name,
                float(np.clip(1.0 - with_it / max(without_it, 1e-300), 0.0, 1.0)),
                estimates,
                rms(force),
            )
        )
    return tuple(sorted(listed, key=lambda e: -e.force_rms_n))


def _verdict(found: Attribution, settled: Settled) -> Verdict:
    final = settled.final
    left = coloured(final, found.judge.noise_m2, found.judge.input_m2)
    if not final.planted.effects:
        return "nothing_missing" if left < _WHITE else "not_explained"
    gain = 1.0 - float(np.sqrt(final.mean_square / found.whole.mean_square))
    if left < _EXPLAINED and not _makeshift(found, final):
        return "ambiguous" if settled.rivals else "explained"
    return "partly_explained" if gain > 0.7 else "not_explained"


def _height_noise_m(grids: Sequence[Grid]) -> float:
    """Noise of the heights of runs, which a sensor other than the first's may have measured."""
    variances = [
        estimate_noise(grid.t_s, column).variance for grid in grids for column in grid.heights_m.T
    ]
    return float(np.sqrt(np.mean(variances)))


def _makeshift(found: Attribution, final: Fit) -> bool:
    """Whether so many laws are put together that they would fit a force that has none.

    Linear effects of a model that was itself fitted only undo that fit, and do not count.
    """
    laws = [
        (at, effect(name).family)
        for at, name in final.planted.effects
        if (at, name) not in found.judge.along
    ]
    struts = {at for at, _ in laws}
    return len(laws) > _MOST_LAWS * len(struts) or len(set(laws)) < len(laws)


def _rejected(model: Model, found: Attribution, settled: Settled) -> tuple[RejectedEffect, ...]:
    chosen = set(settled.final.planted.effects)
    listed: dict[tuple[int, str], RejectedEffect] = {}
    for this in found.rounds:
        best = this.candidates[0] if this.candidates else None
        for candidate in this.candidates:
            key = (candidate.strut, candidate.name)
            if key in chosen or key in listed:
                continue
            listed[key] = RejectedEffect(
                effect(candidate.name).family,
                candidate.name,
                _why(this.before, best, candidate),
                model.spec.struts[candidate.strut].name,
            )
    return tuple(listed.values())


def _why(before: Fit, best: Candidate | None, candidate: Candidate) -> str:
    assert best is not None
    if candidate.fit is None:
        tried = float(np.sqrt(candidate.tried / max(best.tried, 1e-300)))
        return f"along the motion it leaves {tried:.3g} times as much as {best.name}"
    if candidate is best:
        share = 1.0 - candidate.fit.cost / before.cost
        return f"lowers the open-loop error by {100.0 * share:.2g} %, no more than chance would"
    ratio = float(np.sqrt(candidate.fit.cost / best.fit.cost)) if best.fit else 1.0
    if ratio < 1.01:
        return f"no better than {best.name}, which needs no more parameters"
    return f"leaves {ratio:.3g} times the open-loop height error of {best.name}"


def _ranking(model: Model, found: Attribution, settled: Settled) -> tuple[Ranked, ...]:
    if not found.rounds:
        return ()
    chosen = set(settled.final.planted.effects)
    first = found.rounds[0]
    best = first.candidates[0] if first.candidates else None
    ranked: list[Ranked] = []
    for candidate in first.candidates:
        share = None
        if candidate.fit is not None:
            share = float(np.clip(1.0 - candidate.fit.cost / first.before.cost, 0.0, 1.0))
        why = ""
        if (candidate.strut, candidate.name) not in chosen:
            why = _why(first.before, best, candidate)
        ranked.append(
            Ranked(
                candidate.name,
                effect(candidate.name).family,
                model.spec.struts[candidate.strut].name,
                share,
                why,
            )
        )
    return tuple(ranked)


def _held_out(results: Sequence[tuple[RunResult, Array | None]], source: str) -> HeldOut:
    runs: list[RunFigures] = []
    for there, cell in results:
        measured = there.grid.heights_m
        strut = None
        if cell is not None and len(cell) == len(there.grid.t_s) and measured.shape[1] == 1:
            strut = BeforeAfter(
                rms(cell - there.strut_before_n[:, 0]), rms(cell - there.strut_after_n[:, 0])
            )
        runs.append(
            RunFigures(
                there.grid.name,
                BeforeAfter(rms(measured - there.before_m), rms(measured - there.after_m)),
                BeforeAfter(rms(there.missing_before.force_n), rms(there.missing_after.force_n)),
                strut,
            )
        )
    return HeldOut(
        _mean([r.height_rmse_m for r in runs]),
        _mean([r.residual_force_rmse_n for r in runs]),
        _mean([r.strut_force_rmse_n for r in runs if r.strut_force_rmse_n])
        if any(r.strut_force_rmse_n for r in runs)
        else None,
        tuple(runs),
        source,
    )


def _mean(values: Sequence[BeforeAfter | None]) -> BeforeAfter:
    there = [v for v in values if v is not None]
    return BeforeAfter(
        float(np.sqrt(np.mean([v.before**2 for v in there]))),
        float(np.sqrt(np.mean([v.after**2 for v in there]))),
    )


def _held_out_series(model: Model, there: RunResult) -> list[HeldOutSeries]:
    return [
        HeldOutSeries(
            there.grid.name,
            strut.name,
            there.grid.t_s,
            there.grid.heights_m[:, i],
            there.before_m[:, i],
            there.after_m[:, i],
        )
        for i, strut in enumerate(model.spec.struts)
    ]


def _suggestion(settled: Settled) -> str:
    names = [name for _, name in settled.final.planted.effects]
    names += [c.name for c in settled.rivals]
    wanted = dict.fromkeys(effect(name).excitation for name in names)
    return "a run with " + "; and ".join(wanted)


def _looks_held(final: Fit, grids: Sequence[Grid]) -> bool:
    """Whether a delay was found that a force held between samples would feign."""
    half_s = 0.5 * float(np.median(np.concatenate([np.diff(grid.t_s) for grid in grids])))
    return any(
        name == "delay"
        and abs(float(final.values[final.planted.slots.index[row, 1]]) / half_s - 1.0) < _HELD
        for row, (_, name) in enumerate(final.planted.effects)
    )


def _assumptions(
    source: str, final: Fit, grids: Sequence[Grid], along: Sequence[tuple[int, str]]
) -> tuple[str, ...]:
    said = [
        "Between samples the applied force is a cubic spline; between nodes DART has it linear.",
        "The initial state of every run is fitted, for both models.",
    ]
    if _looks_held(final, grids):
        said.append(
            "The delay found is half a sampling interval: that is what an applied force looks like "
            "that is held between samples. If the bench holds it, nothing is wrong with it."
        )
    if undone := [name for at, name in final.planted.effects if (at, name) in along]:
        said.append(
            "The model's linear part had itself been fitted to such a run, so that it hid a part "
            f"of what is missing; {', '.join(undone)} undo that."
        )
    if source != "runs":
        said.append("No run was held out: the last fifth of the last run was kept back instead.")
    return tuple(said)
