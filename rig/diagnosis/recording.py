"""Recordings of a bench: what was measured, read from CSV or from a run folder, and checked.

A recording that cannot be diagnosed is refused before anything is computed from it, with one line:
what is wrong, and what to do.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.addressing import Directory
from can_dbc.codec import decode_log
from can_dbc.database import Message
from can_dbc.errors import InputError
from can_dbc.protection import check_crc_log
from dart_model.spec import ModelSpec
from rig.channels.channel import Channel
from rig.channels.quantities import APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE, Quantity
from rig.diagnosis.clipping import find_long_plateaus
from rig.files.delimited_text import read_csv_columns
from rig.log.file_names import STEPS_FILE, parts
from rig.log.reader import RunFolder
from rig.log.reader import read_run as read_run_folder
from rig.plan.load import plan_of_run
from rig.plan.plan import Plan

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

COLUMNS = ("t_s", "height_m", "applied_force_n", "strut_force_n", "temperature_c")
"""Columns of a CSV file. Heights and strut forces may name their strut: ``height_m:tyre``."""

_OF_A_STRUT = ("height_m", "strut_force_n")
_LEAST_SAMPLES = 200
_LEAST_DURATION_S = 0.5
_LARGEST_BYTES = 2_000_000_000
_LARGEST_HEIGHT_M = 100.0
_LONGEST_DURATION_S = 600.0
"""A longer recording adds nothing about a strut, and takes minutes."""
_MOST_MISSING = 0.3
"""Share of missing heights above which a sensor is taken for broken."""
_LONGEST_STEP_S = 0.05
"""Usual time between samples above which a time in other units is more likely."""


class RecordingError(InputError):
    """A recording that cannot be diagnosed; one line: file, column, fault, what was expected."""


@dataclass(frozen=True)
class Recording:
    """One run of a bench, as measured.

    Attributes:
        t_s: Times, increasing, shape (N,).
        heights_m: Heights of the struts, shape (N, struts); NaN where a sample is missing.
        applied_force_n: Applied force, shape (N,), or None where the bench has none.
        strut_forces_n: Load-cell force of each strut, shape (N, struts), a column of NaN for a
            strut without a cell; None where there is no cell.
        temperature_c: Damper temperature, shape (N,), or None.
        sha256: Of the file, or of the run's steps, in hex; None where it was not read from one.
    """

    name: str
    t_s: Array
    heights_m: Array
    applied_force_n: Array | None = None
    strut_forces_n: Array | None = None
    temperature_c: Array | None = None
    sha256: str | None = None

    @property
    def duration_s(self) -> float:
        """Time from first to last sample."""
        return float(self.t_s[-1] - self.t_s[0])


def read_recording(path: Path, struts: Sequence[str] | None = None) -> Recording:
    """Recording from a run's folder or from a CSV file, whose columns may name `struts`.

    Raises:
        InputError: There is no such run.
        RecordingError: It holds nothing that can be diagnosed.
    """
    if path.is_dir():
        return replace(read_run(path), sha256=_sha256(parts(path, STEPS_FILE)))
    if not path.is_file():
        raise InputError(f"{path}: no such run, expected a run's folder or a CSV file")
    return replace(read_csv(path, struts), sha256=_sha256([path]))


def _sha256(files: Iterable[Path]) -> str:
    """SHA-256 of files, one after another, in hex."""
    digest = sha256()
    for path in files:
        with path.open("rb") as file:
            while piece := file.read(1 << 20):
                digest.update(piece)
    return digest.hexdigest()


# --- CSV --------------------------------------------------------------------------------------


def read_csv(path: Path, struts: Sequence[str] | None = None) -> Recording:
    """Recording from a CSV file with units in its header.

    `struts` are the model's, in its order; columns without a strut's name belong to the only one.

    Raises:
        RecordingError: The file is no such table, or holds no run that can be diagnosed.
    """
    name = path.name
    try:
        values, _ = read_csv_columns(
            path, name, _LARGEST_BYTES, lambda header: _check_header(name, header)
        )
    except InputError as error:
        raise RecordingError(str(error)) from error
    columns, samples = list(values), len(values["t_s"])
    if not samples:
        raise RecordingError(f"{name}: holds no samples, expected at least {_LEAST_SAMPLES}")
    names = _struts_of(name, columns, struts)
    heights = [_column_of(name, values, "height_m", strut, names) for strut in names]
    if any(height is None for height in heights):
        missing = names[[height is None for height in heights].index(True)]
        raise RecordingError(f"{name}: header: expected a column height_m:{missing}")
    cells = [_column_of(name, values, "strut_force_n", strut, names) for strut in names]
    return check_recording(
        Recording(
            name,
            values["t_s"],
            np.column_stack([height for height in heights if height is not None]),
            values.get("applied_force_n"),
            _stack_columns(cells, samples),
            values.get("temperature_c"),
        )
    )


def _stack_columns(cells: Sequence[Array | None], samples: int) -> Array | None:
    if all(cell is None for cell in cells):
        return None
    return np.column_stack([np.full(samples, np.nan) if cell is None else cell for cell in cells])


def _column_of(
    name: str, values: Mapping[str, Array], kind: str, strut: str, names: Sequence[str]
) -> Array | None:
    """The column of a strut; without a name it belongs to the only strut."""
    named, plain = values.get(f"{kind}:{strut}"), values.get(kind)
    if plain is not None and len(names) > 1:
        raise RecordingError(
            f"{name}: header: column {kind} of {len(names)} struts ({', '.join(names)}), "
            f"expected {kind}:{strut}"
        )
    return plain if named is None else named


def _struts_of(name: str, columns: Sequence[str], struts: Sequence[str] | None) -> list[str]:
    named = [column.partition(":")[2] for column in columns if ":" in column]
    if struts is None:
        return list(dict.fromkeys(named)) or [""]
    for strut in named:
        if strut not in struts:
            raise RecordingError(
                f"{name}: header: strut {strut[:40]!r}: expected one of {', '.join(struts)}"
            )
    return list(struts)


def _check_header(name: str, columns: list[str]) -> list[str]:
    """The columns of a file's header, all of them, if they are those of a recording."""
    if not columns:
        raise RecordingError(f"{name}: is empty, expected a header {','.join(COLUMNS[:3])}")
    kinds: list[str] = []
    for column in columns:
        kind, colon, strut = column.partition(":")
        if kind not in COLUMNS or (colon and (kind not in _OF_A_STRUT or not strut)):
            raise RecordingError(
                f"{name}: header: column {column[:40]!r}: expected one of {', '.join(COLUMNS)}, "
                "a height or strut force with its strut as in height_m:tyre"
            )
        if columns.count(column) > 1:
            raise RecordingError(f"{name}: header: column {column} occurs twice, expected once")
        kinds.append(kind)
    for column in COLUMNS[:2]:
        if column not in kinds:
            raise RecordingError(f"{name}: header: column {column} is missing, expected it")
    if "applied_force_n" not in kinds and "strut_force_n" not in kinds:
        raise RecordingError(
            f"{name}: header: expected applied_force_n or strut_force_n, in addition to t_s and "
            "height_m"
        )
    return columns


