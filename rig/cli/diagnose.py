"""`rig diagnose`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.junit import JUNIT, JUnitFile, write_junit
from rig.cli.progress import progress_bar
from rig.cli.result_tables import diagnosis_check, print_diagnosis
from rig.cli.terminal import JsonFlag, Labels, PrintToo, print_text, refuse_existing

_FAR_LESS = 0.5
"""Share of the residual force from which on a corrected model is worth its corrections."""

EXAMPLES = "Example: `rig diagnose runs/7 --model model.yaml --held-out runs/8 --out found`"


def diagnose(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Run folders, or CSV files.")],
    model: Annotated[
        str,
        typer.Option(metavar="MODEL", help="Model file, or the name of a shipped model."),
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results.")],
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="Run or CSV file that takes no part in the search and the fit; may be repeated. "
            "Without it, blocks of RUN are held out.",
        ),
    ] = None,
    level: Annotated[
        float,
        typer.Option(
            metavar="P",
            min=1e-9,
            max=0.2,
            help="Probability that an effect is named where none is missing, and that a rival is "
            "ruled out by chance.",
        ),
    ] = 0.01,
    label: Labels = None,
    pdf: PrintToo = False,
    as_json: JsonFlag = False,
    junit: JUnitFile = None,
) -> None:
    """Identify the effects that a model lacks, correct the model, and evaluate it on other data."""
    from dart_model.spec import load_named_model
    from rig.diagnosis.files import diagnose_runs
    from rig.diagnosis.outcome import REPORT_FILE, to_json
    from rig.diagnosis.search.criteria import CRITERIA
    from rig.pages.browser_print import find_browser, print_page
    from rig.pages.identity import parse_labels
    from rig.pages.report import write_report

    if pdf:
        find_browser()  # before a search that takes minutes, not after it
    refuse_existing(junit, option=JUNIT)
    labels = parse_labels(label or [])
    spec = load_named_model(model, Path())
    if not as_json:
        print_text(
            "Searching for what the model lacks: usually half a minute to 5 minutes for each "
            "minute of recordings that it learns from. Ctrl-C ends the search; nothing is written "
            "then."
        )
    with progress_bar() as bar:
        criteria = replace(CRITERIA, level=level)
        result = diagnose_runs(runs, spec, held_out or [], out, bar, criteria)
        write_report(result, out / REPORT_FILE, labels)
        if pdf:
            print_page(out / REPORT_FILE, out / "report.pdf")
    write_junit(junit, f"rig diagnose {spec.name}", diagnosis_check(result.diagnosis, spec))
    if as_json:
        typer.echo(to_json(result.diagnosis), nl=False)
        return
    print_diagnosis(result.diagnosis, struts=len(spec.struts))
    print_text(f"Written: {out}/diagnosis.json, {out}/corrected.yaml, {out}/report.html")
    if pdf:
        print_text(f"Printed: {out}/report.pdf")
    force, floor = result.diagnosis.held_out.residual_force_rmse_n, result.diagnosis.noise_floor
    if result.diagnosis.verdict == "not_explained":
        if not force.after < _FAR_LESS * force.before:
            print_text(f"No law explains what {model} lacks: continue with {model}.")
            return
        print_text(
            f"No law explains what remains, but {out}/corrected.yaml lacks {force.after:.3g} N RMS "
            f"instead of {force.before:.3g} N."
        )
    if result.diagnosis.verdict == "partly_explained":
        others = "".join(f" --held-out {path}" for path in held_out or [])
        print_text(
            f"The corrected model still lacks {force.after:.3g} N RMS of {force.before:.3g} N "
            f"(noise alone: {floor.residual_force_rmse_n:.2g} N). Only if that is too much for "
            "your use, diagnose what it lacks: `rig diagnose "
            f"{' '.join(map(str, runs))} --model {out}/corrected.yaml{others} --out {out}_2`"
        )
    is_driven = result.diagnosis.held_out.strut_force_rmse_n is None
    if is_driven and (result.diagnosis.effects or result.diagnosis.linear):
        print_text(
            f"Next: `rig tune CONFIG --model {out}/corrected.yaml --run {_run_of(runs)} --out "
            "tuned-corrected.yaml`, as the old gains suit the old model; then `rig run "
            "tuned-corrected.yaml`"
        )


def _run_of(paths: list[Path]) -> str:
    """The first of the recordings that is a run, whose frames a tuning can follow again."""
    return next((str(path) for path in paths if path.is_dir()), "RUN")
