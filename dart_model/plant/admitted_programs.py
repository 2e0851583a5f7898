"""Programs that may run with the rights of the user who opens their files.

No configuration and no log admits one: its user imported it, by hand, on this machine. An imported
program is identified by its content (SHA-256), in whatever folder it is.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from can_dbc.atomic_file import write_whole
from dart_model.errors import ModelError


def admit(content: bytes) -> bool:
    """Admit a program for this user; whether it was not admitted before.

    Raises:
        ModelError: The user's settings cannot be read or written.
    """
    fingerprint = _fingerprint(content)
    admitted = _read_list()
    if fingerprint in admitted:
        return False
    _write([*admitted, fingerprint])
    return True


def withdraw(content: bytes) -> None:
    """Withdraw the admission of a program.

    Raises:
        ModelError: The user's settings cannot be read or written.
    """
    fingerprint = _fingerprint(content)
    _write([item for item in _read_list() if item != fingerprint])


def require_admission(content: bytes, path: Path) -> None:
    """Refuse a program that this user never admitted.

    Raises:
        ModelError: It was not admitted, or the user's settings cannot be read.
    """
    if _fingerprint(content) not in _read_list():
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


def _read_list() -> list[str]:
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
