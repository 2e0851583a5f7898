"""What the machine did to a run: lines of `events.jsonl`, and a section of `run.yaml`."""

import json
from collections.abc import Callable, Mapping

from rig.machine.machine_state import ClockOffset, MachineReader

_SMALLEST_MOVE_NS = 2_000_000
"""Move of a clock that counts."""

_MOST_EVENTS = 10_000
"""Lines of `events.jsonl`: cores that become hot may be slowed every second."""


class MachineEvents:
    """Looks for what the machine did since the last look.

    Args:
        reader: Reads the state of the machine.
        now_ns: Time of the run.
    """

    def __init__(self, reader: MachineReader, now_ns: Callable[[], int]) -> None:
        self._read, self._now_ns = reader.read, now_ns
        state = self._read()
        self._suspended, self._wall = state.suspended, state.wall
        self._begin = self._frequency = state.frequency
        self._events = self._steps = self._suspended_ns = self._stepped_ns = 0

    def look(self) -> list[str]:
        """Lines about what has changed."""
        state = self._read()
        lines: list[str] = []
        self._suspended, suspended_ns = _follow(self._suspended, state.suspended)
        if suspended_ns:
            self._suspended_ns += suspended_ns
            lines.append(self._line("suspended", {"duration_s": suspended_ns * 1e-9}))
        self._wall, step_ns = _follow(self._wall, state.wall)
        if step_ns:
            self._steps += 1
            self._stepped_ns += step_ns
            lines.append(self._line("clock_set", {"step_s": step_ns * 1e-9}))
        before, self._frequency = self._frequency, state.frequency
        if before != state.frequency:
            lines.append(self._line("frequency", {"before": before, "now": state.frequency}))
        left, self._events = max(0, _MOST_EVENTS - self._events), self._events + len(lines)
        return lines[:left]

    def summary(self) -> dict[str, object]:
        """The section of `run.yaml`: totals, and what limits the frequency where that is known."""
        totals: dict[str, object] = {
            "suspended_s": self._suspended_ns * 1e-9,
            "clock_steps": self._steps,
            "clock_stepped_s": self._stepped_ns * 1e-9,
        }
        if not self._begin and not self._frequency:
            return totals
        return {**totals, "frequency": {"begin": self._begin, "end": self._frequency}}

    def _line(self, what: str, content: Mapping[str, object]) -> str:
        return json.dumps({"t_s": self._now_ns() * 1e-9, "machine": what, **content}) + "\n"


def _follow(before: ClockOffset, now: ClockOffset) -> tuple[ClockOffset, int]:
    """What to compare the next offset with, and by how much this one has moved."""
    shift_ns = now.shift_ns(before)
    if abs(shift_ns) >= _SMALLEST_MOVE_NS:
        return now, shift_ns
    # Where the thread lost its core between two clocks the bounds are wide, and would hide a step.
    return min(before, now, key=lambda offset: offset.high_ns - offset.low_ns), 0
