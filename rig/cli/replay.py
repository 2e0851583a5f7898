"""`rig replay`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from rig.cli.output import FAILED, console, write_summary
from rig.cli.watching import progress_line

EXAMPLES = "Example: `rig replay rig-demo/run`"


def replay_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
) -> None:
    """Compute a run again from its frames and compare it with its log, bit for bit."""
    from rig.io.run_log import changed_files
    from rig.operation.replay import replay

    with progress_line(None) as progress:
        result = replay(folder, progress=progress)
    summary: dict[str, object] = {
        "ticks": result.steps.num_rows,
        "logged_ticks": result.logged,
        "different_ticks": result.different,
        "first_different_ns": result.first_different_ns,
        "refused_frames": result.refused_frames,
    }
    table = Table("Replay", str(folder))
    for name, value in summary.items():
        table.add_row(name.replace("_", " "), "-" if value is None else str(value))
    console.print(table)
    if out is not None:
        write_summary(out, summary)
    if result.steps.num_rows == 0:
        console.print("The run holds no tick: nothing was compared.", style="red")
        raise typer.Exit(FAILED)
    missing = result.logged - result.steps.num_rows
    if missing > 0:
        console.print(f"{missing} steps have no frames and were not compared.", style="yellow")
    for name in changed_files(folder):
        console.print(f"{name} is not the one that ran: its hash differs.", style="yellow")
    if result.different:
        console.print("The replay differs from the log.", style="red")
        raise typer.Exit(FAILED)
