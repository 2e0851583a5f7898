"""`rig characterise`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.junit import JUNIT, JUnitFile, Outcome, write_junit
from rig.cli.terminal import (
    FAILED,
    JsonFlag,
    Labels,
    LagGiven,
    MovingMass,
    PrintToo,
    StrutOfRun,
    TemperatureWindow,
    ZeroFlag,
    parse_window,
    print_json,
    print_table,
    print_text,
    refuse_existing,
)

if TYPE_CHECKING:
    from rig.dyno.characterise import Characteristics
    from rig.dyno.report import DamperReport
    from rig.dyno.tolerance import PointVerdict

EXAMPLES = (
    "Examples: `rig characterise dyno.csv` · `rig characterise left.csv right.csv --out found` · "
    "`rig characterise runs/7 --strut suspension` · "
    "`rig characterise dyno.csv --tolerance band.yaml --serial 0815 --out found` · "
    "`rig characterise 0815.csv --master good.csv` · "
    "`rig characterise warm.csv --temperature-c 40:60 --speeds 0.05,0.13,0.52 --curves warm.xlsx`"
)


Tolerance = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Tolerance band about a master curve, YAML or CSV."),
]
Master = Annotated[
    Path | None,
    typer.Option(
        metavar="RUN", help="Record of a good damper in the same test, with which RUN is compared."
    ),
]
Scatter = Annotated[
    float,
    typer.Option(
        metavar="SHARE",
        min=0.001,
        max=0.5,
        help="With --master: relative standard deviation of each property among good dampers.",
    ),
]


def characterise_command(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN", help="Run folders, or CSV files of measured data."),
    ],
    strut: StrutOfRun = None,
    zero: ZeroFlag = True,
    lag_ms: LagGiven = None,
    moving_mass_kg: MovingMass = 0.0,
    temperature_c: TemperatureWindow = None,
    reference_c: Annotated[
        float | None,
        typer.Option(
            metavar="C",
            help="Temperature at which the forces of the curves are also given, where the record "
            "determines the change per kelvin.",
        ),
    ] = None,
    speeds: Annotated[
        str | None,
        typer.Option(
            metavar="V,V,...",
            help="Speeds in m/s at which the curves give forces; without it 0.05 to 1.5 m/s.",
        ),
    ] = None,
    curves: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="New CSV or XLSX file for the curves: forces at speeds with their intervals.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="New folder for characteristics.json and report.html."),
    ] = None,
    tolerance: Tolerance = None,
    master: Master = None,
    scatter: Scatter = 0.03,
    serial: Annotated[
        str | None, typer.Option(metavar="TEXT", help="Serial number, for the report.")
    ] = None,
    label: Labels = None,
    pdf: PrintToo = False,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Report the figures of a damper: force over velocity, energy, gas force, friction, knee.

    A record must contain repeated cycles; several records are drawn into one report. With
    --tolerance, the exit code is 1 unless every point of the band passes; with --master, unless the
    damper agrees with the master in all steps of the master's record.
    """
    from rig.dyno.report import content_of, evaluate_records, write_content
    from rig.dyno.request import FigureRequest
    from rig.dyno.tolerance import load_tolerance
    from rig.formats.curve_table import write_curve_table
    from rig.pages.identity import parse_labels

    _check_outputs(out, curves, junit, pdf=pdf, is_judged=bool(tolerance or master))
    labels = ({"serial": serial} if serial else {}) | parse_labels(label or [])
    band = None if tolerance is None else load_tolerance(tolerance)
    requested = FigureRequest(
        zero,
        None if lag_ms is None else 1e-3 * lag_ms,
        moving_mass_kg,
        parse_window(temperature_c, "--temperature-c"),
        reference_c,
        _parse_speeds(speeds),
    )
    reports = evaluate_records(runs, strut, band, master, scatter, requested)
    content = content_of(reports, serial, band)
    if curves is not None:
        write_curve_table([report.characteristics for report in reports], curves)
    if out is not None:
        write_content(content, out)
        _write_sheet(reports, out, labels, pdf=pdf)
    checks = [check for report in reports for check in report.checks()]
    outcomes = [Outcome(check.name, check.words, not check.passes) for check in checks]
    write_junit(junit, f"rig characterise {serial or ''}".strip(), outcomes)
    if as_json:
        print_json(content)
    else:
        for report in reports:
            _print(report)
        if curves is not None:
            print_text(f"Curves: {curves}")
        if out is not None:
            print_text(f"Report: {out / 'report.html'}{' and report.pdf' if pdf else ''}")
    if not all(check.passes for check in checks):
        raise typer.Exit(FAILED)


