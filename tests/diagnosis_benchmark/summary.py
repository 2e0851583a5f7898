"""Figures and tables over all results."""

import csv
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.diagnosis_benchmark.judge import LIVE_MULTIPLE, Result
from tests.diagnosis_benchmark.plan import GROUPS
from tests.evidence import command_line, write_evidence
from tests.evidence import table as markdown_table
from tests.truth.cases import FAMILIES

FIRST_COLUMNS = (*FAMILIES, "restoring_surface", "none")
EXPLAINED_MULTIPLE = 1.2
"""An ``explained`` bench leaves no more than this many times the noise floor."""
WILSON_Z = 1.959964
"""Two-sided 95 % of a normal distribution."""
_APART = ("faint", "disturbed")
"""Groups of which no name is expected."""
POOLS = {
    "one effect": ("single", "rough", "dyno"),
    "several effects": ("pair", "triple", "rough_pair", "rough_triple", "dyno_pair"),
    "nothing planted": ("complete", "rough_complete", "dyno_complete"),
    "foreign formula": ("foreign", "rough_foreign"),
    "base moved": ("moving", "posts"),
    "all but outside": tuple(group for group in GROUPS if group not in {"outside", *_APART}),
    "all": tuple(group for group in GROUPS if group not in _APART),
}
"""Groups that are also counted together. A force outside any catalogue has no right name, so what
is named there is counted apart."""


TEXT = f"""
Recordings are simulated on benches with known truth, by a generator with its own equations of
motion. In each case no effect, one effect or several effects are planted, on a bench or a dyno. The
RMS force of each planted effect is at least five times (in `outside` ten times) the apparent RMS
force that sensor noise alone causes below 25 Hz. The nominal model is exact (apart from these
effects) or rough: its stiffness is wrong by up to 20 %, its damping by up to 40 %, its mass by up
to 5 %, the measured applied force by up to 2 %, and a preload of up to 5 % of the weight (on a
dyno, of the standard deviation of the strut force) is missing.

`single`, `pair` and `triple` are groups with one, two and three planted effects; `complete` has
none. In `foreign`, the planted force belongs to a family of `rig`, but has a formula that `rig`
does not contain; in `outside`, no law of `rig` describes the planted force. `rough` stands for a
rough nominal model, `dyno` for a dyno; the groups that are called just `rough` and `dyno` have one
planted effect. In `moving` and `posts` the base is moved as measured: a mass on a shaker, a quarter
car, or a full car on four posts, with one to three effects in a suspension; every height and every
position of the base has white noise of 10 µm (on posts 5 µm), and springs, dampers and wheels of
the model are rough. On dynos, about half of the cases have a rough nominal model, unless the
planted effect is linear. With a rough nominal model and no planted effect, `explained` is right,
because linear corrections explain the data. In `disturbed` nothing is planted, but the noise of
height and load cell has a time constant of 0.5 to 10 ms, and the height is 0.1 to 5 ms late; there
only the false names count. The rows in italics combine groups, as far as these
were run.

{{groups}} With `--one-of N` in the command at the end of the page,
about one case of N was run in each group, and at least one.

A case counts as right if

- one effect is planted, the verdict is `explained` or `partly_explained`, and `rig diagnose` names
  the family of the effect first (a preload that accompanies a stiffness is not counted before it;
  with a rough nominal model, the first family that is not linear counts),
- or several effects are planted, the verdict is one of these, and all of their families are named,
  as effects (candidates included) or as linear corrections,
- or the verdict is `ambiguous`, and the planted families are named in this way or listed as rivals,
- or nothing is planted, and the verdict is `nothing_missing`, or, with a rough nominal model, at
  most linear corrections are named and the verdict is not `not_explained`,
- or no law of `rig` describes the planted force, and the verdict is `partly_explained` or
  `not_explained`.

The held-out error of an `explained` case is compared with {EXPLAINED_MULTIPLE} times that of a
right model (on a dyno, with {EXPLAINED_MULTIPLE} times the noise floor that the diagnosis reports).
*False names* is the share of cases in which a family is named that was not planted, with at least
one identifiable parameter (linear corrections, such as another stiffness, do not count); *false
candidates* is the share of cases in which the report calls such a family a candidate; *not bound*
is the share of cases in which the data do not exclude that a named effect has the size zero.
Each share is given with its 95 % Wilson interval. The intervals of parameters are counted only in
cases that are right. A case may have several of them; the Wilson interval of their share assumes
that they are independent, and may be too narrow. *F1 of the range in which it acts* is the overlap
of the stroke in which a stop or an end zone shows, and of the speeds at which a knee does, with
those at which they were planted (twice what is common over the sum of both). *Runs live* is the
share of corrected models that follow the held-out run tick by tick at its rate, with the gains that
`rig tune` finds for them: the loop is stable, no force is infinite, and where all is explained the
residual force that the observer finds is at most {LIVE_MULTIPLE:g} times its floor. With a moved
base they run in lockstep with their bench, which moves as in the held-out run, with Kalman filters,
whose gains are computed from the model. The durations depend on the load of the machine, which is
stated at the end of the page.
"""


