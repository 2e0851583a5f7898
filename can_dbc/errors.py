"""Errors of inputs: the base class of the whole project, and those of this package."""

import difflib
from collections.abc import Iterable

_MOST_NAMES = 12
"""Names that a line lists before it becomes unreadable."""


class InputError(ValueError):
    """An input is wrong; one line names file, key, value and what was expected.

    Every package derives its own error from this one, so that a caller catches all of them at
    once; the command prints the line and ends with exit code 2. It stands in the lowest package,
    because every other one raises it.
    """


def expected_name(name: str, known: Iterable[str]) -> str:
    """What an error says was expected in place of an unknown name: the nearest of the known ones.

    Where none is near, the first twelve of them are listed; there is at least one.
    """
    names = list(known)
    folded = {entry.casefold(): entry for entry in names}
    near = difflib.get_close_matches(name.casefold(), folded, n=3, cutoff=0.6)
    if near:
        return "did you mean " + " or ".join(folded[entry] for entry in near) + "?"
    if len(names) == 1:
        return f"expected {names[0]}"
    shown = ", ".join(names[:_MOST_NAMES]) + (", ..." if len(names) > _MOST_NAMES else "")
    return f"expected one of {shown}"


def missing_package(package: str, remedy: str) -> str:
    """What an error says of a package that is not installed; `remedy` is the command to type."""
    return f"the package {package} is not installed, expected `{remedy}` in the clone of rig"


class DatabaseError(InputError):
    """A DBC file, or a signal requested of it, is wrong."""


class FileError(InputError):
    """A text or YAML file cannot be read, or its content does not fit the schema."""
