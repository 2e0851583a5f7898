"""A configuration proposed from a DBC: which signals look like what the bridge needs.

What is proposed is safe to start with: an observer that is slow and stable until it is tuned, a
signal that marks the estimate as invalid, and limits on what a height sensor can send.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from can_dbc.codec import si_step
from can_dbc.database import Database, Message, Signal
from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension, si_conversion
from rig.bridge.published_quantities import FORCE, STATUS_MESSAGE, VALID
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    TEMPERATURE,
    Quantity,
)
from rig.observers.kalman import KalmanObserver

_WORDS: dict[Quantity, tuple[str, ...]] = {
    HEIGHT: ("height", "hoehe", "stroke", "travel", "weg", "displ", "pos", "length", "lvdt"),
    APPLIED_FORCE: ("applied", "act", "excit", "input", "drive", "shaker", "erreg"),
    LOAD_CELL_FORCE: ("cell", "load", "meas", "ist", "sensor", "damper"),
    TEMPERATURE: ("temp", "damper", "oil", "oel"),
}
"""Parts of names by which a signal is preferred among those of the right unit."""

_STRUT = "strut"
"""Strut of the model that is proposed."""

_UNKNOWN_NOISE_M, _UNKNOWN_INTERVAL_NS = 1e-5, 10_000_000
"""Where the DBC does not state a step or a cycle."""

_ESTIMATE_WORDS = ("estim", "schaetz", "calc", "spring", "damper", "cmd", "set", "out", "soll")
_VALID_WORDS = ("valid", "gueltig", "qual", "ok")
_STATE_WORDS = ("state", "mode", "status", "zustand")
_LEAST_STATE_BITS = 3
"""A mode is a number from 0 to 6."""

_STALE_CYCLES = 3
"""Cycles after which a height is stale: two frames in a row may be lost."""

_LEAST_STALE_S = 0.01
_LARGEST_RATE_M_PER_S = 10.0
"""Of a height: several times what a damper is tested at."""

_FROZEN_S = 1.0
"""A reading that is the same for longer is taken for frozen: noise changes it in some samples."""

_FROZEN_FORCE = (
    "    # The same for the applied force, unless it is constant for longer while all is well.",
    f"    # - {{channel: {APPLIED_FORCE.key}, value: unchanged_s, high: {_FROZEN_S:g}, "
    "action: hold}",
)

_CELL_LIMIT = (
    "    # Against a wrong scale or mass: how far the estimate may be from the load cell, in N.",
    "    # - {value: force_difference_n, low: -100, high: 100, action: hold}",
)

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
        "model: reference          # an example: set the bench's own model file",
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
    keys = {line.strip().partition(":")[0] for line in lines}
    listened = {name for name, _ in used}
    free = [item for item in others if item.name not in listened]
    best = heights[0]
    step_m = si_step(best.message, best.signal.name, HEIGHT.dimension)
    lines += [
        *_propose_publish(free),
        *propose_observer(step_m, best.message.cycle_time_ns),
        *_supervision(best),
        *(_FROZEN_FORCE if APPLIED_FORCE.key in keys else ()),
        *(_CELL_LIMIT if LOAD_CELL_FORCE.key in keys else ()),
    ]
    return "\n".join(lines) + "\n"


def _propose_publish(free: Sequence[Message]) -> list[str]:
    """Lines of what could carry the estimate, its validity and the bridge's mode."""
    estimates = _candidates(free, Dimension.FORCE, _ESTIMATE_WORDS)
    if not estimates:
        return ["# publish: no other message has a signal with a unit of force"]
    lines = ["publish:", _line("  ", FORCE.key, estimates)]
    chosen = estimates[0].message
    valid = _find_integers([chosen], _VALID_WORDS, 1) or _find_integers(free, _VALID_WORDS, 1)
    if valid:
        lines.append(_line("  ", VALID.key, valid))
    else:
        lines += [
            "  # valid: no signal looks like it; without one a lost estimate looks like a force:",
            "  # unsafe: {publish_without_valid: true} accepts that",
        ]
    states = _find_integers(free, _STATE_WORDS, _LEAST_STATE_BITS)
    if any(item.name == STATUS_MESSAGE for item in free):
        lines.append(f"status: {STATUS_MESSAGE}")
    elif states:
        lines += ["status:", _line("  ", "state", states)]
    return lines


def propose_observer(step_m: float, interval_ns: int | None) -> list[str]:
    """Lines of an observer that is stable until it is tuned.

    Args:
        step_m: Step of the height; 0 where it is unknown.
        interval_ns: Time between two heights, if it is known.
    """
    noise_std_m = step_m / math.sqrt(12.0) or _UNKNOWN_NOISE_M
    observer = KalmanObserver.before_tuning(noise_std_m, interval_ns or _UNKNOWN_INTERVAL_NS)
    found = observer.filter
    return [
        "observers:",
        f"  {_STRUT}:   # slow and stable; rig tune finds a better one",
        f"    kind: {observer.kind}",
        f"    filter: {{bandwidth_hz: {found.bandwidth_hz:.4g}, "
        f"noise_std_m: {found.noise_std_m:.3e}}}",
    ]


def _supervision(height: _Candidate) -> list[str]:
    """Lines of ages and limits that follow from the height's message."""
    cycle_s = (height.message.cycle_time_ns or _UNKNOWN_INTERVAL_NS) * 1e-9
    stale_s = max(_LEAST_STALE_S, _STALE_CYCLES * cycle_s)
    rate = _LARGEST_RATE_M_PER_S
    return [
        "supervision:",
        f"  stale_after_s: {stale_s:g}",
        f"  safe_after_s: {max(0.5, 5.0 * stale_s):g}",
        "  limits:",
        f"    - {{value: measured_rate_m_per_s, low: {-rate:g}, high: {rate:g}, action: refuse}}",
        "    # A sensor that has frozen; remove the line for one that repeats itself at rest.",
        f"    - {{value: unchanged_s, high: {_FROZEN_S:g}, action: hold}}",
    ]


def _find_integers(
    messages: Iterable[Message], words: Sequence[str], bits: int
) -> list[_Candidate]:
    """Integer signals with one of some words in their names and no unit, the best name first."""
    found = [
        _Candidate(sum(word in signal.name.lower() for word in words), message, signal)
        for message in messages
        for signal in message.signals.values()
        if not signal.unit and not signal.is_float and signal.length_bits >= bits
    ]
    named = [item for item in found if item.score]
    return sorted(named, key=lambda item: (-item.score, item.signal.length_bits))


def _line(indent: str, key: str, found: Sequence[_Candidate]) -> str:
    best, *rest = found
    comment = f"   # {best.signal.unit or 'no unit'}"
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
