"""Writes the folder of a run while it runs, so that it can be read after a kill.

A thread writes, so that a slow disk does not delay a tick. Frames are written
unbuffered, at most 10 ms after they came (20 ms while no tick comes); steps are flushed in batches.
While the disk takes nothing, ticks wait in memory, and what does not fit there is counted. The
system writes to the disk when it likes to; at an interval it is made to, and waited for.
"""

import contextlib
import math
import os
import re
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import yaml

from can_dbc.atomic_file import write_whole
from can_dbc.frame import Frame
from rig.log.candump import format_frame
from rig.log.captures import Capture, Captures, CaptureWindow, Entry
from rig.log.errors import LogError
from rig.log.file_names import CAPTURES_FOLDER, CHECKSUMS_FILE, RUN_FILE
from rig.log.reader import RunHeader
from rig.log.rotation import Part, Rotation
from rig.log.step_columns import Step, StepRows
from rig.log.whole_file import WholeFile
from rig.machine.realtime import follow

FLUSH_NS = 190_000_000
"""Time of the run that a batch of steps spans; with `WAKE_NS` at most 0.2 s are lost to a kill."""

_MOST_STEPS = 200
"""Steps in a batch: while a larger one is put together a fast loop waits for the interpreter."""

_MOST_AT_ONCE = 40
"""Ticks taken over in one go, for the same reason."""

_GIVEN_WAY_S = 5e-5
"""Pause after each go. A shorter one has no effect: a thread that requests the interpreter again at
once gets it before the waiting one is awake."""

WAKE_NS = 10_000_000
"""Time of the run after which the writing thread is woken for what was handed over."""

_LONGEST_PAUSE_S = 0.02
"""After which the writing thread looks by itself, while no tick wakes it."""

MOST_WAITING = 120_000
"""Ticks that may wait for the disk before they are dropped, and counted: two minutes at 1 kHz."""

MANY_WAITING = 2_000
"""Ticks waiting that are a fault."""

_LOOK_EVERY_S = 1.0
"""Time between two writings of the side file, and two looks at what is to be noted."""

_CLOSING_S = 30.0
"""How long the end of a run waits for a slow disk."""

_RESERVE_FILE, _RESERVE_BYTES = "reserve.tmp", 65_536
"""Space kept back, so that a full disk still takes how the run ended."""


@dataclass(frozen=True)
class LogOptions:
    """What is written besides frames and steps, and when the files are continued in others.

    Attributes:
        rotation: When the files are continued.
        window: Time captured around faults; None captures nothing.
        capture_name: Name of the capture that a change from one mode to another triggers, if any.
        side_file: Name and content of a file that is rewritten once a second, if any.
        watch: Name of a file, and lines to add to it, which are asked for once a second and at the
            end, if any.
        sync_s: Interval at which the thread that writes has all on the disk; None leaves it to the
            system.
    """

    rotation: Rotation = field(default_factory=Rotation)
    window: CaptureWindow | None = None
    capture_name: Callable[[int, int], str | None] = lambda _before, _now: None
    side_file: tuple[str, Callable[[], bytes]] | None = None
    watch: tuple[str, Callable[[], Sequence[str]]] | None = None
    sync_s: float | None = None


