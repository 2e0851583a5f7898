"""Figures on measured sets, and how they are written."""

import csv
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from rig.diagnosis.outcome import Diagnosis

TABLE_FILE, PAGE_FILE = "scoreboard.csv", "scoreboard.md"
START, CORRECTED = "rig, start model", "rig, corrected"


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        dataset: The set.
        test: On what it was tested.
        model: Which model.
        value: The figure; None where there is none.
        unit: Its unit.
        source: Where a published figure stands, or how ours came about.
    """

    dataset: str
    test: str
    model: str
    value: float | None
    unit: str
    source: str


def write_scoreboard(rows: Sequence[Row], out: Path) -> None:
    """Write the rows as CSV, and as Markdown with one table a set."""
    with (out / TABLE_FILE).open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(Row)])
        writer.writerows(astuple(row) for row in rows)
    (out / PAGE_FILE).write_text(page(rows), "utf-8")


def page(rows: Sequence[Row]) -> str:
    """The rows in Markdown: one table a set, a line a model, a column a test."""
    lines: list[str] = []
    for dataset in dict.fromkeys(row.dataset for row in rows):
        own = [row for row in rows if row.dataset == dataset]
        tests = list(dict.fromkeys(row.test for row in own))
        unit = own[0].unit
        lines += [f"## {dataset} ({unit})", "", f"| model | {' | '.join(tests)} | source |"]
        lines.append("|" + "---|" * (len(tests) + 2))
        for model, source in dict.fromkeys((row.model, row.source) for row in own):
            values = {
                row.test: row.value for row in own if (row.model, row.source) == (model, source)
            }
            cells = [_cell(values.get(test)) for test in tests]
            lines.append(f"| {model} | {' | '.join(cells)} | {source} |")
        lines.append("")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def findings(diagnosis: Diagnosis) -> str:
    """Verdict and effects in one line."""
    effects = ", ".join(effect.name.replace("_", " ") for effect in diagnosis.effects)
    return f"{diagnosis.verdict.replace('_', ' ')}: {effects or 'nothing found'}"
