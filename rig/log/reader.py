"""Reads the folder of a run, whole or cut off by a kill.

A replay computes the steps that a kill cut off again from the frames.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Required, TypedDict, cast

import pyarrow as pa

from can_dbc.frame import Frame
from can_dbc.yaml_file import parse_mapping, read_text
from rig.files.hashes import hash_files
from rig.log.added_columns import read_added
from rig.log.candump import LATEST_S, line_error, parse_frame
from rig.log.checksums import Damage, find_damage
from rig.log.errors import LogError
from rig.log.file_names import FRAMES_FILE, RUN_FILE, STEPS_FILE, parts
from rig.log.step_columns import step_schema

_TAIL_BYTES = 4096
"""More than the longest line of `frames.log`."""

_MOST_MAPPED = 10_000
"""Parts of a run's steps that are mapped into memory: Linux lets a process map 65 530 files."""

RUN_SCHEMA = 3
"""Version of the folder's layout and of the modes in it, in `run.yaml`."""

_READ_SCHEMAS = (2, RUN_SCHEMA)
"""A run of schema 2 has the same files, and no SETTLING: it is read, and cannot be replayed."""


class BusEntry(TypedDict, total=False):
    """The bus in a run's configuration; see `rig.bus.bus.BusConfig`."""

    interface: str
    channel: str
    bitrate: int
    data_bitrate: int | None


class ConfigEntry(TypedDict, total=False):
    """Parts of a run's configuration that are read as written; see `rig.plan.config.RunConfig`."""

    model: str
    rate_hz: float
    bus: BusEntry
    signals: dict[str, dict[str, object]]
    observers: dict[str, object]
    supervision: dict[str, object]


class Divergence(TypedDict):
    """Where the model diverged last, and when."""

    strut: str
    t_s: float


class Ending(TypedDict, total=False):
    """How a run ended, as far as it is read; see `rig.run.logged_run`."""

    status: str
    counts: dict[str, int]
    diverged: Divergence | None
    timing: dict[str, dict[str, float]]
    log_fault: str | None
    dropped_steps: int
    time_in_mode_s: dict[str, float]
    machine: dict[str, object] | None


_MAPPINGS = (("config",), ("config", "bus"), ("ending",), ("ending", "counts"), ("capture",))
"""Entries of `run.yaml` that are mappings, where they are there."""


class RunHeader(TypedDict, total=False):
    """Content of `run.yaml`: entries are of these kinds and numbers finite, others are as written.

    `schema` and `epoch_ns` are there.
    """

    schema: Required[int]
    epoch_ns: Required[int]
    config: ConfigEntry
    config_source: str
    files_sha256: dict[str, str]
    versions: dict[str, str]
    granted: dict[str, object] | None
    forced: Sequence[object]
    ending: Ending
    capture: dict[str, object]


@dataclass(frozen=True)
class RunFolder:
    """A run that is read back.

    Of its steps what a kill cut off is missing, and every file whose checksum differs: a changed
    bit may be a height of any size. Behind their columns come those that were added later.
    """

    folder: Path
    header: RunHeader
    steps: pa.Table
    epoch_ns: int
    damage: tuple[Damage, ...] = ()
    added: tuple[str, ...] = ()

    @property
    def logged_steps(self) -> pa.Table:
        """The steps as the run logged them."""
        return self.steps.drop_columns(list(self.added)) if self.added else self.steps

    @property
    def frame_files(self) -> list[Path]:
        """Files with the frames, in their order."""
        return parts(self.folder, FRAMES_FILE)

    def frames(self) -> Iterator[tuple[Frame, str]]:
        """Every frame with its direction, in the order of the log.

        Raises:
            LogError: A line other than the last, which a kill may have cut, is no frame.
        """
        for path in self.frame_files:
            try:
                with path.open(encoding="ascii", errors="replace") as file:
                    yield from self._parse_lines(file, path)
            except OSError as error:
                raise LogError(f"{path}: cannot be read: {error.strerror}") from error

    def _parse_lines(self, lines: Iterator[str], path: Path) -> Iterator[tuple[Frame, str]]:
        for number, line in enumerate(lines, start=1):
            try:
                yield parse_frame(line, self.epoch_ns)
            except (ValueError, IndexError) as error:
                if not line.endswith("\n"):
                    return
                raise line_error(f"{path}: line {number}", line) from error


