"""How long `rig diagnose` takes for recordings of a minute: `python -m tests.bench.diagnosis`.

Cases are diagnosed one after another, each by a command of its own, as a user has it.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import NamedTuple

from tests.bench.test_tick_speed import TICKS, array_loop
from tests.diagnosis_benchmark.plan import GROUPS, Slot, fill, part_of, slots
from tests.evidence import add_page_option, command_line, table, write_evidence
from tests.truth.files import write_case
from tests.truth.plant import Case

DURATION_S, RATE_HZ = 60.0, 1000
_KINDS = ("single", "pair", "triple", "complete", "foreign")
FREE = (*_KINDS, "outside", "rough", *(f"rough_{kind}" for kind in _KINDS[1:]))
"""Groups of benches whose body is free, with an exact model and with a rough one."""
_ROUNDS = 30

TEXT = f"""
Benches with a free body are drawn as [the benchmark](diagnosis.md) draws them, and recorded for
{DURATION_S:.0f} s at {RATE_HZ} Hz; the held-out run is as long as there. Each is diagnosed by `rig
diagnose`, one after another, from the start of the command to its end: reading, search, the figures
of the held-out run in DART, and the report. The ratio is to a bare DART loop that steps through the
recording once, with array functions, measured in the same run.
"""


class Measured(NamedTuple):
    """A diagnosis: what it found, and what it took.

    Attributes:
        wall_s: From the start of the command to its end.
        cpu_s: Time on all cores together.
        memory_mib: Most memory at a time.
    """

    case: str
    verdict: str
    names: tuple[str, ...]
    wall_s: float
    cpu_s: float
    memory_mib: float


def minute_of(slot: Slot) -> Case:
    """A case with a recording of a minute at the full rate."""
    case = fill(slot)
    assert isinstance(case, Case)
    excitation = replace(case.train.excitation, duration_s=DURATION_S)
    return replace(
        case,
        train=replace(case.train, excitation=excitation),
        sensors=replace(case.sensors, sample_rate_hz=RATE_HZ),
    )


def measure(slot: Slot, out: Path) -> Measured:
    """Diagnose a case by a command of its own."""
    case, folder = minute_of(slot), out / slot.name
    write_case(case, folder)
    command = [
        sys.executable, "-m", "rig", "diagnose", folder / "train.csv",
        "--model", folder / "model.yaml", "--held-out", folder / "test.csv",
        "--out", folder / "found", "--json",
    ]  # fmt: skip
    begin = time.perf_counter()
    with (folder / "output.txt").open("w", encoding="utf-8") as output:
        child = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(child.pid, 0)
    wall_s = time.perf_counter() - begin
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"{slot.name}: rig diagnose failed, see {folder / 'output.txt'}")
    found = json.loads((folder / "found" / "diagnosis.json").read_text("utf-8"))
    names = tuple(effect["name"] for effect in found["effects"])
    cpu_s = used.ru_utime + used.ru_stime
    return Measured(case.name, found["verdict"], names, wall_s, cpu_s, used.ru_maxrss / 1024.0)


def bare_dart_s() -> float:
    """CPU time of a bare DART loop through a recording: the median of some rounds."""
    loop = array_loop(observing=False)
    times: list[float] = []
    for _ in range(_ROUNDS):
        begin = process_time()
        loop()
        times.append((process_time() - begin) / TICKS)
    return statistics.median(times) * DURATION_S * RATE_HZ


def describe(found: list[Measured]) -> str:
    """Sentences on all cases."""
    walls = [it.wall_s for it in found]
    slow = sum(wall > 30.0 for wall in walls)
    return (
        f"{len(found)} cases: median {statistics.median(walls):.1f} s, longest {max(walls):.0f} s, "
        f"{slow} above 30 s; most memory {max(it.memory_mib for it in found):.0f} MiB."
    )


def rows_of(found: list[Measured], dart_s: float) -> str:
    """The table of all cases."""
    rows = [
        (
            it.case,
            it.verdict,
            ", ".join(it.names) or "–",
            f"{it.wall_s:.1f}",
            f"{it.cpu_s:.1f}",
            f"{it.cpu_s / dart_s:.0f}",
            f"{it.memory_mib:.0f}",
        )
        for it in found
    ]
    heads = ("case", "verdict", "named", "s", "CPU s", "times bare DART", "MiB")
    return table(heads, rows)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.diagnosis", description=__doc__)
    parser.add_argument("--one-of", type=int, default=20, metavar="N", help="one case of N of each")
    parser.add_argument("--seed", type=int, default=0, help="another one gives other cases")
    parser.add_argument("--out", type=Path, required=True, help="folder for cases and answers")
    add_page_option(parser)
    given = parser.parse_args()
    cases = {name: GROUPS[name].cases for name in FREE}
    found: list[Measured] = []
    for slot in slots(part_of(cases, given.one_of), given.seed):
        found.append(measure(slot, given.out))
        print(f"{found[-1].wall_s:6.1f} s  {slot.name}: {found[-1].verdict}", flush=True)
    parts = [describe(found), rows_of(found, bare_dart_s())]
    print(*parts, sep="\n\n")
    if given.page:
        write_evidence("diagnosis-speed", "How long a diagnosis takes", TEXT, parts, command_line())


if __name__ == "__main__":
    main()
