"""Figures and tables over all results."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.diagnosis_benchmark.judge import Result
from tests.truth.cases import FAMILIES

FIRST_COLUMNS = (*FAMILIES, "restoring_surface", "none")
GROUPS = ("single", "pair", "triple", "complete", "outside", "foreign", "faint")
TARGETS = {"single": 0.98, "pair": 0.90, "complete": 0.98, "outside": 1.0}


def _share(results: Iterable[Result], holds: Callable[[Result], bool]) -> float:
    flags = [holds(result) for result in results]
    return float(np.mean(flags)) if flags else float("nan")


def _percentile(values: list[float], percent: float) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.percentile(finite, percent)) if finite else float("nan")


def _named(result: Result) -> str:
    return result.families[0] if result.families else "none"


def group_figures(results: list[Result]) -> dict[str, object]:
    """Figures of one group of cases."""
    multiples = [result.floor_multiple for result in results]
    held = [interval for result in results if result.right for interval in result.intervals]
    times = [result.duration_s for result in results]
    before = [result.rmse_before_m / result.height_noise_m for result in results]
    return {
        "cases": len(results),
        "right": _share(results, lambda result: result.right),
        "verdicts": dict(Counter(result.verdict for result in results)),
        "spurious_effects": _share(results, _has_spurious),
        "held_out_over_floor_before_median": _percentile(before, 50),
        "held_out_over_floor_median": _percentile(multiples, 50),
        "held_out_over_floor_95_percent": _percentile(multiples, 95),
        "intervals": len(held),
        "interval_coverage": _share(held, lambda interval: interval.holds),
        "seconds_median": _percentile(times, 50),
        "seconds_max": _percentile(times, 100),
    }


def _has_spurious(result: Result) -> bool:
    return any(family not in result.planted for family in result.families)


def confusion(results: list[Result]) -> dict[str, dict[str, int]]:
    """Planted family -> first named family -> cases."""
    return {
        family: dict(Counter(_named(r) for r in results if r.planted == (family,)))
        for family in FAMILIES
    }


def coverage(results: list[Result]) -> dict[str, tuple[int, int]]:
    """Parameter -> intervals that hold the truth, and all."""
    held = [i for r in results if r.right for i in r.intervals]
    names = sorted({i.parameter for i in held})
    return {
        name: (sum(i.holds for i in held if i.parameter == name), _count(held, name))
        for name in names
    }


def _count(held: list, name: str) -> int:
    return sum(1 for interval in held if interval.parameter == name)


def summarise(results: list[Result]) -> dict[str, object]:
    """Everything that the tables show, as plain data."""
    groups = {g: [r for r in results if r.group == g] for g in GROUPS}
    return {
        "groups": {g: group_figures(members) for g, members in groups.items() if members},
        "targets_right": TARGETS,
        "confusion": confusion(groups["single"]),
        "coverage": coverage([r for r in results if r.group in {"single", "pair", "triple"}]),
        "wrong": [
            {
                "slot": r.slot,
                "case": r.case,
                "ratios": r.ratios,
                "verdict": r.verdict,
                "families": r.families,
                "ambiguous_with": r.ambiguous_with,
                "message": r.message,
            }
            for r in results
            if not r.right and r.group != "faint"
        ],
    }


def print_tables(summary: dict, console: Console) -> None:
    """Print all tables."""
    for table in (_groups_table(summary), _confusion_table(summary), _coverage_table(summary)):
        console.print(table)
    console.print(_wrong_table(summary))


def _groups_table(summary: dict) -> Table:
    table = Table(title="Groups")
    for heading in ("group", "cases", "right", "target", "verdicts", "spurious"):
        table.add_column(heading)
    for heading in ("held-out / floor: before", "median", "95 %", "coverage", "s median", "s max"):
        table.add_column(heading, justify="right")
    for group, f in summary["groups"].items():
        target = summary["targets_right"].get(group)
        table.add_row(
            group,
            str(f["cases"]),
            f"{f['right']:.1%}",
            f"{target:.0%}" if target else "",
            ", ".join(f"{verdict} {n}" for verdict, n in sorted(f["verdicts"].items())),
            f"{f['spurious_effects']:.0%}",
            f"{f['held_out_over_floor_before_median']:.1f}",
            f"{f['held_out_over_floor_median']:.2f}",
            f"{f['held_out_over_floor_95_percent']:.2f}",
            f"{f['interval_coverage']:.0%} of {f['intervals']}",
            f"{f['seconds_median']:.1f}",
            f"{f['seconds_max']:.1f}",
        )
    return table


def _confusion_table(summary: dict) -> Table:
    table = Table(title="Planted (rows) and named first (columns), single effects")
    table.add_column("planted")
    for number, _ in enumerate(FIRST_COLUMNS):
        table.add_column(str(number + 1), justify="right")
    for number, family in enumerate(FAMILIES):
        row = summary["confusion"][family]
        cells = [str(row.get(column, "")) for column in FIRST_COLUMNS]
        table.add_row(f"{number + 1} {family}", *cells)
    table.caption = f"{len(FAMILIES) + 1} restoring_surface, {len(FAMILIES) + 2} none"
    return table


def _coverage_table(summary: dict) -> Table:
    table = Table(title="95 % intervals that hold the truth, where the answer is right")
    table.add_column("parameter")
    table.add_column("inside", justify="right")
    table.add_column("of", justify="right")
    for name, (inside, count) in summary["coverage"].items():
        table.add_row(name, str(inside), str(count))
    return table


def _wrong_table(summary: dict) -> Table:
    table = Table(title="Wrong answers")
    for heading in ("case", "over floor", "verdict", "named", "rivals", "message"):
        table.add_column(heading, overflow="fold")
    for entry in summary["wrong"]:
        table.add_row(
            f"{entry['slot']} {entry['case']}",
            " ".join(f"{ratio:.0f}" for ratio in entry["ratios"]),
            entry["verdict"],
            ", ".join(entry["families"]),
            ", ".join(entry["ambiguous_with"]),
            entry["message"],
        )
    return table


def write_tables(results: list[Result], summary: dict, out: Path) -> None:
    """Write ``summary.json``, and ``cases.csv`` with one row a case."""
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    columns = ("slot", "case", "planted", "laws", "ratios", "verdict", "names", "ambiguous_with")
    columns += ("right", "height_noise_m", "rmse_before_m", "rmse_after_m", "own_floor_m")
    columns += ("duration_s", "message")
    with (out / "cases.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for result in results:
            values = (getattr(result, column) for column in columns)
            writer.writerow(" ".join(map(str, v)) if isinstance(v, tuple) else v for v in values)
