"""A store read as a whole: shares of verdicts, wear, change-points, outliers, jumps of a bench."""

import datetime
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rig.fleet.store import opened
from rig.fleet.trends import (
    FEWEST,
    LEVEL,
    Change,
    Drift,
    Point,
    bench_jump,
    change_point,
    drift,
    outliers,
    without_jump,
)

SCALED_BY_FORCE = ("stiffness_n_per_m", "damping_n_s_per_m", "friction_n", "gas_force_n")
"""Values that a load cell's gain multiplies, and the linear model or every damper has."""

_RECENT = 5
"""Last points of a series whose median stands for the damper as it is now."""


class Quantity(NamedTuple):
    """What a series is of.

    Attributes:
        strut: Strut; empty for a figure.
        effect: Effect; empty for the linear part and for figures.
        parameter: Name with its unit.
    """

    strut: str
    effect: str
    parameter: str

    @property
    def words(self) -> str:
        """As it is said."""
        return f"{self.effect.replace('_', ' ')} {self.parameter}".strip()


class Where(NamedTuple):
    """Which damper, on which bench."""

    bench: str
    damper: str


class Series(NamedTuple):
    """A quantity of a damper over time.

    Attributes:
        where: Damper and bench.
        quantity: What of it.
        points: Values by day.
        drift: Its straight line; None where it is too short.
        change: Its likeliest change-point; None where it is too short.
        is_change: Whether that is significant in the whole fleet.
        is_drift: Whether the slope is, where there is no change-point.
        with_bench: Whether the change is that of its bench.
    """

    where: Where
    quantity: Quantity
    points: tuple[Point, ...]
    drift: Drift | None
    change: Change | None
    is_change: bool
    is_drift: bool
    with_bench: bool


class Jump(NamedTuple):
    """A step that the dampers of a bench have in common.

    Attributes:
        bench: The bench.
        parameter: What stepped.
        factor: By what factor.
        change: When; its values are logarithms.
    """

    bench: str
    parameter: str
    factor: float
    change: Change


class Outlier(NamedTuple):
    """A damper that is unlike the others.

    Attributes:
        where: Damper and bench.
        quantity: In what.
        value: Median of its last points.
        usual: Median of all.
        distance: From it, in robust standard deviations of the others.
    """

    where: Where
    quantity: Quantity
    value: float
    usual: float
    distance: float


@dataclass(frozen=True)
class Overview:
    """A store as a whole.

    Attributes:
        runs: Number of runs.
        failed: Those that could not be evaluated, by the words of their error.
        verdicts: By bench, how often each verdict was given.
        series: Every quantity of every damper.
        jumps: Of benches.
        outliers: Dampers.
    """

    runs: int
    failed: Mapping[str, int]
    verdicts: Mapping[str, Mapping[str, int]]
    series: tuple[Series, ...]
    jumps: tuple[Jump, ...]
    outliers: tuple[Outlier, ...]

    def as_dict(self) -> dict[str, Any]:
        """For JSON; series without their points."""
        return {
            "runs": self.runs,
            "failed": dict(self.failed),
            "verdicts": {bench: dict(counts) for bench, counts in self.verdicts.items()},
            "jumps": [
                {
                    "bench": jump.bench,
                    "parameter": jump.parameter,
                    "factor": jump.factor,
                    **_change_dict(jump.change),
                }
                for jump in self.jumps
            ],
            "changes": [
                {**_place(item), "with_bench": item.with_bench, **_change_dict(item.change)}
                for item in self.series
                if item.is_change and item.change is not None
            ],
            "drifts": [
                {**_place(item), **item.drift._asdict()}
                for item in self.series
                if item.is_drift and item.drift is not None
            ],
            "outliers": [
                {**item.where._asdict(), **item.quantity._asdict(), "value": item.value,
                 "usual": item.usual, "distance": item.distance}
                for item in self.outliers
            ],
        }  # fmt: skip


def date_of(day: float) -> str:
    """A day of a series as a date."""
    return datetime.date.fromordinal(round(day)).isoformat()


