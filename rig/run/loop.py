"""The one loop: live, simulated and replayed runs differ only in ticks, source and sink."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Protocol

from msgspec import Struct

from can_dbc.frame import Frame
from rig.bridge.bridge import Bridge, BridgeState, TickResult
from rig.bridge.counts import Conditions, Counts
from rig.bridge.values import Mode, StepOutput
from rig.log.step_columns import BUS_FAULT, LIMITED, LOG_FAULT, REQUEST_FLAGS, LogColumns, Step
from rig.machine.clock import Clock
from rig.run.changed_settings import Changes, no_changes
from rig.run.timing import BINS, Timing


class Tick(Struct, frozen=True, gc=False):
    """A tick that is due, and how many were missed before it."""

    t_ns: int
    overruns: int


class Port(Protocol):
    """Where frames come from and go to."""

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames that have come up to a tick, and what is known of the bus."""
        ...

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Send the frames of a tick; returns those that were sent."""
        ...


Sink = Callable[[Sequence[Frame], Sequence[Frame], TickResult, Step], None]
"""What a tick received and sent, what it did, and the record of it."""

Progress = Callable[[int, Mode], None]
"""Called with time and mode of a tick."""

SHOWN_EVERY_NS = 200_000_000
"""Time between two looks at a run: five a second, as fast as a person reads."""


class Look(NamedTuple):
    """A look at a run after a number of ticks; without a clock there is no lateness.

    Attributes:
        t_ns: Time since the first tick, missed ones included.
        cause: Why the mode is what it is, as in the run's events; empty while it is RUNNING.
    """

    t_ns: int
    ticks: int
    output: StepOutput
    counts: Counts
    late_ns: int | None
    device_faults: tuple[tuple[int, str], ...] = ()
    log_fault: str | None = None
    cause: Mapping[str, object] = MappingProxyType({})


Watch = Callable[[Look], None]
"""Called with a look now and then; the loop itself calls it, so it must be quick."""


def _never() -> bool:
    """A stop that is never requested."""
    return False


def no_progress(_t_ns: int, _mode: Mode) -> None:
    """A progress callback that does nothing."""


def no_watch(_look: Look) -> None:
    """A watch callback that does nothing."""


@dataclass(frozen=True)
class RunControl:
    """How a run is ended and followed.

    Attributes:
        stop: Asked before each tick whether to end.
        progress: Called with time and mode of every tick.
        watch: Called with a look five times a second.
        forced: Errors of the check that the user overrode, for `run.yaml`.
    """

    stop: Callable[[], bool] = _never
    progress: Progress = no_progress
    watch: Watch = no_watch
    forced: Sequence[Mapping[str, str]] = ()


def regular_ticks(
    clock: Clock, period_ns: int, count: int | None, stop: Callable[[], bool], timing: Timing
) -> Iterator[Tick]:
    """Ticks on a grid of absolute deadlines; missed ones are skipped and counted.

    The first one is the next after now: what had to be set up before it makes no tick late.
    """
    # A number is written through a view of the memory in half the time it takes in the array.
    lateness, work = timing.lateness.data, timing.work.data
    extremes = timing.extremes_ns.data
    last = BINS - 1
    woke_ns = clock.now_ns()
    index, overruns = -(-woke_ns // period_ns), 0
    end = None if count is None else index + count
    while (end is None or index < end) and not stop():
        deadline_ns = index * period_ns
        before_ns, woke_ns = woke_ns, clock.wait_until(deadline_ns)
        late_ns = woke_ns - deadline_ns
        missed = late_ns // period_ns
        if missed > 0:
            index += missed
            overruns += missed
            if end is not None and index >= end:
                return
        lateness[min(late_ns // 1000, last)] += 1
        extremes[0] = max(extremes[0], late_ns)
        extremes[2] = max(extremes[2], woke_ns - before_ns)
        yield Tick(index * period_ns, overruns)
        overruns = 0
        work_ns = clock.now_ns() - woke_ns
        work[min(work_ns // 1000, last)] += 1
        extremes[1] = max(extremes[1], work_ns)
        index += 1


def run(
    bridge: Bridge,
    ticks: Iterator[Tick],
    port: Port,
    sink: Sink,
    columns: LogColumns,
    changes: Changes = no_changes,
) -> Iterator[BridgeState]:
    """Run the bridge over ticks; yields the state after each of them.

    Whatever has an age is as old as the first tick: setting up may have taken seconds. The record
    of every tick goes to `sink`; `changes` may give another bridge from a tick on.
    """
    first = next(ticks, None)
    if first is None:
        return
    state = bridge.init(first.t_ns)
    for tick in itertools.chain((first,), ticks):
        changed = changes(tick.t_ns)
        if changed is not None:
            bridge, state = changed, changed.take_over(state, bridge, tick.t_ns)
        frames, conditions = port.receive(tick.t_ns)
        if tick.overruns:
            conditions = conditions._replace(overruns=tick.overruns)
        limited = state.counts.limited
        state, result = bridge.tick(state, tick.t_ns, frames, conditions)
        sent = port.send(result.frames)
        output = result.output
        numbers = columns.numbers(result.step_input, output)
        flags = _flags(conditions, is_limited=result.counts.limited > limited)
        step = Step(tick.t_ns, tick.overruns, len(frames), output.mode, flags, numbers)
        sink(frames, sent, result, step)
        yield state


def _flags(conditions: Conditions, *, is_limited: bool) -> int:
    request = conditions.request
    if not (request or conditions.bus_fault or conditions.log_fault or is_limited):
        return 0
    return (
        (0 if request is None else REQUEST_FLAGS[request])
        + BUS_FAULT * conditions.bus_fault
        + LOG_FAULT * conditions.log_fault
        + LIMITED * is_limited
    )
