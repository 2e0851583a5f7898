"""An applied force or a prescribed height from a CSV file."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.files.delimited_text import read_csv_columns

MAX_FILE_BYTES = 200_000_000
"""Largest file that is read."""

TIME_COLUMN = "t_s"


class Samples(NamedTuple):
    """Samples of a quantity: times in s, increasing, and a value at each, shape (samples,) each."""

    t_s: NDArray[np.float64]
    values: NDArray[np.float64]


def read_samples(folder: Path, name: str, column: str) -> Samples:
    """Read a column of the file `name` in `folder` or below it; other columns are ignored.

    Raises:
        InputError: The file is outside the folder, missing, too large, or not such a table; one
            line naming line, column and expectation.
    """
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise InputError(f"path = {name!r}, expected a file in the configuration's folder")
    where = f"path = {name!r}"
    columns = (TIME_COLUMN, column)
    values, lines = read_csv_columns(
        path, where, MAX_FILE_BYTES, lambda header: _choose_columns(where, header, columns)
    )
    t_s = values[TIME_COLUMN]
    if len(t_s) < 2:
        raise InputError(f"{where} has {len(t_s)} samples, expected at least 2")
    steps_s = np.diff(t_s)
    if not bool(np.all(steps_s > 0.0)):
        line = lines[int(np.argmin(steps_s > 0.0)) + 1]
        raise InputError(f"{where}: line {line}: t_s does not increase")
    return Samples(t_s, values[column])


def _choose_columns(where: str, header: list[str], columns: Sequence[str]) -> Sequence[str]:
    for column in columns:
        if header.count(column) != 1:
            raise InputError(f"{where}: line 1: expected one column {column}")
    return columns
