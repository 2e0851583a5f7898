"""How far channels are late, from the force that a measured motion takes.

With the right delays the force of a strut is a function of height and velocity with dry friction,
as far as the strut is one. So the force is fitted with such functions and with its own derivatives
by the delays: the part of these that the functions cannot represent determines the error of the
delays and its covariance. Repeated until it converges this is the method of Gauss and Newton.

A single sine determines no delay: whatever is periodic is a function of height and velocity there.

Where there are more struts than coordinates, a motion does not show forces of struts that are in
balance with one another. Without these, the force of a strut contains shares of the forces of other
struts, so that the functions of all struts are fitted together.

References:
    Golub, Pereyra, SIAM J. Numer. Anal. 10 (1973), projection of linear parameters.
    Dahl, A solid friction model, Aerospace Corporation TOR-0158 (1968).
    Newey, West, A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent
    covariance matrix, Econometrica 55 (1987).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

Array = NDArray[np.float64]

_KNOTS = 25
"""Knots of the piecewise linear functions of height and of velocity, evenly over their ranges: a
stop has its contact within a twenty-fourth of the stroke. Polynomials cannot bend so sharply, and a
stop was taken for a delay of a millisecond."""

_SLOW = (0.0, 3e-3, 1e-2, 3e-2)
"""Shares of the largest velocity up to which dry friction rises, which has no knot there."""

_ITERATIONS = 8
"""Steps of Gauss and Newton at most."""

_RANK = 1e-9
"""Eigenvalues below this share of the largest are rounding: of the functions some are alike."""

_FRICTION_OF_STROKE = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
"""Displacements over which dry friction reverses, as shares of the stroke: presliding of tens of
micrometres to a soft seal. Without friction among the functions, its hysteresis is taken for a
delay; with only three of them, some 0.1 ms of it were."""

_NO_SHARE = 1e-9
"""Products of the shares of two struts below this are rounding, over those of each with itself."""

_EXACT = 1e-6
"""Least error of a strut's force that is weighed, as a share of the largest error."""

_LEAST_OWN = 1e-4
"""Of a derivative's power that the derivatives by other delays must not be able to give: channels
that move alike are late together. Of the posts of a car they leave 0.01."""

_LEAST_SHARE = 0.03
"""Of a derivative's power, without what those by other delays give of it, that the functions must
not be able to give. Of one sine they leave
1e-5, with friction 0.002; of seven sines 0.3, with a stop, whose rise they can give, 0.09."""


class ForceOverTime(NamedTuple):
    """The force that a strut takes along its measured motion.

    Attributes:
        height_m: Shape (N,).
        velocity_m_per_s: Shape (N,).
        force_n: With the delays as they are assumed, shape (N,).
        by_delays: Its derivatives by them, shape (N, delays).
        further: Signals that may be in the forces of all struts in one proportion each (a mass that
            is not quite known): their parts in this one's, shape (N, signals).
        shares: Share of each strut's force that is in it, shape (N, struts): at each time the rows
            of all struts are a projection.
    """

    height_m: Array
    velocity_m_per_s: Array
    force_n: Array
    by_delays: Array
    further: Array
    shares: Array


class DelayStep(NamedTuple):
    """Changes of delays in s, and their standard deviations: infinite where undetermined."""

    steps_s: Array
    stds_s: Array


