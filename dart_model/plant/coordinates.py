"""Joint coordinates: how they change at given rates."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dart_model.plant.dart_types import DartSkeleton

Array = NDArray[np.float64]

Move = Callable[[Array, Array, float], Array]
"""Coordinates, rates, duration (s) -> coordinates after it."""


def move_of(dart: DartSkeleton) -> Move:
    """How the coordinates of a skeleton change; rotations in space do not add up."""

    def integrate(q: Array, v: Array, h: float) -> Array:
        dart.setPositions(q)
        dart.setVelocities(v)
        dart.integratePositions(h)
        return np.array(dart.getPositions())

    for q in sample_positions(dart.getNumDofs()):
        v = np.roll(q, 1) + 1.0
        if not np.allclose(integrate(q, v, 0.5), q + 0.5 * v, rtol=0.0, atol=1e-12):
            return integrate
    return _add


def sample_positions(coordinates: int) -> list[Array]:
    """Fixed generic configurations at which constancy is tested."""
    return [0.3 * np.sin(1.0 + (k + 0.7) * np.arange(1, coordinates + 1)) for k in range(4)]


def _add(q: Array, v: Array, h: float) -> Array:
    return q + h * v