class RunWriter:
    """Writer of a run's folder.

    Args:
        header: What is known before the first tick, for `run.yaml`; its `epoch_ns` is the Unix time
            of the run's start.
        loop_priority: Real-time priority of a loop that waits for a clock (0 for none): a thread
            writes, just below it. None: no thread writes, and the caller waits for the disk.

    Raises:
        LogError: The folder cannot be created, or holds another run.
    """

    def __init__(
        self,
        folder: Path,
        header: RunHeader,
        columns: Sequence[str],
        channel: str,
        loop_priority: int | None,
        options: LogOptions,
    ) -> None:
        self.folder = folder
        self.fault: str | None = None
        """Fault of the disk now, if any; the run continues."""
        self.trouble: str | None = None
        """First fault of the disk, if there was one."""
        self.dropped = 0
        """Ticks that the disk did not take."""
        self.is_busy = False
        """Whether ticks are being written now."""
        self._header = header
        self._epoch_ns = header["epoch_ns"]
        # A line of the log holds no blanks in its parts, nor anything beyond ASCII.
        self._channel = re.sub(r"[^!-~]", "_", channel)
        self._columns = tuple(columns)
        self._side_file, self._watch = options.side_file, options.watch
        self._sync_s = options.sync_s
        self._sync_fault: str | None = None
        self._rows = StepRows(columns)
        self._rotation = options.rotation
        self._captures = (
            None
            if options.window is None
            else Captures(options.window, options.capture_name, self._write_capture)
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if (folder / RUN_FILE).exists():
                raise LogError(f"{folder}: contains a run already, expected an empty folder")
            _write_yaml(folder / RUN_FILE, header)
            (folder / _RESERVE_FILE).write_bytes(bytes(_RESERVE_BYTES))
            self._part = Part(folder, 0, self._rows.schema, 0)
        except OSError as error:
            raise LogError(f"{folder}: cannot be written: {error.strerror}") from error
        self._waiting: deque[Entry] = deque()
        self._notes: deque[tuple[str, str]] = deque()
        self._noted: dict[str, WholeFile] = {}
        self._lines = b""
        self._closing = threading.Event()
        self._wake = threading.Event()
        self._woken_ns = 0
        self._thread = threading.Thread(
            target=self._run_thread, args=(loop_priority or 0,), name="run-log"
        )
        self._has_thread = loop_priority is not None
        if self._has_thread:
            self._thread.start()

    def add(self, received: Sequence[Frame], sent: Sequence[Frame], step: Step) -> None:
        """Hand over what a tick received, sent and computed."""
        waiting = len(self._waiting)
        if waiting >= MANY_WAITING:
            self._set_fault("the disk is too slow")
            if waiting >= MOST_WAITING:
                self.dropped += 1
                return
        self._waiting.append(Entry(received, sent, step))
        if not self._has_thread:
            self._write_waiting()
        elif step.t_ns - self._woken_ns >= WAKE_NS:
            # Woken by the end of a tick's work, and not by a timer, which would as often go off in
            # the middle of it and take the interpreter from the loop.
            self._woken_ns = step.t_ns
            self._wake.set()

    def note(self, name: str, line: str) -> None:
        """Add a line to another file of the run, before what is logged of the next tick."""
        self._notes.append((name, line))
        self._wake.set()

    def trigger(self, why: str) -> None:
        """Capture a window around the next tick, if any are; one word names its folder."""
        if self._captures is not None:
            self._captures.trigger(why)

    def close(self, ending: Callable[[], dict[str, object]], last: Sequence[Frame] = ()) -> None:
        """Write what is waiting, and then what `ending` adds to `run.yaml`.

        `last` are frames that were sent after the last tick.
        """
        self._closing.set()
        self._wake.set()
        if self._has_thread:
            self._thread.join(_CLOSING_S)
        is_stuck = self._thread.is_alive()
        if is_stuck:
            self._set_fault("the disk is too slow")
        else:
            self._finish(last)
            self._sync(self._sync_folder)
        self.dropped += len(self._waiting) + self._rows.count
        with contextlib.suppress(OSError):
            (self.folder / _RESERVE_FILE).unlink()
        try:
            _write_yaml(self.folder / RUN_FILE, {**self._header, **ending()})
        except OSError as error:
            self._set_fault(str(error.strerror))
        if not is_stuck:
            self._sync(lambda: _sync_files((self.folder / RUN_FILE, self.folder)))

    def _finish(self, last: Sequence[Frame]) -> None:
        self._write_waiting()
        self._lines += "".join(self._line(frame, "T") for frame in last).encode("ascii")
        self._look()
        if self._captures is not None:
            self._captures.finish()
        try:
            try:
                self._write_lines()
                self._flush()
            finally:
                with contextlib.ExitStack() as files:  # all of them, whichever fails
                    files.callback(self._close_notes)
                    files.callback(self._write_notes)
                    files.callback(self._end_part, self._part)
        except OSError as error:
            self._set_fault(str(error.strerror))

    def _set_fault(self, why: str) -> None:
        self.fault = why
        if self.trouble is None:
            self.trouble = why

    def _run_thread(self, loop_priority: int) -> None:
        follow(loop_priority)
        self._sync(self._sync_folder)
        look, sync = _Interval(_LOOK_EVERY_S), _Interval(self._sync_s or math.inf)
        while not self._closing.is_set():
            self._wake.wait(_LONGEST_PAUSE_S)
            self._wake.clear()
            self._write_waiting()
            if look.is_over():
                self._look()
            if sync.is_over():
                self._sync(self._sync_open_files)

    def _sync(self, sync: Callable[[], None]) -> None:
        """Write files to the disk, where the run asks for it; a fault lasts until that works."""
        if self._sync_s is None:
            return
        try:
            sync()
        except OSError as error:
            self._sync_fault = str(error.strerror)
            self._set_fault(self._sync_fault)
        else:
            self._sync_fault = None

    def _sync_open_files(self) -> None:
        self._part.sync()
        for file in self._noted.values():
            file.sync()
        _sync_files((self.folder,))  # with the names of files that are new

    def _sync_folder(self) -> None:
        paths = (path for path in self.folder.rglob("*") if path.is_file() or path.is_dir())
        _sync_files((*paths, self.folder))

    def _look(self) -> None:
        """Write the side file, and add what is to be noted beside ticks."""
        if self._watch is not None:
            name, lines = self._watch
            for line in lines():
                self.note(name, line)
        # A failure is made up for by the next writing.
        if self._side_file is not None:
            name, content = self._side_file
            with contextlib.suppress(OSError):
                write_whole(self.folder / name, content())

    def _write_waiting(self) -> None:
        """Write what waits; what the disk does not take is kept, and tried again the next time."""
        self.is_busy = True
        try:
            self._write_notes()
            self._write_lines()
            self._flush_if_due()
            while self._waiting:
                room = _MOST_STEPS - self._rows.count
                count = min(_MOST_AT_ONCE, room, len(self._waiting))
                self._write_notes()  # after the count, so that a note precedes its tick
                self._take(count)
                self._write_lines()
                self._give_way()
                self._flush_if_due()
        except OSError as error:
            self._set_fault(str(error.strerror))
        else:
            self.fault = self._sync_fault
        finally:
            self.is_busy = False

    def _write_notes(self) -> None:
        while self._notes:
            name, line = self._notes[0]
            if name not in self._noted:
                self._noted[name] = WholeFile(self.folder / name)
            self._noted[name].append(line.encode())
            self._notes.popleft()

    def _close_notes(self) -> None:
        with contextlib.ExitStack() as files:
            for file in self._noted.values():
                files.callback(file.close)

    def _give_way(self) -> None:
        """Let the loop have the interpreter, if it waits for it."""
        if self._has_thread:
            time.sleep(_GIVEN_WAY_S)

    def _take(self, count: int) -> None:
        lines: list[str] = []
        for _ in range(count):
            entry = self._waiting.popleft()
            lines += self._lines_of(entry)
            self._rows.append(entry.step)
            if self._captures is not None:
                self._captures.take(entry)
        self._lines = "".join(lines).encode("ascii")

    def _lines_of(self, entry: Entry) -> list[str]:
        lines = [self._line(frame, "R") for frame in entry.received]
        return lines + [self._line(frame, "T") for frame in entry.sent]

    def _line(self, frame: Frame, direction: str) -> str:
        return format_frame(frame, self._epoch_ns, self._channel, direction)

    def _write_lines(self) -> None:
        self._part.frames.append(self._lines)
        self._lines = b""

    def _flush_if_due(self) -> None:
        if self._rows.span_ns >= FLUSH_NS or self._rows.count >= _MOST_STEPS:
            last_ns = self._rows.last_ns
            self._flush()
            self._rotate(last_ns)
            self._give_way()

    def _flush(self) -> None:
        if self._rows.count:
            self._part.steps.append(_serialize(self._rows))
            self._rows.clear()

    def _rotate(self, now_ns: int) -> None:
        """Continue in new files, if it is time; frames and steps then end with the same tick."""
        limit, part = self._rotation, self._part
        is_full = limit.size_bytes is not None and part.size >= limit.size_bytes
        is_long = limit.time_ns is not None and now_ns - part.begin_ns >= limit.time_ns
        if is_full or is_long:
            self._part = Part(self.folder, part.number + 1, self._rows.schema, now_ns)
            self._end_part(part)

    def _end_part(self, part: Part) -> None:
        """Close a part and note its checksums."""
        try:
            part.end()
            self._sync(part.sync)
        finally:
            part.close()
            self.note(CHECKSUMS_FILE, part.checksums)

    def _write_capture(self, capture: Capture) -> None:
        folder = self.folder / CAPTURES_FOLDER / f"{capture.number:03d}_{capture.why}"
        header = {**self._header, "capture": {"why": capture.why, "t_s": capture.t_ns * 1e-9}}
        rows = StepRows(self._columns)
        try:
            folder.mkdir(parents=True)
            part = Part(folder, 0, rows.schema, 0)
            for first in range(0, len(capture.entries), _MOST_AT_ONCE):
                lines: list[str] = []
                for entry in capture.entries[first : first + _MOST_AT_ONCE]:
                    rows.append(entry.step)
                    lines += self._lines_of(entry)
                part.frames.append("".join(lines).encode("ascii"))
                part.steps.append(_serialize(rows))
                rows.clear()
                self._give_way()
            part.end()
            part.close()
            write_whole(folder / CHECKSUMS_FILE, part.checksums)
            for name in self._header.get("files_sha256", {}):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.folder / name, folder / name)
            _write_yaml(folder / RUN_FILE, header)
        except OSError as error:
            self._set_fault(f"capture {folder.name}: {error.strerror}")


class _Interval:
    """Time that passes again and again."""

    def __init__(self, length_s: float) -> None:
        self._length_s = length_s
        self._end_s = time.monotonic() + length_s

    def is_over(self) -> bool:
        """Whether it has passed; then the next one begins."""
        now_s = time.monotonic()
        if now_s < self._end_s:
            return False
        self._end_s = now_s + self._length_s
        return True


def _sync_files(paths: Iterable[Path]) -> None:
    """Have files, and the names in folders, on the disk."""
    for path in paths:
        with contextlib.suppress(FileNotFoundError):  # requests and claims are removed again
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)


def _serialize(rows: StepRows) -> bytes:
    return bytes(rows.batch().serialize())


def _write_yaml(path: Path, content: Mapping[str, object]) -> None:
    write_whole(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
