"""The banner of a run: mode, cause and what to do, for a glance from across the bench."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

from rig.bridge.values import Mode
from rig.log.reader import ConfigEntry
from rig.pages.mode_band import last_entry, time_s
from rig.pages.mode_words import MEANINGS, TONES, LoggedEvent, describe_cause
from rig.pages.number_formats import capital

_ENDS = {
    "done": ("good", "✓", "ENDED"),
    "empty": ("part", "◐", "ENDED"),
    "safe": ("bad", "✕", "ENDED IN SAFE"),
    "waiting": ("bad", "✕", "ENDED WAITING"),
    "failed": ("bad", "✕", "FAILED"),
    "killed": ("part", "◐", "KILLED"),
    "reading": ("idle", "…", "READING"),
    "absent": ("idle", "…", "NO RUN"),
    "unreadable": ("bad", "✕", "UNREADABLE"),
}
"""States of a run that is not being recorded: tone, sign and word."""

_REQUESTS = {Mode.SAFE: "acknowledge", Mode.READY: "arm"}
"""Requests of the operator that lead on from a mode."""


class Banner(NamedTuple):
    """What the banner shows.

    Attributes:
        tone: Class of its colour.
        sign: Sign before the word.
        word: The mode, or how the run ended.
        text: Since when and why, and what that means.
        request: Request of the operator that leads on; empty without one.
    """

    tone: str
    sign: str
    word: str
    text: str
    request: str = ""


def make_banner(
    state: tuple[str, str],
    newest: tuple[Mode, float] | None,
    config: ConfigEntry,
    events: Sequence[LoggedEvent],
) -> Banner:
    """The banner of a run.

    Args:
        state: State of its folder, and a sentence about it.
        newest: Mode and time in s of its newest cycle; None before there is one.
        config: Its configuration.
        events: Its events.
    """
    folder, words = state
    if folder != "live":
        tone, sign, word = _ENDS.get(folder, ("idle", "…", folder.upper()))
        last = last_entry(events, Mode.SAFE) if folder == "safe" else None
        cause = describe_cause(last) if last else ""
        return Banner(tone, sign, word, f"{words} {capital(cause)}." if cause else words)
    if newest is None:
        return Banner("idle", "…", "STARTING", "The model is being loaded.")
    mode, now_s = newest
    tone, sign = TONES[mode]
    entry = last_entry(events, mode)
    if mode is Mode.WAITING:
        waited = "" if entry is None else f", {now_s - time_s(entry):.0f} s"
        text = f"for {name_awaited(config)}{waited}. {MEANINGS[mode]}"
        return Banner(tone, sign, mode.name, text)
    since = "" if entry is None else f"since {time_s(entry):.1f} s"
    with_strut = len(config.get("observers", {})) > 1
    cause = ""
    if entry is not None and mode is not Mode.RUNNING:
        cause = describe_cause(entry, with_strut=with_strut)
    text = ": ".join(part for part in (since, cause) if part)
    text = f"{text}. {MEANINGS[mode]}" if text else MEANINGS[mode]
    return Banner(tone, sign, mode.name, text, _REQUESTS.get(mode, ""))


def name_awaited(config: ConfigEntry) -> str:
    """The frames without which a model cannot start, and their bus."""
    heights = cast(
        "Mapping[str, Mapping[str, object]]", config.get("signals", {}).get("height", {})
    )
    names = dict.fromkeys(str(entry.get("message")) for entry in heights.values())
    bus = config.get("bus", {})
    return f"{' and '.join(names) or 'a height'} on {bus.get('channel', 'the bus')}"
