"""Results of a check as JUnit XML, for a CI server."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple
from xml.etree import ElementTree

import typer

from can_dbc.errors import InputError

JUnitFile = Annotated[
    Path | None,
    typer.Option("--junit", metavar="FILE", help="Write it as JUnit XML too, for a CI server."),
]


class Outcome(NamedTuple):
    """One line of a check.

    Attributes:
        what: Name of the check.
        text: Its result.
        failed: Whether that is a failure.
    """

    what: str
    text: str
    failed: bool


def refuse_existing(path: Path) -> None:
    """Refuse to overwrite a file.

    Raises:
        InputError: It exists.
    """
    if path.exists():
        raise InputError(f"--junit {path}: exists, expected a new file")


def write_junit(path: Path, suite: str, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes as JUnit XML, a test case each.

    Raises:
        InputError: The file exists, or cannot be written.
    """
    refuse_existing(path)
    failures = sum(outcome.failed for outcome in outcomes)
    root = ElementTree.Element(
        "testsuite", name=suite, tests=str(len(outcomes)), failures=str(failures), errors="0"
    )
    for outcome in outcomes:
        case = ElementTree.SubElement(root, "testcase", classname=suite, name=outcome.what)
        kind = "failure" if outcome.failed else "system-out"
        ElementTree.SubElement(case, kind).text = outcome.text
    try:
        ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)
    except OSError as error:
        raise InputError(f"--junit {path}: cannot be written: {error.strerror}") from error
