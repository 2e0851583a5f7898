"""The record of a tick, and its columns in `steps.arrow`."""

import struct
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from msgspec import Struct

ACKNOWLEDGED, BUS_FAULT, LOG_FAULT = 1, 2, 4
"""Bits of `Step.flags`."""

END_OF_STREAM = b"\xff\xff\xff\xff\0\0\0\0"
"""Last bytes of an Arrow stream that was closed."""


class Step(Struct, frozen=True, gc=False):
    """The record of one tick.

    Attributes:
        t_ns: Time of the tick.
        overruns: Ticks missed before it.
        received: Frames received, so that a replay gives each tick the same ones.
        mode: State of the bridge.
        flags: Bit 0 acknowledged, bit 1 bus fault, bit 2 log fault.
        numbers: Measured and published values, as the log's further columns are named.
    """

    t_ns: int
    overruns: int
    received: int
    mode: int
    flags: int
    numbers: tuple[float, ...]


def step_schema(columns: Sequence[str] = ()) -> pa.Schema:
    """Arrow schema of `steps.arrow`.

    Args:
        columns: Names of `Step.numbers`.
    """
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

    Args:
        columns: Names of the numbers of a step.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        self.schema = step_schema(columns)
        self._packer = struct.Struct(f"<qiibb{len(columns)}d")
        self._columns = np.dtype(
            [
                (name, kind.to_pandas_dtype())
                for name, kind in zip(self.schema.names, self.schema.types, strict=True)
            ]
        )
        self._rows = bytearray()
        self._first_ns = 0
        self.last_ns = 0
        """Time of the last one."""
        self.count = 0
        """How many they are."""

    @property
    def span_ns(self) -> int:
        """Time from the first one to the last."""
        return self.last_ns - self._first_ns if self._rows else 0

    def append(self, step: Step) -> None:
        """Add a step."""
        if not self._rows:
            self._first_ns = step.t_ns
        self.last_ns = step.t_ns
        self.count += 1
        self._rows += self._packer.pack(
            step.t_ns, step.overruns, step.received, step.mode, step.flags, *step.numbers
        )

    def batch(self) -> pa.RecordBatch:
        """All steps as an Arrow record batch."""
        table = np.frombuffer(self._rows, self._columns)
        arrays = [pa.array(np.ascontiguousarray(table[name])) for name in self.schema.names]
        return pa.record_batch(arrays, schema=self.schema)

    def clear(self) -> None:
        """Remove all steps."""
        self._rows = bytearray()
        self.count = 0
