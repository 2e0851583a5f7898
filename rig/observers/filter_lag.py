"""How far a filter lags behind a force that changes faster than its random walk allows for.

The variances of a filter are those of its noise. Where the force moves more, the estimate lags, and
the innovations show it: they are no longer white. Without noise the error's own equation,

    d²x/dt² = a - L_2 nu,    x = nu,    dx/dt = v - L_1 nu,

with innovation nu, gains L_1 and L_2 of error and rate over the interval, and error a of the
acceleration by the residual force, gives

    a = d²nu/dt² + L_1 dnu/dt + L_2 nu.

A Butterworth filter of third order gives these derivatives of the innovation. What the square of a
has beyond that of white innovations is the lag's: its mean, and its last peak, so that the lag of a
force that changes now and then is stated where it occurs.

Reference: Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE TAC 15
(1970), for the innovations of a filter that is not optimal.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import (  # pyright: ignore[reportUnknownVariableType, reportMissingTypeStubs]
    expm,
    solve_discrete_lyapunov,
)

Array = NDArray[np.float64]

_CORNER = 1.5
"""Corner of the derivatives over that of the filter."""

FADING = 20.0
"""Time constant with which their square is followed, in units of 1 / omega."""

LARGEST_OF_NOISE = 9.0
"""Square that white innovations hardly ever show, over its mean: three standard deviations."""


class Lag(NamedTuple):
    """Filtered innovation in m, two derivatives, mean and fading peak of a lag's square (m²/s⁴)."""

    value: float = 0.0
    rate: float = 0.0
    curvature: float = 0.0
    square: float = 0.0
    peak: float = 0.0


NO_LAG = Lag()


class LagFilter(NamedTuple):
    """The filter of the innovations.

    Attributes:
        rows: Rows of its transition over an interval, and its input's share.
        output: Lag per value, rate and curvature.
        white: Mean square of the lag that white innovations of the filter's own variance show.
        fading: Share of the newest square in the mean.
    """

    rows: tuple[tuple[float, float, float, float], ...]
    output: tuple[float, float, float]
    white: float
    fading: float


def derivatives_filter(omega: float, interval_s: float) -> tuple[Array, Array, Array]:
    """Filter of an innovation and of two derivatives, for a force with a corner in rad/s.

    The result is its transition over an interval, (3, 3), the share of the innovation, (3,), and
    the units of value, rate and curvature, (3,).
    """
    corner = _CORNER * omega
    # In units of 1 / corner, where the numbers are of one size.
    rates = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [-1, -2, -2, 1], [0, 0, 0, 0]])
    step = expm(rates * (corner * interval_s))
    return step[:3, :3], step[:3, 3], np.power(corner, np.arange(3.0))


def make_lag_filter(
    omega: float, interval_s: float, gain: tuple[float, float], innovation_m2: float
) -> LagFilter:
    """The filter for innovations of a variance, with a gain in SI (of error, and of its rate)."""
    transition, share, units = derivatives_filter(omega, interval_s)
    output = np.array([gain[1] / interval_s, gain[0] / interval_s, 1.0]) * units
    covariance = solve_discrete_lyapunov(transition, np.outer(share, share) * innovation_m2)
    white = float(output @ covariance @ output)
    rows = tuple(
        (a, b, c, d) for (a, b, c), d in zip(transition.tolist(), share.tolist(), strict=True)
    )
    return LagFilter(rows, tuple(output.tolist()), white, min(1.0, omega * interval_s / FADING))


def update_lag(lag: Lag, filtered: LagFilter, new_m: float) -> Lag:
    """The lag after an innovation."""
    (a, b, c, d), (e, f, g, h), (p, q, r, s) = filtered.rows
    x, y, z, square, peak = lag
    value = a * x + b * y + c * z + d * new_m
    rate = e * x + f * y + g * z + h * new_m
    curvature = p * x + q * y + r * z + s * new_m
    by_value, by_rate, by_curvature = filtered.output
    now = by_value * value + by_rate * rate + by_curvature * curvature
    new = now * now
    peak -= filtered.fading * peak
    square += filtered.fading * (new - square)
    return Lag(value, rate, curvature, square, max(new, peak))


def lag_variance(lag: Lag, filtered: LagFilter, scale: float) -> float:
    """Variance of the lag in m²/s⁴, beyond what innovations of a scaled variance show."""
    white = scale * filtered.white
    return max(0.0, lag.square - white, lag.peak - LARGEST_OF_NOISE * white)
