"""Drift of a load cell's zero, from the rests of a record and the cycles of its steps.

The force at rest at one height is that of the gas, and what friction holds. Where it changes over a
test, the zero drifted, the gas warmed, or friction holds another way. A zero that drifts changes
the mean force of the cycles of a step as well; friction that holds another way does not. Both
together determine a polynomial over time by weighted least squares, which is the drift, counted
from its begin. Where cycles and rests contradict each other, there is none. Damping that fades
changes the mean of a cycle, too, where one direction is stronger: that is in the weights. Without
two rests at one height, the cycles alone limit how far a zero may have drifted.

Reference: Seber and Lee, Linear Regression Analysis (2003), 3.10, for generalised least squares.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from rig.dyno.figures import AtRest, ForceRecord
from rig.dyno.stroke_force import Figure, ForceRange
from rig.dyno.strokes import Array, Block, standard_noise

_SAME_HEIGHT_M = 5e-4
"""By which rests of one height may differ: of a gas spring of 2 N/mm that is 1 N."""

_LEAST_SHARE, _MOST_SHARE = 0.5, 1.5
"""Shares of the rests' change between which the cycles confirm it."""

_EXCLUDED = 2.0
"""Standard deviations by which the cycles' share is below the least one where they exclude it."""

_NO_MATTER = 0.05
"""Share of the largest deviation from which on another one, independent of it, is considered."""

_CUT = 0.4
"""Error of a cycle's mean over the range of its force, times the square of its samples: of a sine
that is integrated by trapezoids from between two samples on, pi/8 at most."""

_MEAN_SHARE = 1.0 / np.pi
"""Mean force of a cycle over its largest force where one direction alone damps: what a relative
fade of the damping changes the mean by is at most so much."""

_MOST_DEGREES, _FITS = 4, 3.0
"""Highest degree of the polynomial, and mean square of the misfits, in their standard deviations,
below which a lower degree is enough."""

_HALF = 1.96
"""Standard deviations of half an interval."""

_CERTAIN = 4.0
"""Standard deviations from which on a drift is one."""


DriftKind = Literal["known", "open", "excluded", "unseen"]


class ZeroDrift(NamedTuple):
    """Change of the force of a load cell over time that is not the strut's.

    Attributes:
        line: The change, in N, over time in s; zero at its begin.
        begin_s: First time at which it is known; straight before.
        end_s: Last time; straight afterwards.
        largest: Change from its begin to where it is largest.
        kind: `known`: it may be removed; `open`: rests show it, and the cycles leave open whether
            it is one; `excluded`: rests show it, and the cycles that it is none; `unseen`: it is
            not certain, and line and deviations say how large it may be.
        source: What shows it, as a phrase.
        deviations: Independent deviations of the line, each half a 95 % interval.
    """

    line: np.polynomial.Polynomial
    begin_s: float
    end_s: float
    largest: Figure
    kind: DriftKind
    source: str
    deviations: tuple[np.polynomial.Polynomial, ...]

    def at(self, t_s: Array) -> Array:
        """Drift at times."""
        return self.follow(self.line, t_s)

    def follow(self, line: np.polynomial.Polynomial, t_s: Array) -> Array:
        """A line over time, straight beyond the times in which the drift is known."""
        inside_s = np.clip(t_s, self.begin_s, self.end_s)
        beyond = line.deriv()(inside_s) * (t_s - inside_s)
        return np.asarray(line(inside_s) + beyond, np.float64)


class _Cycles(NamedTuple):
    """Mean forces of the first and of the last cycle of a step: times, difference, deviation."""

    first_s: float
    last_s: float
    change_n: float
    std_n: float


