"""The folder of a run, and how it is read.

    run.yaml      what was known before the first tick, and how the run ended
    frames.log    every frame, received (R) and sent (T), in candump's format with ns
    steps.arrow   one record a tick, as an Arrow IPC stream

Where a run was rotated, `frames.0001.log` and `steps.0001.arrow` follow, and so on. What a kill
took of the steps is computed again from the frames.
"""

import contextlib
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pyarrow as pa

from can_dbc.frame import Frame
from can_dbc.yaml_file import parse_mapping, read_text
from rig.log.errors import LogError
from rig.log.steps import step_schema

_TAIL_BYTES = 4096
"""More than the longest line of `frames.log`."""

RUN_FILE, FRAMES_FILE, STEPS_FILE = "run.yaml", "frames.log", "steps.arrow"
MODEL_FILE, DBC_FILE = "model.yaml", "bus.dbc"

END_OF_STREAM = b"\xff\xff\xff\xff\0\0\0\0"
"""What an Arrow stream that was closed ends with."""

RUN_SCHEMA = 2
"""Version of the folder's layout, in `run.yaml`."""

LATEST_S = 9_000_000_000
"""Unix time beyond which a stamp is wrong: in ns it would hardly go into 64 bits."""

_pa = cast("Any", pa)


def format_frame(frame: Frame, epoch_ns: int, channel: str, direction: str) -> str:
    """A line of candump's log format, with ns and the direction (R or T) at the end."""
    seconds, ns = divmod(frame.t_ns + epoch_ns, 1_000_000_000)
    if frame.is_error:
        identifier = f"{frame.arbitration_id | 0x20000000:08X}"
    else:
        identifier = f"{frame.arbitration_id:0{8 if frame.is_extended else 3}X}"
    separator = f"##{1 if frame.bitrate_switch else 0:X}" if frame.is_fd else "#"
    payload = frame.data.hex().upper()
    return f"({seconds}.{ns:09d}) {channel} {identifier}{separator}{payload} {direction}\n"


