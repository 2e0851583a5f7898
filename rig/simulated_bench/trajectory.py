"""The bench's motion over time, as records on a regular grid."""

from typing import NamedTuple

import numpy as np

from rig.simulated_bench.assembly import Assembly, assemble
from rig.simulated_bench.compilation import Floats, Integers
from rig.simulated_bench.equations_of_motion import RECORD_COLUMNS, RECORD_EXTRA
from rig.simulated_bench.integrator import RecordGrid, advance
from rig.simulated_bench.schema import BenchConfig, BenchConfigError

NANOSECONDS = 1e-9
"""Length of a nanosecond in s."""


class BenchDivergedError(BenchConfigError):
    """The motion is no longer finite: the step is too long for this bench."""


class BenchState(NamedTuple):
    """State of the bench between two calls.

    Attributes:
        records: Number of records so far; the state is at the time of the next one.
        y: State, shape (states,).
    """

    records: int
    y: Floats


class BenchTrajectory(NamedTuple):
    """The motion of a bench on a regular grid of times; row k is at `t_ns[k]`.

    Attributes:
        t_ns: Times from the start, shape (records,).
        height_m: Height of each strut, shape (records, struts).
        velocity_m_per_s: Rate of height of each strut, shape (records, struts).
        strut_force_n: Total force of each strut, undeclared effects in it included, shape
            (records, struts).
        applied_force_n: Force that the force sensor sees, shape (records,).
        acting_force_n: Force that reaches the driven body, shape (records,).
        temperature_c: Temperature of the damper, shape (records,).
    """

    t_ns: Integers
    height_m: Floats
    velocity_m_per_s: Floats
    strut_force_n: Floats
    applied_force_n: Floats
    acting_force_n: Floats
    temperature_c: Floats


def regular_grid(config: BenchConfig, period_ns: int) -> RecordGrid:
    """Divide a period into steps no longer than the configured one."""
    substeps = -(-period_ns // config.step_ns)
    return RecordGrid(substeps, period_ns * NANOSECONDS / substeps)


def advance_records(
    assembly: Assembly, grid: RecordGrid, motion: BenchState, count: int
) -> tuple[BenchState, Floats]:
    """State of a bench after `count` records, and the records, shape (count, columns).

    Their columns are those of `rig.simulated_bench.equations_of_motion.observe`.

    Raises:
        BenchDivergedError: The motion is no longer finite.
    """
    struts = len(assembly.mechanics.ends.positions)
    records = np.empty((count, RECORD_COLUMNS * struts + RECORD_EXTRA))
    y = motion.y.copy()
    advance(assembly.mechanics, assembly.drive, grid, motion.records, y, records)
    if not np.isfinite(records).all():
        raise BenchDivergedError(
            f"the motion is not finite after {motion.records * grid.substeps * grid.step_s:g} s, "
            "expected a shorter step_ns or curves that do not drive the bench"
        )
    return BenchState(motion.records + count, y), records


def simulate(config: BenchConfig, duration_ns: int, period_ns: int = 1_000_000) -> BenchTrajectory:
    """Run a bench from its start, without sensors and bus.

    A `SimulatedBench` with the same grid goes through the same values bit for bit.

    Args:
        config: The bench.
        duration_ns: Time of the last record; rounded down to a multiple of `period_ns`.
        period_ns: Time between records.

    Raises:
        BenchConfigError: The bench has no state to start from.
        BenchDivergedError: The motion is no longer finite.
    """
    assembly = assemble(config)
    count = duration_ns // period_ns + 1
    _, records = advance_records(
        assembly, regular_grid(config, period_ns), BenchState(0, assembly.start), count
    )
    extra = RECORD_COLUMNS * len(config.struts)
    return BenchTrajectory(
        t_ns=np.arange(count, dtype=np.int64) * period_ns,
        height_m=records[:, 0:extra:RECORD_COLUMNS],
        velocity_m_per_s=records[:, 1:extra:RECORD_COLUMNS],
        strut_force_n=records[:, 2:extra:RECORD_COLUMNS],
        applied_force_n=records[:, extra],
        acting_force_n=records[:, extra + 1],
        temperature_c=records[:, extra + 2],
    )
