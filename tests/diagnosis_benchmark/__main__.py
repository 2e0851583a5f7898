"""``python -m tests.diagnosis_benchmark``: the full benchmark, one command.

Results are kept in ``--out``, so an interrupted run goes on where it stopped; after a change of the
program, give a new folder. ``--write KIND SEED`` only writes one case's files.
"""

import argparse
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from tests.diagnosis_benchmark.execute import crashed, execute
from tests.diagnosis_benchmark.judge import Result
from tests.diagnosis_benchmark.plan import Counts, Slot, slots
from tests.diagnosis_benchmark.summary import print_tables, summarise, write_tables
from tests.truth.cases import make_case
from tests.truth.files import write_case


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tests.diagnosis_benchmark",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--cases", type=int, default=200, help="single effects above the floor")
    parser.add_argument("--pairs", type=int, default=50, help="two effects")
    parser.add_argument("--triples", type=int, default=0, help="three effects")
    parser.add_argument("--complete", type=int, default=50, help="nothing planted")
    parser.add_argument("--outside", type=int, default=30, help="forces no catalogue holds")
    parser.add_argument(
        "--foreign", type=int, default=32, help="formulas kept back from catalogues"
    )
    parser.add_argument("--faint", type=int, default=0, help="single effects below the floor's 5x")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other cases")
    parser.add_argument("--out", type=Path, required=True, help="folder for results and tables")
    parser.add_argument("--limit-s", type=float, default=600.0, help="longest time for a case")
    parser.add_argument("--write", nargs=2, metavar=("KIND", "SEED"), help="only write one case")
    return parser.parse_args()


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


def main() -> None:
    """Run the benchmark, or write one case."""
    args = _arguments()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.write:
        kind, seed = args.write
        write_case(make_case(int(seed), kind), args.out)
        return
    counts = Counts(
        args.cases, args.pairs, args.triples, args.complete, args.outside, args.foreign, args.faint
    )
    todo = slots(counts, args.seed)
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
    print_tables(summary, Console(width=180))


if __name__ == "__main__":
    main()
