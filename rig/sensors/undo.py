"""What devices held before they were set, in a file, so that it can be put back."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

from rig.inputs.errors import InputError
from rig.inputs.yaml_file import load_validated
from rig.sensors.setting import Changed

_SCHEMA = 1
_HEX = r"^([0-9a-f]{2}){1,8}$"


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: Annotated[int, Field(ge=1, le=127)]
    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    subindex: Annotated[int, Field(ge=0, le=255)]
    before: Annotated[str, Field(pattern=_HEX)]


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[Literal[1], Field(alias="schema")]
    changes: Annotated[tuple[_Entry, ...], Field(max_length=1000)]


def write_undo(path: Path, changes: Sequence[Changed]) -> None:
    """Write what was held before.

    Raises:
        InputError: The file exists, or cannot be written.
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
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise InputError(f"{path}: exists, expected a new file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def read_undo(path: Path) -> list[Changed]:
    """What was held before.

    Raises:
        InputError: The file cannot be read, or is none of this kind.
    """
    found = load_validated(_File, path)
    return [Changed(item.node_id, item.index, item.subindex, item.before) for item in found.changes]
