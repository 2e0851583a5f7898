"""A store read as a whole: shares of verdicts, wear, change-points, outliers, jumps of a bench."""

import datetime
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median, median_high
from typing import Any, NamedTuple

from rig.fleet.scatter import common_scatter
from rig.fleet.sources import UNKNOWN
from rig.fleet.store import connect
from rig.fleet.trends import (
    FEWEST,
    LEVEL,
    ChangePoint,
    DatedValue,
    Drift,
    find_bench_jump,
    find_change_point,
    find_outliers,
    fit_drift,
    visible_step,
    without_step,
)

SCALED_BY_FORCE = ("stiffness_n_per_m", "damping_n_s_per_m", "friction_n", "gas_force_n")
"""Values that a load cell's gain multiplies, and the linear model or every damper has."""

_FORCE = re.compile(r"_n(_per_|_s|_at_|$)")
"""Units of what is proportional to a force: N, N/m, N·s/m, ..."""

_MONTH_DAYS = 365.25 / 12.0

_RECENT = 5
"""Last points of a series whose median stands for the damper as it is now."""


class SeriesQuantity(NamedTuple):
    """What a series is of.

    A figure has neither strut nor effect, and the linear part of a strut no effect.
    """

    strut: str
    effect: str
    parameter: str

    @property
    def words(self) -> str:
        """Effect and parameter as a phrase."""
        return f"{self.effect.replace('_', ' ')} {self.parameter}".strip()


class Where(NamedTuple):
    """Which damper, on which bench."""

    bench: str
    damper: str


class Visible(NamedTuple):
    """Changes of a series that are seen with a chance of 95 %.

    Attributes:
        drift_per_day: Slope of a straight line.
        step: A step in the middle; None where the series is too short for a change-point.
    """

    drift_per_day: float
    step: float | None


class Series(NamedTuple):
    """A quantity of a damper over time.

    Attributes:
        points: Values by day.
        drift: Its straight line; None where it is too short.
        change: Its likeliest change-point; None where it is too short.
        is_change: Whether that is significant in the whole fleet.
        is_drift: Whether the slope is, where there is no change-point.
        visible: What would have been seen; None where it is too short for a straight line.
    """

    where: Where
    quantity: SeriesQuantity
    points: tuple[DatedValue, ...]
    drift: Drift | None
    change: ChangePoint | None
    is_change: bool
    is_drift: bool
    visible: Visible | None


class Jump(NamedTuple):
    """A step by a factor that the dampers of a bench have in common.

    The values of its change are logarithms.
    """

    bench: str
    parameter: str
    factor: float
    change: ChangePoint


class Outlier(NamedTuple):
    """A damper that is unlike the others: the median of its last points, and the usual one.

    The distance is in robust standard deviations of the others.
    """

    where: Where
    quantity: SeriesQuantity
    value: float
    usual: float
    distance: float


class Power(NamedTuple):
    """What would be seen of a quantity with a chance of 95 %: medians over the dampers.

    Attributes:
        dampers: Dampers of which there is a value.
        runs: Runs of a damper.
        scatter: Standard deviation from run to run, as a share of the value; None unknown.
        drift_per_month: Slope, as a share of the value; None with less than three days.
        step: A step in the middle, as a share of the value; None with less than ten runs.
    """

    quantity: str
    dampers: int
    runs: float
    scatter: float | None
    drift_per_month: float | None
    step: float | None


def _power(quantity: SeriesQuantity, items: Sequence[Series]) -> Power:
    levels = [abs(item.drift.level) for item in items if item.drift is not None]
    level = float(median(levels)) if levels else 0.0
    lines = [item.drift for item in items if item.drift is not None]
    seen = [item.visible for item in items if item.visible is not None]
    steps = [it.step for it in seen if it.step is not None]

    def share(values: Sequence[float]) -> float | None:
        return float(median(values)) / level if values and level > 0.0 else None

    return Power(
        quantity.words,
        len(items),
        float(median(len(item.points) for item in items)),
        share([line.scatter.variance**0.5 for line in lines]),
        share([_MONTH_DAYS * it.drift_per_day for it in seen]),
        share(steps),
    )


