"""`rig run`."""

import contextlib
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from can_dbc.errors import InputError
from rig.cli.progress import status_line, stoppable
from rig.cli.result_tables import print_run
from rig.cli.side_by_side import run_side_by_side
from rig.cli.terminal import FAILED, JsonFlag, print_text
from rig.files.folders import refuse_full

if TYPE_CHECKING:
    from rig.plan.plan import Plan
    from rig.run.logged_run import Ended

EXAMPLES = (
    "Examples: `rig run rig.yaml` · `rig run rig.yaml --out runs/7 --listen-only` · "
    "`rig run left.yaml right.yaml --out runs/8`, then `rig view runs/8/left runs/8/right`"
)


def run(
    configs: Annotated[
        list[Path],
        typer.Argument(
            metavar="CONFIG", help="YAML file; several run as separate bridges at once."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of the run, or of the runs; by default runs/ and the time."
        ),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL", help="Another model than the configuration's, e.g. a corrected one."
        ),
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.001,
            help="Length of the run; else the configuration's, or until Ctrl-C.",
        ),
    ] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Run although `rig check` finds an error.")
    ] = False,
    trace: Annotated[
        bool, typer.Option("--trace", help="Keep what became of late ticks, for `rig timing`.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Run the bridge on a bus; Ctrl-C ends it in order.

    Several configurations are as many bridges, a process each, each with a folder in `--out` that
    is called as its configuration; the exit code is the worst of theirs.
    """
    folder = out or Path("runs") / time.strftime("%Y-%m-%d_%H-%M-%S")
    if len(configs) > 1:
        options: list[str] = [] if model is None else ["--model", model]
        options += [] if duration_s is None else ["--duration-s", str(duration_s)]
        flags = {"--listen-only": listen_only, "--force": force, "--trace": trace}
        options += [name for name, given in flags.items() if given]
        raise typer.Exit(run_side_by_side(configs, folder, options, as_json=as_json))
    (config,) = configs
    _run_one(config, folder, model, duration_s, listen_only, force, trace, as_json)


def _run_one(
    config: Path,
    folder: Path,
    model: str | None,
    duration_s: float | None,
    listen_only: bool,
    force: bool,
    trace: bool,
    as_json: bool,
) -> None:
    from rig.plan.load import load_plan
    from rig.plan.preflight_checks import errors
    from rig.run.live import live
    from rig.run.loop import RunControl
    from rig.run.trace import Trace

    plan = load_plan(config, model=model, duration_s=duration_s)
    wrong = errors(plan)
    if wrong and not force:
        raise InputError(
            f"{config}: {wrong[0].what}: {wrong[0].text} (`rig check` shows all; --force runs it)"
        )
    refuse_full(folder)
    channels = [channel.name for channel in plan.channels]
    shown = status_line(plan.config.duration_s, channels, list(plan.config.devices))
    with stoppable() as stop, shown as watch:
        forced = [finding.as_dict() for finding in wrong]
        ended = live(
            plan,
            folder,
            RunControl(stop=stop, watch=watch, forced=forced),
            listen_only=listen_only,
            trace=Trace(plan.period_ns) if trace else None,
        )
        # Inside: a second Ctrl-C must not lose it.
        text = json.dumps(ended.summary(), indent=2) + "\n"
        with contextlib.suppress(OSError):  # a full disk, which the table below reports
            (folder / "summary.json").write_text(text, "utf-8")
    if as_json:
        typer.echo(text, nl=False)
    else:
        print_run(ended, with_timing=True)
        print_text(f"Run: {folder}")
    _refuse_bad_ends(plan, ended)
    if not as_json and listen_only:
        print_text(f"Next: `rig tune {config} --run {folder} --out tuned.yaml`")
    elif not as_json and plan.has_force:
        print_text(f"Next: `rig diagnose {folder} --model {folder}/model.yaml --out diagnosis`")


def _why(ended: "Ended") -> str:
    """Why a run is in its safe state, in brackets."""
    cause = ended.state.supervised.cause
    if cause is None:
        return ""
    value = f", {cause.quantity} {cause.value:.4g} beyond {cause.limit:.4g}" * bool(cause.quantity)
    return f" ({cause.event.value}{value}; events.jsonl has what led there)"


def _refuse_bad_ends(plan: "Plan", ended: "Ended") -> None:
    from rig.bridge.values import Mode

    stderr = Console(stderr=True)
    if ended.state.mode is Mode.WAITING:
        messages = sorted({entry.message for entry in plan.config.signals.height.values()})
        stderr.print(
            f"No valid height arrived: expected frames of {', '.join(messages)}. Is the bench "
            "sending, are channel, bit rate and DBC right, and which frames were refused?",
            style="red",
        )
        raise typer.Exit(FAILED)
    if ended.state.mode is Mode.SAFE:
        stderr.print(f"The run ended in its safe state{_why(ended)}.", style="red")
        raise typer.Exit(FAILED)
    if ended.dropped_steps:
        stderr.print(
            f"The log lacks {ended.dropped_steps} ticks ({ended.log_fault}): expected a disk with "
            "room, and fast enough.",
            style="red",
        )
        raise typer.Exit(FAILED)
