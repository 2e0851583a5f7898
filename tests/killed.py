"""What a SIGKILL takes: `python -m tests.killed --out DIR`.

The reference case runs in real time in a process of its own, which counts what was received in
memory that outlives it; it is killed at random moments, and what stands on the disk is counted.
"""

import argparse
import mmap
import multiprocessing
import os
import signal
import struct
import time
from pathlib import Path

import numpy as np

from rig.log.reader import read_run
from rig.log.writer import RunWriter
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from tests.evidence import add_page_option, command_line, table, write_evidence

_COUNTS = struct.Struct("<qq")
"""Frames received, and ticks."""


TEXT = """
{kills} runs of the reference case are killed (SIGKILL), each at a random moment, 0.3 to 4 s after
its first tick. They run in real time at 1 kHz, with the simulated bench on a virtual bus in the
same process. The process counts received frames and ticks before it logs them, in shared memory
that outlives it. The received frames and the logged ticks (rows of `steps.arrow`) on the disk are
then counted, and the run is replayed from its frames. The logged ticks are compared with the
replay: a tick counts as different if its row and the replayed row do not agree bit for bit. Ticks
that the log lost cannot be compared; the replay computes them from the frames on the disk, at the
times of the configured rate. A loss of power is not tested.
"""


def run(folder: Path, counts: mmap.mmap) -> None:
    """Run the reference case until killed; what was received is counted before it is logged."""
    add, total = RunWriter.add, [0, 0]

    def counted(self, received, sent, step):
        total[0] += len(received)
        total[1] += 1
        counts[: _COUNTS.size] = _COUNTS.pack(*total)
        add(self, received, sent, step)

    RunWriter.add = counted
    with_bench(
        load_plan(CONFIGS / "reference.yaml", duration_s=60.0),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        folder,
        lockstep=False,
    )


def main() -> None:
    """Kill ten runs, and print what each lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    add_page_option(parser)
    asked = parser.parse_args()
    rng = np.random.default_rng(asked.seed)
    rows: list[tuple[int, ...]] = []
    for number in range(asked.kills):
        counts = mmap.mmap(-1, _COUNTS.size)
        folder = asked.out / f"run{number}"
        process = multiprocessing.get_context("fork").Process(target=run, args=(folder, counts))
        process.start()
        while _COUNTS.unpack(counts[: _COUNTS.size])[1] == 0:
            time.sleep(0.01)
        time.sleep(float(rng.uniform(0.3, 4.0)))
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        received, ticks = _COUNTS.unpack(counts[: _COUNTS.size])
        found = read_run(folder)
        kept = sum(direction == "R" for _, direction in found.frames())
        again = replay(folder)
        counts_on_disk = (kept, found.steps.num_rows, again.steps.num_rows, again.different)
        rows.append((number, received, ticks, *counts_on_disk, received - kept))
        print(
            f"{number}: received {received} frames in {ticks} ticks; on the disk {kept} frames, "
            f"{found.steps.num_rows} steps; replayed {again.steps.num_rows} ticks, "
            f"{again.different} different"
        )
    most = max(row[-1] for row in rows)
    print(f"lost at most {most} frames")
    if asked.page:
        heads = ("run", "frames received", "ticks", "frames on the disk")
        counts = ("logged ticks on the disk", "ticks replayed", "different ticks", "frames lost")
        steps_lost = max(ticks - logged for _, _, ticks, _, logged, *_ in rows)
        not_replayed = [row[2] - row[5] for row in rows]
        sentences = (
            f"No run lost more than {most} of the frames that it had received. Up to {steps_lost} "
            "ticks of a run are missing\nfrom its log; the replay computed all ticks of each run "
            f"except for the last {min(not_replayed)} to {max(not_replayed)}."
        )
        write_evidence(
            "killed",
            "What is lost when the bridge's process is killed",
            TEXT.format(kills=asked.kills),
            [sentences, table((*heads, *counts), rows)],
            command_line(),
        )


if __name__ == "__main__":
    main()
