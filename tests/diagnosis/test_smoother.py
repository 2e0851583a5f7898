"""Noise of a signal whose record has a gap near its start."""

import numpy as np
import pytest

from rig.diagnosis.numerics.smoother import estimate_noise, smooth

NOISE_M = 13e-6


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
