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

FAST_SPEED_M_PER_S = 0.5
"""Speed beyond the knee of nearly every damper, at which a loop has to be stable, too, where no run
shows how fast its bench is."""

_SPEEDS_M_PER_S = np.geomspace(0.05, 10.0, 24)
"""At which a strut has to dissipate: from a slow motion to three times that of a fast bench."""

_SECANT_N = 1.0
"""Of the force, to which the response is linear."""

_ROUNDING_N = 1e-6
"""Force that counts as none."""


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


def mobility_matrix(plant: AnyPlant, heights_m: Sequence[float]) -> NDArray[np.float64]:
    """Acceleration of each strut's height per newton in each strut, in 1/kg, (struts, struts).

    At rest at some heights; NaN for a strut that stands where the others put it.
    """
    state, no_inputs = plant.init(heights_m), (0.0,) * plant.inputs

    def accelerations(forces_n: NDArray[np.float64]) -> NDArray[np.float64]:
        loaded = plant.load(state, forces_n.tolist(), no_inputs, AMBIENT_C)
        return np.array(loaded.accelerations_m_per_s2)

    free = accelerations(np.zeros(plant.struts))
    return np.column_stack([accelerations(unit) - free for unit in np.eye(plant.struts)])


def _strut_response(plant: AnyPlant, heights_m: NDArray[np.float64], index: int) -> StrutResponse:
    alone, no_inputs = np.eye(plant.struts)[index], (0.0,) * plant.inputs

    def acceleration(u: NDArray[np.float64]) -> NDArray[np.float64]:
        force_n, height_m, velocity_m_per_s = u.tolist()
        heights, velocities = heights_m + height_m * alone, velocity_m_per_s * alone
        state = plant.init(heights.tolist(), velocities.tolist())
        loaded = plant.load(state, (force_n * alone).tolist(), no_inputs, AMBIENT_C)
        return np.array([loaded.accelerations_m_per_s2[index]])

    ((mobility, stiffness, damping),) = central_differences(
        acceleration, (_SECANT_N, _SECANT_M, USUAL_SPEED_M_PER_S)
    ).tolist()
    return StrutResponse(mobility, -stiffness, -damping)


def find_driving_speeds_m_per_s(plant: AnyPlant, heights_m: Sequence[float]) -> list[float | None]:
    """The lowest speed of each strut at which its force drives the motion; None without one.

    The force at a velocity, less that at rest, has to be against it in a passive strut (van der
    Schaft, L2-Gain and Passivity Techniques in Nonlinear Control, 2017, 2).
    """
    return [_find_driving_speed(plant, heights_m, index) for index in range(plant.struts)]


def _find_driving_speed(plant: AnyPlant, heights_m: Sequence[float], index: int) -> float | None:
    def force_n(velocity_m_per_s: float) -> float:
        velocities = (velocity_m_per_s * np.eye(plant.struts)[index]).tolist()
        state = plant.init(list(heights_m), velocities)
        no_inputs = (0.0,) * plant.inputs
        return plant.load(state, [0.0] * plant.struts, no_inputs, AMBIENT_C).forces_n[index]

    rest_n = force_n(0.0)
    for speed in _SPEEDS_M_PER_S.tolist():
        if force_n(speed) > rest_n + _ROUNDING_N or force_n(-speed) < rest_n - _ROUNDING_N:
            return speed
    return None
