"""Bridge and bench over a virtual bus in real time: `python -m tests.realtime --out FOLDER`.

One frame in and one frame out a tick, by default at 1 kHz for five minutes, with a busy process on
every core. Prints overruns, lateness, work and the error of the estimate. Exit code 1 if the
estimate is off by more than 2 % of the peak force, or if a tick was missed under SCHED_FIFO.

With `--bare` ticks come and nothing is done in them: what this machine takes from any program, be
it a thread that holds a lock in the kernel or a host that runs other machines beside this one.
"""

import argparse
import contextlib
import multiprocessing
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.channels.channel import SignalName
from rig.pages.timing_picture import draw_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan, resolve
from rig.run.live import real_time, with_bench
from rig.run.logged_run import Ended
from rig.run.loop import RunControl, regular_ticks
from rig.run.timing import Timing
from rig.run.trace import Trace
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.soak import SETTLING, force_error_n, load_cell

ESTIMATE = SignalName(message="RIG_ESTIMATE", signal="SPRING_DAMPER_FORCE")
VALID = SignalName(message="RIG_ESTIMATE", signal="VALID")

CLASSIC_CAN_HZ = 3703
"""What 1 Mbit/s carries of one frame in and one out, with the most stuff bits."""

MOST_ERROR = 0.02

TEXT = """
Bridge and simulated bench run in one process, on a virtual bus, in real time: at least one frame in
and one frame out per tick, at {rate_hz:g} Hz for {seconds:g} s. {load} The loop ran {granted}
SCHED_FIFO.

The lateness is the time from a tick's deadline to the wake-up of the loop; the work (computing
time) is the time from the wake-up to the end of the tick. A missed tick is counted and not made up
for. The force error is the RMS difference between the estimated force and that of the simulated
bench's load cell, without the first {skipped_s:g} s, relative to the peak force. The lateness
depends on the machine as much as on the program, and differs on another machine. No CAN hardware
took part.
"""

_ROUND_NS = 20_000_000
"""In which a busy process works for its share, and then rests."""


def spin(share: float) -> None:
    """Keep a core busy, for this share of the time."""
    while True:
        until_ns = time.monotonic_ns() + round(share * _ROUND_NS)
        while time.monotonic_ns() < until_ns:
            pass
        time.sleep((1.0 - share) * _ROUND_NS * 1e-9)


@contextlib.contextmanager
def busy_cores(share: float) -> Iterator[None]:
    """A busy process on each core."""
    processes = [
        multiprocessing.Process(target=spin, args=(share,), daemon=True)
        for _ in range(os.cpu_count() or 1)
    ]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def at_rate(
    rate_hz: float, seconds: float, *, fifo: bool, folder: Path
) -> tuple[Plan, BenchConfig]:
    """The reference case with one frame in and one out a tick."""
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=seconds)
    folder.mkdir(parents=True)
    dbc = folder / "every_tick.dbc"
    # Without a cycle time a message is sent at every tick.
    text = re.sub(r'("GenMsgCycleTime" BO_ (?:256|272)) 1;', r"\1 0;", DEFAULT_DATABASE.read_text())
    dbc.write_text(text)
    realtime = ready.config.realtime.model_copy(update={} if fifo else {"fifo_priority": 0})
    config = ready.config.model_copy(
        update={
            "rate_hz": rate_hz,
            "publish": {"strut": {"force": ESTIMATE, "valid": VALID}},
            "realtime": realtime,
        }
    )
    bench = load_bench_config(CONFIGS / "reference_bench.yaml")
    measurement, auxiliary = bench.transmissions
    period_ns = config.period_ns
    every = (
        measurement.model_copy(update={"period_ns": period_ns}),
        auxiliary.model_copy(update={"period_ns": 10 * period_ns}),
    )
    ready = resolve(config, ready.source, ready.model, load_database(dbc))
    return ready, bench.model_copy(update={"transmissions": every})


