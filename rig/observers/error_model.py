"""How the error of a model moves: what the observers of its struts start with."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ALONE = 1e-9
"""Share of a strut's own mobility up to which another strut does not move it."""


class StrutResponse(NamedTuple):
    """Response of the acceleration of a strut's height to that strut alone.

    It falls by stiffness and damping per metre of height and per metre per second.
    """

    mobility_per_kg: float
    stiffness_per_s2: float
    damping_per_s: float


class ErrorModel(NamedTuple):
    """Motion of the free coordinates of a model about a state, in SI.

    The error is that of the bench less the model: of n coordinates, which are those that are free
    to move, and of their rates.

    Attributes:
        free: Acceleration of the coordinates by coordinates and rates but for the struts' laws,
            shape (n, 2 n).
        laws: Force of each strut's law by coordinates and rates, shape (struts, 2 n).
        by_force: Acceleration of the coordinates by a newton in each strut, shape (n, struts).
        heights: Height of each strut by the coordinates, shape (struts, n).
    """

    free: Array
    laws: Array
    by_force: Array
    heights: Array

    @property
    def mobility_per_kg(self) -> Array:
        """Acceleration of each strut's height per newton in each strut, shape (struts, struts)."""
        return self.heights @ self.by_force

    def responses(self) -> list[StrutResponse]:
        """Response of each strut, while the heights of the others stay as they are."""
        own = np.linalg.pinv(self.heights, rcond=1e-9)
        n = len(self.by_force)
        found: list[StrutResponse] = []
        for strut, (height, law) in enumerate(zip(self.heights, self.laws, strict=True)):
            direction = own[:, strut] / (height @ own[:, strut])
            acceleration = self.free + np.outer(self.by_force[:, strut], law)
            stiffness, damping = (
                -float(height @ part @ direction)
                for part in (acceleration[:, :n], acceleration[:, n:])
            )
            mobility = float(height @ self.by_force[:, strut])
            found.append(StrutResponse(mobility, stiffness, damping))
        return found

    def moves_another(self, strut: int) -> bool:
        """Whether a force in a strut moves the height of another one."""
        mobility = self.mobility_per_kg
        others = np.delete(np.abs(mobility[strut]), strut)
        return bool(np.any(others > _ALONE * abs(mobility[strut, strut])))
