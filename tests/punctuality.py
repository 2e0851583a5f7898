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

from rig.log.reader import read_run
from rig.plan.load import plan_of_run
from rig.run.late_ticks import find_late_ticks
from rig.run.trace import read_trace
from tests.evidence import add_page_option, command_line, table, write_evidence

TEXT = """
The bridge and an empty loop, which only waits for its ticks, run in turn at 1 kHz for equal times.
The simulated bench runs in the bridge's process, and on each core a further process is busy for
{busy:g} % of the time. SCHED_FIFO was {granted}. A tick is missed if the loop is late by a whole
period.

Only the two runs of one pair are comparable: from pair to pair the load of the machine changes, and
with it the number of missed ticks changes more than it differs between the two loops. The rows
below the sum break it down by the part of the loop in which the time was lost and by the cause,
which `rig timing` determines from the kernel's accounting. The parts of the loop are receive,
compute, send, log, between (what the loop does after the log, before it waits) and wait.
"""

NAMES = {"bare": "empty loop", "bridge": "bridge"}


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


def _granted(folder: Path) -> str:
    header = read_run(folder).header
    return "granted" if header["granted"]["fifo"] else "not granted"


def write_page(rows: list[dict[str, tuple[int, Counter[str]]]], text: str, seconds: float) -> None:
    """Write the guide's page: the spread over the pairs, and what took the ticks."""
    counts = np.array([[row[name][0] for name in NAMES] for row in rows])
    causes = {name: sum((row[name][1] for row in rows), Counter[str]()) for name in NAMES}
    low, middle, high = np.percentile(counts, [10, 50, 90], axis=0)
    spread = [f"{m:g} ({a:g} to {b:g})" for a, m, b in zip(low, middle, high, strict=True)]
    total, ticks = causes["bare"] + causes["bridge"], seconds * 1000
    cells = [
        (f"median over the pairs, of {ticks:g} ticks each (10 to 90 %)", *spread),
        (f"sum over {len(rows)} pairs, of {len(rows) * ticks:g} ticks", *counts.sum(axis=0)),
        *(
            (f"- {cause}", *(causes[name][cause] for name in NAMES))
            for cause, _ in total.most_common()
        ),
    ]
    difference = f"{np.median(np.diff(counts)):g}"
    write_evidence(
        "punctuality",
        "Is the bridge as punctual as an empty loop?",
        text,
        [
            table(("missed ticks", *NAMES.values()), cells),
            "Missed ticks of the bridge less those of the empty loop, median over the pairs: "
            f"{difference}.",
        ],
        command_line(),
    )


def main() -> None:
    """Run the pairs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--busy", type=float, default=1.0, help="share of each core kept busy")
    add_page_option(parser)
    asked = parser.parse_args()
    rows: list[dict[str, tuple[int, Counter[str]]]] = []
    for pair in range(asked.pairs):
        found = {
            name: missed(
                asked.out / f"{name}{pair:03d}", asked.seconds, bare=name == "bare", busy=asked.busy
            )
            for name in NAMES
        }
        rows.append(found)
        print(
            f"pair {pair}: empty loop {found['bare'][0]}, bridge {found['bridge'][0]}", flush=True
        )
        (asked.out / "pairs.json").write_text(json.dumps(rows, indent=1))
    counts = np.array([[row[name][0] for name in NAMES] for row in rows])
    for name, column in zip(NAMES.values(), counts.T, strict=True):
        low, middle, high = np.percentile(column, [10, 50, 90])
        print(f"{name}: median {middle:g} (10 to 90 %: {low:g} to {high:g}), sum {column.sum()}")
    print(f"bridge less empty loop, median of the pairs: {np.median(np.diff(counts)):g}")
    for name in NAMES:
        total = Counter[str]()
        for row in rows:
            total.update(row[name][1])
        print(f"{name}:")
        for cause, count in total.most_common():
            print(f"  {count:6}  {cause}")
    if asked.page:
        text = TEXT.format(busy=100 * asked.busy, granted=_granted(asked.out / "bridge000" / "run"))
        write_page(rows, text, asked.seconds)


if __name__ == "__main__":
    main()
