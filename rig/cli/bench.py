"""`rig bench`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from can_dbc.errors import InputError
from rig.cli.end_of_run import diagnosis_of, keep_summary, print_end
from rig.cli.progress import progress_line, status_line, stoppable
from rig.cli.summary_file import write_summary
from rig.cli.terminal import (
    Bitrate,
    Channel,
    Interface,
    JsonFlag,
    console,
    print_json,
)
from rig.files.folders import refuse_full

if TYPE_CHECKING:
    from rig.bus.bus import BusConfig
    from rig.bus.secoc import Authentication

EXAMPLES = (
    "Examples: `rig bench my_bench.yaml --interface socketcan --channel vcan0` · "
    "`rig bench my_bench.yaml --bridge rig.yaml --out runs/bench` · without a bus: "
    "`rig bench my_bench.yaml --bridge rig.yaml --lockstep --duration-s 20 --out runs/1`"
)


BenchFile = Annotated[
    Path,
    typer.Argument(metavar="CONFIG", help="Configuration of a simulated bench, a YAML file."),
]
Dbc = Annotated[
    Path | None, typer.Option(metavar="FILE", help="DBC; the package's own by default.")
]
Duration = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=0.001,
        help="Duration; by default until Ctrl-C, or with --lockstep that of the bridge's "
        "configuration, if it states one.",
    ),
]
Bridge = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Configuration of a bridge, from which bus, DBC and authentication are taken.",
    ),
]
Lockstep = Annotated[
    bool,
    typer.Option(
        "--lockstep",
        help="Also run the bridge of --bridge, both in simulated time, as fast as the machine "
        "allows; requires --bridge and --out.",
    ),
]
OtherModel = Annotated[
    str | None,
    typer.Option(metavar="MODEL", help="With --lockstep: another model than the bridge's."),
]
Out = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder for summary.json; with --lockstep, for the bridge's run."
    ),
]


def bench(
    config: BenchFile,
    interface: Interface = "socketcan",
    channel: Channel = "vcan0",
    bitrate: Bitrate = 1_000_000,
    dbc: Dbc = None,
    duration_s: Duration = None,
    bridge: Bridge = None,
    lockstep: Lockstep = False,
    model: OtherModel = None,
    out: Out = None,
    as_json: JsonFlag = False,
) -> None:
    """Run a simulated bench on a bus in real time, or with a bridge in simulated time.

    --lockstep selects simulated time, which uses no bus.
    """
    from rig.bus.bus import BusConfig
    from rig.plan.load import load_plan

    if lockstep:
        if bridge is None or out is None:
            raise InputError("--lockstep: expected --bridge CONFIG and --out DIR with it")
        _run_with_bridge(config, bridge, model, out, duration_s, as_json=as_json)
        return
    if model is not None:
        raise InputError("--model: expected --lockstep with it")
    bus, authentication = BusConfig(interface, channel, bitrate), None
    if bridge is not None:
        plan = load_plan(bridge)
        bus, dbc, authentication = plan.config.bus, plan.database.path, plan.authentication
    summary = _run_alone(config, bus, dbc, authentication, duration_s)
    if as_json:
        print_json(summary)
    else:
        console.print(f"Sent {summary['frames']} frames.")
    write_summary(out, summary)


def _run_alone(
    config: Path,
    bus: "BusConfig",
    dbc: Path | None,
    authentication: "Authentication | None",
    duration_s: float | None,
) -> dict[str, object]:
    """Run a bench on a bus, and count its frames."""
    from rig.run.live import run_bench
    from rig.run.loop import RunControl
    from rig.simulated_bench.config import load_bench_config

    bench_config = load_bench_config(config)
    with stoppable() as stop, progress_line(duration_s) as progress:
        frames = run_bench(
            bench_config,
            bus,
            dbc,
            RunControl(stop=stop, progress=progress),
            authentication=authentication,
            duration_s=duration_s,
        )
    return {"bench": bench_config.name, "frames": frames}


def _run_with_bridge(
    config: Path,
    bridge: Path,
    model: str | None,
    out: Path,
    duration_s: float | None,
    *,
    as_json: bool,
) -> None:
    from dataclasses import replace

    from rig.plan.load import load_plan
    from rig.plan.preflight_checks import errors, refusal
    from rig.run.live import with_bench
    from rig.run.loop import RunControl
    from rig.simulated_bench.config import load_bench_config

    plan = load_plan(bridge, model=model, duration_s=duration_s)
    bench_config = load_bench_config(config)
    # No frame of a simulated bench may reach the configured bus.
    bus = replace(plan.config.bus, interface="virtual", channel="lockstep", options={})
    plan = plan.with_config(plan.config.model_copy(update={"bus": bus}))
    wrong = errors(plan)
    if wrong:
        raise refusal(plan, wrong[0])
    refuse_full(out)
    with stoppable() as stop, status_line(plan.config.duration_s) as watch:
        ended = with_bench(
            plan, bench_config, out, RunControl(stop=stop, watch=watch), lockstep=True
        )
        keep_summary(ended, out)
    print_end(plan, ended, out, diagnosis_of(plan, out, model), with_timing=False, as_json=as_json)
