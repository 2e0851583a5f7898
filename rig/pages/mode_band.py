"""The modes of a run as a band over its time, and why each was entered."""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

from rig.bridge.values import Mode
from rig.log.file_names import EVENTS_FILE
from rig.pages.mode_words import TONES, LoggedEvent, describe_cause

_PIECES = 1000
"""Pieces of the band: the severest mode of each is drawn, so that none is too short to be seen."""

_MOST_LISTED = 200
"""Events in the table; a mode that flutters fills no page."""

_SEVERITY = (Mode.RUNNING, Mode.READY, Mode.SETTLING, Mode.INIT, Mode.WAITING, Mode.HOLD, Mode.SAFE)


class BandPiece(NamedTuple):
    """A stretch of the band: mode and tone, begin and length in percent of the run."""

    mode: str
    tone: str
    begin_percent: float
    percent: float


class ListedEvent(NamedTuple):
    """A line of the table: time in s of the run, what happened, and why."""

    t_s: float
    what: str
    why: str


def read_events(folder: Path) -> list[LoggedEvent]:
    """Events of a run, in their order; what cannot be read of its file is left out."""
    path = folder / EVENTS_FILE
    return parse_events(path.read_bytes()) if path.exists() else []


def parse_events(lines: bytes) -> list[LoggedEvent]:
    """Events in lines of their file; what cannot be read is left out."""
    events: list[LoggedEvent] = []
    for line in lines.decode("utf-8", errors="replace").splitlines():
        try:
            event = json.loads(line)
            if isinstance(event["t_s"], int | float):
                events.append(event)
        except (ValueError, KeyError, TypeError):  # cut off, as by a kill
            continue
    return events


def time_s(event: LoggedEvent) -> float:
    """Time of an event since the first tick, s."""
    return float(str(event["t_s"]))


def last_entry(events: Sequence[LoggedEvent], mode: Mode) -> LoggedEvent | None:
    """The event that entered a mode last; None without one."""
    return next((it for it in reversed(events) if it.get("to") == mode.name), None)


def make_band(events: Sequence[LoggedEvent], begin_s: float, end_s: float) -> list[BandPiece]:
    """The modes between two times, stretch by stretch."""
    changes = [
        (time_s(event), Mode[str(event["to"])])
        for event in events
        if event.get("to") in Mode.__members__
    ]
    if not changes or end_s <= begin_s:
        return []
    ends_s = [*(t_s for t_s, _ in changes[1:]), end_s]
    pieces = [-1] * _PIECES
    for (from_s, mode), to_s in zip(changes, ends_s, strict=True):
        first, last = (_piece_at(t_s, begin_s, end_s) for t_s in (from_s, to_s))
        for piece in range(first, max(first, last - (to_s < end_s)) + 1):
            pieces[piece] = max(pieces[piece], _SEVERITY.index(mode))
    share = 100.0 / _PIECES
    stretches: list[BandPiece] = []
    begin = 0
    for severity, group in itertools.groupby(pieces):
        length = len(list(group))
        mode = _SEVERITY[max(severity, 0)]
        tone = TONES[mode].name
        stretches.append(BandPiece(mode.name, tone, begin * share, length * share))
        begin += length
    return stretches


def list_events(
    events: Sequence[LoggedEvent], *, with_strut: bool = True
) -> tuple[list[ListedEvent], int]:
    """The first events of a run in words, and how many more there are."""
    listed = [_in_words(event, with_strut=with_strut) for event in events[:_MOST_LISTED]]
    return listed, max(0, len(events) - _MOST_LISTED)


def _piece_at(t_s: float, begin_s: float, end_s: float) -> int:
    share = (t_s - begin_s) / (end_s - begin_s)
    return min(max(int(share * _PIECES), 0), _PIECES - 1)


def _in_words(event: LoggedEvent, *, with_strut: bool) -> ListedEvent:
    t_s = time_s(event)
    if "request" in event:
        refused = ", refused" if event.get("refused") else ""
        return ListedEvent(t_s, f"{event['request']}{refused}", f"by {event.get('by')}")
    if "mark" in event:
        return ListedEvent(t_s, f"“{event['mark']}”", f"by {event.get('by')}")
    if "to" in event:
        return ListedEvent(
            t_s,
            f"{event.get('from')} → {event['to']}",
            _cause_in_words(event, with_strut=with_strut),
        )
    others = {key: value for key, value in event.items() if key not in ("t_s", "machine")}
    why = ", ".join(f"{key} {value}" for key, value in others.items())
    return ListedEvent(t_s, str(event.get("machine", "")).replace("_", " "), why)


def _cause_in_words(event: LoggedEvent, *, with_strut: bool) -> str:
    words, first = describe_cause(event, with_strut=with_strut), event.get("first_cause")
    if isinstance(first, dict):
        words += f"; at first: {describe_cause(cast('LoggedEvent', first), with_strut=with_strut)}"
    return words
