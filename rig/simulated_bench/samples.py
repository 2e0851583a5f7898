"""An applied force or a prescribed height from a CSV file."""

import csv
import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_FILE_BYTES = 200_000_000
"""Largest file that is read."""

TIME_COLUMN = "t_s"


class Samples(NamedTuple):
    """Samples of a quantity.

    Attributes:
        t_s: Times in s, shape (samples,), increasing.
        values: Value at each time, shape (samples,).
    """

    t_s: NDArray[np.float64]
    values: NDArray[np.float64]


def read_samples(folder: Path, name: str, column: str) -> Samples:
    """Read one column over time; other columns are ignored.

    Args:
        folder: Folder of the configuration; the file must lie in it or below.
        name: Path of the file relative to `folder`.
        column: Name of the column, with its unit.

    Returns:
        The samples.

    Raises:
        ValueError: The file is outside the folder, missing, too large, or not such a table; one
            line naming line, column and expectation.
    """
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise ValueError(f"path = {name!r}, expected a file in the configuration's folder")
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ValueError(f"path = {name!r}, expected at most {MAX_FILE_BYTES} bytes")
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(_rows(csv.reader(file), name, (TIME_COLUMN, column)))
    except OSError as error:
        raise ValueError(f"path = {name!r} cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"path = {name!r}, expected CSV in UTF-8") from error
    if len(rows) < 2:
        raise ValueError(f"path = {name!r} has {len(rows)} samples, expected at least 2")
    table = np.array(rows, dtype=np.float64)
    steps_s = np.diff(table[:, 0])
    if not bool(np.all(steps_s > 0.0)):
        line = int(np.argmin(steps_s > 0.0)) + 3
        raise ValueError(f"path = {name!r}, line {line}: t_s does not increase")
    return Samples(np.ascontiguousarray(table[:, 0]), np.ascontiguousarray(table[:, 1]))


def _rows(
    reader: Iterator[list[str]], name: str, columns: tuple[str, str]
) -> Iterator[tuple[float, float]]:
    empty: list[str] = []
    header = [cell.strip() for cell in next(reader, empty)]
    for column in columns:
        if header.count(column) != 1:
            raise ValueError(f"path = {name!r}, line 1: expected one column {column}")
    where = [header.index(column) for column in columns]
    for line, row in enumerate(reader, start=2):
        if len(row) != len(header):
            raise ValueError(f"path = {name!r}, line {line}: expected {len(header)} columns")
        t_s, value = (
            _number(row[index], name, line, column)
            for index, column in zip(where, columns, strict=True)
        )
        yield t_s, value


def _number(text: str, name: str, line: int, column: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"path = {name!r}, line {line}: {column} = {text[:40]!r}, expected a finite number"
        )
    return value
