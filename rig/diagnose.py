"""Runs in, diagnosis out: whatever a run is logged as becomes records, and results become files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.codec import decode_log
from can_dbc.database import Message
from can_dbc.protection import check_crc_log
from dart_model.spec import ModelSpec, copy_skeleton
from dart_model.yaml_file import InputError
from rig.config import Setup, SignalName
from rig.core.messages import Quantity
from rig.identify.diagnose import diagnose
from rig.identify.diagnosis import Diagnosis, write_results
from rig.identify.records import Record, checked, read_csv
from rig.identify.report import ReportInput, write_report
from rig.io.run_log import RUN_FILE, RunFolder
from rig.replay import setup_of_run

_Array = NDArray[np.float64]


def read_record(path: Path) -> Record:
    """A record from a run's folder or from a CSV file.

    Raises:
        InputError: There is no such run.
        RecordError: It holds nothing that can be diagnosed.
    """
    if path.is_dir():
        return record_of_run(path)
    if not path.is_file():
        raise InputError(f"{path}: no such run, expected a run's folder or a CSV file")
    return read_csv(path)


def record_of_run(folder: Path) -> Record:
    """What the bench sent in a run, on the time of the first strut's height.

    Frames with a wrong CRC or length are left out; single missing heights are NaN, the other
    channels are linear between their samples.

    Args:
        folder: Folder of the run.

    Raises:
        InputError: The run is damaged, or holds no height.
        RecordError: It holds nothing that can be diagnosed.
    """
    found, ready = setup_of_run(folder)
    payloads = _payloads(found, ready)
    signals = ready.config.signals
    heights = [
        _channel(ready, payloads, entry, Quantity.HEIGHT) for entry in signals.height.values()
    ]
    for (name, entry), (t_s, _) in zip(signals.height.items(), heights, strict=True):
        if len(t_s) < 2:
            raise InputError(f"{folder}: no {entry.message} with the height of strut {name}")
    t_s = heights[0][0]
    half_s = 0.5 * float(np.median(np.diff(t_s)))

    def other(entry: SignalName | None, quantity: Quantity) -> _Array | None:
        if entry is None:
            return None
        own_t_s, values = _channel(ready, payloads, entry, quantity)
        return np.interp(t_s, own_t_s, values) if len(own_t_s) else None

    return checked(
        Record(
            folder.name,
            t_s,
            np.column_stack([_nearest(t_s, *height, half_s) for height in heights]),
            other(signals.applied_force, Quantity.APPLIED_FORCE),
            other(signals.load_cell_force, Quantity.LOAD_CELL_FORCE),
            other(signals.temperature, Quantity.TEMPERATURE),
        )
    )


_Payloads = dict[tuple[int, bool], tuple[NDArray[np.int64], NDArray[np.uint8]]]


def _payloads(found: RunFolder, ready: Setup) -> _Payloads:
    """Times and payloads of every received message, wrong lengths left out."""
    lengths = {
        (message.arbitration_id, message.is_extended): message.length_bytes
        for message in map(
            ready.database.message, {entry.message for entry in ready.config.signals.named()}
        )
    }
    times: dict[tuple[int, bool], list[int]] = {key: [] for key in lengths}
    data: dict[tuple[int, bool], list[bytes]] = {key: [] for key in lengths}
    for frame, direction in found.frames():
        key = (frame.arbitration_id, frame.is_extended)
        if direction == "R" and not frame.is_error and lengths.get(key) == len(frame.data):
            times[key].append(frame.t_ns)
            data[key].append(frame.data)
    return {
        key: (
            np.array(times[key], dtype=np.int64),
            np.frombuffer(b"".join(data[key]), dtype=np.uint8).reshape(-1, length),
        )
        for key, length in lengths.items()
    }


def _channel(
    ready: Setup, payloads: _Payloads, entry: SignalName, quantity: Quantity
) -> tuple[_Array, _Array]:
    """Sample times in s and values of one signal."""
    message = ready.database.message(entry.message)
    t_ns, data = payloads[message.arbitration_id, message.is_extended]
    good = np.ones(len(data), dtype=bool)
    if message.protection is not None:
        good = check_crc_log(data, message.protection)
    values = decode_log(message, [entry.signal], [quantity.dimension], data)[entry.signal]
    good &= np.isfinite(values)
    t_s, first = np.unique(_sample_times_s(t_ns[good], message), return_index=True)
    return t_s, values[good][first]


def _sample_times_s(t_ns: NDArray[np.int64], message: Message) -> _Array:
    """Times of sampling: on the grid of the cycle time where arrivals say that there is one."""
    cycle_ns = message.cycle_time_ns
    if cycle_ns is None or len(t_ns) == 0:
        return np.asarray(t_ns * 1e-9, dtype=np.float64)
    index = np.rint((t_ns - t_ns[0]) / cycle_ns)
    jitter_ns = t_ns - t_ns[0] - index * cycle_ns
    if float(np.max(np.abs(jitter_ns - np.median(jitter_ns)))) > 0.4 * cycle_ns:
        return np.asarray(t_ns * 1e-9, dtype=np.float64)
    return (t_ns[0] + np.median(jitter_ns) + index * cycle_ns) * 1e-9


def _nearest(t_s: _Array, own_t_s: _Array, values: _Array, half_s: float) -> _Array:
    """Values at the times of another message; NaN where none is near."""
    at = np.clip(np.searchsorted(own_t_s, t_s - half_s), 0, len(own_t_s) - 1)
    return np.where(np.abs(own_t_s[at] - t_s) <= half_s, values[at], np.nan)


DIAGNOSIS_FILE, CORRECTED_FILE, REPORT_FILE = "diagnosis.json", "corrected.yaml", "report.html"


def diagnose_runs(
    runs: Sequence[Path],
    model: ModelSpec,
    held_out: Sequence[Path],
    out: Path,
    progress: Callable[[str, float], None],
) -> Diagnosis:
    """Diagnose runs, and write the diagnosis, the corrected model and the report.

    Args:
        runs: Folders of runs, or CSV files.
        model: The model.
        held_out: Runs to judge on.
        out: Folder to write into.
        progress: Told what is being done, and the share that is done.

    Raises:
        InputError: A run cannot be read, or `out` cannot be written or holds a run.
        RecordError: A run holds nothing that can be diagnosed.
    """
    if (out / RUN_FILE).exists():
        raise InputError(f"{out}: holds a run, expected another folder for what was found")
    result = diagnose(
        model,
        [read_record(path) for path in runs],
        [read_record(path) for path in held_out],
        progress,
    )
    progress("writing the report", 1.0)
    report = ReportInput(
        result.diagnosis, result.fitted, result.held_out, result.ranking, result.assumptions
    )
    try:
        write_results(result.diagnosis, result.corrected, out)
        copy_skeleton(model, out)
        write_report(report, out / REPORT_FILE)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return result.diagnosis
