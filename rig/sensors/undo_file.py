"""File of the contents that devices had before a change, from which the change is undone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field

from can_dbc.errors import InputError
from can_dbc.yaml_file import load_yaml
from rig.bus.canopen_network import CanOpenNetwork
from rig.sensors.canopen_set_up import (
    CanOpenSettings,
    DeviceWriter,
    ObjectChange,
    configure_device,
)


class _File(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[Literal[1], Field(alias="schema")]
    changes: Annotated[tuple[ObjectChange, ...], Field(max_length=1000)]


def configure_with_undo(
    network: CanOpenNetwork, node_id: int, settings: CanOpenSettings, undo: Path
) -> Sequence[ObjectChange]:
    """Configure a device, and write its changes into a file; returns the changes.

    The file is new; there is none after a call that changes nothing.

    Raises:
        InputError: The file cannot be written, or the device cannot do it.
    """
    writer = DeviceWriter(network, node_id)
    try:  # before any change, so that a file that cannot be written prevents it
        undo.open("x").close()
    except FileExistsError:
        raise InputError(
            f"--before {undo}: exists, expected a new file; if the device still has the changes "
            f"in it, undo them first with --restore {undo}"
        ) from None
    except OSError as error:
        raise InputError(f"--before {undo}: cannot be written: {error.strerror}") from error
    try:
        configure_device(writer, settings)
    except InputError as error:
        if not writer.changes:
            raise
        raise InputError(f"{error}; {undo} holds the changes so far") from error
    finally:
        if writer.changes:
            write_undo(undo, writer.changes)
        else:
            undo.unlink(missing_ok=True)
    return writer.changes


def write_undo(path: Path, changes: Sequence[ObjectChange]) -> None:
    """Write the contents before changes.

    Raises:
        InputError: The file cannot be written.
    """
    entries = [item.model_dump() for item in changes]
    text = yaml.safe_dump({"schema": 1, "changes": entries}, sort_keys=False)
    try:
        path.write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}: {text!r}") from error


def read_undo(path: Path) -> list[ObjectChange]:
    """Changes from a file of `write_undo`.

    Raises:
        InputError: The file cannot be read, or is none of this kind.
    """
    return list(load_yaml(_File, path).changes)
