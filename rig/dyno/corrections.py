"""What is removed from a force before figures are computed: drift of the zero, lag of the cell.

Each can be stated or refused, and each is reported. Nothing is removed that a record does not
determine; how large it may then be is in the intervals of what depends on it.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from rig.dyno.alternatives import Alternative
from rig.dyno.cell_lag import LONGEST_LAG_S, CellLag, estimate_lag
from rig.dyno.figures import LOAD_CELL, DynoStep, ForceRecord
from rig.dyno.request import FigureRequest
from rig.dyno.stroke_force import ForceRange
from rig.dyno.strokes import Array
from rig.dyno.zero_drift import ZeroDrift

_LEAST_LAG_S = 1e-4
"""Lag that is worth removing."""

_KNOWN_SHARE, _KNOWN_S = 0.25, 3e-4
"""Half of its interval, as a share of a lag and as a time, up to which a lag is known."""

_POSSIBLE = (0.25, 0.5, 0.75, 1.0)
"""Shares of a possible lag at which figures are computed: forces at the largest speed are largest
where the lag is the true one, which is at most an eighth of it away from these."""


class Corrections(NamedTuple):
    """What was found, and what of it was removed.

    Attributes:
        requested: What was requested.
        drift: Drift of the zero; None if there is none.
        lag: Lag by the record's own steps; None where none of them would show one.
        removed_lag_s: Lag that was removed, in s; zero if none was.
    """

    requested: FigureRequest
    drift: ZeroDrift | None
    lag: CellLag | None
    removed_lag_s: float

    @property
    def removes_drift(self) -> bool:
        """Whether a drift was removed."""
        return self.requested.zero and self.drift is not None and self.drift.kind == "known"

    def alternatives(self) -> list[Alternative]:
        """What the corrections might be as well."""
        return [*self._other_drifts(), *self._other_lags()]

    def _other_drifts(self) -> Iterator[Alternative]:
        drift = self.drift
        if drift is None or not self.requested.zero or drift.kind == "excluded":
            return
        if drift.kind in ("open", "unseen"):
            yield Alternative(drift_n=drift.at, is_possible=True)
        for line in drift.deviations:
            yield Alternative(drift_n=partial(drift.follow, line))

    def _other_lags(self) -> Iterator[Alternative]:
        lag = self.lag
        if lag is None or self.requested.lag_s is not None or lag.kind == "several":
            return
        if self.removed_lag_s:
            yield Alternative(lag_s=lag.figure.half)
        elif lag.kind == "one" and _is_narrow(lag):
            yield Alternative(lag_s=max(lag.figure.low, lag.figure.high, key=abs))
        else:
            ends = (end for end in (min(lag.figure.low, 0.0), lag.figure.high) if end)
            yield from (Alternative(share * end, None, True) for end in ends for share in _POSSIBLE)

    def apply(self, record: ForceRecord) -> ForceRecord:
        """The record without what is removed."""
        force_n = record.force_n
        if self.drift is not None and self.removes_drift:
            force_n = force_n - self.drift.at(record.t_s)
        if self.removed_lag_s:
            at_s = np.minimum(record.t_s + self.removed_lag_s, record.t_s[-1]).clip(record.t_s[0])
            force_n = CubicSpline(record.t_s, force_n)(at_s)
        return record._replace(force_n=np.asarray(force_n, np.float64))

    def limits_in(self, limits: ForceRange, t_s: Array) -> ForceRange:
        """What is left of a cell's limits at times of a step, shape (N,), once drift is removed."""
        if self.drift is None or not self.removes_drift:
            return limits
        drift_n = self.drift.at(t_s)
        return ForceRange(limits.low_n - float(drift_n.min()), limits.high_n - float(drift_n.max()))

    def as_dict(self) -> dict[str, object]:
        """For `characteristics.json`."""
        drift, lag = self.drift, self.lag
        return {
            "zero_drift_n": None if drift is None else drift.largest,
            "removes_drift": self.removes_drift,
            "lag_s": None if lag is None else lag.figure,
            "removed_lag_s": self.removed_lag_s,
            "moving_mass_kg": self.requested.moving_mass_kg,
        }

    def words(self) -> Iterator[str]:
        """A sentence on each."""
        if self.requested.moving_mass_kg:
            yield (
                f"the inertia of {self.requested.moving_mass_kg:g} kg between load cell and strut "
                "was removed from the force"
            )
        if self.drift is not None and (self.requested.zero or self.drift.kind != "unseen"):
            yield _drift_words(self.drift, removes=self.removes_drift)
        lag = self.lag
        if self.removed_lag_s:
            yield (
                f"the force lags the height by {1e3 * self.removed_lag_s:.3g} ms"
                f"{self._interval()}: removed. Peak forces and spring rates would be wrong with it"
            )
        elif lag is not None and lag.kind == "several" and _is_seen(lag):
            yield (
                "the force depends on whether the strut speeds up or slows down, and not by one "
                "lag in all steps: a soft mount, air in the oil, or valves that lag"
            )
        elif lag is not None and self.requested.lag_s is not None and _is_seen(lag):
            yield (
                f"the force lags the height by {1e3 * lag.figure.value:.3g} ms"
                f"{self._interval()}: not removed, so that spring rates rise with speed"
            )
        elif lag is not None and lag.kind == "open" and lag.figure.high >= _LEAST_LAG_S:
            yield (
                f"a lag of the force of up to {1e3 * lag.figure.high:.3g} ms cannot be "
                "distinguished from a spring, as the steps have fewer than three frequencies: it "
                "is in the intervals. State a known one by `--lag-ms`, 0 if there is none"
            )

    def _interval(self) -> str:
        if self.lag is None or self.lag.kind != "one":
            return ""
        low, high = 1e3 * self.lag.figure.low, 1e3 * self.lag.figure.high
        return f" (95 %: {low:.3g} to {high:.3g} ms)"


