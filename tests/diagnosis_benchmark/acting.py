"""Where an effect shows, held against where it was planted.

Stops and end zones by height, knees by speed.
"""

import itertools
import math
from collections.abc import Iterator, Sequence

from tests.truth.plant import Case

Ends = tuple[float, float]


def overlaps(case: Case, diagnosis: dict) -> Iterator[float]:
    """Overlap (F1) of each planted region with the parts in which its effect is said to show.

    A region counts where the recording has been. An effect that was not named has none.
    """
    for planted in case.effects:
        named = (e for e in diagnosis["effects"] if e["family"] == planted.family)
        where, truth = next(named, {}).get("where"), planted.truth
        if where is None:
            continue
        if planted.family == "stop":
            outside = truth["low_m"], truth["high_m"]
            yield overlap(where["height_m"], outside, where["recorded_height_m"])
        elif planted.law == "taper":
            outside = case.bench.free_length_m, math.inf
            yield overlap(where["height_m"], outside, where["recorded_height_m"])
        elif planted.law == "blow_off":
            slow = -truth["knee_m_per_s"], truth["knee_m_per_s"]
            yield overlap(where["velocity_m_per_s"], slow, where["recorded_velocity_m_per_s"])


def overlap(parts: Sequence[Ends], outside: Ends, recorded: Ends) -> float:
    """F1 of parts of a recorded range with what lies in it outside of another one."""
    low, high = recorded
    regions = [(low, min(outside[0], high)), (max(outside[1], low), high)]
    regions = [(begin, end) for begin, end in regions if end > begin]
    shared = sum(
        max(0.0, min(a[1], b[1]) - max(a[0], b[0])) for a, b in itertools.product(parts, regions)
    )
    whole = sum(end - begin for begin, end in (*parts, *regions))
    return 2.0 * shared / whole if whole > 0.0 else 0.0
