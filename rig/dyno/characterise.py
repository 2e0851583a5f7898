"""From a recording to the figures of its damper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError, expected_name
from rig.dyno.alternatives import cover
from rig.dyno.build_notes import read_build_notes
from rig.dyno.corrections import Corrections, find_lag
from rig.dyno.curves import CurvePoint, compute_curves
from rig.dyno.damper import Damper, mark_warm_up, summarise_damper
from rig.dyno.figures import (
    LOAD_CELL,
    AtRest,
    DynoStep,
    ForceRecord,
    compute_rest,
    compute_step,
    find_motion,
)
from rig.dyno.quality import quality
from rig.dyno.request import DEFAULT, FigureRequest
from rig.dyno.sensor_faults import find_level_limits, judge_sensors
from rig.dyno.stroke_force import ForceRange
from rig.dyno.strokes import (
    Array,
    Block,
    BlockMotion,
    find_blocks,
    find_holds,
    find_slow_cycle,
    find_strokes,
)
from rig.dyno.timeline import Span, account
from rig.dyno.zero_drift import estimate_drift
from rig.log.reader import read_run
from rig.recordings.read import read_recording
from rig.recordings.recording import Recording

_FEWEST_SAMPLES_A_CYCLE = 10


@dataclass(frozen=True)
class Characteristics:
    """Figures of a damper from one record.

    Attributes:
        corrections: What of lag and drift was removed from its force.
        quality: What in the record may mislead.
        account: The whole record as steps, rests, transitions, and what was rejected and why.
        curves: Forces at speeds.
        build: How the damper was built, by name.
    """

    record: ForceRecord
    steps: tuple[DynoStep, ...]
    holds: tuple[AtRest, ...]
    damper: Damper
    corrections: Corrections
    quality: tuple[str, ...]
    account: tuple[Span, ...]
    curves: tuple[CurvePoint, ...]
    build: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def name(self) -> str:
        """Name of the record."""
        return self.record.name

    def as_dict(self) -> dict[str, object]:
        """For `characteristics.json`."""
        figures = self.damper._asdict()
        notes = figures.pop("notes")
        return {
            "record": self.name,
            "strut": self.record.strut or None,
            "force": self.record.source,
            "build": self.build,
            "signs": "positive when the strut pushes: damping of compression positive",
            "steps": [step.figures() for step in self.steps],
            "holds": self.holds,
            "corrections": self.corrections.as_dict(),
            **figures,
            "curves": self.curves,
            "account": self.account,
            "quality": self.quality,
            "notes": notes,
        }


def characterise(
    path: Path, strut: str | None = None, requested: FigureRequest = DEFAULT
) -> Characteristics:
    """Figures of a damper from a run's folder or a CSV of measured data.

    `strut` may be None where a run has only one; the requested corrections are applied.

    Raises:
        InputError: There is no such record, no cycle in it repeats, or its build notes are wrong.
    """
    build = read_build_notes(path)
    recording = read_recording(path)
    name, height_m, force_n, source = _read_strut(path, recording, strut)
    good = np.isfinite(height_m) & np.isfinite(force_n)
    warm_c = None if recording.temperature_c is None else recording.temperature_c[good]
    record = ForceRecord(
        recording.name, recording.t_s[good], height_m[good], force_n[good], warm_c, name, source
    )
    return replace(characterise_record(record, requested), build=build)


def characterise_record(record: ForceRecord, requested: FigureRequest = DEFAULT) -> Characteristics:
    """Figures of a damper from its record, without missing values.

    Raises:
        InputError: No cycle of the record repeats, or its values are not those of a damper.
    """
    record, faults = judge_sensors(record)
    t_s, height_m = record.t_s, record.height_m
    strokes = find_strokes(t_s, height_m)
    blocks = find_blocks(t_s, height_m, strokes)
    rests = find_holds(t_s, height_m, blocks)
    moving = [_find_moving(record, block) for block in blocks]
    none = Corrections(requested, None, None, 0.0)
    kept, rejected = _compute_steps(record, moving, faults.limits, none)
    levels = find_level_limits([stroke for _, step in kept for stroke in step.strokes])
    if levels != ForceRange():
        faults = faults._replace(limits=faults.limits.within(levels))
        kept, rejected = _compute_steps(record, moving, faults.limits, none)
    at_rest = [compute_rest(record, here) for here in rests]
    drift = estimate_drift(record, blocks, at_rest, faults.limits)
    corrections = none._replace(drift=drift)
    if corrections.removes_drift:
        without = corrections.apply(record)
        kept, rejected = _compute_steps(without, moving, faults.limits, corrections)
    corrections = find_lag(corrections, record, [step for _, step in kept])
    record = corrections.apply(record)
    if corrections.removed_lag_s:
        kept, rejected = _compute_steps(record, moving, faults.limits, corrections)
    kept, rejected = _admit(kept, rejected, requested.warm_c, record.name)
    if not kept:
        raise InputError(
            f"{record.name}: no steady cycle in {len(strokes)} strokes: never three in a row of "
            f"equal amplitude with {_FEWEST_SAMPLES_A_CYCLE} samples a cycle, expected a test that "
            "repeats its cycles"
        )
    holds = tuple(compute_rest(record, here) for here in rests)
    marked = mark_warm_up([step for _, step in kept])
    spans = account(t_s, strokes, [block for block, _ in kept], rejected, rests)
    warnings = quality(record, marked, spans, faults, corrections)
    damper = summarise_damper(marked)
    others = [(it, tuple(it.apply(step) for step in marked)) for it in corrections.alternatives()]
    dampers = [(it, summarise_damper(steps)) for it, steps in others]
    # With another knee, friction and gas would be without another damping.
    alike = [(it, like) for it, like in dampers if like.bent_sides == damper.bent_sides]
    if requested.reference_c is not None and not any(damper.share_per_kelvin_per_k.values()):
        warnings = (
            *warnings,
            f"no force at {requested.reference_c:g} °C: the record does not determine the change "
            "per kelvin (one speed over 2 K or more, and a slow step)",
        )
    curves = [
        (it, compute_curves(steps, like, requested))
        for (it, steps), (_, like) in zip(others, dampers, strict=True)
    ]
    return Characteristics(
        record,
        cover(marked, others),
        holds,
        cover(damper, alike),
        corrections,
        warnings,
        spans,
        cover(compute_curves(marked, damper, requested), curves),
    )


def _admit(
    kept: list[tuple[Block, DynoStep]],
    rejected: dict[int, str],
    warm_c: tuple[float, float] | None,
    name: str,
) -> tuple[list[tuple[Block, DynoStep]], dict[int, str]]:
    """Steps whose mean temperature is within a window, and the others with the reason."""
    if warm_c is None:
        return kept, rejected
    low_c, high_c = warm_c
    admitted: list[tuple[Block, DynoStep]] = []
    for block, step in kept:
        at_c = step.temperature_c
        if at_c is None:
            raise InputError(
                f"{name}: has no temperature, expected a column temperature_c for --temperature-c"
            )
        if low_c <= at_c <= high_c:
            admitted.append((block, step))
        else:
            text = f"at {at_c:.1f} °C, outside {low_c:g} to {high_c:g} °C"
            rejected |= {stroke.first: text for stroke in block.strokes}
    if kept and not admitted:
        raise InputError(
            f"{name}: no step between {low_c:g} and {high_c:g} °C (--temperature-c); its steps "
            f"have {', '.join(f'{step.temperature_c:.1f}' for _, step in kept)} °C"
        )
    return admitted, rejected


def _find_moving(record: ForceRecord, block: Block) -> tuple[Block, BlockMotion | None]:
    """A block with the motion that it repeats, or that of its one slow cycle."""
    motion = find_motion(record, block)
    if motion is None and len(block.strokes) > 1:
        cycle = find_slow_cycle(record.t_s, record.height_m, block)
        if cycle is not None and (slow := find_motion(record, cycle)) is not None:
            return cycle, slow
    return block, motion


def _compute_steps(
    record: ForceRecord,
    moving: Sequence[tuple[Block, BlockMotion | None]],
    limits: ForceRange,
    corrections: Corrections,
) -> tuple[list[tuple[Block, DynoStep]], dict[int, str]]:
    """Blocks with their figures, and why others have none by the first sample of their strokes."""
    kept: list[tuple[Block, DynoStep]] = []
    rejected: dict[int, str] = {}
    for block, motion in moving:
        times_s = record.t_s[block.begin : block.end]
        inside = corrections.limits_in(limits, times_s)
        mass_kg = corrections.requested.moving_mass_kg
        step = compute_step(record, block, motion, inside, mass_kg)
        if isinstance(step, str):
            rejected |= {stroke.first: step for stroke in block.strokes}
        else:
            kept.append((block, step))
    return kept, rejected


def _read_strut(
    path: Path, recording: Recording, strut: str | None
) -> tuple[str, Array, Array, str]:
    """Name of a strut, its heights and forces (NaN where one is missing), and their origin."""
    cells_n = recording.strut_forces_n
    if not path.is_dir():
        if strut is not None:
            raise InputError(f"{path}: --strut {strut}: a file has no struts, expected a run")
        if recording.heights_m.shape[1] > 1:
            raise InputError(f"{path}: holds several struts, expected a file of one")
        if cells_n is None:
            raise InputError(
                f"{path}: has no strut_force_n, expected the force of a load cell "
                "in a column of that name"
            )
        return "", recording.heights_m[:, 0], cells_n[:, 0], LOAD_CELL
    run = read_run(path)
    config = run.header.get("config", {})
    names = list(config.get("observers", {}))
    if strut is None and len(names) > 1:
        raise InputError(f"{path}: has the struts {', '.join(names)}, expected --strut")
    name = strut or names[0]
    if name not in names:
        raise InputError(f"{path}: --strut {name}: {expected_name(name, names)}")
    index = list(config.get("signals", {})["height"]).index(name)
    height_m = recording.heights_m[:, index]
    if cells_n is not None:
        return name, height_m, cells_n[:, index], LOAD_CELL
    tick_s = np.asarray(run.steps.column("t_ns").to_numpy(), np.float64) * 1e-9
    estimated = np.asarray(run.steps.column(f"{name}.force_n").to_numpy(), np.float64)
    known = np.isfinite(estimated)
    if not known.any():
        raise InputError(f"{path}: holds no estimated force of {name}, expected a run that ran")
    begin, end = tick_s[known][0], tick_s[known][-1]
    inside = (recording.t_s >= begin) & (recording.t_s <= end)
    return (
        name,
        np.where(inside, height_m, np.nan),
        np.interp(recording.t_s, tick_s[known], estimated[known]),
        "estimated by the observer",
    )
