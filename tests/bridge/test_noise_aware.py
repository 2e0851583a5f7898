"""Observers on a bench with noise, latency and a moving start, through the core on DART.

The bench is the reference case's, which shares no code with the model.
"""

import numpy as np
import pytest

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, load_model
from rig.bridge.free_model import start_of_motion
from rig.bridge.mode_supervisor import Supervision
from rig.bridge.values import StepInput
from rig.channels.channel import Sample
from rig.channels.measured_quantities import APPLIED_FORCE
from rig.closed_loop.loop import Loop, SampleTiming
from rig.closed_loop.noise_response import motion_by_noise
from rig.closed_loop.poles import closed_loop_poles
from rig.closed_loop.strut_response import linearise_at
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import PiObserver
from rig.plan.config import CONFIGS
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.bridge.cores import MS, bench_sample, channels, gains, supervised

SUPERVISION = Supervision(stale_after_s=0.03, safe_after_s=0.5)
PAPER = PiObserver(force_limit_n=5000.0)
EXACT = ErrorFilter(bandwidth_hz=40.0, noise_std_m=5.8e-7)
NOISY = ErrorFilter(bandwidth_hz=19.5, noise_std_m=2.05e-5)


@pytest.fixture(scope="module")
def truth():
    bench = load_bench_config(CONFIGS / "reference_bench.yaml")
    found = simulate(bench, 8_000 * MS, MS)
    return found.height_m[:, 0], found.strut_force_n[:, 0], found.applied_force_n


def rounded(heights, step_m):
    return np.round(heights / step_m) * step_m


def noisy(heights, seed=0):
    rng = np.random.default_rng(seed)
    return rounded(heights + 2e-5 * rng.standard_normal(len(heights)), 1.5e-5)


def follow(observer, heights, applied, delay=0, known=True, first=0):
    """Columns height, velocity, force, deviation of each tick; NaN before the model started."""
    delay_ns = delay * MS if known else 0
    plant = DartPlant(load_model(MODELS / "reference.yaml"))
    core = supervised(plant, (observer,), SUPERVISION, channels(1, delay_ns=delay_ns))
    state = core.init(0)
    found = np.full((len(heights), 4), np.nan)
    for tick in range(first, len(heights)):
        samples = [bench_sample(1, APPLIED_FORCE, float(applied[tick]), tick * MS)]
        if tick - delay >= first:
            samples.append(Sample(0, float(heights[tick - delay]), tick * MS - delay_ns))
        state, output, _ = core.step(state, StepInput(tick * MS, tuple(samples)))
        if output.struts:
            strut = output.struts[0]
            found[tick] = (
                strut.height_m, strut.velocity_m_per_s, strut.force_n, strut.force_std_n,
            )  # fmt: skip
    return found


def error(found, force, first=500):
    """RMS error of the force after a tick, as a share of the peak."""
    return np.sqrt(np.mean((found[first:, 2] - force[first:]) ** 2)) / np.abs(force[500:]).max()


def coverage(found, force, first=500):
    return np.mean(np.abs(found[first:, 2] - force[first:]) < 1.96 * found[first:, 3])


def test_exact_heights(truth):
    height, force, applied = truth
    found = follow(KalmanObserver("kalman", EXACT), rounded(height, 2e-6), applied)
    assert error(found, force) < 0.002
    assert 0.92 < coverage(found, force) < 0.98


def test_noisy_heights(truth):
    height, force, applied = truth
    found = follow(KalmanObserver("kalman", NOISY), noisy(height), applied)
    published = follow(PAPER, noisy(height), applied)
    assert error(found, force) < 0.01
    assert error(found, force) < 0.8 * error(published, force)
    assert 0.92 < coverage(found, force) < 0.98


def test_velocity_is_the_derivative_of_height(truth):
    """Only a force acts: no state is overwritten, however wrong the start and the noise."""
    height, _, applied = truth
    heights = noisy(height)[:2000] + 0.01
    # Smooth: behind a jump the model starts again from the measurements.
    heights[1000:] -= 0.01 * (1.0 - np.cos(np.pi * np.minimum(np.arange(1000) / 300, 1.0)))
    found = follow(KalmanObserver("kalman", NOISY), heights, applied[:2000])
    z, v = found[100:, 0], found[100:, 1]
    # Under a force that is constant over a tick the height grows by the mean of both velocities,
    # but for a twelfth of the jerk times a tick's cube: c/m times 1000 m/s² at the jump.
    assert np.abs(np.diff(z) - 0.5e-3 * (v[1:] + v[:-1])).max() < 1e-6
    assert np.ptp(z) > 0.02


def test_a_moving_start_does_not_ring(truth):
    height, force, applied = truth
    first = 3210
    observer = KalmanObserver("kalman", NOISY)
    lockstep = error(follow(observer, noisy(height), applied), force, first + 200)
    moving = follow(observer, noisy(height), applied, first=first)
    assert error(moving, force, first + 200) < 1.2 * lockstep
    # What it publishes before is no better than it says.
    early = slice(first + 15, first + 200)
    assert np.mean(np.abs(moving[early, 2] - force[early]) < 3.0 * moving[early, 3]) > 0.95


