"""How a damper was built: notes in a file beside its record, which go where the record goes.

Of `0815.csv` the notes are in `0815.build.yaml`, of a run's folder in `build.yaml` inside:

    valve: digressive, 1.5 mm bleed
    shims: 8 x 0.15, 6 x 0.20
    oil: SAE 5
    pressure_bar: 16
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping, read_text

_MOST, _LONGEST = 50, 200
"""Notes of a damper, and characters of one: what fits on a sheet."""


def read_build_notes(record: Path) -> dict[str, str]:
    """Notes of a record by name, as text; none where there is no such file.

    Raises:
        InputError: The file is no mapping of names to texts and numbers.
    """
    path = record / "build.yaml" if record.is_dir() else record.with_suffix(".build.yaml")
    if not path.exists():
        return {}
    notes = parse_mapping(read_text(path), str(path))
    if len(notes) > _MOST:
        raise InputError(f"{path}: has {len(notes)} notes, expected {_MOST} at most")
    for name, value in notes.items():
        if not isinstance(value, str | int | float) or len(str(value)) > _LONGEST:
            raise InputError(
                f"{path}: {name}: {str(value)[:_LONGEST]!r}, expected a text of at most {_LONGEST} "
                "characters, or a number"
            )
    return {name: str(value) for name, value in notes.items()}


def differing_notes(notes: Sequence[Mapping[str, str]]) -> list[str]:
    """Notes that are not the same in all records, in words."""
    names = dict.fromkeys(name for own in notes for name in own)
    return [
        f"{name}: {', '.join(own.get(name, 'not stated') for own in notes)}"
        for name in names
        if len({own.get(name) for own in notes}) > 1
    ]
