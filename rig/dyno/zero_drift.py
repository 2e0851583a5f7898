"""Drift of a load cell's zero, from the rests of a record and the steps between them.

The force at rest at one height is that of the gas, and what friction holds. Where it changes over a
test, the zero drifted, the gas warmed, or friction holds another way. A zero that drifts changes
the mean force of the cycles between two rests as well, as fast as the rests show; friction that
holds another way does not. Where the cycles confirm what the rests show, a polynomial through the
rests is the drift, counted from the first one.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.figures import AtRest, ForceRecord
from rig.dyno.stroke_force import Figure
from rig.dyno.strokes import Array, Block

_SAME_HEIGHT_M = 5e-4
"""By which rests of one height may differ: of a gas spring of 2 N/mm that is 1 N."""

_LEAST_SHARE, _MOST_SHARE = 0.5, 1.5
"""Shares of the rests' change that the cycles have to show: damping that fades, stronger in one
direction, changes their mean, too."""

_FEWEST_CYCLES = 3

_MOST_DEGREES, _FITS = 4, 3.0
"""Highest degree of the polynomial over time that a drift is, and mean square of its distances from
the rests, in their standard deviations, below which a lower degree is enough."""


class ZeroDrift(NamedTuple):
    """Change of the force at rest, over time.

    Attributes:
        line: Change since the first rest, in N, over time in s.
        times_s: Times of the rests, increasing, shape (N,).
        largest: Largest change between two rests.
        begin_s: Time of the earlier of these.
        end_s: Time of the later one.
        is_confirmed: Whether the cycles between the rests show it.
    """

    line: np.polynomial.Polynomial
    times_s: Array
    largest: Figure
    begin_s: float
    end_s: float
    is_confirmed: bool

    def at(self, t_s: Array) -> Array:
        """Drift at times, constant before the first rest and after the last."""
        inside_s = np.clip(t_s, self.times_s[0], self.times_s[-1])
        return np.asarray(self.line(inside_s), np.float64)


def estimate_drift(
    record: ForceRecord, blocks: Sequence[Block], rests: Sequence[AtRest]
) -> ZeroDrift | None:
    """The drift of a record; None where no two rests of one height differ by more than chance."""
    alike = [
        [rest for rest in rests if abs(rest.height_m - other.height_m) <= _SAME_HEIGHT_M]
        for other in rests
    ]
    mine: list[AtRest] = max(alike, key=len) if alike else []
    pairs = [
        (earlier, later)
        for index, earlier in enumerate(mine)
        for later in mine[index + 1 :]
        if later.force_n.low > earlier.force_n.high or later.force_n.high < earlier.force_n.low
    ]
    if not pairs:
        return None
    earlier, later = max(pairs, key=lambda pair: abs(pair[1].force_n.value - pair[0].force_n.value))
    times_s, line = _line(mine)
    value = later.force_n.value - earlier.force_n.value
    half = 0.5 * float(
        np.hypot(later.force_n.high - later.force_n.low, earlier.force_n.high - earlier.force_n.low)
    )
    largest = Figure(value, value - half, value + half, "force at rest at one height")
    drift = ZeroDrift(line, times_s, largest, earlier.begin_s, later.begin_s, is_confirmed=False)
    return drift._replace(is_confirmed=_is_confirmed(record, blocks, drift))


def _line(rests: Sequence[AtRest]) -> tuple[Array, np.polynomial.Polynomial]:
    """Times of rests, and the polynomial of least degree that describes their forces."""
    times_s = np.array([0.5 * (rest.begin_s + rest.end_s) for rest in rests])
    forces_n = np.array([rest.force_n.value for rest in rests])
    halves_n = np.array([0.5 * (rest.force_n.high - rest.force_n.low) for rest in rests])
    weights = 1.96 / np.maximum(halves_n, 1e-12)
    degree = 0
    while True:
        degree += 1
        line = np.polynomial.Polynomial.fit(times_s, forces_n, degree, w=weights)
        freedom = len(times_s) - degree - 1
        misfit = float(np.sum((weights * (forces_n - line(times_s))) ** 2))
        if degree >= _MOST_DEGREES or freedom < 1 or misfit <= _FITS * freedom:
            return times_s, line - float(line(times_s[0]))


def _is_confirmed(record: ForceRecord, blocks: Sequence[Block], drift: ZeroDrift) -> bool:
    """Whether the mean force of the cycles changes as the rests do, by weighted least squares."""
    shown: list[float] = []
    expected: list[float] = []
    weights: list[float] = []
    for block in blocks:
        begins = [stroke.first for stroke in block.strokes[::2]]
        cycles = [slice(*pair) for pair in itertools.pairwise(begins)]
        if len(cycles) < _FEWEST_CYCLES:
            continue
        t_s = np.array([float(record.t_s[cycle].mean()) for cycle in cycles])
        mean_n = np.array([float(record.force_n[cycle].mean()) for cycle in cycles])
        about_s = t_s - t_s.mean()
        slope = float(about_s @ mean_n) / float(about_s @ about_s)
        residual = mean_n - mean_n.mean() - slope * about_s
        variance = float(residual @ residual) / (len(t_s) - 2) / float(about_s @ about_s)
        ends_n = drift.at(t_s[[0, -1]])
        shown.append(slope)
        expected.append(float(ends_n[1] - ends_n[0]) / float(t_s[-1] - t_s[0]))
        weights.append(1.0 / max(variance, 1e-30))
    if not shown or not any(expected):
        return False
    w, x, y = np.array(weights), np.array(expected), np.array(shown)
    power = float(w @ (x * x))
    share, std = float(w @ (x * y)) / power, power**-0.5
    return share - std >= _LEAST_SHARE and share + std <= _MOST_SHARE