def test_five_milliseconds_of_latency(truth):
    height, force, applied = truth
    heights = rounded(height, 2e-6)
    without = error(follow(PAPER, heights, applied), force)
    assert error(follow(PAPER, heights, applied, delay=5, known=False), force) > 2.5 * without
    assert not error(follow(PAPER, heights, applied, delay=5), force) < 1.0  # the loop is lost
    predicted = PiObserver(force_limit_n=5000.0, filter=EXACT)
    assert error(follow(predicted, heights, applied, delay=5), force) < 1.3 * without
    aware = KalmanObserver("kalman", EXACT)
    assert error(follow(aware, heights, applied, delay=5), force) < 0.5 * without


@pytest.mark.parametrize("delay", [0, 3])
@pytest.mark.parametrize("every", [1, 4])
def test_the_noise_aware_loop_is_stable_and_damped(delay, every):
    plant = DartPlant(load_model(MODELS / "reference.yaml"))
    corner = ErrorFilter(bandwidth_hz=20.0 / every, noise_std_m=2e-5)
    observers = (KalmanObserver("kalman", corner),)
    poles = closed_loop_poles(plant, observers, (0.3,), SampleTiming(MS, every, delay))
    assert max(pole.magnitude for pole in poles) < 1.0
    # The filter knows nothing of the law: at 5 Hz the model's own damper takes part.
    assert min(pole.damping_ratio for pole in poles) > (0.15 if every == 1 else 0.05)


@pytest.mark.parametrize("observer", [PAPER, KalmanObserver("kalman", NOISY)])
def test_noise_and_lag_of_the_linear_loop_are_those_of_the_simulated_one(observer):
    """A bench at rest with sensor noise; a bench at rest whose strut carries a sine more."""
    plant = DartPlant(load_model(MODELS / "reference.yaml"))
    rest_m = 0.5 - 98.1 / 500.0
    loop = Loop(plant, (observer,), (rest_m,), SampleTiming(MS))
    linear = loop.linear()
    rng = np.random.default_rng(5)
    x, errors = loop.at_rest, []
    for _ in range(12_000):
        x, (error_n,) = loop.after(x, [2e-5 * rng.standard_normal()])
        errors.append(error_n)
    simulated = np.std(errors[2000:])
    assert linear.noise_gain_n_per_m() * 2e-5 == pytest.approx(simulated, rel=0.1)
    x, errors = loop.at_rest, []
    frequency_hz = 4.0
    for tick in range(6000):
        x, (error_n,) = loop.after(x, None, [np.sin(2.0 * np.pi * frequency_hz * tick * 1e-3)])
        errors.append(error_n)
    amplitude = np.sqrt(2.0) * np.std(errors[-1000:])
    assert linear.lag_gain(np.array([frequency_hz]))[0] == pytest.approx(amplitude, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kinds", ["kalman", "pi", "joint"])
def test_a_model_moves_by_noise_as_stated(kinds):
    """Covariance of heights and rates against the loop's own steps under noise."""
    name, heights = (
        ("quarter_car", [0.29, 0.35]) if kinds == "joint" else ("reference", [0.5 - 98.1 / 500.0])
    )
    plant = DartPlant(load_model(MODELS / f"{name}.yaml"))
    kalman = KalmanObserver("kalman", ErrorFilter(12.0, 2e-5))
    observers = [gains(1e5, 1e4)] if kinds == "pi" else [kalman] * len(heights)
    timing, struts = SampleTiming(MS), range(len(heights))
    stated = motion_by_noise(plant, observers, heights, timing, struts)
    loop, rng, found = Loop(plant, observers, heights, timing), np.random.default_rng(5), []
    x = loop.at_rest
    for _ in range(12_000):
        x, _ = loop.after(x, (2e-5 * rng.standard_normal(len(heights))).tolist())
        found.append(plant.state_of(x[: loop._ends[1]].tolist()).struts)
    simulated = np.var(np.array(found)[2000:], axis=0).T
    assert stated.shape == (len(heights), 2, len(heights), len(heights))
    expected = 4e-10 * np.diagonal(stated, axis1=2, axis2=3).sum(axis=0)
    assert np.sqrt(expected) == pytest.approx(np.sqrt(simulated), rel=0.2)


def test_a_start_from_several_heights_is_a_parabola_through_them():
    t_ms = np.arange(-11, 1)
    heights = 0.3 + 0.8 * t_ms * 1e-3 + 4.0 * (t_ms * 1e-3) ** 2
    given = [Sample(0, float(h), int(t) * MS) for h, t in zip(heights, t_ms, strict=True)]
    assert start_of_motion(given, 0) == pytest.approx((0.3, 0.8), abs=1e-9)
    # They came 5 ms late.
    late = start_of_motion(given, 5 * MS)
    assert late == pytest.approx((0.3 + 0.004 + 1e-4, 0.84), abs=1e-9)
    assert start_of_motion(given[:1], 0) == (heights[0], 0.0)


def test_answers_are_those_of_masses_springs_and_dampers():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    tyre, suspension = linearise_at(plant, (0.29, 0.35)).responses()
    both = 1.0 / 3.0 + 1.0 / 15.0
    assert tyre == pytest.approx((1.0 / 3.0, 20000.0 / 3.0, 130.0 / 3.0), rel=1e-6)
    assert suspension == pytest.approx((both, 800.0 * both, 120.0 * both), rel=1e-6)