def estimate_drift(
    record: ForceRecord, blocks: Sequence[Block], rests: Sequence[AtRest], limits: ForceRange
) -> ZeroDrift | None:
    """The drift of a record; None where rests show none, or nothing in it would show one.

    The cycles of steps whose force was clipped, at `limits`, are not used.
    """
    mine = _alike(rests)
    whole = [block for block in blocks if not limits.touches(record.force_n[block.samples])]
    cycles = [it for block in whole if (it := _cycles_of(record, block)) is not None]
    if len(mine) < 2:
        moving = _fit([], cycles)
        if moving is None or _is_seen(moving):
            return moving
        half = max(abs(moving.largest.low), abs(moving.largest.high))
        largest = Figure.around(0.0, half, moving.largest.method)
        return moving._replace(largest=largest, kind="unseen")
    at_rest = _fit(mine, [])
    if at_rest is None or not _is_seen(at_rest):
        return None
    kind = _confirm(cycles, at_rest)
    both = _fit(mine, cycles) if kind == "known" else None
    return at_rest._replace(kind=kind) if both is None else both


def _alike(rests: Sequence[AtRest]) -> list[AtRest]:
    """The rests of the height at which most of them are."""
    alike = [
        [rest for rest in rests if abs(rest.height_m - other.height_m) <= _SAME_HEIGHT_M]
        for other in rests
    ]
    return max(alike, key=len) if alike else []


def _cycles_of(record: ForceRecord, block: Block) -> _Cycles | None:
    """How the mean force of a block's cycles changes; None with less than two whole cycles."""
    strokes = block.strokes
    begins = [stroke.first for stroke in strokes[::2]]
    if len(strokes) % 2 == 0:
        begins.append(strokes[-1].last)
    if len(begins) < 3:
        return None
    t_s = record.t_s[begins[0] : begins[-1] + 1]
    force_n = record.force_n[begins[0] : begins[-1] + 1]
    # A cycle begins and ends between two samples.
    edges_s: Array = np.linspace(float(t_s[0]), float(t_s[-1]), len(begins))
    times_s: Array = 0.5 * (edges_s[1:] + edges_s[:-1])
    a_cycle = len(force_n) / len(times_s)
    cut_n = _CUT * float(np.ptp(force_n)) / a_cycle**2
    least_n = max(cut_n, standard_noise(force_n) / a_cycle**0.5)
    change_n, std_n = _trend(times_s, _means(edges_s, t_s, force_n), least_n)
    # Damping that fades makes the cycles smaller, and their mean too, where it is not symmetrical.
    sizes_n = _means(edges_s, t_s, np.abs(force_n - force_n.mean()))
    smaller_n, smaller_std_n = _trend(times_s, sizes_n, least_n)
    fade = float(np.hypot(smaller_n, smaller_std_n)) / float(sizes_n.mean())
    fade_n = _MEAN_SHARE * fade * float(np.abs(force_n - force_n.mean()).max())
    std_n = max(float(np.hypot(std_n, fade_n)), 1e-12)
    return _Cycles(float(times_s[0]), float(times_s[-1]), change_n, std_n)


