"""Which mode follows which: the table of the bridge's states."""

from dataclasses import dataclass
from enum import Enum, auto

from rig.core.types import Mode


class Event(Enum):
    """What a tick finds, the gravest one first."""

    STOP = auto()
    TIMEOUT = auto()
    STALE = auto()
    ACKNOWLEDGED = auto()
    FRESH = auto()


@dataclass(frozen=True)
class Supervision:
    """When a measurement is too old, and what the safe state publishes.

    Attributes:
        stale_after_ns: Age at which the integral is frozen and the estimate marked invalid.
        safe_after_ns: Age at which the safe state is entered.
        safe_holds_last: The safe state publishes the last valid force; otherwise zero.
    """

    stale_after_ns: int
    safe_after_ns: int
    safe_holds_last: bool


TRANSITIONS: dict[tuple[Mode, Event], Mode] = {
    (Mode.WAITING, Event.FRESH): Mode.RUNNING,
    (Mode.RUNNING, Event.STALE): Mode.HOLD,
    (Mode.RUNNING, Event.TIMEOUT): Mode.SAFE,
    (Mode.HOLD, Event.FRESH): Mode.RUNNING,
    (Mode.HOLD, Event.TIMEOUT): Mode.SAFE,
    (Mode.SAFE, Event.ACKNOWLEDGED): Mode.WAITING,
    (Mode.WAITING, Event.STOP): Mode.STOPPED,
    (Mode.RUNNING, Event.STOP): Mode.STOPPED,
    (Mode.HOLD, Event.STOP): Mode.STOPPED,
    (Mode.SAFE, Event.STOP): Mode.STOPPED,
}
"""Mode and event -> next mode; a pair that is not listed changes nothing."""


def next_mode(mode: Mode, event: Event) -> Mode:
    """Mode after an event."""
    return TRANSITIONS.get((mode, event), mode)


def age_event(supervision: Supervision, age_ns: int) -> Event:
    """What the age of the oldest measurement means."""
    if age_ns <= supervision.stale_after_ns:
        return Event.FRESH
    return Event.STALE if age_ns <= supervision.safe_after_ns else Event.TIMEOUT
