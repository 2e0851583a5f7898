"""A foreign table, or the channels of an MF4 file, becomes a CSV of measured data.

A folder of tables becomes as many; a wrong one does not stop the others.
"""

from collections.abc import Callable, Iterator, Sequence
from math import isnan
from pathlib import Path

import numpy as np

from can_dbc.atomic_file import replacing
from can_dbc.errors import InputError
from rig.dyno.quality import preflight
from rig.files.delimited_text import ROWS_AT_ONCE
from rig.files.folders import refuse_full
from rig.formats.import_report import ImportReport
from rig.formats.mapping import TableMapping, output_columns
from rig.formats.mf4_channels import read_mf4_channels
from rig.formats.mts import is_mts
from rig.formats.named_columns import READERS, read_named_columns
from rig.formats.text_table import Array, read_text_columns


def import_table(source: Path, mapping: TableMapping, out: Path) -> ImportReport:
    """Turn a foreign table, or the channels of a file, into the project's CSV.

    The text is read in pieces, so memory does not grow with the width of the table.

    Args:
        source: Text file, or a file of MF4, TDMS, MTS or a worksheet whose channels are named
            as the mapping's columns.
        mapping: What it means.
        out: CSV file to write; it must not exist.

    Raises:
        InputError: One line that names file, line or key, value and what was expected.
    """
    if out.exists():
        raise InputError(f"{out}: exists already, expected a new file")
    outputs = output_columns(mapping)
    suffix = source.suffix.lower()
    if is_mts(source) or suffix in READERS:
        read_columns = read_named_columns
    elif suffix in (".mf4", ".mdf", ".dat"):
        read_columns = read_mf4_channels
    else:
        read_columns = read_text_columns
    t_s, readings, assumptions = read_columns(source, mapping, outputs)
    _check_times(source, t_s)
    written: dict[str, Array] = {}
    for output, column in zip(outputs, readings, strict=True):
        value = output.factor * column + output.offset
        if output.subtracted_from:
            written[output.subtracted_from] = written[output.subtracted_from] - value
        else:
            written[output.name] = value
    names, values = ("t_s", *written), list(written.values())
    assumptions += [output.words for output in outputs]
    missing = np.isnan(values[0])
    if missing.any():
        assumptions.append(
            f"{np.count_nonzero(missing)} of {len(t_s)} rows have no height and are left out"
        )
        t_s, values = t_s[~missing], [value[~missing] for value in values]
        _check_times(source, t_s)
    _write_csv(out, names, [t_s, *values])
    assumptions += _assume_signs(mapping)
    assumptions += preflight(t_s, dict(zip(names[1:], values, strict=True)))
    duration_s = float(t_s[-1] - t_s[0])
    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    return ImportReport(out, len(t_s), duration_s, rate_hz, names, tuple(assumptions))


def import_folder(
    source: Path, find_mapping: Callable[[Path], TableMapping], out: Path
) -> Iterator[tuple[Path, ImportReport | InputError]]:
    """Turn every file of a folder into a CSV, in the order of their names.

    Args:
        source: The folder; folders within and hidden files are ignored.
        find_mapping: Gives the mapping of a file.
        out: Folder for the CSV files, which are called as their sources; new or empty.

    Yields:
        File, and the report of its import or the error by which it was refused.

    Raises:
        InputError: There is no file, two would have one name, or `out` is not empty.
    """
    files = sorted(
        path for path in source.iterdir() if path.is_file() and not path.name.startswith(".")
    )
    if not files:
        raise InputError(f"{source}: holds no file, expected tables")
    stems = [path.stem for path in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise InputError(f"{source}: two files are called {twice}, expected different names")
    refuse_full(out)
    for path in files:
        try:
            yield path, import_table(path, find_mapping(path), out / f"{path.stem}.csv")
        except InputError as error:
            yield path, error


def _assume_signs(mapping: TableMapping) -> list[str]:
    signs = ["height is taken as positive when the bodies move apart"]
    if mapping.applied_force is not None:
        signs.append("applied force is taken as positive upwards, without the weight")
    if mapping.strut_force is not None or mapping.strut_forces:
        signs.append("strut force is taken as positive when the strut pushes its bodies apart")
    if mapping.applied_force is None and not mapping.inputs:
        signs.append("there is no applied force: the motion is taken as prescribed")
    return signs


def _check_times(source: Path, t_s: Array) -> None:
    if len(t_s) < 2:
        raise InputError(f"{source}: {len(t_s)} rows of data, expected at least 2")
    steps = np.diff(t_s)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise InputError(
            f"{source}: time {t_s[row]:.9g} s in row {row} follows {t_s[row - 1]:.9g} s, expected "
            "times that increase; where stamps are too coarse give time.sampling_rate_hz"
        )


def _write_csv(out: Path, names: Sequence[str], columns: Sequence[Array]) -> None:
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(out) as temporary,
            temporary.open("w", encoding="ascii", newline="\n") as file,
        ):
            file.write(",".join(names) + "\n")
            for first in range(0, len(columns[0]), ROWS_AT_ONCE):
                part = np.column_stack([column[first : first + ROWS_AT_ONCE] for column in columns])
                file.writelines(_csv_line(row) for row in part.tolist())
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error


def _csv_line(row: list[float]) -> str:
    cells = [f"{row[0]:.9f}", *("" if isnan(value) else f"{value:.10g}" for value in row[1:])]
    return ",".join(cells) + "\n"
