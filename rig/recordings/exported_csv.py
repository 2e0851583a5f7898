"""Recordings in the CSV files that `rig export --format csv` writes: the ticks of a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.csv
from numpy.typing import NDArray

from rig.channels.measured_quantities import (
    ACCELERATION,
    INPUT_QUANTITIES,
    LOAD_CELL_FORCE,
    TEMPERATURE,
)
from rig.recordings.recording import Array, RecordedInput, Recording, RecordingError

_HEIGHT, _TIME = ".measured_height_m", ".measured_t_ns"
_LONGEST_HEADER = 100_000
"""Bytes in which the header of such a file ends."""


def is_export(path: Path) -> bool:
    """Whether a CSV file has the columns of an exported run."""
    with path.open("rb") as file:
        header = file.readline(_LONGEST_HEADER)
    return f'{_HEIGHT}"'.encode() in header


def read_export(path: Path, struts: Sequence[str] | None = None) -> Recording:
    """Recording of an exported run: each height with what was measured at its tick.

    Times are those at which the first strut's heights were sampled; of other struts, the applied
    force, the load cell and the temperature it has what the bridge had at that tick.

    Args:
        path: The file.
        struts: The model's, in its order; those of the file in its own order if None.

    Raises:
        RecordingError: The file is damaged, lacks a column, or holds no force.
    """
    try:
        table = pyarrow.csv.read_csv(path)
    except pa.ArrowException as error:
        raise RecordingError(f"{path.name}: is damaged, expected it as exported") from error
    names = [name.removesuffix(_HEIGHT) for name in table.column_names if name.endswith(_HEIGHT)]
    names = list(struts) if struts is not None else names
    heights = [_column(path, table, name + _HEIGHT) for name in names]
    sampled_ns = _column(path, table, names[0] + _TIME)
    is_new = np.isfinite(sampled_ns) & (np.diff(sampled_ns, prepend=np.nan) != 0.0)
    is_new &= np.all(np.isfinite(heights), axis=0)
    cell, temperature = (
        _quantity(path, table, quantity.column, is_new)
        for quantity in (LOAD_CELL_FORCE, TEMPERATURE)
    )
    inputs = _inputs(path, table, is_new)
    if not inputs and cell is None:
        raise RecordingError(
            f"{path.name}: holds heights alone, expected a run with an applied force or a load cell"
        )
    return Recording(
        path.name,
        sampled_ns[is_new] * 1e-9,
        np.column_stack(heights)[is_new],
        inputs,
        None if cell is None or len(names) > 1 else cell[:, np.newaxis],
        temperature,
    )


def _column(path: Path, table: pa.Table, name: str) -> Array:
    if name not in table.column_names:
        raise RecordingError(f"{path.name}: header: column {name} is missing, expected it")
    try:
        return np.asarray(cast("Any", table.column(name)).to_numpy(), dtype=np.float64)
    except (ValueError, TypeError, pa.ArrowException) as error:
        raise RecordingError(f"{path.name}: column {name}: expected numbers alone") from error


def _inputs(path: Path, table: pa.Table, rows: NDArray[np.bool_]) -> dict[str, RecordedInput]:
    """What drove the bench at some ticks, by name."""
    inputs: dict[str, RecordedInput] = {}
    for column in table.column_names:
        kind, _, name = column.partition(":")
        quantity = next((item for item in INPUT_QUANTITIES if item.column == kind), None)
        if quantity is None or quantity is ACCELERATION:
            continue
        values, acceleration = (
            _quantity(path, table, other, rows)
            for other in (column, f"{ACCELERATION.column}:{name}")
        )
        if values is not None:
            inputs[name or quantity.key] = RecordedInput(quantity, values, acceleration)
    return inputs


def _quantity(path: Path, table: pa.Table, column: str, rows: NDArray[np.bool_]) -> Array | None:
    """A quantity of the bench at some ticks, straight between those at which it came, or None."""
    if column not in table.column_names:
        return None
    values, ticks = _column(path, table, column), np.arange(table.num_rows)
    came = np.isfinite(values)
    return np.interp(ticks[rows], ticks[came], values[came]) if came.any() else None
