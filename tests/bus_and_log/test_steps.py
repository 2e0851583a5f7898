"""What comes back from a record batch is what was put in."""

import numpy as np
import pyarrow as pa
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from rig.log.step_columns import Step, StepRows

COLUMNS = ["temperature_c", "tyre.force_n", "suspension.force_n"]

numbers = st.floats(width=64)
steps = st.builds(
    Step,
    t_ns=st.integers(0, 2**62),
    overruns=st.integers(0, 2**31 - 1),
    received=st.integers(0, 2**31 - 1),
    mode=st.integers(0, 5),
    flags=st.integers(0, 7),
    numbers=st.tuples(*[numbers] * len(COLUMNS)),
)


def read_back(rows: StepRows) -> list[Step]:
    stream = rows.schema.serialize().to_pybytes() + rows.batch().serialize().to_pybytes()
    table = pa.ipc.open_stream(stream).read_all()
    lines = zip(*[column.to_pylist() for column in table.columns], strict=True)
    return [Step(*line[:5], tuple(line[5:])) for line in lines]


def same(a: Step, b: Step) -> bool:
    first, second = astuple(a), astuple(b)
    return first[:5] == second[:5] and np.array_equal(a.numbers, b.numbers, equal_nan=True)


@given(st.lists(steps, min_size=1, max_size=20))
def test_steps_come_back_as_they_were(given_steps):
    rows = StepRows(COLUMNS)
    for step in given_steps:
        rows.append(step)
    assert rows.count == len(given_steps)
    assert rows.span_ns == given_steps[-1].t_ns - given_steps[0].t_ns
    found = read_back(rows)
    assert all(same(a, b) for a, b in zip(found, given_steps, strict=True))
    rows.clear()
    assert (rows.count, rows.span_ns) == (0, 0)