def read_run(folder: Path) -> RunFolder:
    """Open a run's folder, whole or cut off by a kill.

    Raises:
        LogError: It is no run, or a file of it is damaged beyond its end.
    """
    if not folder.is_dir():
        kind = "is a file" if folder.exists() else "no such folder"
        raise LogError(f"{folder}: {kind}, expected the folder of a run")
    header = read_header(folder)
    for name in (FRAMES_FILE, STEPS_FILE):
        if not (folder / name).is_file():
            raise LogError(f"{folder}: {name} is missing, expected a run")
    damage = find_damage(folder)
    altered = [item.name for item in damage if not item.is_readable]
    steps = _read_steps([it for it in parts(folder, STEPS_FILE) if it.name not in altered])
    added = read_added(folder, steps.num_rows)
    names = [name for name in added.schema.names if name not in steps.schema.names]
    for name in names:
        steps = steps.append_column(name, added.column(name))
    return RunFolder(folder, header, steps, header["epoch_ns"], damage, tuple(names))


def _runs_below(folder: Path) -> str:
    """What an error adds where the folders of a folder are runs."""
    runs = sorted(path.parent.name for path in folder.glob(f"*/{RUN_FILE}"))[:3]
    return f", such as {', '.join(str(folder / name) for name in runs)}" if runs else ""


def read_header(folder: Path) -> RunHeader:
    """Content of a run's `run.yaml`.

    Raises:
        LogError: It is not a run's header, or was written by another version.
    """
    path = folder / RUN_FILE
    if path.exists() and not path.is_file():
        raise LogError(f"{path}: is no file, expected a run's header")
    if not path.is_file():
        raise LogError(f"{folder}: {RUN_FILE} is missing, expected a run{_runs_below(folder)}")
    header = parse_mapping(read_text(path, 64 * 1024 * 1024), str(path))
    schema = header.get("schema")
    if schema not in _READ_SCHEMAS:
        if schema is None:
            raise LogError(f"{path}: has no schema, expected the run.yaml of a run")
        raise LogError(
            f"{path}: schema {str(schema)[:40]}: expected {RUN_SCHEMA}: use the version of rig "
            "that wrote it, or record the run again"
        )
    epoch_ns = header.get("epoch_ns")
    if not isinstance(epoch_ns, int) or not 0 <= epoch_ns < LATEST_S * 1_000_000_000:
        raise LogError(f"{path}: epoch_ns: {str(epoch_ns)[:40]}: expected a Unix time in ns")
    _check_entries(header, path)
    return cast("RunHeader", header)


def _check_entries(header: Mapping[str, object], path: Path) -> None:
    """Refuse a header whose entries are of another kind than a run's, or hold no numbers."""
    for keys in _MAPPINGS:
        holder = header
        for key in keys[:-1]:
            # It is a mapping: it was checked before.
            holder = cast("Mapping[str, object]", holder.get(key, {}))
        if not isinstance(holder.get(keys[-1], {}), Mapping):
            raise LogError(f"{path}: {'.'.join(keys)}: expected a mapping")
    bus = cast("RunHeader", header).get("config", {}).get("bus", {})
    for key in ("bitrate", "data_bitrate"):
        rate = bus.get(key)
        if rate is not None and (not isinstance(rate, int) or rate < 1):
            raise LogError(f"{path}: config.bus.{key}: {str(rate)[:40]}: expected bits per second")
    entries: list[tuple[str, object]] = list(header.items())
    while entries:
        name, value = entries.pop()
        if isinstance(value, float) and not isfinite(value):
            raise LogError(f"{path}: {name}: {value}: expected a finite number")
        if isinstance(value, Mapping):
            inner = cast("Mapping[object, object]", value)
            entries += [(f"{name}.{key}", item) for key, item in inner.items()]
        elif isinstance(value, list):
            entries += [(name, item) for item in cast("list[object]", value)]