def _groups_text(run: Iterable[str]) -> str:
    """A sentence about the groups that the table contains."""
    usual = [name for name, group in GROUPS.items() if group.cases]
    absent = [name for name in usual if name not in set(run)]
    if not absent:
        return f"The table contains all {len(usual)} groups of the benchmark."
    names = ", ".join(f"`{name}`" for name in absent)
    number = len(usual) - len(absent)
    contained = f"The table contains {number} of the {len(usual)} groups of the benchmark."
    return f"{contained} Not run: {names}."


class Rate(NamedTuple):
    """A share of cases with its 95 % interval after Wilson (1927); None where there are none."""

    hits: int
    of: int
    share: float | None
    low: float | None
    high: float | None

    def __str__(self) -> str:
        if self.share is None:
            return "-"
        return f"{_percent(self.share)} % ({_percent(self.low)}-{_percent(self.high)})"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f}".removesuffix(".0")


def rate(flags: Iterable[bool]) -> Rate:
    """Share of what is true."""
    values = list(flags)
    hits, count = sum(values), len(values)
    if not count:
        return Rate(0, 0, None, None, None)
    share, z2 = hits / count, WILSON_Z**2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    reach = share * (1 - share) / count + z2 / (4 * count**2)
    half = WILSON_Z / (1 + z2 / count) * math.sqrt(reach)
    # Rounding must not put an end beside the share itself, where all or none are hits.
    low = 0.0 if hits == 0 else middle - half
    high = 1.0 if hits == count else middle + half
    return Rate(hits, count, share, low, high)


def _percentile(values: Iterable[float], percent: float) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.percentile(finite, percent)) if finite else None


def _named(result: Result) -> str:
    return result.families[0] if result.families else "none"


def figures(results: list[Result]) -> dict[str, object]:
    """Figures of some cases."""
    explained = [result.floor_multiple for result in results if result.verdict == "explained"]
    held = [interval for result in results if result.right for interval in result.intervals]
    overlaps = [overlap for result in results for overlap in result.overlaps]
    times = [result.duration_s for result in results]
    return {
        "cases": len(results),
        "right": rate(result.right for result in results),
        "false_names": rate(bool(result.false_names) for result in results),
        "false_candidates": rate(bool(result.false_candidates) for result in results),
        "unbound": rate(bool(result.unbound) for result in results),
        "explained_within": rate(multiple <= EXPLAINED_MULTIPLE for multiple in explained),
        "explained_worst": _percentile(explained, 100),
        "coverage": rate(interval.holds for interval in held),
        "runs_live": rate(r.runs_live for r in results if r.live_force_ratio is not None),
        "overlaps": len(overlaps),
        "overlap_mean": float(np.mean(overlaps)) if overlaps else None,
        "verdicts": dict(Counter(result.verdict for result in results)),
        "over_floor_median": _percentile((result.floor_multiple for result in results), 50),
        "seconds_median": _percentile(times, 50),
        "seconds_worst": _percentile(times, 100),
    }


