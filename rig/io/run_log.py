"""The folder of a run: written while it runs, readable after it was killed.

    run.yaml      what was known before the first tick, and how the run ended
    frames.log    every frame, received (R) and sent (T), in candump's format with ns
    steps.arrow   one record a tick, as an Arrow IPC stream

A thread of its own writes, so that a slow disk does not delay a tick. Frames are written unbuffered,
at most 10 ms after they came; steps are flushed in batches, and what a kill takes of them is
computed again from the frames.
"""

import contextlib
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import pyarrow as pa
import yaml

from can_dbc.frame import Frame
from dart_model.yaml_file import InputError, parse_mapping, read_text

FLUSH_NS = 190_000_000
"""Time of the run that a batch of steps spans; with `POLL_S` at most 0.2 s are lost to a kill."""

POLL_S = 0.01
"""How often the writing thread looks for what was handed over."""

_TAIL_BYTES = 4096
"""More than the longest line of `frames.log`."""

_MOST_WAITING = 200_000
"""Ticks that may wait for a slow disk before they are dropped, and counted."""

RUN_FILE, FRAMES_FILE, STEPS_FILE = "run.yaml", "frames.log", "steps.arrow"
MODEL_FILE, DBC_FILE = "model.yaml", "bus.dbc"

_pa = cast("Any", pa)


class Step(NamedTuple):
    """What is logged of one tick.

    Attributes:
        t_ns: Time of the tick.
        overruns: Ticks missed before it.
        received: Frames received, so that a replay gives each tick the same ones.
        mode: State of the bridge.
        flags: Bit 0 acknowledged, bit 1 bus fault, bit 2 log fault.
        applied_force_n: New applied force, NaN where none came.
        temperature_c: New temperature, NaN where none came.
        struts: Nine numbers a strut, in the order of `STRUT_COLUMNS`.
    """

    t_ns: int
    overruns: int
    received: int
    mode: int
    flags: int
    applied_force_n: float
    temperature_c: float
    struts: tuple[float, ...]


