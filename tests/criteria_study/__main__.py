"""``python -m tests.criteria_study --out DIR``: each number that decides, halved and doubled.

A fixed set of quick cases is diagnosed with each. ``table.md`` in the folder says how many answers
are right and how many names are false, and which answers change. A quarter of an hour on two cores.
"""

import argparse
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import fields
from pathlib import Path

from rich.console import Console
from rich.markdown import Markdown
from rich.progress import Progress

from rig.diagnosis.search.criteria import CRITERIA
from tests.criteria_study.cases import CASES, Answer
from tests.criteria_study.execute import FACTORS, Task, moved, run

NAMES = tuple(field.name for field in fields(CRITERIA))


def _tasks(criteria: list[str]) -> list[Task]:
    moves = [(name, factor) for name in criteria for factor in ("half", "double")]
    return [Task(case, *move) for move in [(None, "as is"), *moves] for case in CASES]


def _run_all(tasks: list[Task], jobs: int) -> Iterator[tuple[Task, Answer]]:
    if jobs > 1:
        # One thread a diagnosis: two at a time use two cores.
        os.environ.update({f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "NUMBA")})
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = {pool.submit(run, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _said(found: Answer) -> str:
    names = ", ".join(sorted(found.families)) or "nothing"
    return f"{found.verdict}, {names}" + (", white" if found.white else "")


def _cell(found: dict[str, Answer]) -> tuple[str, str]:
    """Hit rate and number of false names of the answers to all cases."""
    hits = sum(found[case] == CASES[case].right for case in found)
    false = sum(len(found[case].families - CASES[case].right.families) for case in found)
    return f"{hits}/{len(found)}", str(false)


def table(criteria: list[str], answers: dict[Task, Answer]) -> str:
    """Hit rates, and what changes, in Markdown."""
    rows = [
        "| criterion | value | right: half | as is | double | false names: half | as is | double |",
        "|---|---|---|---|---|---|---|---|",
    ]
    changes = ["", "| criterion | value | case | answer | as is |", "|---|---|---|---|---|"]
    for name in criteria:
        cells = []
        for factor in FACTORS:
            tasks = [Task(case, None if factor == "as is" else name, factor) for case in CASES]
            cells.append(_cell({task.case: answers[task] for task in tasks}))
            for task in tasks:
                usual, here = answers[Task(task.case, None, "as is")], answers[task]
                if here != usual:
                    value = f"{moved(name, factor):g}"
                    changes.append(
                        f"| {name} | {value} | {task.case} | {_said(here)} | {_said(usual)} |"
                    )
        right, false = zip(*cells, strict=True)
        value = f"{getattr(CRITERIA, name):g}"
        rows.append("| " + " | ".join([name, value, *right, *false]) + " |")
    wrong = [
        f"{case}: {_said(there)}, right is {_said(CASES[case].right)}"
        for case in CASES
        if (there := answers[Task(case, None, "as is")]) != CASES[case].right
    ]
    found = "Wrong as it is: " + ("; ".join(wrong) or "none") + "."
    return "\n".join([*rows, *(changes if len(changes) > 3 else []), "", found, ""])


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.criteria_study",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the table")
    parser.add_argument("--jobs", type=int, default=2, help="diagnoses at a time")
    parser.add_argument("--only", help="only these criteria, with commas between")
    args = parser.parse_args()
    args.criteria = args.only.split(",") if args.only else list(NAMES)
    unknown = set(args.criteria) - set(NAMES)
    if unknown:
        parser.error(f"--only: {', '.join(sorted(unknown))}: expected some of {', '.join(NAMES)}")
    return args


def main() -> int:
    """Run the study; returns the exit code."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    tasks = _tasks(args.criteria)
    answers: dict[Task, Answer] = {}
    with Progress() as progress:
        bar = progress.add_task("diagnosing", total=len(tasks))
        for task, found in _run_all(tasks, args.jobs):
            answers[task] = found
            last = f"{task.case}, {task.criterion or 'all'} {task.factor}"
            progress.update(bar, advance=1, description=last)
    text = table(args.criteria, answers)
    (args.out / "table.md").write_text(text, encoding="utf-8")
    Console().print(Markdown(text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
