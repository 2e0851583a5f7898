"""`python -m tests.scoreboard`: published measured sets, our figures beside the published ones."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.progress import progress_bar
from rig.cli.terminal import JsonFlag, console, print_json, table
from tests.evidence import PAGE_HELP, command_line, write_evidence
from tests.scoreboard.run import run_scoreboard
from tests.scoreboard.table import page

TEXT = """
Published data of measured benches are diagnosed with `rig diagnose`. The nominal model is the start
model; the last column states where the parameters of this model are from. Laws and parameters are
searched for and fitted on the training data. The test data decide two things afterwards: laws
without which all data are described as well, or better, give way to fewer; and with the verdict
`not_explained`, the model with the smallest error on the test data is used, so that this error is
slightly optimistic.

Each table contains one data set, with one row per model and one column per test. The errors of the
models called `rig` were computed here; the others were published in the source in the last column.

The Silverbox is an electronic circuit that behaves as a mass on a hardening spring (Wigren,
Schoukens 2013). EMPS is an electro-mechanical positioning stage without a spring (Janot, Gautier,
Brunot 2019). Its recordings `train` and `pulses` are each used once for training and once for the
test. dynoNet is a neural network without a physical model. The table below it shows what each
recording says about the Coulomb friction, published as 20.39 N: five parameters are fitted to one
recording in free run, with the friction held at one value after another. For `train` the error is
least at 20.4 N, but only a tenth larger at 19 and 23 N. For `pulses` it is least at 22 N, and a
fifth larger at 20.39 N. Either recording is described several times better by its own parameters
than by a model that was trained on the other recording.

The two dampers were moved on a dyno (Downey et al. 2016; an MR damper at three coil currents): the
start model is the spring and the damper that come nearest to the training data, whose tolerance is
100 %.
"""


def scoreboard(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data",
            metavar="DIR",
            help="Folder with folders silverbox, emps, brfd, mr_damper, any of them.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME", help="Only this set; may be given several times."),
    ] = None,
    as_page: Annotated[bool, typer.Option("--page", help=PAGE_HELP)] = False,
    as_json: JsonFlag = False,
) -> None:
    """Diagnose published measured sets and print our figures beside the published ones."""
    with progress_bar() as bar:
        rows = run_scoreboard(data, out, bar, only or ())
    if as_page:
        title = "Measured benches"
        write_evidence("measured-benches", title, TEXT, [page(rows).strip()], command_line())
    if as_json:
        print_json([asdict(row) for row in rows])
        return
    shown = table("set", "test", "model", "figure", "source", title="Measured sets")
    for row in rows:
        figure = "-" if row.value is None else f"{row.value:.4g} {row.unit}"
        shown.add_row(row.dataset, row.test, row.model, figure, row.source)
    console.print(shown)
    console.print(f"Written: {out}/scoreboard.csv, {out}/scoreboard.md", markup=False)


if __name__ == "__main__":
    typer.run(scoreboard)
