"""`rig compare`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import JsonFlag, StrutOfRun, console, print_json, print_table, print_text

if TYPE_CHECKING:
    from rig.dyno.characterise import Characteristics
    from rig.dyno.comparison import Difference, Trend
    from rig.dyno.stroke_force import Figure

EXAMPLES = (
    "Examples: `rig compare before.csv after.csv` · "
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
    as_json: JsonFlag = False,
) -> None:
    """Compare two states of a damper: list the figures that differ significantly, and the others.

    With --dose NUMBER for each of three or more states, fit a straight line to each figure over
    these numbers.
    """
    from rig.dyno.characterise import characterise
    from rig.dyno.comparison import compare_dampers, trends_over_dose

    if not dose and len(runs) != 2:
        raise InputError(
            f"{len(runs)} given, expected two records to compare, or --dose NUMBER once for each"
        )
    records = [characterise(path, strut) for path in runs]
    if dose:
        trends = trends_over_dose(records, dose)
        if as_json:
            print_json({"schema": 1, "trends": trends})
        else:
            _print_trends(trends)
            _print_missing(records)
        return
    differences = compare_dampers(records[0], records[1])
    if as_json:
        print_json({"schema": 1, "differences": differences})
        return
    _print_differences(differences, records[0].name, records[1].name)
    _print_missing(records)


def _print_missing(records: "list[Characteristics]") -> None:
    from rig.dyno.comparison import steps_without_partner

    for text in steps_without_partner(records):
        print_text(f"- not compared: {text}")


def _print_differences(differences: "list[Difference]", before: str, after: str) -> None:
    from rig.pages.characteristics_page import with_half

    rows: list[tuple[str, ...]] = []
    same: list[str] = []
    for item in differences:
        if item.differs:
            states = with_half(item.before), with_half(item.after)
            rows.append((item.figure, *states, _interval(item.change, item.unit)))
        else:
            bound = f"{max(abs(item.change.low), abs(item.change.high)):.2g} {item.unit}".rstrip()
            same.append(f"{item.figure} (by at most {bound})")
    if rows:
        print_table(("figure", before, after, "change, 95 % interval"), rows, "What differs")
    else:
        console.print("No figure that was compared differs by more than chance.")
    if same:
        print_text(f"Not shown to differ: {'; '.join(same)}.")


def _print_trends(trends: "list[Trend]") -> None:
    rows = [
        (
            item.figure,
            _interval(item.slope, item.unit),
            f"{item.at_zero:.4g} {item.unit}",
            "straight" if item.is_straight else "bent: no straight line",
        )
        for item in trends
        if item.differs
    ]
    if rows:
        heads = ("figure", "change per unit of dose", "at zero", "")
        print_table(heads, rows, "Over the dose")
    same = [item.figure for item in trends if not item.differs]
    if same:
        print_text(f"No change over the dose: {'; '.join(same)}.")


def _interval(figure: "Figure", unit: str) -> str:
    return f"{figure.value:+.3g} {unit} ({figure.low:+.3g} to {figure.high:+.3g})"
