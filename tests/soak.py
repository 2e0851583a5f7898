"""Hours of bench time in lockstep: `python -m tests.soak --hours 4 --out FOLDER`.

Checks that memory stays flat after the first ten minutes, that ticks and time do not drift apart,
that the log is rotated, and that the last ten minutes' estimates are as good as the first's. Exit
code 1 if any of it does not hold.
"""

import argparse
import resource
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import yaml
from numpy.typing import NDArray

from can_dbc.codec import decode_log
from can_dbc.database import load_database
from can_dbc.units import Dimension
from rig.log.file_names import DBC_FILE, FRAMES_FILE, RUN_FILE, STEPS_FILE, parts
from rig.log.received_frames import read_frame_columns
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.loop import RunControl
from rig.simulated_bench.config import load_bench_config

PART_S = 600
S = 1_000_000_000
MOST_GROWTH_MIB = 10.0
WORSE = 1.02
SETTLING = 1000
"""Frames of the load cell at the beginning that do not count: ten seconds."""


def load_cell(folder: Path, part: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times and forces of the load cell in one part of the log."""
    frames = read_frame_columns([parts(folder, FRAMES_FILE)[part]], 0)
    message = load_database(folder / DBC_FILE).message("BENCH_AUXILIARY")
    of_cell = frames.arbitration_id == message.arbitration_id
    payload = np.ascontiguousarray(frames.payload[of_cell][:, : message.length_bytes])
    decoded = decode_log(message, ["LOAD_CELL_FORCE"], [Dimension.FORCE], payload)
    epoch_ns = int(yaml.safe_load((folder / RUN_FILE).read_text())["epoch_ns"])
    return frames.t_ns[of_cell] - epoch_ns, decoded["LOAD_CELL_FORCE"]


def force_error_n(folder: Path, part: int) -> float:
    """RMS of the estimated force less the load cell's in one part of the log."""
    with cast("Any", pa).memory_map(str(parts(folder, STEPS_FILE)[part])) as source:
        steps = cast("Any", pa).ipc.open_stream(source).read_all()
    t_ns, cell_n = load_cell(folder, part)
    estimate_n = np.interp(t_ns, steps["t_ns"].to_numpy(), steps["strut.force_n"].to_numpy())
    return float(np.sqrt(np.mean((estimate_n - cell_n)[SETTLING:] ** 2)))


def main() -> int:
    """Run it, print the figures, and give the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=float, default=4.0)
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=asked.hours * 3600.0)
    log = ready.config.log.model_copy(update={"rotate_s": float(PART_S)})
    memory_mib: list[float] = []

    def progress(t_ns: int, _mode: object) -> None:
        if t_ns % (PART_S * S) == 0 and t_ns:
            memory_mib.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
            print(f"{t_ns // S:>6} s  {memory_mib[-1]:.1f} MiB", flush=True)

    ended = with_bench(
        ready.with_config(ready.config.model_copy(update={"log": log})),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        asked.out,
        lockstep=True,
        control=RunControl(progress=progress),
    )
    files = parts(asked.out, STEPS_FILE)
    # The last part may be short; the one before it is whole.
    first_n, last_n = force_error_n(asked.out, 0), force_error_n(asked.out, len(files) - 2)
    growth_mib = memory_mib[-1] - memory_mib[0]
    expected = round(asked.hours * 3600.0 * ready.config.rate_hz)
    drift_ns = ended.state.supervised.t_ns - (expected - 1) * ready.config.period_ns
    print(f"memory: {growth_mib:.1f} MiB more than after ten minutes")
    print(f"ticks: {ended.ticks} of {expected}, last one {drift_ns} ns off; {len(files)} parts")
    print(f"force error: {first_n:.3f} N in the first ten minutes, {last_n:.3f} N in the last")
    holds = (
        growth_mib < MOST_GROWTH_MIB
        and ended.ticks == expected
        and drift_ns == 0
        and ended.log_fault is None
        and last_n <= WORSE * first_n
    )
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
