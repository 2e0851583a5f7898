"""A run as two Parquet files."""

import json
from pathlib import Path
from typing import Any, cast

import pyarrow as pa
import pyarrow.parquet
from msgspec.structs import astuple

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.formats.run_content import RunContent, read_content
from rig.log.file_names import RUN_FILE
from rig.log.reader import RunFolder

_parquet = cast("Any", pyarrow.parquet)  # its stubs are incomplete

_STEPS_PARQUET, _FRAMES_PARQUET = "steps.parquet", "frames.parquet"
_KEY = b"rig.run"
_FRAME_SCHEMA = pa.schema(
    [
        ("t_ns", pa.int64()),
        ("arbitration_id", pa.uint32()),
        ("data", pa.binary()),
        ("is_extended", pa.bool_()),
        ("is_fd", pa.bool_()),
        ("bitrate_switch", pa.bool_()),
        ("is_error", pa.bool_()),
        ("sent", pa.bool_()),
    ]
)


def write_parquet(run: RunFolder, out: Path) -> list[Path]:
    """Write a run into a new folder; returns the files."""
    content = read_content(run)
    rows = [(*astuple(frame), direction == "T") for frame, direction in content.frames]
    columns = [list(column) for column in zip(*rows, strict=True)] or [
        [] for _ in _FRAME_SCHEMA.names
    ]
    arrays = [
        pa.array(column, type=kind)
        for column, kind in zip(columns, _FRAME_SCHEMA.types, strict=True)
    ]
    frames = pa.Table.from_arrays(arrays, schema=_FRAME_SCHEMA)
    texts = {name: data.decode("utf-8", "surrogateescape") for name, data in content.files.items()}
    metadata = {_KEY: json.dumps(texts).encode("ascii")}
    out.mkdir()
    _parquet.write_table(frames, str(out / _FRAMES_PARQUET))
    steps = content.steps.replace_schema_metadata(metadata)
    _parquet.write_table(steps, str(out / _STEPS_PARQUET))
    return [out / _FRAMES_PARQUET, out / _STEPS_PARQUET]


def read_parquet(source: Path) -> RunContent:
    """The content of a run that `write_parquet` wrote.

    Raises:
        InputError: It is something else.
    """
    try:
        steps = _parquet.read_table(str(source / _STEPS_PARQUET))
        frames = _parquet.read_table(str(source / _FRAMES_PARQUET))
    except (OSError, pa.ArrowInvalid) as error:
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
    return RunContent(files, pairs, steps.replace_schema_metadata(None))
