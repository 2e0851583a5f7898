"""`rig timing`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.summary_file import SummaryFolder, write_summary
from rig.cli.terminal import JsonFlag, console, print_json, print_table

EXAMPLES = "Example: `rig run rig.yaml --trace --out runs/7`, then `rig timing runs/7`"

_MOST_ROWS = 40
"""Gaps that are listed one by one."""


def timing(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run that was recorded with --trace.")
    ],
    out: SummaryFolder = None,
    as_json: JsonFlag = False,
) -> None:
    """List the missed ticks of a traced run, with the part that took too long, and the cause."""
    from rig.plan.load import plan_of_run
    from rig.run.late_ticks import by_cause, find_late_ticks
    from rig.run.trace import read_trace

    plan = plan_of_run(folder)
    late = find_late_ticks(read_trace(folder), plan.period_ns)
    summary: dict[str, object] = {
        "late": [{**item._asdict(), "cause": item.cause.name.lower()} for item in late]
    }
    write_summary(out, summary)
    if as_json:
        print_json(summary)
    elif not late:
        console.print("No tick was missed.")
    else:
        heads = ("time / s", "missed", "part", "longer by / ms", "cause")
        gaps = [
            (
                f"{item.t_ns * 1e-9:.3f}",
                str(item.missed),
                item.part,
                f"{item.excess_ns * 1e-6:.2f}",
                item.cause.value,
            )
            for item in late[:_MOST_ROWS]
        ]
        print_table(heads, gaps, "Gaps")
        if len(late) > _MOST_ROWS:
            console.print(f"and {len(late) - _MOST_ROWS} more")
        causes = [(cause.value, str(count), str(ticks)) for cause, count, ticks in by_cause(late)]
        print_table(("cause", "gaps", "missed ticks"), causes, "Causes")
