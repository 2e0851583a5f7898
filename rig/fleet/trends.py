"""What a value does over time: wear, a change-point, outliers, and jumps of a whole bench.

A series is a straight line (wear) until it has a change-point: a step, or a bend. Its statistic is
the largest F over all instants of the change (Quandt 1960; Andrews 1993, Econometrica 61), whose
distribution under a straight line with independent errors depends on the times alone and is drawn
here; a level for a whole fleet is divided among its series (Bonferroni).
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq  # pyright: ignore[reportUnknownVariableType]
from scipy.stats import f as fisher
from scipy.stats import ncf as noncentral
from scipy.stats import t as student

from rig.fleet.scatter import POWER, Scatter

Array = NDArray[np.float64]
Member = TypeVar("Member")

LEVEL = 0.0025
"""Chance of one false alarm of a kind in a whole fleet without any change: of the four kinds, which
are drift, change-point, outlier and jump of a bench, together one in a hundred."""

FEWEST = 10
"""Points of a series from which on a change-point is looked for."""

EDGE = 3
"""Points that each side of a change has at least: a line through two of them fits anything."""

_DRAWS = 40_000
_TAIL = 40
"""Draws of the statistic without a change, and how many of them its tail is continued from."""

_PIECES = 20
"""In how many parts they are drawn, so that memory does not grow with the series."""

_MOST_CHANGES = 200
"""Days at which a change is looked for in a series; of more, evenly spread ones."""

_ALONE = 5
"""Dampers from which on one is held against the others."""

_MOST_MEMBERS = 400
"""Of more, the bound of so many is taken at a level that is that much smaller."""

_VALUES_DRAWN, _ROUNDS = 1_000_000, 10
"""Random numbers a round, and rounds, from which the bound of outliers is read."""

_SHARED = 2
"""Dampers that have to show a jump together, for it to be the bench's."""

_GAUSS = 1.4826
"""Standard deviation over median absolute deviation of a Gaussian."""


class DatedValue(NamedTuple):
    """A value on a day, which is counted from any origin."""

    day: float
    value: float


class ChangePoint(NamedTuple):
    """A change-point.

    Attributes:
        day: First day of a step, or the day on which a bend begins.
        low: Earliest such day of its 95 % interval.
        high: Latest.
        kind: ``step`` or ``bend``.
        before: Value just before, by the line there.
        after: At the end of the series, by the line there.
        slope_before: Change per day before.
        slope_after: Change per day after.
        p: Chance of a statistic as large without a change, in one series.
    """

    day: float
    low: float
    high: float
    kind: Literal["step", "bend"]
    before: float
    after: float
    slope_before: float
    slope_after: float
    p: float


class Drift(NamedTuple):
    """Slope of the straight line through a series, with its 95 % interval.

    Attributes:
        per_day: Change per day.
        level: Value of the line in the middle.
        p: Chance of a slope as large without a drift.
        scatter: Scatter about the line.
        squares_days2: Sum of squares of the days about their mean, as far as they determine the
            slope.
    """

    per_day: float
    low: float
    high: float
    level: float
    p: float
    scatter: Scatter
    squares_days2: float

    def visible_per_day(self, level: float) -> float:
        """Change per day that is seen with a chance of 95 %, at a level of significance."""
        return self.scatter.visible_slope(self.squares_days2, level)


def find_change_point(points: Sequence[DatedValue]) -> ChangePoint | None:
    """The likeliest change of a series by day, significant or not; None where it is too short."""
    days = np.array([point.day for point in points])
    if len(points) < FEWEST or np.ptp(days) <= 0.0:
        return None
    y = np.array([point.value for point in points])
    if not _change_indices(days):
        return None
    statistic = float(_largest(days, y[:, np.newaxis])[0])
    return _describe_change(days, y, _chance(tuple(np.round(days - days[0], 6)), statistic))


def fit_drift(
    points: Sequence[DatedValue],
    stepped_on: float | None = None,
    common: Scatter | None = None,
) -> Drift | None:
    """The straight line through a series by day; None with too few days for it.

    `stepped_on` is the day of a step of unknown size that is not its own, `common` the scatter of
    the quantity in all dampers.
    """
    days = np.array([point.day for point in points])
    if len(np.unique(days)) < 3:
        return None
    columns = _line_and_step(days, stepped_on)
    free = len(days) - columns.shape[1]
    if free < 1:
        return None
    y = np.array([point.value for point in points])
    weights = np.linalg.lstsq(columns, y, rcond=None)[0]
    left = y - columns @ weights
    span = float(np.ptp(days))
    slope = float(weights[1]) / span
    scatter = Scatter(float(left @ left) / free, float(free)).pooled(common)
    squares_days2 = span**2 / float(np.linalg.inv(columns.T @ columns)[1, 1])
    error = (scatter.variance / squares_days2) ** 0.5
    half = error * float(student.ppf(0.975, scatter.freedom))
    p = float(2.0 * student.sf(abs(slope) / max(error, 1e-300), scatter.freedom))
    level = float(y.mean())
    return Drift(slope, slope - half, slope + half, level, p, scatter, squares_days2)


