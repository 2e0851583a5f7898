"""`rig timing`."""

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.summary_file import write_summary
from rig.cli.terminal import JsonFlag, console, print_json, table

EXAMPLES = "Example: `rig run rig.yaml --trace --out runs/7`, then `rig timing runs/7`"

_MOST_ROWS = 40
"""Gaps that are listed one by one."""


def timing(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run with --trace.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """List the missed ticks of a traced run: the part that took longer, and the cause."""
    from rig.plan.load import plan_of_run
    from rig.run.late_ticks import by_cause, find_late_ticks
    from rig.run.trace import read_trace

    plan = plan_of_run(folder)
    late = find_late_ticks(read_trace(folder), plan.period_ns)
    summary: dict[str, object] = {
        "late": [{**item._asdict(), "cause": item.cause.name.lower()} for item in late]
    }
    if out is not None:
        write_summary(out, summary)
    if as_json:
        print_json(summary)
    elif not late:
        console.print("No tick was missed.")
    else:
        rows = table("time / s", "missed", "part", "longer by / ms", "cause", title="Gaps")
        for item in late[:_MOST_ROWS]:
            when, longer = f"{item.t_ns * 1e-9:.3f}", f"{item.excess_ns * 1e-6:.2f}"
            rows.add_row(when, str(item.missed), item.part, longer, item.cause.value)
        console.print(rows)
        if len(late) > _MOST_ROWS:
            console.print(f"and {len(late) - _MOST_ROWS} more")
        causes = table("cause", "gaps", "missed ticks", title="Causes")
        for cause, gaps, missed in by_cause(late):
            causes.add_row(cause.value, str(gaps), str(missed))
        console.print(causes)
