"""`steps.arrow`: the columns that the log keeps of a tick, the record of one, and a batch of them.

What it holds of a channel is declared here, what it holds of a strut are the attributes of
`rig.bridge.values.StrutOutput`; the frames of a tick are in `frames.log`.
"""

import struct
from collections.abc import Sequence
from math import nan

import numpy as np
import pyarrow as pa
from msgspec import Struct
from msgspec.structs import astuple

from rig.bridge.values import Request, StepInput, StepOutput, StrutOutput
from rig.channels.channel import Channel, Role

BUS_FAULT, LOG_FAULT, LIMITED = 2, 4, 32
REQUEST_FLAGS = {Request.ACKNOWLEDGE: 1, Request.ARM: 8, Request.DISARM: 16}
"""Bits of `Step.flags`."""

_REQUESTS = 1 | 8 | 16


def request_of(flags: int) -> Request | None:
    """What an operator requested at a tick; None for nothing."""
    return next((it for it, bit in REQUEST_FLAGS.items() if flags & _REQUESTS == bit), None)


END_OF_STREAM = b"\xff\xff\xff\xff\0\0\0\0"
"""Last bytes of an Arrow stream that was closed."""

_MEASURED = ("measured_height_m", "measured_t_ns")
_PUBLISHED = StrutOutput.__struct_fields__

STRUT_COLUMNS = (*_MEASURED, *_PUBLISHED)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is no value, but 0 for
`valid`."""


class Step(Struct, frozen=True, gc=False):
    """The record of one tick.

    received: Frames received, so that a replay gives each tick the same ones.
    flags: Bit 0 acknowledged, bit 1 bus fault, bit 2 log fault, bit 3 armed, bit 4 disarmed, bit 5
        beyond a limit.
    numbers: Measured and published values, as the log's further columns are named.
    """

    t_ns: int
    overruns: int
    received: int
    mode: int
    flags: int
    numbers: Sequence[float]


class LogColumns:
    """Columns of a run's log, and the numbers of a tick in their order.

    First stand inputs and quantities of the bench, then the struts, then the further sensors, then
    the columns of virtual ones (`virtual`), as `StepOutput.sensors` has them.
    The indices of the channels are their positions.
    """

    def __init__(
        self,
        struts: Sequence[str],
        channels: Sequence[Channel],
        virtual: Sequence[str] = (),
    ) -> None:
        bench = [channel for channel in channels if channel.role in (Role.BENCH, Role.INPUT)]
        sensors = [channel for channel in channels if channel.role is Role.SENSOR]
        first = [len(bench) + i * len(STRUT_COLUMNS) for i in range(len(struts))]
        begin_of_sensors = len(bench) + len(struts) * len(STRUT_COLUMNS)
        published = [begin + len(_MEASURED) for begin in first]
        self._published = [slice(begin, begin + len(_PUBLISHED)) for begin in published]
        self._column_of = [0] * len(channels)
        for column, channel in enumerate(bench):
            self._column_of[channel.index] = column
        for column, channel in enumerate(sensors):
            self._column_of[channel.index] = begin_of_sensors + 2 * column
        for channel in channels:
            if channel.role is Role.HEIGHT:
                self._column_of[channel.index] = first[channel.strut]
        self._is_height = [channel.role is Role.HEIGHT for channel in channels]
        self._blank = [nan] * begin_of_sensors + [nan, 0.0] * len(sensors)
        self._virtual = len(self._blank)
        self._blank += [nan] * len(virtual)
        for begin in published:  # invalid is what is sent before an estimate
            self._blank[begin + _PUBLISHED.index("valid")] = 0.0
        self.names: tuple[str, ...] = (
            *(channel.column for channel in bench),
            *(f"{strut}.{name}" for strut in struts for name in STRUT_COLUMNS),
            *(name for channel in sensors for name in (channel.column, f"{channel.name}.left_out")),
            *virtual,
        )
        """Names of the columns."""

    def numbers(self, step_input: StepInput, output: StepOutput) -> list[float]:
        """Numbers of a tick; NaN where nothing arrived or no estimate is published."""
        numbers, column_of = self._blank.copy(), self._column_of
        for sample in step_input.samples:
            column = column_of[sample.channel]
            numbers[column] = sample.value
            if self._is_height[sample.channel]:
                numbers[column + 1] = sample.t_ns
        if output.struts:
            for columns, strut in zip(self._published, output.struts, strict=True):
                numbers[columns] = astuple(strut)
        if output.sensors:
            numbers[self._virtual :] = output.sensors
        for channel in output.left_out:
            numbers[column_of[channel] + 1] = 1.0
        return numbers


def step_schema(columns: Sequence[str] = ()) -> pa.Schema:
    """Arrow schema of `steps.arrow`, with the names of `Step.numbers`."""
    fields = [
        ("t_ns", pa.int64()),
        ("overruns", pa.int32()),
        ("received", pa.int32()),
        ("mode", pa.int8()),
        ("flags", pa.int8()),
    ]
    return pa.schema([*fields, *((name, pa.float64()) for name in columns)])


class StepRows:
    """Steps on their way to a record batch of an Arrow stream.

    Each is packed at once, in a third of a microsecond: to turn a batch of Python numbers into
    columns in one go would keep the interpreter from a fast loop for longer than a tick lasts.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self.schema = step_schema(columns)
        self._pack = struct.Struct(f"<qiibb{len(columns)}d").pack
        self._columns = np.dtype(
            [
                (name, kind.to_pandas_dtype())
                for name, kind in zip(self.schema.names, self.schema.types, strict=True)
            ]
        )
        self._rows = bytearray()

    @property
    def count(self) -> int:
        """Number of steps."""
        return len(self._rows) // self._columns.itemsize

    @property
    def last_ns(self) -> int:
        """Time of the last one; 0 if there is none."""
        return self._time_at(len(self._rows) - self._columns.itemsize)

    @property
    def span_ns(self) -> int:
        """Time from the first one to the last."""
        return self.last_ns - self._time_at(0)

    def append(self, step: Step) -> None:
        """Add a step."""
        self._rows += self._pack(
            step.t_ns, step.overruns, step.received, step.mode, step.flags, *step.numbers
        )

    def _time_at(self, begin: int) -> int:
        return int.from_bytes(self._rows[begin : begin + 8], "little") if self._rows else 0

    def batch(self) -> pa.RecordBatch:
        """All steps as an Arrow record batch."""
        table = np.frombuffer(self._rows, self._columns)
        arrays = [pa.array(np.ascontiguousarray(table[name])) for name in self.schema.names]
        return pa.record_batch(arrays, schema=self.schema)

    def clear(self) -> None:
        """Remove all steps."""
        self._rows = bytearray()