def visible_step(points: Sequence[DatedValue], level: float) -> float | None:
    """Size of a step in the middle of a series that is seen with a chance of 95 %, at a level.

    None where no change-point is looked for.
    """
    days = np.array([point.day for point in points])
    if len(points) < FEWEST or not _change_indices(days):
        return None
    columns = _columns(days, _middle(days))
    y = np.array([point.value for point in points])
    line, _ = np.linalg.qr(columns[:, :2])
    left = y - line @ (line.T @ y)
    step = columns[:, 2] - line @ (line.T @ columns[:, 2])
    freedom = len(days) - 3
    of_step = step * (step @ left) / (step @ step)
    variance = float(np.sum((left - of_step) ** 2)) / freedom
    critical = _critical(tuple(np.round(days - days[0], 6)), level)
    # The true instant is one of those that are tried: the largest F is at least that one's.
    return (_noncentrality(critical, len(days) - 4) * variance / float(step @ step)) ** 0.5


@lru_cache(maxsize=256)
def _noncentrality(critical: float, freedom: int) -> float:
    """Of an F of two degrees of freedom over others that exceeds a value with the usual power."""

    def lacks(noncentrality: float) -> float:
        return POWER - float(noncentral.sf(critical, 2, freedom, noncentrality))

    return float(brentq(lacks, 1e-6, 1e6))


