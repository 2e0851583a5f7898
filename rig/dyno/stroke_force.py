"""One fit of a block's force, of which every figure is a functional.

All strokes of one direction lie over one another along the angle theta = asin(u), u the position
in the stroke from -1 to 1: along it the force of a damper under a sine is smooth up to the turning
points, where along the height it has infinite slopes. A cubic spline through the samples of all
strokes is the mean stroke. Its uncertainty is what the strokes differ by, and the noise: the
sandwich of the least squares with strokes as clusters, or the plain covariance, whichever is
larger; and what the next simpler spline and the next one would say differs by.

References:
    De Boor, A Practical Guide to Splines (2001).
    Cameron and Miller, A practitioner's guide to cluster-robust inference, J. Human Resources 50
    (2015), for covariance and degrees of freedom.
    Dixon, The Shock Absorber Handbook (2007), 10, for the tests.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.special import stdtrit  # pyright: ignore[reportUnknownVariableType]

from rig.dyno.strokes import Array, BlockMotion

_DEGREE = 3
_PIECES = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 72, 108, 160)
"""Pieces of a spline that are tried; none is the linear strut alone."""

_FEWEST_IN_A_PIECE = 4
"""Samples of a piece, which has four coefficients: a spline without them is free there."""

_FOLLOWS_A_SINE = 8
"""Pieces from which on a spline follows a sine to 1e-4 of it: sine and cosine as further columns
would be linear combinations of its own."""

_UNDERSMOOTHED = 1
"""Steps by which the spline is more flexible than the best for the curve itself: the best curve has
a bias as large as its noise, and intervals about it miss the truth (Hall, Ann. Stat. 20, 1992)."""

_VELOCITY_PIECES = (16, 8, 4, 2, 1, 0)
"""Of the mean velocity, which has no noise to speak of."""

_WORST_CONDITION = 1e10
"""Of the normal equations: beyond it the samples leave a part of the stroke open."""

_MOST_LEVERAGE = 1.0
"""Variance of a spline at any angle over that of a sample: beyond it the spline extrapolates."""

_COVERAGE = 0.95
_FEWEST_CLUSTERS = 4
"""Strokes from which on their differences are believed."""


class Figure(NamedTuple):
    """A figure with its 95 % interval, and the method that gave it.

    Where samples that it depends on were clipped, an end of the interval is infinite: the value is
    a bound. If both are, the value means nothing.
    """

    value: float
    low: float
    high: float
    method: str

    @classmethod
    def around(cls, value: float, half: float, method: str) -> "Figure":
        """A figure in the middle of its interval, of which `half` is half the width."""
        return cls(value, value - half, value + half, method)

    def scaled(self, factor: float) -> "Figure":
        """The figure times a factor, which may be negative."""
        low, high = sorted((factor * self.low, factor * self.high))
        return self._replace(value=factor * self.value, low=low, high=high)

    @property
    def half(self) -> float:
        """Half the width of its interval."""
        return 0.5 * (self.high - self.low)

    @property
    def is_bounded(self) -> bool:
        """Whether both ends of its interval are known."""
        return math.isfinite(self.low) and math.isfinite(self.high)


class ForceRange(NamedTuple):
    """Forces at which a load cell is clipped; infinite where it is not."""

    low_n: float = -math.inf
    high_n: float = math.inf

    def within(self, other: "ForceRange") -> "ForceRange":
        """The range that both leave."""
        return ForceRange(max(self.low_n, other.low_n), min(self.high_n, other.high_n))

    def touches(self, force_n: Array) -> bool:
        """Whether forces reach an end of it, or nearly."""
        low, high = self.low_n, self.high_n
        at_low = math.isfinite(low) and force_n.min() <= low + _AT_LIMIT_SHARE * abs(low)
        at_high = math.isfinite(high) and force_n.max() >= high - _AT_LIMIT_SHARE * abs(high)
        return bool(at_low or at_high)


_MIDDLE, _CONSTANT = 0.5, 0.1
"""Half of the stroke, and how much of the speed may differ in it where it is called constant: under
a sine 13 per cent do."""

_AT_LIMIT_SHARE, _AT_LIMIT_STDS, _BESIDE = 0.005, 4.0, 2
"""Share of a limit and standard deviations within which a mean stroke is clipped, and how many
angles next to it, where the spline rounds the corner."""

_GRID = 181
ANGLES: Array = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _GRID)
"""Angles at which a mean stroke is kept, linear in between: its bend there is a hundredth of a per
cent of its force."""


_PARTS = (9, 90)
"""Fewest and most parts of a stroke over which samples are averaged stroke by stroke, two samples
each: 20 to 2 degrees."""

FINE: Array = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 361)
"""Angles at which samples are gathered, half a degree apart."""


class CycleMeans(NamedTuple):
    """Means of samples over strokes by phase, as they were measured.

    Attributes:
        mean_n: Mean over the strokes of each part, NaN where few have a sample, shape (P,).
        half_n: Half the 95 % interval by what the strokes differ by, infinite of a single one,
            shape (P,).
        angle: Middle of each part, shape (P,).
    """

    mean_n: Array
    half_n: Array
    angle: Array


class MeanStroke(NamedTuple):
    """The mean stroke of one direction.

    Attributes:
        sign: 1 for rebound, -1 for compression.
        middle_m: Height at mid-stroke.
        amplitude_m: Half the stroke.
        force_n: Force at `ANGLES`, shape (181,).
        covariance: Its covariance, shape (181, 181).
        freedom: Degrees of freedom.
        velocity_m_per_s: Velocity at `ANGLES`, shape (181,).
        samples: How many samples lie nearest to each of `FINE`, shape (361,).
        sums_n: Sums of their forces, shape (361,).
        noise_n: Standard deviation of a sample about the mean stroke.
        beyond: At `ANGLES` 1 where the true force lies above a clipped one, -1 where it lies below,
            else 0, shape (181,).
        cycles: Means over the strokes by phase.
    """

    sign: int
    middle_m: float
    amplitude_m: float
    force_n: Array
    covariance: Array
    freedom: float
    velocity_m_per_s: Array
    samples: Array
    sums_n: Array
    noise_n: float
    beyond: NDArray[np.int8]
    cycles: CycleMeans

    @property
    def height_m(self) -> Array:
        """Height at `ANGLES`, shape (181,)."""
        return self.middle_m + self.sign * self.amplitude_m * np.sin(ANGLES)

    @property
    def is_clipped(self) -> bool:
        """Whether its force was clipped somewhere."""
        return bool(np.any(self.beyond))

    def clipped_at(self, limits: ForceRange) -> "MeanStroke":
        """The same, marked where it is as good as at a limit, and next to that."""
        marks = np.zeros(_GRID, np.int8)
        for sign, limit in ((-1, limits.low_n), (1, limits.high_n)):
            if math.isfinite(limit):
                margin_n = _AT_LIMIT_SHARE * abs(limit) + _AT_LIMIT_STDS * np.sqrt(
                    np.diag(self.covariance)
                )
                at = sign * (self.force_n - limit) >= -margin_n
                marks[np.convolve(at, np.ones(2 * _BESIDE + 1), "same") > 0.0] = sign
        return self._replace(beyond=marks)

    @property
    def is_constant(self) -> bool:
        """Whether the speed is the same over the middle half of the stroke: a triangle, no sine."""
        speed = np.abs(self.velocity_m_per_s[np.abs(np.sin(ANGLES)) <= _MIDDLE])
        return float(np.ptp(speed)) <= _CONSTANT * float(speed.mean())

    def row(self, theta: Array | float) -> Array:
        """The force at angles as rows over `force_n`, shape (M, 181)."""
        position = (np.atleast_1d(theta) + 0.5 * np.pi) / np.pi * (_GRID - 1.0)
        before = np.clip(position.astype(np.int64), 0, _GRID - 2)
        share = np.clip(position - before, 0.0, 1.0)
        rows = np.zeros((len(position), _GRID))
        rows[np.arange(len(position)), before] = 1.0 - share
        rows[np.arange(len(position)), before + 1] = share
        return rows

    def peak_of_cycles(self) -> Figure:
        """The largest mean by phase against the motion, with what the strokes differ by there."""
        mean_n = self.cycles.mean_n
        at = int(np.argmax(np.where(np.isnan(mean_n), -math.inf, -self.sign * mean_n)))
        value, half = float(mean_n[at]), float(self.cycles.half_n[at])
        beyond = int(self.beyond[int(np.argmin(np.abs(ANGLES - self.cycles.angle[at])))])
        low = -math.inf if beyond < 0 else value - half
        high = math.inf if beyond > 0 else value + half
        width = 180.0 / len(mean_n)
        return Figure(
            value, low, high, f"largest mean of all strokes by phase, {width:.0f} degrees"
        )

    def figure(self, row: Array, method: str) -> Figure:
        """A linear functional of the force, with its interval."""
        return combine([(row, self)], method)


def combine(
    parts: Sequence[tuple[Array, MeanStroke]],
    method: str,
    factor: float = 1.0,
    relative_std: float = 0.0,
) -> Figure:
    """A sum of functionals of several mean strokes, with its interval.

    A part is a row over the forces of a mean stroke. The sum is multiplied by `factor`, whose
    relative standard deviation is `relative_std`.
    """
    value = factor * sum(float(row @ stroke.force_n) for row, stroke in parts)
    variances = [factor**2 * float(row @ stroke.covariance @ row) for row, stroke in parts]
    variance = sum(variances)
    # Welch's and Satterthwaite's degrees of freedom of a sum.
    weighted = sum(v * v / stroke.freedom for v, (_, stroke) in zip(variances, parts, strict=True))
    freedom = variance * variance / weighted if weighted > 0.0 else 1e9
    half = student_factor(freedom) * (variance + (relative_std * value) ** 2) ** 0.5
    # Where a force was clipped, the true one moves the sum in one direction or in both.
    moves = np.concatenate([np.sign(factor * row) * stroke.beyond for row, stroke in parts])
    low = -math.inf if np.any(moves < 0.0) else value - half
    high = math.inf if np.any(moves > 0.0) else value + half
    return Figure(value, low, high, method)


def student_factor(freedom: float) -> float:
    """Half width of a 95 % interval in standard deviations, by Student's t."""
    return float(stdtrit(freedom, 0.5 + 0.5 * _COVERAGE))


