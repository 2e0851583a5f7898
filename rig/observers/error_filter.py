"""A Kalman filter for the error of the model of one strut: what the observers predict with.

Bench and model carry the same loads but for the residual force d and the virtual force F_v, so that
the error of the model's height, x = z - z_model, obeys

    m d²x/dt² = d - F_v - k x - c dx/dt,

m the effective mass that the strut's force moves, k and c the slopes of the model's own law, which
is not where the bench is. The mean is predicted with the slopes at the model's present height and
velocity: in a stop, or beyond the knee of a damper, those at rest would make errors grow. The gain
is that of the slopes at the start. The residual force is an integrated random walk of third order
(the third derivative of d is white noise): a smooth force that nothing else is known of. State: x,
its rate, and the acceleration d / m with its first two derivatives. The virtual force is a known
input, so that the filter also estimates the error at the present time, when the newest measurement
is some milliseconds old.

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
from typing import Annotated, NamedTuple, TypeVar

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from can_dbc.yaml_file import Finite
from rig.observers.covariances import discretise, limit_ahead
from rig.observers.filter_lag import (
    NO_LAG,
    Lag,
    LagFilter,
    lag_variance,
    make_lag_filter,
    update_lag,
)
from rig.observers.protocol import Innovation, Remark, Start, TuningTask

Array = NDArray[np.float64]
Mean = tuple[float, float, float, float, float]

ORDER = 5
"""States: error, rate, acceleration by the residual force and two derivatives of it. With three or
four the reference case's force error is 2.7 or 1.05 % of the peak at its best bandwidth, with five
0.85 %, under 20 um of noise."""

_SETTLED = 1e-6
"""Relative distance of the variances from their limit below which the gains are constant."""

STEADY_VARIANCE = 1.5**2
"""Variance of the residual force, over that with every measurement there, up to which the filter is
steady: single missing ones do no harm."""

_SETTLING = 8.0
"""Time in units of 1 / omega in which a steady filter forgets what it was before."""

ACCELERATION_STD_M_PER_S2 = 30.0
"""Of the residual force over the mass, before anything was measured: three times gravity."""

RATE_STD_M_PER_S = 1.0
"""Of the model's velocity at its start: dampers move at up to two metres a second."""

_LOWEST_HZ, _HIGHEST_HZ = 0.01, 1e4
_LEAST_STD_M, _LARGEST_STD_M = 1e-12, 1.0
"""Bounds of what a filter can be asked for."""

HeightNoise = Annotated[Finite, Field(ge=_LEAST_STD_M, le=_LARGEST_STD_M)]
"""Standard deviation of a height in m."""

_NO_ERROR: Mean = (0.0, 0.0, 0.0, 0.0, 0.0)

_FORGOTTEN = 20.0
"""Time without a measurement, in units of 1 / omega, after which what was known is worth nothing: a
polynomial of third order is 20³ times as uncertain as at one."""

MOST_HELD = 20
"""Missing measurements for which an innovation stands in the derivatives that show a lag."""

STEP_OF_MODEL = 0.5
"""Of a step of the mean, in radians or time constants of the model's own law: a ten-thousandth of
its change is left out."""

MOST_OF_MODEL = 50.0
"""The same of a whole step: of a stop that stiff, all that counts is that the error is gone."""

_FADING_S = 1.0
"""Time constant with which the innovations' variance is followed."""

_SMALLEST_SCALE, _LARGEST_SCALE = 1e-4, 1e4
"""Bounds of a variance that follows the innovations, over the configured one."""

_WIDEST_PER_INTERVAL, _NARROWEST_PER_INTERVAL = 2.0, 0.004
"""Bounds of a corner in rad/s times the time between two measurements: wider ones follow single
samples, narrower ones nothing."""

_WIDEST_OF_RATE = 1.0 / 3.0
"""Corner of a filter over the rate of its measurements beyond which it smooths nothing."""


DAMPING = 0.8
"""Damping ratio of the feedback: settles fast, hardly overshoots."""

MOST_PER_INTERVAL = 0.3
"""Largest product of the feedback's corner and the time between two measurements: the hold of the
virtual force takes half an interval of phase."""

