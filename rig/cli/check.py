"""`rig check`."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rig.cli.junit import JUnitFile, Outcome, write_junit
from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import (
    FAILED,
    ConfigFile,
    JsonFlag,
    print_json,
    print_table,
    print_text,
    styled,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.plan.preflight_checks import Finding

EXAMPLES = "Examples: `rig check rig.yaml` · `rig check rig.yaml --junit check.xml`"


def check_command(
    config: ConfigFile,
    out: SummaryFolder = None,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Check a configuration before the bench moves: signals, units, rate, bus load, poles.

    The exit code is 1 if there is an error; warnings do not change it.
    """
    from rig.plan.load import load_plan
    from rig.plan.preflight_checks import Severity, check

    findings = check(load_plan(config))
    as_dicts = [finding.as_dict() for finding in findings]
    if as_json:
        print_json(as_dicts)
    else:
        _print(config, findings)
        if not any(finding.severity is Severity.ERROR for finding in findings):
            print_text(
                f"Next: `rig run {config} --listen-only --duration-s 20 --out first` while the "
                f"bench moves as usual, then `rig tune {config} --run first --out tuned.yaml`"
            )
    write_summary(out, {"findings": as_dicts})
    outcomes = [
        Outcome(finding.what, finding.text, finding.severity is Severity.ERROR)
        for finding in findings
    ]
    write_junit(junit, f"rig check {config}", outcomes)
    if any(outcome.failed for outcome in outcomes):
        raise typer.Exit(FAILED)


def _print(config: Path, findings: "Sequence[Finding]") -> None:
    from rig.plan.preflight_checks import Severity

    styles = {Severity.OK: "green", Severity.WARNING: "yellow", Severity.ERROR: "red"}
    wrong, doubtful, fine = (
        [item for item in findings if item.severity is severity]
        for severity in (Severity.ERROR, Severity.WARNING, Severity.OK)
    )
    counted = [_counted(items, word) for items, word in ((wrong, "error"), (doubtful, "warning"))]
    said = "; ".join(text for text in counted if text)
    head = "Not ready" if wrong else "Ready"
    summary = f"{head}, with {said}." if said else f"{head}: no errors, no warnings."
    print_text(summary, "red" if wrong else "yellow" if doubtful else "green")
    findings = [*wrong, *doubtful, *fine]
    rows = [
        (styled(item.severity.value, styles[item.severity]), item.what, item.text)
        for item in findings
    ]
    print_table(("", "What", "Finding"), rows, f"Check of {config}")


def _counted(items: "Sequence[Finding]", word: str) -> str:
    """Findings of a kind, counted and named; empty without one."""
    names = ", ".join(dict.fromkeys(item.what for item in items))
    return f"{len(items)} {word}{'s' if len(items) > 1 else ''}: {names}" if items else ""
