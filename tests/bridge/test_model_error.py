"""The filter of the model's error against theory, and the noise-aware observer on a bench."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.observers.error_filter import (
    ErrorFilter,
    Pace,
    _gain,
    _steady,
    _transition,
    predict_covariance,
)
from rig.observers.kalman import KalmanObserver
from rig.observers.pi import PiObserver
from rig.observers.protocol import Innovation, Start

MS = 1_000_000
START = Start(0, 0.1, MS)
FILTER = ErrorFilter(bandwidth_hz=20.0, noise_std_m=2e-5)


def test_the_steady_covariance_solves_the_riccati_equation():
    for interval in (0.02, 0.1, 0.5):
        steady = _steady(Pace(interval))
        gain, after = _gain(predict_covariance(steady.covariance, Pace(interval), 1))
        assert np.allclose(after, steady.covariance, rtol=1e-5)
        assert np.allclose(gain, steady.gain, rtol=1e-5)
        assert np.all(np.linalg.eigvalsh(steady.covariance) > 0.0)


def test_a_fast_sampled_filter_is_a_butterworth_filter_of_fifth_order():
    interval = 0.002
    transition, _ = _transition(interval, 0.0, 0.0)
    gain = _steady(Pace(interval)).gain
    loop = transition @ (np.eye(5) - np.outer(gain, np.eye(5)[0]))
    poles = np.log(np.linalg.eigvals(loop).astype(complex)) / interval
    expected = [np.exp(1j * math.pi * (0.5 + (2 * k + 1) / 10)) for k in range(5)]
    for pole in expected:
        assert min(abs(poles - pole)) < 5e-3


@settings(deadline=None)
@given(
    first=st.floats(0.01, 0.5),
    second=st.floats(0.01, 0.5),
    stiffness=st.floats(0.0, 2.0),
    damping=st.floats(0.0, 2.0),
)
def test_two_steps_are_one_step_of_their_sum(first, second, stiffness, damping):
    times = (first, second, first + second)
    (a, p), (b, q), (c, r) = (_transition(t, stiffness, damping) for t in times)
    assert np.allclose(b @ a, c, atol=1e-13)
    assert np.allclose(b @ p @ b.T + q, r, rtol=1e-7, atol=1e-16)


@given(time=st.floats(0.01, 2.0))
def test_without_a_law_the_noise_is_that_of_integrators(time):
    """Closed form of the integrated random walk."""
    transition, noise = _transition(time, 0.0, 0.0)
    for row in range(5):
        for column in range(5):
            up, left = 4 - row, 4 - column
            power = up + left + 1
            expected = time**power / (power * math.factorial(up) * math.factorial(left))
            assert noise[row, column] == pytest.approx(expected, rel=1e-6)
            if column >= row:
                gap = column - row
                expected = time**gap / math.factorial(gap)
                assert transition[row, column] == pytest.approx(expected, rel=1e-12)


def test_the_mean_moves_as_the_transition_says():
    """At steps of a quarter of the model's own radian; the Taylor series ends at the fifth."""
    follower = ErrorFilter(bandwidth_hz=1.0 / (2.0 * math.pi), noise_std_m=1.0)
    start = Start(0, 1.0, 250 * MS, 0, 1.0, 0.4)
    state = follower.with_numbers(follower.steady_state(start), (0.3, -0.2, 0.5, 0.1, -0.4, 0.0))
    moved = follower.predict(state, 250 * MS)
    transition, _ = _transition(0.25, 1.0, 0.4)
    assert moved == pytest.approx(transition @ np.array(state.mean), abs=1e-5)


def run_filter(error_m, inputs, follower=FILTER, start=START):
    """States after each measurement of an error that inputs (m/s²) act on."""
    state = follower.init(start)
    states = []
    for tick, (value, acceleration) in enumerate(zip(error_m, inputs, strict=True), start=1):
        state = follower.update(state, Innovation(value, tick * start.interval_ns))
        state = follower.with_input(state, tick * start.interval_ns, acceleration)
        states.append(state)
    return states


def test_a_polynomial_force_is_found_exactly_whatever_the_virtual_force_does():
    """A force whose third derivative is zero leaves no steady error: theory of the random walk."""
    rng = np.random.default_rng(1)
    inputs = np.append(0.0, rng.normal(0.0, 5.0, 3000))
    a, j, s = 3.0, -4.0, 2.5
    x = v = 0.0
    t, h = 0.0, 1e-3
    error, truth = [], []
    for by_force in inputs:
        b = a + j * t + s * t * t / 2.0 + by_force
        c = j + s * t
        x += v * h + b * h**2 / 2 + c * h**3 / 6 + s * h**4 / 24
        v += b * h + c * h**2 / 2 + s * h**3 / 6
        t += h
        error.append(x)
        truth.append(a + j * t + s * t * t / 2.0)
    states = run_filter(error, [*inputs[1:].tolist(), 0.0])
    assert states[-1].mean[0] == pytest.approx(error[-1], abs=1e-8)
    assert states[-1].mean[2] == pytest.approx(truth[-1], abs=1e-3)


def test_its_standard_deviation_is_that_of_its_errors():
    """Over 400 random walks and sensors: the chi-square of the error at the end."""
    rng = np.random.default_rng(2)
    interval = FILTER.omega * 1e-3
    transition, noise = _transition(interval, 0.0, 0.0)
    root = np.linalg.cholesky(interval * noise)
    unit = np.array([FILTER.omega**k for k in range(5)]) * FILTER.noise_std_m
    squares = []
    for _ in range(400):
        # What the filter assumes before the first measurement.
        state = FILTER.init(START)
        walk = np.sqrt(np.diagonal(state.covariance)) * rng.standard_normal(5)
        for tick in range(1, 161):
            walk = transition @ walk + root @ rng.standard_normal(5)
            seen = (walk[0] + rng.standard_normal()) * FILTER.noise_std_m
            state = FILTER.update(state, Innovation(seen, tick * MS))
        std = FILTER.residual_std(state, 160 * MS) / math.sqrt(state.scale)
        squares.append(((state.mean[2] - walk[2] * unit[2]) / std) ** 2)
    # The sum of 400 squares of standard normal numbers, within four deviations.
    assert np.sum(squares) == pytest.approx(400.0, abs=4.0 * math.sqrt(800.0))


