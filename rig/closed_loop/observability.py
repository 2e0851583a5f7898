"""Which unknown forces and offsets can be observed from measured heights.

An unknown that is constant, or changes without a law, is one more state that stays where it is. It
is observable if no motion of the model explains it away: if the matrix

    [ A - 1   B ]
    [   C     D ]

has independent columns, A and C the model's map over a time and its heights, B and D what the
unknowns do to them; A, B and C by differences on the model itself.

Reference: Hautus, Controllability and observability conditions of linear autonomous systems (1969);
Francis and Wonham, The internal model principle of control theory, Automatica 12 (1976).
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant, AnySensorReader
from rig.closed_loop.derivatives import central_differences

Array = NDArray[np.float64]

_TIME_S = 0.02
"""Time of the map: long enough that it differs from one, short for a bench."""

_STEP = 1e-6
"""Of the model's numbers (m or rad, and per second): a third of the digits of a double."""

_FORCE_STEP_N = 1e-2
"""Of the forces, whose effect is linear."""

_INDEPENDENT = 1e-6
"""Least singular value of columns of unit length: a hundred times what the differences leave."""

_SEEN = 1e-4
"""Share of a sensor's change below which what is left of it is that of the differences."""


class Unknown(NamedTuple):
    """An unknown force of a strut, or an offset that adds to its measured height."""

    name: str
    strut: int
    is_offset: bool = False


class Observability(NamedTuple):
    """What is observable from measured heights.

    Attributes:
        hidden: Unknowns that are not observable at all.
        confused: Pairs of unknowns, each observable if the other is known, that cannot be
            distinguished.
        together: Whether all that are not hidden are observable at once.
    """

    hidden: tuple[Unknown, ...]
    confused: tuple[tuple[Unknown, Unknown], ...]
    together: bool


class LinearModel(NamedTuple):
    """A model about rest, from one time to another.

    Attributes:
        model: The model's numbers by those before, shape (n, n).
        by_force: The same by forces in its struts, shape (n, struts).
        heights: Heights by the model's numbers, shape (struts, n).
    """

    model: Array
    by_force: Array
    heights: Array


def linear_model(plant: AnyPlant, heights_m: Sequence[float]) -> LinearModel:
    """A model about rest at some heights of all its struts."""
    start = np.array(plant.numbers(plant.init(heights_m)))
    nothing, no_inputs = np.zeros(plant.struts), (0.0,) * plant.inputs

    def after(x: Array, forces_n: Array) -> Array:
        state = plant.state_of(x.tolist())
        loaded = plant.load(state, forces_n.tolist(), no_inputs, AMBIENT_C)
        return np.array(plant.numbers(plant.step(loaded, _TIME_S, no_inputs)))

    def heights(x: Array) -> Array:
        return np.array([height_m for height_m, _ in plant.state_of(x.tolist()).struts])

    steps = [_STEP] * len(start)
    return LinearModel(
        central_differences(lambda d: after(start + d, nothing), steps),
        central_differences(lambda d: after(start, d), [_FORCE_STEP_N] * plant.struts),
        central_differences(lambda d: heights(start + d), steps),
    )


def observability(
    linear: LinearModel, measured: Sequence[int], unknowns: Sequence[Unknown]
) -> Observability:
    """Which unknowns can be observed from the heights of the measured struts, by index."""
    model, by_force = linear.model, linear.by_force
    seen = linear.heights[list(measured)]
    columns = [_column(unknown, by_force, measured, len(seen)) for unknown in unknowns]
    base = np.vstack([model - np.eye(len(model)), seen])
    scaled: Array = base / np.maximum(np.linalg.norm(base, axis=0), 1e-300)

    def is_observable(*which: int) -> bool:
        # The model's own motion must not explain it: only what it leaves of the columns counts.
        rest: Array = np.column_stack([columns[i] / np.linalg.norm(columns[i]) for i in which])
        explained = np.linalg.lstsq(scaled, rest, rcond=1e-10)[0]
        rest = rest - scaled @ explained
        least = np.linalg.svd(rest, compute_uv=False)[-1]
        return bool(least > _INDEPENDENT)

    alone = [bool(columns[i].any()) and is_observable(i) for i in range(len(unknowns))]
    pairs = [
        (unknowns[i], unknowns[j])
        for i, j in itertools.combinations(range(len(unknowns)), 2)
        if alone[i] and alone[j] and not is_observable(i, j)
    ]
    hidden = [item for item, observed in zip(unknowns, alone, strict=True) if not observed]
    shown = [i for i, observed in enumerate(alone) if observed]
    return Observability(tuple(hidden), tuple(pairs), not shown or is_observable(*shown))


def _column(unknown: Unknown, by_force: Array, measured: Sequence[int], outputs: int) -> Array:
    """What an unknown does to the model's numbers and to the measured heights."""
    if not unknown.is_offset:
        return np.concatenate([by_force[:, unknown.strut], np.zeros(outputs)])
    to_heights = np.array([float(strut == unknown.strut) for strut in measured])
    return np.concatenate([np.zeros(len(by_force)), to_heights])


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
    start = np.array(plant.numbers(plant.init(heights_m)))
    no_inputs, no_forces = (0.0,) * plant.inputs, (0.0,) * plant.struts

    def read(x: Array) -> Array:
        loaded = plant.load(plant.state_of(x.tolist()), no_forces, no_inputs, AMBIENT_C)
        return np.array(reader.read(loaded, no_forces))

    def motion(x: Array) -> Array:
        struts = plant.state_of(x.tolist()).struts
        return np.array([struts[strut] for strut in measured]).ravel()

    steps = [_STEP] * len(start)
    rows = central_differences(lambda d: read(start + d), steps)
    seen = central_differences(lambda d: motion(start + d), steps)
    # An effect's internal state follows the motion.
    count = len(start) - plant.internal_states
    rows, seen = rows[:, :count], seen[:, :count]
    left = rows - np.linalg.lstsq(seen.T, rows.T, rcond=None)[0].T @ seen
    loaded = plant.load(plant.init(heights_m), no_forces, no_inputs, AMBIENT_C)
    gains = np.array(reader.force_gains(loaded))
    others = [strut for strut in range(plant.struts) if strut not in observed]
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-300)
    is_seen = np.linalg.norm(left, axis=1) < _SEEN * size
    largest = np.maximum(np.abs(gains).max(axis=1), 1e-300)
    is_acted_on = np.abs(gains[:, others]).max(axis=1, initial=0.0) > _SEEN * largest
    return [bool(item) for item in is_seen & ~is_acted_on]
