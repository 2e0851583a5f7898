"""The meaning of a foreign table: its layout, its times, and the unit and sign of each column.

Nothing is guessed: what the mapping leaves open has a documented default.
"""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.calibration import Calibration
from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension, SiConversion, si_conversion
from can_dbc.yaml_file import Finite, Positive, load_yaml
from rig.channels.channel import Zero

Text = Annotated[str, Field(min_length=1, max_length=200)]
Unit = Annotated[str, Field(min_length=1, max_length=40)]
ColumnName = Text | Annotated[int, Field(ge=1, le=10_000)]
"""A column by its name, or by its number, the first one being 1."""


class _Section(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")


class TextLayout(_Section):
    """Layout of a text table.

    Attributes:
        separator: One character, `tab`, or `whitespace` for any run of spaces and tabs.
        decimal: Decimal separator: a point or a comma.
        encoding: Character encoding, by its name in Python.
        skip_lines: Lines before the header line, or before the data if there is none.
        column_names: Whether the file has a header line with the names of the columns.
        skip_after_names: Lines between the header line and the data, such as a line with units;
            blank lines do not count.
        first_row: First row of data that is used, counted from 0.
        rows: Number of rows that are used; all if absent.
    """

    separator: Annotated[str, Field(pattern=r"^(.|tab|whitespace)$")] = ","
    decimal: Literal[".", ","] = "."
    encoding: Text = "utf-8-sig"
    skip_lines: Annotated[int, Field(ge=0, le=100_000)] = 0
    column_names: bool = True
    skip_after_names: Annotated[int, Field(ge=0, le=1000)] = 0
    first_row: Annotated[int, Field(ge=0, le=10**12)] = 0
    rows: Annotated[int, Field(ge=1, le=10**12)] | None = None

    @model_validator(mode="after")
    def _one_meaning_a_character(self) -> "TextLayout":
        if self.separator == self.decimal:
            raise ValueError(
                f"separator {self.separator!r} is also the decimal sign, expected another"
            )
        return self


class TimeColumn(_Section):
    """When a row was measured: a column of numbers, a column of dates, or a sampling rate.

    Attributes:
        column: Column of the time, by its name or its number (from 1).
        unit: Unit of a column of numbers, such as `s` or `ms`.
        date_format: Format of a column of dates: the codes of Python's `strptime` (`%f` for
            fractions of a second), or `iso` for ISO 8601; only for text tables.
        sampling_rate_hz: Rows per second, if the table has no column of times.
    """

    column: ColumnName | None = None
    unit: Unit | None = None
    date_format: Text | None = None
    sampling_rate_hz: Positive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> "TimeColumn":
        if (self.column is None) == (self.sampling_rate_hz is None):
            raise ValueError("expected one of column and sampling_rate_hz")
        if self.column is None and (self.unit or self.date_format):
            raise ValueError("unit and date_format require a column, expected none of them")
        if self.column is not None and (self.unit is None) == (self.date_format is None):
            raise ValueError("expected one of unit and date_format with the column")
        return self


class _Channel(_Section):
    """A measured quantity: gain times reading in `unit`, converted to SI, by its calibration.

    Attributes:
        column: Column of the quantity, by its name or its number (from 1).
        unit: Unit of gain times reading.
        gain: Factor on the reading, in `unit` per unit of the table. If volts were recorded: the
            reciprocal of the sensor's sensitivity, such as 100 for 10 mV/K.
    """

    column: ColumnName
    unit: Unit
    gain: Finite = 1.0

    @property
    def calibration(self) -> Calibration:
        """From gain times reading to what is measured, in SI."""
        return Calibration()

    @model_validator(mode="after")
    def _is_not_constant(self) -> "_Channel":
        if self.gain == 0.0:
            raise ValueError("gain 0: expected another number")
        return self


class HeightChannel(_Channel):
    """A height.

    Attributes:
        unit: Unit of gain times reading, such as `mm`.
        gain: Factor on the reading, in `unit` per unit of the table. If volts were recorded: the
            reciprocal of the sensor's sensitivity, such as 20 for 0.05 V/mm.
        zero: A reading at a known length of the strut; if absent, the reading is the length.
        reversed: True if the reading falls while the strut gets longer; requires `zero`.
    """

    zero: Zero | None = None
    reversed: bool = False

    @property
    def calibration(self) -> Calibration:
        """By the zero and the direction of the sensor."""
        zero = self.zero or Zero(reads=0.0, at_m=0.0)
        return Calibration(zero.reads, zero.at_m, self.reversed)

    @model_validator(mode="after")
    def _is_a_length(self) -> "HeightChannel":
        if self.reversed and self.zero is None:
            raise ValueError("reversed: expected zero: {reads, at_m} with it")
        return self


class ForceChannel(_Channel):
    """A force.

    Attributes:
        unit: Unit of gain times reading, such as `kN` or `lbf`.
        gain: Factor on the reading, in `unit` per unit of the table. If volts were recorded: the
            reciprocal of the sensor's sensitivity, such as 500 for 2 mV/N.
        tare_n: Reading without a force, in N after the gain and the conversion of the unit and
            before a reversal.
        reversed: True if the table has the opposite sign.
    """

    tare_n: Finite = 0.0
    reversed: bool = False

    @property
    def calibration(self) -> Calibration:
        """By the tare and the direction of the cell."""
        return Calibration(self.tare_n, 0.0, self.reversed)


class TemperatureChannel(_Channel):
    """A temperature; `offset_k` is added.

    Attributes:
        unit: Unit of gain times reading, such as `degC`.
        offset_k: Offset in K that is added after the gain and the conversion of the unit.
    """

    offset_k: Finite = 0.0

    @property
    def calibration(self) -> Calibration:
        """By the offset."""
        return Calibration(0.0, self.offset_k)


class TableMapping(_Section):
    """The meaning of a foreign table.

    Attributes:
        table: Layout of a text table. Of its keys, only `first_row` and `rows` are also used for
            XLSX, TDMS and MTS files; MF4 files use none of them.
        time: Times of the rows; required except for MF4 files, whose channels have times.
        height: Height of the strut, which grows in rebound.
        applied_force: Force on the body, positive upwards (force-driven bench); this or
            `strut_force` is required.
        strut_force: Force of the load cell, positive when the strut pushes its ends apart; this or
            `applied_force` is required.
        temperature: Temperature of the damper.
    """

    table: TextLayout = TextLayout()
    time: TimeColumn | None = None
    height: HeightChannel
    applied_force: ForceChannel | None = None
    strut_force: ForceChannel | None = None
    temperature: TemperatureChannel | None = None

    @model_validator(mode="after")
    def _has_a_force(self) -> "TableMapping":
        if self.applied_force is None and self.strut_force is None:
            raise ValueError("expected applied_force or strut_force in addition to height")
        return self


def load_mapping(path: Path) -> TableMapping:
    """Read a mapping.

    Raises:
        InputError: One line that names file, key, value and what was expected.
    """
    mapping = load_yaml(TableMapping, path)
    try:
        output_columns(mapping)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return mapping


class OutputColumn(NamedTuple):
    """A column of the CSV that is written: `factor * reading + offset`.

    Attributes:
        unit: Unit of the reading, or with a gain that of gain times reading.
    """

    name: str
    key: str
    column: ColumnName
    unit: str
    has_gain: bool
    factor: float
    offset: float
    words: str


def output_columns(mapping: TableMapping) -> list[OutputColumn]:
    """The columns of the CSV that a mapping gives.

    Raises:
        InputError: A unit is unknown or of another dimension.
    """
    channels = (
        ("height_m", mapping.height, Dimension.LENGTH),
        ("applied_force_n", mapping.applied_force, Dimension.FORCE),
        ("strut_force_n", mapping.strut_force, Dimension.FORCE),
        ("temperature_c", mapping.temperature, Dimension.TEMPERATURE),
    )
    return [
        _output_column(name, channel, dimension)
        for name, channel, dimension in channels
        if channel is not None
    ]


def _output_column(name: str, channel: _Channel, dimension: Dimension) -> OutputColumn:
    key = name.rpartition("_")[0]
    conversion = unit_conversion(channel.unit, dimension, key)
    calibration = channel.calibration
    factor = calibration.sign * conversion.factor * channel.gain
    words = f"{name} = {factor:.9g} * column {channel.column!r}"
    offset = calibration.apply(conversion.offset)
    if offset:
        words += f" {'+' if offset > 0 else '-'} {abs(offset):.9g}"
    has_gain = channel.gain != 1.0
    gain = f", {channel.gain:g} {channel.unit} a reading" if has_gain else ""
    reversed_ = ", sign reversed" if calibration.is_reversed else ""
    words += f" (read in {channel.unit}{gain}{reversed_})"
    return OutputColumn(name, key, channel.column, channel.unit, has_gain, factor, offset, words)


def unit_conversion(unit: str, dimension: Dimension, key: str) -> SiConversion:
    """The conversion of readings to SI; `key` names the channel in an error.

    Raises:
        InputError: The unit is unknown or of another dimension.
    """
    try:
        return si_conversion(unit, dimension)
    except DatabaseError as error:
        raise InputError(f"{key}.unit: {error}") from error
