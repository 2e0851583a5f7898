"""Noise of a signal whose record has a gap near its start, or that jumps."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rig.diagnosis.numerics.smoother import estimate_noise, estimate_noise_beside_jumps, smooth

NOISE_M = 13e-6
NOISE_N = 0.6


def test_a_gap_behind_the_first_samples_does_not_hide_the_noise():
    """With a hardly known state the prediction over the gap loses all digits of small ratios."""
    t_s = 0.004 * np.arange(1600)
    t_s = t_s[(t_s < 0.006) | (t_s > 0.4)]
    rng = np.random.default_rng(1)
    true_m = 1.5 * t_s - 0.2 * t_s**2 + 0.01 * np.sin(20.0 * t_s)
    noise = estimate_noise(t_s, true_m + NOISE_M * rng.standard_normal(len(t_s)))
    assert np.sqrt(noise.variance) == pytest.approx(NOISE_M, rel=0.1)
    # A tick may be 35 ns beside a sample.
    all_s = np.union1d(t_s, t_s[::7] + 35e-9)
    known_m = np.full(len(all_s), np.nan)
    known_m[np.searchsorted(all_s, t_s)] = true_m
    smoothed = smooth(all_s, known_m, noise)
    assert np.all(np.isfinite(smoothed.deviations))
    late = all_s > 0.5
    rate = 1.5 - 0.4 * all_s + 0.2 * np.cos(20.0 * all_s)
    assert smoothed.states[late, 1] == pytest.approx(rate[late], abs=5e-3)


def cell_n(noise_n, seed=3):
    """A load cell at 1 kHz: a spring, and friction that jumps six times a second."""
    t_s = 0.001 * np.arange(12_000)
    motion = np.sin(6.0 * np.pi * t_s)
    noise = noise_n * np.random.default_rng(seed).standard_normal(len(t_s))
    return t_s, 300.0 * motion + 30.0 * np.sign(np.cos(6.0 * np.pi * t_s)) + noise


def test_jumps_do_not_count_as_noise():
    t_s, force_n = cell_n(NOISE_N)
    assert np.sqrt(estimate_noise(t_s, force_n).variance) > 1.5 * NOISE_N
    assert estimate_noise_beside_jumps(force_n) == pytest.approx(NOISE_N, rel=0.1)


def test_values_that_are_held_count_once():
    _, force_n = cell_n(NOISE_N)
    held = np.repeat(force_n, 5)
    assert estimate_noise_beside_jumps(held) == estimate_noise_beside_jumps(force_n)


def test_of_coloured_noise_more_than_its_differences_between_samples_is_seen():
    """First-order noise: differences of fourth order of samples of distance h have the variance
    sum_jk c_j c_k exp(-|j - k| h / tau)."""
    tau_s = 2e-3
    white = np.random.default_rng(5).standard_normal(40_000)
    kept = np.exp(-1e-3 / tau_s)
    noise = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], white)
    weights = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    lags = np.abs(np.subtract.outer(np.arange(5), np.arange(5)))
    expected = [np.sqrt(weights @ kept ** (h * lags) @ weights / 70.0) for h in (1, 3)]
    assert expected[0] < 0.6
    assert expected[1] > 0.8
    assert estimate_noise_beside_jumps(noise) == pytest.approx(expected[1], rel=0.03)


def test_a_constant_has_no_noise_to_estimate():
    assert estimate_noise_beside_jumps(np.zeros(100)) == np.inf