def confusion(results: list[Result]) -> dict[str, dict[str, int]]:
    """Planted family -> first named family -> cases."""
    return {
        family: dict(Counter(_named(r) for r in results if r.planted == (family,)))
        for family in FAMILIES
    }


def coverage(results: list[Result]) -> dict[str, Rate]:
    """Parameter -> intervals that hold the truth, where the answer is right."""
    held = [interval for result in results if result.right for interval in result.intervals]
    return {
        name: rate(interval.holds for interval in held if interval.parameter == name)
        for name in sorted({interval.parameter for interval in held})
    }


def _pooled(results: list[Result], pools: dict[str, tuple[str, ...]]) -> dict[str, object]:
    members = {name: [r for r in results if r.group in groups] for name, groups in pools.items()}
    return {name: figures(found) for name, found in members.items() if found}


def summarise(results: list[Result]) -> dict[str, object]:
    """Everything that the tables show."""
    return {
        "groups": _pooled(results, {group: (group,) for group in GROUPS}),
        "pools": _pooled(results, POOLS),
        "confusion": confusion([r for r in results if r.group in POOLS["one effect"]]),
        "coverage": coverage([r for r in results if r.group not in _APART]),
        "wrong": _entries(results, lambda r: not r.right and r.group not in _APART),
        "false": _entries(results, lambda r: bool(r.false_names) and r.group != "outside"),
        "unbound": _entries(results, lambda r: bool(r.unbound)),
        "missed_floor": _entries(results, _misses_floor),
    }


def _misses_floor(result: Result) -> bool:
    return result.verdict == "explained" and not result.floor_multiple <= EXPLAINED_MULTIPLE


def _entries(results: list[Result], shown: Callable[[Result], bool]) -> list[dict]:
    return [
        {
            "slot": result.slot,
            "case": result.case,
            "ratios": result.ratios,
            "verdict": result.verdict,
            "families": result.families,
            "linear": result.linear,
            "ambiguous_with": result.ambiguous_with,
            "false_names": result.false_names,
            "false_candidates": result.false_candidates,
            "unbound": result.unbound,
            "over_floor": result.floor_multiple if math.isfinite(result.floor_multiple) else None,
            "message": result.message,
        }
        for result in results
        if shown(result)
    ]


class Column(NamedTuple):
    """A column of the table of groups: its heading, and its cell from a group's figures."""

    heading: str
    cell: Callable[[dict], str]


def _decimal(key: str, form: str) -> Callable[[dict], str]:
    return lambda found: "-" if found[key] is None else format(found[key], form)


def _explained(found: dict) -> str:
    worst = "" if found["explained_worst"] is None else f", worst {found['explained_worst']:.2f}"
    return f"{found['explained_within']}{worst}"


COLUMNS = (
    Column("cases", lambda found: str(found["cases"])),
    Column("right", lambda found: str(found["right"])),
    Column("false names", lambda found: str(found["false_names"])),
    Column("false candidates", lambda found: str(found["false_candidates"])),
    Column("not bound", lambda found: str(found["unbound"])),
    Column(f"`explained` within {EXPLAINED_MULTIPLE} noise floors", _explained),
    Column("95 % intervals that contain the truth", lambda found: f"{found['coverage']}"),
    Column("mean F1 of the range in which it acts", _decimal("overlap_mean", ".2f")),
    Column("runs live", lambda found: str(found["runs_live"])),
    Column("median duration, s", _decimal("seconds_median", ".1f")),
    Column("longest duration, s", _decimal("seconds_worst", ".1f")),
)


def _rows(summary: dict) -> list[list[str]]:
    every = summary["groups"] | {f"*{name}*": f for name, f in summary["pools"].items()}
    return [[name, *(column.cell(found) for column in COLUMNS)] for name, found in every.items()]


