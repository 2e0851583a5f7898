"""`rig check`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rig.cli.junit import JUnitFile, Outcome, write_junit
from rig.cli.summary_file import write_summary
from rig.cli.terminal import FAILED, ConfigFile, JsonFlag, console, print_json, table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.plan.preflight_checks import Finding

EXAMPLES = "Examples: `rig check rig.yaml` · `rig check rig.yaml --junit check.xml`"


def check_command(
    config: ConfigFile,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Say what is wrong before a bench moves: signals, units, rate, bus load, poles."""
    from rig.plan.load import load_plan
    from rig.plan.preflight_checks import Severity, check

    findings = check(load_plan(config))
    if as_json:
        print_json([finding.as_dict() for finding in findings])
    else:
        _print(config, findings)
    if out is not None:
        write_summary(out, {"findings": [finding.as_dict() for finding in findings]})
    if junit is not None:
        wrong = Severity.ERROR
        outcomes = [Outcome(item.what, item.text, item.severity is wrong) for item in findings]
        write_junit(junit, f"rig check {config}", outcomes)
    if any(finding.severity is Severity.ERROR for finding in findings):
        raise typer.Exit(FAILED)


def _print(config: Path, findings: "Sequence[Finding]") -> None:
    from rig.plan.preflight_checks import Severity

    shown = table("", "What", "Finding", title=f"Check of {config}")
    styles = {Severity.OK: "green", Severity.WARNING: "yellow", Severity.ERROR: "red"}
    for finding in findings:
        style = styles[finding.severity]
        shown.add_row(f"[{style}]{finding.severity.value}[/]", finding.what, finding.text)
    console.print(shown)
