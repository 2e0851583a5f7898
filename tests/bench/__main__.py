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
from tests.bench.test_codec_speed import FRAMES, REPEATS, time_decoding
from tests.bench.test_many_struts import OBSERVERS, STANDING, strut_subjects
from tests.bench.test_tick_speed import (
    ROUNDS,
    TICKS,
    corrected_subjects,
    observer_subjects,
    ratios,
    tick_subjects,
    time_replays,
    time_rounds,
)
from tests.evidence import add_page_option, command_line, table, write_evidence

TEXT = f"""
The tables give the CPU time of one tick, as the median over {ROUNDS} rounds of {TICKS} ticks. The
rounds of all rows of a table alternate. Each ratio is formed within one round; the tables give its
median over the rounds, with the 10th and 90th percentile in parentheses. This median may therefore
differ from the ratio of the two medians.

- *DART, scalar functions* and *DART, array functions*: bare DART loops with one moving body. They
  read position and velocity, set a force and call `World.step`. Reading and setting use DART's
  scalar functions, which are cheaper, or its array functions.
- *Plant alone*: DART with the bridge's third-order integrator.
- *Plant, observer and supervisor*: the same with a PI observer and the supervision of the mode,
  without frames.
- *Whole tick of the bridge*: one frame is decoded and checked, and one is encoded; the bus
  driver and the log are not included.
- *Hand-written loop*: it decodes a frame with cantools, steps DART with a PI observer, and encodes
  a frame, without checks, modes or limits.

Ratios to DART alone vary from machine to machine; those to the hand-written loop, which like the
bridge is mostly Python, vary less. For times of a live run see
[lateness and force error in real time](real-time.md).
"""
SCALAR, ARRAY = "DART, scalar functions", "DART, array functions"
BY_HAND = "hand-written loop"
_LABELS = {"PI": "`pi`", "noise-aware": "noise-aware (`kalman`)"}


def compare(found: Mapping[str, np.ndarray]) -> str:
    """Table of the time of each subject, and its ratio to three others."""
    over = [ratios(dict(found), first) for first in (SCALAR, ARRAY, BY_HAND)]
    rows = [
        (name, f"{np.median(times):.2f}", *(_spread(*ratio[name]) for ratio in over))
        for name, times in found.items()
    ]
    references = ("DART, scalar", "DART, array", "the hand-written loop")
    heads = ("one tick of", "median, µs", *(f"ratio to {name}" for name in references))
    return table(heads, rows)


def _spread(low: float, middle: float, high: float) -> str:
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def compare_models() -> str:
    """Table of corrected models against the nominal one."""
    found = time_rounds(corrected_subjects())
    over = ratios(found, next(iter(found)))
    rows = [
        (name, f"{np.median(times):.1f}", _spread(*over[name])) for name, times in found.items()
    ]
    return table(("one tick", "median, µs", "ratio to the nominal model"), rows)


def compare_struts(folder: Path) -> str:
    """Table of four struts of a full car against one."""
    with patch.object(build, "ENGINES", STANDING):
        found = time_rounds(strut_subjects(folder))
    rows = []
    for kind in OBSERVERS:
        one, four = (f"{kind}, {number}" for number in ("one strut", "four struts"))
        times = (f"{np.median(found[name]):.1f}" for name in (one, four))
        rows.append((_LABELS[kind], *times, _spread(*ratios(found, one)[four])))
    return table(("observer", "one strut, µs", "four struts, µs", "ratio"), rows)


def describe_logs(folder: Path) -> str:
    """Sentences on decoding and replaying logs."""
    cantools_us, frame_us, log_us = time_decoding()
    replay_us, by_hand_us = time_replays(folder)
    return (
        f"rig decodes a log of {FRAMES} frames in one call {cantools_us / log_us:.0f} times as "
        "fast as cantools decodes it frame by frame, and a single frame "
        f"{cantools_us / frame_us:.1f} times as fast (two signals per frame; CPU time, fastest of "
        f"{REPEATS} repeats). A replay computes about {round(1e6 / replay_us, -2):.0f} ticks per "
        "second on one core, and reproduces the log bit for bit; its tick takes "
        f"{replay_us / by_hand_us:.1f} times as long as that of the hand-written loop (fastest of "
        "five rounds)."
    )


def main() -> None:
    """Measure, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_page_option(parser)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        parts = [
            compare(time_rounds(tick_subjects())),
            "The bare DART loops with a PI observer added, and nothing else:",
            compare(time_rounds(observer_subjects())),
            "Whole ticks with models to which a diagnosis has added a law:",
            compare_models(),
            "Whole ticks with four struts of a full car, compared with one strut. The model is "
            "replaced by one that computes nothing: the times are those of the bridge alone, and "
            "are not comparable with those above:",
            compare_struts(Path(folder)),
            describe_logs(Path(folder)),
        ]
    print(*parts, sep="\n\n")
    if given.page:
        write_evidence("speed", "What a tick costs", TEXT, parts, command_line())


if __name__ == "__main__":
    main()