def mean_stroke(
    motion: BlockMotion, force_n: Array, number: NDArray[np.int64], sign: int
) -> MeanStroke | None:
    """The mean of the strokes of one direction; None where there are too few samples.

    The motion of the block has N samples; forces, and the stroke that each sample belongs to, have
    the shape (N,). `sign` is 1 for rebound, -1 for compression.
    """
    mine = sign * motion.velocity_m_per_s > 0.0
    along = sign * motion.between_m_per_s > 0.0
    if not mine.any() or not along.any():
        return None
    low, high = float(motion.between_m.min()), float(motion.between_m.max())
    middle, amplitude = 0.5 * (low + high), 0.5 * (high - low)
    force_n, number = force_n[mine], number[mine]
    theta, between = (
        np.arcsin(np.clip(sign * (height_m - middle) / amplitude, -1.0, 1.0))
        for height_m in (motion.height_m[mine], motion.between_m[along])
    )
    made = [_fit_spline(theta, force_n, number, pieces) for pieces in _PIECES]
    fits = [item for item in made if item is not None]
    if not fits:
        return None
    chosen = int(np.argmin([item.criterion for item in fits]))
    chosen = min(chosen + _UNDERSMOOTHED, len(fits) - 1)
    best = fits[chosen]
    # The noise is that of the most flexible fit: what the chosen one leaves out counts too.
    noise = max(best.variance, fits[-1].variance)
    covariance, freedom = noise * best.inverse, fits[-1].freedom
    if best.clustered is not None and np.trace(best.clustered) > np.trace(covariance):
        covariance, freedom = best.clustered, best.clusters - 1.0
    rows = _design(ANGLES, best.pieces)
    forces = rows @ best.weights
    covariance = rows @ covariance @ rows.T
    for other in (*fits[:chosen][-1:], *fits[chosen + 1 : chosen + 2]):
        # What the next simpler curve and the next one would say shows what this one leaves out.
        apart = forces - _design(ANGLES, other.pieces) @ other.weights
        covariance = covariance + np.outer(apart, apart)
    velocity = _mean_velocity(between, motion.between_m_per_s[along])
    nearest = np.round((theta + 0.5 * np.pi) / np.pi * (len(FINE) - 1)).astype(np.int64)
    samples = np.bincount(nearest, minlength=len(FINE)).astype(np.float64)
    sums: Array = np.bincount(nearest, weights=force_n, minlength=len(FINE)).astype(np.float64)
    return MeanStroke(
        sign,
        middle,
        amplitude,
        forces,
        covariance,
        freedom,
        velocity,
        samples,
        sums,
        float(np.sqrt(noise)),
        np.zeros(_GRID, np.int8),
        _cycle_means(theta, force_n, number),
    )


