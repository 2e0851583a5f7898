"""The lag of a filter behind a force that changes faster than its random walk allows for."""

import math

import numpy as np
import pytest

from rig.observers.error_filter import ErrorFilter
from rig.observers.filter_lag import NO_LAG, lag_variance, make_lag_filter, update_lag
from rig.observers.kalman import KalmanObserver
from rig.observers.protocol import Innovation, Start
from tests.faults.trial import BEGIN_MS, MS, Gateway, Trial, after

INTERVAL_NS = 1_000_000
BANDWIDTH_HZ = 20.0
OMEGA = 2.0 * math.pi * BANDWIDTH_HZ
CORNER = 1.5 * OMEGA


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6])
def test_without_noise_the_innovations_show_the_error_of_the_force(share):
    """Up to the magnitude of the Butterworth filter of third order that takes the derivatives."""
    follower = ErrorFilter(bandwidth_hz=BANDWIDTH_HZ, noise_std_m=1e-9)
    state = follower.steady_state(Start(0, 1.0, INTERVAL_NS, 0, 0.0, 0.0, ()))
    frequency = share * OMEGA
    shown, true = [], []
    by_value, by_rate, by_curvature = state.constants.lag.output
    for number in range(1, 6000):
        t_s = number * 1e-3
        acceleration = math.sin(frequency * t_s)
        measured = Innovation(-acceleration / frequency**2, number * INTERVAL_NS)
        state = follower.update(state, measured)
        lag = state.lag
        shown.append(by_value * lag.value + by_rate * lag.rate + by_curvature * lag.curvature)
        true.append(acceleration - state.mean[2])
    shown, true = np.array(shown[2000:]), np.array(true[2000:])
    magnitude = 1.0 / math.sqrt(1.0 + (frequency / CORNER) ** 6)
    assert np.std(shown) == pytest.approx(magnitude * np.std(true), rel=0.1)
    # The stated variance holds it: between its mean square and its peak.
    variance = follower.residual_std(state, state.t_ns) ** 2
    assert np.var(true) * 0.8 < variance < 2.2 * np.var(true)


def test_white_innovations_show_no_lag():
    """Their mean square is that of the filtered noise, in closed form; nothing is beyond it."""
    innovation_m2 = 4e-12
    filtered = make_lag_filter(OMEGA, 1e-3, (0.1, 3.0), innovation_m2)
    rng = np.random.default_rng(3)
    lag, squares, beyond = NO_LAG, [], []
    by_value, by_rate, by_curvature = filtered.output
    for new_m in rng.normal(0.0, math.sqrt(innovation_m2), 200_000):
        lag = update_lag(lag, filtered, float(new_m))
        now = by_value * lag.value + by_rate * lag.rate + by_curvature * lag.curvature
        squares.append(now * now)
        beyond.append(lag_variance(lag, filtered, 1.0))
    assert np.mean(squares) == pytest.approx(filtered.white, rel=0.05)
    assert np.mean(beyond) < 0.25 * filtered.white


def test_a_scaled_noise_is_no_lag_either():
    filtered = make_lag_filter(OMEGA, 1e-3, (0.1, 3.0), 1e-12)
    lag = NO_LAG._replace(square=9.0 * filtered.white)
    assert lag_variance(lag, filtered, 9.0) == 0.0
    assert lag_variance(lag, filtered, 1.0) == pytest.approx(8.0 * filtered.white)


def observer(bandwidth_hz):
    return KalmanObserver("kalman", ErrorFilter(bandwidth_hz=bandwidth_hz, noise_std_m=6e-7))


def coverage(ticks):
    """Share of valid ticks whose force the stated 95 % interval holds."""
    valid = [tick for tick in ticks if tick.is_valid]
    errors_n = np.array([abs(tick.force_n - tick.truth_n) for tick in valid])
    std_n = np.array([tick.result.output.struts[0].force_std_n for tick in valid])
    return np.mean(errors_n <= 1.96 * std_n)


def missing(length_ms):
    return lambda t_ns, frames: [] if (t_ns // MS) % 1000 < length_ms else frames


def lost(share):
    def inject(t_ns, frames):
        kept = np.random.default_rng(t_ns).random(len(frames)) >= share
        return [frame for frame, is_kept in zip(frames, kept, strict=True) if is_kept]

    return inject


EVENTS = {
    "none": lambda _t_ns, frames: frames,
    "5 ms missing": missing(5),
    "100 ms missing": missing(100),
    "300 ms missing": missing(300),
    "a gateway of 8 ms": Gateway(8, 250),
    "a gateway of 60 ms": Gateway(60, 1000),
    "every tenth lost": lost(0.1),
    "every second lost": lost(0.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("event", EVENTS)
def test_the_stated_deviation_holds_the_error_of_a_filter_that_lags(event):
    """The reference bench, without noise: all of the error is lag."""
    ticks = Trial(observer=observer(20.0)).run(BEGIN_MS + 1500, after(MS, EVENTS[event]))
    assert coverage(ticks) > 0.95


@pytest.mark.parametrize(("bandwidth_hz", "least"), [(10.0, 0.9), (30.0, 0.93), (50.0, 0.95)])
def test_at_other_bandwidths(bandwidth_hz, least):
    assert coverage(Trial(observer=observer(bandwidth_hz)).run(BEGIN_MS + 1000)) > least
