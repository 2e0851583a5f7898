"""Folders to write into."""

import itertools
from pathlib import Path

from can_dbc.errors import InputError


def refuse_full(folder: Path) -> None:
    """Refuse a folder that is not empty, so that nothing is overwritten.

    Raises:
        InputError: It is not empty, or no folder.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is not empty, expected a new or an empty folder")


def free_folder(folder: Path) -> Path:
    """`folder` if it is new, else the same name with the first free number appended."""
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain([folder], numbered) if not path.exists())