def _cycle_means(theta: Array, force_n: Array, number: NDArray[np.int64]) -> CycleMeans:
    """Means by phase of forces at angles, and of the strokes that they belong to, shape (N,)."""
    strokes, index = np.unique(number, return_inverse=True)
    parts = int(np.clip(len(theta) / len(strokes) / 2.0, *_PARTS))
    part = np.clip(((theta / np.pi + 0.5) * parts).astype(np.int64), 0, parts - 1)
    cell = index * parts + part
    shape, size = (len(strokes), parts), len(strokes) * parts
    counts = np.bincount(cell, minlength=size).reshape(shape)
    sums = np.bincount(cell, weights=force_n, minlength=size).reshape(shape)
    has = counts > 0
    means = np.where(has, sums / np.maximum(counts, 1), 0.0)
    # The first and the last stroke may be parts of one.
    have = has.sum(axis=0)
    is_known = have >= max(1, len(strokes) - 2)
    mean_n = np.where(is_known, means.sum(axis=0) / np.maximum(have, 1), math.nan)
    apart_n = np.where(has, means - mean_n, 0.0)
    freedom = np.maximum(have - 1, 1)
    std_n = np.sqrt((apart_n**2).sum(axis=0) / freedom / np.maximum(have, 1))
    factors = np.array([student_factor(float(n)) for n in range(1, len(strokes) + 1)])
    half_n = np.where(have > 1, factors[freedom - 1] * std_n, math.inf)
    middle = (np.arange(parts) + 0.5) / parts * np.pi - 0.5 * np.pi
    return CycleMeans(*(np.asarray(values, np.float64) for values in (mean_n, half_n, middle)))


