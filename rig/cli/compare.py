"""`rig compare`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import JsonFlag, console, print_json, table

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
        typer.Argument(
            metavar="A B...", help="Folders of runs, or CSV files: states of one damper."
        ),
    ],
    dose: Annotated[
        list[float] | None,
        typer.Option(
            "--dose", metavar="NUMBER", help="Of each state: pressure, clicks, °C; once for each."
        ),
    ] = None,
    strut: Annotated[
        str | None, typer.Option("--strut", metavar="NAME", help="Which strut of a run.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Say what differs between two states of a damper, by how much, and what does not.

    With --dose, once for each state: how each figure changes over the dose.
    """
    from rig.dyno.characterise import characterise
    from rig.dyno.comparison import compared, over_dose

    if not dose and len(runs) != 2:
        raise InputError(f"{len(runs)} records, expected two, or --dose once for each")
    found = [characterise(path, strut) for path in runs]
    if dose:
        trends = over_dose(found, dose)
        if as_json:
            print_json({"schema": 1, "trends": [item.as_dict() for item in trends]})
        else:
            _print_trends(trends)
            _print_unpaired(found)
        return
    differences = compared(found[0], found[1])
    if as_json:
        print_json({"schema": 1, "differences": [item.as_dict() for item in differences]})
        return
    _print_differences(differences, found[0].name, found[1].name)
    _print_unpaired(found)


def _print_unpaired(found: "list[Characteristics]") -> None:
    from rig.dyno.comparison import unpaired

    for text in unpaired(found):
        console.print(f"- not compared: {text}", markup=False)


def _print_differences(found: "list[Difference]", before: str, after: str) -> None:
    shown = table("figure", before, after, "change, 95 % interval", title="What differs")
    same: list[str] = []
    for item in found:
        if not item.differs:
            unit = f" {item.unit}" if item.unit else ""
            same.append(f"{item.name} (by at most {_reach(item.change)}{unit})")
            continue
        shown.add_row(
            item.name, _number(item.before), _number(item.after), _interval(item.change, item.unit)
        )
    if shown.rows:
        console.print(shown)
    else:
        console.print("Nothing that was compared differs by more than chance.")
    if same:
        console.print(f"Not shown to differ: {'; '.join(same)}.", markup=False)


def _print_trends(found: "list[Trend]") -> None:
    shown = table("figure", "change per unit of dose", "at zero", "", title="Over the dose")
    for item in found:
        if item.differs:
            shape = "straight" if item.is_straight else "bent: a line is not all"
            shown.add_row(
                item.name,
                _interval(item.slope, item.unit),
                f"{item.at_zero:.4g} {item.unit}",
                shape,
            )
    if shown.rows:
        console.print(shown)
    same = [item.name for item in found if not item.differs]
    if same:
        console.print(f"No change over the dose: {'; '.join(same)}.", markup=False)


def _number(figure: "Figure") -> str:
    from rig.pages.characteristics_page import with_half

    return with_half(figure)


def _interval(figure: "Figure", unit: str) -> str:
    return f"{figure.value:+.3g} {unit} ({figure.low:+.3g} to {figure.high:+.3g})"


def _reach(figure: "Figure") -> str:
    return f"{max(abs(figure.low), abs(figure.high)):.2g}"
