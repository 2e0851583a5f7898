"""``python -m tests.diagnosis_benchmark``: the full benchmark, one command.

Results are kept in ``--out``, so an interrupted run goes on where it stopped; after a change of the
program, give a new folder. The folder then holds ``summary.json``, ``table.md`` and ``cases.csv``.
``--one-of 20 --bounds`` is a quick look. ``--write KIND SEED`` only writes one case's files.
"""

import argparse
import multiprocessing
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tests.diagnosis_benchmark.bounds import violations
from tests.diagnosis_benchmark.execute import crashed, execute
from tests.diagnosis_benchmark.judge import Result
from tests.diagnosis_benchmark.plan import GROUPS, Counts, Slot, part_of, slots
from tests.diagnosis_benchmark.summary import print_tables, summarise, write_page, write_tables
from tests.evidence import add_page_option
from tests.truth.cases import make_case
from tests.truth.files import write_case


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.diagnosis_benchmark",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, group in GROUPS.items():
        option = f"--{name.replace('_', '-')}"
        says = f"{group.says} ({group.cases})"
        parser.add_argument(option, type=int, default=group.cases, metavar="N", help=says)
    parser.add_argument(
        "--one-of", type=int, default=1, metavar="N", help="one case of N of each group"
    )
    parser.add_argument("--groups", help="only these, with commas between")
    parser.add_argument("--bounds", action="store_true", help="exit with 1 where one is violated")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other cases")
    parser.add_argument("--out", type=Path, required=True, help="folder for results and tables")
    parser.add_argument("--limit-s", type=float, default=600.0, help="longest time for a case")
    parser.add_argument("--write", nargs=2, metavar=("KIND", "SEED"), help="only write one case")
    add_page_option(parser)
    args = parser.parse_args()
    unknown = set(_chosen(args)) - set(GROUPS)
    if unknown:
        parser.error(
            f"--groups: {', '.join(sorted(unknown))}: expected some of {', '.join(GROUPS)}"
        )
    return args


def _chosen(args: argparse.Namespace) -> list[str]:
    return args.groups.split(",") if args.groups else list(GROUPS)


def _counts(args: argparse.Namespace) -> Counts:
    counts = {group: getattr(args, group) for group in _chosen(args)}
    return part_of(counts, args.one_of)


def _run_all(todo: list[Slot], out: Path, jobs: int, limit_s: float) -> Iterator[Result]:
    if jobs > 1:
        # One thread a case: two cases at a time use two cores.
        os.environ.update({f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "NUMBA")})
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, mp_context=context) as pool:
        futures = {pool.submit(execute, slot, out, limit_s): slot for slot in todo}
        for future in as_completed(futures):
            error = future.exception()
            yield crashed(futures[future], error) if error else future.result()


def main() -> int:
    """Run the benchmark, or write one case; returns the exit code."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.write:
        kind, seed = args.write
        write_case(make_case(int(seed), kind), args.out)
        return 0
    todo = slots(_counts(args), args.seed)
    results = []
    with Progress() as progress:
        bar = progress.add_task("diagnosing", total=len(todo))
        for result in _run_all(todo, args.out, args.jobs, args.limit_s):
            results.append(result)
            wrong = sum(not r.right for r in results)
            progress.update(bar, advance=1, description=f"{wrong} wrong, last {result.slot}")
    results.sort(key=lambda result: result.slot)
    summary = summarise(results)
    write_tables(results, summary, args.out)
    console = Console(width=200)
    print_tables(summary, console)
    if args.page:
        write_page(summary)
    violated = violations(summary)
    for line in violated:
        console.print(f"bound violated: {line}", markup=False)
    return 1 if args.bounds and violated else 0


if __name__ == "__main__":
    sys.exit(main())
