"""Reads the columns of a foreign text table, in pieces, as a mapping says."""

import csv
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from can_dbc.units import Dimension
from rig.formats.mapping import Mapping, Output, Place, Table, Time, unit_conversion

Array = NDArray[np.float64]
_MAX_BYTES = 4_000_000_000
"""Largest file: some hours at the highest rates, and a row at a time is in memory."""

_MAX_LINE = 100_000
"""Longest line in characters: hundreds of columns."""

_MAX_SAMPLES = 5_000_000
"""Most rows: more than an hour at 1 kHz, and what a diagnosis can hold."""

ROWS_AT_ONCE = 50_000
_MISSING = ("", "nan", "na", "n/a", "null", "-")
Columns = tuple[Array, list[Array], list[str]]
"""Times in s, readings of each output as they stand in the file, and what was assumed."""


def text_columns(source: Path, mapping: Mapping, outputs: Sequence[Output]) -> Columns:
    """Times and readings of a text table.

    Raises:
        InputError: One line that names file, line or key, value and what was expected.
    """
    time = mapping.time
    if time is None:
        raise InputError(f"{source}: the mapping has no time, expected time: {{column: ...}}")
    try:
        size = source.stat().st_size
        if size > _MAX_BYTES:
            raise InputError(f"{source}: {size} bytes, expected at most {_MAX_BYTES}")
        with source.open(encoding=mapping.table.encoding, newline="") as file:
            return _parsed(source, file, mapping, time, outputs)
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from error
    except LookupError as error:
        raise InputError(f"{source}: table.encoding: {error}, expected e.g. utf-8") from error
    except (UnicodeError, csv.Error) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{source}: is no such text: {reason}") from error


def _parsed(
    source: Path, file: Any, mapping: Mapping, time: Time, outputs: Sequence[Output]
) -> Columns:
    table = mapping.table
    rows = _rows(source, _lines(source, file), table)
    names = _names(source, rows, table)
    places = [_index(source, output.key, output.place, names) for output in outputs]
    if time.column is not None:
        places.append(_index(source, "time", time.column, names))
    stop = None if table.rows is None else table.first_row + table.rows
    taken = itertools.islice(rows, table.first_row, stop)
    comma = table.decimal == ","
    parts: list[list[Array]] = []
    count = 0
    to_time = _time_reader(source, time, comma=comma)
    while piece := list(itertools.islice(taken, ROWS_AT_ONCE)):
        count += len(piece)
        if count > _MAX_SAMPLES:
            raise InputError(f"{source}: more than {_MAX_SAMPLES} rows, expected fewer: cut it")
        columns = [
            _numbers(source, output.key, _cells(source, piece, place), comma=comma)
            for output, place in zip(outputs, places, strict=False)
        ]
        for output, column in zip(outputs[1:], columns[1:], strict=True):
            _refuse_missing(source, output.key, column, piece)
        if time.column is not None:
            columns.append(to_time(_cells(source, piece, places[-1])))
        parts.append(columns)
    if not parts:
        raise InputError(f"{source}: no rows of data after the header, expected some")
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    if table.rows is not None and count < table.rows:
        raise InputError(
            f"{source}: {count} rows from row {table.first_row} on, expected {table.rows}"
        )
    said = _said_of_layout(table, names, count)
    if time.sampling_rate_hz is not None:
        t_s = np.arange(count) / time.sampling_rate_hz
        said.append(f"t_s from {time.sampling_rate_hz:.9g} rows a second, evenly, beginning at 0")
        return t_s, joined, said
    t_s = joined.pop()
    if time.date_format is not None:
        said.append(f"t_s from dates in column {time.column!r}, 0 at the first one")
    else:
        unit = unit_conversion(time.unit or "", Dimension.TIME, "time")
        t_s *= unit.factor
        said.append(f"t_s = {unit.factor:.9g} * column {time.column!r} (read in {time.unit})")
    return t_s, joined, said


def _said_of_layout(table: Table, names: list[str] | None, count: int) -> list[str]:
    skipped = "" if table.skip_lines == 0 else f", {table.skip_lines} lines skipped before"
    named = "columns by number" if names is None else f"{len(names)} named columns"
    first, last = table.first_row, table.first_row + count - 1
    return [
        f"text in {table.encoding}, separated by {table.separator!r}, decimal sign "
        f"{table.decimal!r}, {named}{skipped}; rows {first} to {last} of the data taken"
    ]


def _lines(source: Path, file: Any) -> Iterator[str]:
    while line := cast("str", file.readline(_MAX_LINE)):
        if len(line) >= _MAX_LINE:
            raise InputError(f"{source}: a line is longer than {_MAX_LINE} characters")
        yield line


class _Row(NamedTuple):
    """A row of cells and the number of its line."""

    line: int
    cells: list[str]


