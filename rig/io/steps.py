"""What is logged of each tick, and its columns in `steps.arrow`."""

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa

ACKNOWLEDGED, BUS_FAULT, LOG_FAULT = 1, 2, 4
"""Bits of `Step.flags`."""

_pa = cast("Any", pa)


class Step(NamedTuple):
    """What is logged of one tick.

    Attributes:
        t_ns: Time of the tick.
        overruns: Ticks missed before it.
        received: Frames received, so that a replay gives each tick the same ones.
        mode: State of the bridge.
        flags: Bit 0 acknowledged, bit 1 bus fault, bit 2 log fault.
        applied_force_n: New applied force, NaN where none came.
        temperature_c: New temperature, NaN where none came.
        struts: Nine numbers a strut, in the order of `STRUT_COLUMNS`.
    """

    t_ns: int
    overruns: int
    received: int
    mode: int
    flags: int
    applied_force_n: float
    temperature_c: float
    struts: tuple[float, ...]


STRUT_COLUMNS = (
    "measured_height_m",
    "measured_t_ns",
    "force_n",
    "virtual_force_n",
    "valid",
    "height_m",
    "velocity_m_per_s",
    "acceleration_m_per_s2",
    "innovation_m",
)
"""Columns of each strut, prefixed with its name and a dot; NaN where there is nothing."""


def step_schema(struts: Sequence[str]) -> Any:
    """Arrow schema of `steps.arrow`."""
    fields = [
        ("t_ns", _pa.int64()),
        ("overruns", _pa.int32()),
        ("received", _pa.int32()),
        ("mode", _pa.int8()),
        ("flags", _pa.int8()),
        ("applied_force_n", _pa.float64()),
        ("temperature_c", _pa.float64()),
    ]
    fields += [(f"{strut}.{name}", _pa.float64()) for strut in struts for name in STRUT_COLUMNS]
    return _pa.schema(fields)


class StepRows:
    """Steps on their way to a record batch of an Arrow stream.

    Each is packed at once, in a third of a microsecond: to turn a batch of Python numbers into
    columns in one go would keep the interpreter from a fast loop for longer than a tick lasts.

    Args:
        struts: Names of the struts.
    """

    def __init__(self, struts: Sequence[str]) -> None:
        self.schema = step_schema(struts)
        self._packer = struct.Struct(f"<qiibbdd{len(struts) * len(STRUT_COLUMNS)}d")
        self._columns = np.dtype(
            [(field.name, field.type.to_pandas_dtype()) for field in self.schema]
        )
        self._rows = bytearray()
        self._first_ns = 0
        self.last_ns = 0
        """Time of the last one."""

    def __len__(self) -> int:
        return len(self._rows) // self._packer.size

    @property
    def span_ns(self) -> int:
        """Time from the first one to the last."""
        return self.last_ns - self._first_ns if self._rows else 0

    def append(self, step: Step) -> None:
        """Add a step."""
        if not self._rows:
            self._first_ns = step.t_ns
        self.last_ns = step.t_ns
        self._rows += self._packer.pack(*step[:-1], *step.struts)

    def serialized(self) -> bytes:
        """All steps as a record batch."""
        table = np.frombuffer(self._rows, self._columns)
        arrays = [_pa.array(np.ascontiguousarray(table[name])) for name in self.schema.names]
        batch = _pa.RecordBatch.from_arrays(arrays, schema=self.schema)
        return bytes(batch.serialize())

    def clear(self) -> None:
        """Begin anew."""
        self._rows = bytearray()
