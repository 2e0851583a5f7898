"""How far a joint filter lags behind forces that change faster than it allows for.

As in `rig.observers.filter_lag`, for several heights at once. Without noise the errors x of the
observed heights obey, with the innovations nu of all heights and the gains of the interval,

    d²x/dt² = a + A (x, v) - L_2 nu,    x = nu,    dx/dt = v - L_1 nu,

each innovation in the error of each height; A is the model's own motion, a are the accelerations by
the errors of the residual forces, and these forces are M⁻¹ a with the mobility M of the observed
struts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import (  # pyright: ignore[reportUnknownVariableType, reportMissingTypeStubs]
    solve_discrete_lyapunov,
)

from rig.observers.error_filter import MOST_HELD
from rig.observers.filter_lag import FADING, LARGEST_OF_NOISE, derivatives_filter

Array = NDArray[np.float64]


class JointLag(NamedTuple):
    """Lag of the forces of p observed struts, as the innovations of m heights show it.

    Attributes:
        t_ns: Time of the last innovations.
        filtered: Filtered innovations and two derivatives, for each force, shape (p, m, 3).
        square_n2: Mean square of each force's lag, shape (p,).
        peak_n2: Fading peak of that square, shape (p,).
    """

    t_ns: int
    filtered: Array
    square_n2: Array
    peak_n2: Array


class JointLagFilter:
    """The filter of the innovations.

    Args:
        omegas: Corners of the forces in rad/s, p of them.
        interval_s: Time between two innovations.
        gains: Gains in SI of the errors of the observed heights and of their rates, less what the
            model itself changes in an interval, and a one for each one's own height; each by all
            innovations, shape (3, p, m).
        by_accelerations: Forces by accelerations of the observed heights, shape (p, p).
        innovations_m2: Steady covariance of the innovations, shape (m, m).
    """

    def __init__(
        self,
        omegas: Sequence[float],
        interval_s: float,
        gains: tuple[Array, Array, Array],
        by_accelerations: Array,
        innovations_m2: Array,
    ) -> None:
        self._interval_ns = round(interval_s * 1e9)
        of_error, of_rate, own = gains
        # Of filtered innovations, rates and curvatures: what they show of each force.
        show = np.stack([of_rate / interval_s, of_error / interval_s, own], axis=2)
        force = np.einsum("pk,kmi->pmi", by_accelerations, show)
        transitions: list[Array] = []
        shares: list[Array] = []
        white: list[float] = []
        for place, omega in enumerate(omegas):
            transition, share, units = derivatives_filter(omega, interval_s)
            force[place] *= units
            each = solve_discrete_lyapunov(transition, np.outer(share, share))
            together = force[place] @ each @ force[place].T
            white.append(float(np.sum(together * innovations_m2)))
            transitions.append(transition)
            shares.append(share)
        self._force, self._white_n2 = force, np.array(white)
        self._transitions, self._shares = np.array(transitions), np.array(shares)
        self._fading = np.minimum(1.0, np.array(omegas) * interval_s / FADING)

    def init(self, t_ns: int, before: JointLag | None = None) -> JointLag:
        """Lag at a start; it keeps the squares that there were before."""
        still, none = np.zeros_like(self._force), np.zeros_like(self._white_n2)
        if before is None:
            return JointLag(t_ns, still, none, none)
        return before._replace(t_ns=t_ns, filtered=still)

    def update(self, lag: JointLag, t_ns: int, innovations_m: Array) -> JointLag:
        """Lag after innovations at a time, (m,), as large as with a steady filter."""
        number = max(1, round((t_ns - lag.t_ns) / self._interval_ns))
        filtered, square, peak = lag.filtered, lag.square_n2, lag.peak_n2
        put = self._shares[:, None, :] * innovations_m[None, :, None]
        for _ in range(min(number, MOST_HELD)):
            filtered = filtered @ self._transitions.transpose(0, 2, 1) + put
            new = np.square((self._force * filtered).sum(axis=(1, 2)))
            peak = np.maximum(new, peak - self._fading * peak)
            square = square + self._fading * (new - square)
        return JointLag(t_ns, filtered, square, peak)

    def variances_n2(self, lag: JointLag, scales: Array) -> Array:
        """Variance of each force by its lag, beyond what white innovations show, shape (p,).

        `scales` are the variances of the struts' sensors over the configured ones.
        """
        white = scales * self._white_n2
        beyond = np.maximum(lag.square_n2 - white, lag.peak_n2 - LARGEST_OF_NOISE * white)
        return np.maximum(beyond, 0.0)
