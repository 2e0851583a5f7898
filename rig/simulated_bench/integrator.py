"""Integrator of the bench's equations of motion.

Reference: Hairer, Norsett, Wanner, "Solving Ordinary Differential Equations I" (1993), II.1.
"""

from typing import NamedTuple

import numpy as np

from rig.simulated_bench.compilation import Floats, jit_compile
from rig.simulated_bench.drive import BenchDrive
from rig.simulated_bench.equations_of_motion import (
    BenchMechanics,
    derivatives,
    observe,
    prescribe,
    write_inputs,
)


class RecordGrid(NamedTuple):
    """Times of the records: record k is at `k * substeps * step_s`.

    Attributes:
        substeps: Steps of the integrator between records.
        step_s: Length of a step in s.
    """

    substeps: int
    step_s: float


@jit_compile
def runge_kutta_step(
    mechanics: BenchMechanics, t_s: float, step_s: float, inputs: Floats, y: Floats, work: Floats
) -> None:
    """Advance the state by one step of the classical fourth-order method.

    Args:
        mechanics: The bench.
        t_s: Time at the start of the step in s.
        step_s: Length of the step in s.
        inputs: Inputs at start, middle and end of the step, shape (3, inputs).
        y: State, shape (states,); changed in place.
        work: Scratch, shape (5, states).
    """
    half_s = 0.5 * step_s
    derivatives(mechanics, t_s, inputs[0], y, work[0])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + half_s * work[0, j]
    derivatives(mechanics, t_s + half_s, inputs[1], work[4], work[1])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + half_s * work[1, j]
    derivatives(mechanics, t_s + half_s, inputs[1], work[4], work[2])
    for j in range(y.shape[0]):
        work[4, j] = y[j] + step_s * work[2, j]
    derivatives(mechanics, t_s + step_s, inputs[2], work[4], work[3])
    for j in range(y.shape[0]):
        slope = work[0, j] + 2.0 * (work[1, j] + work[2, j]) + work[3, j]
        y[j] += step_s / 6.0 * slope
    prescribe(mechanics, inputs[2], y)


@jit_compile
def advance(
    mechanics: BenchMechanics,
    drive: BenchDrive,
    grid: RecordGrid,
    first: int,
    y: Floats,
    records: Floats,
) -> None:
    """Write records at equal times, advancing the state to the time after the last one.

    Args:
        mechanics: The bench.
        drive: Applied force and prescribed motions.
        grid: Times of the records.
        first: Index of the first record.
        y: State at the first record, shape (states,); changed in place.
        records: Receives the records, shape
            (records, RECORD_COLUMNS * struts + RECORD_EXTRA).
    """
    work = np.zeros((5, y.shape[0]))
    inputs = np.zeros((3, 1 + 2 * mechanics.prescribed.shape[0]))
    step_s = grid.step_s
    for row in range(records.shape[0]):
        start = (first + row) * grid.substeps
        write_inputs(mechanics, drive, start * step_s, inputs[2])
        prescribe(mechanics, inputs[2], y)
        observe(mechanics, drive, start * step_s, y, records[row])
        for i in range(start, start + grid.substeps):
            inputs[0] = inputs[2]
            write_inputs(mechanics, drive, (i + 0.5) * step_s, inputs[1])
            write_inputs(mechanics, drive, (i + 1) * step_s, inputs[2])
            runge_kutta_step(mechanics, i * step_s, step_s, inputs, y, work)
