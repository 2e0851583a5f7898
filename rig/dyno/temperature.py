"""What temperature changes: forces per kelvin, where a record shows it, and what is typical."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import Figure, student_factor

TYPICAL_PER_K = 0.004
"""Relative change of a damping force per kelvin that is assumed possible where it is not known."""

FRICTION_PER_K = 0.01
"""The same of friction: seals soften as they warm."""

GAS_PER_K = 1.0 / 273.0
"""The same of a gas force: ideal gas of constant volume."""

_ALIKE_SPEED = 0.05
"""Relative difference of speed and amplitude up to which steps are repetitions of each other."""

LEAST_WARMING_K = 2.0
"""Least span of temperatures for a change per kelvin: sensors agree within one kelvin."""

_FEWEST_STROKES = 6
"""Fewest strokes for a change per kelvin."""


def apart_k(first: DynoStep | None, second: DynoStep | None) -> float:
    """How much warmer the second step is; zero where that is not known."""
    if first is None or second is None:
        return 0.0
    if first.temperature_c is None or second.temperature_c is None:
        return 0.0
    return second.temperature_c - first.temperature_c


def widen(figure: Figure, per_k: float, apart_k: float) -> Figure:
    """A figure whose interval contains a relative change per kelvin."""
    half = math.hypot(figure.half, figure.value * per_k * apart_k)
    return Figure.around(figure.value, half, figure.method)


class Warming(NamedTuple):
    """Change of a force per kelvin.

    Attributes:
        mean_n: Mean of the forces.
        squares_k2: Sum of squares of the temperatures about their mean.
    """

    slope: Figure
    mean_n: float
    squares_k2: float

    def share(self, gas: Figure) -> Figure:
        """The change over the force without gas."""
        return self.slope.scaled(1.0 / (self.mean_n - gas.value))


def change_per_kelvin(steps: Sequence[DynoStep], index: int) -> Warming | None:
    """Change of the force at peak velocity per kelvin over steps of one speed and amplitude."""
    if any(step.temperature_c is None for step in steps):
        return None
    groups: list[list[DynoStep]] = []
    for step in steps:
        alike = next((group for group in groups if _is_same_step(group[0], step)), None)
        if alike is None:
            groups.append([step])
        else:
            alike.append(step)
    found = [slope for group in groups if (slope := _slope(group, index)) is not None]
    # Not the one with the narrowest interval: that is narrow by chance as well.
    return max(found, key=lambda it: it.squares_k2, default=None)


def _is_same_step(a: DynoStep, b: DynoStep) -> bool:
    return all(
        abs(x - y) <= _ALIKE_SPEED * x
        for x, y in ((a.peak_speed_m_per_s, b.peak_speed_m_per_s), (a.amplitude_m, b.amplitude_m))
    )


def _slope(group: Sequence[DynoStep], index: int) -> Warming | None:
    """Least squares through the strokes of like steps."""
    temperatures = np.concatenate([step.warmth[index].temperature_c for step in group])
    forces = np.concatenate([step.warmth[index].force_n for step in group])
    if len(forces) < _FEWEST_STROKES or np.ptp(temperatures) < LEAST_WARMING_K:
        return None
    about = temperatures - temperatures.mean()
    slope = float(about @ forces) / float(about @ about)
    residual = forces - forces.mean() - slope * about
    freedom = len(forces) - 2
    std = float(np.sqrt(residual @ residual / freedom / (about @ about)))
    half = student_factor(freedom) * std
    speed = group[0].peak_speed_m_per_s
    text = f"line through the strokes at {speed:.3g} m/s over {np.ptp(temperatures):.1f} K"
    figure = Figure.around(slope, half, text)
    return Warming(figure, float(forces.mean()), float(about @ about))
