"""The messages of a DBC's text that cantools can read, and why it cannot read the others.

Files from the field hold what the format does not allow: a comment on a signal without a name,
values of a signal that is not there, a standard id of 29 bits, signals that overlap. cantools
refuses such a file as a whole. Here only the messages that are wrong are left out, and what
merely names or describes (`VAL_`, `CM_`) if it cannot be read; what says how bytes are to be
understood never is.
"""

import logging
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import cantools.database
from cantools.database.can import Database as CantoolsDatabase
from cantools.database.can import Message as CantoolsMessage
from cantools.database.errors import Error as CantoolsError

from can_dbc.errors import DatabaseError

LENGTH_MAX_BYTES = 1785
"""Length of the longest J1939 transport message: a longer one cannot be meant."""

_LAYOUTS_MAX = 65_536  # a 16-bit multiplexer; cantools takes about 3 s for as many
_RANGES_SUM_MAX = 2_000_000
_REASON_MAX = 300
"""Longest reason of cantools' that is repeated."""

_MESSAGE_LENGTH = re.compile(r"\bBO_\s+\d+\s+\w+\s*:\s*(\d+)")
_SIGNAL_POSITION = re.compile(r":\s*(\d+)\s*\|\s*(\d+)\s*@")
_MULTIPLEXER_RANGES = re.compile(r"\bSG_MUL_VAL_\s+(\d+)\s+\w+\s+(\w+)([^;]*)")
_RANGE = re.compile(r"(\d+)\s*-\s*(\d+)")

_STATEMENT = re.compile(
    r"^(?=(?:BO_|CM_|VAL_|VAL_TABLE_|BA_|BA_DEF_|BA_DEF_DEF_|BA_DEF_REL_|BA_REL_|BA_DEF_DEF_REL_"
    r"|BA_SGTYPE_|SIG_VALTYPE_|SG_MUL_VAL_|SIG_GROUP_|SIGTYPE_VALTYPE_|BO_TX_BU_|BU_|BU_SG_REL_"
    r"|BU_BO_REL_|BU_EV_REL_|EV_|EV_DATA_|ENVVAR_DATA_|NS_|BS_|VERSION)\b)",
    re.MULTILINE,
)
"""Where a statement begins: its keyword, at the beginning of a line."""

_BYTES = ("SIG_VALTYPE_", "SG_MUL_VAL_")
"""Statements that say how bytes are to be understood."""

_ABOUT = re.compile(r"(?:VAL_|SIG_VALTYPE_|SG_MUL_VAL_|CM_\s+SG_)\s+(\d+)\s+(\w+)")
"""A statement about a signal of a message."""

_ATTRIBUTES = ("BA_", "BA_DEF_", "BA_DEF_DEF_")
_USED_ATTRIBUTE = re.compile(r'"(?:GenMsgCycleTime|VFrameFormat|E2E\w+)"')


# What cantools warns of, names and ids that are given twice, is among what is passed over.
logging.getLogger("cantools").addHandler(logging.NullHandler())


class ReadableStatements(NamedTuple):
    """Messages as cantools has them, and what was passed over: its name and the reason."""

    messages: list[CantoolsMessage]
    passed_over: dict[str, str]


def parse_statements(path: Path, text: str) -> ReadableStatements:
    """Read what can be read of a DBC's text.

    Raises:
        DatabaseError: A message or signal is larger than any frame, the statements that say how
            bytes are to be understood cannot be read, or there is no message at all.
    """
    _refuse_excess(path, text)
    try:
        return ReadableStatements(_load(text, is_strict=True), {})
    except (CantoolsError, ValueError, IndexError) as error:
        first = _reason(error)
    passed_over: dict[str, str] = {}
    statements = _STATEMENT.split(text)
    messages = [item for item in statements if _keyword(item) == "BO_"]
    readable = _readable_messages(messages, passed_over) if messages else []
    rest = [item for item in statements if _keyword(item) not in ("", "BO_")]
    others = _about_signals(rest, readable, passed_over)
    for kept in _thinned(others) if readable else ():
        try:
            parsed = _load("\n".join((*readable, *kept)), is_strict=False)
        except (CantoolsError, ValueError, IndexError):
            continue
        if len(kept) < len(others):
            passed_over["value names, comments and attributes"] = first
        return ReadableStatements(_without_overlaps(parsed, passed_over), passed_over)
    raise DatabaseError(f"{path}: not a usable DBC: {first}")


