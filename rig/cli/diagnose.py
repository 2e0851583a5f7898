"""`rig diagnose`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from can_dbc.errors import InputError
from rig.cli.junit import JUNIT, write_junit
from rig.cli.progress import progress_bar
from rig.cli.result_tables import diagnosis_check, print_diagnosis
from rig.cli.terminal import JsonFlag, Labels, PrintToo, print_text, refuse_existing

if TYPE_CHECKING:
    from rig.diagnosis.outcome import Diagnosis

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
    junit: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write JUnit XML, for a CI server: one test, which fails unless the verdict "
            "is `nothing_missing`. The exit code does not depend on the verdict.",
        ),
    ] = None,
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
            "Searching for what the model lacks: usually ten seconds to three minutes for each "
            "minute of recordings that it learns from (a full car: up to ten). Ctrl-C ends the "
            "search; nothing is written then."
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
    _print_next_step(result.diagnosis, runs, model, held_out or [], out)


def _print_next_step(
    found: "Diagnosis", runs: list[Path], model: str, held_out: list[Path], out: Path
) -> None:
    """Print what to do with a corrected model, with the gains that belong to it."""
    from rig.diagnosis.outcome import CORRECTED_FILE
    from rig.pages.report.words import is_prescribed

    force, floor = found.held_out.residual_force_rmse_n, found.noise_floor
    if found.verdict == "not_explained":
        if not force.after < _FAR_LESS * force.before:
            print_text(f"No law explains what {model} lacks: continue with {model}.")
            return
        print_text(
            f"No law explains what remains, but {out}/corrected.yaml lacks {force.after:.3g} N RMS "
            f"instead of {force.before:.3g} N."
        )
    if found.verdict == "partly_explained":
        others = "".join(f" --held-out {path}" for path in held_out)
        print_text(
            f"The corrected model still lacks {force.after:.3g} N RMS of {force.before:.3g} N "
            f"(noise alone: {floor.residual_force_rmse_n:.2g} N). Only if that is too much for "
            "your use, diagnose what it lacks: `rig diagnose "
            f"{' '.join(map(str, runs))} --model {out}/corrected.yaml{others} --out {out}_2`"
        )
    if not is_prescribed(found) and (found.effects or found.linear):
        run = next((path for path in runs if path.is_dir()), None)
        if run is not None:
            print_gains(run, out / CORRECTED_FILE)
        print_text(
            f"Next: `rig tune CONFIG --model {out}/corrected.yaml --run {run or 'RUN'} --out "
            "tuned-corrected.yaml`, as the old gains suit the old model; then `rig run "
            "tuned-corrected.yaml`"
        )


def print_gains(run: Path, corrected: Path) -> None:
    """Print the gains that belong to a corrected model, at the rate and latency of a run."""
    import yaml

    from dart_model.spec import load_model
    from rig.plan.load import plan_of_run
    from rig.tuning.gains import Aim
    from rig.tuning.tune import settings_of, tune

    plan = plan_of_run(run, load_model(corrected))
    try:
        with progress_bar() as bar:
            struts = tune(plan, run, "kalman", Aim(), bar)
    except InputError as error:
        print_text(f"No gains for {corrected}: {error}", "yellow")
        return
    print_text(f"Gains for {corrected} at {1e9 / plan.period_ns:g} Hz, `observers:` of CONFIG:")
    observers = {strut.name: _rounded(settings_of(strut.tuned.observer)) for strut in struts}
    for line in yaml.safe_dump(observers, sort_keys=False).splitlines():
        print_text(f"  {line}")


def _rounded(value: object) -> object:
    """Settings with numbers of four digits."""
    if isinstance(value, dict):
        settings = cast("dict[str, object]", value)
        return {key: _rounded(item) for key, item in settings.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value
