"""`rig replay`."""

import typer

from rig.cli.progress import progress_line
from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import FAILED, JsonFlag, RunFolder, console, print_json, print_table

EXAMPLES = "Example: `rig replay rig-demo/run`"


def replay_command(
    folder: RunFolder,
    out: SummaryFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """Compute a run again from its frames and compare the result with its log, bit for bit."""
    from rig.log.checksums import refuse_damage
    from rig.log.reader import find_changed_files
    from rig.run.replay import replay

    with progress_line(None) as progress:
        result = replay(folder, progress=progress)
    summary: dict[str, object] = {
        "ticks": result.steps.num_rows,
        "logged_ticks": result.logged,
        "different_ticks": result.different,
        "first_different_ns": result.first_different_ns,
        "refused_frames": result.refused_frames,
    }
    missing = result.logged - result.steps.num_rows
    changed = find_changed_files(folder)
    write_summary(out, summary)
    if as_json:
        print_json({**summary, "changed_files": changed})
    else:
        rows = [
            (name.replace("_", " "), "-" if value is None else str(value))
            for name, value in summary.items()
        ]
        print_table(("Replay", str(folder)), rows)
        if result.steps.num_rows == 0:
            console.print("The run holds no tick: nothing was compared.", style="red")
        elif missing > 0:
            console.print(f"{missing} steps have no frames and were not compared.", style="yellow")
        for name in changed:
            console.print(f"{name} is not the one that ran: its hash differs.", style="yellow")
        if result.different:
            console.print("The replay differs from the log.", style="red")
    refuse_damage(folder, result.damage)
    if result.different or changed or result.steps.num_rows == 0:
        raise typer.Exit(FAILED)
