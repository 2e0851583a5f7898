"""`rig check`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rig.cli.output import FAILED, ConfigFile, console, write_summary

EXAMPLES = "Example: `rig check rig.yaml`"


def check_command(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
) -> None:
    """Say what is wrong before a bench moves: signals, units, rate, bus load, poles."""
    from rig.operation.check import Severity, check
    from rig.operation.setup import load_setup

    findings = check(load_setup(config))
    table = Table("", "What", "Finding", title=f"Check of {config}")
    styles = {Severity.OK: "green", Severity.WARNING: "yellow", Severity.ERROR: "red"}
    for finding in findings:
        style = styles[finding.severity]
        table.add_row(f"[{style}]{finding.severity.value}[/]", finding.what, finding.text)
    console.print(table)
    if out is not None:
        write_summary(out, {"findings": [finding.as_dict() for finding in findings]})
    if any(finding.severity is Severity.ERROR for finding in findings):
        raise typer.Exit(FAILED)
