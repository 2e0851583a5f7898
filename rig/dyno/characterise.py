"""`rig characterise` but for its words: from a recording to the figures of its damper."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.diagnosis.recording import Recording, read_recording
from rig.dyno.damper import Damper, summarise_damper
from rig.dyno.figures import DynoStep, Side, compute_step
from rig.dyno.quality import quality
from rig.dyno.stroke_force import Figure
from rig.dyno.strokes import find_blocks, find_holds, find_strokes
from rig.log.reader import read_run

Array = NDArray[np.float64]

SCHEMA = 1

_BATCHES = 10
"""Parts of a hold whose means tell the uncertainty of its mean: noise may be correlated within one
(Law, Simulation Modeling and Analysis, 2015, 9.5.3)."""

_LARGEST_N = 1e8
"""Ten times what the largest damper machines of civil engineering reach."""

_FEWEST_SAMPLES_A_CYCLE = 10


@dataclass(frozen=True)
class AtRest:
    """A hold: the gas force, and what friction keeps.

    Attributes:
        begin_s: Its beginning.
        end_s: Its end.
        height_m: Mean height.
        force: Mean force, in N.
        temperature_c: Mean temperature; None where none was measured.
    """

    begin_s: float
    end_s: float
    height_m: float
    force: Figure
    temperature_c: float | None


@dataclass(frozen=True)
class Characteristics:
    """All that a record tells of a damper.

    Attributes:
        name: Name of the record.
        strut: Name of the strut; empty where there is one.
        source: Where the force comes from.
        height_m: Measured heights, for plots.
        force_n: Forces, for plots.
        steps: Its steps, in time.
        holds: What stood still.
        damper: Figures over all steps.
        quality: What in the record may mislead.
    """

    name: str
    strut: str
    source: str
    height_m: Array
    force_n: Array
    steps: tuple[DynoStep, ...]
    holds: tuple[AtRest, ...]
    damper: Damper
    quality: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """For `characteristics.json`."""
        damper = self.damper
        return {
            "record": self.name,
            "strut": self.strut or None,
            "force": self.source,
            "signs": "positive when the strut pushes: damping of compression positive",
            "steps": [
                {"kind": kind} | _step_dict(step)
                for kind, step in zip(damper.kinds, self.steps, strict=True)
            ],
            "holds": [
                {
                    "begin_s": hold.begin_s,
                    "end_s": hold.end_s,
                    "height_m": hold.height_m,
                    "force_n": hold.force.as_dict(),
                    "temperature_c": hold.temperature_c,
                }
                for hold in self.holds
            ],
            "gas_force_n": _or_none(damper.gas_force),
            "gas_rate_n_per_m": _or_none(damper.gas_rate),
            "friction_n": _or_none(damper.friction),
            "knee_m_per_s": {key: _or_none(value) for key, value in damper.knee.items()},
            "asymmetry": _or_none(damper.asymmetry),
            "force_per_kelvin_n_per_k": {
                key: _or_none(value) for key, value in damper.per_kelvin.items()
            },
            "quality": list(self.quality),
            "notes": list(damper.notes),
        }


def characterise(path: Path, strut: str | None = None) -> Characteristics:
    """Figures of a damper from a run's folder or a CSV of measured data.

    Args:
        path: Folder or file.
        strut: Name of the strut; may be left out where there is one.

    Raises:
        InputError: There is no such record, or nothing in it repeats.
    """
    recording = read_recording(path)
    name, height_m, force_n, source, recording = _of_strut(path, recording, strut)
    good = np.isfinite(height_m) & np.isfinite(force_n)
    t_s, height_m, force_n = recording.t_s[good], height_m[good], force_n[good]
    temperature_c = None if recording.temperature_c is None else recording.temperature_c[good]
    return characterise_arrays(recording.name, t_s, height_m, force_n, temperature_c, name, source)


def characterise_arrays(
    name: str,
    t_s: Array,
    height_m: Array,
    force_n: Array,
    temperature_c: Array | None = None,
    strut: str = "",
    source: str = "load cell",
) -> Characteristics:
    """The same from arrays.

    Args:
        name: Name of the record.
        t_s: Times, increasing, shape (N,).
        height_m: Heights, shape (N,).
        force_n: Strut forces, shape (N,), positive when the strut pushes.
        temperature_c: Temperatures, shape (N,), or None.
        strut: Name of the strut.
        source: Where the force comes from.

    Raises:
        InputError: Nothing in it repeats.
    """
    largest_n = float(np.abs(force_n).max(initial=0.0))
    if largest_n > _LARGEST_N:
        raise InputError(f"{name}: a force of {largest_n:.3g} N, expected at most {_LARGEST_N:g}")
    strokes = find_strokes(t_s, height_m)
    blocks = find_blocks(strokes)
    steps = [compute_step(t_s, height_m, force_n, temperature_c, block) for block in blocks]
    found = tuple(step for step in steps if step is not None)
    if not found:
        raise InputError(
            f"{name}: {len(strokes)} strokes, and no three alike in a row with "
            f"{_FEWEST_SAMPLES_A_CYCLE} samples a cycle, expected a test that repeats its cycles"
        )
    holds = tuple(
        _at_rest(t_s, height_m, force_n, temperature_c, hold.begin, hold.end)
        for hold in find_holds(t_s, height_m, blocks)
    )
    rests = [(hold.begin_s, hold.height_m, hold.force) for hold in holds]
    warned = quality(t_s, force_n, found, rests, len(strokes))
    damper = summarise_damper(found)
    return Characteristics(name, strut, source, height_m, force_n, found, holds, damper, warned)


def _of_strut(
    path: Path, recording: Recording, strut: str | None
) -> tuple[str, Array, Array, str, Recording]:
    """Name of the strut, its heights and forces, and where these come from."""
    if not path.is_dir():
        if strut is not None:
            raise InputError(f"{path}: --strut {strut}: a file has no struts, expected a run")
        if recording.heights_m.shape[1] > 1:
            raise InputError(f"{path}: holds several struts, expected a file of one")
        if recording.strut_forces_n is None:
            raise InputError(f"{path}: has no strut_force_n, expected a load cell's force")
        return "", recording.heights_m[:, 0], recording.strut_forces_n[:, 0], "load cell", recording
    run = read_run(path)
    config: Any = run.header.get("config", {})
    names = list(config.get("observers", {}))
    if strut is None and len(names) > 1:
        raise InputError(f"{path}: has the struts {', '.join(names)}, expected --strut")
    name = strut or names[0]
    if name not in names:
        raise InputError(f"{path}: --strut {name}: expected one of {', '.join(names)}")
    place = list(config["signals"]["height"]).index(name)
    height_m = recording.heights_m[:, place]
    if recording.strut_forces_n is not None:
        return name, height_m, recording.strut_forces_n[:, place], "load cell", recording
    tick_s = np.asarray(run.steps.column("t_ns").to_numpy(), np.float64) * 1e-9
    estimated = np.asarray(run.steps.column(f"{name}.force_n").to_numpy(), np.float64)
    known = np.isfinite(estimated)
    if not known.any():
        raise InputError(f"{path}: holds no estimated force of {name}, expected a run that ran")
    begin, end = tick_s[known][0], tick_s[known][-1]
    inside = (recording.t_s >= begin) & (recording.t_s <= end)
    height_m = np.where(inside, height_m, np.nan)
    force_n = np.interp(recording.t_s, tick_s[known], estimated[known])
    return name, height_m, force_n, "estimated by the observer", recording


def _at_rest(
    t_s: Array, height_m: Array, force_n: Array, temperature_c: Array | None, begin: int, end: int
) -> AtRest:
    values = force_n[begin:end]
    means = np.array([part.mean() for part in np.array_split(values, min(_BATCHES, len(values)))])
    std = float(np.std(means, ddof=1)) / len(means) ** 0.5 if len(means) > 1 else float("nan")
    mean, half = float(values.mean()), 2.26 * std  # Student's t of ten batches
    return AtRest(
        float(t_s[begin]),
        float(t_s[end - 1]),
        float(height_m[begin:end].mean()),
        Figure(mean, mean - half, mean + half, "mean at rest, ten batches"),
        None if temperature_c is None else float(temperature_c[begin:end].mean()),
    )


def _or_none(figure: Figure | None) -> dict[str, object] | None:
    return None if figure is None else figure.as_dict()


def _step_dict(step: DynoStep) -> dict[str, Any]:
    return {
        "begin_s": step.begin_s,
        "end_s": step.end_s,
        "cycles": step.cycles,
        "frequency_hz": step.frequency_hz,
        "amplitude_m": step.amplitude_m,
        "middle_m": step.middle_m,
        "temperature_c": step.temperature_c,
        "compression": _side_dict(step.compression),
        "rebound": _side_dict(step.rebound),
        "energy_per_cycle_j": step.energy_per_cycle.as_dict(),
        "equivalent_damping_n_s_per_m": step.equivalent_damping.as_dict(),
        "spring_rate_n_per_m": step.spring_rate.as_dict(),
        "mean_force_n": step.mean_force.as_dict(),
        "half_difference_n": step.half_difference.as_dict(),
        "hysteresis_at_zero_n": step.hysteresis_at_zero.as_dict(),
    }


def _side_dict(side: Side) -> Mapping[str, Any]:
    return {
        "peak_velocity_m_per_s": side.peak_velocity.as_dict(),
        "force_at_peak_velocity_n": side.force_at_peak_velocity.as_dict(),
        "force_window_n": side.force_window.as_dict(),
        "force_zero_crossing_n": side.force_zero_crossing.as_dict(),
        "peak_force_n": side.peak_force.as_dict(),
        "hysteresis_n": {key: value.as_dict() for key, value in side.hysteresis.items()},
    }