@dataclass(frozen=True)
class Overview:
    """A store as a whole.

    Attributes:
        failed: Those that could not be evaluated, by the words of their error.
        verdicts: By bench, how often each verdict was given.
        model: Model and version of these runs: those that were evaluated last.
        others: Runs of other models or versions in the store.
    """

    runs: int
    failed: Mapping[str, int]
    verdicts: Mapping[str, Mapping[str, int]]
    series: tuple[Series, ...]
    jumps: tuple[Jump, ...]
    outliers: tuple[Outlier, ...]
    model: str
    others: int

    @property
    def words(self) -> str:
        """What it is about, in a sentence."""
        dampers = len({item.where for item in self.series})
        left_out = f"; {self.others} runs of other models or versions are left out" * bool(
            self.others
        )
        return (
            f"{_count(self.runs, 'run')} of {_count(dampers, 'damper')} on "
            f"{_count(len(self.verdicts), 'bench', 'benches')}, model "
            f"{self.model}{left_out}"
        )

    def powers(self) -> list[Power]:
        """What would have been seen, by quantity."""
        by_quantity: dict[SeriesQuantity, list[Series]] = {}
        for item in self.series:
            by_quantity.setdefault(item.quantity, []).append(item)
        return [_power(quantity, items) for quantity, items in by_quantity.items()]

    def as_dict(self) -> dict[str, object]:
        """For JSON; series without their points."""
        return {
            "runs": self.runs,
            "model": self.model,
            "others": self.others,
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
                {**_place(item), **_change_dict(item.change)}
                for item in self.series
                if item.is_change and item.change is not None
            ],
            "drifts": [
                {
                    **_place(item),
                    **{key: getattr(item.drift, key) for key in ("per_day", "low", "high", "p")},
                    "level": item.drift.level,
                }
                for item in self.series
                if item.is_drift and item.drift is not None
            ],
            "visible": [power._asdict() for power in self.powers()],
            "outliers": [
                {
                    **_place(item),
                    "value": item.value,
                    "usual": item.usual,
                    "distance": item.distance,
                }
                for item in self.outliers
            ],
        }


def _count(number: int, noun: str, plural: str = "") -> str:
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"


def date_of(day: float) -> str:
    """A day of a series as a date."""
    return datetime.date.fromordinal(round(day)).isoformat()


def read_overview(store: Path) -> Overview:
    """Read a store.

    Raises:
        InputError: There is none, or it cannot be read.
    """
    with connect(store) as connection:
        model, sha256, version = connection.execute(
            "SELECT model, model_sha256, version FROM runs ORDER BY written DESC LIMIT 1"
        ).fetchall()[0]
        connection.execute(
            "CREATE TEMP TABLE these AS SELECT * FROM runs WHERE model_sha256 = ? AND version = ?",
            [sha256, version],
        )
        ((runs,),) = connection.execute("SELECT count(*) FROM these").fetchall()
        ((every,),) = connection.execute("SELECT count(*) FROM runs").fetchall()
        failed = dict(
            connection.execute(
                "SELECT error, count(*) FROM these WHERE error <> '' "
                "GROUP BY error ORDER BY count(*) DESC, error"
            ).fetchall()
        )
        verdicts: dict[str, dict[str, int]] = {}
        for bench, verdict, count in connection.execute(
            "SELECT bench, CASE WHEN error = '' THEN verdict ELSE 'failed' END AS said, count(*) "
            "FROM these GROUP BY bench, said ORDER BY bench, count(*) DESC, said"
        ).fetchall():
            verdicts.setdefault(bench, {})[verdict] = count
        collected = _read_series(connection)
    jumps = _jumps(collected)
    step_days = {jump.bench: jump.change.day for jump in jumps}
    # Every series without the jump of its bench, whose size is its own best one.
    cleared = {
        quantity: {
            where: without_step(points, _step_day(step_days, where, quantity))
            for where, points in by_place.items()
        }
        for quantity, by_place in collected.items()
    }
    words = f"{model} ({sha256[:8]}), rig {version}"
    return Overview(
        runs,
        failed,
        verdicts,
        _series(cleared, step_days),
        jumps,
        _outliers(cleared),
        words,
        every - runs,
    )


_Collected = dict[SeriesQuantity, dict[Where, list[DatedValue]]]


