"""`python -m tests.fleet.study --runs 10000`: one fleet through processes and through Dask.

A worker of the cluster is killed on the way. Printed are what either store holds, the throughput
per core beside plain loops over single diagnoses, and the time that distributing takes a run.
"""

import argparse
import multiprocessing
import os
import resource
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

import psutil

from rig.fleet import store
from rig.fleet.campaign import CampaignProgress, FleetModel, load_fleet_model, run_campaign
from rig.fleet.executors import Engine, dask, processes
from rig.fleet.one_run import evaluate_run
from rig.fleet.sources import RunSource, find_sources
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.fleet.cluster import cluster
from tests.fleet.population import RATE_HZ, SAMPLES, Piece, write_fleet, write_model

CORES, WORKERS, SINGLE = 2, 4, 200
BENCHES, DAMPERS = 4, 40
PATTERN = "{bench}/{date}/{damper}"
TEXT = """
A fleet of {RUNS} simulated dyno runs ({DAMPERS} dampers on {BENCHES} benches, {seconds:g} s at
{RATE_HZ:g} Hz per run) is diagnosed in two campaigns on one machine with {CORES} cores: with a Dask
cluster of {WORKERS} workers, one of which is killed after a third of the runs, and with {CORES}
processes. The throughput is compared with that of plain loops, which diagnose one run after the
other: {CORES} such loops run simultaneously, one per core; together they diagnose {singles} runs,
each once, after a first diagnosis in each loop that is not timed.

The cost of distribution is the CPU time of the campaign's process, which distributes the runs
and writes the store, plus that of Dask's scheduler. The overhead inside the workers is not
counted. The runs are short: with longer runs, distribution costs a smaller share. The cost per
run contains a share of the fixed cost of the campaign, which is larger with few runs. The cost
for a million runs is a million times this cost per run; this is an upper estimate if the
further cost of each run does not grow with the number of runs, which was not measured.

The loops and the two campaigns ran one after the other, each under a different load of the machine.
The throughput depends on this load. A ratio may therefore exceed 1, and the ratios neither measure
the cost of distribution nor compare Dask with processes; the CPU times do.
"""


def scattered(_damper, _week, rng):
    """A damper as production makes it."""
    return Piece(
        friction=1.0 + 0.05 * rng.standard_normal(), damping=1.0 + 0.03 * rng.standard_normal()
    )


def plain_loop(sources: Sequence[RunSource], model: FleetModel) -> float:
    """Diagnoses a second, one after another, after the first one, which imports and compiles."""
    evaluate_run(sources[0], model)
    begun = time.perf_counter()
    for source in sources:
        evaluate_run(source, model)
    return len(sources) / (time.perf_counter() - begun)