def _parse_speeds(text: str | None) -> tuple[float, ...]:
    """Speeds from a text such as 0.05,0.1."""
    from rig.dyno.request import STANDARD_SPEEDS_M_PER_S

    if text is None:
        return STANDARD_SPEEDS_M_PER_S
    try:
        speeds = tuple(sorted({float(cell) for cell in text.split(",")}))
    except ValueError:
        speeds = ()
    if not speeds or not all(0.0 < speed <= 100.0 for speed in speeds):
        raise InputError(f"--speeds {text}: expected speeds in m/s, such as 0.05,0.1,0.3")
    return speeds


def _check_outputs(
    out: Path | None, curves: Path | None, junit: Path | None, *, pdf: bool, is_judged: bool
) -> None:
    """Refuse files that cannot be written, and a report on no verdict, before the work."""
    from rig.files.folders import refuse_full
    from rig.formats.curve_table import check_curve_table
    from rig.pages.browser_print import find_browser

    if out is not None:
        refuse_full(out)
    if curves is not None:
        check_curve_table(curves)
    if pdf and out is None:
        raise InputError("--pdf: expected --out DIR, where the report is written")
    if pdf:
        find_browser()
    refuse_existing(junit, option=JUNIT)
    if junit is not None and not is_judged:
        raise InputError("--junit: expected --tolerance or --master, which it reports on")


def _write_sheet(
    reports: "Sequence[DamperReport]", out: Path, labels: dict[str, str], *, pdf: bool
) -> None:
    from rig.pages.browser_print import print_page
    from rig.pages.characteristics_page import write_characteristics_page

    page = out / "report.html"
    write_characteristics_page(reports, page, labels)
    if pdf:
        print_page(page, page.with_suffix(".pdf"))


def _print(report: "DamperReport") -> None:
    record = report.characteristics
    _print_steps(record)
    _print_points(report.points)
    for note in (*record.quality, *record.damper.notes):
        print_text(f"- {note}")
    if report.against_master is not None:
        print_text(f"Against the master: {report.against_master.words()}.")


def _print_steps(record: "Characteristics") -> None:
    from rig.pages.characteristics_page import KIND_WORDS, damper_rows, with_half

    heads = ("step", "± mm", "m/s", "compression N", "rebound N", "J a cycle", "N·s/m")
    steps = [
        (
            KIND_WORDS[step.kind],
            f"±{1e3 * step.amplitude_m:.2f}",
            f"{step.peak_speed_m_per_s:.3g}",
            with_half(step.compression.force_at_peak_velocity_n),
            with_half(step.rebound.force_at_peak_velocity_n),
            with_half(step.energy_per_cycle_j),
            with_half(step.equivalent_damping_n_s_per_m),
        )
        for step in record.steps
    ]
    print_table(heads, steps, f"{record.name} (force: {record.record.source})")
    rows = damper_rows(record)
    if rows:
        print_table(("over all steps", "value", "95 % interval", "method"), rows)


def _print_points(points: "Sequence[PointVerdict]") -> None:
    rows = [
        (f"{point.side} at {point.velocity_m_per_s:g} m/s", point.words(), point.verdict)
        for point in points
    ]
    if rows:
        print_table(("point", "force", "verdict"), rows)