def _middle(days: Array) -> int:
    """Index of the first point after a change in the middle."""
    found = _change_indices(days)
    return found[len(found) // 2]


def without_step(points: Sequence[DatedValue], day: float | None) -> list[DatedValue]:
    """A series without the step that it has on a day, if any, its straight line kept."""
    step = None if day is None else _step_at(points, day)
    if day is None or step is None:
        return list(points)
    return [p._replace(value=p.value - step) if p.day >= day else p for p in points]


def _line_and_step(days: Array, day: float | None) -> Array:
    """Line, and step where there are points enough on either side, shape (N, 2 or 3)."""
    index = len(days) if day is None else int(np.searchsorted(days, day))
    has_step = EDGE <= index <= len(days) - EDGE
    columns = _columns(days, index if has_step else 1)
    return columns[:, : 3 if has_step else 2]


def find_outliers(values: Mapping[Member, float], level: float) -> dict[Member, float]:
    """How many robust standard deviations away from the others members are that stand out.

    Up to a half of the values, one a member, may be bad. `level` is the chance of any such member
    among so many alike.
    """
    if len(values) < _ALONE:
        return {}
    every = np.array(list(values.values()))
    distance = _distances(every[:, np.newaxis])[:, 0]
    bound = _farthest(
        min(len(values), _MOST_MEMBERS), level * min(1.0, _MOST_MEMBERS / len(values))
    )
    return {name: float(far) for name, far in zip(values, distance, strict=True) if far > bound}


def _distances(values: Array) -> Array:
    """Distances from the median over the spread, column by column, shape (N, M)."""
    from_middle = np.abs(values - np.median(values, axis=0))
    return from_middle / np.maximum(_GAUSS * np.median(from_middle, axis=0), 1e-300)


@lru_cache(maxsize=64)
def _farthest(members: int, level: float) -> float:
    """Distance that the farthest of so many Gaussian values exceeds with a chance of `level`."""
    rng = np.random.default_rng(0)
    draws = max(round(_VALUES_DRAWN / members), 1)
    farthest = np.concatenate(
        [_distances(rng.standard_normal((members, draws))).max(axis=0) for _ in range(_ROUNDS)]
    )
    return float(np.quantile(farthest, 1.0 - level))


def find_bench_jump(series: Mapping[str, Sequence[DatedValue]], level: float) -> ChangePoint | None:
    """A step that the dampers of one bench have in common: of its calibration, not of theirs.

    The series are, of each damper, the logarithm of a value that its force scales; `level` is the
    chance of a jump where there is none.

    Returns:
        The change, if it is significant and at least two dampers share it; ``before`` and
        ``after`` are logarithms of the common factor.
    """
    usable = {name: points for name, points in series.items() if len(points) >= 2 * EDGE}
    if len(usable) < _SHARED:
        return None
    by_day: dict[float, list[float]] = {}
    for points in usable.values():
        middle = float(np.median([point.value for point in points]))
        for point in points:
            by_day.setdefault(point.day, []).append(point.value - middle)
    common = [
        DatedValue(day, float(np.median(left)))
        for day, left in sorted(by_day.items())
        if len(left) >= _SHARED
    ]
    change = find_change_point(common)
    if change is None or change.kind != "step" or change.p > level:
        return None
    size = change.after - change.before
    tried = [_step_at(points, change.day) for points in usable.values()]
    steps = [step for step in tried if step is not None]
    shared = [step for step in steps if 0.5 < step / size < 2.0]
    return change if len(shared) >= max(_SHARED, 0.5 * len(steps)) else None


def _step_at(points: Sequence[DatedValue], day: float) -> float | None:
    """Size of a step on a day, from the line of wear; None where a side has too few points."""
    columns = _line_and_step(np.array([point.day for point in points]), day)
    if columns.shape[1] < 3:
        return None
    values = np.array([point.value for point in points])
    return float(np.linalg.lstsq(columns, values, rcond=None)[0][2])


# --- the statistic --------------------------------------------------------------------------------


def _change_indices(days: Array) -> list[int]:
    """Indices of the first point after a change, each on another day."""
    found = [k for k in range(EDGE, len(days) - EDGE + 1) if days[k] > days[k - 1]]
    return found[:: -(-len(found) // _MOST_CHANGES)] if found else []


def _columns(days: Array, index: int) -> Array:
    """Line, step and bend, shape (N, 4)."""
    x = (days - days.mean()) / np.ptp(days)
    after = np.arange(len(days)) >= index
    bend = np.where(after, (days - days[index - 1]) / np.ptp(days), 0.0)
    return np.column_stack([np.ones_like(x), x, after.astype(np.float64), bend])


def _largest(days: Array, y: Array) -> Array:
    """Largest F over all change-points of each column of y, shape (N, M)."""
    line, _ = np.linalg.qr(_columns(days, EDGE)[:, :2])
    left = y - line @ (line.T @ y)
    total = np.sum(left**2, axis=0)
    best = np.zeros(y.shape[1])
    for index in _change_indices(days):
        basis, _ = np.linalg.qr(_columns(days, index))
        explained = np.sum((basis[:, 2:].T @ left) ** 2, axis=0)
        f = (explained / 2.0) / np.maximum((total - explained) / (len(days) - 4), 1e-300)
        best = np.maximum(best, f)
    return best


@lru_cache(maxsize=64)
def _null(days: tuple[float, ...]) -> Array:
    """Sorted largest F of straight lines with noise."""
    rng = np.random.default_rng(0)
    found = [
        _largest(np.array(days), rng.standard_normal((len(days), _DRAWS // _PIECES)))
        for _ in range(_PIECES)
    ]
    return np.sort(np.concatenate(found))


def _chance(days: tuple[float, ...], statistic: float) -> float:
    """Chance of a statistic as large; beyond the draws by the F of one instant times their number.

    The largest of many dependent F has the tail of so many independent ones; how many they are is
    read where both are known.
    """
    drawn = _null(days)
    above = len(drawn) - int(np.searchsorted(drawn, statistic))
    if above >= _TAIL:
        return (above + 1.0) / (len(drawn) + 1.0)
    free = len(days) - 4
    known = float(drawn[-_TAIL])
    independent = (_TAIL / len(drawn)) / max(float(fisher.sf(known, 2, free)), 1e-300)
    return min(1.0, independent * float(fisher.sf(statistic, 2, free)))


@lru_cache(maxsize=256)
def _critical(days: tuple[float, ...], level: float) -> float:
    """Largest F that a straight line exceeds with a chance of `level`."""
    return float(brentq(lambda f: _chance(days, f) - level, 1e-3, 1e7))


_KINDS: tuple[tuple[Literal["step", "bend"], list[int]], ...] = (
    ("step", [0, 1, 2]),
    ("bend", [0, 1, 3]),
)


def _describe_change(days: Array, y: Array, p: float) -> ChangePoint:
    """The likelier of a step and a bend, where it likeliest is, and from what to what it leads."""
    kinds = {
        kind: {index: _rss(_columns(days, index)[:, own], y) for index in _change_indices(days)}
        for kind, own in _KINDS
    }
    kind, own = min(_KINDS, key=lambda item: min(kinds[item[0]].values()))
    left = kinds[kind]
    at = min(left, key=lambda index: left[index])
    # The profile likelihood of the change-point, with the variance estimated (Hinkley 1970).
    bound = left[at] * (1.0 + float(fisher.ppf(0.95, 1, len(days) - 3)) / (len(days) - 3))
    likely = [index for index, rss in left.items() if rss <= bound]
    columns = _columns(days, at)[:, own]
    weights = np.linalg.lstsq(columns, y, rcond=None)[0]
    span = float(np.ptp(days))
    slope = float(weights[1]) / span
    is_bend = kind == "bend"
    # A bend begins on a day that is still on the line, a step is there on the day.
    day, low, high = (float(days[k - is_bend]) for k in (at, min(likely), max(likely)))
    before = float(weights[0]) + slope * (day - float(days.mean()))
    return ChangePoint(
        day,
        low,
        high,
        kind,
        before,
        float(columns[-1] @ weights) if is_bend else before + float(weights[2]),
        slope,
        slope + (float(weights[2]) / span if is_bend else 0.0),
        p,
    )


def _rss(columns: Array, y: Array) -> float:
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    return float(left @ left)
