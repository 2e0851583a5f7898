"""A Kalman filter for the error of the model of one strut: what the observers predict with.

Bench and model carry the same loads but for the residual force d and the virtual force F_v, so that
the error of the model's height, x = z - z_model, obeys

    d²x/dt² = (d - F_v) / m,    m the effective mass that the strut's force moves,

whatever law the model has. The residual force is an integrated random walk of third order (the
third derivative of d is white noise): a smooth force that nothing else is known of. State: x, its
rate, and the acceleration d / m with its first two derivatives. The virtual force is a known input,
so that the filter also tells where the error stands now, when the newest measurement is some
milliseconds old.

The intensity of the noise is given as a bandwidth: of a sensor with standard deviation sigma every
h seconds, the steady filter is a Butterworth filter with the corner (q / (sigma² h))^(1/10).
Variances are in units of sigma², and sigma² itself follows the innovations.

References:
    Jazwinski, Stochastic Processes and Filtering Theory (1970), 7.
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.
    Johnson, Optimal control of the linear regulator with constant disturbances, IEEE TAC 13 (1968),
    for the disturbance as a state.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from rig.core.contract import Innovation, Start
from rig.inputs.yaml_file import Positive

Array = NDArray[np.float64]
Mean = tuple[float, float, float, float, float]

ORDER = 5
"""States: error, rate, acceleration and two derivatives of it. With three or four the reference
case's force error is 2.7 or 1.05 % of the peak at its best bandwidth, with five 0.85 %, under 20 um
of noise."""

_SETTLED = 1e-6
"""Relative distance of the variances from their limit below which the gains are constant."""

_MOST_UPDATES = 1_000_000
"""Updates until the limit is reached: bandwidths below 1e-5 of the rate take longer."""

_ACCELERATION_STD_M_PER_S2 = 30.0
"""Of the residual force over the mass, before anything was measured: three times gravity."""

_RATE_STD_M_PER_S = 1.0
"""Of the model's velocity at its start: dampers move at up to two metres a second."""

_FADING_S = 1.0
"""Time constant with which the innovations' variance is followed."""

_SMALLEST_SCALE, _LARGEST_SCALE = 1e-4, 1e4
"""Bounds of a variance that follows the innovations, over the configured one."""


class Steady(NamedTuple):
    """A filter that has run for long, at one interval; in units of sigma and 1 / omega.

    Attributes:
        gain: Gain, shape (5,).
        innovation: Variance of the innovation.
        covariance: Of the estimate after an update, shape (5, 5).
    """

    gain: Array
    innovation: float
    covariance: Array


