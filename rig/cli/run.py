"""`rig run`."""

import time
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.end_of_run import diagnosis_of, keep_summary, print_end
from rig.cli.progress import status_line, stoppable
from rig.cli.side_by_side import run_side_by_side
from rig.cli.terminal import JsonFlag
from rig.files.folders import refuse_full

EXAMPLES = (
    "Examples: `rig run rig.yaml` · `rig run rig.yaml --out runs/7 --listen-only` · "
    "`rig run left.yaml right.yaml --out runs/8`, then `rig view runs/8/left runs/8/right`"
)


def run(
    configs: Annotated[
        list[Path],
        typer.Argument(
            metavar="CONFIG", help="Configuration, a YAML file; several run as separate bridges."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the run, or of the runs; by default runs/DATE_TIME.",
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
            help="Duration; by default that of the configuration, or until Ctrl-C.",
        ),
    ] = None,
    listen_only: Annotated[bool, typer.Option("--listen-only", help="Send nothing.")] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Run although `rig check` finds an error.")
    ] = False,
    trace: Annotated[
        bool,
        typer.Option(
            "--trace", help="Record the duration of each part of late ticks, for `rig timing`."
        ),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Run the bridge on a bus; Ctrl-C ends it properly.

    Several configurations run as separate processes, each with a folder in `--out` that has the
    name of the configuration. The exit code is 2 if one of them ends with 2, otherwise 1 if one
    ends with 1.
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
    from rig.plan.preflight_checks import errors, refusal
    from rig.run.live import live
    from rig.run.loop import RunControl
    from rig.run.trace import Trace

    plan = load_plan(config, model=model, duration_s=duration_s)
    wrong = errors(plan)
    if wrong and not force:
        raise refusal(plan, wrong[0], "; --force runs it")
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
        keep_summary(ended, folder)
    following = diagnosis_of(plan, folder, model)
    if listen_only:
        other, name = ("", "tuned") if model is None else (f" --model {model}", "tuned-corrected")
        following = f"rig tune {config}{other} --run {folder} --out {config.with_name(name)}.yaml"
    print_end(plan, ended, folder, following, with_timing=True, as_json=as_json)