def _read_series(connection: Any) -> _Collected:
    """Every series by quantity.

    Values that their run does not bound are left out, and dampers without a name: of several,
    one series would belong to none.
    """
    rows = connection.execute(
        "SELECT v.strut, v.effect, v.parameter, t.bench, t.damper, t.date, v.value "
        'FROM "values" v JOIN these t USING (key) '
        "WHERE t.damper <> ? AND v.kind IN ('model', 'figure') AND isfinite(v.value) "
        "AND isfinite(v.low) AND isfinite(v.high) ORDER BY t.date, v.key",
        [UNKNOWN],
    )
    found: _Collected = {}
    while batch := rows.fetchmany(100_000):
        for strut, effect, parameter, bench, damper, date, value in batch:
            day = float(datetime.date.fromisoformat(date).toordinal())
            series = found.setdefault(SeriesQuantity(strut, effect, parameter), {})
            series.setdefault(Where(bench, damper), []).append(DatedValue(day, value))
    return found


def _jumps(collected: _Collected) -> tuple[Jump, ...]:
    """The surest jump of each bench; a load cell's gain shows in several quantities at once."""
    usable = {
        quantity: by_place
        for quantity, by_place in collected.items()
        if not quantity.effect and quantity.parameter in SCALED_BY_FORCE
    }
    benches = sorted({where.bench for by_place in usable.values() for where in by_place})
    level = LEVEL / max(1, len(benches) * len(usable))
    found: dict[str, Jump] = {}
    for bench in benches:
        for quantity, by_place in usable.items():
            logs = {
                where.damper: [point._replace(value=math.log(point.value)) for point in points]
                for where, points in by_place.items()
                if where.bench == bench and all(point.value > 0.0 for point in points)
            }
            change = find_bench_jump(logs, level)
            if change is not None and (bench not in found or change.p < found[bench].change.p):
                factor = math.exp(change.after - change.before)
                found[bench] = Jump(bench, quantity.parameter, factor, change)
    return tuple(found.values())


def _step_day(
    step_days: Mapping[str, float], where: Where, quantity: SeriesQuantity
) -> float | None:
    """Day of the bench's jump, if it has one and the series is in it."""
    return step_days.get(where.bench) if _FORCE.search(quantity.parameter) else None


def _series(collected: _Collected, step_days: Mapping[str, float]) -> tuple[Series, ...]:
    """Every series with what is significant among all of them."""
    lines: dict[tuple[SeriesQuantity, Where], Drift | None] = {}
    for quantity, by_place in sorted(collected.items()):
        days = {where: _step_day(step_days, where, quantity) for where in by_place}
        own = [fit_drift(points, days[where]) for where, points in by_place.items()]
        common = common_scatter([line.scatter for line in own if line is not None])
        for where, points in sorted(by_place.items()):
            lines[quantity, where] = fit_drift(points, days[where], common)
    tested = [points for by_place in collected.values() for points in by_place.values()]
    level = LEVEL / max(1, sum(line is not None for line in lines.values()))
    change_level = LEVEL / max(1, sum(len(points) >= FEWEST for points in tested))
    found: list[Series] = []
    for (quantity, where), line in lines.items():
        points = collected[quantity][where]
        change = find_change_point(points)
        is_change = change is not None and change.p < change_level
        is_drift = line is not None and line.p < level and not is_change
        visible = None
        if line is not None:
            visible = Visible(line.visible_per_day(level), visible_step(points, change_level))
        found.append(
            Series(where, quantity, tuple(points), line, change, is_change, is_drift, visible)
        )
    return tuple(found)


def _outliers(collected: _Collected) -> tuple[Outlier, ...]:
    found: list[Outlier] = []
    for quantity, by_place in sorted(collected.items()):
        latest = {
            where: median_high(point.value for point in points[-_RECENT:])
            for where, points in by_place.items()
        }
        usual = median_high(latest.values())
        for where, distance in find_outliers(latest, LEVEL / len(collected)).items():
            found.append(Outlier(where, quantity, latest[where], usual, distance))
    return tuple(found)


def _place(item: Series | Outlier) -> dict[str, str]:
    return {**item.where._asdict(), **item.quantity._asdict()}


def _change_dict(change: ChangePoint) -> dict[str, object]:
    dates = {key: date_of(getattr(change, key)) for key in ("day", "low", "high")}
    return {**change._asdict(), **dates}
