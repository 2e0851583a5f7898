"""Lengths and checksums of a run's files, so that damage is seen when they are read.

`checksums.txt` has a line for each file of frames and steps that is finished: CRC-32 in hex, length
in bytes, name. A file without a line was cut off by a kill, and is checked by its form alone.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from can_dbc.yaml_file import read_text
from rig.files.hashes import compute_crc32
from rig.log.errors import DamageError, LogError
from rig.log.file_names import CHECKSUMS_FILE

_LINE = re.compile(r"([0-9a-f]{8}) ([0-9]{1,18}) ((?:frames|steps)[.0-9a-z]*)")


def checksum_line(name: str, size: int, crc32: int) -> str:
    """A line of `CHECKSUMS_FILE`."""
    return f"{crc32:08x} {size} {name}\n"


class Damage(NamedTuple):
    """What has changed in a file since it was written.

    Attributes:
        name: Name of the file.
        text: What has changed, as a phrase.
        is_readable: Whether what is left of the file is what was written.
    """

    name: str
    text: str
    is_readable: bool


def refuse_damage(folder: Path, damage: Iterable[Damage]) -> None:
    """Refuse a run whose frames or steps have changed since they were written.

    Raises:
        DamageError: They have; one line that names what is lost.
    """
    text = "; ".join(item.text for item in damage)
    if text:
        raise DamageError(f"{folder}: damaged: {text}: copy the run again from its origin")


def find_damage(folder: Path) -> tuple[Damage, ...]:
    """What has changed in a run's frames and steps since they were written.

    Raises:
        LogError: A file cannot be read, or a line is none of `CHECKSUMS_FILE`.
    """
    path = folder / CHECKSUMS_FILE
    return tuple(_damages(folder, read_text(path).splitlines(), path)) if path.exists() else ()


def _damages(folder: Path, lines: Iterable[str], path: Path) -> Iterator[Damage]:
    for number, line in enumerate(lines, start=1):
        expected_crc, size, name = _parse(line, f"{path}: line {number}")
        file = folder / name
        if not file.is_file():
            yield Damage(name, f"{name} is missing ({size} bytes)", is_readable=False)
            continue
        try:
            found = file.stat().st_size
            if found < size:
                yield Damage(name, f"{name} has {found} bytes of {size}", is_readable=True)
            elif found > size or compute_crc32(file) != expected_crc:
                text = f"{name} is not what was written: its checksum differs"
                yield Damage(name, text, is_readable=False)
        except OSError as error:
            raise LogError(f"{file}: cannot be read: {error.strerror}") from error


def _parse(line: str, where: str) -> tuple[int, int, str]:
    found = _LINE.fullmatch(line)
    if found is None:
        raise LogError(f"{where}: {line[:60]!r}: expected a checksum, a length and a file's name")
    return int(found[1], 16), int(found[2]), found[3]
