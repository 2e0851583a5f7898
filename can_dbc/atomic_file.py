"""Files that are written whole or not at all, whatever interrupts the program."""

import contextlib
import os
import secrets
from collections.abc import Generator
from pathlib import Path


@contextlib.contextmanager
def replacing(path: Path) -> Generator[Path]:
    """A new name in the file's folder; what is written there replaces the file at the end.

    Where the block fails the file stays as it was, and nothing else is left. Only a program that
    is killed leaves the new name, which begins with a dot.

    Raises:
        OSError: The folder is missing, or the disk fails.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        yield temporary
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, text as UTF-8.

    Raises:
        OSError: The folder is missing, or the disk fails.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def write_durably(path: Path, content: str) -> None:
    """Write a result whole or not at all, and have it on the disk: UTF-8.

    Raises:
        OSError: The folder is missing, or the disk fails.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
