"""How far a model in closed loop moves by the noise of the heights that its observers follow.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 4: the covariance of
a linear system under white noise.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.protocol import AnyPlant
from rig.closed_loop.derivatives import central_differences
from rig.closed_loop.loop import Loop, SampleTiming
from rig.observers.protocol import AnyObserver

Array = NDArray[np.float64]

_STEP = 1e-6
"""Of the model's numbers (m or rad, and per second): a third of the digits of a double."""


def motion_by_noise(
    plant: AnyPlant,
    observers: Sequence[AnyObserver],
    heights_m: Sequence[float],
    timing: SampleTiming,
    struts: Sequence[int],
) -> Array:
    """Covariances of the motion of c struts by white noise of unit variance in each one's height.

    They are of the heights (m²) and of their rates (m²/s²), about rest at some heights; shape
    (c, 2, c, c), first by whose height is noisy. They are NaN where the loop is not stable.
    """
    loop = Loop(plant, observers, heights_m, timing)
    rest = np.array(plant.numbers(plant.init(heights_m)))

    def motion(change: Array) -> Array:
        every = plant.state_of((rest + change).tolist()).struts
        return np.array([every[strut] for strut in struts]).T.ravel()

    shown = central_differences(motion, [_STEP] * len(rest))
    found: list[Array] = []
    for linear in loop.linear_each(struts):
        covariance = linear.noise_covariance()[: len(rest), : len(rest)]
        of_motion = shown @ covariance @ shown.T
        count = len(struts)
        found.append(np.array([of_motion[:count, :count], of_motion[count:, count:]]))
    return np.reshape(found, (len(struts), 2, len(struts), len(struts)))
