"""Gaps of the applied force, over which a recording holds what was interpolated.

One missing sample hardly matters. Measured on `rig/examples/foreign_dbc` (500 Hz, 24 kg), error of
the right model in free run over the noise floor: 1.1 with every fifth sample missing by itself; 1.1
to 4.6 with gaps of 10 ms over 1 % of the run, and 16 to 35 with gaps of 50 ms.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_TWO_MISSING = 2.5
"""Usual intervals between samples beyond which at least two samples are missing."""


class Gaps(NamedTuple):
    """Gaps of two samples or more: their number, the share of the time, and the longest in s."""

    number: int
    share: float
    longest_s: float

    def report(self, run: str) -> str:
        """What the gaps mean for a diagnosis of a run, in one line."""
        return (
            f"{run}: the applied force is missing in {self.number} gap{'s' * (self.number > 1)} of "
            f"two samples or more ({100.0 * self.share:.2g} % of the run, up to "
            f"{self.longest_s:.2g} s). It is interpolated there, which adds to the error of any "
            "model on this run: record the run again, with less load on the computer and the bus."
        )


def find_gaps(t_s: NDArray[np.float64]) -> Gaps | None:
    """Gaps between sample times in s, increasing, shape (n,); None where there are none."""
    steps_s = np.diff(t_s)
    duration_s = float(steps_s.sum())
    if not duration_s > 0.0:
        return None
    long_s = steps_s[steps_s > _TWO_MISSING * float(np.median(steps_s))]
    if not len(long_s):
        return None
    return Gaps(len(long_s), float(long_s.sum()) / duration_s, float(long_s.max()))
