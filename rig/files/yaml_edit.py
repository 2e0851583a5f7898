"""Changes of some keys in a YAML file that a person wrote: comments and order stay."""

import io
from collections.abc import Iterable, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Any, cast

import ruamel.yaml
import ruamel.yaml.util

from can_dbc.atomic_file import write_durably
from can_dbc.yaml_file import read_text

_WIDEST = 10_000
"""Columns after which a line would be folded: the file's own lines stay what they are."""

_YAML = cast("Any", ruamel.yaml).YAML  # untyped
_guess_indent = cast("Any", ruamel.yaml.util).load_yaml_guess_indent


def set_keys(path: Path, place: Sequence[str], values: Mapping[str, object]) -> None:
    """Set keys of the mapping at a place, which exists, in a file that was read before.

    Raises:
        FileError: The file cannot be read.
        KeyError: There is no such place.
        OSError: The file cannot be written.
    """
    write_durably(path, edit_keys(read_text(path), [(place, values)]))


def edit_keys(text: str, changes: Iterable[tuple[Sequence[str], Mapping[str, object]]]) -> str:
    """Text of a YAML file with keys of the mappings at some places set.

    Raises:
        KeyError: There is no such place.
    """
    _, _, dashes = _guess_indent(text)
    offset = 2 if dashes else 0
    editor = _YAML()
    editor.preserve_quotes = True
    editor.width = _WIDEST
    editor.indent(mapping=2, sequence=offset + 2, offset=offset)
    content = editor.load(text)
    for place, values in changes:
        entry = content
        for key in place:
            entry = entry[key]
        cast("MutableMapping[str, object]", entry).update(values)
    changed = io.StringIO()
    editor.dump(content, changed)
    return changed.getvalue()