def _means(edges_s: Array, t_s: Array, values: Array) -> Array:
    """Means between edges of values at times, by trapezoids."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)
    integral = np.concatenate([[0.0], np.cumsum(areas)])
    return np.asarray(np.diff(np.interp(edges_s, t_s, integral)) / np.diff(edges_s), np.float64)


def _trend(times_s: Array, values: Array, least_std: float) -> tuple[float, float]:
    """Change of values from the first to the last time by a straight line, and its deviation."""
    about_s = times_s - times_s.mean()
    squares = float(about_s @ about_s)
    slope = float(about_s @ values) / squares
    left = values - values.mean() - slope * about_s
    scatter = float(left @ left / max(len(left) - 2, 1)) ** 0.5
    length_s = float(times_s[-1] - times_s[0])
    return slope * length_s, max(least_std, scatter) * length_s / squares**0.5


def _fit(rests: Sequence[AtRest], cycles: Sequence[_Cycles]) -> ZeroDrift | None:
    """The polynomial of least degree that describes them; None where they determine none."""
    rest_s = np.array([0.5 * (rest.begin_s + rest.end_s) for rest in rests])
    force_n = np.array([rest.force_n.value for rest in rests])
    rest_std_n = np.array([0.51 * it.force_n.half for it in rests])
    first_s, last_s, change_n, std_n = (
        np.array([it[i] for it in cycles]) for i in range(len(_Cycles._fields))
    )
    times_s = np.concatenate([rest_s, first_s, last_s])
    equations = len(rest_s) + len(change_n) - (len(rest_s) > 0)
    if not len(times_s) or equations < 1 or np.ptp(times_s) <= 0.0:
        return None
    begin_s, end_s = float(times_s.min()), float(times_s.max())
    share = [(at_s - begin_s) / (end_s - begin_s) for at_s in (rest_s, first_s, last_s)]
    weights = 1.0 / np.concatenate([np.maximum(rest_std_n, 1e-12), std_n])
    target = np.concatenate([force_n, change_n]) * weights
    degree = 0
    while True:
        degree += 1
        powers = np.arange(1, degree + 1)
        at_rest = share[0][:, None] ** powers
        at_cycles = share[2][:, None] ** powers - share[1][:, None] ** powers
        level = np.concatenate([np.ones(len(rest_s)), np.zeros(len(change_n))])
        design = np.column_stack([np.concatenate([at_rest, at_cycles]), level]) * weights[:, None]
        found = np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], np.float64)
        residual = target - design @ found
        freedom = equations - degree
        misfit = float(residual @ residual)
        if degree >= _MOST_DEGREES or freedom < 1 or misfit <= _FITS * freedom:
            break
    covariance = np.asarray(np.linalg.pinv(design.T @ design), np.float64)[:degree, :degree]
    covariance = covariance * max(1.0, misfit / max(freedom, 1))
    span_s = (begin_s, end_s)
    shares = np.linspace(0.0, 1.0, 101)[:, None] ** powers
    drift_n = shares @ found[:degree]
    at = int(np.argmax(np.abs(drift_n)))
    half = _HALF * float(shares[at] @ covariance @ shares[at]) ** 0.5
    largest = Figure.around(float(drift_n[at]), half, f"polynomial of degree {degree} over time")
    source = " and ".join(["rests"] * bool(rests) + ["cycles"] * bool(cycles))
    deviations = tuple(_line(it, span_s) for it in _principal(covariance, shares))
    line = _line(found[:degree], span_s)
    return ZeroDrift(line, begin_s, end_s, largest, "known", source, deviations)


def _line(weights: Array, span_s: tuple[float, float]) -> np.polynomial.Polynomial:
    """A polynomial over a time, zero at its begin."""
    return np.polynomial.Polynomial([0.0, *weights], domain=span_s, window=[0.0, 1.0])


def _principal(covariance: Array, shares: Array) -> list[Array]:
    """Independent deviations of a polynomial's weights (D,) that matter, 1.96 times their own."""
    variances, axes = np.linalg.eigh(covariance)
    found = [
        _HALF * variance**0.5 * axis
        for variance, axis in zip(variances.clip(0.0), axes.T, strict=True)
    ]
    sizes_n = [float(np.abs(shares @ it).max()) for it in found]
    return [
        it for it, size_n in zip(found, sizes_n, strict=True) if size_n > _NO_MATTER * max(sizes_n)
    ]


def _is_seen(drift: ZeroDrift) -> bool:
    half = drift.largest.half
    return abs(drift.largest.value) > _CERTAIN / _HALF * half


def _confirm(cycles: Sequence[_Cycles], drift: ZeroDrift) -> DriftKind:
    """Whether the cycles change as the rests do, by weighted least squares."""
    # Also beyond the rests, if these are not all along the test.
    x = np.array([drift.line(it.last_s) - drift.line(it.first_s) for it in cycles])
    y = np.array([it.change_n for it in cycles])
    w = np.array([it.std_n for it in cycles]) ** -2.0
    power = float(w @ (x * x))
    if power <= 0.0:
        return "open"
    share, std = float(w @ (x * y)) / power, power**-0.5
    if share - std >= _LEAST_SHARE and share + std <= _MOST_SHARE:
        return "known"
    return "excluded" if share + _EXCLUDED * std < _LEAST_SHARE else "open"
