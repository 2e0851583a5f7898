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
from dart_model.spec import InputName
from dart_model.spec import Name as StrutName
from rig.channels.channel import Zero
from rig.channels.measured_quantities import ACCELERATION, APPLIED_FORCE, APPLIED_TORQUE, MOTION

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


class StrutHeight(HeightChannel):
    """A height of one of several struts.

    Attributes:
        less: Column of the same unit and gain that is subtracted: where positions were measured,
            the height is that of the upper end less that of the lower one.
    """

    less: ColumnName | None = None


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


class AccelerationChannel(_Channel):
    """A measured acceleration of a body that is moved.

    Attributes:
        unit: Unit of gain times reading, such as `m/s^2` or `g`.
        reversed: True if the table has the opposite sign.
    """

    reversed: bool = False

    @property
    def calibration(self) -> Calibration:
        """By the direction of the sensor."""
        return Calibration(0.0, 0.0, self.reversed)


class InputChannel(ForceChannel):
    """What drives the bench: a force, a torque, or the motion of a body.

    Attributes:
        unit: Unit of gain times reading, such as `kN`, `Nm` or `mm`.
        measures: `force`, `torque`, or `motion` of a body.
        tare_n: Only for a force: reading without a force, in N after the gain and the conversion
            of the unit and before a reversal.
        acceleration: Only for a motion: the measured acceleration of the body.
    """

    measures: Literal["force", "torque", "motion"]
    acceleration: AccelerationChannel | None = None

    @model_validator(mode="after")
    def _fits_what_it_measures(self) -> "InputChannel":
        if self.acceleration is not None and self.measures != "motion":
            raise ValueError(f"acceleration: expected none with measures: {self.measures}")
        if self.tare_n and self.measures != "force":
            raise ValueError(f"tare_n: expected none with measures: {self.measures}")
        return self


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
        height: Height of the only strut, which grows in rebound; this or `heights` is required.
        heights: Heights of several struts, by their names in the model.
        applied_force: Force on the body, positive upwards (force-driven bench); this, `inputs` or a
            strut force is required.
        inputs: What drives the bench, by the names of the model's inputs.
        strut_force: Force of the load cell, positive when the strut pushes its ends apart.
        strut_forces: The same of several struts, by their names in the model.
        temperature: Temperature of the damper.
    """

    table: TextLayout = TextLayout()
    time: TimeColumn | None = None
    height: HeightChannel | None = None
    heights: dict[StrutName, StrutHeight] = Field(default_factory=dict[str, StrutHeight])
    applied_force: ForceChannel | None = None
    inputs: dict[InputName, InputChannel] = Field(default_factory=dict[str, InputChannel])
    strut_force: ForceChannel | None = None
    strut_forces: dict[StrutName, ForceChannel] = Field(default_factory=dict[str, ForceChannel])
    temperature: TemperatureChannel | None = None

    @model_validator(mode="after")
    def _has_a_force(self) -> "TableMapping":
        if (self.height is None) == (not self.heights):
            raise ValueError("expected one of height and heights")
        if not (self.applied_force or self.strut_force or self.inputs or self.strut_forces):
            raise ValueError(
                "expected applied_force or strut_force (or inputs or strut_forces) in addition to "
                "the height"
            )
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
        subtracted_from: Name of the column from which it is subtracted instead of being written;
            empty for a column of its own.
    """

    name: str
    key: str
    column: ColumnName
    unit: str
    has_gain: bool
    factor: float
    offset: float
    words: str
    subtracted_from: str = ""


def output_columns(mapping: TableMapping) -> list[OutputColumn]:
    """The columns of the CSV that a mapping gives.

    Raises:
        InputError: A unit is unknown or of another dimension.
    """
    columns: list[OutputColumn] = []
    if mapping.height is not None:
        columns.append(_output_column("height_m", "height", mapping.height, Dimension.LENGTH))
    for strut, height in mapping.heights.items():
        name, key = f"height_m:{strut}", f"heights.{strut}"
        columns.append(_output_column(name, key, height, Dimension.LENGTH))
        if height.less is not None:
            unit = height.unit
            conversion = unit_conversion(unit, Dimension.LENGTH, key)
            factor = columns[-1].factor
            words = f"{name} less {factor:.9g} * column {height.less!r}"
            has_gain = height.gain != 1.0
            offset = conversion.offset
            columns.append(
                OutputColumn("", key, height.less, unit, has_gain, factor, offset, words, name)
            )
    if mapping.applied_force is not None:
        name, key = APPLIED_FORCE.column, APPLIED_FORCE.key
        columns.append(_output_column(name, key, mapping.applied_force, Dimension.FORCE))
    for name, item in mapping.inputs.items():
        quantity, key = _MEASURED[item.measures], f"inputs.{name}"
        columns.append(_output_column(f"{quantity.column}:{name}", key, item, quantity.dimension))
        if item.acceleration is not None:
            further, key = f"{ACCELERATION.column}:{name}", f"{key}.acceleration"
            dimension = ACCELERATION.dimension
            columns.append(_output_column(further, key, item.acceleration, dimension))
    if mapping.strut_force is not None:
        channel = mapping.strut_force
        columns.append(_output_column("strut_force_n", "strut_force", channel, Dimension.FORCE))
    for strut, channel in mapping.strut_forces.items():
        name, key = f"strut_force_n:{strut}", f"strut_forces.{strut}"
        columns.append(_output_column(name, key, channel, Dimension.FORCE))
    if mapping.temperature is not None:
        channel, dimension = mapping.temperature, Dimension.TEMPERATURE
        columns.append(_output_column("temperature_c", "temperature", channel, dimension))
    return columns


_MEASURED = {"force": APPLIED_FORCE, "torque": APPLIED_TORQUE, "motion": MOTION}
"""What an input `measures`."""


def _output_column(name: str, key: str, channel: _Channel, dimension: Dimension) -> OutputColumn:
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