def _drift_words(drift: ZeroDrift, *, removes: bool) -> str:
    if drift.kind == "unseen":
        return (
            f"a drift of the zero of up to {drift.largest.high:.2g} N over the test cannot be seen "
            "without two rests at one height: it is in the intervals"
        )
    between = (
        f"by {drift.largest.value:+.3g} N between {drift.begin_s:.1f} s and {drift.end_s:.1f} s"
    )
    change = f"the zero of the load cell drifted {between}, as {drift.source} show"
    if removes:
        return f"{change}: removed"
    if drift.kind == "known":
        return f"{change}: not removed"
    rests = (
        f"the force at rest at one height changed {between}: gas that warms, friction that holds "
        "another way, or a cell that drifts"
    )
    if drift.kind == "excluded":
        return f"{rests} (the cycles between do not show it; nothing is removed)"
    return f"{rests} (the cycles between leave it open; the intervals contain both)"


def _is_seen(lag: CellLag) -> bool:
    """Whether a lag is certain and of a size that matters."""
    figure = lag.figure
    is_certain = figure.low > 0.0 or figure.high < 0.0
    return is_certain and abs(figure.value) >= _LEAST_LAG_S


def _is_narrow(lag: CellLag) -> bool:
    """Whether a lag is known well enough to be removed."""
    size = abs(lag.figure.value)
    return size <= LONGEST_LAG_S and lag.figure.half <= max(_KNOWN_SHARE * size, _KNOWN_S)


def find_lag(
    corrections: Corrections, record: ForceRecord, steps: Sequence[DynoStep]
) -> Corrections:
    """The corrections of a record with its lag, whose steps have no drift but the lag."""
    stated_s = corrections.requested.lag_s
    lag = estimate_lag(steps) if record.source == LOAD_CELL else None
    lag_s = stated_s or 0.0
    if stated_s is None and lag is not None and lag.kind == "one":
        lag_s = lag.figure.value if _is_narrow(lag) and _is_seen(lag) else 0.0
    return corrections._replace(lag=lag, removed_lag_s=lag_s)
