"""Which mode follows which, and what is done beyond a limit: the tables of the bridge's states."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import NamedTuple

from rig.bridge.contract import Measurement, Mode, StrutOutput


class Event(IntEnum):
    """What a tick finds, the severest first."""

    BEYOND_SAFE = auto()
    TIMEOUT = auto()
    BEYOND_HOLD = auto()
    STALE = auto()
    ACKNOWLEDGED = auto()
    FRESH = auto()


class Action(IntEnum):
    """What is done beyond a limit, the severest last.

    WARN reports it in the status. REFUSE also drops the measurement, with all of its frame. HOLD
    also marks the estimate invalid as long as it lasts. SAFE enters the safe state. HOLD and SAFE
    for a measurement drop it too.
    """

    WARN = 1
    REFUSE = 2
    HOLD = 3
    SAFE = 4


class Watched(Enum):
    """What a limit is set on: the first three of the measurement, the others of the estimate."""

    MEASURED_HEIGHT_M = "measured_height_m"
    MEASURED_RATE_M_PER_S = "measured_rate_m_per_s"
    UNCHANGED_S = "unchanged_s"
    HEIGHT_M = "height_m"
    FORCE_N = "force_n"
    VIRTUAL_FORCE_N = "virtual_force_n"
    INNOVATION_M = "innovation_m"

    @property
    def is_measured(self) -> bool:
        """Whether it is of the measurement."""
        return self in _MEASURED


_MEASURED = (Watched.MEASURED_HEIGHT_M, Watched.MEASURED_RATE_M_PER_S, Watched.UNCHANGED_S)


@dataclass(frozen=True)
class Limit:
    """One row of the table of limits.

    Attributes:
        watched: What it is set on, of every strut.
        low: Smallest value within, in the unit of `watched`.
        high: Largest value within.
        action: What is done beyond.
    """

    watched: Watched
    low: float
    high: float
    action: Action


class Seen(NamedTuple):
    """What plausibility remembers of one strut's measurements.

    Attributes:
        height_m: Last measured height that was used.
        t_ns: Its time.
        since_ns: Since when the height is exactly that.
    """

    height_m: float
    t_ns: int
    since_ns: int


def judged(limits: Sequence[Limit], seen: Seen | None, measured: Measurement) -> tuple[Seen, int]:
    """What the limits say of a new measurement.

    Args:
        limits: Limits on measured quantities; others are passed over.
        seen: What is remembered of the strut; None before its first measurement.
        measured: The new measurement.

    Returns:
        What is to be remembered, and the severest action asked for, 0 if none.
    """
    height_m, t_ns = measured.height_m, measured.t_ns
    last = seen or Seen(height_m, t_ns, t_ns)
    age_s = (t_ns - last.t_ns) * 1e-9
    values = {
        Watched.MEASURED_HEIGHT_M: height_m,
        Watched.MEASURED_RATE_M_PER_S: (height_m - last.height_m) / age_s if age_s > 0.0 else 0.0,
        Watched.UNCHANGED_S: (t_ns - last.since_ns) * 1e-9 if height_m == last.height_m else 0.0,
    }
    action = max(
        (
            limit.action
            for limit in limits
            if limit.watched in values and not limit.low <= values[limit.watched] <= limit.high
        ),
        default=0,
    )
    if action >= Action.REFUSE:
        # What was used last stays the reference, but only for as long as the rate allows for.
        return last, action
    since_ns = last.since_ns if height_m == last.height_m else t_ns
    return Seen(height_m, t_ns, since_ns), action


def beyond(limits: Sequence[Limit], strut: StrutOutput) -> int:
    """The severest action that the limits ask for at an estimate, 0 if it is within all of them.

    Args:
        limits: Limits on estimated quantities; others are passed over.
        strut: What a tick publishes of one strut.
    """
    values = {
        Watched.HEIGHT_M: strut.height_m,
        Watched.FORCE_N: strut.force_n,
        Watched.VIRTUAL_FORCE_N: strut.virtual_force_n,
        Watched.INNOVATION_M: strut.innovation_m,
    }
    return max(
        (
            limit.action
            for limit in limits
            if limit.watched in values and not limit.low <= values[limit.watched] <= limit.high
        ),
        default=0,
    )


EVENTS_BEYOND = {Action.HOLD: Event.BEYOND_HOLD, Action.SAFE: Event.BEYOND_SAFE}
"""Action -> event; the others change no mode."""


@dataclass(frozen=True)
class Supervision:
    """When a measurement is too old, what the safe state publishes, and the limits.

    Attributes:
        stale_after_ns: Age at which the estimate is marked invalid.
        safe_after_ns: Age at which the safe state is entered.
        safe_holds_last: The safe state publishes the last valid force; otherwise zero.
        limits: What is done beyond which values.
    """

    stale_after_ns: int
    safe_after_ns: int
    safe_holds_last: bool
    limits: tuple[Limit, ...] = ()


TRANSITIONS: dict[tuple[Mode, Event], Mode] = {
    (Mode.WAITING, Event.FRESH): Mode.RUNNING,
    (Mode.RUNNING, Event.STALE): Mode.HOLD,
    (Mode.RUNNING, Event.TIMEOUT): Mode.SAFE,
    (Mode.RUNNING, Event.BEYOND_HOLD): Mode.HOLD,
    (Mode.RUNNING, Event.BEYOND_SAFE): Mode.SAFE,
    (Mode.HOLD, Event.BEYOND_SAFE): Mode.SAFE,
    (Mode.HOLD, Event.FRESH): Mode.RUNNING,
    (Mode.HOLD, Event.TIMEOUT): Mode.SAFE,
    (Mode.SAFE, Event.ACKNOWLEDGED): Mode.WAITING,
}
"""Mode and event -> next mode; a pair that is not listed changes nothing."""


def next_mode(mode: Mode, event: Event) -> Mode:
    """Mode after an event."""
    return TRANSITIONS.get((mode, event), mode)


def mode_at_age(supervision: Supervision, mode: Mode, age_ns: int) -> Mode:
    """Mode after a tick at which the oldest measurement is of some age."""
    if mode is Mode.RUNNING and age_ns <= supervision.stale_after_ns:
        return mode
    return next_mode(mode, age_event(supervision, age_ns))


def age_event(supervision: Supervision, age_ns: int) -> Event:
    """What the age of the oldest measurement means."""
    if age_ns <= supervision.stale_after_ns:
        return Event.FRESH
    return Event.STALE if age_ns <= supervision.safe_after_ns else Event.TIMEOUT
