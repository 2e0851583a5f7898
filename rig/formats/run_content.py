"""All that a run holds, on its way into another format and back."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import pyarrow as pa

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.log.file_names import CHECKSUMS_FILE, FRAMES_FILE, STEPS_FILE
from rig.log.reader import RunFolder

_NOT_COPIED = (FRAMES_FILE, STEPS_FILE, CHECKSUMS_FILE, "reserve.tmp")
_LARGEST_FILE_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True)
class RunContent:
    """All that a run holds.

    Attributes:
        files: Content of its other files by name: `run.yaml`, model, DBC.
        frames: Every frame and its direction.
        steps: Every step, an Arrow table.
    """

    files: dict[str, bytes]
    frames: list[tuple[Frame, str]]
    steps: pa.Table


def channel_of(header: Mapping[str, object]) -> str:
    """Channel of the bus by the header of a run, for the lines of `frames.log`."""
    match header:
        case {"config": {"bus": {"channel": str(channel)}}} if channel and " " not in channel:
            return channel
        case _:
            return "can0"


def path_inside(name: str, source: Path) -> PurePosixPath:
    """Path of one of a run's files in its folder.

    Raises:
        InputError: The name leads out of it.
    """
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or not path.name:
        raise InputError(f"{source}: file {name!r}: expected a name inside the run's folder")
    return path


def read_content(run: RunFolder) -> RunContent:
    """All that a run holds, except its captures."""
    logs = {path.name for path in run.frame_files}
    files = {
        path.relative_to(run.folder).as_posix(): path.read_bytes()
        for path in sorted(run.folder.rglob("*"))
        if path.is_file()
        and path.name not in (*_NOT_COPIED, *logs)
        and not path.name.startswith("steps.")
        and path.relative_to(run.folder).parts[0] != "captures"
        and path.stat().st_size <= _LARGEST_FILE_BYTES
    }
    return RunContent(files, list(run.frames()), run.steps)
