"""Results of a check as JUnit XML, for a CI server."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple
from xml.etree import ElementTree

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import refuse_existing

JUNIT = "--junit "

JUnitFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also write the result as JUnit XML, for a CI server."),
]


class Outcome(NamedTuple):
    """One line of a check: its name, its result, and whether that is a failure."""

    what: str
    text: str
    failed: bool


def write_junit(path: Path | None, suite: str, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes as JUnit XML, a test case each, if a file is given.

    Raises:
        InputError: The file exists, or cannot be written.
    """
    if path is None:
        return
    refuse_existing(path, option=JUNIT)
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
        raise InputError(f"{JUNIT}{path}: cannot be written: {error.strerror}") from error
