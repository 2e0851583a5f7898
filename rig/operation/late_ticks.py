"""Why ticks were missed, told from the rows of a trace."""

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from rig.operation.trace import Row

_MANY_FAULTS = 50
"""Mapping this many pages takes some 20 to 50 µs, which a tick may not notice."""

_OWN_SHARE = 10.0
"""Times its usual duration up to which a part that nobody interrupted is the loop's own work: cold
caches make four of it."""

_MOSTLY = 0.5
"""Share of the excess from which an account explains it."""


class Cause(Enum):
    """Who took the time, as far as the kernel accounts for it."""

    HOST = "the host ran something else (steal)"
    OTHER_THREAD = "the loop could run, and another thread had the core"
    INTERPRETER = "the log's thread held the interpreter"
    DISK = "a page was read from a disk"
    FAULTS = "pages were mapped"
    KERNEL = "the kernel took the core"
    OWN = "the loop's own work"
    UNACCOUNTED = "nobody accounts for it: an interrupt, or a host that pauses the machine"


class LateTick(NamedTuple):
    """Ticks that were missed on end, and why.

    Attributes:
        t_ns: When the first of them was due.
        missed: How many.
        part: Where the time went: receive, compute, send, log, between (what the loop does before
            it waits) or wait.
        cause: Who took it.
        excess_ns: How much longer the part took than usual.
    """

    t_ns: int
    missed: int
    part: str
    cause: Cause
    excess_ns: int


def late_ticks(rows: Sequence[Row], period_ns: int) -> list[LateTick]:
    """Every gap in which ticks were missed.

    Args:
        rows: Rows of a trace, each late one behind the tick before it.
        period_ns: Time between two ticks.
    """
    pairs = list(pairwise(rows))
    on_time = [
        _parts(before, row)
        for before, row in pairs
        if row.deadline_ns - before.deadline_ns == period_ns
        and row.woke_ns - row.deadline_ns < period_ns
    ]
    if not on_time:
        return []
    usual = {part: median(parts[part] for parts in on_time) for part in on_time[0]}
    return [
        _explained(before, row, period_ns, usual)
        for before, row in pairs
        if row.woke_ns - row.deadline_ns >= period_ns
    ]


def _parts(before: Row, row: Row) -> dict[str, int]:
    """Durations in ns from one wake-up to the next; of the wait what is beyond the deadline."""
    return {
        "receive": before.received_ns - before.woke_ns,
        "compute": before.computed_ns - before.received_ns,
        "send": before.sent_ns - before.computed_ns,
        "log": before.logged_ns - before.sent_ns,
        "between": row.asleep_ns - before.logged_ns,
        "wait": row.woke_ns - max(row.asleep_ns, row.deadline_ns),
    }


def _explained(before: Row, row: Row, period_ns: int, usual: dict[str, float]) -> LateTick:
    parts = _parts(before, row)
    part = max(parts, key=lambda name: parts[name] - usual[name])
    excess_ns = round(parts[part] - usual[part])
    missed = (row.woke_ns - row.deadline_ns) // period_ns
    is_wait = part == "wait"
    own = not is_wait and parts[part] < _OWN_SHARE * usual[part]
    cause = _cause(before, row, excess_ns, is_wait=is_wait, own=own)
    return LateTick(row.deadline_ns, missed, part, cause, excess_ns)


def _cause(before: Row, row: Row, excess_ns: int, *, is_wait: bool, own: bool) -> Cause:
    """The first account that explains the excess; the surest come first."""
    switched = row.voluntary - before.voluntary
    accounts = (
        (row.steal_ns > before.steal_ns, Cause.HOST),
        (row.run_delay_ns - before.run_delay_ns > _MOSTLY * excess_ns, Cause.OTHER_THREAD),
        (row.major_faults > before.major_faults, Cause.DISK),
        # Once to wait for the deadline; a second time for the interpreter.
        (is_wait and row.log_busy and switched > 1, Cause.INTERPRETER),
        (row.involuntary > before.involuntary, Cause.KERNEL),
        (row.minor_faults - before.minor_faults > _MANY_FAULTS, Cause.FAULTS),
        (own, Cause.OWN),
    )
    return next((cause for holds, cause in accounts if holds), Cause.UNACCOUNTED)
