"""What is logged of each tick, and its columns in `steps.arrow`."""

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


def serialized(steps: Sequence[Step], schema: Any) -> bytes:
    """Steps as a record batch of an Arrow stream.

    Args:
        steps: At least one.
        schema: Their `step_schema`.
    """
    *columns, struts = zip(*steps, strict=True)
    every = [*columns, *np.array(struts, dtype=np.float64).T]
    arrays = [
        _pa.array(column, type=field.type) for column, field in zip(every, schema, strict=True)
    ]
    return bytes(_pa.RecordBatch.from_arrays(arrays, schema=schema).serialize())
