"""The force of an FMU as a part of the mechanism: along the measured motion, and linear about it.

No compiled loop can ask an FMU. As with a tabulated mechanism, a simulation that comes to follow
the measurement follows the FMU; what is reported in the end was computed by the FMU itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from dart_model.plant import DartPlant
from dart_model.plant.fmu import MockUp
from rig.diagnosis.problem.mechanism import Mechanism
from rig.diagnosis.problem.problem import Track

Array = NDArray[np.float64]

_SECANT = 0.02
"""Share of stroke and top speed over which an FMU's slopes are taken: about what a model errs by,
so that friction has a slope as well."""
_LEAST_REACH = 1e-9
"""In m and m/s: of a strut that stands still, which is refused later with a reason."""
_LONGEST_STATE_STEP_S = 0.5e-3
"""Longest step of an FMU's internal states: that of a strut whose motion is prescribed."""


def with_mockups(mechanism: Mechanism, plant: DartPlant, motion: Track) -> Mechanism:
    """The mechanism with the forces of FMUs, along a motion and linear about it.

    Args:
        mechanism: Without them, constant or along the motion.
        plant: The model.
        motion: The measured motion, with the applied force; N nodes.
    """
    if not any(plant.mockups):
        return mechanism
    nodes = len(motion.t_s)
    m = Mechanism(*(np.repeat(part, nodes // len(part), axis=0) for part in mechanism))
    heights_m, velocities = motion.heights_m.T, motion.velocities_m_per_s.T
    q = m.q + _solved(m.jacobian, heights_m - m.heights_m)
    v = _solved(m.jacobian, velocities)
    bias = m.bias + np.einsum("kij,kj->ki", m.bias_q, q - m.q)
    bias = bias + np.einsum("kij,kj->ki", m.bias_v, v - m.v)
    bias_q, bias_v = m.bias_q, m.bias_v
    for strut, mockup in enumerate(plant.mockups):
        if mockup is not None:
            row = m.jacobian[:, strut]
            there = forces_along(mockup, strut, motion)
            square = row[:, :, np.newaxis] * row[:, np.newaxis, :]
            bias = bias + row * there[0][:, np.newaxis]
            bias_q = bias_q + square * there[1][:, np.newaxis, np.newaxis]
            bias_v = bias_v + square * there[2][:, np.newaxis, np.newaxis]
    found = m._replace(q=q, v=v, heights_m=heights_m, bias=bias, bias_q=bias_q, bias_v=bias_v)
    return Mechanism(*(np.ascontiguousarray(part) for part in found))


def forces_along(mockup: MockUp, strut: int, motion: Track) -> tuple[Array, Array, Array]:
    """Force of an FMU along a motion, and its secants by height and by velocity, each (N,).

    Its internal states begin at their start, and go by the midpoint rule.
    """
    z, w = motion.heights_m[strut], motion.velocities_m_per_s[strut]
    reach_m = max(_SECANT * float(np.ptp(z)), _LEAST_REACH)
    reach = max(_SECANT * float(np.max(np.abs(w))), _LEAST_REACH)
    found = np.empty((3, len(z)))
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
        found[0, k] = force(at)
        found[1, k] = (force(at, reach_m) - force(at, -reach_m)) / (2.0 * reach_m)
        found[2, k] = (force(at, 0.0, reach) - force(at, 0.0, -reach)) / (2.0 * reach)
        if len(states) and k + 1 < len(rows):
            steps = max(1, math.ceil((rows[k + 1, 0] - row[0]) / _LONGEST_STATE_STEP_S))
            for step in range(steps):
                begin, middle = (
                    row + (rows[k + 1] - row) * s for s in (step / steps, (step + 0.5) / steps)
                )
                h = float(rows[k + 1, 0] - row[0]) / steps
                half = states + 0.5 * h * rates(begin, states)
                states = states + h * rates(middle, half)
    return found[0], found[1], found[2]


def _solved(jacobian: Array, heights: Array) -> Array:
    """Coordinates (K, n) of heights (K, struts)."""
    return np.asarray(np.linalg.solve(jacobian, heights[..., np.newaxis])[..., 0], np.float64)