def _load(text: str, *, is_strict: bool) -> list[CantoolsMessage]:
    parsed = cantools.database.load_string(text, database_format="dbc", strict=is_strict)
    return cast("CantoolsDatabase", parsed).messages


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:_REASON_MAX]


def _keyword(statement: str) -> str:
    found = re.match(r"[A-Z_]+", statement)
    return found[0] if found else ""


def _readable_messages(statements: Sequence[str], passed_over: dict[str, str]) -> list[str]:
    """Statements of messages that can be read by themselves, by halves of those that cannot."""
    try:
        _load("\n".join(statements), is_strict=False)
    except (CantoolsError, ValueError, IndexError) as error:
        if len(statements) == 1:
            name = statements[0].partition(":")[0].split()[-1]
            passed_over[f"message {name}"] = _reason(error)
            return []
    else:
        return list(statements)
    half = len(statements) // 2
    first = _readable_messages(statements[:half], passed_over)
    return first + _readable_messages(statements[half:], passed_over)


def _about_signals(
    others: Iterable[str], messages: Iterable[str], passed_over: dict[str, str]
) -> list[str]:
    """Statements other than those about a signal that is in none of some messages."""
    signals = {
        (statement.split()[1], name)
        for statement in messages
        for name in re.findall(r"^\s*SG_\s+(\w+)", statement, re.MULTILINE)
    }
    kept: list[str] = []
    for statement in others:
        about = _ABOUT.match(statement)
        if about is None or about.groups() in signals:
            kept.append(statement)
        else:
            passed_over[about[0]] = "no such signal"
    return kept


def _thinned(others: Sequence[str]) -> list[list[str]]:
    """Statements beside the messages: all, without names and comments, those of the bytes."""
    plain = [item for item in others if _keyword(item) not in ("CM_", "VAL_", "VAL_TABLE_")]
    least = [
        item
        for item in plain
        if _keyword(item) in _BYTES
        or (_keyword(item) in _ATTRIBUTES and _USED_ATTRIBUTE.search(item))
    ]
    return [list(others), plain, least]


def _without_overlaps(
    messages: Iterable[CantoolsMessage], passed_over: dict[str, str]
) -> list[CantoolsMessage]:
    kept: list[CantoolsMessage] = []
    for message in messages:
        try:
            message.refresh(strict=True)
        except (CantoolsError, ValueError) as error:
            passed_over[f"message {message.name}"] = _reason(error)
        else:
            kept.append(message)
    return kept


def _refuse_excess(path: Path, text: str) -> None:
    """Refuse sizes for which cantools would build lists of any length."""
    limit = LENGTH_MAX_BYTES
    for match in _MESSAGE_LENGTH.finditer(text):
        if len(match[1]) > 6 or int(match[1]) > limit:
            raise DatabaseError(
                f"{path}: message of {match[1][:20]} bytes, expected at most {limit}"
            )
    for match in _SIGNAL_POSITION.finditer(text):
        if any(len(part) > 6 or int(part) > 8 * limit for part in match.groups()):
            raise DatabaseError(f"{path}: signal at {match[0][1:40]} does not fit in any message")
    _refuse_layouts(path, text)


def _refuse_layouts(path: Path, text: str) -> None:
    # cantools lists every value of every range, and builds a frame layout for every combination
    # of the values of nested multiplexers.
    largest: defaultdict[str, Counter[str]] = defaultdict(Counter)
    total = 0
    for message, multiplexer, ranges in _MULTIPLEXER_RANGES.findall(text):
        for first, last in _RANGE.findall(ranges):
            # Values may be the same for many signals: the largest bounds how many there are.
            digits = max(len(first), len(last))
            end = _RANGES_SUM_MAX + 1 if digits > 9 else int(last) + 1
            total += max(end - int(first[:9]), 0)
            largest[message][multiplexer] = max(largest[message][multiplexer], end)
    layouts = max((math.prod(ends.values()) for ends in largest.values()), default=0)
    if layouts > _LAYOUTS_MAX or total > _RANGES_SUM_MAX:
        raise DatabaseError(
            f"{path}: SG_MUL_VAL_ asks for {layouts} frame layouts, expected at most {_LAYOUTS_MAX}"
        )
