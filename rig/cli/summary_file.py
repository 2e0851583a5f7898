"""The file `summary.json` of a command's figures."""

import json
from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError

SummaryFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Folder for summary.json.")
]


def write_summary(folder: Path | None, summary: dict[str, object]) -> None:
    """Write `summary.json`, if a folder is given.

    Raises:
        InputError: The folder cannot be written, or holds a run or another summary.
    """
    if folder is None:
        return
    for name in ("run.yaml", "summary.json"):
        if (folder / name).exists():
            raise InputError(f"--out {folder}: holds {name}, expected a folder without one")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", "utf-8")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
