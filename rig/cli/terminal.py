"""The terminal: console, tables and JSON of the commands, and their exit codes."""

import json
import math
from pathlib import Path
from typing import Annotated, cast

import typer
from rich.console import Console
from rich.table import Column, Table

OK, FAILED, WRONG_INPUT = 0, 1, 2
console = Console()

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file.")]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print the same as JSON, and nothing else.")]


def table(*heads: str, title: str | None = None) -> Table:
    """A table whose cells are folded, and never cut."""
    return Table(*(Column(head, overflow="fold") for head in heads), title=title)


def print_json(content: object) -> None:
    """Print as JSON; numbers that are not finite become null."""
    typer.echo(json.dumps(finite(content), indent=2, ensure_ascii=False))


def finite(content: object) -> object:
    """Content with null for numbers that are not finite, which JSON does not have."""
    if isinstance(content, dict):
        items = cast("dict[object, object]", content).items()
        return {str(key): finite(item) for key, item in items}
    if isinstance(content, list | tuple):
        return [finite(item) for item in cast("list[object]", content)]
    return None if isinstance(content, float) and not math.isfinite(content) else content
