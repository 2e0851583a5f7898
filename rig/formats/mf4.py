"""A run as ASAM MDF 4: a bus log with its DBC, decoded signals, and every step."""

import hashlib
import importlib
from collections.abc import Iterable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from can_dbc.errors import InputError, missing_package
from can_dbc.frame import Frame
from rig.formats.run_content import RunContent, read_content
from rig.log.file_names import DBC_FILE, MODEL_FILE, RUN_FILE
from rig.log.reader import RunFolder

_CAN, _STEPS = "CAN_DataFrame", "steps"


_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Payload lengths by data length code."""


def _records(frames: list[tuple[Frame, str]], name: str) -> NDArray[np.void]:
    """Frames as the MDF standard's bus logging lays them out."""
    lengths = np.array([len(frame.data) for frame, _ in frames], dtype=np.int64)
    padded = b"".join(frame.data.ljust(64, b"\0") for frame, _ in frames)
    fields: list[tuple[str, str, object]] = [
        ("BusChannel", "<u1", 1),
        ("ID", "<u4", [frame.arbitration_id for frame, _ in frames]),
        ("IDE", "<u1", [frame.is_extended for frame, _ in frames]),
        ("DLC", "<u1", np.searchsorted(_FD_LENGTHS, lengths)),
        ("DataLength", "<u1", lengths),
        ("DataBytes", "(64,)u1", np.frombuffer(padded, dtype=np.uint8).reshape(-1, 64)),
        ("Dir", "<u1", [direction == "T" for _, direction in frames]),
        ("EDL", "<u1", [frame.is_fd for frame, _ in frames]),
        ("BRS", "<u1", [frame.bitrate_switch for frame, _ in frames]),
        ("ESI", "<u1", 0),
    ]
    records = np.zeros(len(frames), dtype=[(f"{name}.{key}", kind) for key, kind, _ in fields])
    for key, _, values in fields:
        records[f"{name}.{key}"] = values
    return records


def _asammdf() -> ModuleType:
    try:
        return importlib.import_module("asammdf")
    except ImportError as error:
        raise InputError(
            "format mf4: " + missing_package("asammdf", "pip install -e '.[mf4]'")
        ) from error


def write_mf4(run: RunFolder, out: Path) -> list[Path]:
    """Write a run as an MF4 file; returns it.

    Raises:
        InputError: The package asammdf is missing.
    """
    asammdf = _asammdf()
    content = read_content(run)
    source = asammdf.Source("CAN", "CAN", "", source_type=2, bus_type=2)
    dbc = content.files.get(DBC_FILE, b"")
    with closing(asammdf.MDF(version="4.10")) as mdf:
        epoch = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=run.epoch_ns // 1000)
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
        _append_signals(mdf, run.folder / DBC_FILE, content)
        _append_steps(asammdf, mdf, content.steps)
        for name, data in content.files.items():
            if name != DBC_FILE:
                mdf.attach(data, name, hash_sum=hashlib.md5(data, usedforsecurity=False).digest())
        mdf.save(str(out), compression=2)
    return [out]


def _append_signals(mdf: Any, dbc: Path, content: RunContent) -> None:
    """The signals of the frames, decoded by asammdf with the DBC."""
    if all(frame.is_error for frame, _ in content.frames):
        return
    with closing(mdf.extract_bus_logging({"CAN": [(str(dbc), 0)]})) as decoded:
        for number in range(len(decoded.groups)):
            channels = [
                _rename_columns(signal)
                for signal in decoded.iter_channels(skip_master=True)
                if signal.group_index == number
            ]
            if channels:
                mdf.append(channels, comment="decoded with the DBC")


def _rename_columns(signal: Any) -> Any:
    """Prefix a signal's name: readers that decode the frames themselves use the plain one."""
    names = [name for name in signal.display_names if name.endswith(f".{signal.name}")]
    signal.name = f"decoded.{min(names, key=len, default=signal.name)}"
    signal.display_names = {}
    return signal


def _append_steps(asammdf: ModuleType, mdf: Any, steps: pa.Table) -> None:
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


def read_mf4(source: Path) -> RunContent:
    """The content of a run that `write_mf4` wrote.

    Raises:
        InputError: It is something else, or the package asammdf is missing.
    """
    if not source.exists():
        raise InputError(f"{source}: no such file")
    asammdf = _asammdf()
    try:
        mdf = asammdf.MDF(str(source))
    except (OSError, ValueError, LookupError, asammdf.blocks.utils.MdfException) as error:
        raise InputError(
            f"{source}: is no MF4 file, expected what rig export wrote; a table requires --mapping "
            "FILE, a file of MTS --rebound, a bus log --config FILE, an FMU --fmu"
        ) from error
    with closing(mdf):
        files = {
            str(block.file_name): cast("bytes", mdf.extract_attachment(number)[0])
            for number, block in enumerate(mdf.attachments)
        }
        if RUN_FILE not in files or MODEL_FILE not in files:
            raise InputError(f"{source}: holds no {RUN_FILE}, expected an exported run")
        frames = [*_read_frames(mdf, _CAN), *_read_frames(mdf, "CAN_ErrorFrame")]
        frames.sort(key=lambda pair: pair[0].t_ns)
        return RunContent(files, frames, _read_steps(mdf))


def _read_frames(mdf: Any, name: str) -> Iterable[tuple[Frame, str]]:
    if name not in mdf:
        return
    signal = mdf.get(name)
    records = signal.samples
    t_s: NDArray[np.float64] = signal.timestamps
    t_ns = np.rint(t_s * 1e9).astype(np.int64).tolist()
    columns = [
        records[f"{name}.{field}"].tolist()
        for field in ("ID", "DataLength", "IDE", "EDL", "BRS", "Dir")
    ]
    payloads = records[f"{name}.DataBytes"]
    for row, (t, number, length, extended, fd, switched, sent) in enumerate(
        zip(t_ns, *columns, strict=True)
    ):
        data = payloads[row, :length].tobytes()
        frame = Frame(t, number, data, bool(extended), bool(fd), bool(switched), name != _CAN)
        yield frame, "T" if sent else "R"


def _read_steps(mdf: Any) -> pa.Table:
    prefix = f"{_STEPS}."
    comments = [group.channel_group.comment for group in mdf.groups]
    if _STEPS not in comments:
        return pa.table({})
    group = comments.index(_STEPS)
    names = [
        channel.name for channel in mdf.groups[group].channels if channel.name.startswith(prefix)
    ]
    return pa.table(
        {name.removeprefix(prefix): mdf.get(name, group=group).samples for name in names}
    )
