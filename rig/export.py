"""A run in formats that other programs read, and back.

    candump   every frame, time to the us, as `canplayer` plays it
    csv       every step, one column a quantity with its unit in the name
    parquet   `steps.parquet` and `frames.parquet`, with the run's other files in their metadata
    mf4       ASAM MDF 4: the frames as a bus log with the DBC attached, their decoded signals, and
              every step (wants the package asammdf)

Parquet and MF4 hold everything: `import_run` makes the same run of them again, but for the time of
day of the files.
"""

import hashlib
import importlib
import json
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from msgspec.structs import astuple
from numpy.typing import NDArray

from can_dbc.frame import Frame
from dart_model.yaml_file import InputError, parse_mapping
from rig.io.run_log import (
    DBC_FILE,
    FRAMES_FILE,
    MODEL_FILE,
    RUN_FILE,
    STEPS_FILE,
    RunFolder,
    format_frame,
    read_run,
)

__all__ = ["FORMATS", "export_run", "import_run"]

_STEPS_PARQUET, _FRAMES_PARQUET = "steps.parquet", "frames.parquet"
_KEY = b"rig.run"
_NOT_COPIED = (FRAMES_FILE, STEPS_FILE, "reserve.tmp")
_LARGEST_FILE_BYTES = 64 * 1024 * 1024
_CAN, _STEPS = "CAN_DataFrame", "steps"

_pa = cast("Any", pa)
_parquet = cast("Any", pyarrow.parquet)
_csv = cast("Any", pyarrow.csv)


@dataclass(frozen=True)
class _Content:
    """All that a run holds.

    Attributes:
        files: Content of its other files by name: `run.yaml`, model, DBC.
        frames: Every frame and its direction.
        steps: Every step, an Arrow table.
    """

    files: dict[str, bytes]
    frames: list[tuple[Frame, str]]
    steps: Any


