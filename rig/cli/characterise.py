"""`rig characterise`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.output import (
    FAILED,
    JsonFlag,
    JUnitFile,
    Outcome,
    console,
    finite,
    print_json,
    refuse_existing,
    table,
    write_junit,
)
from rig.inputs.errors import InputError

if TYPE_CHECKING:
    from rig.characteristics.command import Characteristics
    from rig.characteristics.tolerance import Judged

EXAMPLES = (
    "Examples: `rig characterise dyno.csv` · `rig characterise left.csv right.csv --out found` · "
    "`rig characterise runs/7 --strut suspension` · "
    "`rig characterise dyno.csv --tolerance band.yaml --serial 0815 --out found`"
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
    tolerance: Annotated[
        Path | None,
        typer.Option(
            "--tolerance",
            metavar="FILE",
            help="Band about a master curve, YAML or CSV: pass or fail.",
        ),
    ] = None,
    serial: Annotated[
        str | None, typer.Option("--serial", metavar="TEXT", help="Serial number, for the report.")
    ] = None,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Find the figures of a damper: force over velocity, energy, gas, friction, knee, temperature.

    Wants a record whose cycles repeat; several are laid over one another on the page. With a
    tolerance the exit code is 1 unless every point of the band is proven to be kept.
    """
    from rig.characteristics.command import SCHEMA, characterise
    from rig.characteristics.tolerance import judged, load_tolerance

    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: holds something, expected a new or empty folder")
    if junit is not None:
        refuse_existing(junit)
    if tolerance is None and junit is not None:
        raise InputError("--junit: says what is kept and what is not, expected --tolerance")
    band = None if tolerance is None else load_tolerance(tolerance)
    found = [characterise(path, strut) for path in runs]
    points = [[] if band is None else judged(item.steps, item.damper.kinds, band) for item in found]
    content: dict[str, object] = {
        "schema": SCHEMA,
        "serial": serial,
        "tolerance": None if band is None else band.name,
        "records": [
            item.as_dict() | {"points": [point.as_dict() for point in of]}
            for item, of in zip(found, points, strict=True)
        ],
    }
    if out is not None:
        _write(found, points, serial, content, out)
    outcomes = [
        Outcome(
            f"{item.name}: {point.side} at {point.velocity_m_per_s:g} m/s",
            f"{point.verdict}: {point.words()}",
            point.verdict != "pass",
        )
        for item, of in zip(found, points, strict=True)
        for point in of
    ]
    if junit is not None:
        write_junit(junit, f"rig characterise {serial or ''}".strip(), outcomes)
    if as_json:
        print_json(content)
    else:
        for item, of in zip(found, points, strict=True):
            _print(item, of)
        if out is not None:
            console.print(f"Report: {out / 'report.html'}", markup=False)
    if any(outcome.failed for outcome in outcomes):
        raise typer.Exit(FAILED)


def _write(
    found: "list[Characteristics]",
    points: "list[list[Judged]]",
    serial: str | None,
    content: dict[str, object],
    out: Path,
) -> None:
    from rig.pages.characteristics_page import write_characteristics_page

    try:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(finite(content), indent=2, ensure_ascii=False) + "\n"
        (out / "characteristics.json").write_text(text, "utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error
    write_characteristics_page(found, out / "report.html", points, serial)


def _print(item: "Characteristics", points: "list[Judged]") -> None:
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
    if points:
        band = table("point", "force", "verdict")
        for point in points:
            where = f"{point.side} at {point.velocity_m_per_s:g} m/s"
            band.add_row(where, point.words(), point.verdict)
        console.print(band)
    for note in (*item.quality, *item.damper.notes):
        console.print(f"- {note}", markup=False)