STRUT_COLUMNS = (
    "measured_height_m",
    "measured_t_ns",
    "force_n",
    "virtual_force_n",
    "valid",
    "height_m",
    "velocity_m_per_s",
    "acceleration_m_per_s2",
    "innovation_m",
)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is nothing."""


_Entry = tuple[Sequence[Frame], Sequence[Frame], Step]


def step_schema(struts: Sequence[str]) -> Any:
    """Arrow schema of `steps.arrow`."""
    fields = [
        ("t_ns", _pa.int64()),
        ("overruns", _pa.int32()),
        ("received", _pa.int32()),
        ("mode", _pa.int8()),
        ("flags", _pa.int8()),
        ("applied_force_n", _pa.float64()),
        ("temperature_c", _pa.float64()),
    ]
    fields += [(f"{strut}.{name}", _pa.float64()) for strut in struts for name in STRUT_COLUMNS]
    return _pa.schema(fields)


def step_table(steps: Sequence[Step], schema: Any) -> Any:
    """Steps as an Arrow table."""
    if not steps:
        return schema.empty_table()
    *columns, struts = zip(*steps, strict=True)
    arrays = [
        _pa.array(column, type=field.type)
        for column, field in zip([*columns, *zip(*struts, strict=True)], schema, strict=True)
    ]
    return _pa.Table.from_arrays(arrays, schema=schema)


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


class RunLog:
    """Writer of a run's folder.

    Args:
        folder: Folder to create; it must be empty or absent.
        header: What is known before the first tick, for `run.yaml`.
        struts: Names of the struts.
        epoch_ns: Unix time of the run's start.
        channel: Name of the bus in `frames.log`.
        paced: The run waits for a clock, so a thread of its own writes; otherwise the run waits for
            the disk.

    Raises:
        InputError: The folder cannot be created, or holds another run.
    """

    def __init__(
        self,
        folder: Path,
        header: dict[str, object],
        struts: Sequence[str],
        epoch_ns: int,
        channel: str,
        *,
        paced: bool,
    ) -> None:
        self.folder = folder
        self.fault: str | None = None
        """What went wrong with the disk, if anything; the run goes on."""
        self.dropped = 0
        """Ticks that a slow disk could not take."""
        self._header = header
        self._epoch_ns = epoch_ns
        self._channel = channel
        self._schema = step_schema(struts)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if (folder / RUN_FILE).exists():
                raise InputError(f"{folder}: holds a run already, expected an empty folder")
            _write_yaml(folder / RUN_FILE, header)
            self._frames = (folder / FRAMES_FILE).open("wb", buffering=0)
            self._steps = (folder / STEPS_FILE).open("wb", buffering=0)
        except OSError as error:
            raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
        self._stream = _pa.ipc.new_stream(self._steps, self._schema)
        self._waiting: deque[_Entry] = deque()
        self._batch: list[Step] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._write_until_closed, name="run-log")
        if paced:
            self._thread.start()

    def add(self, received: Sequence[Frame], sent: Sequence[Frame], step: Step) -> None:
        """Hand over what a tick received, sent and computed."""
        if len(self._waiting) >= _MOST_WAITING:
            self.dropped += 1
            self.fault = "the disk is too slow"
            return
        self._waiting.append((received, sent, step))
        if not self._thread.is_alive():
            self._write_waiting()

    def close(self, ending: dict[str, object]) -> None:
        """Write what is waiting, and how the run ended."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self._write_waiting()
        self._flush()
        try:
            self._stream.close()
            self._steps.close()
            self._frames.close()
            _write_yaml(self.folder / RUN_FILE, {**self._header, **ending})
        except OSError as error:
            self.fault = str(error.strerror)

    def _write_until_closed(self) -> None:
        # The loop only appends: waking this thread at every tick would cost the loop more.
        while not self._closing.wait(POLL_S):
            self._write_waiting()

    def _write_waiting(self) -> None:
        lines: list[str] = []
        while self._waiting:
            received, sent, step = self._waiting.popleft()
            for frames, direction in ((received, "R"), (sent, "T")):
                for frame in frames:
                    lines.append(format_frame(frame, self._epoch_ns, self._channel, direction))
            self._batch.append(step)
        try:
            self._frames.write("".join(lines).encode("ascii"))
        except OSError as error:
            self.fault = str(error.strerror)
        if self._batch and self._batch[-1].t_ns - self._batch[0].t_ns >= FLUSH_NS:
            self._flush()

    def _flush(self) -> None:
        batch, self._batch = self._batch, []
        try:
            for part in step_table(batch, self._schema).combine_chunks().to_batches():
                self._stream.write_batch(part)
        except OSError as error:
            self.fault = str(error.strerror)


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

    def frames(self) -> Iterator[tuple[Frame, str]]:
        """Every frame with its direction, in the order of the log.

        Raises:
            InputError: A line other than the last, which a kill may have cut, is no frame.
        """
        path = self.folder / FRAMES_FILE
        try:
            with path.open(encoding="ascii", errors="replace") as file:
                yield from self._parsed(file, path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error

    def _parsed(self, lines: Iterator[str], path: Path) -> Iterator[tuple[Frame, str]]:
        for number, line in enumerate(lines, start=1):
            try:
                yield parse_frame(line, self.epoch_ns)
            except (ValueError, IndexError) as error:
                if not line.endswith("\n"):
                    return
                raise InputError(
                    f"{path}: line {number}: {line.strip()[:60]!r}: expected a line such as "
                    "'(1.000000000) can0 100#0102 R'"
                ) from error


def read_run(folder: Path) -> RunFolder:
    """Open a run's folder, whole or cut off by a kill.

    Raises:
        InputError: It is no run, or a file of it is damaged beyond its end.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder, expected a run")
    for name in (RUN_FILE, FRAMES_FILE, STEPS_FILE):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: {name} is missing, expected a run")
    path = folder / RUN_FILE
    header = parse_mapping(read_text(path, 64 * 1024 * 1024), str(path))
    epoch_ns = header.get("epoch_ns")
    if not isinstance(epoch_ns, int):
        raise InputError(f"{path}: epoch_ns: {epoch_ns!r}: expected an integer")
    return RunFolder(folder, header, _read_steps(folder / STEPS_FILE), epoch_ns)


def last_frame_ns(folder: Path, epoch_ns: int) -> int:
    """Time of the last whole line of a run's `frames.log`, -1 if there is none.

    Raises:
        InputError: The file cannot be read.
    """
    path = folder / FRAMES_FILE
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            lines = file.read().split(b"\n")[:-1]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    for line in reversed(lines):
        with contextlib.suppress(ValueError, IndexError):
            return parse_frame(line.decode("ascii", "replace"), epoch_ns)[0].t_ns
    return -1


def _read_steps(path: Path) -> Any:
    batches: list[Any] = []
    try:
        with _pa.memory_map(str(path)) as source:
            if source.size() == 0:
                return step_schema(()).empty_table()
            stream = _pa.ipc.open_stream(source)
            schema = stream.schema
            try:
                batches.extend(stream)
            except (_pa.ArrowInvalid, OSError):
                pass  # the batch that a kill cut off
            return _pa.Table.from_batches(batches, schema=schema)
    except (_pa.ArrowInvalid, OSError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: is no Arrow stream of steps: {reason}") from error


def _write_yaml(path: Path, content: dict[str, object]) -> None:
    # Written beside and moved, so that a kill leaves the old or the new file, never half of one.
    beside = path.with_suffix(".tmp")
    beside.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True), "utf-8")
    beside.replace(path)