class ErrorState(Struct, frozen=True, gc=False):
    """What is known of the model's error.

    Attributes:
        t_ns: Time of the estimate: that of the last measurement.
        mean: Error in m, its rate, acceleration of the residual force and its two derivatives, SI.
        covariance: In units of sigma and 1 / omega; None once it is steady.
        scale: Variance of the sensor over the configured one, as the innovations show it.
        inputs: Accelerations by the virtual force, and from when on; the first one from `t_ns` or
            before.
        start: What the filter was started with.
    """

    t_ns: int
    mean: Mean
    covariance: Array | None
    scale: float
    inputs: tuple[tuple[int, float], ...]
    start: Start


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class ErrorFilter:
    """The filter of one strut.

    Attributes:
        bandwidth_hz: Corner up to which the residual force is followed.
        noise_std_m: Standard deviation of the height measurement, quantisation included
            (a step over the square root of 12).
    """

    bandwidth_hz: Positive
    noise_std_m: Positive

    @property
    def omega(self) -> float:
        """Corner in rad/s."""
        return 2.0 * math.pi * self.bandwidth_hz

    def init(self, start: Start) -> ErrorState:
        """State at the model's start, at the first measured height."""
        omega, sigma = self.omega, self.noise_std_m
        rate = _RATE_STD_M_PER_S / (sigma * omega)
        acceleration = _ACCELERATION_STD_M_PER_S2 / (sigma * omega**2)
        deviations = np.array([1.0, rate, acceleration, acceleration, acceleration])
        nothing = (0.0, 0.0, 0.0, 0.0, 0.0)
        inputs = ((start.t_ns, 0.0),)
        return ErrorState(start.t_ns, nothing, np.diag(deviations**2), 1.0, inputs, start)

    def settled(self, start: Start) -> ErrorState:
        """State after a long time without an error."""
        return replace(self.init(start), covariance=None)

    def updated(self, state: ErrorState, innovation: Innovation) -> ErrorState:
        """State at a new measurement; one that is not newer than the last changes nothing.

        Args:
            state: State at the last measurement.
            innovation: Measured less model height, at the time of the measurement.
        """
        if innovation.t_ns <= state.t_ns:
            return state
        mean = _moved(state.mean, state.inputs, state.t_ns, innovation.t_ns)
        interval_ns = state.start.interval_ns
        number = max(1, round((innovation.t_ns - state.t_ns) / interval_ns))
        steady = self._steady(interval_ns)
        covariance, scale = state.covariance, state.scale
        # What is new in a measurement: its distance from the error that was predicted.
        new_m = innovation.value_m - mean[0]
        if covariance is None and number == 1:
            gain = steady.gain
            share = min(1.0, interval_ns * 1e-9 / _FADING_S)
            squared = new_m * new_m / (steady.innovation * self.noise_std_m**2)
            scale += share * (squared - scale)
            scale = min(max(scale, _SMALLEST_SCALE), _LARGEST_SCALE)
        else:
            before = steady.covariance if covariance is None else covariance
            gain, covariance = self._gain(before, number, interval_ns)
            limit = np.diagonal(steady.covariance)
            if np.all(np.abs(np.diagonal(covariance) - limit) <= _SETTLED * limit):
                covariance = None
        omega = self.omega
        physical = new_m
        corrected: list[float] = []
        for value, share_of_it in zip(mean, gain.tolist(), strict=True):
            corrected.append(value + share_of_it * physical)
            physical *= omega
        inputs = _from(state.inputs, innovation.t_ns)
        return ErrorState(
            innovation.t_ns,
            (corrected[0], corrected[1], corrected[2], corrected[3], corrected[4]),
            covariance,
            scale,
            inputs,
            state.start,
        )

    def predicted(self, state: ErrorState, t_ns: int) -> Mean:
        """Mean at a time after the last measurement.

        Beyond the time constant of the filter behind the time at which a measurement was due, a
        polynomial would run away: the error is predicted up to there.
        """
        end_ns = min(t_ns, state.t_ns + self._longest_ns(state))
        return _moved(state.mean, state.inputs, state.t_ns, end_ns)

    def acceleration_std(self, state: ErrorState, t_ns: int) -> float:
        """Standard deviation of the acceleration by the residual force, at a time, in m/s²."""
        interval_ns = state.start.interval_ns
        number = (t_ns - state.t_ns + interval_ns // 2) // interval_ns
        if state.covariance is None:
            variance = self._steady_ahead(interval_ns, number)
        else:
            variance = _ahead(state.covariance, self.omega * interval_ns * 1e-9, number)
        return math.sqrt(state.scale * variance) * self.noise_std_m * self.omega**2

    def with_input(self, state: ErrorState, t_ns: int, acceleration: float) -> ErrorState:
        """State after the virtual force has changed."""
        # Without measurements the inputs would grow in number; the prediction ends, and with it
        # what changes the virtual force.
        if t_ns - state.t_ns > self._longest_ns(state) and acceleration == state.inputs[-1][1]:
            return state
        return replace(state, inputs=(*state.inputs, (t_ns, acceleration)))

    def numbers(self, state: ErrorState) -> tuple[float, ...]:
        """What the next state depends on, all of it in m; covariance and times left out."""
        omega = self.omega
        means = [value / omega**power for power, value in enumerate(state.mean)]
        return (*means, *[acceleration / omega**2 for _, acceleration in state.inputs])

    def with_numbers(self, state: ErrorState, numbers: Sequence[float]) -> ErrorState:
        """The state with other numbers than its own, as `numbers` gives them."""
        omega = self.omega
        x, v, a, j, s = (value * omega**power for power, value in enumerate(numbers[:ORDER]))
        inputs = tuple(
            (since_ns, value * omega**2)
            for (since_ns, _), value in zip(state.inputs, numbers[ORDER:], strict=True)
        )
        return replace(state, mean=(x, v, a, j, s), inputs=inputs)

    def innovation_variance(self, interval_ns: int) -> float:
        """Variance of a steady filter's innovation, in units of the sensor's."""
        return self._steady(interval_ns).innovation

    def _longest_ns(self, state: ErrorState) -> int:
        """How long after the last measurement the error is predicted."""
        return state.start.delay_ns + 2 * state.start.interval_ns + round(1e9 / self.omega)

    def _steady(self, interval_ns: int) -> Steady:
        return _steady(self.omega * interval_ns * 1e-9)

    def _steady_ahead(self, interval_ns: int, number: int) -> float:
        return _steady_ahead(self.omega * interval_ns * 1e-9, number)

    def _gain(self, covariance: Array, number: int, interval_ns: int) -> tuple[Array, Array]:
        interval = self.omega * interval_ns * 1e-9
        return _gain(_predicted(covariance, interval, number))


def _from(inputs: tuple[tuple[int, float], ...], t_ns: int) -> tuple[tuple[int, float], ...]:
    """Those inputs that still act at a time or begin after it."""
    first = 0
    while first + 1 < len(inputs) and inputs[first + 1][0] <= t_ns:
        first += 1
    return inputs[first:]


def _moved(mean: Mean, inputs: tuple[tuple[int, float], ...], from_ns: int, to_ns: int) -> Mean:
    """The mean at a later time, under the inputs in between."""
    x, v, a, j, s = mean
    last = len(inputs) - 1
    for index, (_, by_force) in enumerate(inputs):
        end_ns = to_ns if index == last else min(inputs[index + 1][0], to_ns)
        if end_ns <= from_ns:
            continue
        h = (end_ns - from_ns) * 1e-9
        from_ns = end_ns
        b = a + by_force
        x += h * (v + h * (b / 2.0 + h * (j / 6.0 + h * s / 24.0)))
        v += h * (b + h * (j / 2.0 + h * s / 6.0))
        a += h * (j + h * s / 2.0)
        j += h * s
    return x, v, a, j, s


def _gain(ahead: Array) -> tuple[Array, Array]:
    """Gain, and covariance after an update, from the covariance before it."""
    gain = ahead[:, 0] / (ahead[0, 0] + 1.0)
    after = ahead - np.outer(gain, ahead[0])
    return gain, 0.5 * (after + after.T)


def _predicted(covariance: Array, interval: float, number: int) -> Array:
    """Covariance some intervals later; a sensor's noise is a density of one an interval."""
    transition, noise = _transition(interval * number)
    return transition @ covariance @ transition.T + interval * noise


def _ahead(covariance: Array, interval: float, number: int) -> float:
    """Variance of the acceleration some intervals later."""
    if number < 1:
        return float(covariance[2, 2])
    return float(_predicted(covariance, interval, number)[2, 2])


@lru_cache(maxsize=256)
def _transition(time: float) -> tuple[Array, Array]:
    """Transition over a time, and covariance of what unit white noise adds meanwhile."""
    transition, noise = np.eye(ORDER), np.empty((ORDER, ORDER))
    for row in range(ORDER):
        for column in range(ORDER):
            if column > row:
                transition[row, column] = time ** (column - row) / math.factorial(column - row)
            up, left = ORDER - 1 - row, ORDER - 1 - column
            power = up + left + 1
            noise[row, column] = time**power / (power * math.factorial(up) * math.factorial(left))
    return transition, noise


@lru_cache(maxsize=256)
def _steady(interval: float) -> Steady:
    """The limit of the filter's recursion, from unit covariance on.

    Args:
        interval: Time between two measurements, in units of 1 / omega.
    """
    covariance = np.eye(ORDER)
    for _ in range(_MOST_UPDATES):
        ahead = _predicted(covariance, interval, 1)
        gain, after = _gain(ahead)
        change = np.abs(np.diagonal(after) - np.diagonal(covariance))
        if np.all(change <= 0.01 * _SETTLED * interval * np.diagonal(after)):
            return Steady(gain, float(ahead[0, 0]) + 1.0, after)
        covariance = after
    raise ArithmeticError(
        f"a bandwidth of {interval / 2.0 / math.pi:g} of the rate does not settle"
    )


@lru_cache(maxsize=1024)
def _steady_ahead(interval: float, number: int) -> float:
    return _ahead(_steady(interval).covariance, interval, number)
