"""A configuration proposed from a DBC: which signals look like what the bridge needs."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from can_dbc.database import Database, Message, Signal
from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension, si_conversion
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    TEMPERATURE,
    Quantity,
)

_WORDS: dict[Quantity, tuple[str, ...]] = {
    HEIGHT: ("height", "hoehe", "stroke", "travel", "weg", "displ", "pos", "length", "lvdt"),
    APPLIED_FORCE: ("applied", "act", "excit", "input", "drive", "shaker", "erreg"),
    LOAD_CELL_FORCE: ("cell", "load", "meas", "ist", "sensor", "damper"),
    TEMPERATURE: ("temp", "damper", "oil", "oel"),
}
"""Parts of names by which a signal is preferred among those of the right unit."""

_ESTIMATE_WORDS = ("estim", "schaetz", "calc", "spring", "damper", "cmd", "set", "out", "soll")
_MOST_OTHERS = 4
"""Other candidates that are named in a comment."""


class _Candidate(NamedTuple):
    """A signal of the right unit; the more words fit, the better."""

    score: int
    message: Message
    signal: Signal

    @property
    def entry(self) -> str:
        return f"{{message: {self.message.name}, signal: {self.signal.name}}}"


def propose(database: Database) -> str:
    """YAML of a configuration for a bus whose DBC is known.

    Units decide what a signal may be, names which of them it is, and the node that sends the height
    which messages are the bench's; up to four other candidates stand in a comment. It is a
    proposal: whoever knows the bench reads it before it runs.

    Raises:
        InputError: No signal measures a length.
    """
    heights = _candidates(database.messages.values(), HEIGHT.dimension, _WORDS[HEIGHT])
    if not heights:
        raise InputError(
            f"{database.path}: no signal has a unit of length, expected the height of a strut "
            "(does the DBC give units?)"
        )
    bench = heights[0].message.sender
    messages = database.messages.values()
    received = [item for item in messages if item.sender == bench]
    # A DBC that names no nodes says nothing of who sends what.
    others = [item for item in messages if item.sender != bench] or list(messages)
    lines = [
        "model: reference          # the bench's own model file",
        f"dbc: {database.path.name}",
        "bus: {interface: socketcan, channel: can0, bitrate: 500000}",
        "signals:",
        _line("  ", HEIGHT.key, heights),
    ]
    used = {(heights[0].message.name, heights[0].signal.name)}
    for quantity in (APPLIED_FORCE, LOAD_CELL_FORCE, TEMPERATURE):
        found = _candidates(received, quantity.dimension, _WORDS[quantity])
        found = [c for c in found if (c.message.name, c.signal.name) not in used]
        # A force without a telling name may be either: only the reader knows.
        if found and (found[0].score > 0 or quantity is TEMPERATURE):
            lines.append(_line("  ", quantity.key, found))
            used.add((found[0].message.name, found[0].signal.name))
    listened = {name for name, _ in used}
    free = [item for item in others if item.name not in listened]
    estimates = _candidates(free, Dimension.FORCE, _ESTIMATE_WORDS)
    if estimates:
        lines += ["publish:", _line("  ", "force", estimates)]
    else:
        lines.append("# publish: no other message has a signal with a unit of force")
    return "\n".join(lines) + "\n"


def _line(indent: str, key: str, found: Sequence[_Candidate]) -> str:
    best, *rest = found
    comment = f"   # {best.signal.unit}"
    if rest:
        named = [f"{item.message.name}.{item.signal.name}" for item in rest[:_MOST_OTHERS]]
        comment += f"; or {', '.join(named)}" + (", ..." if len(rest) > _MOST_OTHERS else "")
    return f"{indent}{key}: {best.entry}{comment}"


def _candidates(
    messages: Iterable[Message], dimension: Dimension, words: Sequence[str]
) -> list[_Candidate]:
    """Signals with a unit of a dimension, the one whose name fits best first."""
    found: list[_Candidate] = []
    for message in messages:
        for signal in message.signals.values():
            if _measures(signal, dimension):
                name = f"{message.name} {signal.name}".lower()
                score = sum(word in name for word in words)
                score += sum(word in signal.name.lower() for word in words)
                found.append(_Candidate(score, message, signal))
    return sorted(found, key=lambda item: -item.score)


def _measures(signal: Signal, dimension: Dimension) -> bool:
    try:
        si_conversion(signal.unit, dimension)
    except DatabaseError:
        return False
    return True
