"""Poles of model and observer in closed loop.

Reference: Åström and Wittenmark, "Computer-Controlled Systems" (1997), chapter 3.
"""

import cmath
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.protocol import AnyPlant
from rig.closed_loop.loop import POLE_ROUNDING, Loop, SampleTiming
from rig.observers.error_model import ErrorModel
from rig.observers.protocol import AnyObserver


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


class OperatingPoint(NamedTuple):
    """A motion about which a loop is made linear.

    Attributes:
        heights_m: Height of each strut.
        speed_m_per_s: Speed of each strut, in both directions.
    """

    heights_m: Sequence[float]
    speed_m_per_s: float


def least_damping(
    plant: AnyPlant,
    observers: Sequence[AnyObserver],
    timing: SampleTiming,
    assumed: ErrorModel,
    points: Sequence[OperatingPoint],
) -> tuple[float, OperatingPoint | None]:
    """The least damping ratio of a loop at several points, and that point; 1 without a point.

    The observers take the model to move in the same way everywhere; its stops and the knees of its
    damper are in the model alone. A ratio below zero is an error that grows.
    """
    least: tuple[float, OperatingPoint | None] = 1.0, None
    for point in points:
        loop = Loop(plant, observers, point.heights_m, timing, assumed)
        poles = poles_of(loop.linear(0, point.speed_m_per_s).a, timing.interval_ns * 1e-9)
        ratio = least_damping_ratio(poles)
        if ratio < least[0]:
            least = ratio, point
    return least


def least_damping_ratio(poles: Sequence[Pole]) -> float:
    """Least damping ratio; 1 without a pole."""
    return min((pole.damping_ratio for pole in poles), default=1.0)


def is_stable(poles: Sequence[Pole]) -> bool:
    """Whether no error grows."""
    return all(pole.magnitude <= 1.0 for pole in poles)


def closed_loop_poles(
    plant: AnyPlant,
    observers: Sequence[AnyObserver],
    heights_m: Sequence[float],
    timing: SampleTiming,
) -> list[Pole]:
    """Poles of model and observers about rest at some heights, the slowest to decay first."""
    loop = Loop(plant, observers, heights_m, timing)
    return poles_of(loop.linear().a, timing.interval_ns * 1e-9)


def poles_of(a: NDArray[np.float64], interval_s: float) -> list[Pole]:
    """Poles of a discrete map of shape (n, n) over an interval, the slowest to decay first.

    A pole at 1, by the memory of friction or an integrator that is switched off, harms nothing, and
    is aperiodic.
    """
    poles = [_pole(complex(value), interval_s) for value in np.linalg.eigvals(a)]
    return sorted((pole for pole in poles if pole.magnitude > 1e-6), reverse=True)


def _pole(z: complex, interval_s: float) -> Pole:
    if abs(z) < 1e-12:
        return Pole(0.0, 0.0, 1.0)
    if abs(z - 1.0) < POLE_ROUNDING:
        return Pole(1.0, 0.0, 1.0)
    s = cmath.log(z) / interval_s
    natural = abs(s)
    return Pole(abs(z), natural / (2.0 * cmath.pi), -s.real / natural)
