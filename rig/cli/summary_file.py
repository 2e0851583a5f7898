"""The file `summary.json` of a command's figures."""

import json
from pathlib import Path

from can_dbc.errors import InputError


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
