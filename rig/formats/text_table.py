"""Reads the columns of a foreign text table, in pieces, as a mapping says."""

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.units import Dimension, SiConversion
from rig.files.delimited_text import (
    Column,
    Layout,
    Row,
    cell_error,
    column_of,
    open_rows,
    pieces,
    read_numbers,
    refuse_missing,
)
from rig.formats.mapping import (
    ColumnName,
    OutputColumn,
    TableMapping,
    TextLayout,
    TimeColumn,
    unit_conversion,
)

Array = NDArray[np.float64]
_MAX_BYTES = 4_000_000_000
"""Largest file: some hours at the highest rates, and a row at a time is in memory."""

Columns = tuple[Array, list[Array], list[str]]
"""Times in s, readings of each output as they stand in the file, and what was assumed."""


def read_text_columns(
    source: Path, mapping: TableMapping, outputs: Sequence[OutputColumn]
) -> Columns:
    """Times and readings of a text table.

    Raises:
        InputError: One line that names file, line or key, value and what was expected.
    """
    table, time = mapping.table, mapping.time
    if time is None:
        raise InputError(f"{source}: the mapping has no time, expected time: {{column: ...}}")
    layout = Layout(table.separator, table.decimal, table.encoding, table.skip_lines)
    with open_rows(source, str(source), _MAX_BYTES, layout) as rows:
        names = _column_names(source, rows, table)
        stop = None if table.rows is None else table.first_row + table.rows
        data = itertools.islice(rows, table.first_row, stop)
        columns = _read_columns(source, data, names, mapping, outputs)
    count = len(columns[0])
    if table.rows is not None and count < table.rows:
        raise InputError(
            f"{source}: {count} rows from row {table.first_row} on, expected {table.rows}"
        )
    if time.column is None:
        t_s, words = sample_evenly(time, count)
    elif time.date_format is not None:
        t_s = columns.pop()
        words = f"t_s from dates in column {time.column!r}, 0 at the first one"
    else:
        t_s, words = in_seconds(time, columns.pop())
    return t_s, columns, [_layout_words(table, names, count), words]


def sample_evenly(time: TimeColumn, count: int) -> tuple[Array, str]:
    """Times in s of rows at a sampling rate, shape (count,), and the assumption in words."""
    rate_hz = time.sampling_rate_hz or 1.0
    words = f"t_s from {rate_hz:.9g} rows a second, evenly, beginning at 0"
    return np.arange(count) / rate_hz, words


def _time_conversion(time: TimeColumn) -> SiConversion:
    return unit_conversion(time.unit or "", Dimension.TIME, "time")


def in_seconds(time: TimeColumn, readings: Array) -> tuple[Array, str]:
    """Times in s from readings in the mapping's unit, and the assumption in words.

    Raises:
        InputError: The unit is none of time.
    """
    factor = _time_conversion(time).factor
    words = f"t_s = {factor:.9g} * column {time.column!r} (read in {time.unit})"
    return factor * readings, words


def _read_columns(
    source: Path,
    rows: Iterator[Row],
    names: list[str] | None,
    mapping: TableMapping,
    outputs: Sequence[OutputColumn],
) -> list[Array]:
    """Readings of each output, then of the time where it has a column, shape (rows,) each."""
    name, time, decimal = str(source), mapping.time, mapping.table.decimal

    def read_some(column: Column) -> Array:
        return read_numbers(column, decimal)

    def read_all(column: Column) -> Array:
        readings = read_numbers(column, decimal)
        refuse_missing(column, readings, "only heights may be missing")
        return readings

    readers: list[tuple[str, int, Callable[[Column], Array]]] = []
    for output in outputs:
        index = _column_index(source, output.key, output.column, names)
        readers.append((output.key, index, read_all if readers else read_some))
    if time is not None and time.column is not None:
        index = _column_index(source, "time", time.column, names)
        if time.date_format is None:
            _time_conversion(time)  # refused before a long file is read
        readers.append(("time", index, _Dates(time.date_format) if time.date_format else read_all))
    parts = [
        [read(column_of(name, key, piece, index)) for key, index, read in readers]
        for piece in pieces(name, rows)
    ]
    if not parts:
        raise InputError(f"{source}: no rows of data after the header, expected some")
    return [np.concatenate(readings) for readings in zip(*parts, strict=True)]


def _layout_words(table: TextLayout, names: list[str] | None, count: int) -> str:
    skipped = "" if table.skip_lines == 0 else f", {table.skip_lines} lines skipped before"
    named = "columns by number" if names is None else f"{len(names)} named columns"
    first, last = table.first_row, table.first_row + count - 1
    return (
        f"text in {table.encoding}, separated by {table.separator!r}, decimal sign "
        f"{table.decimal!r}, {named}{skipped}; rows {first} to {last} of the data taken"
    )


def _column_names(source: Path, rows: Iterator[Row], table: TextLayout) -> list[str] | None:
    if not table.column_names:
        return None
    row = next(rows, None)
    if row is None:
        raise InputError(f"{source}: no line with column names, expected one")
    for _ in itertools.islice(rows, table.skip_after_names):
        pass
    return [cell.strip() for cell in row[1]]


def _column_index(source: Path, key: str, column: ColumnName, names: list[str] | None) -> int:
    if isinstance(column, int):
        if names is not None and column > len(names):
            raise InputError(f"{source}: {key}.column = {column}, expected 1 to {len(names)}")
        return column - 1
    if names is None:
        raise InputError(
            f"{source}: {key}.column = {column!r}: the table has no names, expected a number"
        )
    if names.count(column) != 1:
        wrong = "twice" if column in names else "not there"
        shown = ", ".join(name[:40] for name in names[:20] if name)
        hint = "; is table.separator the file's own?" if len(names) == 1 else ""
        raise InputError(
            f"{source}: {key}.column = {column!r} is {wrong}, expected one of {shown}{hint}"
        )
    return names.index(column)


class _Dates:
    """Reads cells as dates, and gives seconds since the first one, exact to the microsecond."""

    def __init__(self, date_format: str) -> None:
        self._format = date_format
        self._first: datetime | None = None

    def __call__(self, column: Column) -> Array:
        dates = [self._parse(column, index) for index in range(len(column.texts))]
        first = self._first = self._first or dates[0]
        return np.array([(date - first).total_seconds() for date in dates])

    def _parse(self, column: Column, index: int) -> datetime:
        text = column.texts[index].strip()
        try:
            if self._format == "iso":
                date = datetime.fromisoformat(text)
            else:
                date = datetime.strptime(text, self._format)
        except (ValueError, re.error):
            raise cell_error(column, index, f"a date as {self._format!r}") from None
        return date if date.tzinfo is not None else date.replace(tzinfo=UTC)
