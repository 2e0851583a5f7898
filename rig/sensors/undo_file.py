"""File of the contents that devices had before a change, from which the change is undone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from can_dbc.errors import InputError
from can_dbc.yaml_file import load_yaml
from rig.sensors.canopen_set_up import (
    SETTABLE,
    CanOpenSettings,
    DeviceWriter,
    ObjectAccess,
    ObjectChange,
    configure_device,
)

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


def configure_with_undo(
    access: ObjectAccess, node_id: int, settings: CanOpenSettings, undo: Path
) -> Sequence[ObjectChange]:
    """Configure a device, and write its changes into a file; returns the changes.

    Args:
        access: Bus of the device.
        node_id: The device.
        settings: The settings.
        undo: New file; there is none after a call that changes nothing.

    Raises:
        InputError: The file cannot be written, or the device cannot do it.
    """
    writer = DeviceWriter(access)
    begin_undo(undo)
    try:
        configure_device(writer, node_id, settings)
    except InputError as error:
        changes = f"; {undo} holds the changes so far" if writer.changes else ""
        raise InputError(f"{error}; the device may still be pre-operational{changes}") from error
    finally:
        if writer.changes:
            write_undo(undo, writer.changes)
        else:
            undo.unlink(missing_ok=True)
    return writer.changes


def write_undo(path: Path, changes: Sequence[ObjectChange]) -> None:
    """Write the contents before changes, over what `begin_undo` made.

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
    """Create the file before any change, so that a file that cannot be written prevents it.

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


def read_undo(path: Path) -> list[ObjectChange]:
    """Changes from a file of `write_undo`.

    Raises:
        InputError: The file cannot be read, or is none of this kind.
    """
    entries = load_yaml(_File, path).changes
    return [ObjectChange(item.node_id, item.index, item.subindex, item.before) for item in entries]
