"""Data files of MTS controllers (Series 793, MultiPurpose TestWare): blocks of columns as text.

The first line says how the file is laid out, `MTS793|program|language|version|delimiter|decimal|`
and more, with delimiter 0 for blanks, 1 for commas and 2 for tabs. Each acquisition then has a line
of its own, a line of names, one of units, and rows of numbers; a file may hold many of them, one
after the other. Blanks are refused: names hold some too.

Reference: MTS Series 793 Application User Manual, Model 793.10 MultiPurpose TestWare, "Data file
header" and "About Specimen.dat files".
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension, si_conversion
from rig.formats.mapping import ForceChannel, HeightChannel, Mapping, TemperatureChannel, Time

Array = NDArray[np.float64]

SIGNATURE = b"MTS793|"
"""With which such a file begins."""

_MAX_BYTES = 1_000_000_000
_DELIMITERS = {"1": ",", "2": "\t"}
_SECONDS = {"sec": "s", "seconds": "s", "msec": "ms"}
"""Units of time as these files call them."""

Rebound = Literal["positive", "negative"]


def is_mts(source: Path) -> bool:
    """Whether a file begins as one of these."""
    try:
        with source.open("rb") as file:
            return file.read(len(SIGNATURE)) == SIGNATURE
    except OSError:
        return False


def mts_columns(source: Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of all acquisitions of a file one after the other, and their units.

    Raises:
        InputError: One line that names file, line and what was expected.
    """
    try:
        if source.stat().st_size > _MAX_BYTES:
            raise InputError(f"{source}: expected at most {_MAX_BYTES} bytes")
        text = source.read_text("latin-1")
    except OSError as error:
        raise InputError(f"{source}: cannot be read: {error.strerror}") from error
    lines = text.splitlines()
    delimiter, comma = _layout(source, lines[0] if lines else "")
    if not text.endswith(("\n", "\r")):
        raise InputError(
            f"{source}: line {len(lines)}: does not end: the file was cut, expected it whole"
        )
    names: list[str] = []
    units: list[str] = []
    texts: list[list[str]] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], start=2):
        if not line.strip() or line.startswith("MTS793|"):
            continue
        cells = [cell.strip().strip('"') for cell in line.rstrip("\t, ").split(delimiter)]
        row = _numbers(cells, comma=comma)
        if row is None:
            texts.append(cells)
            continue
        if texts:
            names, units = _heads(source, number, texts, names, units)
            texts = []
        if len(row) != len(names):
            raise InputError(
                f"{source}: line {number}: {len(row)} numbers, expected {len(names)}: "
                f"{', '.join(names) or 'no names stand before them'}"
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{source}: holds no row of numbers, expected an acquisition")
    table = np.array(rows)
    columns = {name: table[:, place] for place, name in enumerate(names)}
    return columns, dict(zip(names, units, strict=True))


def _layout(source: Path, first: str) -> tuple[str, bool]:
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


def _numbers(cells: Sequence[str], *, comma: bool) -> list[float] | None:
    """A row of numbers; None of a line of text."""
    try:
        found = [float(cell.replace(",", ".") if comma else cell) for cell in cells]
    except ValueError:
        return None
    return found if all(map(np.isfinite, found)) else None


def _heads(
    source: Path, number: int, texts: list[list[str]], names: list[str], units: list[str]
) -> tuple[list[str], list[str]]:
    """Names and units before a row: the last two lines of text, which every block repeats."""
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
        raise InputError(f"{source}: line {number}: a name stands twice: {', '.join(new)}")
    return new, new_units


def mts_mapping(source: Path, rebound: Rebound) -> Mapping:
    """What a file means, by its own names and units.

    Displacement counts as positive in rebound.

    Args:
        source: The file.
        rebound: Sign of the force in rebound, where the damper pulls.

    Raises:
        InputError: A quantity is not there, or several times, or its unit is unknown.
    """
    columns, units = mts_columns(source)

    def one(what: str, *words: str) -> str | None:
        found = [name for name in columns if any(word in name.lower() for word in words)]
        if len(found) > 1:
            raise InputError(
                f"{source}: {what} may be {' or '.join(found)}, expected one: write a --mapping"
            )
        return found[0] if found else None

    time, height, force = (
        one("time", "running time", "time"),
        one("height", "displacement", "length"),
        one("force", "force", "load"),
    )
    if time is None or height is None or force is None:
        raise InputError(
            f"{source}: has {', '.join(columns)}, expected a time, a displacement and a force"
        )
    temperature = one("temperature", "temperature")
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
    return Mapping(
        time=Time(column=time, unit=unit[time]),
        height=HeightChannel(column=height, unit=unit[height]),
        strut_force=ForceChannel(
            column=force, unit=unit[force], sign=-1 if rebound == "positive" else 1
        ),
        temperature=None
        if temperature is None
        else TemperatureChannel(column=temperature, unit=unit[temperature]),
    )