def parse_frame(line: str, epoch_ns: int) -> tuple[Frame, str]:
    """A frame and its direction from a line of candump's log format.

    Raises:
        ValueError: The line is none.
    """
    stamp, _, rest = line.strip().split(" ", 2)
    text, _, direction = rest.partition(" ")
    seconds, _, fraction = stamp.strip("()").partition(".")
    if not (stamp.startswith("(") and stamp.endswith(")") and 1 <= len(fraction) <= 9):
        raise ValueError(f"time stamp {stamp!r}")
    if not 0 <= int(seconds) < LATEST_S:
        raise ValueError(f"time stamp {stamp!r}")
    t_ns = int(seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")) - epoch_ns
    identifier, mark, payload = text.partition("#")
    if not mark or len(identifier) not in (3, 8):
        raise ValueError(f"frame {text!r}")
    number = int(identifier, 16)
    is_fd = payload.startswith("#")
    flags = int(payload[1], 16) if is_fd else 0
    data = bytes.fromhex(payload[2:] if is_fd else payload)
    if len(data) > (64 if is_fd else 8):
        raise ValueError(f"payload of {len(data)} bytes")
    is_error = len(identifier) == 8 and bool(number & 0x20000000)
    is_extended = len(identifier) == 8 and not is_error
    frame = Frame(t_ns, number & 0x1FFFFFFF, data, is_extended, is_fd, bool(flags & 1), is_error)
    return frame, direction if direction in ("R", "T") else "R"


@dataclass(frozen=True)
class RunFolder:
    """A run that is read back.

    Attributes:
        folder: The folder.
        header: Content of `run.yaml`.
        steps: `steps.arrow` as a table; what a kill cut off is missing.
        epoch_ns: Unix time of the run's start.
    """

    folder: Path
    header: dict[str, object]
    steps: Any
    epoch_ns: int

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
                    yield from self._parsed(file, path)
            except OSError as error:
                raise LogError(f"{path}: cannot be read: {error.strerror}") from error

    def _parsed(self, lines: Iterator[str], path: Path) -> Iterator[tuple[Frame, str]]:
        for number, line in enumerate(lines, start=1):
            try:
                yield parse_frame(line, self.epoch_ns)
            except (ValueError, IndexError) as error:
                if not line.endswith("\n"):
                    return
                raise LogError(
                    f"{path}: line {number}: {line.strip()[:60]!r}: expected a line such as "
                    "'(1.000000000) can0 100#0102 R'"
                ) from error


def parts(folder: Path, name: str) -> list[Path]:
    """A file of a run and what it was continued in, in their order."""
    stem, _, ending = name.partition(".")
    return [folder / name, *sorted(folder.glob(f"{stem}.[0-9][0-9][0-9][0-9].{ending}"))]


def part_name(name: str, number: int) -> str:
    """Name of a file's part; the first, number 0, has the plain name."""
    stem, _, ending = name.partition(".")
    return f"{stem}.{number:04d}.{ending}" if number else name


def read_run(folder: Path) -> RunFolder:
    """Open a run's folder, whole or cut off by a kill.

    Raises:
        LogError: It is no run, or a file of it is damaged beyond its end.
    """
    if not folder.is_dir():
        raise LogError(f"{folder}: is no folder, expected a run")
    for name in (RUN_FILE, FRAMES_FILE, STEPS_FILE):
        if not (folder / name).is_file():
            raise LogError(f"{folder}: {name} is missing, expected a run")
    header = read_header(folder)
    epoch_ns = cast("int", header["epoch_ns"])
    return RunFolder(folder, header, _read_steps(parts(folder, STEPS_FILE)), epoch_ns)


def read_header(folder: Path) -> dict[str, object]:
    """Content of a run's `run.yaml`.

    Raises:
        LogError: It is no run's, or one of another version.
    """
    path = folder / RUN_FILE
    header = parse_mapping(read_text(path, 64 * 1024 * 1024), str(path))
    schema = header.get("schema")
    if schema != RUN_SCHEMA:
        raise LogError(
            f"{path}: schema: {str(schema)[:40]}: expected {RUN_SCHEMA}, a run of this version"
        )
    epoch_ns = header.get("epoch_ns")
    if not isinstance(epoch_ns, int) or not 0 <= epoch_ns < LATEST_S * 1_000_000_000:
        raise LogError(f"{path}: epoch_ns: {str(epoch_ns)[:40]}: expected a Unix time in ns")
    return header


def changed_files(folder: Path) -> list[str]:
    """Names of a run's files that are not those it ran with, by their hashes in `run.yaml`.

    Raises:
        LogError: A file cannot be read.
    """
    recorded = read_run(folder).header.get("files_sha256")
    if not isinstance(recorded, dict):
        return []
    changed: list[str] = []
    for name, expected in cast("dict[object, object]", recorded).items():
        path = folder / Path(str(name)).name
        try:
            found = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from error
        if found != expected:
            changed.append(path.name)
    return changed


def last_frame_ns(folder: Path, epoch_ns: int) -> int:
    """Time of the last whole line of a run's `frames.log`, -1 if there is none.

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
                return parse_frame(line.decode("ascii", "replace"), epoch_ns)[0].t_ns
    return -1


def _read_steps(paths: list[Path]) -> Any:
    tables = [_read_part(path) for path in paths]
    first = tables[0]
    for path, table in zip(paths, tables, strict=True):
        if table.num_rows and table.schema != first.schema:
            raise LogError(f"{path}: its columns are not those of {paths[0].name}")
    return _pa.concat_tables([first, *[table for table in tables[1:] if table.num_rows]])


def _read_part(path: Path) -> Any:
    batches: list[Any] = []
    try:
        with _pa.memory_map(str(path)) as source:
            if source.size() < _schema_bytes(bytes(source.read(8))):
                return step_schema().empty_table()
            source.seek(0)
            stream = _pa.ipc.open_stream(source)
            # Behind the last whole batch stands what a kill cut off.
            with contextlib.suppress(_pa.ArrowException, OSError):
                batches.extend(stream)
            table = _pa.Table.from_batches(batches, schema=stream.schema)
            table.validate(full=True)
            _check_columns(table, path)
            return table
    except LogError:
        raise
    except (_pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(f"{path}: is no Arrow stream of steps: {reason}") from error


def _check_columns(table: Any, path: Path) -> None:
    common = step_schema()
    for number, column in enumerate(table.schema):
        expected = common[number] if number < len(common) else _pa.field(column.name, _pa.float64())
        if (column.name, column.type) != (expected.name, expected.type):
            raise LogError(
                f"{path}: column {number + 1} is {str(column)[:60]!r}, expected '{expected}'"
            )
        if table.column(number).null_count:
            raise LogError(f"{path}: column {column.name[:60]!r} has gaps, expected none")
    if table.num_columns < len(common):
        raise LogError(f"{path}: expected columns {', '.join(common.names)} at least")


def _schema_bytes(head: bytes) -> int:
    """Bytes of an Arrow stream up to the end of its schema, by its first eight bytes."""
    marker, length = head[:4], int.from_bytes(head[4:8], "little", signed=True)
    return 8 + max(length, 0) if marker == b"\xff" * len(marker) else 0
