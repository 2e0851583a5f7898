"""Who tested what, where and when: the rows at the head of a report.

A row that is not given is a line to fill in by hand on paper; on a screen it is left out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from can_dbc.errors import InputError

FIELDS = ("damper", "serial", "date", "operator", "bench")
_TITLES = {"serial": "Serial number"}
_LONGEST = 200
"""Characters of a label: more do not fit on a line."""


class IdentityRow(NamedTuple):
    """A row of a report's head, such as “Operator” and a name; the text may be empty."""

    title: str
    text: str


def identity_rows(labels: Mapping[str, str]) -> tuple[IdentityRow, ...]:
    """Rows of the usual fields, then of every other label."""
    names = dict.fromkeys((*FIELDS, *labels))
    return tuple(IdentityRow(_title(name), labels.get(name, "")) for name in names)


def _title(name: str) -> str:
    words = name.replace("_", " ")
    return _TITLES.get(name, words[:1].upper() + words[1:])


def parse_labels(texts: Sequence[str]) -> dict[str, str]:
    """Labels from texts such as `operator=M. Berg`.

    Raises:
        InputError: A text has no name or no value, a name twice, or is too long.
    """
    labels: dict[str, str] = {}
    for given in texts:
        name, sign, text = (part.strip() for part in given.partition("="))
        if not (name and sign and text) or len(given) > _LONGEST:
            raise InputError(
                f"--label {given[:_LONGEST]!r}: expected NAME=TEXT of at most {_LONGEST} "
                "characters, such as operator='M. Berg'"
            )
        if name in labels:
            raise InputError(f"--label {given!r}: {name} is given twice, expected it once")
        labels[name] = text
    return labels
