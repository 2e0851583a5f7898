"""`rig timing`."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.output import JsonFlag, console, print_json, table, write_summary

EXAMPLES = "Example: `rig run rig.yaml --trace --out runs/7`, then `rig timing runs/7`"

_MOST_ROWS = 40
"""Gaps that are shown one by one."""


def timing(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run with --trace.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Write summary.json there.")
    ] = None,
    as_json: JsonFlag = False,
) -> None:
    """Say of each missed tick of a traced run in which part the time went, and who took it."""
    from rig.run.late_ticks import find_late_ticks
    from rig.run.replay import setup_of_run
    from rig.run.trace import read_trace

    _, ready = setup_of_run(folder)
    late = find_late_ticks(read_trace(folder), ready.config.period_ns)
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
        one_by_one = table("time / s", "missed", "part", "longer by / ms", "cause", title="Gaps")
        for item in late[:_MOST_ROWS]:
            when, longer = f"{item.t_ns * 1e-9:.3f}", f"{item.excess_ns * 1e-6:.2f}"
            one_by_one.add_row(when, str(item.missed), item.part, longer, item.cause.value)
        console.print(one_by_one)
        if len(late) > _MOST_ROWS:
            console.print(f"and {len(late) - _MOST_ROWS} more")
        gaps, missed = Counter[str](), Counter[str]()
        for item in late:
            gaps[item.cause.value] += 1
            missed[item.cause.value] += item.missed
        causes = table("cause", "gaps", "missed ticks", title="Causes")
        for cause, count in gaps.most_common():
            causes.add_row(cause, str(count), str(missed[cause]))
        console.print(causes)
