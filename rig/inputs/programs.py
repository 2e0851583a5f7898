"""Files that are programs, and run with the rights of whoever opens them: which ones may.

A configuration or a log never makes one run: its owner imported it, by hand, on this machine. What
was imported is known by its content (SHA-256), so that it may lie anywhere.
"""

import hashlib
from pathlib import Path

from rig.inputs.errors import InputError


def fingerprint(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        InputError: It cannot be read.
    """
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def admit(path: Path) -> None:
    """Let a file run from now on, for this user.

    Raises:
        InputError: It cannot be read, or the user's settings cannot be written.
    """
    found, listed = fingerprint(path), _list()
    if found in _admitted():
        return
    try:
        listed.parent.mkdir(parents=True, exist_ok=True)
        with listed.open("a", encoding="utf-8") as file:
            file.write(f"{found}  {path.name}\n")
    except OSError as error:
        raise InputError(f"{listed}: cannot be written ({error.strerror})") from error


def require_admitted(path: Path) -> None:
    """Refuse a file that this user never let run.

    Raises:
        InputError: It was not, or cannot be read.
    """
    if fingerprint(path) not in _admitted():
        raise InputError(
            f"{path}: a program that was not imported on this machine, expected `rig import "
            f"{path.name} --fmu` first, by someone who trusts it"
        )


def _admitted() -> set[str]:
    try:
        text = _list().read_text("utf-8")
    except FileNotFoundError:
        return set()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{_list()}: cannot be read ({error})") from error
    return {line.split(maxsplit=1)[0] for line in text.splitlines() if line.strip()}


def _list() -> Path:
    from typer import get_app_dir

    return Path(get_app_dir("rig")) / "imported_programs"
