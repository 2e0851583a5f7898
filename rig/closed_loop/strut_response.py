"""Responses of a model and of its struts about a state, by secants."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant, ModelState
from rig.closed_loop.derivatives import central_differences
from rig.observers.error_model import ErrorModel

Array = NDArray[np.float64]

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

_SHORT_S = 1e-8
"""Time in which rates show their accelerations: what the fastest model changes meanwhile is a
ten-millionth, and what is rounded even less."""

_ROUNDING_N = 1e-6
"""Force that counts as none."""


def linearise(plant: AnyPlant, state: ModelState, inputs: Sequence[float]) -> ErrorModel:
    """Motion of a model about rest where a state has it, by secants of its laws."""
    at = np.array(plant.numbers(state))
    n, struts = (len(at) - plant.internal_states) // 2, plant.struts
    at[n:] = 0.0
    no_forces = np.zeros(struts)

    def changed(change: Array) -> ModelState:
        numbers = at.copy()
        numbers[: len(change)] += change
        return plant.state_of(numbers.tolist(), 0.0, inputs)

    def heights_m(positions: Array) -> Array:
        return np.array([height_m for height_m, _ in changed(positions).struts])

    def respond(change: Array, forces_n: Array) -> Array:
        """Accelerations of the coordinates and forces of the laws after a change."""
        loaded = plant.load(changed(change), forces_n.tolist(), inputs, AMBIENT_C)
        soon = np.array(plant.numbers(plant.step(loaded, _SHORT_S, inputs)))
        rates = (soon[n : 2 * n] - change[n:]) / _SHORT_S
        return np.concatenate([rates, loaded.forces_n])

    heights = central_differences(heights_m, [_SECANT_M] * n)
    # A coordinate that turns a long arm by a small angle moves a strut as far as one that slides.
    largest = np.abs(heights).max(axis=0, initial=0.0)
    reach = np.where(largest > 0.0, largest, 1.0)
    widths = np.concatenate([_SECANT_M / reach, USUAL_SPEED_M_PER_S / reach]).tolist()
    by_motion = central_differences(lambda u: respond(u, no_forces), widths)
    by_force = central_differences(lambda u: respond(np.zeros(2 * n), u), [_SECANT_N] * struts)[:n]
    motion, laws = by_motion[:n], by_motion[n:]
    return ErrorModel(motion - by_force @ laws, laws, by_force, heights)


def laws_by_motion(
    plant: AnyPlant, state: ModelState, inputs: Sequence[float], column: int
) -> Array:
    """Change of the forces of the struts' laws by a motion among the inputs, shape (struts, 2).

    By its position (m) and by its velocity (m/s); `column` is where the former is in the inputs.
    """
    numbers = plant.numbers(state)

    def forces_n(change: Array) -> Array:
        changed = np.array(inputs, np.float64)
        changed[column : column + 2] += change
        moved = plant.state_of(numbers, 0.0, changed.tolist())
        no_forces = (0.0,) * plant.struts
        return np.array(plant.load(moved, no_forces, changed.tolist(), AMBIENT_C).forces_n)

    return central_differences(forces_n, (_SECANT_M, USUAL_SPEED_M_PER_S))


def linearise_at(plant: AnyPlant, heights_m: Sequence[float]) -> ErrorModel:
    """Motion of a model about rest at some heights, without inputs."""
    return linearise(plant, plant.init(heights_m), (0.0,) * plant.inputs)


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
