"""Folders to write into."""

import contextlib
import itertools
from collections.abc import Generator
from pathlib import Path

from can_dbc.errors import InputError

_CLAIM_FILE = "claim.tmp"
"""Stands in a folder from before the first file is written into it until that is done."""


@contextlib.contextmanager
def claim(folder: Path) -> Generator[None]:
    """Context in which this program, and no other, writes the first files into a folder.

    Of several that begin at once one does; what it wrote then refuses all that come later.

    Raises:
        InputError: The folder is not empty, another program is beginning in it, or it cannot be
            written.
    """
    refuse_full(folder)
    path = folder / _CLAIM_FILE
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.touch(exist_ok=False)
    except FileExistsError as error:
        raise InputError(
            f"{folder}: another program is beginning to write into it, expected a folder of its own"
        ) from error
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from error
    try:
        # Another one may have written and ended since the first look.
        refuse_full(folder, claimed_by=path)
        yield
    finally:
        path.unlink(missing_ok=True)


def refuse_full(folder: Path, claimed_by: Path | None = None) -> None:
    """Refuse a folder in which is more than a claim, so that nothing is overwritten.

    Raises:
        InputError: It is not empty, or no folder.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a new or an empty folder")
    if folder.exists() and any(path != claimed_by for path in folder.iterdir()):
        raise InputError(f"{folder}: is not empty, expected a new or an empty folder")


def free_folder(folder: Path) -> Path:
    """`folder` if it is new, else the same name with the first free number appended."""
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return next(path for path in itertools.chain([folder], numbered) if not path.exists())