def delay_step(struts: Sequence[ForceOverTime]) -> DelayStep:
    """Errors of delays that the forces of all struts show together.

    A strut whose force is not finite is left out.
    """
    delays = struts[0].by_delays.shape[1]
    steps, stds = np.zeros(delays), np.full(delays, np.inf)
    known = [i for i, strut in enumerate(struts) if np.all(np.isfinite(strut.force_n))]
    if not known:
        return DelayStep(steps, stds)
    forces = _Forces.of([struts[i]._replace(shares=struts[i].shares[:, known]) for i in known])
    left = forces.left(np.ones(len(known)))
    # Where the functions leave more, errors are larger.
    errors_n = left[..., 0].std(axis=1)
    weights = 1.0 / np.maximum(errors_n, max(_EXACT * float(errors_n.max()), 1e-300))
    left, slopes = (
        (weights[:, np.newaxis, np.newaxis] * part).reshape(-1, part.shape[2])
        for part in (forces.left(weights), forces.both[..., 1:])
    )
    residual, direction = left[:, 0], left[:, 1:]
    gram, whole = direction.T @ direction, slopes.T @ slopes
    own = [_own_power(whole, i) for i in range(delays)]
    determined = [
        own[i] > _LEAST_OWN * whole[i, i] and _own_power(gram, i) > _LEAST_SHARE * own[i]
        for i in range(delays)
    ]
    which = np.flatnonzero(determined)
    if not len(which):
        return DelayStep(steps, stds)
    inverse = np.linalg.inv(gram[np.ix_(which, which)])
    steps[which] = -inverse @ (direction[:, which].T @ residual)
    # Correlated errors: the variance of a product's sum, from its own spectrum at zero, with what
    # the fit leaves as error.
    errors = (residual + direction[:, which] @ steps[which])[:, np.newaxis] * direction[:, which]
    # Those of different struts at a time are correlated, too.
    errors = errors.reshape(len(known), -1, len(which)).sum(axis=0)
    covariance = inverse @ _long_run_covariance(errors) @ inverse
    stds[which] = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return DelayStep(steps, stds)


class _Forces(NamedTuple):
    """Forces of struts and what may be in them.

    Attributes:
        both: Forces and their derivatives by the delays, shape (struts, N, 1 + delays).
        functions: Of the motion of each strut, shapes (N, functions).
        shares: Share of the force of a strut (last) in another's, shape (struts, N, struts).
        further: Signals that may be in all forces in one proportion, shape (struts, N, signals).
    """

    both: Array
    functions: list[Array]
    shares: Array
    further: Array

    @classmethod
    def of(cls, struts: Sequence[ForceOverTime]) -> "_Forces":
        """The forces of some struts, whose shares are those in each other."""
        return cls(
            np.array([np.column_stack([it.force_n, it.by_delays]) for it in struts]),
            [_functions(it.height_m, it.velocity_m_per_s) for it in struts],
            np.array([it.shares for it in struts]),
            np.array([it.further for it in struts]),
        )

    def left(self, weights: Array) -> Array:
        """What functions and further signals leave of the forces, weighted by strut, as `both`."""
        squares = weights[:, np.newaxis, np.newaxis] ** 2
        weighted = squares * self.shares
        targets = np.concatenate([self.further, self.both], axis=2)
        with_targets = np.vstack(
            [
                rows.T @ np.einsum("rk,rkm->km", weighted[..., i], targets)
                for i, rows in enumerate(self.functions)
            ]
        )
        signals = self.further.shape[2]
        among = np.einsum("rkm,rkn->mn", squares * self.further, targets)
        shared = with_targets[:, :signals]
        gram = np.block([[self._products(weighted), shared], [shared.T, among[:, :signals]]])
        against = np.vstack([with_targets[:, signals:], among[:, signals:]])
        coefficients = _solve_projection(gram, against)
        ends = np.cumsum([rows.shape[1] for rows in self.functions])
        *own, rest = np.split(coefficients, ends)
        given = np.array([rows @ part for rows, part in zip(self.functions, own, strict=True)])
        return self.both - np.einsum("rks,skm->rkm", self.shares, given) - self.further @ rest

    def _products(self, weighted: Array) -> Array:
        """Products among the functions of all struts; `weighted`: shares times squared weights.

        With the matrix P of shares at a time and weights W, the functions F of a strut i are
        P[:, i] F in all forces: the product of two of them is F times (PᵀW²P)[i, j] times F.
        """
        metric = np.einsum("rki,rkj->ijk", weighted, self.shares)
        sizes = np.abs(metric).max(axis=2)
        own = np.sqrt(np.diag(sizes))
        linked = sizes > _NO_SHARE * np.outer(own, own)
        return np.block(
            [
                [
                    a.T @ (metric[i, j, :, np.newaxis] * b)
                    if linked[i, j]
                    else np.zeros((a.shape[1], b.shape[1]))
                    for j, b in enumerate(self.functions)
                ]
                for i, a in enumerate(self.functions)
            ]
        )


