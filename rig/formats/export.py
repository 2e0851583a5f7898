"""A run in formats that other programs read, and back.

    candump   every frame, time to the us, as `canplayer` plays it
    csv       every step, one column a quantity with its unit in the name
    parquet   `steps.parquet` and `frames.parquet`, with the run's other files in their metadata
    mf4       ASAM MDF 4: the frames as a bus log with the DBC attached, their decoded signals, and
              every step (requires the package asammdf)

Parquet and MF4 hold everything: `import_run` restores the same run from them, except the files'
modification times.
"""

import contextlib
import shutil
from collections.abc import Callable, Generator
from pathlib import Path

import pyarrow as pa
import pyarrow.csv

from can_dbc.errors import InputError, expected_name
from can_dbc.yaml_file import parse_mapping
from rig.files.folders import refuse_full
from rig.formats.mf4 import read_mf4, write_mf4
from rig.formats.mts import is_mts
from rig.formats.parquet import read_parquet, write_parquet
from rig.formats.run_content import channel_of, path_inside
from rig.log.candump import format_frame
from rig.log.checksums import refuse_damage
from rig.log.file_names import FRAMES_FILE, RUN_FILE, STEPS_FILE
from rig.log.reader import RunFolder, read_run


def export_run(
    folder: Path, kind: str, out: Path, read: Callable[[Path], RunFolder] = read_run
) -> list[Path]:
    """Write a run in another format; returns the files that were written.

    Args:
        folder: Folder of the run.
        kind: One of `FORMATS`.
        out: File to write; for Parquet a folder.
        read: Reads the run; what it adds to the steps is exported too.

    Raises:
        InputError: The run is damaged, the format is unknown or requires a missing package, or
            `out` exists or cannot be written.
    """
    if kind not in FORMATS:
        raise InputError(f"format {kind!r}: {expected_name(kind, FORMATS)}")
    if out.exists():
        raise InputError(f"{out}: exists, expected a new file")
    run = read(folder)
    if run.damage and run.steps.num_rows == 0:  # nothing of it could be exported
        refuse_damage(folder, run.damage)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with _removed_on_failure(out):
            return FORMATS[kind](run, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def _removed_on_failure(out: Path) -> Generator[None]:
    """Remove the file or folder if the block fails, so that no partial export remains."""
    try:
        yield
    except BaseException:
        if out.is_dir():
            shutil.rmtree(out, ignore_errors=True)
        else:
            out.unlink(missing_ok=True)
        raise


def import_run(source: Path, folder: Path) -> None:
    """Restore a run, into an absent or empty folder, from what `export_run` wrote: MF4 or Parquet.

    Raises:
        InputError: The source is no such export, or the folder cannot be written.
    """
    refuse_full(folder)
    if is_mts(source):
        raise InputError(f"{source}: a file of MTS, expected --rebound positive or negative")
    if source.is_dir() and not any(source.glob("*.parquet")):
        raise InputError(
            f"{source}: is no run in Parquet, expected --mapping FILE or --rebound for tables"
        )
    content = read_parquet(source) if source.is_dir() else read_mf4(source)
    header = parse_mapping(content.files[RUN_FILE].decode("utf-8"), f"{source}: {RUN_FILE}")
    epoch_ns, channel = header.get("epoch_ns"), channel_of(header)
    if not isinstance(epoch_ns, int):
        raise InputError(f"{source}: {RUN_FILE}: epoch_ns: {epoch_ns!r}: expected an integer")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, data in content.files.items():
            path = folder / path_inside(name, source)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        with (folder / FRAMES_FILE).open("w", encoding="ascii") as file:
            file.writelines(
                format_frame(frame, epoch_ns, channel, direction)
                for frame, direction in content.frames
            )
        with (
            pa.OSFile(str(folder / STEPS_FILE), "wb") as sink,
            pa.ipc.new_stream(sink, content.steps.schema) as stream,
        ):
            stream.write_table(content.steps)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from error


def _write_candump(run: RunFolder, out: Path) -> list[Path]:
    channel = channel_of(run.header)
    with out.open("w", encoding="ascii") as file:
        for frame, direction in run.frames():
            # candump has times in us, and no direction.
            line = format_frame(frame, run.epoch_ns, channel, direction)
            stamp, rest = line.split(" ", 1)
            file.write(f"{stamp[:-4]}) {rest[:-2].rstrip()}\n")
    return [out]


def _write_csv(run: RunFolder, out: Path) -> list[Path]:
    steps = run.steps
    t_s = pa.array(steps.column("t_ns").to_numpy() * 1e-9)
    pyarrow.csv.write_csv(steps.add_column(0, "t_s", t_s), str(out))
    return [out]


FORMATS: dict[str, Callable[[RunFolder, Path], list[Path]]] = {
    "candump": _write_candump,
    "csv": _write_csv,
    "parquet": write_parquet,
    "mf4": write_mf4,
}
"""Writer of each format; it returns the files that it wrote."""
