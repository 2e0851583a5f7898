"""`rig compare`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import (
    JsonFlag,
    Labels,
    LagGiven,
    MovingMass,
    StrutOfRun,
    TemperatureWindow,
    ZeroFlag,
    parse_window,
    print_json,
    print_table,
    print_text,
)

if TYPE_CHECKING:
    from rig.dyno.characterise import Characteristics
    from rig.pages.comparison_page import ComparisonTable

EXAMPLES = (
    "Examples: `rig compare before.csv after.csv --out compared` · "
    "`rig compare left.csv right.csv --tolerance band.yaml` · "
    "`rig compare 2bar.csv 4bar.csv 6bar.csv --dose 2 --dose 4 --dose 6`"
)


def compare_command(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN", help="Run folders, or CSV files: states of one damper."),
    ],
    dose: Annotated[
        list[float] | None,
        typer.Option(
            metavar="NUMBER",
            help="Pressure, clicks or °C of a state; once for each RUN, in the same order.",
        ),
    ] = None,
    strut: StrutOfRun = None,
    zero: ZeroFlag = True,
    lag_ms: LagGiven = None,
    moving_mass_kg: MovingMass = 0.0,
    temperature_c: TemperatureWindow = None,
    tolerance: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Tolerance band, YAML or CSV: state the difference of two dampers, such as left "
            "and right, in per cent of its width.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New folder for comparison.json and report.html."),
    ] = None,
    label: Labels = None,
    as_json: JsonFlag = False,
) -> None:
    """Compare two states of a damper: list the figures that differ significantly, and the others.

    With --dose NUMBER for each of three or more states, fit a straight line to each figure over
    these numbers.
    """
    from rig.dyno.characterise import characterise
    from rig.dyno.comparison import compare_dampers, match_in_band, trends_over_dose
    from rig.dyno.request import FigureRequest
    from rig.dyno.tolerance import load_tolerance
    from rig.files.folders import refuse_full
    from rig.pages.comparison_page import (
        difference_tables,
        match_table,
        summarise_differences,
        summarise_trends,
        trend_tables,
    )
    from rig.pages.identity import parse_labels

    if not dose and len(runs) != 2:
        raise InputError(
            f"{len(runs)} given, expected two records to compare, or --dose NUMBER once for each"
        )
    if dose and tolerance is not None:
        raise InputError("--tolerance: expected two records, without --dose")
    if out is not None:
        refuse_full(out)
    band = None if tolerance is None else load_tolerance(tolerance)
    labels = parse_labels(label or [])
    requested = FigureRequest(
        zero,
        None if lag_ms is None else 1e-3 * lag_ms,
        moving_mass_kg,
        parse_window(temperature_c, "--temperature-c"),
    )
    records = [characterise(path, strut, requested) for path in runs]
    content: dict[str, object] = {"schema": 1}
    if dose:
        trends = trends_over_dose(records, dose)
        content["trends"] = trends
        summary, tables = summarise_trends(trends, records), trend_tables(trends)
    else:
        names = [record.name for record in records]
        differences = compare_dampers(*records)
        content["differences"] = differences
        summary = summarise_differences(differences, records)
        tables = difference_tables(differences, *names)
        if band is not None:
            left, right = records
            matches = match_in_band(left, right, band)
            content["match"] = matches
            tables = (match_table(matches, *names), *tables)
    if out is not None:
        _write(records, summary, tables, content, out, labels)
    if as_json:
        print_json(content)
        return
    _print(records, summary, tables)
    if out is not None:
        print_text(f"Report: {out / 'report.html'}")


def _write(
    records: "Sequence[Characteristics]",
    summary: str,
    tables: "Sequence[ComparisonTable]",
    content: object,
    out: Path,
    labels: dict[str, str],
) -> None:
    from rig.dyno.report import write_content
    from rig.pages.comparison_page import write_comparison_page

    write_content(content, out, "comparison.json")
    write_comparison_page(records, summary, tables, out / "report.html", labels)


def _print(
    records: "Sequence[Characteristics]", summary: str, tables: "Sequence[ComparisonTable]"
) -> None:
    from rig.dyno.comparison import list_not_comparable
    from rig.pages.comparison_page import notes_on

    print_text(f"{summary[:1].upper()}{summary[1:]}.")
    *shown, others = tables
    for table in shown:
        if table.rows:
            rows = [(row.figure, *row.cells) for row in table.rows]
            print_table(table.heads, rows, table.title)
    if others.rows:
        texts = (
            f"{row.figure} ({others.heads[-1].lower()} {row.cells[-1]})" for row in others.rows
        )
        print_text(f"{others.title}: {'; '.join(texts)}.")
    for text in list_not_comparable(records):
        print_text(f"- not comparable: {text}")
    for text in notes_on(records):
        print_text(f"- {text}")
