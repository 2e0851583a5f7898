"""Runge and Kutta's fourth-order method on lists, for the benches of these tests."""

from collections.abc import Callable

import numpy as np

State = list[float]


def integrated(
    derivative: Callable[[float, State], State],
    start: State,
    samples: int,
    step_s: float,
    fine: int,
):
    """State at each sample, shape (samples, states).

    Args:
        derivative: Time (s), state -> derivative.
        start: State at time zero.
        samples: Number of samples.
        step_s: Time between samples.
        fine: Integration steps between samples.
    """
    h = step_s / fine
    state = list(start)
    rows = []
    for k in range(samples):
        rows.append(state)
        for j in range(fine):
            t = (k * fine + j) * h
            first = derivative(t, state)
            second = derivative(t + 0.5 * h, _moved(state, first, 0.5 * h))
            third = derivative(t + 0.5 * h, _moved(state, second, 0.5 * h))
            fourth = derivative(t + h, _moved(state, third, h))
            slopes = zip(first, second, third, fourth, strict=True)
            mean = [(a + 2.0 * b + 2.0 * c + d) / 6.0 for a, b, c, d in slopes]
            state = _moved(state, mean, h)
    return np.array(rows)


def _moved(state: State, slope: State, reach: float) -> State:
    return [x + reach * d for x, d in zip(state, slope, strict=True)]


def measured(heights_m, noise_m, resolution_m, seed):
    """Heights as a sensor gives them: noisy and rounded."""
    rng = np.random.default_rng(seed)
    noisy = heights_m + rng.normal(0.0, noise_m, np.shape(heights_m))
    return np.round(noisy / resolution_m) * resolution_m
