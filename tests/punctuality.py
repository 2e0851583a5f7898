"""Is the bridge as punctual as a loop that does nothing? `python -m tests.punctuality --out DIR`.

Runs both in turn, the same length each, on the same busy machine, and says how many ticks each
missed and who took the time of those that the bridge missed. Hours differ more than programs do:
only what is in one pair can be compared.
"""

import argparse
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from rig.plan.load import plan_of_run
from rig.run.late_ticks import find_late_ticks
from rig.run.trace import read_trace


def missed(folder: Path, seconds: float, *, bare: bool, busy: float) -> tuple[int, Counter[str]]:
    """Missed ticks of one run at 1 kHz, and how many each cause took."""
    options = ["--bare"] if bare else []
    command = [sys.executable, "-m", "tests.realtime", "--out", str(folder), "--trace", *options]
    command += ["--seconds", str(seconds), "--busy", str(busy)]
    subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    where = folder if bare else folder / "run"
    late = find_late_ticks(read_trace(where), 1_000_000 if bare else _period_ns(where))
    causes = Counter[str]()
    for item in late:
        causes[f"{item.part}: {item.cause.value}"] += item.missed
    return sum(item.missed for item in late), causes


def _period_ns(folder: Path) -> int:
    return plan_of_run(folder).period_ns


def main() -> None:
    """Run the pairs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--busy", type=float, default=1.0, help="share of each core kept busy")
    asked = parser.parse_args()
    rows: list[dict[str, object]] = []
    for pair in range(asked.pairs):
        found = {
            name: missed(
                asked.out / f"{name}{pair:03d}", asked.seconds, bare=name == "bare", busy=asked.busy
            )
            for name in ("bare", "bridge")
        }
        rows.append({name: [count, dict(causes)] for name, (count, causes) in found.items()})
        print(
            f"pair {pair}: empty loop {found['bare'][0]}, bridge {found['bridge'][0]}", flush=True
        )
        (asked.out / "pairs.json").write_text(json.dumps(rows, indent=1))
    counts = np.array([[row[name][0] for name in ("bare", "bridge")] for row in rows])
    for name, column in zip(("empty loop", "bridge"), counts.T, strict=True):
        low, middle, high = np.percentile(column, [10, 50, 90])
        print(f"{name}: median {middle:g} (10 to 90 %: {low:g} to {high:g}), sum {column.sum()}")
    print(f"bridge less empty loop, median of the pairs: {np.median(np.diff(counts)):g}")
    for name in ("bare", "bridge"):
        total = Counter[str]()
        for row in rows:
            total.update(row[name][1])
        print(f"{name}:")
        for cause, count in total.most_common():
            print(f"  {count:6}  {cause}")


if __name__ == "__main__":
    main()
