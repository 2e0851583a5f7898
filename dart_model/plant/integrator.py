"""Kutta's third-order method, and how long its steps may be; knows nothing of DART.

DART's own `World.step` is semi-implicit Euler: first order, with forces held over the step. Third
order keeps the error of the reference case far below the height's resolution at one step a
millisecond, where a second-order method would need four.

Reference: Kutta, "Beitrag zur näherungsweisen Integration totaler Differentialgleichungen" (1901);
Hairer, Nørsett, Wanner, "Solving Ordinary Differential Equations I" (1993), section II.1.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

Array = NDArray[np.float64]
Value = TypeVar("Value", float, Array)

Internal = tuple[float, ...]
"""Internal states."""

Slope = Callable[[Value, Value, Internal, float, float], tuple[Value, Sequence[float]]]
"""Coordinates, their rates, internal states, time (s), share of all steps -> second derivative of
the coordinates, derivative of the internal states. Moved coordinates and rates are written to where
the inputs have them at that share."""

Move = Callable[[Value, Value, float], Value]
"""Coordinates, rates, duration (s) -> coordinates after it."""

LONGEST_STEP_S = 1e-3
"""Steps are never longer: with 1 ms the reference case's own error is far below a height sensor's
resolution."""

SHORTEST_STEP_S = 1e-6
"""A bench that asks for shorter steps is refused: it could not be simulated in real time."""

_FREQUENCY_STEP = 0.1
"""Largest product of step and natural angular frequency. An undamped mode loses (0.1)³ π / 12, that
is 0.03 %, of its amplitude in a period, and one with a damping ratio of 0.02 is never off by more
than 0.1 % of where it began."""
_POLE_STEP = 0.5
"""Largest product of step and magnitude of a pole, for modes too strongly damped to swing."""
_STABLE_STEP = 1.6
"""The same with the steepest slopes of effects, which act within short ranges: there it is
enough that the method is stable, as it is up to 1.7 for undamped modes. A step of this length ends
the fastest motion of dry friction: 1 - 1.6 + 1.6² / 2 - 1.6³ / 6 = 0."""


class Course(Struct, frozen=True, gc=False):
    """Steps of equal length."""

    t_s: float
    duration_s: float
    steps: int


def advance(
    slope: Slope[Value],
    move: Move[Value],
    start: tuple[Value, Value, Internal],
    first: tuple[Value, Sequence[float]],
    course: Course,
) -> tuple[Value, Value, Internal]:
    """Coordinates, rates and internal states after equal steps from a start with slope `first`."""
    (q, v, internal), (a1, rates1) = start, first
    t_s, steps = course.t_s, course.steps
    h = course.duration_s / steps
    half, sixth = 0.5 * h, h / 6.0
    for step in range(1, steps + 1):
        a2, rates2 = slope(
            move(q, v, half),
            v + half * a1,
            propagate(internal, half, rates1) if internal else internal,
            t_s + half,
            (step - 0.5) / steps,
        )
        t_s += h
        a3, rates3 = slope(
            move(q, v + h * a1, h),
            v + h * (2.0 * a2 - a1),
            _extrapolate(internal, h, rates1, rates2) if internal else internal,
            t_s,
            step / steps,
        )
        # The stages' own velocities drive the coordinates.
        q = move(q, v + sixth * (a1 + 2.0 * a2), h)
        v = v + sixth * (a1 + 4.0 * a2 + a3)
        if internal:
            internal = _weigh(internal, h, rates1, rates2, rates3)
        if step < steps:
            a1, rates1 = slope(q, v, internal, t_s, step / steps)
    return q, v, internal


def propagate(internal: Internal, h: float, rates: Sequence[float]) -> Internal:
    """Internal states after a duration (s) at constant rates."""
    return tuple([state + h * rate for state, rate in zip(internal, rates, strict=True)])


def _extrapolate(
    internal: Internal, h: float, begin: Sequence[float], middle: Sequence[float]
) -> Internal:
    """Internal states of the last stage, by the rates of the first two."""
    states = zip(internal, begin, middle, strict=True)
    return tuple([state + 2.0 * h * rate2 - h * rate1 for state, rate1, rate2 in states])


def _weigh(
    internal: Internal,
    h: float,
    begin: Sequence[float],
    middle: Sequence[float],
    after: Sequence[float],
) -> Internal:
    """Internal states at the end of a step, by the rates of its stages."""
    states = zip(internal, begin, middle, after, strict=True)
    return tuple([state + h * ((r1 + 4.0 * r2 + r3) / 6.0) for state, r1, r2, r3 in states])


class Linearised(NamedTuple):
    """A bench in one configuration: ``mass @ q'' + damping @ q' + stiffness @ q = 0``, (n, n)."""

    mass: Array
    damping: Array
    stiffness: Array

    def poles(self) -> NDArray[np.complex128]:
        """Poles in rad/s, shape (2 n,)."""
        n = len(self.mass)
        matrix = np.zeros((2 * n, 2 * n))
        matrix[:n, n:] = np.eye(n)
        matrix[n:, :n] = -np.linalg.solve(self.mass, self.stiffness)
        matrix[n:, n:] = -np.linalg.solve(self.mass, self.damping)
        return np.linalg.eigvals(matrix).astype(np.complex128)

    def natural_rad_per_s(self) -> float:
        """Largest natural angular frequency, without damping."""
        values = np.linalg.eigvals(np.linalg.solve(self.mass, self.stiffness))
        return float(np.sqrt(np.max(np.abs(values))))


def exact_step_s(linear: Linearised) -> float:
    """Longest step with which the free response of a linear bench is right (see `_FREQUENCY_STEP`).

    It is not bounded by `LONGEST_STEP_S` or `SHORTEST_STEP_S`.
    """
    frequency = _FREQUENCY_STEP / max(linear.natural_rad_per_s(), 1e-9)
    return min(frequency, _POLE_STEP / _fastest_rad_per_s(linear))


def stable_step_s(linear: Linearised) -> float:
    """Longest step with which a bench stays stable at the steepest slopes of its effects."""
    return stable_for(_fastest_rad_per_s(linear))


def stable_for(fastest_rad_per_s: float) -> float:
    """The same by the magnitude of the fastest pole."""
    return _STABLE_STEP / max(fastest_rad_per_s, 1e-9)


def _fastest_rad_per_s(linear: Linearised) -> float:
    return max(float(np.max(np.abs(linear.poles()))), 1e-9)