def _mean_velocity(theta: Array, velocity_m_per_s: Array) -> Array:
    """Velocity at `ANGLES`, by the most flexible spline that its angles carry."""
    for pieces in _VELOCITY_PIECES:
        design = _design(theta, pieces)
        gram = design.T @ design
        if pieces == 0 or np.linalg.cond(gram) < _WORST_CONDITION:
            weights = np.linalg.lstsq(design, velocity_m_per_s, rcond=None)[0]
            return _design(ANGLES, pieces) @ weights
    raise AssertionError("a spline of no pieces is always there")


def _design(theta: Array, pieces: int) -> Array:
    """Columns at angles: the spline, and with few pieces what a linear strut has under a sine."""
    sine, cosine = np.sin(theta), np.cos(theta)
    if not pieces:
        return np.column_stack([np.ones_like(theta), sine, cosine])
    half = 0.5 * np.pi
    inner = np.linspace(-half, half, pieces + 1)
    knots = np.concatenate([[-half] * _DEGREE, inner, [half] * _DEGREE])
    spline: Array = BSpline.design_matrix(theta, knots, _DEGREE).toarray()
    return np.column_stack([spline, sine, cosine]) if pieces < _FOLLOWS_A_SINE else spline


class _Fit(NamedTuple):
    """A spline through the samples of a direction.

    Attributes:
        criterion: Akaike's, corrected for few samples.
        inverse: Their covariance under noise of one.
        clustered: Covariance by what the strokes differ by; None of few strokes.
    """

    criterion: float
    pieces: int
    weights: Array
    inverse: Array
    variance: float
    freedom: float
    clustered: Array | None
    clusters: int


def _fit_spline(
    theta: Array, force_n: Array, number: NDArray[np.int64], pieces: int
) -> _Fit | None:
    """A spline; None where the samples do not carry it."""
    design = _design(theta, pieces)
    # A machine in step with the clock samples the same few angles in every cycle.
    angles = len(np.unique(np.round(theta, 2)))
    count, size = design.shape
    if angles < size + (pieces > 0) or count < 2 * size:
        return None
    edges = np.linspace(-0.5 * np.pi, 0.5 * np.pi, max(pieces, 1) + 1)
    if int(np.histogram(theta, edges)[0].min()) < _FEWEST_IN_A_PIECE:
        return None
    gram = design.T @ design
    if np.linalg.cond(gram) > _WORST_CONDITION:
        return None
    inverse: Array = np.linalg.inv(gram).astype(np.float64)
    if pieces >= _FOLLOWS_A_SINE:
        rows = _design(ANGLES, pieces)
        if float(((rows @ inverse) * rows).sum(axis=1).max()) > _MOST_LEVERAGE:
            return None
    weights = inverse @ (design.T @ force_n)
    residual_n = force_n - design @ weights
    squares = float(residual_n @ residual_n)
    criterion = count * np.log(max(squares / count, 1e-300)) + 2.0 * size * count / (
        count - size - 1.0
    )
    clusters = np.unique(number)
    clustered: Array | None = None
    if len(clusters) >= _FEWEST_CLUSTERS:
        scores = np.array([design[number == c].T @ residual_n[number == c] for c in clusters])
        share = len(clusters) / (len(clusters) - 1.0)
        clustered = inverse @ (share * scores.T @ scores) @ inverse
    variance, freedom = squares / (count - size), float(count - size)
    return _Fit(criterion, pieces, weights, inverse, variance, freedom, clustered, len(clusters))