# --- Run folders ------------------------------------------------------------------------------


def read_run(folder: Path) -> Recording:
    """What the bench sent in a run, on the time of the first strut's height.

    Frames with a wrong CRC or length are ignored; single missing heights are NaN, the other
    channels are linear between their samples.

    Raises:
        InputError: The run is damaged, or holds no height.
        RecordingError: It holds nothing that can be diagnosed.
    """
    plan = plan_of_run(folder)
    payloads = _payloads(read_run_folder(folder), plan)
    heights = [_samples(payloads, channel) for channel in plan.heights]
    for channel, (t_s, _) in zip(plan.heights, heights, strict=True):
        if len(t_s) < 2:
            raise InputError(
                f"{folder}: no {_message(channel).name} with the height of strut {channel.name}"
            )
    t_s = heights[0][0]
    half_s = 0.5 * float(np.median(np.diff(t_s)))

    def bench(quantity: Quantity) -> Array | None:
        channel = plan.bench_channel(quantity)
        if channel is None:
            return None
        own_t_s, values = _samples(payloads, channel)
        return np.interp(t_s, own_t_s, values) if len(own_t_s) else None

    cell = bench(LOAD_CELL_FORCE)
    if cell is None and bench(APPLIED_FORCE) is None:
        raise RecordingError(
            f"{folder}: has heights alone, expected signals.applied_force or "
            "signals.load_cell_force in its configuration, and frames of it"
        )
    # The bus carries one load cell; with several struts its strut is not known.
    return check_recording(
        Recording(
            folder.name,
            t_s,
            np.column_stack([_nearest(t_s, *height, half_s) for height in heights]),
            bench(APPLIED_FORCE),
            None if cell is None or len(heights) > 1 else cell[:, np.newaxis],
            bench(TEMPERATURE),
        )
    )


