"""Windows of a run around its faults, each written as a run folder."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from can_dbc.frame import Frame
from rig.log.step_columns import BUS_FAULT, LIMITED, LOG_FAULT, Step


class Entry(NamedTuple):
    """Frames and record of a tick."""

    received: Sequence[Frame]
    sent: Sequence[Frame]
    step: Step


@dataclass(frozen=True)
class CaptureWindow:
    """Time captured before and after a trigger, and the most captures of one run."""

    before_ns: int
    after_ns: int
    most: int


class Capture(NamedTuple):
    """A finished window: its number from 1 on, its trigger in one word, and all of its ticks."""

    number: int
    why: str
    t_ns: int
    entries: list[Entry]


class Captures:
    """Watches a run tick by tick for triggers.

    A trigger is a change to HOLD or SAFE, a fault of the bus or of the log, or a limit passed, that
    was not there the tick before, or one given with `trigger`. A trigger within a window does not
    lengthen it.
    """

    def __init__(
        self,
        window: CaptureWindow,
        capture_name: Callable[[int, int], str | None],
        finished: Callable[[Capture], None],
    ) -> None:
        self._window = window
        self._capture_name = capture_name
        self._finished = finished
        self._before: deque[Entry] = deque()
        self._open: Capture | None = None
        self._count = 0
        self._requested: str | None = None
        self._mode = 0
        self._flags = 0

    def trigger(self, why: str) -> None:
        """Capture at the next tick, for one word of a reason; may be called from any thread."""
        self._requested = why

    def take(self, entry: Entry) -> None:
        """Take over a tick, and report a window that it ends."""
        step = entry.step
        why = self._find_trigger(step)
        self._mode, self._flags = step.mode, step.flags
        oldest_ns = step.t_ns - self._window.before_ns
        while self._before and self._before[0].step.t_ns < oldest_ns:
            self._before.popleft()
        if self._open is None and why is not None and self._count < self._window.most:
            self._count += 1
            self._open = Capture(self._count, why, step.t_ns, list(self._before))
        if self._open is not None:
            self._open.entries.append(entry)
            if step.t_ns - self._open.t_ns >= self._window.after_ns:
                self.finish()
        self._before.append(entry)

    def finish(self) -> None:
        """End an open window now."""
        if self._open is not None:
            capture, self._open = self._open, None
            self._finished(capture)

    def _find_trigger(self, step: Step) -> str | None:
        requested, self._requested = self._requested, None
        began = step.flags & ~self._flags
        if requested is not None:
            return requested
        if began & BUS_FAULT:
            return "bus"
        if began & LOG_FAULT:
            return "log"
        return self._capture_name(self._mode, step.mode) or ("limit" if began & LIMITED else None)
