"""Modes, causes and counts of a run in words, for the page, the reports and the terminal."""

import math
from collections.abc import Mapping
from typing import NamedTuple

from rig.bridge.mode_supervisor import Event
from rig.bridge.values import Mode
from rig.pages.number_formats import three_digits, with_unit

LoggedEvent = Mapping[str, object]
"""A line of a run's events: time, modes, cause with its quantity, value and limit (SI)."""


class Tone(NamedTuple):
    """How a mode is shown: by colour, sign and word, each of which suffices.

    Attributes:
        name: Class of its colour in the pages' styles.
        sign: A sign that is read without colour.
    """

    name: str
    sign: str


TONES: Mapping[Mode, Tone] = {
    Mode.INIT: Tone("idle", "…"),
    Mode.WAITING: Tone("wait", "…"),
    Mode.SETTLING: Tone("part", "◐"),
    Mode.READY: Tone("part", "◑"),
    Mode.RUNNING: Tone("good", "✓"),
    Mode.HOLD: Tone("part", "‖"),
    Mode.SAFE: Tone("bad", "✕"),
}

MEANINGS: Mapping[Mode, str] = {
    Mode.INIT: "The model is being loaded. Force output invalid.",
    Mode.WAITING: "The model has not started. Force output invalid.",
    Mode.SETTLING: "The estimate still depends on how it began. Force output invalid.",
    Mode.READY: "The estimate has settled and is not armed. Force output invalid.",
    Mode.RUNNING: "Force output valid.",
    Mode.HOLD: "Force output invalid until the cause has gone.",
    Mode.SAFE: "The model is stopped, not the bench. Force output invalid until acknowledged.",
}

_SENTENCES: Mapping[str, str] = {
    Event.TICKS_MISSING.value: "the loop stood still for",
    Event.STALE.value: "no valid measurement for",
    Event.TIMEOUT.value: "no valid measurement for",
    Event.OVERLOADED.value: "too many ticks missed:",
    Event.DIVERGED.value: "the model diverged",
    Event.UNSETTLED.value: "the estimate was disturbed",
    Event.DEVICE_FAULT.value: "a device reports a fault",
    Event.LOG_LOST.value: "the run can no longer be logged",
    Event.INTERLOCK_OPEN.value: "the interlock is open",
    Event.BEYOND_HOLD.value: "a limit was passed",
    Event.BEYOND_SAFE.value: "a limit was passed",
    Event.ACKNOWLEDGED.value: "acknowledged",
    Event.FRESH.value: "measurements arrive",
    Event.SETTLED.value: "the estimate has settled",
    Event.WITHHELD.value: "settled, and withheld until armed",
}

_QUANTITIES: Mapping[str, tuple[str, str]] = {
    "measured_height_m": ("measured height", "m"),
    "measured_rate_m_per_s": ("rate of the measured height", "m/s"),
    "height_m": ("model height", "m"),
    "innovation_m": ("height error (innovation)", "m"),
    "force_n": ("estimated force", "N"),
    "virtual_force_n": ("virtual force", "N"),
    "force_std_n": ("standard deviation of the force", "N"),
    "force_rate_n_per_s": ("rate of the force", "N/s"),
    "force_difference_n": ("difference of estimated force and load cell", "N"),
    "unchanged_s": ("time without a change", "s"),
    "age_s": ("age of the measurement", "s"),
    "gap_s": ("gap", "s"),
    "missed_share": ("share of missed ticks", "%"),
}
"""Quantities of causes and limits, with their units in SI."""


COUNT_WORDS: Mapping[str, str] = {
    "overruns": "ticks missed",
    "lost": "frames lost (by their counters)",
    "saturated": "frames sent with a value at the limit of its range",
    "stale": "ticks in HOLD",
    "limited": "ticks beyond a limit",
    "bus_faulty": "ticks with a fault of the bus",
    "left_out": "ticks without a further sensor",
    "device_faulty": "ticks with a device at fault",
    "refused": "frames refused",
    "wrong_crc": "refused: wrong CRC",
    "wrong_length": "refused: wrong length",
    "repeated": "refused: repeated",
    "out_of_sequence": "refused: out of sequence",
    "masquerade": "refused: CRC of another message",
    "implausible": "refused: beyond a limit",
    "second_sender": "refused: from another sender",
    "from_faulty_device": "refused: device at fault",
    "no_value": "refused: the sensor states no value",
    "untimed": "refused: sample time not known",
}
"""Counts of a run (`rig.bridge.counts.Counts`) in words, in the order in which they are shown."""


def name_quantity(key: str) -> tuple[str, str]:
    """Words and unit of a limited quantity; of a channel's the channel and no unit."""
    if key in _QUANTITIES:
        return _QUANTITIES[key]
    channel, _, value = key.rpartition(" ")
    words, unit = _QUANTITIES.get(value, (value.replace("_", " "), ""))
    return f"{channel.replace('_', ' ')} {words}".strip(), unit


def describe_cause(event: LoggedEvent, *, with_strut: bool = True) -> str:
    """Why a mode was entered, without a stop at its end; empty where the event has no cause."""
    cause = str(event.get("cause") or "")
    words = _SENTENCES.get(cause, cause.replace("_", " "))
    if "quantity" in event:
        name, unit = name_quantity(str(event["quantity"]))
        value, limit = (_amount(event.get(key), unit) for key in ("value", "limit"))
        if _is_within(event.get("value"), event.get("limit")):
            words = f"{name} was beyond {limit}"
        elif cause in _WITH_VALUE:
            words = f"{words} {value} (limit {limit})"
        else:
            words = f"{name} {value or 'not known'}" + (f" (limit {limit})" if limit else "")
    keys = ("strut", "device") if with_strut else ("device",)
    parts = [words, *(f"{key} {event[key]}" for key in keys if key in event)]
    return ", ".join(part for part in parts if part)


_WITH_VALUE = frozenset(
    it.value for it in (Event.TICKS_MISSING, Event.STALE, Event.TIMEOUT, Event.OVERLOADED)
)
"""Causes whose sentence ends with the value."""


def _is_within(value: object, limit: object) -> bool:
    """Whether a value has returned within its limit, which counts as passed for some time yet."""
    if not (isinstance(value, int | float) and isinstance(limit, int | float)):
        return False
    return abs(value) < abs(limit) and value * limit >= 0.0


def _amount(value: object, unit: str) -> str:
    """A value with three digits at most, lengths in mm; empty where there is no number."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return ""
    factor, unit = {"m": (1e3, "mm"), "%": (1e2, "%")}.get(unit, (1.0, unit))
    if unit == "s" and abs(value) < 1.0:
        factor, unit = 1e3, "ms"
    text = three_digits(factor * float(value))
    text = text.rstrip("0").rstrip(".") if "." in text else text
    return with_unit(text, unit)
