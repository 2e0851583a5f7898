"""The terminal: console, tables and JSON of the commands, and their exit codes."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Column, Table

from rig.files.json_text import json_text

OK, FAILED, WRONG_INPUT = 0, 1, 2
console = Console()

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file.")]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print the same as JSON, and nothing else.")]


def table(*heads: str, title: str | None = None) -> Table:
    """A table whose cells are folded, and never cut."""
    return Table(*(Column(head, overflow="fold") for head in heads), title=title)


def print_json(content: object) -> None:
    """Print as JSON; numbers that are not finite become null."""
    typer.echo(json_text(content), nl=False)
