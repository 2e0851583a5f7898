"""Recordings in CSV files, with units in their headers."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from can_dbc.errors import InputError, expected_name
from rig.channels.measured_quantities import (
    ACCELERATION,
    APPLIED_FORCE,
    APPLIED_TORQUE,
    INPUT_QUANTITIES,
    MOTION,
)
from rig.files.delimited_text import read_csv_columns
from rig.recordings.gaps import find_gaps
from rig.recordings.recording import Array, RecordedInput, Recording, RecordingError

COLUMNS = ("t_s", "height_m", "applied_force_n", "strut_force_n", "temperature_c")
"""Columns of a CSV file. Heights and strut forces may name their strut: ``height_m:tyre``."""

_OF_A_STRUT = ("height_m", "strut_force_n")
_OF_AN_INPUT = tuple(quantity.column for quantity in INPUT_QUANTITIES)
"""Columns that name an input of the model: ``motion_m:road``; the only force needs no name."""
_LARGEST_BYTES = 2_000_000_000
"""Ten minutes, the longest recording, at 50 kHz in five columns of twelve characters."""


def read_csv(path: Path, struts: Sequence[str] | None = None) -> Recording:
    """Recording from a CSV file with units in its header.

    `struts` are the model's, in its order; columns without a strut's name belong to the only one.

    Raises:
        RecordingError: The file is no such table.
    """
    name = path.name
    try:
        values, _ = read_csv_columns(
            path, name, _LARGEST_BYTES, lambda header: _check_header(name, header)
        )
    except InputError as error:
        raise RecordingError(str(error)) from error
    columns, samples = list(values), len(values["t_s"])
    names = _struts_of(name, columns, struts)
    heights = [_column_of(name, values, "height_m", strut, names) for strut in names]
    if any(height is None for height in heights):
        missing = names[[height is None for height in heights].index(True)]
        raise RecordingError(f"{name}: header: expected a column height_m:{missing}")
    cells = [_column_of(name, values, "strut_force_n", strut, names) for strut in names]
    return Recording(
        name,
        values["t_s"],
        np.column_stack([height for height in heights if height is not None]),
        _inputs_of(name, values),
        _stack_columns(cells, samples),
        values.get("temperature_c"),
    )


def _inputs_of(name: str, values: Mapping[str, Array]) -> dict[str, RecordedInput]:
    """What drove the bench, by name."""
    inputs: dict[str, RecordedInput] = {}
    for quantity in (APPLIED_FORCE, APPLIED_TORQUE, MOTION):
        for column, measured in values.items():
            kind, _, own = column.partition(":")
            if kind != quantity.column:
                continue
            own = own or quantity.key
            if own in inputs:
                raise RecordingError(f"{name}: header: input {own} has two columns, expected one")
            acceleration = None
            if quantity is MOTION:
                acceleration = values.get(f"{ACCELERATION.column}:{own}")
            gaps = find_gaps(values["t_s"], measured)
            inputs[own] = RecordedInput(quantity, measured, acceleration, gaps)
    for column in values:
        kind, _, own = column.partition(":")
        if kind == ACCELERATION.column and (
            own not in inputs or inputs[own].quantity is not MOTION
        ):
            raise RecordingError(
                f"{name}: header: column {column}: expected {MOTION.column}:{own} in addition"
            )
    return inputs


def _stack_columns(cells: Sequence[Array | None], samples: int) -> Array | None:
    if all(cell is None for cell in cells):
        return None
    return np.column_stack([np.full(samples, np.nan) if cell is None else cell for cell in cells])


def _column_of(
    name: str, values: Mapping[str, Array], kind: str, strut: str, names: Sequence[str]
) -> Array | None:
    """The column of a strut; without a name it belongs to the only strut."""
    named, plain = values.get(f"{kind}:{strut}"), values.get(kind)
    if plain is not None and len(names) > 1:
        raise RecordingError(
            f"{name}: header: column {kind} of {len(names)} struts ({', '.join(names)}), "
            f"expected {kind}:{strut}"
        )
    return plain if named is None else named


def _struts_of(name: str, columns: Sequence[str], struts: Sequence[str] | None) -> list[str]:
    parts = [column.partition(":") for column in columns]
    named = [name for kind, _, name in parts if kind in _OF_A_STRUT and name]
    if struts is None:
        return list(dict.fromkeys(named)) or [""]
    for strut in named:
        if strut not in struts:
            raise RecordingError(
                f"{name}: header: strut {strut[:40]!r}: {expected_name(strut, struts)}"
            )
    return list(struts)


def _expected(kind: str) -> str:
    """What was expected in place of an unknown column, and what makes it of such a table."""
    separator = next((sign for sign in ";\t" if sign in kind), "")
    quantities = {column.rpartition("_")[0]: column for column in COLUMNS}
    quantity, _, unit = kind.rpartition("_")
    if separator:
        text = f"expected columns separated by commas (in a mapping: separator: {separator!r})"
    elif quantity in quantities:
        text = f"expected {quantities[quantity]} (in a mapping: unit: {unit})"
    else:
        columns = ", ".join(COLUMNS)
        named = ", ".join(f"{column}:NAME" for column in _OF_AN_INPUT)
        return (
            f"expected one of {columns}, a height or strut force with its strut as in "
            f"height_m:tyre, or an input with its name ({named}); `rig import` makes them of a "
            "foreign table"
        )
    return f"{text}; `rig import TABLE --mapping FILE` makes them of a foreign table"


def _check_header(name: str, columns: list[str]) -> list[str]:
    """The columns of a file's header, all of them, if they are those of a recording."""
    if not columns:
        raise RecordingError(f"{name}: is empty, expected a header {','.join(COLUMNS[:3])}")
    kinds: list[str] = []
    for column in columns:
        kind, colon, own = column.partition(":")
        may_name = kind in (*_OF_A_STRUT, *_OF_AN_INPUT)
        has_to_name = kind in _OF_AN_INPUT and kind != APPLIED_FORCE.column
        is_known = kind in COLUMNS or kind in _OF_AN_INPUT
        if not is_known or (colon and not (may_name and own)) or (has_to_name and not own):
            raise RecordingError(f"{name}: header: column {column[:40]!r}: {_expected(kind)}")
        if columns.count(column) > 1:
            raise RecordingError(f"{name}: header: column {column} occurs twice, expected once")
        kinds.append(kind)
    for column in COLUMNS[:2]:
        if column not in kinds:
            raise RecordingError(f"{name}: header: column {column} is missing, expected it")
    if not {*_OF_AN_INPUT, "strut_force_n"} & set(kinds):
        raise RecordingError(
            f"{name}: header: expected applied_force_n or strut_force_n (or an input of the model, "
            "such as motion_m:road), in addition to t_s and height_m"
        )
    return columns
