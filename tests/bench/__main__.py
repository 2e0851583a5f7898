"""What a tick costs, as ratios: `python -m tests.bench [--page]`.

Measures what `pytest -m long -n 0 tests/bench` measures and prints it as tables.
"""

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from unittest.mock import patch

import numpy as np

from rig.plan import build
from tests.bench.test_codec_speed import time_decoding
from tests.bench.test_many_struts import OBSERVERS, STANDING, strut_subjects
from tests.bench.test_tick_speed import (
    ROUNDS,
    TICKS,
    observer_subjects,
    ratios,
    tick_subjects,
    time_replays,
    time_rounds,
)
from tests.evidence import add_page_option, command_line, table, write_evidence

TEXT = f"""
CPU time of one tick, in {ROUNDS} rounds of {TICKS} ticks each. The rounds of all subjects of a
table alternate, and a ratio is that within one round: its median, and in parentheses the 10th and
90th percentile over the rounds. The measure is the bare DART loop of a moving body: read position
and velocity, set a force, `World.step`, with DART's array functions or its cheaper scalar ones. The
loop by hand decodes and encodes with cantools around DART and a PI observer, without a check, a
mode or a limit. A ratio to DART alone differs by machine; that to the loop by hand, which is mostly
Python as well, differs less. Times of a live run are on the page of real time.
"""
SCALAR, ARRAY = "DART, scalar functions", "DART, array functions"
BY_HAND = "cantools, DART and a PI by hand"


def compare(found: Mapping[str, np.ndarray]) -> str:
    """Table of the time of each subject, and its ratio to three others."""
    over = [ratios(dict(found), first) for first in (SCALAR, ARRAY, BY_HAND)]
    rows = [
        (name, f"{np.median(times):.2f}", *(_spread(*ratio[name]) for ratio in over))
        for name, times in found.items()
    ]
    heads = ("a tick of", "µs", "to scalar DART", "to array DART", "to the loop by hand")
    return table(heads, rows)


def _spread(low: float, middle: float, high: float) -> str:
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def compare_struts(folder: Path) -> str:
    """Table of four struts of a full car against one."""
    with patch.object(build, "ENGINES", STANDING):
        found = time_rounds(strut_subjects(folder))
    rows = []
    for kind in OBSERVERS:
        one, four = (f"{kind}, {number}" for number in ("one strut", "four struts"))
        times = (f"{np.median(found[name]):.1f}" for name in (one, four))
        rows.append((kind, *times, _spread(*ratios(found, one)[four])))
    return table(("observer", "one strut, µs", "four struts, µs", "ratio"), rows)


def describe_logs(folder: Path) -> str:
    """Sentences on decoding and replaying logs."""
    cantools_us, frame_us, log_us = time_decoding()
    replay_us, by_hand_us = time_replays(folder)
    return (
        f"A whole log is decoded {cantools_us / log_us:.0f} times as fast as by cantools frame by "
        f"frame, and a single frame {cantools_us / frame_us:.1f} times as fast. A logged run is "
        f"replayed, bit for bit, at {1e6 / replay_us:.0f} ticks a second of one core; a tick of it "
        f"takes {replay_us / by_hand_us:.1f} times as long as the loop by hand."
    )


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_page_option(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        parts = [
            compare(time_rounds(tick_subjects())),
            "With an observer, and nothing else:",
            compare(time_rounds(observer_subjects())),
            "Four struts of a full car compared with one, without the cost of their model:",
            compare_struts(Path(folder)),
            describe_logs(Path(folder)),
        ]
    print(*parts, sep="\n\n")
    if given.page:
        write_evidence("speed", "What a tick costs", TEXT, parts, command_line())


if __name__ == "__main__":
    main()
