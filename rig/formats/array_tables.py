"""Reads the columns of a table that names them itself: a worksheet, a TDMS file, one of MTS.

Columns are called by their names: a worksheet's by its first row, a TDMS channel's as `group/name`
or by its name alone where that is the only one. Formulas, macros and objects are not looked at.

MATLAB's files are left out: scipy's reader of them crashes the process on some damaged ones.
"""

import importlib
import io
import logging
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.units import Dimension
from rig.formats.mapping import Mapping as TableMapping
from rig.formats.mapping import Output, unit_conversion
from rig.formats.mts import is_mts, mts_columns
from rig.formats.text_table import Array, Columns

_MAX_BYTES = 1_000_000_000
"""Largest file, and largest content of a worksheet: what memory holds."""

_MAX_SAMPLES = 5_000_000
"""Most rows, as of a text."""


def array_columns(source: Path, mapping: TableMapping, outputs: Sequence[Output]) -> Columns:
    """Times and readings of a table that is no text.

    Args:
        source: File whose suffix is one of `READERS`.
        mapping: What its columns mean.
        outputs: The columns of the CSV.

    Raises:
        InputError: One line that names file, column and what was expected.
    """
    time = mapping.time
    if time is None:
        raise InputError(f"{source}: the mapping has no time, expected time: {{column: ...}}")
    if time.date_format is not None:
        raise InputError(f"{source}: time.date_format: is for texts, expected a column of numbers")
    table = mts_columns(source)[0] if is_mts(source) else _read(source)
    columns = [_column(source, table, output.key, output.place) for output in outputs]
    said = [f"{len(table)} columns: {', '.join(list(table)[:12])}"]
    first, count = mapping.table.first_row, len(columns[0])
    if time.sampling_rate_hz is not None:
        t_s = np.arange(count) / time.sampling_rate_hz
        said.append(f"t_s from {time.sampling_rate_hz:.9g} rows a second, evenly, beginning at 0")
    else:
        unit = unit_conversion(time.unit or "", Dimension.TIME, "time")
        t_s = unit.factor * _column(source, table, "time", time.column or "")
        said.append(f"t_s = {unit.factor:.9g} * column {time.column!r} (read in {time.unit})")
    for output, column in zip(outputs, columns, strict=True):
        if len(column) != len(t_s):
            raise InputError(
                f"{source}: {output.key}.column = {output.place!r} has {len(column)} values, "
                f"expected {len(t_s)} as the time"
            )
    last = None if mapping.table.rows is None else first + mapping.table.rows
    taken = slice(first, last)
    t_s, columns = t_s[taken], [column[taken] for column in columns]
    keys = [item.key for item in outputs[1:]]  # a height may be missing in a row
    for key, column in (("time", t_s), *zip(keys, columns[1:], strict=True)):
        wrong = np.flatnonzero(~np.isfinite(column))
        if len(wrong):
            raise InputError(
                f"{source}: {key}: expected numbers in every row, found none in row "
                f"{first + int(wrong[0]) + 1} under the names (table.first_row begins later)"
            )
    return t_s, columns, said


def _read(source: Path) -> Mapping[str, Array]:
    """Columns of a file by their names."""
    try:
        if source.stat().st_size > _MAX_BYTES:
            raise InputError(f"{source}: expected at most {_MAX_BYTES} bytes")
        content = source.read_bytes()
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from error
    read = READERS[source.suffix.lower()]
    try:
        return read(content)
    except ImportError as error:
        raise InputError(
            f"{source}: wants the package {error.name}: pip install 'rig[tables]'"
        ) from error
    except Exception as error:
        # Foreign readers raise whatever they stumble on in a file that is cut or was made to harm.
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{source}: is no such file, or is damaged: {reason}") from error


def _column(source: Path, table: Mapping[str, Array], key: str, place: str | int) -> Array:
    names = list(table)
    if isinstance(place, int):
        if not 1 <= place <= len(names):
            raise InputError(f"{source}: {key}.column = {place}: expected 1 to {len(names)}")
        return table[names[place - 1]]
    alike = [name for name in names if name == place or name.rpartition("/")[2] == place]
    if len(alike) != 1:
        what = f"there {len(alike)} times" if alike else "not there"
        raise InputError(
            f"{source}: {key}.column = {place!r} is {what}, expected one of "
            f"{', '.join(names[:20]) or 'no column at all'}"
        )
    column = table[alike[0]]
    if not 2 <= len(column) <= _MAX_SAMPLES:
        raise InputError(
            f"{source}: column {place!r} has {len(column)} values, expected 2 to {_MAX_SAMPLES}"
        )
    return column


def _worksheet(content: bytes) -> Mapping[str, Array]:
    """The first worksheet, its first row the names; cells without a number are NaN."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        if sum(item.file_size for item in archive.infolist()) > _MAX_BYTES:
            raise ValueError(f"more than {_MAX_BYTES} bytes within")
    openpyxl = cast("Any", importlib.import_module("openpyxl"))
    book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
    rows = book.worksheets[0].iter_rows(values_only=True)
    names = [str(cell).strip() if cell is not None else "" for cell in next(rows, ())]
    cells: list[list[float]] = []
    for row in rows:
        if all(cell is None for cell in row):
            continue
        cells.append([_number(cell) for cell in row[: len(names)]])
        if len(cells) > _MAX_SAMPLES:
            raise ValueError(f"more than {_MAX_SAMPLES} rows")
    if not cells:
        raise ValueError("no rows of data under the names")
    twice = next((name for name in names if name and names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"two columns are called {twice}, expected names of their own")
    width = len(names)
    table = np.array([row + [np.nan] * (width - len(row)) for row in cells])
    return {name or f"column {place}": table[:, place - 1] for place, name in enumerate(names, 1)}


def _number(cell: object) -> float:
    is_number = isinstance(cell, int | float) and not isinstance(cell, bool)
    return float(cast("float", cell)) if is_number else float("nan")


class _Heard(logging.Handler):
    """Keeps the first message of a reader."""

    def __init__(self) -> None:
        super().__init__()
        self.first: str | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message, if it is the first."""
        self.first = self.first or record.getMessage()


def _tdms(content: bytes) -> Mapping[str, Array]:
    """Channels of numbers, as `group/name`."""
    nptdms = cast("Any", importlib.import_module("nptdms"))
    heard = _Heard()
    logs = [logging.getLogger(name) for name in logging.root.manager.loggerDict if "nptdms" in name]
    # What the reader only warns of is a file that was cut: it is refused, and not read in part.
    for log in logs:
        log.handlers, log.propagate = [heard], False
    file = nptdms.TdmsFile.read(io.BytesIO(content))
    if heard.first is not None:
        raise ValueError(heard.first)
    return {
        f"{group.name}/{channel.name}": numbers
        for group in file.groups()
        for channel in group.channels()
        if (numbers := _numbers(channel[:])) is not None
    }


def _numbers(value: Any) -> Array | None:
    """A vector of numbers; None of anything else."""
    array: NDArray[Any] = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.size < 2 or array.size != max(array.shape):
        return None
    return np.array(array.ravel(), dtype=np.float64)


READERS: Mapping[str, Callable[[bytes], Mapping[str, Array]]] = MappingProxyType(
    {".xlsx": _worksheet, ".tdms": _tdms}
)
"""Suffix -> what reads such a file."""
