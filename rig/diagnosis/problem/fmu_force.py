"""The force of an FMU along a measured motion, and linear about it.

No compiled loop can call an FMU. As with a tabulated mechanism, a simulation that converges to the
measurement converges to the FMU; the reported figures are computed by the FMU itself.
"""

import math

import numpy as np
from numpy.typing import NDArray

from dart_model.plant.fmu import MockUp
from rig.diagnosis.problem.grid import Track

Array = NDArray[np.float64]

_SECANT = 0.02
"""Share of stroke and top speed over which an FMU's slopes are taken: about the error of a
model, so that friction has a slope as well."""
_LEAST_REACH = 1e-9
"""Least secant in m and m/s, for a strut that stands still, which is refused later."""
_LONGEST_STATE_STEP_S = 0.5e-3
"""Longest step of an FMU's internal states: that of a strut whose motion is prescribed."""


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
