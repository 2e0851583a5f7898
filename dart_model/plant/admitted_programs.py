"""Files that are programs, and run with the rights of whoever opens them: which ones may.

A configuration or a log never makes one run: its owner imported it, by hand, on this machine. What
was imported is known by its content (SHA-256), so that it may lie anywhere.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from can_dbc.atomic_file import write_whole
from dart_model.errors import ModelError


def admit(content: bytes) -> bool:
    """Let a program run from now on, for this user.

    Returns:
        Whether it could not before.

    Raises:
        ModelError: The user's settings cannot be read or written.
    """
    found = _fingerprint(content)
    admitted = _admitted()
    if found in admitted:
        return False
    _write([*admitted, found])
    return True


def withdraw(content: bytes) -> None:
    """Let a program run no more.

    Raises:
        ModelError: The user's settings cannot be read or written.
    """
    found = _fingerprint(content)
    _write([item for item in _admitted() if item != found])


def require_admission(content: bytes, path: Path) -> None:
    """Refuse a program that this user never let run.

    Args:
        content: The program.
        path: What to call it.

    Raises:
        ModelError: It was not, or the user's settings cannot be read.
    """
    if _fingerprint(content) not in _admitted():
        raise ModelError(
            f"{path}: a program that was not imported on this machine, expected `rig import "
            f"{path.name} --fmu` first, by someone who trusts it"
        )


def _fingerprint(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _write(fingerprints: Sequence[str]) -> None:
    path = _list()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, "".join(f"{item}\n" for item in fingerprints))
    except OSError as error:
        raise ModelError(f"{path}: cannot be written ({error.strerror})") from error


def _admitted() -> list[str]:
    try:
        text = _list().read_text("utf-8")
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise ModelError(f"{_list()}: cannot be read ({error})") from error
    return text.split()


def _list() -> Path:
    from typer import get_app_dir

    return Path(get_app_dir("rig")) / "imported_programs"
