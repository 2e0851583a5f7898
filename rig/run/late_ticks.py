"""Causes of missed ticks, from the rows of a trace."""

from collections import Counter
from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from statistics import median
from typing import NamedTuple

from rig.run.trace import TraceRow

_MANY_FAULTS = 50
"""Mapping this many pages takes some 20 to 50 µs, which a tick may not notice."""

_OWN_SHARE = 10.0
"""Times its usual duration up to which a part without an interruption is the loop's own work: cold
caches make four of it."""

_MOSTLY = 0.5
"""Share of the excess from which an account explains it."""

_QUOTA_PERIOD_NS = 100_000_000
"""Period of the kernel's CPU bandwidth control, by default: a host's quota for a guest or container
that is used up stops it until the period ends."""

_QUOTA_PHASE_NS = 1_500_000
"""Within which the ends of such stops lie, in the period: its clock and ours drift apart."""

_LEAST_IN_PHASE = 4
"""Gaps in phase that are no coincidence: of twenty at random, as many are in one in a thousand."""


class LossCause(Enum):
    """Cause of lost time, as far as the kernel accounts for it."""

    QUOTA = "the host's CPU quota (gaps end in phase with its period of 100 ms)"
    HOST = (
        "the host ran something else (the run's steal time is at least half of what is otherwise "
        "not accounted for)"
    )
    OTHER_THREAD = "the loop was ready to run, but another thread had the core"
    INTERPRETER = "the log's thread held the interpreter"
    DISK = "a page was read from a disk"
    FAULTS = "pages were mapped"
    KERNEL = "the kernel took the core"
    OWN = "the loop's own work"
    UNACCOUNTED = "not accounted for (an interrupt, or a host that pauses the machine)"


class LateTick(NamedTuple):
    """Consecutive missed ticks, and their cause.

    Attributes:
        missed: Their number.
        part: Where the time went: receive, compute, send, log, between (what the loop does after
            the log, before it waits) or wait.
        excess_ns: How much longer the part took than usual.
        end_ns: When the loop resumed.
    """

    t_ns: int
    missed: int
    part: str
    cause: LossCause
    excess_ns: int
    end_ns: int


def by_cause(late: Sequence[LateTick]) -> list[tuple[LossCause, int, int]]:
    """Cause, number of gaps and number of missed ticks, the most frequent cause first."""
    gaps = Counter(item.cause for item in late)
    return [
        (cause, count, sum(item.missed for item in late if item.cause is cause))
        for cause, count in gaps.most_common()
    ]


def find_late_ticks(rows: Sequence[TraceRow], period_ns: int) -> list[LateTick]:
    """Every gap in which ticks were missed; each late row follows that of the tick before it."""
    pairs = list(pairwise(rows))
    on_time = [
        _parts(before, row)
        for before, row in pairs
        if row.deadline_ns - before.deadline_ns == period_ns
        and row.woke_ns - row.deadline_ns < period_ns
    ]
    usual = {part: median([parts[part] for parts in on_time] or [0]) for part in _PARTS}
    late = [
        _explain(before, row, period_ns, usual)
        for before, row in pairs
        if row.woke_ns - row.deadline_ns >= period_ns
    ]
    return _by_host(late, rows[-1].steal_ns - rows[0].steal_ns) if late else []


_PARTS = ("receive", "compute", "send", "log", "between", "wait")


def _parts(before: TraceRow, row: TraceRow) -> dict[str, int]:
    """Durations in ns from one wake-up to the next; of the wait what is beyond the deadline."""
    return {
        "receive": before.received_ns - before.woke_ns,
        "compute": before.computed_ns - before.received_ns,
        "send": before.sent_ns - before.computed_ns,
        "log": before.logged_ns - before.sent_ns,
        "between": row.asleep_ns - before.logged_ns,
        "wait": row.woke_ns - max(row.asleep_ns, row.deadline_ns),
    }


def _explain(before: TraceRow, row: TraceRow, period_ns: int, usual: dict[str, float]) -> LateTick:
    parts = _parts(before, row)
    part = max(parts, key=lambda name: parts[name] - usual[name])
    excess_ns = round(parts[part] - usual[part])
    missed = (row.woke_ns - row.deadline_ns) // period_ns
    is_wait = part == "wait"
    own = not is_wait and parts[part] < _OWN_SHARE * usual[part]
    cause = _cause(before, row, excess_ns, is_wait=is_wait, own=own)
    return LateTick(row.deadline_ns, missed, part, cause, excess_ns, row.woke_ns)


def _cause(
    before: TraceRow, row: TraceRow, excess_ns: int, *, is_wait: bool, own: bool
) -> LossCause:
    """The first account of the guest's kernel that explains the excess; the surest come first."""
    switched = row.voluntary - before.voluntary
    accounts = (
        (row.run_delay_ns - before.run_delay_ns > _MOSTLY * excess_ns, LossCause.OTHER_THREAD),
        (row.major_faults > before.major_faults, LossCause.DISK),
        # Once to wait for the deadline; a second time for the interpreter.
        (is_wait and row.log_busy and switched > 1, LossCause.INTERPRETER),
        (row.involuntary > before.involuntary, LossCause.KERNEL),
        (row.minor_faults - before.minor_faults > _MANY_FAULTS, LossCause.FAULTS),
        (own, LossCause.OWN),
    )
    return next((cause for holds, cause in accounts if holds), LossCause.UNACCOUNTED)


def _by_host(late: list[LateTick], stolen_ns: int) -> list[LateTick]:
    """The gaps, with the host as cause of unaccounted ones where its stolen time shows it.

    Stolen time is counted in steps of 10 ms, which no single gap is as long as.
    """
    unaccounted = [item for item in late if item.cause is LossCause.UNACCOUNTED]
    in_phase = _in_phase(unaccounted)
    rest_ns = sum(item.excess_ns for item in unaccounted if item not in in_phase)
    stolen_ns -= sum(item.excess_ns for item in in_phase)
    rest = LossCause.HOST if rest_ns and stolen_ns >= _MOSTLY * rest_ns else LossCause.UNACCOUNTED
    causes = {item: LossCause.QUOTA if item in in_phase else rest for item in unaccounted}
    return [item._replace(cause=causes.get(item, item.cause)) for item in late]


def _in_phase(late: Sequence[LateTick]) -> list[LateTick]:
    """Largest group of gaps that end at one phase of the quota's period, if it is significant."""
    groups = [
        [
            other
            for other in late
            if (other.end_ns - item.end_ns + _QUOTA_PHASE_NS) % _QUOTA_PERIOD_NS
            <= 2 * _QUOTA_PHASE_NS
        ]
        for item in late
    ]
    largest = max(groups, key=len) if groups else []
    return largest if len(largest) >= _LEAST_IN_PHASE else []