def find_changed_files(folder: Path) -> list[str]:
    """Names of a run's files that differ from those it ran with, by their hashes in `run.yaml`.

    A run of before 0.3 has no hashes of the files that its model names.

    Raises:
        LogError: A file cannot be read, or is none of the run's folder.
    """
    recorded = read_header(folder).get("files_sha256")
    if not isinstance(recorded, dict):
        return []
    changed: list[str] = []
    for key, expected in cast("dict[object, object]", recorded).items():
        name = str(key)
        path = folder / name
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise LogError(
                f"{folder / RUN_FILE}: files_sha256: {name[:100]!r}: expected a file in the folder"
            )
        try:
            sha256 = hash_files([path])
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from error
        if sha256 != expected:
            changed.append(name)
    return changed


def last_frame_ns(folder: Path, epoch_ns: int) -> int:
    """Time of the last frame that a run received, -1 if the end of its log holds none.

    Frames that it sent after its last tick are those of its end.

    Raises:
        LogError: The file cannot be read.
    """
    for path in reversed(parts(folder, FRAMES_FILE)):
        try:
            with path.open("rb") as file:
                file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
                lines = file.read().split(b"\n")[:-1]
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from error
        for line in reversed(lines):
            with contextlib.suppress(ValueError, IndexError):
                frame, direction = parse_frame(line.decode("ascii", "replace"), epoch_ns)
                if direction == "R":
                    return frame.t_ns
    return -1


def _read_steps(paths: list[Path]) -> pa.Table:
    if not paths:
        return step_schema().empty_table()
    tables = [
        _read_part(path, is_mapped=number < _MOST_MAPPED) for number, path in enumerate(paths)
    ]
    first = tables[0]
    for path, table in zip(paths, tables, strict=True):
        if table.num_rows and table.schema != first.schema:
            raise LogError(f"{path}: its columns are not those of {paths[0].name}")
    return pa.concat_tables([first, *[table for table in tables[1:] if table.num_rows]])


def _read_part(path: Path, *, is_mapped: bool) -> pa.Table:
    batches: list[pa.RecordBatch] = []
    try:
        with pa.memory_map(str(path)) if is_mapped else pa.OSFile(str(path), "r") as source:
            if source.size() < _schema_bytes(bytes(source.read(8))):
                return step_schema().empty_table()
            source.seek(0)
            stream = pa.ipc.open_stream(source)
            # Behind the last whole batch stands what a kill cut off.
            with contextlib.suppress(pa.ArrowException, OSError):
                batches.extend(stream)
            table = pa.Table.from_batches(batches, schema=stream.schema)
            table.validate(full=True)
            _check_columns(table, path)
            return table
    except LogError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(f"{path}: is no Arrow stream of steps: {reason}") from error


def _check_columns(table: pa.Table, path: Path) -> None:
    common, columns = (
        cast("list[pa.Field[pa.DataType]]", list(schema))
        for schema in (step_schema(), table.schema)
    )
    for number, column in enumerate(columns):
        expected = common[number] if number < len(common) else pa.field(column.name, pa.float64())
        if (column.name, column.type) != (expected.name, expected.type):
            raise LogError(
                f"{path}: column {number + 1} is {str(column)[:60]!r}, expected '{expected}'"
            )
        if table.column(number).null_count:
            raise LogError(f"{path}: column {column.name[:60]!r} has gaps, expected none")
    if table.num_columns < len(common):
        raise LogError(
            f"{path}: expected columns {', '.join(field.name for field in common)} at least"
        )


def _schema_bytes(head: bytes) -> int:
    """Bytes of an Arrow stream up to the end of its schema, by its first eight bytes."""
    marker, length = head[:4], int.from_bytes(head[4:8], "little", signed=True)
    return 8 + max(length, 0) if marker == b"\xff" * len(marker) else 0
