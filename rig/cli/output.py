"""Where commands print and write, and the exit codes they end with."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple
from xml.etree import ElementTree

import typer
from rich.console import Console
from rich.table import Column, Table

from can_dbc.errors import InputError
from rig.files.json_text import json_text

OK, FAILED, WRONG_INPUT = 0, 1, 2
ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file.")]
console = Console()

JsonFlag = Annotated[bool, typer.Option("--json", help="Print the same as JSON, and nothing else.")]
JUnitFile = Annotated[
    Path | None,
    typer.Option("--junit", metavar="FILE", help="Write it as JUnit XML too, for a CI server."),
]


class Outcome(NamedTuple):
    """One line of a check, for a CI server.

    Attributes:
        what: What was checked.
        text: What was found.
        failed: Whether that is a failure.
    """

    what: str
    text: str
    failed: bool


def table(*heads: str, title: str | None = None) -> Table:
    """A table whose cells are folded, and never cut."""
    return Table(*(Column(head, overflow="fold") for head in heads), title=title)


def print_json(content: object) -> None:
    """Print as JSON; numbers that are not finite become null."""
    typer.echo(json_text(content), nl=False)


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


def write_summary(folder: Path, summary: dict[str, object]) -> None:
    """Write `summary.json`.

    Raises:
        InputError: The folder cannot be written, or holds a run or another summary.
    """
    for name in ("run.yaml", "summary.json"):
        if (folder / name).exists():
            raise InputError(f"--out {folder}: holds {name}, expected a folder without one")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
