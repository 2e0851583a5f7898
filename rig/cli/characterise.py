"""`rig characterise`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.output import JsonFlag, console, finite, print_json, table
from rig.inputs.errors import InputError

if TYPE_CHECKING:
    from rig.characteristics.command import Characteristics

EXAMPLES = (
    "Examples: `rig characterise dyno.csv` · `rig characterise left.csv right.csv --out found` · "
    "`rig characterise runs/7 --strut suspension`"
)


def characterise_command(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Folders of runs, or CSV files of measured data."),
    ],
    strut: Annotated[
        str | None, typer.Option("--strut", metavar="NAME", help="Which strut of a run.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="New folder for characteristics.json and report.html."
        ),
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Find the figures of a damper: force over velocity, energy, gas, friction, knee, temperature.

    Wants a record whose cycles repeat; several are laid over one another on the page.
    """
    from rig.characteristics.command import SCHEMA, characterise

    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: holds something, expected a new or empty folder")
    found = [characterise(path, strut) for path in runs]
    content: dict[str, object] = {"schema": SCHEMA, "records": [item.as_dict() for item in found]}
    if out is not None:
        _write(found, content, out)
    if as_json:
        print_json(content)
        return
    for item in found:
        _print(item)
    if out is not None:
        console.print(f"Report: {out / 'report.html'}", markup=False)


def _write(found: "list[Characteristics]", content: dict[str, object], out: Path) -> None:
    from rig.pages.characteristics_page import write_characteristics_page

    try:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(finite(content), indent=2, ensure_ascii=False) + "\n"
        (out / "characteristics.json").write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    write_characteristics_page(found, out / "report.html")


def _print(item: "Characteristics") -> None:
    from rig.pages.characteristics_page import damper_rows, kind_words, with_half

    shown = table(
        "step",
        "± mm",
        "m/s",
        "compression N",
        "rebound N",
        "J a cycle",
        "N·s/m",
        title=f"{item.name} (force: {item.source})",
    )
    for kind, step in zip(item.damper.kinds, item.steps, strict=True):
        shown.add_row(
            kind_words(kind),
            f"±{1e3 * step.amplitude_m:.2f}",
            f"{step.peak_speed_m_per_s:.3g}",
            with_half(step.compression.force_at_peak_velocity),
            with_half(step.rebound.force_at_peak_velocity),
            with_half(step.energy_per_cycle),
            with_half(step.equivalent_damping),
        )
    console.print(shown)
    rows = damper_rows(item)
    if rows:
        over_all = table("over all steps", "value", "95 % interval", "how it was found")
        for row in rows:
            over_all.add_row(*row)
        console.print(over_all)
    for note in item.damper.notes:
        console.print(f"- {note}", markup=False)