def _rows(source: Path, lines: Iterator[str], table: Table) -> Iterator[_Row]:
    skipped = sum(1 for _ in itertools.islice(lines, table.skip_lines))
    if skipped < table.skip_lines:
        raise InputError(
            f"{source}: table.skip_lines = {table.skip_lines}, but it has {skipped} lines"
        )
    if table.separator == "whitespace":
        cells = (line.split() for line in lines)
    else:
        separator = "\t" if table.separator == "tab" else table.separator
        cells = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    for number, row in enumerate(cells, start=table.skip_lines + 1):
        if any(cell.strip() for cell in row):
            yield _Row(number, row)


def _names(source: Path, rows: Iterator[_Row], table: Table) -> list[str] | None:
    if not table.column_names:
        return None
    row = next(rows, None)
    if row is None:
        raise InputError(f"{source}: no line with column names, expected one")
    for _ in itertools.islice(rows, table.skip_after_names):
        pass
    return [cell.strip() for cell in row.cells]


def _index(source: Path, key: str, place: Place, names: list[str] | None) -> int:
    if isinstance(place, int):
        if names is not None and place > len(names):
            raise InputError(
                f"{source}: {key}.column = {place}, but there are {len(names)} columns"
            )
        return place - 1
    if names is None:
        raise InputError(
            f"{source}: {key}.column = {place!r}: the table has no names, expected a number"
        )
    if names.count(place) != 1:
        found = "twice" if place in names else "not there"
        shown = ", ".join(name[:40] for name in names[:20] if name)
        raise InputError(f"{source}: {key}.column = {place!r} is {found}, expected one of {shown}")
    return names.index(place)


class _Cells(NamedTuple):
    """Cells of one column, and the numbers of their lines."""

    lines: list[int]
    texts: list[str]


def _cells(source: Path, piece: list[_Row], place: int) -> _Cells:
    try:
        texts = [row.cells[place].strip() for row in piece]
    except IndexError:
        short = next(row for row in piece if len(row.cells) <= place)
        raise InputError(
            f"{source}: line {short.line}: {len(short.cells)} cells, expected at least {place + 1}"
        ) from None
    return _Cells([row.line for row in piece], texts)


def _numbers(source: Path, key: str, cells: _Cells, *, comma: bool) -> Array:
    texts = cells.texts
    if comma:
        texts = [text.replace(",", ".") for text in texts]
    try:
        values = np.array(texts, dtype=np.float64)
    except ValueError:
        values = np.array(
            [
                _number(source, key, line, text)
                for line, text in zip(cells.lines, texts, strict=True)
            ]
        )
    infinite = np.isinf(values)
    if np.any(infinite):
        row = int(np.argmax(infinite))
        raise InputError(
            f"{source}: line {cells.lines[row]}: {key} = {texts[row][:40]!r}, "
            "expected a finite number"
        )
    return values


def _number(source: Path, key: str, line: int, text: str) -> float:
    if text.lower() in _MISSING:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"{source}: line {line}: {key} = {text[:40]!r}, expected a number"
        ) from None


def _refuse_missing(source: Path, key: str, column: Array, piece: list[_Row]) -> None:
    if np.any(np.isnan(column)):
        row = int(np.argmax(np.isnan(column)))
        raise InputError(
            f"{source}: line {piece[row].line}: {key} is missing, expected a number "
            "(only heights may be missing)"
        )


def _time_reader(source: Path, time: Time, *, comma: bool) -> Callable[[_Cells], Array]:
    if time.date_format is None:
        unit_conversion(time.unit or "s", Dimension.TIME, "time")

        def numbers(cells: _Cells) -> Array:
            values = _numbers(source, "time", cells, comma=comma)
            if np.any(np.isnan(values)):
                row = int(np.argmax(np.isnan(values)))
                raise InputError(
                    f"{source}: line {cells.lines[row]}: time is missing, expected a number"
                )
            return values

        return numbers
    return _Dates(source, time.date_format)


class _Dates:
    """Reads cells as dates, and gives seconds since the first one, exact to the microsecond."""

    def __init__(self, source: Path, form: str) -> None:
        self._source = source
        self._form = form
        self.first: datetime | None = None

    def __call__(self, cells: _Cells) -> Array:
        stamps = [
            self._stamp(line, text) for line, text in zip(cells.lines, cells.texts, strict=True)
        ]
        first = self.first = self.first or stamps[0]
        return np.array([(stamp - first).total_seconds() for stamp in stamps])

    def _stamp(self, line: int, text: str) -> datetime:
        try:
            if self._form == "iso":
                stamp = datetime.fromisoformat(text)
            else:
                stamp = datetime.strptime(text, self._form)
        except (ValueError, re.error):
            raise InputError(
                f"{self._source}: line {line}: time = {text[:40]!r}, "
                f"expected a date as {self._form!r}"
            ) from None
        return stamp if stamp.tzinfo is not None else stamp.replace(tzinfo=UTC)
