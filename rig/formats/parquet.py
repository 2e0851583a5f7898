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

_STEPS_PARQUET, _FRAMES_PARQUET = "steps.parquet", "frames.parquet"
_KEY = b"rig.run"
_pa = cast("Any", pa)
_parquet = cast("Any", pyarrow.parquet)

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


def write_parquet(run: RunFolder, out: Path) -> list[Path]:
    """Write a run into a new folder; returns the files."""
    content = read_content(run)
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


def read_parquet(source: Path) -> RunContent:
    """The content of a run that `write_parquet` wrote.

    Raises:
        InputError: It is something else.
    """
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
    return RunContent(files, pairs, steps.replace_schema_metadata(None))
