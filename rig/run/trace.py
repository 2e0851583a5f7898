"""Parts of late ticks, and the kernel's account of them.

Nothing of this runs unless it is requested: clock, port and sink of a run are wrapped then.
"""

import contextlib
import os
import resource
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import pyarrow as pa

from can_dbc.frame import Frame
from rig.bridge.bridge import TickResult
from rig.bridge.counts import Conditions
from rig.log.errors import LogError
from rig.log.file_names import TRACE_FILE
from rig.log.step_columns import Step
from rig.machine.clock import Clock, WrappedClock
from rig.run.loop import Port, Sink

_MOST_ROWS = 200_000
"""Rows kept; a run that is late at every tick would fill the memory."""

_LATE_SHARE = 0.5
"""Share of a period from which on a tick that is late, or works, is kept with the one before."""

_TYPICAL_ROWS = 1000
"""Ticks at the beginning that are always kept, as the usual case."""

_MARKS = 7
"""Times in a row."""


class TraceRow(NamedTuple):
    """One tick; times on the run's clock in ns, counters since the thread's start.

    Attributes:
        deadline_ns: When it was due.
        asleep_ns: When the loop began to wait for it.
        woke_ns: When the loop resumed.
        received_ns: When its frames were read.
        computed_ns: When the bridge was done.
        sent_ns: When its frames were sent.
        logged_ns: When it was handed to the log.
        voluntary: Times the loop gave its core away to wait.
        involuntary: Times the kernel took it.
        minor_faults: Pages mapped without a disk.
        major_faults: Pages read from a disk.
        run_delay_ns: Time in which the loop could have run and another thread did.
        steal_ns: Time in which the host did not run this machine, of all cores; as last read, which
            is at the beginning and at ticks that are late.
        log_busy: Whether the log's thread was busy when the loop resumed.
    """

    deadline_ns: int
    asleep_ns: int
    woke_ns: int
    received_ns: int
    computed_ns: int
    sent_ns: int
    logged_ns: int
    voluntary: int
    involuntary: int
    minor_faults: int
    major_faults: int
    run_delay_ns: int
    steal_ns: int
    log_busy: int


class _Busy(Protocol):
    @property
    def is_busy(self) -> bool: ...


class Trace:
    """Keeps the rows of ticks that were late."""

    def __init__(self, period_ns: int) -> None:
        self.rows: list[TraceRow] = []
        self._late_ns = round(_LATE_SHARE * period_ns)
        self._seen = 0
        self._before: TraceRow | None = None
        self._marks: list[int] = []
        self._counters: tuple[int, ...] = ()
        self._now: Callable[[], int] = lambda: 0
        self._log: _Busy | None = None
        self._schedstat = _open("/proc/thread-self/schedstat")
        self._stat = _open("/proc/stat")
        self._steal_ns = self._read_steal_ns()

    def clock(self, clock: Clock) -> Clock:
        """The clock, with marks around its waits."""
        self._now = clock.now_ns
        return _TracedClock(clock, self)

    def port(self, port: Port, log: _Busy) -> Port:
        """The port, with marks, and the run's log."""
        self._log = log
        return _TracedPort(port, self)

    def sink(self, sink: Sink) -> Sink:
        """The sink, with a mark after it."""

        def sink_and_mark(
            received: Sequence[Frame], sent: Sequence[Frame], result: TickResult, step: Step
        ) -> None:
            sink(received, sent, result, step)
            self.mark()
            self._finish()

        return sink_and_mark

    def begin(self, deadline_ns: int, asleep_ns: int, woke_ns: int) -> None:
        """A tick, after its wait."""
        self._marks = [deadline_ns, asleep_ns, woke_ns]
        used = resource.getrusage(resource.RUSAGE_THREAD)
        if woke_ns - deadline_ns > self._late_ns:
            self._steal_ns = self._read_steal_ns()
        self._counters = (
            used.ru_nvcsw,
            used.ru_nivcsw,
            used.ru_minflt,
            used.ru_majflt,
            self._read_run_delay_ns(),
            self._steal_ns,
            int(self._log is not None and self._log.is_busy),
        )

    def mark(self) -> None:
        """The end of a part of a tick."""
        self._marks.append(self._now())

    def nothing_done(self) -> None:
        """A tick of a loop that only waits: all of its parts end at once."""
        while len(self._marks) < _MARKS:
            self.mark()
        self._finish()

    def write(self, folder: Path) -> None:
        """Write the rows into the folder of the run.

        Raises:
            OSError: It cannot be written.
        """
        columns = list(zip(*self.rows, strict=True)) or [()] * len(TraceRow._fields)
        arrays = [pa.array(column, type=pa.int64()) for column in columns]
        table = pa.Table.from_arrays(arrays, names=list(TraceRow._fields))
        with (
            pa.OSFile(str(folder / TRACE_FILE), "wb") as file,
            pa.ipc.new_file(file, table.schema) as writer,
        ):
            writer.write_table(table)
        for descriptor in (self._schedstat, self._stat):
            if descriptor is not None:
                os.close(descriptor)

    def _finish(self) -> None:
        row = TraceRow(*self._marks, *self._counters)
        late = row.woke_ns - row.deadline_ns > self._late_ns
        worked = row.logged_ns - row.woke_ns > self._late_ns
        self._seen += 1
        if len(self.rows) < _MOST_ROWS and (late or worked or self._seen <= _TYPICAL_ROWS):
            if self._before is not None and (not self.rows or self.rows[-1] != self._before):
                self.rows.append(self._before)
            self.rows.append(row)
        self._before = row

    def _read_run_delay_ns(self) -> int:
        if self._schedstat is None:
            return 0
        return int(os.pread(self._schedstat, 100, 0).split()[1])

    def _read_steal_ns(self) -> int:
        if self._stat is None:
            return 0
        jiffies = int(os.pread(self._stat, 200, 0).split(maxsplit=9)[8])
        return jiffies * (1_000_000_000 // os.sysconf("SC_CLK_TCK"))


def _open(path: str) -> int | None:
    with contextlib.suppress(OSError):
        return os.open(path, os.O_RDONLY)
    return None


class _TracedClock(WrappedClock):
    def __init__(self, clock: Clock, trace: Trace) -> None:
        super().__init__(clock)
        self._trace = trace

    def wait_until(self, t_ns: int) -> int:
        asleep_ns = self.now_ns()
        woke_ns = super().wait_until(t_ns)
        self._trace.begin(t_ns, asleep_ns, woke_ns)
        return woke_ns


class _TracedPort:
    def __init__(self, port: Port, trace: Trace) -> None:
        self._port = port
        self._trace = trace

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        received = self._port.receive(t_ns)
        self._trace.mark()
        return received

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        self._trace.mark()
        sent = self._port.send(frames)
        self._trace.mark()
        return sent


def read_trace(folder: Path) -> list[TraceRow]:
    """The rows of a run's trace.

    Raises:
        LogError: The run has none, or it is damaged.
    """
    path = folder / TRACE_FILE
    if not path.is_file():
        raise LogError(f"{path}: no such file, expected a run made with --trace")
    try:
        with pa.memory_map(str(path)) as source:
            table = pa.ipc.open_file(source).read_all()
            columns = [table.column(name).to_pylist() for name in TraceRow._fields]
    except (pa.ArrowException, OSError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise LogError(f"{path}: is not a trace: {reason}") from error
    return [TraceRow(*values) for values in zip(*columns, strict=True)]