def single_rate(sources: Sequence[RunSource], model: FleetModel) -> float:
    """Diagnoses a second and core of plain loops, one on each core at once.

    A loop on one core while the other one rests is faster on a machine that is shared.
    """
    parts = [sources[k : CORES * SINGLE : CORES] for k in range(CORES)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(CORES, mp_context=context) as pool:
        return sum(pool.map(plain_loop, parts, [model] * CORES)) / CORES


def through(
    engine: Engine,
    sources: Sequence[RunSource],
    model: FleetModel,
    out: Path,
    kill: psutil.Process | None,
) -> tuple[CampaignProgress, float]:
    """A campaign, and the CPU time of this process a run."""

    def progress(now: CampaignProgress) -> None:
        if kill is not None and now.done == len(sources) // 3 and kill.is_running():
            kill.kill()

    before = resource.getrusage(resource.RUSAGE_SELF)
    end = run_campaign(sources, model, out, engine.make, engine.window, progress=progress)
    after = resource.getrusage(resource.RUSAGE_SELF)
    own_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return end, own_s / max(end.done, 1)


def content(out: Path) -> list[str]:
    """Everything of a store but times and parts, by key; as text, since NaN is not itself."""
    names = "key, source, bench, date, damper, verdict, error, before, after, floor"
    runs = store.query(out, f"SELECT {names} FROM runs ORDER BY key")[1]
    values = 'SELECT * EXCLUDE (part) FROM "values" ORDER BY ALL'
    return list(map(repr, [*runs, *store.query(out, values)[1]]))


class Measured(NamedTuple):
    """One campaign.

    Attributes:
        name: Of the engine.
        done: Runs.
        failed: Runs that failed.
        elapsed_s: Its duration.
        rate: Runs a second and core.
        share: That rate over the one of plain loops.
        own_ms: CPU time of this process a run.
        scheduler_ms: CPU time of the scheduler a run.
    """

    name: str
    done: int
    failed: int
    elapsed_s: float
    rate: float
    share: float
    own_ms: float
    scheduler_ms: float

    @property
    def hours_of_a_million(self) -> float:
        """CPU time of distributing a million runs."""
        return (self.own_ms + self.scheduler_ms) * 1e6 / 3.6e6


def write_page(campaigns: Sequence[Measured], alone: float, singles: int, sentences: str) -> None:
    """Write the guide's page."""
    heads = ("executor", "runs", "failed", "duration, s", "runs per second and core")
    costs = (
        "relative to plain loops",
        "CPU time in the campaign's process, ms per run",
        "CPU time in the scheduler, ms per run",
        "CPU time to distribute a million runs (without the diagnoses), h",
    )
    rows = [
        (
            item.name,
            item.done,
            item.failed,
            f"{item.elapsed_s:.0f}",
            f"{item.rate:.2f}",
            f"{item.share:.2f}",
            f"{item.own_ms:.2f}",
            f"{item.scheduler_ms:.2f}",
            f"{item.hours_of_a_million:.2f}",
        )
        for item in campaigns
    ]
    numbers = {"CORES": CORES, "WORKERS": WORKERS, "DAMPERS": DAMPERS, "BENCHES": BENCHES}
    numbers |= {"RUNS": campaigns[0].done, "singles": singles}
    text = TEXT.format(**numbers, RATE_HZ=RATE_HZ, seconds=SAMPLES / RATE_HZ)
    loops = f"Plain loops: {alone:.2f} diagnoses per second and core."
    found = table((*heads, *costs), rows)
    title = "What it costs to distribute the diagnosis of a fleet"
    write_evidence("fleet", title, text, [loops, found, sentences], command_line())


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    add_page_option(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        weeks = -(-given.runs // DAMPERS)
        write_fleet(folder / "runs", DAMPERS, weeks, scattered, BENCHES, given.seed)
        model = load_fleet_model(write_model(folder))
        sources = find_sources([str(folder / "runs")], PATTERN)[: given.runs]
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        alone = single_rate(sources, model)
        print(f"{len(sources)} runs; plain loops: {alone:.2f} a second and core", flush=True)
        stores: list[Path] = []
        with cluster(folder, WORKERS) as there:
            scheduler = psutil.Process(there.scheduler.pid)
            victim = psutil.Process(there.workers[1].pid)
            before = sum(scheduler.cpu_times()[:2])
            out = folder / "by_dask"
            with dask(there.address) as engine:
                end, own_s = through(engine, sources, model, out, victim)
            spent_s = (sum(scheduler.cpu_times()[:2]) - before) / end.done
            campaigns = [report("Dask", end, alone, own_s, spent_s)]
            is_gone = not victim.is_running() or victim.status() == psutil.STATUS_ZOMBIE
            print(f"  the killed worker is gone: {is_gone}", flush=True)
            stores.append(out)
        out = folder / "by_processes"
        end, own_s = through(processes(CORES), sources, model, out, None)
        campaigns.append(report("processes", end, alone, own_s, 0.0))
        stores.append(out)
        is_same = content(stores[0]) == content(stores[1])
        ((runs, keys),) = store.query(out, "SELECT count(*), count(DISTINCT key) FROM runs")[1]
        print(f"both stores hold the same: {is_same}; {runs} runs, {keys} different")
        if given.page:
            counts = f"Each store contains each of the {runs} runs exactly once."
            if not is_same or not runs == keys == len(sources):
                counts = (
                    f"The store of the processes contains {runs} runs with {keys} different keys, "
                    f"expected {len(sources)} of each."
                )
            sentences = (
                f"One worker {'was' if is_gone else 'was not'} killed during the Dask campaign. "
                f"The two stores contain {'the same' if is_same else 'different'} runs and values. "
                f"{counts}"
            )
            write_page(campaigns, alone, min(len(sources), CORES * SINGLE), sentences)


def report(
    name: str, end: CampaignProgress, alone: float, own_s: float, scheduler_s: float
) -> Measured:
    """A line of the table, which is also printed."""
    rate = end.done / end.elapsed_s / CORES
    costs_ms = 1e3 * own_s, 1e3 * scheduler_s
    found = Measured(name, end.done, end.failed, end.elapsed_s, rate, rate / alone, *costs_ms)
    print(
        f"{name}: {end.done} runs, {end.failed} failed, {end.elapsed_s:.0f} s, {rate:.2f} a second "
        f"and core ({found.share:.3f} of plain loops); distributing: {found.own_ms:.2f} ms a run "
        f"here and {found.scheduler_ms:.2f} ms in the scheduler, {found.hours_of_a_million:.2f} h "
        "of a million runs",
        flush=True,
    )
    return found


if __name__ == "__main__":
    main()