def test_the_scale_follows_a_sensor_that_is_noisier_than_configured():
    rng = np.random.default_rng(3)
    state = run_filter(3.0 * 2e-5 * rng.standard_normal(6000), np.zeros(6000))[-1]
    assert state.scale == pytest.approx(9.0, rel=0.2)


@settings(deadline=None, max_examples=30)
@given(missing=st.integers(1, 40), seed=st.integers(0, 9))
def test_after_missing_measurements_it_knows_less_and_then_as_much_again(missing, seed):
    rng = np.random.default_rng(seed)
    state = FILTER.steady_state(START)
    steady = FILTER.residual_std(state, 0)
    t_ns = missing * MS + MS
    assert FILTER.residual_std(state, t_ns) > steady
    state = FILTER.update(state, Innovation(2e-5 * rng.standard_normal(), t_ns))
    assert state.covariance is not None
    for tick in range(1, 400):
        state = FILTER.update(state, Innovation(2e-5 * rng.standard_normal(), t_ns + tick * MS))
    assert state.covariance is None


def test_an_old_measurement_is_used_once():
    state = FILTER.update(FILTER.steady_state(START), Innovation(1e-4, MS))
    assert FILTER.update(state, Innovation(5e-4, MS)) is state


def test_its_numbers_are_all_that_the_next_state_depends_on():
    rng = np.random.default_rng(4)
    for observer in (
        KalmanObserver("kalman", FILTER),
        PiObserver(filter=FILTER, derivative_n_s_per_m=100.0),
    ):
        here, there = observer.steady_state(START), observer.steady_state(START)
        for tick in range(1, 8):
            here = observer.step(here, tick * MS, Innovation(1e-5 * rng.normal(), tick * MS))
            there = observer.step(there, tick * MS, Innovation(0.0, tick * MS))
        again = observer.with_numbers(there, observer.numbers(here))
        after = [observer.step(s, 8 * MS, Innovation(1e-5, 8 * MS)) for s in (here, again)]
        assert after[1].virtual_force_n == pytest.approx(after[0].virtual_force_n, rel=1e-12)


def test_without_measurements_the_virtual_force_comes_to_rest():
    observer = KalmanObserver("kalman", FILTER)
    state = observer.steady_state(START)
    for tick in range(1, 50):
        state = observer.step(state, tick * MS, Innovation(1e-3 * math.sin(0.05 * tick), tick * MS))
    forces = []
    for tick in range(50, 600):
        state = observer.step(state, tick * MS, None)
        forces.append(state.virtual_force_n)
    assert forces[100] == forces[-1]
    assert len(state.error.inputs) < 80
    assert abs(forces[-1]) <= observer.force_limit_n


def test_a_derivative_of_the_raw_innovation_is_refused():
    with pytest.raises(ValueError, match="requires filter"):
        PiObserver(derivative_n_s_per_m=5.0)


@pytest.mark.parametrize("gap_ms", [200, 5_000, 3_600_000])
def test_after_a_long_gap_it_restarts(gap_ms):
    observer = KalmanObserver("kalman", FILTER)
    state = observer.steady_state(START)
    for tick in range(1, 50):
        state = observer.step(state, tick * MS, Innovation(1e-3 * math.sin(0.1 * tick), tick * MS))
    for tick in range(gap_ms, gap_ms + 400):
        state = observer.step(state, tick * MS, Innovation(2e-3, tick * MS))
        assert math.isfinite(state.virtual_force_n)
        assert math.isfinite(state.force_std_n)
    assert state.error.covariance is None


@pytest.mark.parametrize("damping_per_s", [0.0, 10.0, 200.0, 1000.0])
@pytest.mark.parametrize("gap_ms", [50, 150, 262, 400])
def test_a_gap_on_a_stiffly_damped_model_stays_finite_and_sane(damping_per_s, gap_ms):
    observer = KalmanObserver("kalman", FILTER)
    start = Start(0, 0.1, MS, 0, 500.0, damping_per_s)
    state = observer.steady_state(start)
    for tick in range(1, gap_ms):
        state = observer.step(state, tick * MS, None)
        assert math.isfinite(state.force_std_n)
    x, v = 2e-5, 0.0
    for tick in range(gap_ms, gap_ms + 300):
        state = observer.step(state, tick * MS, Innovation(x, tick * MS))
        # A height that is off by its noise asks for little.
        assert abs(state.residual_force_n) < 40.0
        for _ in range(10):
            v += 1e-4 * (-0.1 * state.virtual_force_n - 500.0 * x - damping_per_s * v)
            x += 1e-4 * v
    assert abs(x) < 1e-5


def test_a_bench_two_millimetres_off_after_a_gap_is_no_blow():
    observer = KalmanObserver("kalman", FILTER)
    state = observer.steady_state(START)
    x = 2e-3
    v, forces = 0.0, []
    for tick in range(300, 700):
        state = observer.step(state, tick * MS, Innovation(x, tick * MS))
        forces.append(state.residual_force_n)
        v += -0.1 * state.virtual_force_n * 1e-3
        x += v * 1e-3
    assert max(map(abs, forces)) < 1500.0
    assert abs(x) < 1e-4
