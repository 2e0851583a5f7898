"""A measured motion, followed by a filter with fading memory: position, velocity, acceleration.

The filter has no lag for a constant acceleration. Where the acceleration itself is measured, only
position and velocity are corrected, and there is no lag for any acceleration that the sensor shows.

Reference: Morrison, "Introduction to Sequential Smoothing and Prediction" (1969), chapter 13: the
fading-memory polynomial filters of second and of first degree.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from rig.channels.channel import Sample

SETTLED = 9.0
"""Time constants after which the filter has forgotten that it began at rest: to a hundredth."""


class TrackedMotion(Struct, frozen=True, gc=False):
    """A motion as it is known: a position and its derivatives at the last measurement.

    That measured `measured_m`.
    """

    position_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    innovation_m: float
    measured_ns: int
    measured_m: float = 0.0


def update_motion(motion: TrackedMotion, sample: Sample, settling_s: float) -> TrackedMotion:
    """The motion after a new measured position; older ones fade with a time constant."""
    return _correct(motion, sample, settling_s, _gains_of_second_degree)


def update_with_acceleration(
    motion: TrackedMotion, sample: Sample, settling_s: float
) -> TrackedMotion:
    """The motion after a new measured position, its acceleration being that of a sensor."""
    return _correct(motion, sample, settling_s, _gains_of_first_degree)


def _gains_of_second_degree(kept: float) -> tuple[float, float, float]:
    """Gains of position, velocity and acceleration, in units of the time between two samples."""
    fresh = 1.0 - kept
    return 1.0 - kept**3, 1.5 * fresh * fresh * (1.0 + kept), fresh**3


def _gains_of_first_degree(kept: float) -> tuple[float, float, float]:
    """The same without a correction of the acceleration."""
    fresh = 1.0 - kept
    return 1.0 - kept * kept, fresh * fresh, 0.0


def _correct(
    motion: TrackedMotion,
    sample: Sample,
    settling_s: float,
    gains: Callable[[float], tuple[float, float, float]],
) -> TrackedMotion:
    """The motion after a position, by gains of the share that is kept of what was known."""
    age_s = (sample.t_ns - motion.measured_ns) * 1e-9
    if age_s <= 0.0:
        return motion
    position_m, velocity, acceleration = predict_motion(motion, sample.t_ns)
    innovation_m = sample.value - position_m
    of_position, of_velocity, of_acceleration = gains(math.exp(-age_s / settling_s))
    return TrackedMotion(
        position_m + of_position * innovation_m,
        velocity + of_velocity * innovation_m / age_s,
        acceleration + of_acceleration * innovation_m / (age_s * age_s),
        innovation_m,
        sample.t_ns,
        sample.value,
    )


def predict_motion(motion: TrackedMotion, t_ns: int) -> tuple[float, float, float]:
    """Position (m), velocity (m/s) and acceleration (m/s²) at a time after the last measurement."""
    h = (t_ns - motion.measured_ns) * 1e-9
    acceleration = motion.acceleration_m_per_s2
    velocity = motion.velocity_m_per_s + h * acceleration
    return (
        motion.position_m + h * (motion.velocity_m_per_s + 0.5 * h * acceleration),
        velocity,
        acceleration,
    )


def accelerate(motion: TrackedMotion, sample: Sample) -> TrackedMotion:
    """The motion after a measured acceleration, which it has from the last position on."""
    return replace(motion, acceleration_m_per_s2=sample.value)


class ErrorGains(NamedTuple):
    """Errors of a followed motion at the time of a sample, by what makes them.

    Attributes:
        noise: Covariance of position (m), velocity (m/s) and acceleration (m/s²) by white noise of
            unit variance in the samples, shape (3, 3).
        innovation: Variance of the innovations by that noise.
        change: Variance of their changes from sample to sample by it.
        lag: Errors of the three, and of the jerk that is taken for zero, per metre of innovation
            where the filter lags behind: behind a constant jerk, or, with a measured acceleration,
            one with a constant error. Shape (4,).
    """

    noise: NDArray[np.float64]
    innovation: float
    change: float
    lag: NDArray[np.float64]

    def ahead(self, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Noise (2, 2) and lag (2,) of position and velocity some time after the sample."""
        h, h2, h3 = time_s, time_s**2 / 2.0, time_s**3 / 6.0
        ahead = np.array([[1.0, h, h2, h3], [0.0, 1.0, h, h2]])
        return ahead[:, :3] @ self.noise @ ahead[:, :3].T, ahead @ self.lag


def error_gains(settling_s: float, interval_s: float, *, has_acceleration: bool) -> ErrorGains:
    """What noise of samples and lag do to a followed motion."""
    update = update_with_acceleration if has_acceleration else update_motion
    step_ns, power = round(interval_s * 1e9), 2 if has_acceleration else 3
    noise, innovation, change, before_m = np.zeros((3, 3)), 0.0, 0.0, 0.0
    rest = TrackedMotion(0.0, 0.0, 0.0, 0.0, 0)
    # The response to one sample, and to a power of time.
    passed, late = rest, rest
    for number in range(1, 5 + math.ceil(2.0 * SETTLED * settling_s / interval_s)):
        t_ns = number * step_ns
        passed = update(passed, Sample(0, float(number == 1), t_ns), settling_s)
        late = update(late, Sample(0, (t_ns * 1e-9) ** power, t_ns), settling_s)
        now = np.array([passed.position_m, passed.velocity_m_per_s, passed.acceleration_m_per_s2])
        noise += np.outer(now, now)
        innovation += passed.innovation_m**2
        change += (passed.innovation_m - before_m) ** 2
        before_m = passed.innovation_m
    t_s = late.measured_ns * 1e-9
    derivatives = [math.perm(power, order) * t_s ** max(power - order, 0) for order in range(4)]
    found = [late.position_m, late.velocity_m_per_s, late.acceleration_m_per_s2, 0.0]
    lag = np.array(found) - derivatives
    return ErrorGains(noise, innovation, change, lag / late.innovation_m)


def lag_free_hz(settling_s: float, share: float) -> float:
    """Frequency up to which a followed position errs by at most a share of the motion.

    Without a measured acceleration: the error of a filter with three poles of one time constant is
    the cube of the angular frequency times it.
    """
    return share ** (1.0 / 3.0) / (2.0 * math.pi * settling_s)
