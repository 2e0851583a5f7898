"""How the readings of virtual sensors change with a model's motion, and what determines them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant, AnySensorReader, ModelState
from rig.closed_loop.derivatives import central_differences

Array = NDArray[np.float64]

_STEP = 1e-6
"""Of the model's numbers (m or rad, and per second): a third of the digits of a double."""

_SEEN = 1e-4
"""Share of a sensor's change below which what is left of it is that of the differences."""

_INDEPENDENT = 1e-6
"""Share of the largest singular value below which heights depend on one another."""


class SensorResponse(NamedTuple):
    """How the sensors of a model read about rest, by the motion of some of its struts.

    Attributes:
        by_heights: Readings by the heights of these struts (m), then by their rates (m/s), shape
            (sensors, 2 struts): of all motions that show them, the smallest.
        by_inputs: Readings by position (m) and velocity (m/s) of each motion among the inputs while
            the coordinates stay, shape (motions, sensors, 2).
        with_inputs: The same while heights and rates of these struts stay.
        is_determined: Whether heights and rates of these struts determine a reading.
    """

    by_heights: Array
    by_inputs: Array
    with_inputs: Array
    is_determined: NDArray[np.bool_]


def respond_to_motion(
    plant: AnyPlant,
    reader: AnySensorReader,
    state: ModelState,
    inputs: Sequence[float],
    struts: Sequence[int],
    motions: Sequence[int] = (),
) -> SensorResponse:
    """Response of a model's sensors where a state has it.

    `struts` are the indices of those whose motion is measured, `motions` the places of the motions'
    positions in the inputs.
    """
    at = np.array(plant.numbers(state))
    # An effect's internal state follows the motion.
    count = len(at) - plant.internal_states
    at[count // 2 : count] = 0.0
    no_forces = (0.0,) * plant.struts

    def moved(change: Array, further: Array) -> ModelState:
        numbers = at.copy()
        numbers[: len(change)] += change
        return plant.state_of(numbers.tolist(), 0.0, further.tolist())

    def read(change: Array, further: Array) -> Array:
        given = further.tolist()
        loaded = plant.load(moved(change, further), no_forces, given, AMBIENT_C)
        return np.array(reader.read(loaded, no_forces))

    def see(change: Array, further: Array) -> Array:
        every = moved(change, further).struts
        return np.array([every[strut] for strut in struts]).T.ravel()

    still, nothing = np.array(inputs, np.float64), np.zeros(count)

    def by_motion(function: Callable[[Array, Array], Array]) -> Array:
        return central_differences(lambda d: function(d, still), [_STEP] * count)

    def by_input(function: Callable[[Array, Array], Array], column: int) -> Array:
        places = np.eye(len(still))[column : column + 2]
        return central_differences(lambda d: function(nothing, still + d @ places), [_STEP] * 2)

    rows, seen = by_motion(read), by_motion(see)
    by_heights = rows @ np.linalg.pinv(seen, rcond=_INDEPENDENT)
    left = np.linalg.norm(rows - by_heights @ seen, axis=1)
    is_determined = left < _SEEN * np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    direct = [by_input(read, column) for column in motions]
    held = [
        rows_of_input - by_heights @ by_input(see, column)
        for rows_of_input, column in zip(direct, motions, strict=True)
    ]
    shape = (len(motions), len(rows), 2)
    return SensorResponse(
        by_heights, np.reshape(direct, shape), np.reshape(held, shape), is_determined
    )


def find_corrected(
    plant: AnyPlant,
    reader: AnySensorReader,
    heights_m: Sequence[float],
    measured: Sequence[int],
    observed: Sequence[int],
) -> list[bool]:
    """Whether each sensor of a model is determined by what is measured, about rest at some heights.

    It is where heights and rates of the measured struts, given by index, determine it, and where no
    force changes it but those of the observed struts.
    """
    state, no_inputs = plant.init(heights_m), (0.0,) * plant.inputs
    is_seen = respond_to_motion(plant, reader, state, no_inputs, measured).is_determined
    loaded = plant.load(state, (0.0,) * plant.struts, no_inputs, AMBIENT_C)
    gains = np.array(reader.force_gains(loaded))
    others = [strut for strut in range(plant.struts) if strut not in observed]
    largest = np.maximum(np.abs(gains).max(axis=1), 1e-300)
    is_acted_on = np.abs(gains[:, others]).max(axis=1, initial=0.0) > _SEEN * largest
    return [bool(item) for item in is_seen & ~is_acted_on]
