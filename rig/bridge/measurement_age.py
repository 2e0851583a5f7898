"""Whether a measurement is too old to rest an estimate on.

The bridge marks its estimate invalid by it and then enters the safe state
(`rig.bridge.mode_supervisor`), and starts no model from measurements that are too old. The two ages
are `supervision.stale_after_s` and `supervision.safe_after_s` of a configuration. A further sensor
of a strut is left out by its own interval (`rig.observers.joint_filter`).
"""

_MOST_CYCLES = 3
"""Cycles of its message after which a value is too old: two frames may be lost."""


def is_too_old(measured_ns: int, t_ns: int, limit_ns: int) -> bool:
    """Whether a measurement is older than a limit at a time."""
    return t_ns - measured_ns > limit_ns


def age_limit_ns(interval_ns: int, stale_after_ns: int) -> int:
    """Age from which a value that may come less often than the heights is too old."""
    return max(stale_after_ns, _MOST_CYCLES * interval_ns)
