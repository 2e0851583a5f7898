"""`rig characterise`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.junit import JUnitFile, Outcome, refuse_existing, write_junit
from rig.cli.terminal import FAILED, JsonFlag, console, finite, print_json, table

if TYPE_CHECKING:
    from rig.dyno.characterise import Characteristics
    from rig.dyno.faults import Naming
    from rig.dyno.tolerance import Judged

EXAMPLES = (
    "Examples: `rig characterise dyno.csv` · `rig characterise left.csv right.csv --out found` · "
    "`rig characterise runs/7 --strut suspension` · "
    "`rig characterise dyno.csv --tolerance band.yaml --serial 0815 --out found` · "
    "`rig characterise 0815.csv --master good.csv`"
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
    master: Annotated[
        Path | None,
        typer.Option(
            "--master",
            metavar="RUN",
            help="Record of a good damper, same test: name what is wrong.",
        ),
    ] = None,
    scatter: Annotated[
        float,
        typer.Option(
            "--scatter",
            min=0.001,
            max=0.5,
            help="Relative standard deviation of each property among good dampers.",
        ),
    ] = 0.03,
    serial: Annotated[
        str | None, typer.Option("--serial", metavar="TEXT", help="Serial number, for the report.")
    ] = None,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Find the figures of a damper: force over velocity, energy, gas, friction, knee, temperature.

    Wants a record whose cycles repeat; several are laid over one another on the page. With a
    tolerance the exit code is 1 unless every point of the band is proven to be kept, with a master
    unless the damper is as good as it.
    """
    from rig.dyno.characterise import characterise
    from rig.dyno.faults import named
    from rig.dyno.master import master_of
    from rig.dyno.tolerance import judged, load_tolerance

    _refuse(out, junit, is_judged=tolerance is not None or master is not None)
    band = None if tolerance is None else load_tolerance(tolerance)
    found = [characterise(path, strut) for path in runs]
    good = None if master is None else master_of(characterise(master, strut))
    namings = [None if good is None else named(item, good, scatter) for item in found]
    points = [[] if band is None else judged(item.steps, item.damper.kinds, band) for item in found]
    content = _content(found, points, namings, serial, None if band is None else band.name)
    if out is not None:
        _write(found, points, namings, serial, content, out)
    outcomes = _outcomes(found, points, namings)
    if junit is not None:
        write_junit(junit, f"rig characterise {serial or ''}".strip(), outcomes)
    if as_json:
        print_json(content)
    else:
        for item, of, naming in zip(found, points, namings, strict=True):
            _print(item, of)
            if naming is not None:
                console.print(f"Against the master: {naming.words()}.", markup=False)
        if out is not None:
            console.print(f"Report: {out / 'report.html'}", markup=False)
    if any(outcome.failed for outcome in outcomes):
        raise typer.Exit(FAILED)


def _refuse(out: Path | None, junit: Path | None, *, is_judged: bool) -> None:
    """Refuse what would be overwritten, and a test report of nothing."""
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: holds something, expected a new or empty folder")
    if junit is not None:
        refuse_existing(junit)
        if not is_judged:
            raise InputError("--junit: says what is good, expected --tolerance or --master")


def _content(
    found: "list[Characteristics]",
    points: "list[list[Judged]]",
    namings: "list[Naming | None]",
    serial: str | None,
    band: str | None,
) -> dict[str, object]:
    """All of it, for a file."""
    from rig.dyno.characterise import SCHEMA

    return {
        "schema": SCHEMA,
        "serial": serial,
        "tolerance": band,
        "records": [
            item.as_dict()
            | {"points": [point.as_dict() for point in of]}
            | {"against_master": None if naming is None else naming.as_dict()}
            for item, of, naming in zip(found, points, namings, strict=True)
        ],
    }


def _outcomes(
    found: "list[Characteristics]",
    points: "list[list[Judged]]",
    namings: "list[Naming | None]",
) -> list[Outcome]:
    """What is good and what is not, for a CI server."""
    outcomes = [
        Outcome(
            f"{item.name}: {point.side} at {point.velocity_m_per_s:g} m/s",
            f"{point.verdict}: {point.words()}",
            point.verdict != "pass",
        )
        for item, of in zip(found, points, strict=True)
        for point in of
    ]
    outcomes += [
        Outcome(f"{item.name}: against the master", naming.words(), not naming.passes)
        for item, naming in zip(found, namings, strict=True)
        if naming is not None
    ]
    return outcomes


def _write(
    found: "list[Characteristics]",
    points: "list[list[Judged]]",
    namings: "list[Naming | None]",
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
    write_characteristics_page(found, out / "report.html", points, namings, serial)


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