def export_run(folder: Path, kind: str, out: Path) -> list[Path]:
    """Write a run in another format.

    Args:
        folder: Folder of the run.
        kind: One of `FORMATS`.
        out: File to write; for Parquet a folder.

    Returns:
        The files that were written.

    Raises:
        InputError: The run is damaged, the format is unknown or wants a package that is missing, or
            `out` exists or cannot be written.
    """
    if kind not in FORMATS:
        raise InputError(f"format {kind!r}: expected one of {', '.join(FORMATS)}")
    if out.exists():
        raise InputError(f"{out}: exists, expected a new file")
    found = read_run(folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        return FORMATS[kind](found, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error


def import_run(source: Path, folder: Path) -> None:
    """Make the folder of a run again from what `export_run` wrote.

    Args:
        source: An MF4 file, or a folder with Parquet files.
        folder: Folder to write; absent or empty.

    Raises:
        InputError: The source is no such export, or the folder cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is not empty, expected a new or an empty folder")
    content = _from_parquet(source) if source.is_dir() else _from_mf4(source)
    header = parse_mapping(content.files[RUN_FILE].decode("utf-8"), f"{source}: {RUN_FILE}")
    epoch_ns, channel = header.get("epoch_ns"), _channel(header)
    if not isinstance(epoch_ns, int):
        raise InputError(f"{source}: {RUN_FILE}: epoch_ns: {epoch_ns!r}: expected an integer")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in content.files.items():
            path = folder / _inside(name, source)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        with (folder / FRAMES_FILE).open("w", encoding="ascii") as file:
            file.writelines(
                format_frame(frame, epoch_ns, channel, direction)
                for frame, direction in content.frames
            )
        with (
            _pa.OSFile(str(folder / STEPS_FILE), "wb") as sink,
            _pa.ipc.new_stream(sink, content.steps.schema) as stream,
        ):
            stream.write_table(content.steps)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _channel(header: dict[str, object]) -> str:
    match header:
        case {"config": {"bus": {"channel": str(channel)}}} if channel and " " not in channel:
            return channel
        case _:
            return "can0"


def _inside(name: str, source: Path) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.name:
        raise InputError(f"{source}: file {name!r}: expected a name inside the run's folder")
    return path


def _content(found: RunFolder) -> _Content:
    logs = {path.name for path in found.frame_files}
    files = {
        path.relative_to(found.folder).as_posix(): path.read_bytes()
        for path in sorted(found.folder.rglob("*"))
        if path.is_file()
        and path.name not in (*_NOT_COPIED, *logs)
        and not path.name.startswith("steps.")
        and path.relative_to(found.folder).parts[0] != "captures"
        and path.stat().st_size <= _LARGEST_FILE_BYTES
    }
    return _Content(files, list(found.frames()), found.steps)


def _to_candump(found: RunFolder, out: Path) -> list[Path]:
    channel = _channel(found.header)
    with out.open("w", encoding="ascii") as file:
        for frame, direction in found.frames():
            # candump's time is in us, and it says nothing of the direction.
            line = format_frame(frame, found.epoch_ns, channel, direction)
            stamp, rest = line.split(" ", 1)
            file.write(f"{stamp[:-4]}) {rest[:-2].rstrip()}\n")
    return [out]


def _to_csv(found: RunFolder, out: Path) -> list[Path]:
    steps = found.steps
    t_s = _pa.array(steps.column("t_ns").to_numpy() * 1e-9)
    _csv.write_csv(steps.add_column(0, "t_s", t_s), str(out))
    return [out]


_FRAME_SCHEMA = _pa.schema(
    [
        ("t_ns", _pa.int64()),
        ("arbitration_id", _pa.uint32()),
        ("data", _pa.binary()),
        ("is_extended", _pa.bool_()),
        ("is_fd", _pa.bool_()),
        ("bitrate_switch", _pa.bool_()),
        ("is_error", _pa.bool_()),
        ("sent", _pa.bool_()),
    ]
)


def _to_parquet(found: RunFolder, out: Path) -> list[Path]:
    content = _content(found)
    rows = [(*astuple(frame), direction == "T") for frame, direction in content.frames]
    columns = [list(column) for column in zip(*rows, strict=True)] or [[] for _ in _FRAME_SCHEMA]
    arrays = [
        _pa.array(column, type=field.type)
        for column, field in zip(columns, _FRAME_SCHEMA, strict=True)
    ]
    frames = _pa.Table.from_arrays(arrays, schema=_FRAME_SCHEMA)
    texts = {name: data.decode("utf-8", "surrogateescape") for name, data in content.files.items()}
    metadata = {_KEY: json.dumps(texts).encode("ascii")}
    out.mkdir()
    _parquet.write_table(frames, str(out / _FRAMES_PARQUET))
    steps = content.steps.replace_schema_metadata(metadata)
    _parquet.write_table(steps, str(out / _STEPS_PARQUET))
    return [out / _FRAMES_PARQUET, out / _STEPS_PARQUET]


def _from_parquet(source: Path) -> _Content:
    try:
        steps = _parquet.read_table(str(source / _STEPS_PARQUET))
        frames = _parquet.read_table(str(source / _FRAMES_PARQUET))
    except (OSError, _pa.ArrowInvalid) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{source}: is no run in Parquet: {reason}") from error
    try:
        metadata: dict[bytes, bytes] = steps.schema.metadata or {}
        texts = cast("dict[str, str]", json.loads(metadata[_KEY]))
        files = {name: text.encode("utf-8", "surrogateescape") for name, text in texts.items()}
        _ = files[RUN_FILE]
    except (KeyError, ValueError, AttributeError) as error:
        raise InputError(f"{source}: {_STEPS_PARQUET}: holds no {RUN_FILE}") from error
    if frames.schema != _FRAME_SCHEMA:
        raise InputError(f"{source}: {_FRAMES_PARQUET}: its columns are not those of frames")
    columns = [frames.column(name).to_pylist() for name in frames.schema.names]
    pairs = [(Frame(*values), "T" if sent else "R") for *values, sent in zip(*columns, strict=True)]
    return _Content(files, pairs, steps.replace_schema_metadata(None))


def _bus_dtype(name: str) -> np.dtype[np.void]:
    fields: list[Any] = [
        (f"{name}.BusChannel", "<u1"),
        (f"{name}.ID", "<u4"),
        (f"{name}.IDE", "<u1"),
        (f"{name}.DLC", "<u1"),
        (f"{name}.DataLength", "<u1"),
        (f"{name}.DataBytes", "(64,)u1"),
        (f"{name}.Dir", "<u1"),
        (f"{name}.EDL", "<u1"),
        (f"{name}.BRS", "<u1"),
        (f"{name}.ESI", "<u1"),
    ]
    return np.dtype(fields)


_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Payload lengths by data length code."""


def _records(frames: list[tuple[Frame, str]], name: str) -> NDArray[np.void]:
    """Frames as the MDF standard's bus logging lays them out."""
    records = np.zeros(len(frames), dtype=_bus_dtype(name))
    padded = b"".join(frame.data.ljust(64, b"\0") for frame, _ in frames)
    records[f"{name}.BusChannel"] = 1
    records[f"{name}.ID"] = [frame.arbitration_id for frame, _ in frames]
    records[f"{name}.IDE"] = [frame.is_extended for frame, _ in frames]
    lengths = np.array([len(frame.data) for frame, _ in frames], dtype=np.int64)
    records[f"{name}.DLC"] = np.searchsorted(_FD_LENGTHS, lengths)
    records[f"{name}.DataLength"] = lengths
    records[f"{name}.DataBytes"] = np.frombuffer(padded, dtype=np.uint8).reshape(-1, 64)
    records[f"{name}.Dir"] = [direction == "T" for _, direction in frames]
    records[f"{name}.EDL"] = [frame.is_fd for frame, _ in frames]
    records[f"{name}.BRS"] = [frame.bitrate_switch for frame, _ in frames]
    return records


def _asammdf() -> Any:
    try:
        return importlib.import_module("asammdf")
    except ImportError as error:
        raise InputError(
            "format mf4: the package asammdf is missing, expected `pip install rig[mf4]`"
        ) from error


def _to_mf4(found: RunFolder, out: Path) -> list[Path]:
    asammdf = _asammdf()
    content = _content(found)
    source = asammdf.Source("CAN", "CAN", "", source_type=2, bus_type=2)
    dbc = content.files.get(DBC_FILE, b"")
    with closing(asammdf.MDF(version="4.10")) as mdf:
        epoch = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=found.epoch_ns // 1000)
        mdf.header.start_time = epoch
        for name, is_error in ((_CAN, False), ("CAN_ErrorFrame", True)):
            frames = [pair for pair in content.frames if pair[0].is_error is is_error]
            if not frames:
                continue
            mdf.append(
                asammdf.Signal(
                    _records(frames, name),
                    np.array([frame.t_ns for frame, _ in frames], dtype=np.int64) * 1e-9,
                    name=name,
                    source=source,
                    attachment=(dbc, DBC_FILE, hashlib.md5(dbc, usedforsecurity=False).digest()),
                ),
                comment="frames of the bus",
            )
        _append_decoded(mdf, found.folder / DBC_FILE, content)
        _append_steps(asammdf, mdf, content.steps)
        for name, data in content.files.items():
            if name != DBC_FILE:
                mdf.attach(data, name, hash_sum=hashlib.md5(data, usedforsecurity=False).digest())
        mdf.save(str(out), compression=2)
    return [out]


def _append_decoded(mdf: Any, dbc: Path, content: _Content) -> None:
    """The signals of the frames, decoded by asammdf with the DBC."""
    if not any(not frame.is_error for frame, _ in content.frames):
        return
    with closing(mdf.extract_bus_logging({"CAN": [(str(dbc), 0)]})) as decoded:
        for number in range(len(decoded.groups)):
            channels = [
                _as_decoded(signal)
                for signal in decoded.iter_channels(skip_master=True)
                if signal.group_index == number
            ]
            if channels:
                mdf.append(channels, comment="decoded with the DBC")


def _as_decoded(signal: Any) -> Any:
    """A signal under a name of its own: readers that decode the frames themselves use the plain."""
    names = [name for name in signal.display_names if name.endswith(f".{signal.name}")]
    signal.name = f"decoded.{min(names, key=len, default=signal.name)}"
    signal.display_names = {}
    return signal


def _append_steps(asammdf: Any, mdf: Any, steps: Any) -> None:
    if steps.num_rows == 0:
        return
    t_s = steps.column("t_ns").to_numpy() * 1e-9
    mdf.append(
        [
            asammdf.Signal(steps.column(name).to_numpy(), t_s, name=f"{_STEPS}.{name}")
            for name in steps.schema.names
        ],
        comment=_STEPS,
    )


def _from_mf4(source: Path) -> _Content:
    asammdf = _asammdf()
    try:
        mdf = asammdf.MDF(str(source))
    except (OSError, ValueError, LookupError, asammdf.blocks.utils.MdfException) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{source}: is no MF4 file: {reason}") from error
    with closing(mdf):
        files = {
            str(block.file_name): cast("bytes", mdf.extract_attachment(number)[0])
            for number, block in enumerate(mdf.attachments)
        }
        if RUN_FILE not in files or MODEL_FILE not in files:
            raise InputError(f"{source}: holds no {RUN_FILE}, expected an exported run")
        frames = [*_frames_of(mdf, _CAN), *_frames_of(mdf, "CAN_ErrorFrame")]
        frames.sort(key=lambda pair: pair[0].t_ns)
        return _Content(files, frames, _steps_of(mdf))


def _frames_of(mdf: Any, name: str) -> Iterable[tuple[Frame, str]]:
    if name not in mdf:
        return
    signal = mdf.get(name)
    records: Any = signal.samples
    t_s: NDArray[np.float64] = signal.timestamps
    t_ns = np.rint(t_s * 1e9).astype(np.int64).tolist()
    columns = [
        records[f"{name}.{field}"].tolist()
        for field in ("ID", "DataLength", "IDE", "EDL", "BRS", "Dir")
    ]
    payloads: Any = records[f"{name}.DataBytes"]
    for row, (t, number, length, extended, fd, switched, sent) in enumerate(
        zip(t_ns, *columns, strict=True)
    ):
        data = payloads[row, :length].tobytes()
        frame = Frame(t, number, data, bool(extended), bool(fd), bool(switched), name != _CAN)
        yield frame, "T" if sent else "R"


def _steps_of(mdf: Any) -> Any:
    prefix = f"{_STEPS}."
    group = next(
        (
            number
            for number, group in enumerate(mdf.groups)
            if group.channel_group.comment == _STEPS
        ),
        None,
    )
    if group is None:
        return _pa.table({})
    names = [
        channel.name for channel in mdf.groups[group].channels if channel.name.startswith(prefix)
    ]
    arrays = [_pa.array(mdf.get(name, group=group).samples) for name in names]
    return _pa.Table.from_arrays(arrays, names=[name.removeprefix(prefix) for name in names])


FORMATS: dict[str, Callable[[RunFolder, Path], list[Path]]] = {
    "candump": _to_candump,
    "csv": _to_csv,
    "parquet": _to_parquet,
    "mf4": _to_mf4,
}
"""How each format is written."""