_Payloads = dict[str, tuple[NDArray[np.int64], NDArray[np.uint8]]]


def _message(channel: Channel) -> Message:
    if channel.message is None:
        raise ValueError(f"{channel.key}: expected a channel on a bus")
    return channel.message


def _payloads(run: RunFolder, plan: Plan) -> _Payloads:
    """Times and payloads of every received message, wrong lengths left out."""
    messages = sorted(
        {item.name: item for item in map(_message, plan.channels)}.values(),
        key=lambda item: item.name,
    )
    directory = Directory(messages)
    times: list[list[int]] = [[] for _ in messages]
    data: list[list[bytes]] = [[] for _ in messages]
    for frame, direction in run.frames():
        index = directory.index_of(frame.arbitration_id, frame.is_extended)
        if index is None or direction != "R" or frame.is_error:
            continue
        if len(frame.data) == messages[index].length_bytes:
            times[index].append(frame.t_ns)
            data[index].append(frame.data)
    return {
        message.name: (
            np.array(times[index], dtype=np.int64),
            np.frombuffer(b"".join(data[index]), dtype=np.uint8).reshape(-1, message.length_bytes),
        )
        for index, message in enumerate(messages)
    }


def _samples(payloads: _Payloads, channel: Channel) -> tuple[Array, Array]:
    """Sample times in s and values of one channel."""
    message = _message(channel)
    t_ns, data = payloads[message.name]
    good = np.ones(len(data), dtype=bool)
    if message.protection is not None:
        good = check_crc_log(data, message.protection)
    signal = channel.signal
    values = decode_log(message, [signal], [channel.quantity.dimension], data)[signal]
    good &= np.isfinite(values)
    t_s, first = np.unique(_sample_times_s(t_ns[good], message), return_index=True)
    return t_s, values[good][first]


def _sample_times_s(t_ns: NDArray[np.int64], message: Message) -> Array:
    """Times of sampling in s: on the grid of the cycle time where the arrivals fit one."""
    cycle_ns = message.cycle_time_ns
    if cycle_ns is None or len(t_ns) == 0:
        return np.asarray(t_ns * 1e-9, dtype=np.float64)
    index = np.rint((t_ns - t_ns[0]) / cycle_ns)
    jitter_ns = t_ns - t_ns[0] - index * cycle_ns
    if float(np.max(np.abs(jitter_ns - np.median(jitter_ns)))) > 0.4 * cycle_ns:
        return np.asarray(t_ns * 1e-9, dtype=np.float64)
    return (t_ns[0] + np.median(jitter_ns) + index * cycle_ns) * 1e-9


def _nearest(t_s: Array, own_t_s: Array, values: Array, half_s: float) -> Array:
    """Values at the times of another message; NaN where none is near."""
    at = np.clip(np.searchsorted(own_t_s, t_s - half_s), 0, len(own_t_s) - 1)
    return np.where(np.abs(own_t_s[at] - t_s) <= half_s, values[at], np.nan)


# --- Checks -----------------------------------------------------------------------------------


def check_recording(recording: Recording) -> Recording:
    """The recording itself; single missing heights are allowed.

    Raises:
        RecordingError: Its data would mislead: clipped, constant, in wrong units, too short.
    """
    name, t_s = recording.name, recording.t_s
    if len(t_s) < _LEAST_SAMPLES:
        raise RecordingError(
            f"{name}: {len(t_s)} samples, expected at least {_LEAST_SAMPLES}: record a longer run"
        )
    _check_times(name, t_s)
    for height_m in recording.heights_m.T:
        _check_height(name, height_m)
    for label, channel, advice in _channels(recording):
        bad = ~np.isfinite(channel)
        if np.any(bad):
            raise RecordingError(
                f"{name}: {label} is no number in {int(bad.sum())} samples, first in sample "
                f"{int(np.argmax(bad))}, expected numbers"
            )
        if advice and float(np.ptp(channel)) == 0.0:
            raise RecordingError(
                f"{name}: {label} is constant at {channel[0]:.6g} N, expected it to change: "
                f"{advice}"
            )
        if label == "strut_force_n":
            _refuse_clipping(name, label, "N", channel)
    return recording