def bare(ready: Plan, folder: Path, *, traced: bool) -> None:
    """Let ticks come with nothing to do, and print how well the rate was kept."""
    config, timing = ready.config, Timing.empty()
    count = round((config.duration_s or 0.0) * config.rate_hz)
    trace = Trace(config.period_ns)
    overruns: list[int] = []
    with real_time(config) as (granted, real):
        clock = trace.clock(real) if traced else real
        for tick in regular_ticks(clock, config.period_ns, count, lambda: False, timing):
            overruns.append(tick.overruns)
            if traced:
                trace.nothing_done()
    if traced:
        trace.write(folder)
    print(f"bare loop: {len(overruns)} ticks, {sum(overruns)} overruns, FIFO {granted.fifo}")
    for name, figures in timing.summary().items():
        print(f"{name}: {figures}")


def show(ended: Ended, rate_hz: float, error: float) -> None:
    """Print the figures."""
    granted = ended.granted
    fifo = granted is not None and granted.fifo
    print(f"{rate_hz:g} Hz = {rate_hz / CLASSIC_CAN_HZ:.2f} x {CLASSIC_CAN_HZ} Hz, FIFO {fifo}")
    print(f"{ended.ticks} ticks, {ended.state.counts.overruns} overruns")
    for name, figures in ended.timing.summary().items():
        print(f"{name}: {figures}")
    print(f"force error: {error:.2%} of the peak")
    print(draw_run(ended))


def write_page(ended: Ended, rate_hz: float, seconds: float, busy: float, error: float) -> None:
    """Write the guide's page."""
    granted = ended.granted is not None and ended.granted.fifo
    load = (
        f"On each core, a further process is busy for {100 * busy:g} % of the time." if busy else ""
    )
    missed = ended.state.counts.overruns
    times = {"lateness": ended.timing.lateness_us(), "work": ended.timing.work_us()}
    rows = [(name, *(f"{value:.0f}" for value in found.values())) for name, found in times.items()]
    levels = [f"{level.replace('_', '.')}, µs" for level in times["lateness"]]
    write_evidence(
        "real-time",
        "Lateness and force error in real time",
        TEXT.format(
            rate_hz=rate_hz,
            seconds=seconds,
            load=load,
            skipped_s=10 * SETTLING / rate_hz,
            granted="under" if granted else "without",
        ),
        [
            table(("time of a tick", *levels), rows),
            f"Of {ended.ticks + missed} ticks, {missed} were missed. The force error (RMS) is "
            f"{100 * error:.2f} % of the peak force.",
        ],
        command_line(),
    )


def _share(text: str) -> float:
    share = float(text)
    if not 0.0 <= share <= 1.0:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 to 1")
    return share


def main() -> int:
    """Run it, print the figures, and give the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--no-fifo", action="store_true")
    parser.add_argument(
        "--busy",
        type=_share,
        default=1.0,
        help="share of its core that each busy process takes (0: no such processes)",
    )
    parser.add_argument("--trace", action="store_true", help="keep what became of late ticks")
    parser.add_argument("--bare", action="store_true", help="ticks with nothing to do")
    add_page_option(parser)
    asked = parser.parse_args()
    if asked.page and asked.bare:
        parser.error("--page: the page is about the bridge, expected no --bare")
    ready, bench = at_rate(asked.rate_hz, asked.seconds, fifo=not asked.no_fifo, folder=asked.out)
    load = busy_cores(asked.busy) if asked.busy > 0.0 else contextlib.nullcontext()
    if asked.bare:
        with load:
            bare(ready, asked.out, traced=asked.trace)
        return 0
    with load:
        ended = with_bench(
            ready,
            bench,
            asked.out / "run",
            lockstep=False,
            trace=Trace(ready.config.period_ns) if asked.trace else None,
            control=RunControl(progress=lambda _t_ns, _mode: None),
        )
    peak_n = float(np.abs(load_cell(ended.folder, 0)[1]).max())
    error = force_error_n(ended.folder, 0) / peak_n
    show(ended, asked.rate_hz, error)
    if asked.page:
        write_page(ended, asked.rate_hz, asked.seconds, asked.busy, error)
    missed = ended.granted is not None and ended.granted.fifo and ended.state.counts.overruns > 0
    return 1 if missed or error > MOST_ERROR else 0


if __name__ == "__main__":
    sys.exit(main())
