"""Where commands print and write, and the exit codes they end with."""

import itertools
import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from rig.inputs.errors import InputError

OK, FAILED, WRONG_INPUT = 0, 1, 2
ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file.")]
console = Console()


def free_folder(name: str) -> Path:
    """`name`, or with the first number that makes it new."""
    numbered = (Path(f"{name}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain([Path(name)], numbered) if not path.exists())


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
