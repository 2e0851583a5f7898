"""A Kalman filter for the error of the model of one strut: what the observers predict with.

Bench and model carry the same loads but for the residual force d and the virtual force F_v, so that
the error of the model's height, x = z - z_model, obeys

    m d²x/dt² = d - F_v - k x - c dx/dt,

m the effective mass that the strut's force moves, k and c the slopes of the model's own law, which
is not where the bench is. The residual force is an integrated random walk of third order (the
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
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.linalg import expm  # pyright: ignore[reportUnknownVariableType]

from rig.core.contract import Innovation, Start

Array = NDArray[np.float64]
Mean = tuple[float, float, float, float, float]

ORDER = 5
"""States: error, rate, acceleration by the residual force and two derivatives of it. With three or
four the reference case's force error is 2.7 or 1.05 % of the peak at its best bandwidth, with five
0.85 %, under 20 um of noise."""

_SETTLED = 1e-6
"""Relative distance of the variances from their limit below which the gains are constant."""

_MOST_DOUBLINGS = 60
"""Of the recursion for the limit: more updates than any run has."""

_ACCELERATION_STD_M_PER_S2 = 30.0
"""Of the residual force over the mass, before anything was measured: three times gravity."""

_RATE_STD_M_PER_S = 1.0
"""Of the model's velocity at its start: dampers move at up to two metres a second."""

_LOWEST_HZ, _HIGHEST_HZ = 0.01, 1e4
_LEAST_STD_M, _LARGEST_STD_M = 1e-12, 1.0
"""Bounds of what a filter can be asked for."""

_NOTHING: Mean = (0.0, 0.0, 0.0, 0.0, 0.0)

_FORGOTTEN = 20.0
"""Time without a measurement, in units of 1 / omega, after which what was known is worth nothing: a
polynomial of third order is 20³ times as uncertain as at one."""