def markdown(summary: dict) -> str:
    """The table of groups, ready for a README; each share with its own 95 % interval."""
    heading = ["group", *(column.heading for column in COLUMNS)]
    lines = [heading, ["---", *("---:" for _ in COLUMNS)], *_rows(summary)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _wrong_rows(summary: dict) -> list[tuple[str, ...]]:
    return [
        (
            f"{entry['slot']} ({entry['case']})",
            entry["verdict"],
            ", ".join([*entry["families"], *entry["linear"]]) or "nothing",
            ", ".join(entry["ambiguous_with"]),
            entry["message"],
        )
        for entry in summary["wrong"]
    ]


def write_page(summary: dict) -> None:
    """Write the guide's page: the table of groups, and which cases were wrong."""
    rows = _wrong_rows(summary)
    wrong = markdown_table(("wrong case", "verdict", "named", "ambiguous with", "message"), rows)
    write_evidence(
        "diagnosis",
        "How often a diagnosis is right",
        TEXT.format(groups=_groups_text(summary["groups"])),
        [markdown(summary).strip(), wrong if rows else "No case was wrong."],
        command_line(),
    )


def print_tables(summary: dict, console: Console) -> None:
    """Print all tables."""
    for table in (_groups_table(summary), _confusion_table(summary), _coverage_table(summary)):
        console.print(table)
    titles = {
        "wrong": "Wrong answers",
        "false": "False names",
        "unbound": "Effects that the data do not bind",
        "missed_floor": f"Explained, but above {EXPLAINED_MULTIPLE} floors",
    }
    for key, title in titles.items():
        console.print(_entries_table(summary[key], title))


def _groups_table(summary: dict) -> Table:
    table = Table(title="Groups, each share with its 95 % interval")
    table.add_column("group")
    for column in COLUMNS:
        table.add_column(column.heading, justify="right")
    for row in _rows(summary):
        table.add_row(*row)
    return table


def _confusion_table(summary: dict) -> Table:
    table = Table(title="Planted (rows) and named first (columns), one effect")
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
    for name, found in summary["coverage"].items():
        table.add_row(name, str(found.hits), str(found.of))
    return table


def _entries_table(entries: list[dict], title: str) -> Table:
    table = Table(title=title)
    headings = ("case", "effects / floor", "verdict", "held-out / floor", "named", "linear")
    for heading in (*headings, "rivals", "false, not bound", "message"):
        table.add_column(heading)
    for entry in entries:
        multiple = entry["over_floor"]
        table.add_row(
            f"{entry['slot']} {entry['case']}",
            " ".join(f"{ratio:.0f}" for ratio in entry["ratios"]),
            entry["verdict"],
            "-" if multiple is None else f"{multiple:.2f}",
            ", ".join(entry["families"]),
            ", ".join(entry["linear"]),
            ", ".join(entry["ambiguous_with"]),
            ", ".join([*entry["false_names"], *entry["unbound"]]),
            entry["message"],
        )
    return table


def _plain(value: object) -> object:
    """Rates as objects with names, for JSON."""
    if isinstance(value, Rate):
        return value._asdict()
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return value


def write_tables(results: list[Result], summary: dict, out: Path) -> None:
    """Write ``summary.json``, ``table.md``, and ``cases.csv`` with one row a case."""
    text = json.dumps(_plain(summary), indent=1, allow_nan=False)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    (out / "table.md").write_text(markdown(summary), encoding="utf-8")
    columns = ("slot", "case", "planted", "laws", "ratios", "is_rough", "verdict", "names")
    columns += ("linear", "ambiguous_with", "right", "false_names", "false_candidates", "unbound")
    columns += ("unit",)
    columns += ("error_before", "error_after", "floor", "own_floor", "duration_s", "message")
    with (out / "cases.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        for result in results:
            values = (getattr(result, column) for column in columns)
            writer.writerow(" ".join(map(str, v)) if isinstance(v, tuple) else v for v in values)
