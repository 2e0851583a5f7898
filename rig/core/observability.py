"""What measured heights can tell of unknown forces and offsets, and what they cannot.

An unknown that is constant, or changes without a law, is one more state that stays where it is. It
can be told if no motion of the model explains it away: if the matrix

    [ A - 1   B ]
    [   C     D ]

has independent columns, A and C the model's map over a time and its heights, B and D what the
unknowns do to them; A, B and C by differences on the model itself.

Reference: Hautus, Controllability and observability conditions of linear autonomous systems (1969);
Francis and Wonham, The internal model principle of control theory, Automatica 12 (1976).
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from rig.core.contract import AMBIENT_C, Plant

Array = NDArray[np.float64]

_TIME_S = 0.02
"""Time of the map: long enough that it differs from one, short for a bench."""

_STEP = 1e-6
_FORCE_STEP_N = 1e-2
_INDEPENDENT = 1e-6
"""Least singular value of columns of unit length: a hundred times what the differences leave."""


class Unknown(NamedTuple):
    """Something that is not known.

    Attributes:
        name: What it is, as a phrase.
        strut: Index of the strut that it is of.
        is_offset: Whether it adds to the strut's measured height, and not to its force.
    """

    name: str
    strut: int
    is_offset: bool = False


class Verdict(NamedTuple):
    """What measured heights tell.

    Attributes:
        hidden: Unknowns that they do not tell at all.
        confused: Pairs of unknowns, each told if the other is known, that they do not tell apart.
        together: Whether they tell all at once that is not hidden.
    """

    hidden: tuple[Unknown, ...]
    confused: tuple[tuple[Unknown, Unknown], ...]
    together: bool


def observability(
    plant: Plant, heights_m: Sequence[float], measured: Sequence[int], unknowns: Sequence[Unknown]
) -> Verdict:
    """What the heights of some struts tell of unknowns, about a model at rest.

    Args:
        plant: The model.
        heights_m: Heights of all struts at rest.
        measured: Indices of the struts whose heights are measured.
        unknowns: What is asked.
    """
    model, by_force, seen = _linear(plant, heights_m)
    seen = seen[list(measured)]
    columns = [_column(unknown, by_force, measured, len(seen)) for unknown in unknowns]
    base = np.vstack([model - np.eye(len(model)), seen])

    def is_told(*which: int) -> bool:
        # The model's own motion must not explain it: only what it leaves of the columns counts.
        rest: Any = np.column_stack([columns[i] / np.linalg.norm(columns[i]) for i in which])
        scaled = base / np.maximum(np.linalg.norm(base, axis=0), 1e-300)
        explained: Any = cast("Any", np.linalg.lstsq)(scaled, rest, rcond=1e-10)[0]
        rest = rest - scaled @ explained
        least = cast("Any", np.linalg.svd)(rest, compute_uv=False)[-1]
        return bool(least > _INDEPENDENT)

    alone = [bool(columns[i].any()) and is_told(i) for i in range(len(unknowns))]
    pairs = [
        (unknowns[i], unknowns[j])
        for i, j in itertools.combinations(range(len(unknowns)), 2)
        if alone[i] and alone[j] and not is_told(i, j)
    ]
    hidden = [item for item, told in zip(unknowns, alone, strict=True) if not told]
    shown = [i for i, told in enumerate(alone) if told]
    return Verdict(tuple(hidden), tuple(pairs), not shown or is_told(*shown))


def _column(unknown: Unknown, by_force: Array, measured: Sequence[int], outputs: int) -> Array:
    """What an unknown does to the model's numbers and to the measured heights."""
    if not unknown.is_offset:
        return np.concatenate([by_force[:, unknown.strut], np.zeros(outputs)])
    to_heights = np.array([float(strut == unknown.strut) for strut in measured])
    return np.concatenate([np.zeros(len(by_force)), to_heights])


def _linear(plant: Plant, heights_m: Sequence[float]) -> tuple[Array, Array, Array]:
    """Map of the model's numbers over a time, what forces in struts add, and heights by numbers."""
    start = np.array(plant.numbers(plant.init(heights_m)))
    nothing = np.zeros(plant.struts)

    def after(x: Array, forces_n: Array) -> Array:
        state = plant.state_of(x.tolist())
        loaded = plant.load(state, forces_n.tolist(), 0.0, AMBIENT_C)
        return np.array(plant.numbers(plant.step(loaded, _TIME_S, 0.0)))

    def heights(x: Array) -> Array:
        return np.array([height_m for height_m, _ in plant.state_of(x.tolist()).struts])

    def slopes(function: Callable[[Array], Array], count: int, step: float) -> Array:
        changed = [step * row for row in np.eye(count)]
        return np.column_stack([(function(d) - function(-d)) / (2.0 * step) for d in changed])

    size = len(start)
    model = slopes(lambda d: after(start + d, nothing), size, _STEP)
    by_force = slopes(lambda d: after(start, d), plant.struts, _FORCE_STEP_N)
    return model, by_force, slopes(lambda d: heights(start + d), size, _STEP)
