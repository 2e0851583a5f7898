"""Tables of numbers as delimited text, read in pieces.

An error is one line: file, line, column, value and what was expected.
"""

import csv
import itertools
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError

Array = NDArray[np.float64]

ROWS_AT_ONCE = 2_000
"""Rows of a piece: memory does not grow with the columns that are not read. Larger pieces are
slower: their rows live long enough for the garbage collector to walk through them."""

MAX_ROWS = 5_000_000
"""Most rows: more than an hour at 1 kHz, and what a diagnosis can hold."""

_MAX_LINE = 100_000
"""Longest line in characters: hundreds of columns."""

_MISSING = ("", "nan", "na", "n/a", "null", "-")


class Layout(NamedTuple):
    """How the text is laid out.

    Attributes:
        separator: Between cells: one character, ``tab``, or ``whitespace`` for any run of blanks.
        decimal: Decimal point or comma.
        encoding: Encoding of the text, by Python's name.
        skip_lines: Lines before the first row.
    """

    separator: str = ","
    decimal: str = "."
    encoding: str = "utf-8-sig"
    skip_lines: int = 0


CSV = Layout()
"""The project's own tables."""


Row = tuple[int, list[str]]
"""Number of its line, and its cells."""


class Column(NamedTuple):
    """A column of some rows: what errors call file and column, and line and text of each cell."""

    file: str
    name: str
    lines: Sequence[int]
    texts: Sequence[str]


@contextmanager
def open_rows(
    path: Path, name: str, max_bytes: int, layout: Layout = CSV
) -> Generator[Iterator[Row]]:
    """Every row that holds a cell; an error calls the file `name`.

    Raises:
        InputError: The file cannot be read, is too large, or is no such text.
    """
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise InputError(f"{name}: {size} bytes, expected at most {max_bytes}")
        with path.open(encoding=layout.encoding, newline="") as file:
            yield _rows(name, _lines(name, file), layout)
    except OSError as error:
        raise InputError(f"{name}: cannot be read: {error.strerror}") from error
    except LookupError as error:
        raise InputError(f"{name}: encoding: {error}, expected e.g. utf-8") from error
    except (UnicodeError, csv.Error) as error:
        encoding = layout.encoding.removesuffix("-sig").upper()
        raise InputError(
            f"{name}: is no text in {encoding}, expected one; `rig import TABLE --mapping FILE` "
            "reads a foreign table in the encoding that the mapping states (table.encoding)"
        ) from error


def _lines(name: str, file: TextIO) -> Iterator[str]:
    while line := file.readline(_MAX_LINE):
        if len(line) >= _MAX_LINE:
            raise InputError(f"{name}: a line is longer than {_MAX_LINE} characters")
        yield line


def _rows(name: str, lines: Iterator[str], layout: Layout) -> Iterator[Row]:
    skipped = sum(1 for _ in itertools.islice(lines, layout.skip_lines))
    if skipped < layout.skip_lines:
        raise InputError(f"{name}: has {skipped} lines, expected {layout.skip_lines} to skip")
    if layout.separator == "whitespace":
        rows = (line.split() for line in lines)
    else:
        separator = "\t" if layout.separator == "tab" else layout.separator
        rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    for line, cells in enumerate(rows, start=layout.skip_lines + 1):
        if cells and (cells[0].strip() or any(map(str.strip, cells))):
            yield line, cells


def pieces(name: str, rows: Iterator[Row]) -> Iterator[list[Row]]:
    """The rows in pieces of `ROWS_AT_ONCE`.

    Raises:
        InputError: There are more than `MAX_ROWS`.
    """
    count = 0
    while piece := list(itertools.islice(rows, ROWS_AT_ONCE)):
        count += len(piece)
        if count > MAX_ROWS:
            raise InputError(f"{name}: more than {MAX_ROWS} rows, expected fewer: cut it")
        yield piece


def column_of(file: str, name: str, piece: Sequence[Row], index: int) -> Column:
    """A column of a piece, by its index.

    Raises:
        InputError: A row is too short.
    """
    try:
        texts = [cells[index] for _, cells in piece]
    except IndexError:
        line, short = next(row for row in piece if len(row[1]) <= index)
        raise InputError(
            f"{file}: line {line}: {len(short)} cells, expected at least {index + 1}"
        ) from None
    return Column(file, name, [line for line, _ in piece], texts)


def read_numbers(column: Column, decimal: str = ".") -> Array:
    """Numbers of a column, NaN where one is missing.

    Raises:
        InputError: A cell holds something else.
    """
    texts = column.texts
    if decimal == ",":
        texts = [text.replace(",", ".") for text in texts]
    try:
        numbers = np.array(texts, dtype=np.float64)
    except ValueError:
        numbers = np.array([_read_number(column, k, text) for k, text in enumerate(texts)])
    infinite = np.flatnonzero(np.isinf(numbers))
    if len(infinite):
        raise cell_error(column, int(infinite[0]), "a finite number")
    return numbers


def _read_number(column: Column, index: int, text: str) -> float:
    if text.strip().lower() in _MISSING:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise cell_error(column, index, "a number") from None


def cell_error(column: Column, index: int, expected: str) -> InputError:
    """The error of a cell: file, line, column, value and what was expected."""
    text = column.texts[index].strip()[:40]
    value = f"= {text!r}" if text else "is missing"
    return InputError(
        f"{column.file}: line {column.lines[index]}: {column.name} {value}, expected {expected}"
    )


def refuse_missing(column: Column, numbers: Array, advice: str) -> None:
    """Refuse a column that lacks a number.

    Raises:
        InputError: It does; `advice` is added to the line.
    """
    missing = np.flatnonzero(np.isnan(numbers))
    if len(missing):
        raise cell_error(column, int(missing[0]), f"a finite number ({advice})")


def read_csv_columns(
    path: Path, name: str, max_bytes: int, choose: Callable[[list[str]], Sequence[str]]
) -> tuple[dict[str, Array], list[int]]:
    """Numbers of the columns of a CSV file that names them in its first row.

    Args:
        path: The file.
        name: What to call it in an error.
        max_bytes: Largest size that is read.
        choose: Names in the header, none of an empty file -> names of the columns that are read.
            It raises `InputError` where the header is wrong.

    Returns:
        Values of each chosen column, shape (rows,), and the line of each row.

    Raises:
        InputError: The file is no such table, or a number is missing.
    """
    with open_rows(path, name, max_bytes) as rows:
        header = [cell.strip() for cell in next(rows, (1, list[str]()))[1]]
        chosen = choose(header)
        lines: list[int] = []
        parts: dict[str, list[Array]] = {key: [np.empty(0)] for key in chosen}
        for piece in pieces(name, rows):
            for line, cells in piece:
                if len(cells) != len(header):
                    raise InputError(
                        f"{name}: line {line}: {len(cells)} values, expected {len(header)}"
                    )
                lines.append(line)
            for key, numbers in parts.items():
                column = column_of(name, key, piece, header.index(key))
                numbers.append(read_numbers(column))
                refuse_missing(column, numbers[-1], "leave out rows without one")
    return {key: np.concatenate(numbers) for key, numbers in parts.items()}, lines
