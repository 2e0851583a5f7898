"""Diagnosis of runs whose motion is imposed: a damper dyno, where the load cell measures.

The model is driven along the measured motion, smoothed over the whole run, and the force that it
lacks is what the load cell shows beyond its own. Laws are fitted to that force alone; in the end
DART is driven along the held-out motions, and its forces are the figures.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
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
from rig.identify.evaluate import rms
from rig.identify.imposed_fit import (
    LINEAR,
    Fit,
    Run,
    along_run,
    first_memories,
    fit,
    intervals,
    law_force,
    linear_columns,
    motion_noise,
    run_of,
    spring_damper_force,
)
from rig.identify.imposed_search import (
    UNSEEN,
    Candidate,
    Found,
    coloured,
    search,
    without,
)
from rig.identify.records import Record, RecordError
from rig.identify.report import FittedSeries, HeldOutForce, Ranked, sentence
from rig.identify.result import Result
from rig.identify.verdict import confirmed

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

_KEPT_BACK = 0.2
_WHITE = 0.1
_EXPLAINED = 0.25
_MOSTLY = 0.7
_SIGNIFICANT = 12
_LONGEST_DURATION_S = 600.0
_LEAST_SWING = 5.0
_LEAST_CELL_SWING = 3.0
_OPPOSITE = -0.6
_IMPLAUSIBLE = 100.0
_TOO_MANY_LAWS = 3


def is_imposed(records: Sequence[Record]) -> bool:
    """Whether the motion of the records is imposed: a load cell, and no applied force.

    Raises:
        RecordError: Some are of one kind and some of the other.
    """
    imposed = [record.applied_force_n is None for record in records]
    if any(imposed) and not all(imposed):
        dyno = records[imposed.index(True)].name
        driven = records[imposed.index(False)].name
        raise RecordError(
            f"{dyno}: has strut_force_n alone, so its motion is imposed, and {driven} has "
            "applied_force_n: expected runs of one kind, diagnose the others by themselves"
        )
    return all(imposed)


def diagnose_imposed(
    spec: ModelSpec, runs: Sequence[Record], held_out: Sequence[Record], progress: Progress
) -> Result:
    """Trace the force that a model lacks along imposed motions to named effects.

    Args:
        spec: The model, with one strut and one coordinate.
        runs: Runs to learn from.
        held_out: Runs to judge on; if there are none, the last fifth of the last run is kept back.
        progress: Told what is being done and the share that is done.

    Raises:
        RecordError: A record or the model cannot be used; one line says why.
    """
    _check_model(spec)
    for record in (*runs, *held_out):
        _check_record(record)
    progress("reading runs", 0.02)
    learnt = [run_of(record, spec) for record in runs]
    judged = [run_of(record, spec) for record in held_out]
    source = "runs"
    if not judged:
        learnt, judged = _kept_back(learnt)
        source = "end of the run"
    for run in (*learnt, *judged):
        _check_run(run)
    found = search(learnt, progress)
    progress("judging on held-out data", 0.92)
    result = _written_up(spec, learnt, judged, source, found)
    progress("done", 1.0)
    return result


def _check_model(spec: ModelSpec) -> None:
    if len(spec.struts) != 1 or DartPlant(spec).guided() is None:
        raise RecordError(
            f"model {spec.name}: {len(spec.struts)} struts, expected one on a straight guide: "
            "the load cell of an imposed motion measures one strut"
        )


def _check_record(record: Record) -> None:
    if record.heights_m.shape[1] != 1 or record.strut_force_n is None:
        raise RecordError(
            f"{record.name}: {record.heights_m.shape[1]} heights, expected one and strut_force_n"
        )
    if record.duration_s > _LONGEST_DURATION_S:
        raise RecordError(
            f"{record.name}: {record.duration_s:.0f} s long, "
            f"expected at most {_LONGEST_DURATION_S:.0f} s: cut it"
        )
    _check_clipped(record.name, record.strut_force_n)


def _check_clipped(name: str, force_n: Array) -> None:
    steps = np.unique(np.diff(np.unique(force_n)))
    if len(steps) == 0 or float(np.ptp(force_n)) < 50.0 * float(steps[0]):
        return
    for label, limit in (("lowest", float(force_n.min())), ("highest", float(force_n.max()))):
        flat = np.flatnonzero(np.diff(np.concatenate([[0], force_n == limit, [0]])))
        longest = int(np.max(flat[1::2] - flat[::2]))
        if longest > max(20, 0.002 * len(force_n)):
            raise RecordError(
                f"{name}: strut_force_n stays at its {label} value {limit:.6g} N for {longest} "
                "samples on end, expected a load cell that is not clipped: widen its range"
            )


def _check_run(run: Run) -> None:
    """Refuse channels that cannot be what their names say."""
    swing = float(np.std(run.height_m))
    if swing < _LEAST_SWING * run.height_noise_m:
        raise RecordError(
            f"{run.name}: height_m moves by {swing:.3g} m RMS and its noise is "
            f"{run.height_noise_m:.3g} m, expected a run with more motion: widen the stroke"
        )
    force, given = run.force_n - run.force_n.mean(), run.given_n - run.given_n.mean()
    cell, law = float(np.std(force)), float(np.std(given))
    noise = float(np.std(np.diff(run.force_n, 2))) / np.sqrt(6.0)
    if cell < _LEAST_CELL_SWING * noise:
        raise RecordError(
            f"{run.name}: strut_force_n moves by {cell:.3g} N RMS and its noise is {noise:.3g} N, "
            "expected a force that stands out of its noise: is the load cell connected?"
        )
    if law > _IMPLAUSIBLE * cell:
        raise RecordError(
            f"{run.name}: along height_m the model gives {law:.3g} N RMS and strut_force_n shows "
            f"{cell:.3g} N: expected the same order: are the units m and N, or columns swapped?"
        )
    if law > 0.0 and float(np.mean(force * given)) < _OPPOSITE * cell * law:
        raise RecordError(
            f"{run.name}: strut_force_n goes against the model's force (correlation "
            f"{np.mean(force * given) / (cell * law):.2f}), expected a force that is positive "
            "where the strut pushes its bodies apart: turn its sign"
        )


def _kept_back(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    last = runs[-1]
    cut = int(len(last.t_s) * (1.0 - _KEPT_BACK))
    kept = last.rows(cut, len(last.t_s))._replace(name=f"{last.name} (last fifth)")
    return [*runs[:-1], last.rows(0, cut)], [kept]


def corrected_dyno(spec: ModelSpec, final: Fit) -> ModelSpec:
    """The model with the laws and linear effects of a fit, after those that it already had."""
    effects = [
        EffectSpec(name=name, parameters=_named(name, values)) for name, values in _all_of(final)
    ]
    if not effects:
        return spec
    strut = spec.struts[0]
    return spec.with_effects(strut.name, (*strut.effects, *effects)).model_copy(
        update={"name": f"{spec.name[:50]}_corrected"}
    )


def _named(name: str, values: Array) -> dict[str, float]:
    return {
        parameter.name: float(np.format_float_scientific(value, precision=_SIGNIFICANT))
        for parameter, value in zip(effect(name).parameters, values, strict=True)
    }


def _all_of(final: Fit) -> list[tuple[str, Array]]:
    """Every effect of a fit with its parameters, laws before linear effects."""
    linear = [
        (name, np.array([amount]))
        for name, amount in zip(final.linear, final.amounts.tolist(), strict=True)
    ]
    return [*zip(final.effects, final.values, strict=True), *linear]


class _Judged(NamedTuple):
    """A held-out run, its forces from DART.

    Attributes:
        run: The run.
        before_n: Force of the model as given, shape (N,).
        after_n: Force of the corrected model, shape (N,).
        apart_n: Root mean square by which DART and the search differ on the corrected model.
    """

    run: Run
    before_n: Array
    after_n: Array
    apart_n: float


def dart_forces(spec: ModelSpec, run: Run) -> Array:
    """Strut force of a model that DART drives along a run's motion, shape (N,).

    What its effects remember at the start is fitted, for nobody measured it.

    Args:
        spec: The model, with one strut and one coordinate.
        run: The motion.
    """
    plant = DartPlant(spec)
    items = spec.struts[0].effects
    bare = run._replace(given_n=spring_damper_force(run))
    memories = first_memories(
        bare, [item.name for item in items], [np.array(item.values()) for item in items]
    )
    memory = tuple(float(m) for part in memories for m in part)
    motion = list(
        zip(run.t_s.tolist(), run.height_m.tolist(), run.velocity_m_per_s.tolist(), strict=True)
    )
    forces = np.empty(len(motion))
    for k, (here, warm) in enumerate(zip(motion, run.temperature_c.tolist(), strict=True)):
        driven = plant.driven(here[1], here[2], 0.0, memory, here[0], warm)
        forces[k] = driven.force_n
        if k + 1 == len(motion) or not memory:
            continue
        rise = [(b - a) / run.substeps for a, b in zip(here, motion[k + 1], strict=True)]
        for step in range(run.substeps):
            at = [a + step * d for a, d in zip(here, rise, strict=True)]
            mid = [a + 0.5 * d for a, d in zip(at, rise, strict=True)]
            rates = plant.driven(at[1], at[2], 0.0, memory, at[0], warm).memory_rates
            half = tuple([m + 0.5 * rise[0] * r for m, r in zip(memory, rates, strict=True)])
            rates = plant.driven(mid[1], mid[2], 0.0, half, mid[0], warm).memory_rates
            memory = tuple([m + rise[0] * r for m, r in zip(memory, rates, strict=True)])
    return forces


def _judge(run: Run, spec: ModelSpec, corrected: ModelSpec, final: Fit) -> _Judged:
    linear = run.given_n + _linear_force(run, final)
    expected = linear + along_run(run._replace(given_n=linear), final.effects, final.values)
    before = dart_forces(spec, run)
    after = dart_forces(corrected, run) if _all_of(final) else before
    return _Judged(run, before, after, rms(after - expected))


def _linear_force(run: Run, final: Fit) -> Array:
    everywhere = run._replace(counted=np.arange(len(run.t_s)))
    return linear_columns(everywhere, final.linear) @ final.amounts


def _written_up(
    spec: ModelSpec, runs: Sequence[Run], judged: Sequence[Run], source: str, found: Found
) -> Result:
    final = found.final
    corrected = corrected_dyno(spec, final)
    there = [_judge(run, spec, corrected, final) for run in judged]
    strut = spec.struts[0].name
    effects = _effects(found, strut)
    held_out, floor = _held_out(there, source), _floor(found)
    verdict = confirmed(
        _verdict(found), held_out.residual_force_rmse_n, floor.residual_force_rmse_n
    )
    families = tuple(dict.fromkeys(effect(c.name).family for c in found.rivals))
    ambiguous = verdict == "ambiguous"
    diagnosis = Diagnosis(
        verdict,
        effects,
        _rejected(found, strut),
        families if ambiguous else (),
        _suggestion(found) if ambiguous else None,
        held_out,
        floor,
        White(coloured(found.base, found.runs) < _WHITE, coloured(final, found.runs) < _WHITE),
        "",
        tuple(run.name for run in runs),
        spec.name,
    )
    diagnosis = replace(diagnosis, sentence=sentence(diagnosis, 1))
    return Result(
        diagnosis,
        corrected,
        tuple(_fitted(run, found, number, strut) for number, run in enumerate(found.runs)),
        tuple(
            HeldOutForce(
                j.run.name, strut, j.run.t_s, j.run.height_m, j.run.velocity_m_per_s,
                j.run.force_n, j.before_n, j.after_n,
            )
            for j in there
        ),
        _ranking(found, strut),
        _assumptions(source, there),
    )  # fmt: skip


def _fitted(run: Run, found: Found, number: int, strut: str) -> FittedSeries:
    final, at = found.final, run.counted
    deviation = float(np.hypot(_white_n(final.residuals[number]), rms(motion_noise(
        final, run, number
    ))))  # fmt: skip
    return FittedSeries(
        run.name,
        strut,
        run.t_s[at],
        run.height_m[at],
        run.velocity_m_per_s[at],
        run.missing_n(),
        final.residuals[number],
        np.full(len(at), deviation),
    )


def _white_n(residual: Array) -> float:
    """Standard deviation of the white part of a residual, after von Neumann."""
    return float(np.sqrt(np.mean(np.diff(residual) ** 2) / 2.0))


def _floor(found: Found) -> NoiseFloor:
    squares = [
        (_white_n(found.final.residuals[k]) ** 2 + rms(motion_noise(found.final, run, k)) ** 2)
        for k, run in enumerate(found.runs)
    ]
    heights = [run.height_noise_m**2 for run in found.runs]
    return NoiseFloor(float(np.sqrt(np.mean(heights))), float(np.sqrt(np.mean(squares))))


def _effects(found: Found, strut: str) -> tuple[FoundEffect, ...]:
    final, runs = found.final, found.runs
    if not _all_of(final):
        return ()
    ends = intervals(final, runs)
    left = np.concatenate(final.residuals)
    with_it = float(np.mean(left**2))
    listed: list[tuple[float, FoundEffect]] = []
    first = 0
    for row, (name, values) in enumerate(_all_of(final)):
        item = effect(name)
        if row < len(final.effects):
            low, high = ends.low, ends.high
            parts = [
                law_force(run, name, values, final.memories[k][row])[run.counted]
                for k, run in enumerate(runs)
            ]
            place = first
            first += len(values)
        else:
            place = row - len(final.effects)
            low, high = ends.linear_low, ends.linear_high
            parts = [linear_columns(run, [name])[:, 0] * values[0] for run in runs]
        force = np.concatenate(parts)
        without_it = float(np.mean((left + force) ** 2))
        estimates = {
            parameter.name: Estimate(
                float(values[i]), float(low[place + i]), float(high[place + i])
            )
            for i, parameter in enumerate(item.parameters)
        }
        share = float(np.clip(1.0 - with_it / max(without_it, 1e-300), 0.0, 1.0))
        there = FoundEffect(item.family, name, strut, share, estimates, rms(force))
        listed.append((_weight(found, row, name), there))
    return tuple(item for _, item in sorted(listed, key=lambda pair: -pair[0]))


def _weight(found: Found, row: int, name: str) -> float:
    """What would be left without an effect, the others fitted again; in N².

    A linear effect that gains nothing by itself only makes room for a law, and weighs nothing.
    """
    final, runs, motion = found.final, found.runs, found.motion
    if row < len(final.effects):
        less = without(final, row, runs, motion)
        return less.cost - final.cost if less is not None else np.inf
    rest = [n for n in final.linear if n != name]
    less = fit(runs, final.effects, final.values, motion, rest, 10, memories=final.memories)
    alone = fit(runs, (), (), motion, [name])
    if less is None or alone is None:
        return 0.0
    return min(less.cost - final.cost, found.base.cost - alone.cost)


def _verdict(found: Found) -> Verdict:
    final = found.final
    left = coloured(final, found.runs)
    if not _all_of(final):
        return "nothing_missing" if left < _WHITE else "not_explained"
    patched = len(final.effects) >= _TOO_MANY_LAWS
    if left < _EXPLAINED and not patched:
        return "ambiguous" if found.rivals else "explained"
    gain = 1.0 - float(np.sqrt(final.mean_square / found.base.mean_square))
    return "partly_explained" if gain > _MOSTLY else "not_explained"


def _rejected(found: Found, strut: str) -> tuple[RejectedEffect, ...]:
    chosen = {name for name, _ in _all_of(found.final)}
    listed: dict[str, RejectedEffect] = {}
    for this in found.rounds:
        able = [c for c in this.candidates if np.isfinite(c.score)]
        for candidate in this.candidates:
            name = candidate.name
            if name not in chosen and name not in listed:
                why = _why(able, candidate)
                listed[name] = RejectedEffect(effect(name).family, name, why, strut)
    for name in LINEAR:
        if found.rounds and name not in chosen:
            why = "adds nothing that blocks without a part in the fit would show"
            listed[name] = RejectedEffect(effect(name).family, name, why, strut)
    for name in sorted(UNSEEN):
        why = "an imposed motion does not show it: it acts on a body or on the applied force"
        listed[name] = RejectedEffect(effect(name).family, name, why, strut)
    return tuple(listed.values())


def _why(able: Sequence[Candidate], candidate: Candidate) -> str:
    if candidate.why:
        return candidate.why
    if not able:
        return "no law stayed within the bounds of its search"
    best = able[0]
    if candidate.fit is None:
        ratio = float(np.sqrt(candidate.tried / max(best.tried, 1e-300)))
        return f"along the motion it leaves {ratio:.3g} times as much as {best.name}"
    if candidate is best:
        return "blocks that took no part in the fit gain no more than by chance"
    ratio = float(np.sqrt(candidate.score / best.score))
    if ratio < 1.01:
        return f"no better than {best.name}, which needs no more parameters"
    return f"leaves {ratio:.3g} times the force error of {best.name} on blocks that were not fitted"


def _ranking(found: Found, strut: str) -> tuple[Ranked, ...]:
    if not found.rounds:
        return ()
    chosen = {name for name, _ in _all_of(found.final)}
    first = found.rounds[0]
    able = [c for c in first.candidates if np.isfinite(c.score)]
    before = float(np.sum(np.concatenate(first.before.residuals) ** 2))
    ranked: list[Ranked] = []
    for candidate in first.candidates:
        share = None
        if np.isfinite(candidate.score):
            share = float(np.clip(1.0 - candidate.score / before, 0.0, 1.0))
        why = "" if candidate.name in chosen else _why(able, candidate)
        family = effect(candidate.name).family
        ranked.append(Ranked(candidate.name, family, strut, share, why))
    return tuple(ranked)


def _held_out(there: Sequence[_Judged], source: str) -> HeldOut:
    nothing = BeforeAfter(float("nan"), float("nan"))
    runs: list[RunFigures] = []
    for item in there:
        at = item.run.counted
        error = BeforeAfter(
            rms((item.run.force_n - item.before_n)[at]), rms((item.run.force_n - item.after_n)[at])
        )
        runs.append(RunFigures(item.run.name, nothing, error, error))
    mean = BeforeAfter(
        float(np.sqrt(np.mean([r.residual_force_rmse_n.before**2 for r in runs]))),
        float(np.sqrt(np.mean([r.residual_force_rmse_n.after**2 for r in runs]))),
    )
    return HeldOut(nothing, mean, mean, tuple(runs), source)


def _suggestion(found: Found) -> str:
    names = [*found.final.effects, *(c.name for c in found.rivals)]
    wanted = dict.fromkeys(effect(name).excitation for name in names)
    return "a run with " + "; and ".join(wanted)


def _assumptions(source: str, there: Sequence[_Judged]) -> tuple[str, ...]:
    apart = max(item.apart_n for item in there)
    said = [
        "The motion is imposed: heights are as measured, smoothed over the whole run, and the load "
        "cell is what the model is compared with; masses and weights have no say.",
        "What laws with memory remember at the start of a run is fitted, for both models.",
        "Before and after are DART's forces, driven along the measured motion; they differ from "
        f"those of the search by {apart:.2g} N RMS.",
    ]
    if source != "runs":
        said.append("No run was held out: the last fifth of the last run was kept back instead.")
    return tuple(said)
