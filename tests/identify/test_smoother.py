"""The smoother against the batch solution of the same problem, and what it says of the noise."""

import numpy as np
import pytest

from rig.identify.smoother import Noise, estimate_noise, smooth


def steps_of(t_s):
    """Transition and covariance of the integrated walk for every step, by quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    for h in np.diff(t_s):

        def power(x):
            return np.array([x**3 / 6.0, x**2 / 2.0, x, 1.0])

        transition = np.array(
            [[1, h, h**2 / 2, h**3 / 6], [0, 1, h, h**2 / 2], [0, 0, 1, h], [0, 0, 0, 1.0]]
        )
        covariance = sum(
            0.5 * h * w * np.outer(power(0.5 * h * (1 + x)), power(0.5 * h * (1 + x)))
            for x, w in zip(nodes, weights, strict=True)
        )
        yield transition, covariance


def batch(t_s, y, variance, ratio):
    """Posterior mean and deviation of all states at once, by weighted least squares."""
    n = len(t_s)
    rows, targets = [], []
    for k, value in enumerate(y):
        if np.isfinite(value):
            row = np.zeros(4 * n)
            row[4 * k] = 1.0
            rows.append(row / np.sqrt(variance))
            targets.append(value / np.sqrt(variance))
    for k, (transition, covariance) in enumerate(steps_of(t_s)):
        root = np.linalg.inv(np.linalg.cholesky(covariance * ratio * variance))
        block = np.zeros((4, 4 * n))
        block[:, 4 * k : 4 * k + 4] = -root @ transition
        block[:, 4 * k + 4 : 4 * k + 8] = root
        rows.extend(block)
        targets.extend(np.zeros(4))
    matrix = np.array(rows)
    covariance = np.linalg.inv(matrix.T @ matrix)
    mean = covariance @ (matrix.T @ np.array(targets))
    return mean.reshape(n, 4), np.sqrt(np.diag(covariance)).reshape(n, 4)


def test_it_is_the_batch_solution_with_uneven_times_and_gaps():
    rng = np.random.default_rng(3)
    t_s = np.cumsum(rng.uniform(0.05, 0.15, 40))
    y = np.sin(2.0 * t_s) + rng.normal(0.0, 0.1, 40)
    y[[5, 6, 20]] = np.nan
    variance, ratio = 0.01, 3e3
    mean, deviation = batch(t_s, y, variance, ratio)
    found = smooth(t_s, y, Noise(variance, ratio))
    np.testing.assert_allclose(found.states[:, :3], mean[:, :3], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.deviations[:, :3], deviation[:, :3], rtol=2e-3)


@pytest.mark.parametrize("noise", [1e-6, 1e-4])
def test_it_finds_the_sensors_noise(noise):
    rng = np.random.default_rng(4)
    t_s = np.arange(6000) * 1e-3
    signal = 2e-3 * np.sin(9.0 * t_s) + 1e-3 * np.sin(31.0 * t_s)
    found = estimate_noise(t_s, signal + rng.normal(0.0, noise, len(t_s)))
    assert np.sqrt(found.variance) == pytest.approx(noise, rel=0.05)


def test_its_deviation_is_its_error_and_it_has_no_lag():
    rng = np.random.default_rng(6)
    t_s = np.arange(8000) * 1e-3
    omega = 12.0
    y = 2e-3 * np.sin(omega * t_s) + rng.normal(0.0, 1e-5, len(t_s))
    found = smooth(t_s, y, estimate_noise(t_s, y))
    inner = slice(500, -500)
    for k in range(3):
        truth = 2e-3 * omega**k * np.sin(omega * t_s + 0.5 * np.pi * k)
        error = (found.states[:, k] - truth)[inner]
        claimed = np.sqrt(np.mean(found.deviations[inner, k] ** 2))
        assert 0.3 * claimed < np.sqrt(np.mean(error**2)) < 1.5 * claimed
        lead = np.mean(error * np.cos(omega * t_s[inner] + 0.5 * np.pi * k))
        assert abs(lead) < 1e-3 * 2e-3 * omega**k
