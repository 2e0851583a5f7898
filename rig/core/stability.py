"""Poles of model and observer in closed loop, found by differences on the step itself.

Nothing is known of the model but what it does: the map from one measurement to the next is
differenced at the given heights, and its eigenvalues are the discrete poles.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 3.
"""

import cmath
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.contract import AMBIENT_C, Measurement, Observer, Plant

_STEP = 1e-8
"""Step of the central differences, in units of the state: so small that no observer comes near its
limit."""


class Pole(NamedTuple):
    """A discrete pole, with what it means in continuous time.

    Attributes:
        magnitude: Distance from zero; 1 or more is unstable.
        frequency_hz: Undamped natural frequency.
        damping_ratio: 1 is aperiodic, 0 rings for ever, negative grows.
    """

    magnitude: float
    frequency_hz: float
    damping_ratio: float


def closed_loop_poles(
    plant: Plant,
    observers: Sequence[Observer],
    heights_m: Sequence[float],
    period_ns: int,
    measured_every: int,
    delay: int = 0,
) -> list[Pole]:
    """Poles of model and observers.

    Args:
        plant: The model.
        observers: One for each of its struts.
        heights_m: Strut heights at which the bench is assumed to rest.
        period_ns: Time between two ticks.
        measured_every: Ticks between two measurements; the virtual force is constant in between.
        delay: Age of a measurement when it is used, in measurement periods.

    Returns:
        Poles, the slowest to decay first.
    """
    interval_ns = period_ns * measured_every
    start = list(plant.numbers(plant.init(heights_m)))
    at_rest = [
        list(observer.numbers(observer.init(Measurement(height_m, 0))))
        for observer, height_m in zip(observers, heights_m, strict=True)
    ]
    # Where the numbers of each observer stand behind those of the plant.
    ends = list(itertools.accumulate((len(part) for part in at_rest), initial=len(start)))

    def after(x: NDArray[np.float64]) -> NDArray[np.float64]:
        numbers = x.tolist()
        model = plant.state_of(numbers[: len(start)])
        states = [
            observer.state_of(numbers[first:end])
            for observer, (first, end) in zip(observers, itertools.pairwise(ends), strict=True)
        ]
        # Model heights of earlier measurements, the newest first: what a delayed loop sees.
        past = numbers[ends[-1] :]
        virtual_n = [state.virtual_force_n for state in states]
        for _ in range(measured_every):
            loaded = plant.load(model, virtual_n, 0.0, AMBIENT_C)
            model = plant.step(loaded, period_ns * 1e-9, 0.0)
        now = [height_m for height_m, _ in model.struts]
        seen = past[-len(now) :] if delay else now
        updated: list[float] = []
        for index, (observer, state) in enumerate(zip(observers, states, strict=True)):
            velocity = model.struts[index][1]
            measured = Measurement(heights_m[index], interval_ns)
            corrected = observer.step(state, interval_ns, seen[index], velocity, measured)
            updated += observer.numbers(corrected)
        return np.array([*plant.numbers(model), *updated, *((now + past)[: len(now) * delay])])

    x = np.array([*start, *itertools.chain(*at_rest), *(list(heights_m) * delay)])
    jacobian = np.empty((len(x), len(x)))
    for index, value in enumerate(x.tolist()):
        step = _STEP * max(1.0, abs(value))
        up, down = x.copy(), x.copy()
        up[index] += step
        down[index] -= step
        jacobian[:, index] = (after(up) - after(down)) / (2.0 * step)
    poles = [_pole(complex(value), interval_ns * 1e-9) for value in np.linalg.eigvals(jacobian)]
    return sorted((pole for pole in poles if pole.magnitude > 1e-6), reverse=True)


def _pole(z: complex, interval_s: float) -> Pole:
    if abs(z) < 1e-12:
        return Pole(0.0, 0.0, 1.0)
    s = cmath.log(z) / interval_s
    natural = abs(s)
    return Pole(abs(z), natural / (2.0 * cmath.pi), -s.real / natural if natural > 0.0 else 1.0)
