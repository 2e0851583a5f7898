"""From a recording to the figures of its damper."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.diagnosis.recording import read_recording
from rig.dyno.damper import Damper, summarise_damper
from rig.dyno.figures import DynoStep, compute_step
from rig.dyno.quality import quality
from rig.dyno.stroke_force import Figure
from rig.dyno.strokes import Hold, find_blocks, find_holds, find_strokes
from rig.log.reader import read_run

Array = NDArray[np.float64]

SCHEMA = 1

_BATCHES = 10
"""Parts of a hold whose means give the uncertainty of its mean: noise may be correlated within one
(Law, Simulation Modeling and Analysis, 2015, 9.5.3)."""

_LARGEST_N = 1e8
"""Ten times what the largest damper machines of civil engineering reach."""

_FEWEST_SAMPLES_A_CYCLE = 10


class ForceRecord(NamedTuple):
    """Measured motion and force of a strut.

    Attributes:
        name: Name of the record.
        t_s: Times, increasing, shape (N,).
        height_m: Heights, shape (N,).
        force_n: Strut forces, shape (N,), positive when the strut pushes.
        temperature_c: Temperatures, shape (N,), or None.
        strut: Name of the strut; empty where there is one.
        source: Origin of the force.
    """

    name: str
    t_s: Array
    height_m: Array
    force_n: Array
    temperature_c: Array | None = None
    strut: str = ""
    source: str = "load cell"


class AtRest(NamedTuple):
    """A hold: the gas force, and what friction keeps.

    Attributes:
        begin_s: Its beginning.
        end_s: Its end.
        height_m: Mean height.
        force_n: Mean force.
        temperature_c: Mean temperature; None where none was measured.
    """

    begin_s: float
    end_s: float
    height_m: float
    force_n: Figure
    temperature_c: float | None


@dataclass(frozen=True)
class Characteristics:
    """Figures of a damper from one record.

    Attributes:
        record: The record.
        steps: Its steps, in time.
        holds: Its times at rest.
        damper: Figures over all steps.
        quality: What in the record may mislead.
    """

    record: ForceRecord
    steps: tuple[DynoStep, ...]
    holds: tuple[AtRest, ...]
    damper: Damper
    quality: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the record."""
        return self.record.name

    def as_dict(self) -> dict[str, object]:
        """For `characteristics.json`."""
        figures = self.damper._asdict()
        kinds, notes = figures.pop("kinds"), figures.pop("notes")
        return {
            "record": self.name,
            "strut": self.record.strut or None,
            "force": self.record.source,
            "signs": "positive when the strut pushes: damping of compression positive",
            "steps": [
                {"kind": kind} | step.figures()
                for kind, step in zip(kinds, self.steps, strict=True)
            ],
            "holds": self.holds,
            **figures,
            "quality": self.quality,
            "notes": notes,
        }


def characterise(path: Path, strut: str | None = None) -> Characteristics:
    """Figures of a damper from a run's folder or a CSV of measured data.

    Args:
        path: Folder or file.
        strut: Name of the strut; may be None where there is one.

    Raises:
        InputError: There is no such record, or no cycle in it repeats.
    """
    record = _read_record(path, strut)
    good = np.isfinite(record.height_m) & np.isfinite(record.force_n)
    warm_c = record.temperature_c
    return characterise_record(
        record._replace(
            t_s=record.t_s[good],
            height_m=record.height_m[good],
            force_n=record.force_n[good],
            temperature_c=None if warm_c is None else warm_c[good],
        )
    )


def characterise_record(record: ForceRecord) -> Characteristics:
    """Figures of a damper from its record, without missing values.

    Raises:
        InputError: No cycle of the record repeats.
    """
    name, t_s, height_m, force_n = record[:4]
    largest_n = float(np.abs(force_n).max(initial=0.0))
    if largest_n > _LARGEST_N:
        raise InputError(f"{name}: a force of {largest_n:.3g} N, expected at most {_LARGEST_N:g}")
    strokes = find_strokes(t_s, height_m)
    blocks = find_blocks(strokes)
    computed = [compute_step(t_s, height_m, force_n, record.temperature_c, item) for item in blocks]
    steps = tuple(step for step in computed if step is not None)
    if not steps:
        raise InputError(
            f"{name}: no steady cycle in {len(strokes)} strokes: never three in a row of equal "
            f"amplitude with {_FEWEST_SAMPLES_A_CYCLE} samples a cycle, expected a test that "
            "repeats its cycles"
        )
    holds = tuple(_at_rest(record, hold) for hold in find_holds(t_s, height_m, blocks))
    rests = [(hold.begin_s, hold.height_m, hold.force_n) for hold in holds]
    warnings = quality(t_s, force_n, steps, rests, len(strokes))
    return Characteristics(record, steps, holds, summarise_damper(steps), warnings)


def _read_record(path: Path, strut: str | None) -> ForceRecord:
    """Heights and forces of a strut; NaN where one is missing."""
    recording = read_recording(path)
    record = ForceRecord(
        recording.name,
        recording.t_s,
        recording.heights_m[:, 0],
        np.empty(0),
        recording.temperature_c,
    )
    cells_n = recording.strut_forces_n
    if not path.is_dir():
        if strut is not None:
            raise InputError(f"{path}: --strut {strut}: a file has no struts, expected a run")
        if recording.heights_m.shape[1] > 1:
            raise InputError(f"{path}: holds several struts, expected a file of one")
        if cells_n is None:
            raise InputError(f"{path}: has no strut_force_n, expected a load cell's force")
        return record._replace(force_n=cells_n[:, 0])
    run = read_run(path)
    config = run.header.get("config", {})
    names = list(config.get("observers", {}))
    if strut is None and len(names) > 1:
        raise InputError(f"{path}: has the struts {', '.join(names)}, expected --strut")
    name = strut or names[0]
    if name not in names:
        raise InputError(f"{path}: --strut {name}: expected one of {', '.join(names)}")
    index = list(config.get("signals", {})["height"]).index(name)
    record = record._replace(strut=name, height_m=recording.heights_m[:, index])
    if cells_n is not None:
        return record._replace(force_n=cells_n[:, index])
    tick_s = np.asarray(run.steps.column("t_ns").to_numpy(), np.float64) * 1e-9
    estimated = np.asarray(run.steps.column(f"{name}.force_n").to_numpy(), np.float64)
    known = np.isfinite(estimated)
    if not known.any():
        raise InputError(f"{path}: holds no estimated force of {name}, expected a run that ran")
    begin, end = tick_s[known][0], tick_s[known][-1]
    inside = (recording.t_s >= begin) & (recording.t_s <= end)
    return record._replace(
        height_m=np.where(inside, record.height_m, np.nan),
        force_n=np.interp(recording.t_s, tick_s[known], estimated[known]),
        source="estimated by the observer",
    )


def _at_rest(record: ForceRecord, hold: Hold) -> AtRest:
    here = slice(hold.begin, hold.end)
    values, warm_c = record.force_n[here], record.temperature_c
    means = np.array([part.mean() for part in np.array_split(values, min(_BATCHES, len(values)))])
    std = float(np.std(means, ddof=1)) / len(means) ** 0.5 if len(means) > 1 else float("nan")
    mean, half = float(values.mean()), 2.26 * std  # Student's t of ten batches
    return AtRest(
        float(record.t_s[hold.begin]),
        float(record.t_s[hold.end - 1]),
        float(record.height_m[here].mean()),
        Figure(mean, mean - half, mean + half, "mean at rest, ten batches"),
        None if warm_c is None else float(warm_c[here].mean()),
    )