CONTRADICTION = 8.0**2
"""Square of what is new in a measurement behind a gap over its variance, from which it contradicts
what is known: another zero, or a motion that the gap hid. Once in 1e15 for normal errors."""


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


class Constants(Struct, frozen=True, gc=False):
    """What a filter requires at every measurement and is the same all through a run.

    Attributes:
        gain: The steady gain in SI: what each of the mean changes by per metre that is new.
        innovation_m2: Steady variance of what is new in a measurement.
        residual_std: Steady standard deviation of `ErrorFilter.residual` at a measurement.
        fading: Share of the newest innovation in the variances' scale.
        next_ns: Time since the last measurement from which on one is missing.
        longest_ns: How long after the last measurement the error is predicted.
        forgotten_ns: Time after which the last measurement says nothing more.
        lag: Filter of the innovations that shows a lag.
    """

    steady: Steady
    gain: Mean
    innovation_m2: float
    residual_std: float
    fading: float
    omega: float
    next_ns: int
    longest_ns: int
    forgotten_ns: int
    lag: LagFilter


class ErrorState(Struct, frozen=True, gc=False):
    """What is known of the model's error.

    Attributes:
        t_ns: Time of the estimate: that of the last measurement.
        mean: Error in m, its rate, acceleration of the residual force and its two derivatives, SI.
        covariance: In units of sigma and 1 / omega; None once it is steady.
        scale: Variance of the sensor over the configured one, as the innovations show it.
        inputs: Accelerations by the virtual force, and from when on; the first one from `t_ns` or
            before.
        slopes: Stiffness and damping of the model's law where it is now, over the effective mass.
        lag: Lag behind a force that changes faster than the filter allows for.
    """

    t_ns: int
    mean: Mean
    covariance: Array | None
    scale: float
    inputs: tuple[tuple[int, float], ...]
    start: Start
    constants: Constants
    slopes: tuple[float, float]
    lag: Lag = NO_LAG


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid"))
class ErrorFilter:
    """The filter of one strut.

    Attributes:
        bandwidth_hz: Bandwidth within which the residual force is followed.
        noise_std_m: Standard deviation of the height measurement, quantisation included (that of
            the quantisation alone is the resolution divided by the square root of 12).
    """

    bandwidth_hz: Annotated[Finite, Field(ge=_LOWEST_HZ, le=_HIGHEST_HZ)]
    noise_std_m: HeightNoise

    @classmethod
    def within(cls, bandwidth_hz: float, noise_std_m: float) -> "ErrorFilter":
        """The filter whose values are the nearest within their bounds."""
        return cls(
            bandwidth_hz=min(max(bandwidth_hz, _LOWEST_HZ), _HIGHEST_HZ),
            noise_std_m=min(max(noise_std_m, _LEAST_STD_M), _LARGEST_STD_M),
        )

    @classmethod
    def corners(cls, interval_s: float) -> tuple[float, float]:
        """Bounds of a sensible corner in rad/s, for measurements at an interval."""
        return _NARROWEST_PER_INTERVAL / interval_s, _WIDEST_PER_INTERVAL / interval_s

    @classmethod
    def with_corner(cls, corner: float, task: TuningTask) -> "ErrorFilter":
        """The filter for a strut, with the sensible corner (rad/s) that is nearest."""
        low, high = cls.corners(task.interval_s)
        return cls.within(min(max(corner, low), high) / (2.0 * math.pi), task.noise_std_m)

    def with_bandwidth(self, factor: float) -> "ErrorFilter":
        """The filter with its bandwidth multiplied by a factor, within its bounds."""
        return self.within(factor * self.bandwidth_hz, self.noise_std_m)

    def to_four_digits(self) -> "ErrorFilter":
        """The filter with values of four digits."""
        bandwidth_hz, noise_std_m = self.bandwidth_hz, self.noise_std_m
        return ErrorFilter(
            bandwidth_hz=float(f"{bandwidth_hz:.4g}"), noise_std_m=float(f"{noise_std_m:.4g}")
        )

    def remark_on_rate(self, rate_hz: float) -> Remark:
        """Whether it smooths at a rate of measurements, or follows single ones."""
        text = f"{self.bandwidth_hz:g} Hz of {rate_hz:g} measurements a second"
        if self.bandwidth_hz <= _WIDEST_OF_RATE * rate_hz:
            return Remark(text, is_warning=False)
        text += ": follows single measurements, expected a third of them at most; see rig tune"
        return Remark(text, is_warning=True)

    @property
    def omega(self) -> float:
        """Corner in rad/s."""
        return 2.0 * math.pi * self.bandwidth_hz

    @property
    def forgotten_ns(self) -> int:
        """Time without a measurement after which the last one says nothing more."""
        return round(_FORGOTTEN / self.omega * 1e9)

    @property
    def settling_ns(self) -> int:
        """Time from steady variances to a steady estimate."""
        return round(_SETTLING / self.omega * 1e9)

    def is_steady(self, state: ErrorState, t_ns: int) -> bool:
        """Whether the residual force is about as uncertain at a time as it ever is."""
        covariance, constants, pace = state.covariance, state.constants, self.pace(state.start)
        if covariance is not None:
            variance = _ahead(covariance, pace, 0)
            if variance > STEADY_VARIANCE * constants.steady.residual:
                return False
        if t_ns - state.t_ns < constants.next_ns:
            return True
        number = round((t_ns - state.t_ns) / state.start.interval_ns)
        usual = _steady_ahead(pace, 1)
        return number < 2 or _steady_ahead(pace, number) <= STEADY_VARIANCE * usual

    def init(self, start: Start) -> ErrorState:
        """State at the model's start, at the first measured height."""
        inputs, constants = ((start.t_ns, 0.0),), self._constants(start)
        slopes = start.stiffness_per_s2, start.damping_per_s
        prior = self._prior()
        return ErrorState(start.t_ns, _NO_ERROR, prior, 1.0, inputs, start, constants, slopes)

    def steady_state(self, start: Start) -> ErrorState:
        """State after a long time without an error."""
        return replace(self.init(start), covariance=None)

    def update(self, state: ErrorState, innovation: Innovation) -> ErrorState:
        """State at a new measurement; one that is not newer than the last changes nothing."""
        if innovation.t_ns <= state.t_ns:
            return state
        constants, t_ns = state.constants, innovation.t_ns
        elapsed_ns = t_ns - state.t_ns
        if elapsed_ns > constants.forgotten_ns:
            return self.restart(state, innovation)
        mean = mean_at(state, t_ns)
        covariance, scale, lag = state.covariance, state.scale, state.lag
        # What is new in a measurement: its distance from the error that was predicted.
        new_m = innovation.value - mean[0]
        are_missing = elapsed_ns >= constants.next_ns
        if covariance is None and not are_missing:
            gain = constants.gain
            scale = update_scale(scale, constants.fading, new_m * new_m / constants.innovation_m2)
            lag = update_lag(lag, constants.lag, new_m)
        else:
            steady = constants.steady.covariance
            before = steady if covariance is None else covariance
            number = max(1, round(elapsed_ns / state.start.interval_ns))
            ahead = predict_covariance(before, self.pace(state.start), number)
            # As large as it would be were the filter steady.
            share = math.sqrt(constants.steady.innovation / (float(ahead[0, 0]) + 1.0))
            usual_m2 = scale * constants.innovation_m2
            if are_missing and (share * new_m) ** 2 > CONTRADICTION * usual_m2:
                return self.restart(state, innovation)
            for _ in range(min(number, MOST_HELD)):
                lag = update_lag(lag, constants.lag, share * new_m)
            in_units, covariance = _gain(ahead)
            gain = in_si(in_units, constants.omega)
            limit = np.diagonal(steady)
            if np.all(np.abs(np.diagonal(covariance) - limit) <= _SETTLED * limit):
                covariance = None
        inputs = inputs_since(state.inputs, t_ns)
        mean = correct(mean, gain, new_m)
        start, slopes = state.start, state.slopes
        return ErrorState(t_ns, mean, covariance, scale, inputs, start, constants, slopes, lag)

    def restart(self, state: ErrorState, innovation: Innovation) -> ErrorState:
        """State at a measurement before which everything known has become worthless."""
        return replace(
            state,
            t_ns=innovation.t_ns,
            mean=(innovation.value, 0.0, 0.0, 0.0, 0.0),
            covariance=self._prior(),
            inputs=inputs_since(state.inputs, innovation.t_ns),
        )

    def predict(self, state: ErrorState, t_ns: int) -> Mean:
        """Mean at a time after the last measurement.

        Beyond the time constant of the filter behind the time at which a measurement was due, a
        polynomial would run away: the error is predicted up to there.
        """
        return mean_at(state, min(t_ns, state.t_ns + state.constants.longest_ns))

    def residual(self, state: ErrorState, mean: Mean) -> float:
        """Acceleration by the force that the model lacks now, in m/s², at the predicted mean."""
        x, v, a, *_ = mean
        stiffness, damping = state.slopes
        return a - stiffness * x - damping * v

    def residual_std(self, state: ErrorState, t_ns: int) -> float:
        """Standard deviation of `residual`, at a time, in m/s²."""
        constants, interval_ns = state.constants, state.start.interval_ns
        elapsed_ns = min(t_ns - state.t_ns, constants.forgotten_ns)
        number = (elapsed_ns + interval_ns // 2) // interval_ns
        if state.covariance is not None:
            variance = _ahead(state.covariance, self.pace(state.start), number)
        elif number < 1:
            variance_of_noise = state.scale * constants.residual_std**2
            return math.sqrt(
                variance_of_noise + lag_variance(state.lag, constants.lag, state.scale)
            )
        else:
            variance = _steady_ahead(self.pace(state.start), number)
        unit = self.noise_std_m * constants.omega**2
        variance_of_noise = state.scale * max(variance, 0.0) * unit * unit
        return math.sqrt(variance_of_noise + lag_variance(state.lag, constants.lag, state.scale))

    def with_input(self, state: ErrorState, t_ns: int, acceleration: float) -> ErrorState:
        """State after the virtual force has changed."""
        newest, t_last_ns, inputs = (t_ns, acceleration), state.t_ns, state.inputs
        if t_ns <= t_last_ns:
            inputs = (newest,)
        # Without measurements the inputs would grow in number; the prediction ends, and with it
        # what changes the virtual force.
        elif t_ns - t_last_ns <= state.constants.longest_ns or acceleration != inputs[-1][1]:
            inputs = (*inputs, newest)
        return ErrorState(
            t_last_ns,
            state.mean,
            state.covariance,
            state.scale,
            inputs,
            state.start,
            state.constants,
            state.slopes,
            state.lag,
        )

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

    def _constants(self, start: Start) -> Constants:
        steady, omega, interval_ns = _steady(self.pace(start)), self.omega, start.interval_ns
        variance_m2 = self.noise_std_m**2
        gain = in_si(steady.gain, omega)
        return Constants(
            steady,
            gain,
            steady.innovation * variance_m2,
            math.sqrt(max(steady.residual, 0.0) * variance_m2) * omega**2,
            scale_fading(interval_ns),
            omega,
            (3 * interval_ns + 1) // 2,
            start.delay_ns + 2 * interval_ns + round(1e9 / omega),
            self.forgotten_ns,
            make_lag_filter(omega, interval_ns * 1e-9, gain[:2], steady.innovation * variance_m2),
        )

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
        rate = RATE_STD_M_PER_S / (sigma * omega)
        acceleration = ACCELERATION_STD_M_PER_S2 / (sigma * omega**2)
        return np.diag(np.array([1.0, rate, acceleration, acceleration, acceleration]) ** 2)


class Pace(NamedTuple):
    """Interval, stiffness and damping that the variances depend on, in units of 1 / omega."""

    interval: float
    stiffness: float = 0.0
    damping: float = 0.0


def scale_fading(interval_ns: int) -> float:
    """Share of the newest of measurements at an interval in the variances' scale."""
    return min(1.0, interval_ns * 1e-9 / _FADING_S)


def update_scale(scale: float, fading: float, squared: float) -> float:
    """The variances' scale after a measurement.

    Args:
        scale: The scale before.
        fading: Share of this measurement.
        squared: Square of what is new in it over its variance, one on average where the variances
            are right.
    """
    scale += fading * (squared - scale)
    return min(max(scale, _SMALLEST_SCALE), _LARGEST_SCALE)


def correct(mean: Mean, gain: Mean, new: float) -> Mean:
    """The mean after an update, with a gain in SI."""
    x, v, a, j, s = mean
    of_x, of_v, of_a, of_j, of_s = gain
    return x + of_x * new, v + of_v * new, a + of_a * new, j + of_j * new, s + of_s * new


def in_si(gain: Array, omega: float) -> Mean:
    """A gain of units of 1 / omega in SI."""
    x, v, a, j, s = (gain * omega ** np.arange(ORDER)).tolist()
    return x, v, a, j, s


InputT = TypeVar("InputT")


def inputs_since(
    inputs: tuple[tuple[int, InputT], ...], t_ns: int
) -> tuple[tuple[int, InputT], ...]:
    """Those inputs that still act at a time or begin after it."""
    first = 0
    while first + 1 < len(inputs) and inputs[first + 1][0] <= t_ns:
        first += 1
    return inputs[first:]


def mean_at(state: ErrorState, to_ns: int) -> Mean:
    """The mean at a later time, under the inputs in between."""
    mean, inputs, from_ns = state.mean, state.inputs, state.t_ns
    slopes, last = state.slopes, len(inputs) - 1
    stiffness, damping = slopes
    # How fast the model's own law moves it.
    own_per_s = max(abs(damping), math.sqrt(abs(stiffness)))
    if to_ns <= from_ns:
        return mean
    for index, (_, by_force) in enumerate(inputs):
        end_ns = to_ns if index == last else min(inputs[index + 1][0], to_ns)
        if end_ns <= from_ns:
            continue
        h = (end_ns - from_ns) * 1e-9
        from_ns = end_ns
        # A step in which the model itself hardly moves: what its law does is a Taylor series.
        quick = min(h * own_per_s, MOST_OF_MODEL)
        if quick <= STEP_OF_MODEL:
            mean = _taylor_step(mean, by_force, h, slopes)
            continue
        count = math.ceil(quick / STEP_OF_MODEL)
        for _ in range(count):
            mean = _taylor_step(mean, by_force, h / count, slopes)
    return mean


def _taylor_step(mean: Mean, by_force: float, h: float, slopes: tuple[float, float]) -> Mean:
    """The mean after a step, to the fifth order of the error's Taylor series."""
    x, v, a, j, s = mean
    stiffness, damping = slopes
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


def predict_covariance(covariance: Array, pace: Pace, number: float) -> Array:
    """Covariance some intervals later; a sensor's noise is a density of one an interval."""
    transition, noise = _transition(pace.interval * number, pace.stiffness, pace.damping)
    return transition @ covariance @ transition.T + pace.interval * noise


def _ahead(covariance: Array, pace: Pace, number: int) -> float:
    """Variance of the residual force's acceleration some intervals later."""
    if number >= 1:
        covariance = predict_covariance(covariance, pace, number)
    row = np.array([-pace.stiffness, -pace.damping, 1.0, 0.0, 0.0])
    return float(row @ covariance @ row)


@lru_cache(maxsize=1024)
def _transition(time: float, stiffness: float, damping: float) -> tuple[Array, Array]:
    """Transition over a time, and covariance of what unit white noise adds meanwhile."""
    rates = np.diag(np.ones(ORDER - 1), 1)
    rates[1, :2] = -stiffness, -damping
    driven = np.zeros((ORDER, ORDER))
    driven[-1, -1] = 1.0
    return discretise(rates, driven, time, damping + math.sqrt(abs(stiffness)))


@lru_cache(maxsize=256)
def _steady(pace: Pace) -> Steady:
    """The limit of the filter's recursion."""
    transition, noise = _transition(pace.interval, pace.stiffness, pace.damping)
    information = np.zeros((ORDER, ORDER))
    information[0, 0] = 1.0
    ahead = limit_ahead(transition, pace.interval * noise, information)
    gain, after = _gain(ahead)
    return Steady(gain, float(ahead[0, 0]) + 1.0, after, _ahead(after, pace, 0))


@lru_cache(maxsize=1024)
def _steady_ahead(pace: Pace, number: int) -> float:
    return _ahead(_steady(pace).covariance, pace, number)
