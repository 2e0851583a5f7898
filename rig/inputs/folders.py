"""Folders that are written into."""

from pathlib import Path

from rig.inputs.errors import InputError


def refuse_full(folder: Path) -> None:
    """Refuse a folder that holds anything: nothing that somebody has is overwritten.

    Raises:
        InputError: It does, or is no folder.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: is not empty, expected a new or an empty folder")
