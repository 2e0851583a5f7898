"""What devices held before they were set, in a file, so that it can be put back."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from can_dbc.errors import InputError
from can_dbc.yaml_file import load_yaml
from rig.sensors.set_up import SETTABLE, Changed

_SCHEMA = 1
_HEX = r"^([0-9a-f]{2}){1,8}$"


def _settable(index: int) -> int:
    if index not in SETTABLE:
        raise ValueError("expected an object that `rig sensor set` changes")
    return index


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: Annotated[int, Field(ge=1, le=127)]
    index: Annotated[int, AfterValidator(_settable)]
    subindex: Annotated[int, Field(ge=0, le=255)]
    before: Annotated[str, Field(pattern=_HEX)]


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[Literal[1], Field(alias="schema")]
    changes: Annotated[tuple[_Entry, ...], Field(max_length=1000)]


def write_undo(path: Path, changes: Sequence[Changed]) -> None:
    """Write what was held before, over what was begun.

    Raises:
        InputError: The file cannot be written.
    """
    entries = [
        {
            "node_id": item.node_id,
            "index": item.index,
            "subindex": item.subindex,
            "before": item.before,
        }
        for item in changes
    ]
    text = yaml.safe_dump({"schema": _SCHEMA, "changes": entries}, sort_keys=False)
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}: {text!r}") from error


def begin_undo(path: Path) -> None:
    """Make the file before anything is changed, to know that it can be written.

    Raises:
        InputError: The file exists, or cannot be written.
    """
    try:
        path.open("x").close()
    except FileExistsError:
        raise InputError(
            f"--before {path}: exists, expected a new file (or --restore it first)"
        ) from None
    except OSError as error:
        raise InputError(f"--before {path}: cannot be written: {error.strerror}") from error


def read_undo(path: Path) -> list[Changed]:
    """What was held before.

    Raises:
        InputError: The file cannot be read, or is none of this kind.
    """
    found = load_yaml(_File, path)
    return [Changed(item.node_id, item.index, item.subindex, item.before) for item in found.changes]
