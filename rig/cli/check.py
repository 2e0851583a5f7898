"""`rig check`."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.junit import JUnitFile, Outcome, write_junit
from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import (
    FAILED,
    JsonFlag,
    print_json,
    print_table,
    print_text,
    styled,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rig.plan.preflight_checks import Finding

EXAMPLES = (
    "Examples: `rig check rig.yaml` · `rig check rig.yaml --junit check.xml` · what recordings can "
    "determine: `rig check runs/7 more.csv --model model.yaml` · what to record in addition: "
    "`rig check runs/7 --model model.yaml --excitation next.csv`"
)


def check_command(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="CONFIG|RUN...",
            help="Configuration, a YAML file; with --model: run folders or CSV files.",
        ),
    ],
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Check recordings instead: what they can determine of this model file, or shipped "
            "model.",
        ),
    ] = None,
    excitation: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="With --model: write an excitation (CSV) that is rich in frequencies and "
            "amplitudes, within the recorded stroke.",
        ),
    ] = None,
    out: SummaryFolder = None,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Check a configuration before the bench moves: signals, units, rate, bus load, poles.

    The exit code is 1 if there is an error; warnings do not change it.

    With --model, recordings are checked before they are diagnosed: stroke, speeds, frequencies,
    noise; which linear parameters and which families of laws they can determine; what to record in
    addition. No diagnosis determines a linear parameter better; of a family, the force is that of
    a law of middling visibility. With --excitation, slow cycles, a sweep through the resonance and
    a multisine are planned within 70 % of the recorded stroke, for a bench of one strut that is a
    dyno or is driven by one applied force. An applied force is what masses, linear spring and
    damper of the model need for the motion. Check it against the limits of your bench before you
    run it.
    """
    if model is not None:
        _check_recordings(paths, model, excitation, out, as_json=as_json, junit=junit)
        return
    if excitation is not None:
        raise InputError(f"--excitation {excitation}: expected recordings and --model MODEL, too")
    if len(paths) > 1:
        raise InputError(
            f"{paths[1]}: expected one configuration, or recordings with --model MODEL"
        )
    if paths[0].is_dir() or paths[0].suffix.lower() == ".csv":
        raise InputError(f"{paths[0]}: is a recording, expected a configuration, or --model MODEL")
    _check_configuration(paths[0], out, as_json=as_json, junit=junit)


def _check_recordings(
    paths: "Sequence[Path]",
    model: str,
    excitation: Path | None,
    out: Path | None,
    *,
    as_json: bool,
    junit: Path | None,
) -> None:
    from dart_model.spec import load_named_model
    from rig.diagnosis.determinable import find_determinable
    from rig.diagnosis.excitation import plan_excitation
    from rig.formats.excitation_table import write_excitation
    from rig.pages import determinable_tables as texts
    from rig.recordings.read import read_recording

    spec = load_named_model(model, Path())
    names = [strut.name for strut in spec.struts]
    recordings = [read_recording(path, names) for path in paths]
    planned = None if excitation is None else plan_excitation(spec, recordings)
    if planned is not None and excitation is not None:
        # Before what takes seconds: the file may be there already.
        write_excitation(planned.t_s, planned.column, planned.values, excitation)
    found = find_determinable(spec, recordings)
    warnings = texts.warnings(found)
    summary: dict[str, object] = {"schema": 1, **asdict(found), "warnings": warnings}
    if as_json:
        print_json(summary)
    else:
        for title, rows in texts.recordings(found):
            print_table(("", ""), rows, title)
        if rows := texts.delays(found):
            heads = ("channel", "estimated delay", "standard deviation")
            print_table(heads, rows, "Delays, if the model lacks no law")
        heads = ("parameter", "strut", "nominal", "known to", "model file", "varies with")
        print_table(heads, texts.linear(found), "Linear part, standard deviations")
        heads = ("family", "strut", "found from", "of the force", "nearest family", "named from")
        print_table(heads, texts.families(found), "Laws, RMS of their force")
        for text in warnings:
            print_text(f"- {text}", "yellow")
        if not warnings:
            print_text("These recordings determine the linear part and all families.", "green")
        if planned is not None:
            stroke = f"{1e3 * planned.heights_m.min():.1f} to {1e3 * planned.heights_m.max():.1f}"
            print_text(
                f"Written: {excitation}, {planned.t_s[-1]:.0f} s of {planned.column}, planned for "
                f"{stroke} mm. On a simulated bench: `components: [{{kind: file, path: FILE}}]`"
            )
        runs = " ".join(str(path) for path in paths)
        print_text(f"Next: `rig diagnose {runs} --model {model} --out found`")
    write_summary(out, summary)
    outcomes = [Outcome("what recordings determine", text, failed=False) for text in warnings]
    write_junit(junit, f"rig check {spec.name}", outcomes)


def _check_configuration(
    config: Path, out: Path | None, *, as_json: bool, junit: Path | None
) -> None:
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
