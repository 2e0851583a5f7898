"""Data files of MTS controllers (Series 793, MultiPurpose TestWare): blocks of columns as text.

The first line gives the layout, `MTS793|program|language|version|delimiter|decimal|` and more, with
delimiter 0 for blanks, 1 for commas and 2 for tabs. Each acquisition then has a title line, a line
of names, one of units, and rows of numbers; a file may hold several acquisitions. Blanks as
delimiter are refused, because names contain some too.

Reference: MTS Series 793 Application User Manual, Model 793.10 MultiPurpose TestWare, "Data file
header" and "About Specimen.dat files".
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension, si_conversion
from rig.formats.mapping import (
    ForceChannel,
    HeightChannel,
    TableMapping,
    TemperatureChannel,
    TimeColumn,
)

Array = NDArray[np.float64]

SIGNATURE = b"MTS793|"
"""First bytes of such a file."""

_MAX_BYTES = 1_000_000_000
_DELIMITERS = {"1": ",", "2": "\t"}
_SECONDS = {"sec": "s", "seconds": "s", "msec": "ms"}
"""Units of time by the names that these files use."""


def is_mts(source: Path) -> bool:
    """Whether a file begins with the signature."""
    try:
        with source.open("rb") as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


def read_whole(source: Path, most_bytes: int) -> bytes:
    """Content of a file of limited size.

    Raises:
        InputError: It is larger, or cannot be read.
    """
    try:
        if source.stat().st_size > most_bytes:
            raise InputError(f"{source}: expected at most {most_bytes} bytes")
        return source.read_bytes()
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from error


def read_mts(source: Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of all acquisitions of a file one after the other, and their units.

    Raises:
        InputError: One line that names file, line and what was expected.
    """
    text = read_whole(source, _MAX_BYTES).decode("latin-1")
    lines = text.splitlines()
    delimiter, comma = _read_layout(source, lines[0] if lines else "")
    if not text.endswith(("\n", "\r")):
        raise InputError(
            f"{source}: line {len(lines)}: has no line end, expected the whole file: it was cut"
        )
    names: list[str] = []
    units: list[str] = []
    texts: list[list[str]] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip() or line.startswith("MTS793|"):
            continue
        cells = [cell.strip().strip('"') for cell in line.rstrip("\t, ").split(delimiter)]
        row = _parse_numbers(cells, comma=comma)
        if row is None:
            texts.append(cells)
            continue
        if texts:
            names, units = _read_heads(source, number, texts, names, units)
            texts = []
        if len(row) != len(names):
            raise InputError(
                f"{source}: line {number}: {len(row)} numbers, expected {len(names)}: "
                f"{', '.join(names) or 'a line of names before them'}"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{source}: holds no row of numbers, expected an acquisition")
    table = np.array(rows)
    return dict(zip(names, table.T, strict=True)), dict(zip(names, units, strict=True))


def _read_layout(source: Path, first: str) -> tuple[str, bool]:
    """Delimiter, and whether the decimal sign is a comma."""
    fields = first.split("|")
    if fields[0] != "MTS793":
        raise InputError(f"{source}: line 1: {first[:40]!r}: expected MTS793|...")
    code, decimal = (fields[4], fields[5]) if len(fields) > 5 else ("2", ".")
    if code not in _DELIMITERS or decimal not in (".", ","):
        raise InputError(
            f"{source}: line 1: delimiter {code!r} and decimal sign {decimal!r}: expected 1 "
            "(commas) or 2 (tabs), and a point or a comma: export it that way"
        )
    if (code, decimal) == ("1", ","):
        raise InputError(f"{source}: line 1: a comma is both delimiter and decimal sign")
    return _DELIMITERS[code], decimal == ","


def _parse_numbers(cells: Sequence[str], *, comma: bool) -> list[float] | None:
    """The numbers of a row; None if it is a line of text."""
    try:
        numbers = [float(cell.replace(",", ".") if comma else cell) for cell in cells]
    except ValueError:
        return None
    return numbers if all(map(np.isfinite, numbers)) else None


def _read_heads(
    source: Path, number: int, texts: list[list[str]], names: list[str], units: list[str]
) -> tuple[list[str], list[str]]:
    """Names and units before a row: the last two lines of text, the same in every acquisition."""
    if names and len(texts) == 1:
        raise InputError(
            f"{source}: line {number - 1}: {', '.join(texts[0])[:60]}: expected "
            f"{len(names)} numbers"
        )
    if len(texts) < 2 or len(texts[-1]) != len(texts[-2]):
        raise InputError(
            f"{source}: line {number}: expected a line of names and one of units before the rows"
        )
    new, new_units = texts[-2], texts[-1]
    if names and (new, new_units) != (names, units):
        raise InputError(
            f"{source}: line {number}: an acquisition of {', '.join(new)} after one of "
            f"{', '.join(names)}: expected the same columns in all"
        )
    if len(set(new)) != len(new):
        raise InputError(f"{source}: line {number}: a name occurs twice: {', '.join(new)}")
    return new, new_units


def mts_mapping(source: Path, rebound: str) -> TableMapping:
    """The mapping that a file's own names and units give; displacement is positive in rebound.

    `rebound` is the sign of the force in rebound, where the damper pulls: `positive` or `negative`.

    Raises:
        InputError: It is no file of MTS, the sign is neither, a quantity is missing or ambiguous,
            or its unit is unknown.
    """
    if rebound not in ("positive", "negative"):
        raise InputError(f"--rebound {rebound!r}: expected positive or negative")
    if not is_mts(source):
        raise InputError(f"{source}: is no file of MTS, expected --mapping FILE")
    columns, units = read_mts(source)

    def find_column(quantity: str, *words: str) -> str | None:
        names = [name for name in columns if any(word in name.lower() for word in words)]
        if len(names) > 1:
            raise InputError(
                f"{source}: {quantity} may be {' or '.join(names)}, expected one: write a --mapping"
            )
        return names[0] if names else None

    time = find_column("time", "time")
    height = find_column("height", "displacement", "length")
    force = find_column("force", "force", "load")
    if time is None or height is None or force is None:
        raise InputError(
            f"{source}: has {', '.join(columns)}, expected a time, a displacement and a force"
        )
    temperature = find_column("temperature", "temperature")
    unit = {name: _SECONDS.get(text.lower(), text) for name, text in units.items()}
    for name, dimension in (
        (time, Dimension.TIME),
        (height, Dimension.LENGTH),
        (force, Dimension.FORCE),
    ):
        try:
            si_conversion(unit[name], dimension)
        except DatabaseError as error:
            raise InputError(f"{source}: {name}: {error}") from error
    return TableMapping(
        time=TimeColumn(column=time, unit=unit[time]),
        height=HeightChannel(column=height, unit=unit[height]),
        strut_force=ForceChannel(column=force, unit=unit[force], reversed=rebound == "positive"),
        temperature=None
        if temperature is None
        else TemperatureChannel(column=temperature, unit=unit[temperature]),
    )