_STEP_OF_MODEL = 0.5
"""Of a step of the mean, in radians or time constants of the model's own law: a ten-thousandth of
its change is left out."""

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
        residual: Variance of the residual force's acceleration after an update.
    """

    gain: Array
    innovation: float
    covariance: Array
    residual: float


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
        steady: What its variances come to.
    """

    t_ns: int
    mean: Mean
    covariance: Array | None
    scale: float
    inputs: tuple[tuple[int, float], ...]
    start: Start
    steady: Steady


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class ErrorFilter:
    """The filter of one strut.

    Attributes:
        bandwidth_hz: Corner up to which the residual force is followed.
        noise_std_m: Standard deviation of the height measurement, quantisation included
            (a step over the square root of 12).
    """

    bandwidth_hz: Annotated[float, Field(ge=_LOWEST_HZ, le=_HIGHEST_HZ)]
    noise_std_m: Annotated[float, Field(ge=_LEAST_STD_M, le=_LARGEST_STD_M)]

    @classmethod
    def within(cls, bandwidth_hz: float, noise_std_m: float) -> "ErrorFilter":
        """The filter whose values are the nearest within their bounds."""
        return cls(
            bandwidth_hz=min(max(bandwidth_hz, _LOWEST_HZ), _HIGHEST_HZ),
            noise_std_m=min(max(noise_std_m, _LEAST_STD_M), _LARGEST_STD_M),
        )

    @property
    def omega(self) -> float:
        """Corner in rad/s."""
        return 2.0 * math.pi * self.bandwidth_hz

    def init(self, start: Start) -> ErrorState:
        """State at the model's start, at the first measured height."""
        steady, inputs = _steady(self.pace(start)), ((start.t_ns, 0.0),)
        return ErrorState(start.t_ns, _NOTHING, self._prior(), 1.0, inputs, start, steady)

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
        interval_ns, steady = state.start.interval_ns, state.steady
        if forget(self, state, innovation.t_ns):
            return self.anew(state, innovation)
        mean = moved(state, innovation.t_ns)
        number = max(1, round((innovation.t_ns - state.t_ns) / interval_ns))
        covariance, scale = state.covariance, state.scale
        # What is new in a measurement: its distance from the error that was predicted.
        new_m = innovation.value_m - mean[0]
        if covariance is None and number == 1:
            gain = steady.gain
            squared = new_m * new_m / (steady.innovation * self.noise_std_m**2)
            scale = self.rescaled(scale, squared, interval_ns)
        else:
            before = steady.covariance if covariance is None else covariance
            gain, covariance = _gain(spread(before, self.pace(state.start), number))
            limit = np.diagonal(steady.covariance)
            if np.all(np.abs(np.diagonal(covariance) - limit) <= _SETTLED * limit):
                covariance = None
        return ErrorState(
            innovation.t_ns,
            corrected(mean, gain.tolist(), new_m, self.omega),
            covariance,
            scale,
            since(state.inputs, innovation.t_ns),
            state.start,
            steady,
        )

    def anew(self, state: ErrorState, innovation: Innovation) -> ErrorState:
        """State at a measurement before which nothing is known any more."""
        return replace(
            state,
            t_ns=innovation.t_ns,
            mean=(innovation.value_m, 0.0, 0.0, 0.0, 0.0),
            covariance=self._prior(),
            inputs=since(state.inputs, innovation.t_ns),
        )

    def rescaled(self, scale: float, squared: float, interval_ns: int) -> float:
        """The variances' scale after a measurement whose squared innovation is over its variance.

        Args:
            scale: The scale before.
            squared: That ratio, one on average where the variances are right.
            interval_ns: Time between two measurements.
        """
        scale += min(1.0, interval_ns * 1e-9 / _FADING_S) * (squared - scale)
        return min(max(scale, _SMALLEST_SCALE), _LARGEST_SCALE)

    def predicted(self, state: ErrorState, t_ns: int) -> Mean:
        """Mean at a time after the last measurement.

        Beyond the time constant of the filter behind the time at which a measurement was due, a
        polynomial would run away: the error is predicted up to there.
        """
        end_ns = min(t_ns, state.t_ns + self._longest_ns(state))
        return moved(state, end_ns)

    def residual(self, state: ErrorState, mean: Mean) -> float:
        """Acceleration by the force that the model lacks where it is now, in m/s².

        Args:
            state: The state.
            mean: Of now, from `predicted`.
        """
        x, v, a, *_ = mean
        return a - state.start.stiffness_per_s2 * x - state.start.damping_per_s * v

    def residual_std(self, state: ErrorState, t_ns: int) -> float:
        """Standard deviation of `residual`, at a time, in m/s²."""
        interval_ns = state.start.interval_ns
        longest_ns = round(_FORGOTTEN / self.omega * 1e9)
        number = (min(t_ns - state.t_ns, longest_ns) + interval_ns // 2) // interval_ns
        if state.covariance is not None:
            variance = _ahead(state.covariance, self.pace(state.start), number)
        elif number < 1:
            variance = state.steady.residual
        else:
            variance = _steady_ahead(self.pace(state.start), number)
        std = math.sqrt(state.scale * max(variance, 0.0))
        return std * self.noise_std_m * self.omega**2

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

    def _longest_ns(self, state: ErrorState) -> int:
        """How long after the last measurement the error is predicted."""
        return state.start.delay_ns + 2 * state.start.interval_ns + round(1e9 / self.omega)

    def pace(self, start: Start) -> "Pace":
        """What the variances depend on."""
        omega = self.omega
        return Pace(
            omega * start.interval_ns * 1e-9,
            start.stiffness_per_s2 / omega**2,
            start.damping_per_s / omega,
        )

    def _prior(self) -> Array:
        """Covariance before anything was measured."""
        omega, sigma = self.omega, self.noise_std_m
        rate = _RATE_STD_M_PER_S / (sigma * omega)
        acceleration = _ACCELERATION_STD_M_PER_S2 / (sigma * omega**2)
        return np.diag(np.array([1.0, rate, acceleration, acceleration, acceleration]) ** 2)


class Pace(NamedTuple):
    """What the variances depend on, in units of 1 / omega.

    Attributes:
        interval: Time between two measurements.
        stiffness: Of the model's law over the mass.
        damping: Of the model's law over the mass.
    """

    interval: float
    stiffness: float = 0.0
    damping: float = 0.0


def forget(follower: ErrorFilter, state: ErrorState, t_ns: int) -> bool:
    """Whether the last measurement lies so far back that it says nothing of a time."""
    return (t_ns - state.t_ns) * 1e-9 * follower.omega > _FORGOTTEN


def corrected(mean: Mean, gain: Sequence[float], new_m: float, omega: float) -> Mean:
    """The mean after an update; the gain is in units of sigma and 1 / omega."""
    x, v, a, j, s = mean
    of_x, of_v, of_a, of_j, of_s = gain
    squared = omega * omega
    return (
        x + of_x * new_m,
        v + of_v * new_m * omega,
        a + of_a * new_m * squared,
        j + of_j * new_m * squared * omega,
        s + of_s * new_m * squared * squared,
    )


def since(inputs: tuple[tuple[int, float], ...], t_ns: int) -> tuple[tuple[int, float], ...]:
    """Those inputs that still act at a time or begin after it."""
    first = 0
    while first + 1 < len(inputs) and inputs[first + 1][0] <= t_ns:
        first += 1
    return inputs[first:]


def moved(state: ErrorState, to_ns: int) -> Mean:
    """The mean at a later time, under the inputs in between."""
    mean, inputs, from_ns = state.mean, state.inputs, state.t_ns
    start, last = state.start, len(inputs) - 1
    for index, (_, by_force) in enumerate(inputs):
        end_ns = to_ns if index == last else min(inputs[index + 1][0], to_ns)
        if end_ns <= from_ns:
            continue
        h = (end_ns - from_ns) * 1e-9
        from_ns = end_ns
        # A step in which the model itself hardly moves: what its law does is a Taylor series.
        quick = h * max(abs(start.damping_per_s), math.sqrt(abs(start.stiffness_per_s2)))
        if quick <= _STEP_OF_MODEL:
            mean = _stepped(mean, by_force, h, start)
            continue
        count = math.ceil(quick / _STEP_OF_MODEL)
        for _ in range(count):
            mean = _stepped(mean, by_force, h / count, start)
    return mean


def _stepped(mean: Mean, by_force: float, h: float, start: Start) -> Mean:
    """The mean after a step, to the fifth order of the error's Taylor series."""
    x, v, a, j, s = mean
    stiffness, damping = start.stiffness_per_s2, start.damping_per_s
    x2 = a + by_force - stiffness * x - damping * v
    x3 = j - stiffness * v - damping * x2
    x4 = s - stiffness * x2 - damping * x3
    x5 = -stiffness * x3 - damping * x4
    return (
        x + h * (v + h * (x2 / 2.0 + h * (x3 / 6.0 + h * (x4 / 24.0 + h * x5 / 120.0)))),
        v + h * (x2 + h * (x3 / 2.0 + h * (x4 / 6.0 + h * x5 / 24.0))),
        a + h * (j + h * s / 2.0),
        j + h * s,
        s,
    )


def _gain(ahead: Array) -> tuple[Array, Array]:
    """Gain, and covariance after an update, from the covariance before it."""
    gain = ahead[:, 0] / (ahead[0, 0] + 1.0)
    after = ahead - np.outer(gain, ahead[0])
    return gain, 0.5 * (after + after.T)


def spread(covariance: Array, pace: Pace, number: float) -> Array:
    """Covariance some intervals later; a sensor's noise is a density of one an interval."""
    transition, noise = _transition(pace.interval * number, pace.stiffness, pace.damping)
    return transition @ covariance @ transition.T + pace.interval * noise


def _ahead(covariance: Array, pace: Pace, number: int) -> float:
    """Variance of the residual force's acceleration some intervals later."""
    if number >= 1:
        covariance = spread(covariance, pace, number)
    row = np.array([-pace.stiffness, -pace.damping, 1.0, 0.0, 0.0])
    return float(row @ covariance @ row)


@lru_cache(maxsize=1024)
def _transition(time: float, stiffness: float, damping: float) -> tuple[Array, Array]:
    """Transition over a time, and covariance of what unit white noise adds meanwhile.

    Reference: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978).
    """
    # Van Loan's matrix grows where the model's own motion decays: a short time, doubled.
    doublings = max(0, math.ceil(math.log2(max(time * (damping + math.sqrt(abs(stiffness))), 1.0))))
    short = time / 2**doublings
    rates = np.diag(np.ones(ORDER - 1), 1)
    rates[1, :2] = -stiffness, -damping
    driven = np.zeros((ORDER, ORDER))
    driven[-1, -1] = 1.0
    both = cast("Any", expm)(short * np.block([[-rates, driven], [np.zeros((5, 5)), rates.T]]))
    transition = np.ascontiguousarray(both[ORDER:, ORDER:].T)
    noise = transition @ both[:ORDER, ORDER:]
    for _ in range(doublings):
        noise = noise + transition @ noise @ transition.T
        transition = transition @ transition
    return transition, 0.5 * (noise + noise.T)


@lru_cache(maxsize=256)
def _steady(pace: Pace) -> Steady:
    """The limit of the filter's recursion, by doubling its length in each iteration.

    Reference: Chu, Fan, Lin, Wang, Structure-preserving algorithms for periodic discrete-time
    algebraic Riccati equations, Int. J. Control 77 (2004).
    """
    transition, noise = _transition(pace.interval, pace.stiffness, pace.damping)
    a, g, ahead = transition.T, np.zeros((ORDER, ORDER)), pace.interval * noise
    g[0, 0] = 1.0
    for _ in range(_MOST_DOUBLINGS):
        between = np.linalg.inv(np.eye(ORDER) + g @ ahead)
        before = ahead
        ahead = ahead + a.T @ ahead @ between @ a
        ahead = 0.5 * (ahead + ahead.T)
        g = g + a @ between @ g @ a.T
        g = 0.5 * (g + g.T)
        a = a @ between @ a
        change = np.abs(np.diagonal(ahead) - np.diagonal(before))
        if np.all(change <= 1e-12 * np.diagonal(ahead)):
            break
    gain, after = _gain(ahead)
    return Steady(gain, float(ahead[0, 0]) + 1.0, after, _ahead(after, pace, 0))


@lru_cache(maxsize=1024)
def _steady_ahead(pace: Pace, number: int) -> float:
    return _ahead(_steady(pace).covariance, pace, number)