def check_fits(recording: Recording, spec: ModelSpec) -> None:
    """Refuse a recording that does not belong to a model, or that misleads, see `check_recording`.

    Raises:
        RecordingError: See above.
    """
    check_recording(recording)
    struts = len(spec.struts)
    if recording.heights_m.shape[1] != struts:
        raise RecordingError(
            f"{recording.name}: {recording.heights_m.shape[1]} heights, model {spec.name} has "
            f"{struts} struts, expected one height for each"
        )
    if recording.duration_s > _LONGEST_DURATION_S:
        raise RecordingError(
            f"{recording.name}: {recording.duration_s:.0f} s long, "
            f"expected at most {_LONGEST_DURATION_S:.0f} s: cut it"
        )


def _channels(recording: Recording) -> Iterable[tuple[str, Array, str]]:
    if recording.applied_force_n is not None:
        yield "applied_force_n", recording.applied_force_n, "apply a force that changes"
    if recording.strut_forces_n is not None:
        for column in recording.strut_forces_n.T:
            if not np.all(np.isnan(column)):
                yield "strut_force_n", column, "is the load cell connected?"
    if recording.temperature_c is not None:
        yield "temperature_c", recording.temperature_c, ""


def _check_times(name: str, t_s: Array) -> None:
    if not np.all(np.isfinite(t_s)):
        row = int(np.argmin(np.isfinite(t_s)))
        raise RecordingError(f"{name}: t_s is no number in sample {row}, expected a time in s")
    steps = np.diff(t_s)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise RecordingError(
            f"{name}: t_s = {t_s[row]:.6g} in sample {row} after {t_s[row - 1]:.6g}, "
            "expected times that increase"
        )
    if t_s[-1] - t_s[0] < _LEAST_DURATION_S:
        raise RecordingError(
            f"{name}: t_s spans {t_s[-1] - t_s[0]:.3g} s, "
            f"expected at least {_LEAST_DURATION_S} s: is the time in s?"
        )
    usual = float(np.median(steps))
    if usual > _LONGEST_STEP_S:
        raise RecordingError(
            f"{name}: t_s has one sample in {usual:.3g} s, expected "
            f"{1.0 / _LONGEST_STEP_S:.0f} a second or more: is the time in s?"
        )


def _check_height(name: str, height_m: Array) -> None:
    finite = np.isfinite(height_m)
    if np.any(np.isinf(height_m)) or float(np.mean(~finite)) > _MOST_MISSING:
        raise RecordingError(
            f"{name}: height_m is no number in {int((~finite).sum())} of {len(finite)} samples, "
            f"expected at most {100.0 * _MOST_MISSING:.0f} % missing"
        )
    heights = height_m[finite]
    if float(np.max(np.abs(heights))) > _LARGEST_HEIGHT_M:
        raise RecordingError(
            f"{name}: height_m reaches {np.max(np.abs(heights)):.6g} m, expected less than "
            f"{_LARGEST_HEIGHT_M:g} m: are the columns swapped, or the unit wrong?"
        )
    if float(np.ptp(heights)) == 0.0:
        raise RecordingError(
            f"{name}: height_m is constant at {heights[0]:.6g} m, "
            "expected motion: is the sensor connected?"
        )
    _refuse_clipping(name, "height_m", "m", heights)


def _refuse_clipping(name: str, label: str, unit: str, values: Array) -> None:
    plateaus = find_long_plateaus(values)
    if plateaus is not None:
        raise RecordingError(
            f"{name}: {label} stays at its {plateaus.extreme} value {plateaus.limit:.6g} {unit} "
            f"for {int(np.max(plateaus.lengths))} samples in a row, expected a sensor that is not "
            "clipped: widen its range or reduce the load"
        )
