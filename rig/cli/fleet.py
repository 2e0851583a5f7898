"""`rig fleet`: many runs at once, a store of their results, and reports over it."""

import contextlib
import csv
import sys
import time
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from can_dbc.errors import InputError, expected_name
from rig.cli.plain_help import PlainCommand, PlainGroup
from rig.cli.terminal import (
    FAILED,
    OK,
    JsonFlag,
    print_json,
    print_table,
    print_text,
    refuse_existing,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    from rig.fleet.campaign import CampaignProgress
    from rig.fleet.overview import Overview

RUN = "run"


class _OrRun(PlainGroup):
    """`rig fleet SOURCE...` is `rig fleet run SOURCE...`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] != "--help":
            if get_close_matches(args[0], self.commands) and not Path(args[0]).exists():
                raise InputError(f"rig fleet {args[0]}: {expected_name(args[0], self.commands)}")
            args = [RUN, *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_OrRun,
    help="Diagnose many runs of many dampers, store the results, and report on them. "
    "`rig fleet SOURCE...` is `rig fleet run SOURCE...`.",
    no_args_is_help=True,
)

RUN_EXAMPLES = (
    "Examples: `rig fleet run runs --model damper.yaml --out store` · "
    "`rig fleet run week_30 --path '{bench}/{date}/{damper}' --model damper.yaml --out store` · "
    "`rig fleet run s3://lab/runs --model damper.yaml --out store --dask tcp://head:8786` · "
    "`rig fleet run runs --model damper.yaml --out store --shard $SLURM_ARRAY_TASK_ID/64`"
)
QUERY_EXAMPLES = (
    'Examples: `rig fleet query store "SELECT bench, verdict, count(*) FROM runs GROUP BY ALL"` · '
    "`rig fleet query store \"SELECT date, value, low, high FROM effects WHERE damper = 'A17' "
    "AND parameter = 'coulomb_force_n' ORDER BY date\" --csv`"
)
REPORT_EXAMPLES = "Examples: `rig fleet report store` · `rig fleet report store --out fleet.html`"

Store = Annotated[Path, typer.Argument(metavar="STORE", help="Store that `rig fleet run` wrote.")]
PathPattern = Annotated[
    str | None,
    typer.Option(
        metavar="PATTERN",
        help="Path of a run below its SOURCE, with {bench}, {damper}, {date} and *. Without it, "
        "the folder above the run is the bench, and the path is searched for a date.",
    ),
]


@app.command(RUN, epilog=RUN_EXAMPLES, cls=PlainCommand)
def run_command(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE",
            help="Run folders, CSV files, or folders of them; also as URLs that fsspec supports.",
        ),
    ],
    model: Annotated[
        str, typer.Option(metavar="MODEL", help="Model file, or the name of a shipped model.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="STORE", help="Store: a new folder, or an existing store to continue."
        ),
    ],
    path: PathPattern = None,
    jobs: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Number of processes; by default one per core."),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Address of the scheduler of a running Dask cluster."),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="I/N", help="Compute only the I-th of N parts; I begins at 1."),
    ] = None,
    again: Annotated[
        bool, typer.Option("--again", help="Also repeat runs that failed before.")
    ] = False,
    as_json: JsonFlag = False,
) -> int:
    """Diagnose many runs, each by itself, and keep the results in a store of Parquet files.

    Runs whose results are in the store are not computed again, so that the same command continues
    after an interruption. A run that fails gets a row with its error; the exit code is then 1.
    `rig fleet SOURCE...` is short for `rig fleet run SOURCE...`.
    """
    from dart_model.spec import model_file
    from rig.fleet.campaign import load_fleet_model, run_campaign
    from rig.fleet.executors import dask as dask_at
    from rig.fleet.executors import processes
    from rig.fleet.sources import find_sources, parse_shard, select_shard
    from rig.fleet.store import refuse_other

    if jobs is not None and dask is not None:
        raise InputError("--jobs and --dask: expected one of them")
    part = None if shard is None else parse_shard(shard)
    nominal = load_fleet_model(model_file(model, Path()))  # refused now, not by every worker
    refuse_other(out)
    runs = find_sources(sources, path)
    if part is not None:
        runs = select_shard(runs, *part)
    computing = contextlib.nullcontext(processes(jobs)) if dask is None else dask_at(dask)
    with computing as engine:
        if not as_json:
            print_text(f"{len(runs)} runs, {engine.words}")
        with _progress() as show:
            end = run_campaign(
                runs, nominal, out, engine.make, engine.window, again=again, progress=show
            )
    if as_json:
        print_json(end._asdict())
    else:
        print_text(end.words)
        if end.failed:
            sql = "SELECT source, error FROM runs WHERE error <> ''"
            print_text(f'Which, and why: `rig fleet query {out} "{sql}"`')
        print_text(f"Store: {out}")
    return FAILED if end.failed else OK


@contextlib.contextmanager
def _progress() -> "Generator[Callable[[CampaignProgress], None]]":
    """A bar, or a line every ten seconds where there is no terminal."""
    from rich.console import Console

    shown = Console(stderr=True)
    if shown.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
        with Progress(*columns, console=shown, transient=True) as bars:
            bar = bars.add_task("runs")
            yield lambda now: bars.update(
                bar,
                total=now.todo,
                completed=now.done,
                description=f"{now.done}, {now.failed} failed",
            )
        return
    due_s = time.monotonic() + 10.0

    def line(now: "CampaignProgress") -> None:
        nonlocal due_s
        if time.monotonic() >= due_s:
            due_s = time.monotonic() + 10.0
            sys.stderr.write(f"{now.done} of {now.todo}, {now.failed} failed\n")

    yield line


@app.command("query", epilog=QUERY_EXAMPLES, cls=PlainCommand)
def query_command(
    store: Store,
    sql: Annotated[
        str,
        typer.Argument(
            metavar="SQL", help="SELECT statement over the views runs, effects and values."
        ),
    ],
    as_csv: Annotated[bool, typer.Option("--csv", help="Print the result as CSV.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Query a store in SQL (DuckDB): one SELECT statement, which opens no other file.

    `runs` has one row per run. `values` has one row per number, with the column `kind`: `model`
    (a parameter of the model), `found` (a parameter of an effect that the model lacks, or its
    `force_rms_n`) or `figure` (a figure of `rig characterise`). `effects` is `values` without the
    figures.
    """
    from rig.fleet.store import query

    if as_csv and as_json:
        raise InputError("--csv and --json: expected one of them")
    names, rows = query(store, sql)
    if as_json:
        print_json([dict(zip(names, map(_plain, row), strict=True)) for row in rows])
    elif as_csv:
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(rows)
    else:
        texts = [["" if item is None else escape(str(item)) for item in row] for row in rows]
        print_table(names, texts)


def _plain(value: object) -> object:
    return value if isinstance(value, int | float | str | bool | None) else str(value)


@app.command("report", epilog=REPORT_EXAMPLES, cls=PlainCommand)
def report_command(
    store: Store,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New HTML file for the report.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Summarise a store: verdicts, changes, wear, outliers, steps common to a bench's dampers."""
    from rig.fleet.overview import read_overview

    refuse_existing(out)
    whole = read_overview(store)
    if as_json:
        print_json(whole.as_dict())
    else:
        _print(whole)
    if out is not None:
        from rig.pages.fleet_page import write_fleet_page

        write_fleet_page(whole, out)
        if not as_json:
            print_text(f"Written: {out}")


def _print(whole: "Overview") -> None:
    from rig.fleet.sentences import alarm_sentences, power_rows

    print_text(whole.words)
    rows = [
        (escape(bench), ", ".join(f"{count} {verdict}" for verdict, count in counts.items()))
        for bench, counts in whole.verdicts.items()
    ]
    print_table(("bench", "verdicts"), rows)
    for line in alarm_sentences(whole) or ["Nothing changed, drifts or stands out."]:
        print_text(f"- {line}")
    powers = [(escape(row.quantity), row.runs, row.drift, row.step) for row in power_rows(whole)]
    if powers:
        heads = ("cannot be seen", "runs of a damper", "drift", "step")
        print_table(heads, powers)
    for error, count in list(whole.failed.items())[:5]:
        print_text(f"failed, {count}: {error}", style="red")
