"""Reads the columns of a file that names them itself: a worksheet, a TDMS file, one of MTS.

A column's name is the first cell of a worksheet's column; of a TDMS channel `group/name`, or the
name alone where only one group has it. Formulas, macros and objects are ignored.

MATLAB's files are left out: scipy's reader of them crashes the process on some damaged ones.
"""

import importlib
import io
import logging
import zipfile
from collections.abc import Callable, Mapping, Sequence
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from types import MappingProxyType
from typing import cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError, missing_package
from rig.files.delimited_text import MAX_ROWS
from rig.formats.mapping import ColumnName, OutputColumn, TableMapping
from rig.formats.mts import is_mts, read_mts, read_whole
from rig.formats.text_table import Array, Columns, in_seconds, sample_evenly

_MAX_BYTES = 1_000_000_000
"""Largest file, and largest content of a worksheet: what memory holds."""


def read_named_columns(
    source: Path, mapping: TableMapping, outputs: Sequence[OutputColumn]
) -> Columns:
    """Times and readings of a file of MTS, or of one whose suffix is in `READERS`.

    Raises:
        InputError: One line that names file, column and what was expected.
    """
    time = mapping.time
    if time is None:
        raise InputError(f"{source}: the mapping has no time, expected time: {{column: ...}}")
    if time.date_format is not None:
        raise InputError(
            f"{source}: time.date_format: applies to text tables, expected a column of numbers"
        )
    table = read_mts(source)[0] if is_mts(source) else _read_file(source)
    columns = [_find_column(source, table, output.key, output.column) for output in outputs]
    first = mapping.table.first_row
    if time.column is None:
        t_s, time_words = sample_evenly(time, len(columns[0]))
    else:
        t_s, time_words = in_seconds(time, _find_column(source, table, "time", time.column))
    for output, column in zip(outputs, columns, strict=True):
        if len(column) != len(t_s):
            raise InputError(
                f"{source}: {output.key}.column = {output.column!r} has {len(column)} values, "
                f"expected {len(t_s)}, as many as times"
            )
    last = None if mapping.table.rows is None else first + mapping.table.rows
    t_s, columns = t_s[first:last], [column[first:last] for column in columns]
    keys = [item.key for item in outputs[1:]]  # a height may be missing in a row
    for key, column in (("time", t_s), *zip(keys, columns[1:], strict=True)):
        wrong = np.flatnonzero(~np.isfinite(column))
        if len(wrong):
            raise InputError(
                f"{source}: row {first + int(wrong[0]) + 1} under the names: {key} is missing, "
                "expected a number (table.first_row begins later)"
            )
    names = f"{len(table)} columns: {', '.join(list(table)[:12])}"
    return t_s, columns, [names, time_words]


def _read_file(source: Path) -> Mapping[str, Array]:
    """Columns of a file by their names."""
    content = read_whole(source, _MAX_BYTES)
    try:
        return READERS[source.suffix.lower()](content)
    except ImportError as error:
        raise InputError(
            f"{source}: " + missing_package(str(error.name), "pip install -e '.[tables]'")
        ) from error
    except Exception as error:
        # Foreign readers raise anything on a file that is cut or malicious.
        kind = source.suffix.lstrip(".").upper()
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{source}: is no valid {kind} file, or is damaged ({reason}): export it again"
        ) from error


def _find_column(source: Path, table: Mapping[str, Array], key: str, name: ColumnName) -> Array:
    names = list(table)
    if isinstance(name, int):
        if not 1 <= name <= len(names):
            raise InputError(f"{source}: {key}.column = {name}: expected 1 to {len(names)}")
        return table[names[name - 1]]
    alike = [full for full in names if name in (full, full.rpartition("/")[2])]
    if len(alike) != 1:
        wrong = f"there {len(alike)} times" if alike else "not there"
        raise InputError(
            f"{source}: {key}.column = {name!r} is {wrong}, expected one of "
            f"{', '.join(names[:20]) or 'no column at all'}"
        )
    column = table[alike[0]]
    if not 2 <= len(column) <= MAX_ROWS:
        raise InputError(
            f"{source}: column {name!r} has {len(column)} values, expected 2 to {MAX_ROWS}"
        )
    return column


def _read_worksheet(content: bytes) -> Mapping[str, Array]:
    """The first worksheet, its first row the names; cells without a number are NaN."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(item.file_size for item in archive.infolist()) > _MAX_BYTES:
            raise ValueError(f"more than {_MAX_BYTES} bytes within")
    openpyxl = importlib.import_module("openpyxl")
    book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
    rows = book.worksheets[0].iter_rows(values_only=True)
    names = [str(cell).strip() if cell is not None else "" for cell in next(rows, ())]
    cells: list[list[float]] = []
    for row in rows:
        if all(cell is None for cell in row):
            continue
        cells.append([_cell_number(cell) for cell in row[: len(names)]])
        if len(cells) > MAX_ROWS:
            raise ValueError(f"more than {MAX_ROWS} rows")
    if not cells:
        raise ValueError("no rows of data under the names")
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two columns are called {twice}, expected different names")
    width = len(names)
    table = np.array([row + [np.nan] * (width - len(row)) for row in cells])
    return {
        name or f"column {number}": table[:, number - 1] for number, name in enumerate(names, 1)
    }


def _cell_number(cell: object) -> float:
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return float(cast("float", cell)) if is_number else float("nan")


def _read_tdms(content: bytes) -> Mapping[str, Array]:
    """Channels of numbers, as `group/name`."""
    nptdms = importlib.import_module("nptdms")
    warnings: SimpleQueue[logging.LogRecord] = SimpleQueue()
    logs = [logging.getLogger(name) for name in logging.root.manager.loggerDict if "nptdms" in name]
    # The reader only warns of a file that was cut; it is refused here, not read in part.
    for log in logs:
        log.handlers, log.propagate = [QueueHandler(warnings)], False
    file = nptdms.TdmsFile.read(io.BytesIO(content))
    if not warnings.empty():
        raise ValueError(warnings.get().getMessage())
    return {
        f"{group.name}/{channel.name}": numbers
        for group in file.groups()
        for channel in group.channels()
        if (numbers := _as_numbers(channel[:])) is not None
    }


def _as_numbers(values: object) -> Array | None:
    """The values as a vector of numbers; None if they are anything else."""
    array: NDArray[np.generic] = np.asarray(values)
    if array.dtype.kind not in "fiu" or array.size < 2 or array.size != max(array.shape):
        return None
    return np.array(array.ravel(), dtype=np.float64)


READERS: Mapping[str, Callable[[bytes], Mapping[str, Array]]] = MappingProxyType(
    {".xlsx": _read_worksheet, ".tdms": _read_tdms}
)
"""Reader of a file's content, by the file's suffix."""
