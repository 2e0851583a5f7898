"""Whether what a fleet's report calls visible is seen: `python -m tests.fleet.power [--fleets N]`.

A fleet without a change is reported. Then one damper gets the drift that this report calls visible,
and in a further report the step; the scatter is the same in all three.
"""

import argparse
import datetime
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rig.fleet import store
from rig.fleet.one_run import RunRow, RunValue
from rig.fleet.overview import read_overview
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.fleet.population import FIRST

QUANTITIES = {"friction_n": 20.0, "gas_force_n": 250.0, "compression_force_n_at_0.2_m_per_s": 900.0}

TEXT = """
{fleets} fleets are drawn at random: 2 to 40 dampers on 1 to 4 benches, run every one, two or four
weeks for 3 to 24 months. Each run gives three figures, which scatter from run to run by 0.3 to 3 %
(Gaussian, independent, in each damper by another factor of 0.7 to 1.4), and differ from damper to
damper by 2 %. `rig fleet report` is run on each fleet three times: without a change, with a drift
of one figure of one damper, and with a step of it in the middle. The sizes of drift and step are
those that the first report calls visible for this damper: larger changes would be seen with a
chance of 95 %. The runs' scatter is the same in the three reports. Where a damper has less than ten
runs, the report states that no step is looked for.

*Accused* are fleets without a change in which a damper or a bench is accused of a drift, a step, an
outlier or a jump; the level is 1 % for all of these together.
"""


class Fleet(NamedTuple):
    """Values without a change, by damper and quantity, shape (runs,); days of the runs."""

    benches: int
    days: tuple[int, ...]
    values: dict[tuple[int, str], np.ndarray]


def drawn(rng):
    """A fleet at random."""
    dampers, benches = int(rng.integers(2, 41)), int(rng.integers(1, 5))
    weeks, every = int(rng.integers(13, 105)), int(rng.choice([1, 2, 4]))
    days = tuple(7 * week for week in range(0, weeks, every))
    scatter = float(np.exp(rng.uniform(np.log(0.003), np.log(0.03))))
    values = {}
    for damper in range(dampers):
        own = scatter * float(np.exp(rng.uniform(np.log(0.7), np.log(1.4))))
        for quantity, usual in QUANTITIES.items():
            level = usual * (1.0 + 0.02 * rng.standard_normal())
            values[damper, quantity] = level * (1.0 + own * rng.standard_normal(len(days)))
    return Fleet(benches, days, values)


def overview(fleet):
    """The report on a fleet."""
    rows = []
    for number, day in enumerate(fleet.days):
        date = (FIRST + datetime.timedelta(days=day)).isoformat()
        for damper in {damper for damper, _ in fleet.values}:
            values = tuple(
                RunValue("figure", "", "", "", quantity, own[number], 0.0, 0.0)
                for (of, quantity), own in fleet.values.items()
                if of == damper
            )
            key = f"{damper}-{number}"
            rows.append(
                RunRow(
                    *(key, key, f"runs/{key}", f"bench {damper % fleet.benches}", f"A{damper}"),
                    *(date, "m", "h", "0.3.0"),
                    verdict="nothing_missing",
                    values=values,
                )
            )
    with tempfile.TemporaryDirectory() as name:
        store.append(Path(name), rows)
        return read_overview(Path(name))


def changed(fleet, which, more):
    """A fleet with more of one damper's quantity."""
    return fleet._replace(values={**fleet.values, which: fleet.values[which] + more})


def one(seed):
    """Runs of a damper, accusations without a change, and whether drift and step are seen."""
    rng = np.random.default_rng(seed)
    fleet = drawn(rng)
    which = list(fleet.values)[int(rng.integers(len(fleet.values)))]
    before = overview(fleet)
    accused = bool(
        before.jumps or before.outliers or any(it.is_change or it.is_drift for it in before.series)
    )
    visible = series_of(before, which).visible
    days, sign = np.array(fleet.days, float), float(rng.choice([-1.0, 1.0]))
    drift = overview(changed(fleet, which, sign * visible.drift_per_day * days))
    seen = series_of(drift, which)
    sees_step = None
    if visible.step is not None:
        late = np.arange(len(days)) >= len(days) // 2
        step = series_of(overview(changed(fleet, which, sign * visible.step * late)), which)
        sees_step = step.is_change
    return len(days), accused, seen.is_drift or seen.is_change, sees_step


def series_of(found, which):
    """A damper's series."""
    damper, quantity = which
    return next(
        it
        for it in found.series
        if it.where.damper == f"A{damper}" and it.quantity.parameter == quantity
    )


GROUPS = ((3, 9), (10, 25), (26, 104))


def study(fleets, seed, each=map):
    """Rows by number of runs: fleets, accused, drifts seen, steps seen and planted."""
    found = list(each(one, [[seed, number] for number in range(fleets)]))
    rows = []
    for low, high in (*GROUPS, (0, 10**6)):
        mine = [it for it in found if low <= it[0] <= high]
        steps = [it[3] for it in mine if it[3] is not None]
        drifts, accused = (sum(it[index] for it in mine) for index in (2, 1))
        rows.append((low, high, len(mine), accused, drifts, sum(steps), len(steps)))
    return rows


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--fleets", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    given = parser.parse_args()
    with ProcessPoolExecutor() as pool:
        rows = study(given.fleets, given.seed, pool.map)
    heads = ("runs of a damper", "fleets", "accused", "drifts seen", "steps seen")
    cells = [
        (
            "all" if low == 0 else f"{low} to {high}",
            count,
            accused,
            f"{drifts} of {count}",
            f"{steps} of {planted}" if planted else "–",
        )
        for low, high, count, accused, drifts, steps, planted in rows
    ]
    for row in (heads, *cells):
        print("  ".join(f"{cell!s:18}" for cell in row))
    if given.page:
        write_evidence(
            "fleet-power",
            "Whether what a fleet's report calls visible is seen",
            TEXT.format(fleets=given.fleets),
            [table(heads, cells)],
            command_line(),
            with_load=False,
        )


if __name__ == "__main__":
    main()
