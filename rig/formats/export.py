"""A run in formats that other programs read, and back.

    candump   every frame, time to the us, as `canplayer` plays it
    csv       every step, one column a quantity with its unit in the name
    parquet   `steps.parquet` and `frames.parquet`, with the run's other files in their metadata
    mf4       ASAM MDF 4: the frames as a bus log with the DBC attached, their decoded signals, and
              every step (wants the package asammdf)

Parquet and MF4 hold everything: `import_run` makes the same run of them again, but for the time of
day of the files.
"""

import contextlib
import shutil
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, cast

import pyarrow as pa
import pyarrow.csv

from can_dbc.errors import InputError
from can_dbc.yaml_file import parse_mapping
from rig.files.folders import refuse_full
from rig.formats.content import channel_of, inside
from rig.formats.mf4 import from_mf4, to_mf4
from rig.formats.parquet import from_parquet, to_parquet
from rig.log.candump import format_frame
from rig.log.file_names import FRAMES_FILE, RUN_FILE, STEPS_FILE
from rig.log.reader import RunFolder, read_run

_pa = cast("Any", pa)
_csv = cast("Any", pyarrow.csv)


def export_run(
    folder: Path, kind: str, out: Path, read: Callable[[Path], RunFolder] = read_run
) -> list[Path]:
    """Write a run in another format.

    Args:
        folder: Folder of the run.
        kind: One of `FORMATS`.
        out: File to write; for Parquet a folder.
        read: Reads the run; what it adds to the steps is exported too.

    Returns:
        The files that were written.

    Raises:
        InputError: The run is damaged, the format is unknown or wants a package that is missing, or
            `out` exists or cannot be written.
    """
    if kind not in FORMATS:
        raise InputError(f"format {kind!r}: expected one of {', '.join(FORMATS)}")
    if out.exists():
        raise InputError(f"{out}: exists, expected a new file")
    found = read(folder)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with _all_or_nothing(out):
            return FORMATS[kind](found, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def _all_or_nothing(out: Path) -> Generator[None]:
    """Leave nothing under a name whose content is not whole."""
    try:
        yield
    except BaseException:
        if out.is_dir():
            shutil.rmtree(out, ignore_errors=True)
        else:
            out.unlink(missing_ok=True)
        raise


def import_run(source: Path, folder: Path) -> None:
    """Make the folder of a run again from what `export_run` wrote.

    Args:
        source: An MF4 file, or a folder with Parquet files.
        folder: Folder to write; absent or empty.

    Raises:
        InputError: The source is no such export, or the folder cannot be written.
    """
    refuse_full(folder)
    content = from_parquet(source) if source.is_dir() else from_mf4(source)
    header = parse_mapping(content.files[RUN_FILE].decode("utf-8"), f"{source}: {RUN_FILE}")
    epoch_ns, channel = header.get("epoch_ns"), channel_of(header)
    if not isinstance(epoch_ns, int):
        raise InputError(f"{source}: {RUN_FILE}: epoch_ns: {epoch_ns!r}: expected an integer")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in content.files.items():
            path = folder / inside(name, source)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        with (folder / FRAMES_FILE).open("w", encoding="ascii") as file:
            file.writelines(
                format_frame(frame, epoch_ns, channel, direction)
                for frame, direction in content.frames
            )
        with (
            _pa.OSFile(str(folder / STEPS_FILE), "wb") as sink,
            _pa.ipc.new_stream(sink, content.steps.schema) as stream,
        ):
            stream.write_table(content.steps)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _to_candump(found: RunFolder, out: Path) -> list[Path]:
    channel = channel_of(found.header)
    with out.open("w", encoding="ascii") as file:
        for frame, direction in found.frames():
            # candump's time is in us, and it says nothing of the direction.
            line = format_frame(frame, found.epoch_ns, channel, direction)
            stamp, rest = line.split(" ", 1)
            file.write(f"{stamp[:-4]}) {rest[:-2].rstrip()}\n")
    return [out]


def _to_csv(found: RunFolder, out: Path) -> list[Path]:
    steps = found.steps
    t_s = _pa.array(steps.column("t_ns").to_numpy() * 1e-9)
    _csv.write_csv(steps.add_column(0, "t_s", t_s), str(out))
    return [out]


FORMATS: dict[str, Callable[[RunFolder, Path], list[Path]]] = {
    "candump": _to_candump,
    "csv": _to_csv,
    "parquet": to_parquet,
    "mf4": to_mf4,
}
"""How each format is written."""
