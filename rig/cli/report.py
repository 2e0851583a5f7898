"""`rig report`."""

from pathlib import Path
from typing import Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import JsonFlag, Labels, PrintToo, RunFolder, print_json, print_text

EXAMPLES = "Examples: `rig report runs/7` · `rig report runs/7 --out handed_over.html --pdf`"


def report(
    run: RunFolder,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="New HTML file; RUN/report.html by default."),
    ] = None,
    label: Labels = None,
    pdf: PrintToo = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a report of a run as one HTML file: configuration, errors, timing, faults."""
    from rig.log.checksums import refuse_damage
    from rig.pages.browser_print import print_page
    from rig.pages.identity import parse_labels
    from rig.pages.run_report import write_run_report

    path = out or run / "report.html"
    if path.suffix == ".pdf":
        raise InputError(f"--out {path}: expected the HTML page; --pdf also writes {path.stem}.pdf")
    paper = path.with_suffix(".pdf")
    for existing in (path, paper) if pdf else (path,):
        if existing.exists():
            raise InputError(f"{existing}: exists, expected another name (--out)")
    damage = write_run_report(run, path, parse_labels(label or []))
    if pdf:
        print_page(path, paper)
    if as_json:
        print_json({"report": str(path), "pdf": str(paper) if pdf else None})
    else:
        print_text(f"Written: {path}")
        if pdf:
            print_text(f"Printed: {paper}")
    refuse_damage(run, damage)
