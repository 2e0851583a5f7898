"""`rig bench`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.progress import progress_line, stoppable
from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import Bitrate, Channel, ConfigFile, Interface, console

EXAMPLES = (
    "Examples: `rig bench my_bench.yaml --interface socketcan --channel vcan0` · "
    "`rig bench my_bench.yaml --bridge rig.yaml --out runs/bench`"
)


def bench(
    config: ConfigFile,
    interface: Interface = "socketcan",
    channel: Channel = "vcan0",
    bitrate: Bitrate = 1_000_000,
    dbc: Annotated[
        Path | None, typer.Option(metavar="FILE", help="DBC; the package's own by default.")
    ] = None,
    duration_s: Annotated[
        float | None,
        typer.Option(metavar="S", min=0.001, help="Length; until Ctrl-C by default."),
    ] = None,
    bridge: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Take bus, DBC and authentication from a bridge's configuration instead.",
        ),
    ] = None,
    out: SummaryFolder = None,
) -> None:
    """Run a simulated bench on a bus, in real time."""
    from rig.bus.bus import BusConfig
    from rig.plan.load import load_plan
    from rig.run.live import run_bench
    from rig.run.loop import RunControl
    from rig.simulated_bench.config import load_bench_config

    bench_config = load_bench_config(config)
    bus, authentication = BusConfig(interface, channel, bitrate), None
    if bridge is not None:
        plan = load_plan(bridge)
        bus, dbc = plan.config.bus, plan.database.path
        authentication = plan.authentication
    with stoppable() as stop, progress_line(duration_s) as progress:
        frames = run_bench(
            bench_config,
            bus,
            dbc,
            RunControl(stop=stop, progress=progress),
            authentication=authentication,
            duration_s=duration_s,
        )
    console.print(f"Sent {frames} frames.")
    write_summary(out, {"bench": bench_config.name, "frames": frames})