def overview(store: Path) -> Overview:
    """Read a store.

    Raises:
        InputError: There is none, or it cannot be read.
    """
    connection = opened(store)
    try:
        runs = connection.execute("SELECT count(*) FROM runs").fetchone()[0]
        failed = dict(
            connection.execute(
                "SELECT error, count(*) FROM runs WHERE error <> '' "
                "GROUP BY error ORDER BY count(*) DESC, error"
            ).fetchall()
        )
        verdicts: dict[str, dict[str, int]] = {}
        for bench, verdict, count in connection.execute(
            "SELECT bench, CASE WHEN error = '' THEN verdict ELSE 'failed' END AS said, count(*) "
            "FROM runs GROUP BY bench, said ORDER BY bench, count(*) DESC, said"
        ).fetchall():
            verdicts.setdefault(bench, {})[verdict] = count
        collected = _collected(connection)
    finally:
        connection.close()
    jumps = _jumps(collected)
    return Overview(runs, failed, verdicts, _series(collected, jumps), jumps, _outliers(collected))


_Collected = dict[Quantity, dict[Where, list[Point]]]


def _collected(connection: Any) -> _Collected:
    """Every series by quantity; values that their run does not bound are left out."""
    rows = connection.execute(
        'SELECT v.strut, v.effect, v.parameter, v.bench, v.damper, v.date, v.value FROM "values" v '
        "WHERE v.kind IN ('model', 'figure') AND isfinite(v.value) AND isfinite(v.low) "
        "AND isfinite(v.high) ORDER BY v.date, v.key"
    )
    found: _Collected = {}
    while batch := rows.fetchmany(100_000):
        for strut, effect, parameter, bench, damper, date, value in batch:
            day = float(datetime.date.fromisoformat(date).toordinal())
            series = found.setdefault(Quantity(strut, effect, parameter), {})
            series.setdefault(Where(bench, damper), []).append(Point(day, value))
    return found


def _jumps(collected: _Collected) -> tuple[Jump, ...]:
    found: list[Jump] = []
    for quantity, by_place in collected.items():
        if quantity.effect or quantity.parameter not in SCALED_BY_FORCE:
            continue
        for bench in sorted({where.bench for where in by_place}):
            logs = {
                where.damper: _logarithms(points)
                for where, points in by_place.items()
                if where.bench == bench and all(point.value > 0.0 for point in points)
            }
            change = bench_jump(logs)
            if change is not None:
                factor = math.exp(change.after - change.before)
                found.append(Jump(bench, quantity.parameter, factor, change))
    return tuple(found)


def _logarithms(points: Sequence[Point]) -> list[Point]:
    return [point._replace(value=math.log(point.value)) for point in points]


def _series(collected: _Collected, jumps: Sequence[Jump]) -> tuple[Series, ...]:
    """Every series with what is significant among all of them."""
    every = [
        (where, quantity, points)
        for quantity, by_place in sorted(collected.items())
        for where, points in sorted(by_place.items())
    ]
    level = LEVEL / max(1, sum(len(points) >= FEWEST for _, _, points in every))
    found: list[Series] = []
    for where, quantity, points in every:
        line, change = drift(points), change_point(points)
        is_change = change is not None and change.p < level
        is_drift = line is not None and len(points) >= FEWEST and line.p < level and not is_change
        shared = is_change and _goes_with(where, points, jumps, level)
        found.append(
            Series(where, quantity, tuple(points), line, change, is_change, is_drift, shared)
        )
    return tuple(found)


def _goes_with(where: Where, points: Sequence[Point], jumps: Sequence[Jump], level: float) -> bool:
    """Whether a change is gone when a jump of its bench is taken out."""
    if any(point.value <= 0.0 for point in points):
        return False
    for jump in jumps:
        if jump.bench == where.bench:
            left = change_point(without_jump(_logarithms(points), jump.change))
            if left is not None and left.p >= level:
                return True
    return False


def _outliers(collected: _Collected) -> tuple[Outlier, ...]:
    found: list[Outlier] = []
    for quantity, by_place in sorted(collected.items()):
        latest = {
            where: sorted(point.value for point in points[-_RECENT:])[len(points[-_RECENT:]) // 2]
            for where, points in by_place.items()
        }
        names = {f"{where.bench}\0{where.damper}": where for where in latest}
        usual = sorted(latest.values())[len(latest) // 2]
        values = {key: latest[where] for key, where in names.items()}
        for name, distance in outliers(values, LEVEL / len(collected)).items():
            found.append(Outlier(names[name], quantity, latest[names[name]], usual, distance))
    return tuple(found)


def _place(item: Series) -> dict[str, str]:
    return {**item.where._asdict(), **item.quantity._asdict()}


def _change_dict(change: Change) -> dict[str, Any]:
    dates = {key: date_of(getattr(change, key)) for key in ("day", "low", "high")}
    return {**change._asdict(), **dates}
