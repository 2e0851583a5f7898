"""Measured data from elsewhere: foreign tables and bus logs become the project's own files.

A mapping file says what a foreign table means (see `Mapping`). Nothing is guessed: what the mapping
leaves open is assumed as documented, and every assumption is returned in words.
"""

import csv
import importlib
import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isnan
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, cast

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.errors import DatabaseError
from can_dbc.frame import Frame
from can_dbc.units import Dimension, SiConversion, si_conversion
from dart_model.yaml_file import InputError, load_validated
from rig.config import Setup, build_bridge
from rig.core.messages import Conditions
from rig.io.clock import VirtualClock
from rig.io.link import LinkFigures
from rig.io.log_files import read_log
from rig.loop import Progress
from rig.runs import logged

Array = NDArray[np.float64]

_MAX_BYTES = 4_000_000_000
_MAX_LINE = 100_000
_MAX_SAMPLES = 5_000_000
_CHUNK = 50_000
_LONGEST_GAP_NS = 3_600_000_000_000
_MISSING = ("", "nan", "na", "n/a", "null", "-")

Text = Annotated[str, Field(min_length=1, max_length=200)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Unit = Annotated[str, Field(min_length=1, max_length=40)]
Place = Text | Annotated[int, Field(ge=1, le=10_000)]
"""A column by its name, or by its number, the first one being 1."""


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")


class Table(_Section):
    """How the text is laid out.

    Attributes:
        separator: Between cells: one character, ``tab``, or ``whitespace`` for any run of blanks.
        decimal: Decimal point or comma.
        encoding: Of the text, as Python calls it.
        skip_lines: Lines before the column names, or before the data where there are no names.
        column_names: Whether a line with the column names stands before the data.
        skip_after_names: Lines between the names and the data, e.g. one with units.
        first_row: First row of data that is taken, counted from 0.
        rows: Number of rows that are taken; all if absent.
    """

    separator: Annotated[str, Field(pattern=r"^(.|tab|whitespace)$")] = ","
    decimal: Literal[".", ","] = "."
    encoding: Text = "utf-8-sig"
    skip_lines: Annotated[int, Field(ge=0, le=100_000)] = 0
    column_names: bool = True
    skip_after_names: Annotated[int, Field(ge=0, le=1000)] = 0
    first_row: Annotated[int, Field(ge=0)] = 0
    rows: Annotated[int, Field(ge=1)] | None = None

    @model_validator(mode="after")
    def _one_meaning_a_character(self) -> "Table":
        if self.separator == self.decimal:
            raise ValueError(
                f"separator {self.separator!r} is also the decimal sign, expected another"
            )
        return self


class Time(_Section):
    """When a row was measured: a column of numbers, a column of dates, or a sampling rate.

    Attributes:
        column: Column of the time.
        unit: Unit of a column of numbers, e.g. ``s`` or ``ms``.
        date_format: How a column of dates is written, in the letters of C's ``strptime``; ``iso``
            for ISO 8601.
        sampling_rate_hz: Rows a second, where there is no column.
    """

    column: Place | None = None
    unit: Unit | None = None
    date_format: Text | None = None
    sampling_rate_hz: Positive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "Time":
        if (self.column is None) == (self.sampling_rate_hz is None):
            raise ValueError("expected one of column and sampling_rate_hz")
        if self.column is None and (self.unit or self.date_format):
            raise ValueError("unit and date_format go with a column, expected none of them")
        if self.column is not None and (self.unit is None) == (self.date_format is None):
            raise ValueError("expected one of unit and date_format with the column")
        return self


class _Channel(_Section):
    """A measured quantity: `si = sign * gain * reading` in `unit`, converted to SI, plus an offset.

    Attributes:
        column: Its column.
        unit: Unit of gain times reading, e.g. ``mm``, ``kN``, ``lbf``.
        gain: Units a reading, e.g. of a sensor whose volts were recorded.
        sign: -1 where the foreign table counts the other way.
    """

    column: Place
    unit: Unit
    gain: Number = 1.0
    sign: Literal[1, -1] = 1

    @model_validator(mode="after")
    def _says_something(self) -> "_Channel":
        if self.gain == 0.0:
            raise ValueError("gain 0: expected another number")
        return self


class HeightChannel(_Channel):
    """A height; `offset_m` is added, e.g. the strut's length where the sensor reads zero."""

    offset_m: Number = 0.0


class ForceChannel(_Channel):
    """A force; `offset_n` is added, e.g. minus the reading of an unloaded cell."""

    offset_n: Number = 0.0


class TemperatureChannel(_Channel):
    """A temperature; `offset_k` is added."""

    offset_k: Number = 0.0


class Mapping(_Section):
    """What a foreign table means.

    Attributes:
        table: How the text is laid out; not read for MF4 files.
        time: When a row was measured; not read for MF4 files, whose channels have times.
        height: Strut height, positive apart.
        applied_force: Force on the body, positive upwards (force-driven bench).
        strut_force: Load cell, positive when the strut pushes its bodies apart.
        temperature: Damper temperature.
    """

    table: Table = Table()
    time: Time | None = None
    height: HeightChannel
    applied_force: ForceChannel | None = None
    strut_force: ForceChannel | None = None
    temperature: TemperatureChannel | None = None

    @model_validator(mode="after")
    def _has_a_force(self) -> "Mapping":
        if self.applied_force is None and self.strut_force is None:
            raise ValueError("expected applied_force or strut_force beside height")
        return self


def load_mapping(path: Path) -> Mapping:
    """Read a mapping.

    Raises:
        InputError: One line that names file, key, value and what was expected.
    """
    mapping = load_validated(Mapping, path)
    try:
        _outputs(mapping)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return mapping


@dataclass(frozen=True)
class ImportReport:
    """What an import made.

    Attributes:
        out: The file or folder written.
        samples: Rows, or frames of a bus log.
        duration_s: Time from the first to the last.
        rate_hz: Rows a second, by the median step; frames a second of a bus log.
        columns: Columns written, or messages of a bus log.
        assumptions: What was assumed and converted, one line each.
    """

    out: Path
    samples: int
    duration_s: float
    rate_hz: float
    columns: tuple[str, ...]
    assumptions: tuple[str, ...]


class _Output(NamedTuple):
    """A column of the CSV that is written, and how it comes from a reading: `a * reading + b`."""

    name: str
    key: str
    place: Place
    unit: str
    factor: float
    offset: float
    words: str


def _outputs(mapping: Mapping) -> list[_Output]:
    made: list[_Output] = []
    height, temperature = mapping.height, mapping.temperature
    made.append(_output("height_m", "height", height, Dimension.LENGTH, height.offset_m))
    for name, key, force in (
        ("applied_force_n", "applied_force", mapping.applied_force),
        ("strut_force_n", "strut_force", mapping.strut_force),
    ):
        if force is not None:
            made.append(_output(name, key, force, Dimension.FORCE, force.offset_n))
    if temperature is not None:
        made.append(
            _output(
                "temperature_c",
                "temperature",
                temperature,
                Dimension.TEMPERATURE,
                temperature.offset_k,
            )
        )
    return made


def _output(name: str, key: str, channel: _Channel, dimension: Dimension, add: float) -> _Output:
    conversion = _conversion(channel.unit, dimension, key)
    factor = conversion.factor * channel.gain * channel.sign
    words = f"{name} = {factor:.9g} * column {channel.column!r}"
    offset = conversion.offset + add
    if offset:
        words += f" {'+' if offset > 0 else '-'} {abs(offset):.9g}"
    gain = "" if channel.gain == 1.0 else f", {channel.gain:g} {channel.unit} a reading"
    turned = ", sign turned" if channel.sign < 0 else ""
    words += f" (read in {channel.unit}{gain}{turned})"
    return _Output(name, key, channel.column, channel.unit, factor, offset, words)


def _conversion(unit: str, dimension: Dimension, key: str) -> SiConversion:
    try:
        return si_conversion(unit, dimension)
    except DatabaseError as error:
        raise InputError(f"{key}.unit: {error}") from error


def import_table(source: Path, mapping: Mapping, out: Path) -> ImportReport:
    """Turn a foreign table, or the channels of an MF4 file, into the project's CSV.

    The text is read in pieces, so memory does not grow with the width of the table.

    Args:
        source: Text file, or MF4 file whose channels are named as the mapping's columns.
        mapping: What it means.
        out: CSV file to write; it must not exist.

    Returns:
        What was made and what was assumed.

    Raises:
        InputError: One line that names file, line or key, value and what was expected.
    """
    if out.exists():
        raise InputError(f"{out}: exists already, expected a new file")
    outputs = _outputs(mapping)
    if source.suffix.lower() in (".mf4", ".mdf", ".dat"):
        t_s, values, said = _measured_channels(source, mapping, outputs)
    else:
        t_s, values, said = _text_columns(source, mapping, outputs)
    _check_times(source, t_s)
    values = [
        output.factor * column + output.offset
        for output, column in zip(outputs, values, strict=True)
    ]
    names = ("t_s", *(output.name for output in outputs))
    _write(out, names, [t_s, *values])
    said += [output.words for output in outputs]
    missing = int(np.count_nonzero(np.isnan(values[0])))
    if missing:
        said.append(f"height_m is missing in {missing} of {len(t_s)} rows; its cells are empty")
    said += _said_of_signs(mapping)
    duration_s = float(t_s[-1] - t_s[0])
    rate_hz = 1.0 / float(np.median(np.diff(t_s)))
    return ImportReport(out, len(t_s), duration_s, rate_hz, names, tuple(said))


def _said_of_signs(mapping: Mapping) -> list[str]:
    said = ["height is taken as positive when the bodies move apart"]
    if mapping.applied_force is not None:
        said.append("applied force is taken as positive upwards, without the weight")
    if mapping.strut_force is not None:
        said.append("strut force is taken as positive when the strut pushes its bodies apart")
    if mapping.applied_force is None:
        said.append("there is no applied force: the motion is taken as imposed")
    return said


def _check_times(source: Path, t_s: Array) -> None:
    if len(t_s) < 2:
        raise InputError(f"{source}: {len(t_s)} rows of data, expected at least 2")
    steps = np.diff(t_s)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise InputError(
            f"{source}: time {t_s[row]:.9g} s in row {row} follows {t_s[row - 1]:.9g} s, expected "
            "times that increase; where stamps are too coarse give time.sampling_rate_hz"
        )


def _write(out: Path, names: Sequence[str], columns: Sequence[Array]) -> None:
    beside = out.with_name(out.name + ".part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("w", encoding="ascii", newline="\n") as file:
            file.write(",".join(names) + "\n")
            for first in range(0, len(columns[0]), _CHUNK):
                part = np.column_stack([column[first : first + _CHUNK] for column in columns])
                file.writelines(_line(row) for row in part.tolist())
        beside.replace(out)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error


def _line(row: list[float]) -> str:
    cells = [f"{row[0]:.9f}", *("" if isnan(value) else f"{value:.10g}" for value in row[1:])]
    return ",".join(cells) + "\n"


_Columns = tuple[Array, list[Array], list[str]]
"""Times in s, readings of each output as they stand in the file, and what was assumed."""


def _text_columns(source: Path, mapping: Mapping, outputs: Sequence[_Output]) -> _Columns:
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
    source: Path, file: Any, mapping: Mapping, time: Time, outputs: Sequence[_Output]
) -> _Columns:
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
    while piece := list(itertools.islice(taken, _CHUNK)):
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
        unit = _conversion(time.unit or "", Dimension.TIME, "time")
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
        _conversion(time.unit or "s", Dimension.TIME, "time")

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
        except ValueError:
            raise InputError(
                f"{self._source}: line {line}: time = {text[:40]!r}, "
                f"expected a date as {self._form!r}"
            ) from None
        return stamp if stamp.tzinfo is not None else stamp.replace(tzinfo=UTC)


def _measured_channels(source: Path, mapping: Mapping, outputs: Sequence[_Output]) -> _Columns:
    """Channels of an MF4 file at the height's times."""
    try:
        asammdf = cast("Any", importlib.import_module("asammdf"))  # optional, and slow to import
        damaged = cast("type[Exception]", asammdf.blocks.utils.MdfException)
    except ImportError as error:
        raise InputError(f"{source}: wants the package asammdf: pip install 'rig[mf4]'") from error
    try:
        with source.open("rb") as raw, asammdf.MDF(raw) as file:
            signals = [_signal(source, file, output) for output in outputs]
    except InputError:
        raise
    except (damaged, OSError, ValueError, LookupError, AttributeError, struct.error) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{source}: is no such MF4 file, or is damaged: {reason}") from error
    at_s = signals[0][0]
    t_s = at_s - at_s[0]
    said = [f"t_s from the times of channel {mapping.height.column!r}, 0 at {at_s[0]:.9g} s"]
    values = [signals[0][1]]
    for output, (own_s, readings) in zip(outputs[1:], signals[1:], strict=True):
        values.append(np.interp(at_s, own_s, readings))
        if not np.array_equal(own_s, at_s):
            said.append(f"{output.name}: {len(own_s)} samples, linear between them")
    return t_s, values, said


def _signal(source: Path, file: Any, output: _Output) -> tuple[Array, Array]:
    name = output.place
    if not isinstance(name, str):
        raise InputError(f"{source}: {output.key}.column = {name}: expected the name of a channel")
    found = cast("tuple[tuple[int, int], ...]", file.channels_db.get(name, ()))
    if len(found) != 1:
        what = "not there" if not found else f"there {len(found)} times"
        raise InputError(
            f"{source}: {output.key}.column = {name!r} is {what}, expected one channel"
        )
    group, index = found[0]
    signal = file.get(group=group, index=index)
    values = np.array(signal.samples, dtype=np.float64)
    t_s = np.array(signal.timestamps, dtype=np.float64)
    if len(values) < 2 or values.ndim != 1 or not np.all(np.isfinite(values)):
        raise InputError(f"{source}: channel {name!r}: expected two or more numbers")
    if signal.unit and signal.unit != output.unit:
        raise InputError(
            f"{source}: {output.key}.unit = {output.unit!r}, but the file says {signal.unit!r}"
        )
    return t_s, values


class _LogPort:
    """Frames of a foreign log, tick by tick. What the bridge sends goes nowhere."""

    def __init__(self, source: Path, heard: frozenset[tuple[int, bool]], first_due_ns: int) -> None:
        self._source = source
        self._frames = read_log(source)
        self._heard = heard
        self.taken = 0
        self.others = 0
        self.last_ns = 0
        self._waiting = self._next()
        self.first_ns = 0 if self._waiting is None else self._waiting.t_ns
        self._shift_ns = first_due_ns - self.first_ns

    @property
    def ended(self) -> bool:
        """Whether all frames were read."""
        return self._waiting is None

    def receive(self, t_ns: int) -> tuple[Sequence[Frame], Conditions]:
        """Frames up to a tick."""
        frames: list[Frame] = []
        while (frame := self._waiting) is not None and frame.t_ns + self._shift_ns <= t_ns:
            # A log that several channels were written to may be out of order by a little.
            self.last_ns = max(frame.t_ns, self.last_ns)
            frames.append(replace(frame, t_ns=self.last_ns + self._shift_ns))
            self.taken += 1
            self._waiting = self._next()
        return frames, Conditions()

    def send(self, frames: Sequence[Frame]) -> Sequence[Frame]:
        """Log nothing as sent."""
        return frames[:0]

    def _next(self) -> Frame | None:
        for _, frame in self._frames:
            if (frame.arbitration_id, frame.is_extended) in self._heard:
                if self.taken and frame.t_ns - self.last_ns > _LONGEST_GAP_NS:
                    gap_s = (frame.t_ns - self.last_ns) * 1e-9
                    raise InputError(
                        f"{self._source}: {gap_s:.0f} s without a frame of the bench, "
                        "expected a log of one run: cut it there"
                    )
                return frame
            self.others += 1
        return None


def import_log(
    source: Path, ready: Setup, out: Path, progress: Progress = lambda _t, _mode: None
) -> ImportReport:
    """Turn a bus log of another program into a run, as if the bridge had heard it live.

    Args:
        source: BLF, ASC, candump, TRC or MF4 log of a bus.
        ready: Configuration that says which signals are heard, with model and DBC.
        out: Folder of the run to write; absent or empty.
        progress: Told of every tick.

    Returns:
        What was made and what was assumed.

    Raises:
        InputError: The log cannot be read, holds no frame that the bridge hears, or the folder
            cannot be written.
    """
    bridge = build_bridge(ready)
    # Half a tick after a tick, so that the jitter of a bench as fast as the bridge gives each tick
    # one frame, and not two to one and none to the next.
    port = _LogPort(source, bridge.heard, ready.config.period_ns // 2)
    wanted = tuple(item.message.name for item in bridge.incoming)
    if port.ended:
        raise InputError(
            f"{source}: none of its {port.others} frames is one of {', '.join(wanted)}, "
            "expected a log of the bench that the configuration describes"
        )
    endless = ready.model_copy(
        update={"config": ready.config.model_copy(update={"duration_s": None})}
    )
    ended = logged(
        endless,
        bridge,
        port,
        VirtualClock(),
        out,
        figures=LinkFigures(),
        stop=lambda: port.ended,
        progress=progress,
    )
    duration_s = (port.last_ns - port.first_ns) * 1e-9
    counts = ended.state.counts
    return ImportReport(
        out,
        port.taken,
        duration_s,
        port.taken / duration_s if duration_s > 0.0 else 0.0,
        wanted,
        (
            f"meaning of the frames from {ready.database.path.name}; "
            f"{port.others} frames of other ids left out",
            "all frames taken as received, error frames left out; the first one is at half a tick",
            f"estimates computed with model {ready.model.name} at {ready.config.rate_hz:g} Hz",
            f"{counts.lost} frames lost and {counts.refused} refused by counter and checksum",
        ),
    )
