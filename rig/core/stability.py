"""Poles of model and observer in closed loop, found by differences on the step itself.

Nothing is known of the model but what it does: the map from one measurement to the next is
differenced at the given heights, and its eigenvalues are the discrete poles.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 3.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dart_model.plant import DartPlant
from rig.core.observer import ObserverGains, update
from rig.core.types import ObserverState


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
    plant: DartPlant,
    gains: tuple[ObserverGains, ...],
    heights_m: tuple[float, ...],
    period_ns: int,
    measured_every: int,
    delay: int = 0,
) -> list[Pole]:
    """Poles of model and observers.

    Args:
        plant: The model.
        gains: One observer a strut.
        heights_m: Strut heights at which the bench is assumed to rest.
        period_ns: Time between two ticks.
        measured_every: Ticks between two measurements; the virtual force is held in between.
        delay: Age of a measurement when it is used, in measurement periods.

    Returns:
        Poles, the slowest to decay first.
    """
    count = len(gains)
    unlimited = [replace(gain, force_limit_n=math.inf) for gain in gains]
    start = plant.initial(heights_m)
    size = plant.coordinates
    interval_ns = period_ns * measured_every

    def after(x: NDArray[np.float64]) -> NDArray[np.float64]:
        values = x.tolist()
        state = plant.state(
            tuple(values[:size]),
            tuple(values[size : 2 * size]),
            tuple(values[2 * size : 2 * size + plant.memory_size]),
            0.0,
        )
        rest = values[2 * size + plant.memory_size :]
        integrals, forces = rest[:count], rest[count : 2 * count]
        # Model heights of earlier measurements, the newest first: what a delayed loop sees.
        past = rest[2 * count :]
        for _ in range(measured_every):
            state = plant.step(plant.load(state, forces, 0.0, 20.0), period_ns * 1e-9, 0.0)
        now = [height_m for height_m, _ in state.struts]
        seen = past[-count:] if delay else now
        updated = [
            update(gain, ObserverState(integral, 0.0, 0.0, 0), height - model, interval_ns)
            for gain, integral, height, model in zip(
                unlimited, integrals, heights_m, seen, strict=True
            )
        ]
        return np.array(
            [
                *state.positions,
                *state.velocities,
                *state.memory,
                *[observer.integral_m_s for observer in updated],
                *[observer.virtual_force_n for observer in updated],
                *(now + past[: -count or None] if delay else []),
            ]
        )

    x = np.array(
        [*start.positions, *start.velocities, *start.memory, *(0.0,) * 2 * count]
        + list(heights_m) * delay
    )
    jacobian = np.empty((len(x), len(x)))
    for index, value in enumerate(x.tolist()):
        step = 1e-6 * max(1.0, abs(value))
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
