"""`rig evaluate`."""

from collections.abc import Mapping, Sequence
from functools import cache
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.terminal import JsonFlag, print_json, print_table, print_text

if TYPE_CHECKING:
    from rig.diagnosis.problem.problem import RunEvaluation
    from rig.recordings.gaps import Gaps

EXAMPLES = (
    "Examples: `rig evaluate runs/9 --model model.yaml` · before and after a correction: "
    "`rig evaluate runs/9 --model model.yaml --model found/corrected.yaml`"
)


def evaluate_command(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN", help="Folders of runs, or CSV files.")
    ],
    model: Annotated[
        list[str],
        typer.Option(
            metavar="MODEL", help="Model file, or the name of a shipped one; once for each model."
        ),
    ],
    as_json: JsonFlag = False,
) -> None:
    """Evaluate models on runs: errors of their free-run simulation, with the noise floor.

    No observer is used, and only the initial states are fitted. If the motion is prescribed, the
    force of the model along the measured motion is compared with the load cell.

    Each model has its own noise floor, because the noise of the applied force moves each model
    differently. That of the model with the smallest error is the one to compare with.
    """
    from dart_model.spec import load_named_model
    from rig.diagnosis.evaluate import evaluate_model
    from rig.recordings.read import read_recording
    from rig.recordings.recording import RecordingError

    read_once = cache(read_recording)
    specs = [load_named_model(name, Path()) for name in model]
    rows: list[tuple[str, RunEvaluation]] = []
    gaps: dict[str, Gaps] = {}
    failed: list[str] = []
    for name, spec in zip(model, specs, strict=True):
        struts = tuple(strut.name for strut in spec.struts)
        recordings = [read_once(path, struts) for path in runs]
        gaps = {item.name: item.gaps for item in recordings if item.gaps is not None}
        for recording in recordings:
            try:
                rows += [(name, it) for it in evaluate_model(spec, [recording])]
            except RecordingError as error:  # the others are evaluated all the same
                failed.append(f"{name}: {error}")
    if as_json:
        evaluations = [_as_dict(*row, gaps) for row in rows]
        print_json({"schema": 1, "evaluations": evaluations, "failed": failed})
    else:
        _print(rows, gaps)
    if failed:
        raise InputError("; ".join(failed))


def _print(rows: "Sequence[tuple[str, RunEvaluation]]", gaps: "Mapping[str, Gaps]") -> None:
    for run in dict.fromkeys(row.figures.run for _, row in rows):
        _print_run(run, [row for row in rows if row[1].figures.run == run])
        if run in gaps:
            print_text(gaps[run].report(run), "yellow")


def _print_run(name: str, rows: "list[tuple[str, RunEvaluation]]") -> None:
    from rig.pages.number_formats import quantity

    floor = "noise floor"
    is_prescribed = any(isnan(row.figures.height_rmse_m.after) for _, row in rows)
    if is_prescribed:
        heads = ("RMS error of the model", "strut force against the load cell", floor)
    else:
        heads = ("RMS error of the model", "height", floor, "residual force", floor)
    cells: list[tuple[str, ...]] = []
    for model, row in rows:
        least_n = quantity(row.floor.residual_force_rmse_n, "N")
        if is_prescribed:
            cell = row.figures.strut_force_rmse_n or row.figures.residual_force_rmse_n
            cells.append((model, quantity(cell.after, "N"), least_n))
            continue
        heights = row.figures.height_rmse_m.after, row.floor.height_rmse_m
        force = quantity(row.figures.residual_force_rmse_n.after, "N")
        cells.append((model, *(quantity(it, "m") for it in heights), force, least_n))
    kind = "Along the measured motion" if is_prescribed else "Free-run simulation"
    print_table(heads, cells, f"{kind} of {name}")


def _as_dict(
    model: str, evaluation: "RunEvaluation", gaps: "Mapping[str, Gaps]"
) -> dict[str, object]:
    figures, floor = evaluation.figures, evaluation.floor
    cell = figures.strut_force_rmse_n
    return {
        "run": figures.run,
        "model": model,
        "height_rmse_m": figures.height_rmse_m.after,
        "residual_force_rmse_n": figures.residual_force_rmse_n.after,
        "strut_force_rmse_n": None if cell is None else cell.after,
        "applied_force_gaps": gaps[figures.run].as_dict() if figures.run in gaps else None,
        "noise_floor": {
            "height_rmse_m": floor.height_rmse_m,
            "residual_force_rmse_n": floor.residual_force_rmse_n,
        },
    }
