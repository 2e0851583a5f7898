"""The force of an FMU as a part of the mechanism: along the measured motion, and linear about it.

No compiled loop can call an FMU. As with a tabulated mechanism, a simulation that converges to the
measurement converges to the FMU; the reported figures are computed by the FMU itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from dart_model.plant import DartPlant
from dart_model.plant.fmu import MockUp
from rig.diagnosis.problem.grid import Track
from rig.diagnosis.problem.mechanism import (
    LinearisedMechanism,
    MechanismPlants,
    constant_mechanism,
    tabulate_mechanism,
)

Array = NDArray[np.float64]

_SECANT = 0.02
"""Share of stroke and top speed over which an FMU's slopes are taken: about the error of a
model, so that friction has a slope as well."""
_LEAST_REACH = 1e-9
"""Least secant in m and m/s, for a strut that stands still, which is refused later."""
_LONGEST_STATE_STEP_S = 0.5e-3
"""Longest step of an FMU's internal states: that of a strut whose motion is prescribed."""


def mechanism_along(plants: MechanismPlants, motion: Track) -> LinearisedMechanism:
    """The mechanism along a measured motion: constant where it can be, and with FMUs' forces."""
    if plants.plain.is_constant:
        mechanism = constant_mechanism(plants)
    else:
        mechanism = tabulate_mechanism(plants, motion.heights_m.T, motion.velocities_m_per_s.T)
    return _with_mockups(mechanism, plants.plain, motion)


def _with_mockups(
    mechanism: LinearisedMechanism, plant: DartPlant, motion: Track
) -> LinearisedMechanism:
    """The mechanism with the forces of FMUs, along a motion and linear about it.

    Args:
        mechanism: Without them, constant or along the motion.
        plant: The model.
        motion: The measured motion, with the applied force; N nodes.
    """
    if not any(plant.mockups):
        return mechanism
    nodes = len(motion.t_s)
    m = LinearisedMechanism(*(np.repeat(part, nodes // len(part), axis=0) for part in mechanism))
    heights_m, velocities = motion.heights_m.T, motion.velocities_m_per_s.T
    q = m.q + _solve_coordinates(m.jacobian, heights_m - m.heights_m)
    v = _solve_coordinates(m.jacobian, velocities)
    bias = m.bias + np.einsum("kij,kj->ki", m.bias_q, q - m.q)
    bias = bias + np.einsum("kij,kj->ki", m.bias_v, v - m.v)
    bias_q, bias_v = m.bias_q, m.bias_v
    for strut, mockup in enumerate(plant.mockups):
        if mockup is not None:
            row = m.jacobian[:, strut]
            force_n, by_height, by_velocity = forces_along(mockup, strut, motion)
            square = row[:, :, np.newaxis] * row[:, np.newaxis, :]
            bias = bias + row * force_n[:, np.newaxis]
            bias_q = bias_q + square * by_height[:, np.newaxis, np.newaxis]
            bias_v = bias_v + square * by_velocity[:, np.newaxis, np.newaxis]
    linearised = m._replace(q=q, v=v, heights_m=heights_m, bias=bias, bias_q=bias_q, bias_v=bias_v)
    return LinearisedMechanism(*(np.ascontiguousarray(part) for part in linearised))


def forces_along(mockup: MockUp, strut: int, motion: Track) -> tuple[Array, Array, Array]:
    """Force of an FMU along a motion, and its secants by height and by velocity, each (N,).

    Its internal states begin at their start, and are integrated by the midpoint rule.
    """
    z, w = motion.heights_m[strut], motion.velocities_m_per_s[strut]
    reach_m = max(_SECANT * float(np.ptp(z)), _LEAST_REACH)
    reach = max(_SECANT * float(np.max(np.abs(w))), _LEAST_REACH)
    forces = np.empty((3, len(z)))
    states = np.zeros(len(mockup.state_scales))
    rows = np.column_stack([motion.t_s, z, w, motion.applied_n, motion.temperature_c])

    def rates(given: Array, own: Array) -> Array:
        out = [0.0] * len(own)
        mockup.rate(*given.tolist(), own.tolist(), (), (), out)
        return np.array(out)

    def force(given: list[float], dz: float = 0.0, dw: float = 0.0) -> float:
        t_s, height_m, velocity, *others = given
        return mockup.force(t_s, height_m + dz, velocity + dw, *others, states.tolist())

    for k, row in enumerate(rows):
        at = row.tolist()
        forces[0, k] = force(at)
        forces[1, k] = (force(at, reach_m) - force(at, -reach_m)) / (2.0 * reach_m)
        forces[2, k] = (force(at, 0.0, reach) - force(at, 0.0, -reach)) / (2.0 * reach)
        if len(states) and k + 1 < len(rows):
            steps = max(1, math.ceil((rows[k + 1, 0] - row[0]) / _LONGEST_STATE_STEP_S))
            for step in range(steps):
                begin, middle = (
                    row + (rows[k + 1] - row) * s for s in (step / steps, (step + 0.5) / steps)
                )
                h = float(rows[k + 1, 0] - row[0]) / steps
                half = states + 0.5 * h * rates(begin, states)
                states = states + h * rates(middle, half)
    return forces[0], forces[1], forces[2]


def _solve_coordinates(jacobian: Array, heights: Array) -> Array:
    """Coordinates (K, n) of heights (K, struts), about the reference."""
    return np.asarray(np.linalg.solve(jacobian, heights[..., np.newaxis])[..., 0], np.float64)
