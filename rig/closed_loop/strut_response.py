"""Responses of a model's struts at rest, by secants of its accelerations."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant
from rig.closed_loop.derivatives import central_differences

_SECANT_M, USUAL_SPEED_M_PER_S = 2e-3, 0.1
"""Of the law's secants: a share of a usual stroke and speed, so that friction, which is infinitely
steep at rest, counts as it acts in motion."""

_SECANT_N = 1.0
"""Of the force, to which the response is linear."""


class StrutResponse(NamedTuple):
    """Response of the acceleration of a strut's height to that strut alone.

    It falls by stiffness and damping per metre of height and per metre per second.
    """

    mobility_per_kg: float
    stiffness_per_s2: float
    damping_per_s: float


def strut_responses(plant: AnyPlant, heights_m: Sequence[float]) -> list[StrutResponse]:
    """Responses of a model's struts at rest at some heights."""
    return [_strut_response(plant, np.asarray(heights_m), index) for index in range(plant.struts)]


def _strut_response(plant: AnyPlant, heights_m: NDArray[np.float64], index: int) -> StrutResponse:
    alone = np.eye(plant.struts)[index]

    def acceleration(u: NDArray[np.float64]) -> NDArray[np.float64]:
        force_n, height_m, velocity_m_per_s = u.tolist()
        heights, velocities = heights_m + height_m * alone, velocity_m_per_s * alone
        state = plant.init(heights.tolist(), velocities.tolist())
        loaded = plant.load(state, (force_n * alone).tolist(), 0.0, AMBIENT_C)
        return np.array([loaded.accelerations_m_per_s2[index]])

    ((mobility, stiffness, damping),) = central_differences(
        acceleration, (_SECANT_N, _SECANT_M, USUAL_SPEED_M_PER_S)
    ).tolist()
    return StrutResponse(mobility, -stiffness, -damping)
