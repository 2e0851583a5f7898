"""Covariances of a linear filter over time, and their limit."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm  # pyright: ignore[reportUnknownVariableType]

Array = NDArray[np.float64]

_MOST_DOUBLINGS = 24
"""Of the recursion for the limit: as many updates as in four hours at 1 kHz. What grows for ever,
as the error of an undamped motion that nothing measures, is what it is then."""


def discretise(
    rates: Array, density: Array, time: float, own_rate: float = 0.0
) -> tuple[Array, Array]:
    """Transition over a time, and covariance of what white noise adds meanwhile, each (n, n).

    Args:
        rates: Derivative of the state by the state, shape (n, n).
        density: Of the noise, shape (n, n).
        time: In the unit of the rates.
        own_rate: How fast the fastest motion decays by itself.

    Reference: Van Loan, Computing integrals involving the matrix exponential, IEEE TAC 23 (1978).
    """
    # Van Loan's matrix grows where a motion decays by itself: a short time, doubled.
    doublings = max(0, math.ceil(math.log2(max(time * own_rate, 1.0))))
    short, n = time / 2**doublings, len(rates)
    generator: Array = short * np.block([[-rates, density], [np.zeros((n, n)), rates.T]])
    both = expm(generator)
    transition = np.ascontiguousarray(both[n:, n:].T)
    noise = transition @ both[:n, n:]
    for _ in range(doublings):
        noise = noise + transition @ noise @ transition.T
        transition = transition @ transition
    return transition, 0.5 * (noise + noise.T)


def limit_ahead(transition: Array, noise: Array, information: Array) -> Array:
    """Limit of the covariance before an update, shape (n, n).

    Args:
        transition: From one update to the next, shape (n, n).
        noise: Covariance that it adds.
        information: Of an update: rows of its readings over their deviations, transposed, times
            these rows.

    The length of the recursion is doubled in each iteration.

    Reference: Chu, Fan, Lin, Wang, Structure-preserving algorithms for periodic discrete-time
    algebraic Riccati equations, Int. J. Control 77 (2004).
    """
    a, g, ahead = transition.T, information, noise
    eye = np.eye(len(noise))
    for _ in range(_MOST_DOUBLINGS):
        between = np.linalg.inv(eye + g @ ahead)
        before = ahead
        ahead = ahead + a.T @ ahead @ between @ a
        ahead = 0.5 * (ahead + ahead.T)
        g = g + a @ between @ g @ a.T
        g = 0.5 * (g + g.T)
        a = a @ between @ a
        change = np.abs(np.diagonal(ahead) - np.diagonal(before))
        if np.all(change <= 1e-12 * np.diagonal(ahead)):
            break
    return ahead