def _solve_projection(gram: Array, against: Array) -> Array:
    """Coefficients (k, m) of least squares by products of columns, some of which may be alike.

    `gram` are the products among them, shape (k, k), and `against` those with targets, (k, m).
    """
    norm = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(norm, norm))
    kept = values > _RANK * values[-1]
    basis = vectors[:, kept] / np.sqrt(values[kept])
    return (basis @ (basis.T @ (against / norm[:, np.newaxis]))) / norm[:, np.newaxis]


def delay_between(late: Array, course: Array, step_s: float) -> tuple[float, float]:
    """Delay of a signal against a known course of it in s, and its standard deviation.

    Both are of shape (N,), `step_s` apart; NaN in the signal is left out.
    """
    delay_s, std_s = 0.0, np.inf
    t_s = step_s * np.arange(len(course))
    known = np.isfinite(late)
    for _ in range(_ITERATIONS):
        seen = np.interp(t_s - delay_s, t_s, course)
        slope = np.gradient(seen, step_s)
        both = np.column_stack([np.ones_like(slope), slope])[known]
        power = float(np.sum((both[:, 1] - both[:, 1].mean()) ** 2))
        if power <= 0.0:
            return 0.0, np.inf
        # A cell's zero is no matter of its delay.
        error = (late - seen)[known]
        solution = np.linalg.lstsq(both, error, rcond=None)[0]
        change = float(solution[1])
        left = error - both @ solution
        errors = (left * (both[:, 1] - both[:, 1].mean()))[:, np.newaxis]
        std_s = float(np.sqrt(max(_long_run_covariance(errors)[0, 0], 0.0))) / power
        delay_s -= change
        if abs(change) < 0.01 * std_s:
            break
    return delay_s, std_s


def _own_power(gram: Array, i: int) -> float:
    """Power of a direction that the others cannot give."""
    others = [k for k in range(len(gram)) if k != i]
    if not others:
        return float(gram[i, i])
    part = gram[np.ix_(others, others)]
    shared = gram[i, others] @ np.linalg.lstsq(part, gram[others, i], rcond=None)[0]
    return float(gram[i, i] - shared)


def _functions(height: Array, velocity: Array) -> Array:
    """Functions (N, functions) of height, velocity and direction."""
    stroke_m = max(float(np.ptp(height)), 1e-12)
    fastest = max(float(np.abs(velocity).max()), 1e-12)
    z, v = 2.0 * (height - height.mean()) / stroke_m, velocity / fastest
    # Each bend with the other quantity, too: a stop that damps, a damper that has zones.
    bends = [
        column
        for one, other in ((z, v), (v, z))
        for bend in (np.maximum(0.0, one - knot) for knot in _inner_knots(one))
        for column in (bend, bend * other)
    ]
    rising = [np.clip(v / max(share, 1e-9), -1.0, 1.0) for share in _SLOW]
    friction = [_friction(height, share * stroke_m) for share in _FRICTION_OF_STROKE]
    return np.column_stack([np.ones_like(z), z, v, z * v, *bends, *rising, *friction])


def _inner_knots(values: Array) -> Array:
    """Knots of a piecewise linear function between its ends."""
    return np.linspace(float(values.min()), float(values.max()), _KNOTS)[1:-1]


def _friction(height_m: Array, reversal_m: float) -> Array:
    """Dry friction of unit size along heights, shape (N,), after Dahl."""
    change = np.diff(height_m)
    kept = np.exp(-np.abs(change) / reversal_m)
    gained = np.sign(change) * (1.0 - kept)
    force = [0.0]
    for keep, gain in zip(kept.tolist(), gained.tolist(), strict=True):
        force.append(keep * force[-1] + gain)
    return np.array(force)


def _long_run_covariance(values: Array) -> Array:
    """Covariance of the sums of correlated series (N, k), Bartlett weights up to a tenth of N."""
    count = len(values)
    lags = max(1, count // 10)
    size = next_fast_len(2 * count, real=True)
    spectrum = np.fft.rfft(values, size, axis=0)
    weights = 1.0 - np.arange(lags + 1) / (lags + 1)
    covariance = np.empty((values.shape[1],) * 2)
    for i in range(values.shape[1]):
        for j in range(values.shape[1]):
            products = np.fft.irfft(spectrum[:, i] * np.conj(spectrum[:, j]), size)
            ahead, behind = products[: lags + 1], products[-lags:]
            covariance[i, j] = float(weights @ ahead + weights[1:] @ behind[::-1])
    return covariance
