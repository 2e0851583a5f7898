"""The terminal: console, tables and JSON of the commands, their common options and exit codes."""

import math
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from can_dbc.errors import InputError
from rig.files.json_text import json_text

OK, FAILED, WRONG_INPUT = 0, 1, 2
EXIT_CODES = {
    OK: "The command succeeded.",
    FAILED: "A run ended in its safe state, without a valid height, or with a log that lacks "
    "ticks; a check, a replay, `rig characterise` with a master or tolerance band, or a run of a "
    "fleet failed; or a run's files are damaged.",
    WRONG_INPUT: "An input is wrong: one line on standard error names file, key, value and what "
    "was expected. (`rig import` of a folder names each refused file on standard output.)",
    130: "Interrupted by Ctrl-C. (Ctrl-C ends a run properly, with one of the codes above.)",
}
"""Exit codes of all commands, with their meanings."""

console = Console(markup=False)

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="Configuration, a YAML file.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")]
StrutOfRun = Annotated[
    str | None, typer.Option(metavar="NAME", help="Strut of the run, if there are several.")
]
ZeroFlag = Annotated[
    bool,
    typer.Option(
        "--zero/--no-zero",
        help="Remove a drift of the load cell's zero, where rests and cycles show one.",
    ),
]
LagGiven = Annotated[
    float | None,
    typer.Option(
        "--lag-ms",
        metavar="MS",
        min=-20.0,
        max=20.0,
        help="Time by which the force lags the height, which is removed; 0 if it does not. Without "
        "it, the lag is estimated from the steps.",
    ),
]
MovingMass = Annotated[
    float,
    typer.Option(
        "--moving-mass-kg",
        metavar="KG",
        min=0.0,
        max=1000.0,
        help="Mass between load cell and strut that moves with the strut; its inertia is removed.",
    ),
]
TemperatureWindow = Annotated[
    str | None,
    typer.Option(
        "--temperature-c",
        metavar="LOW:HIGH",
        help="Use only steps whose mean temperature is in this window, such as 40:60.",
    ),
]
Labels = Annotated[
    list[str] | None,
    typer.Option(
        "--label",
        metavar="NAME=TEXT",
        help="Row of the report's head, such as damper, serial, date, operator, bench; may be "
        "repeated. A usual row that is missing is a line to fill in on paper.",
    ),
]
PrintToo = Annotated[
    bool,
    typer.Option("--pdf", help="Also write the report as PDF; requires Chromium, Chrome or Edge."),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print the result as JSON only.")]
Interface = Annotated[str, typer.Option(metavar="NAME", help="python-can's name of the interface.")]
Channel = Annotated[str, typer.Option(metavar="NAME", help="Channel of the interface.")]
Bitrate = Annotated[int, typer.Option(metavar="BIT/S", min=1, help="Bit rate in bit/s.")]


def escape_controls(text: str) -> str:
    """Write out what would control the terminal in a text from outside."""
    return "".join(
        c if c.isprintable() or c == "\n" or unicodedata.category(c) == "Zs" else repr(c)[1:-1]
        for c in text
    )


def styled(text: str, style: str = "") -> Text:
    """A text from outside in a style; brackets in it are no markup."""
    return Text(escape_controls(text), style)


def table(*heads: str, title: str | None = None) -> Table:
    """A table whose cells are folded, and never cut."""
    columns = (Column(styled(head), overflow="fold") for head in heads)
    return Table(*columns, title=None if title is None else styled(title))


def print_table(
    heads: Sequence[str], rows: Iterable[Sequence[str | Text]], title: str | None = None
) -> None:
    """Print a table."""
    shown = table(*heads, title=title)
    for row in rows:
        shown.add_row(*(styled(cell) if isinstance(cell, str) else cell for cell in row))
    console.print(shown)


def print_text(text: str, style: str = "") -> None:
    """Print a text in which brackets are no markup."""
    console.print(styled(text, style))


def print_json(content: object) -> None:
    """Print as JSON; numbers that are not finite become null."""
    typer.echo(json_text(content), nl=False)


def parse_window(text: str | None, option: str) -> tuple[float, float] | None:
    """Two numbers that increase, such as 40:60.

    Raises:
        InputError: The text is none.
    """
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        window = float(low), float(high)
    except ValueError:
        window = math.nan, math.nan
    if not window[0] < window[1]:
        raise InputError(f"{option} {text}: expected LOW:HIGH, such as 40:60")
    return window


def refuse_existing(*paths: Path | None, option: str = "") -> None:
    """Refuse to overwrite a file; `option` stands before its path in the error.

    Raises:
        InputError: One of the files exists.
    """
    for path in paths:
        if path is not None and path.exists():
            raise InputError(f"{option}{path}: exists, expected a new file")
