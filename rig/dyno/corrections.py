"""What is removed from a force before figures are computed: drift of the zero, lag of the cell.

Each can be refused, and each is reported. Nothing is removed that a record does not determine.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.cell_lag import CellLag, estimate_lag
from rig.dyno.figures import LOAD_CELL, DynoStep, ForceRecord
from rig.dyno.stroke_force import ForceRange
from rig.dyno.strokes import Array
from rig.dyno.zero_drift import ZeroDrift

_LEAST_LAG_S, _LONGEST_LAG_S = 1e-4, 2e-2
"""Lags that are worth removing, and beyond which two channels do not belong together."""

_KNOWN_SHARE, _KNOWN_S = 0.25, 3e-4
"""Half of its interval, as a share of a lag and as a time, up to which a lag is known."""


class RequestedCorrections(NamedTuple):
    """Corrections that a user requests.

    Attributes:
        zero: Whether a drift of the zero is removed.
        lag: Whether a lag is removed.
        lag_s: The lag that is removed; None estimates it from the record.
    """

    zero: bool = True
    lag: bool = True
    lag_s: float | None = None


ALL_CORRECTIONS = RequestedCorrections()


class Corrections(NamedTuple):
    """What was found, and what of it was removed.

    Attributes:
        drift: Drift of the zero; None if there is none.
        removes_drift: Whether it was removed.
        lag: Lag by the record's own steps; None where these have none that is one time.
        removed_lag_s: Lag that was removed, in s; zero if none was.
    """

    drift: ZeroDrift | None
    removes_drift: bool
    lag: CellLag | None
    removed_lag_s: float

    @property
    def any(self) -> bool:
        """Whether anything is removed."""
        return self.removes_drift or self.removed_lag_s != 0.0

    def apply(self, record: ForceRecord) -> ForceRecord:
        """The record without what is removed."""
        force_n = record.force_n
        if self.drift is not None and self.removes_drift:
            force_n = force_n - self.drift.at(record.t_s)
        if self.removed_lag_s:
            force_n = np.interp(record.t_s + self.removed_lag_s, record.t_s, force_n)
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
        }

    def words(self) -> Iterator[str]:
        """A sentence on each."""
        if self.drift is not None:
            yield _drift_words(self.drift, removes=self.removes_drift)
        if self.lag is not None and not self.lag.is_one and _is_seen(self.lag):
            yield (
                "the force depends on whether the strut speeds up or slows down, and not by one "
                "lag in all steps: a soft mount, air in the oil, or valves that lag"
            )
        elif self.removed_lag_s:
            yield (
                f"the force lags the height by {1e3 * self.removed_lag_s:.3g} ms"
                f"{self._interval()}: removed. Peak forces and spring rates would be wrong with it"
            )
        elif self.lag is not None and _is_seen(self.lag):
            yield (
                f"the force lags the height by {1e3 * self.lag.figure.value:.3g} ms"
                f"{self._interval()}: not removed, so that spring rates rise with speed"
            )

    def _interval(self) -> str:
        if self.lag is None:
            return ""
        low, high = 1e3 * self.lag.figure.low, 1e3 * self.lag.figure.high
        return f" (95 %: {low:.3g} to {high:.3g} ms)"


NO_CORRECTIONS = Corrections(None, False, None, 0.0)


def _drift_words(drift: ZeroDrift, *, removes: bool) -> str:
    change = (
        f"the zero of the load cell drifted by {drift.largest.value:+.3g} N between "
        f"{drift.begin_s:.1f} s and {drift.end_s:.1f} s, as {drift.source} show"
    )
    if removes:
        return f"{change}: removed"
    if drift.is_known:
        return f"{change}: not removed"
    return (
        f"the force at rest at one height changed by {drift.largest.value:+.3g} N between "
        f"{drift.begin_s:.1f} s and {drift.end_s:.1f} s: gas that warms, friction that holds "
        "another way, or a cell that drifts (the cycles between do not show it; nothing is removed)"
    )


def _is_seen(lag: CellLag) -> bool:
    """Whether a lag is certain and of a size that matters."""
    figure = lag.figure
    is_certain = figure.low > 0.0 or figure.high < 0.0
    return is_certain and abs(figure.value) >= _LEAST_LAG_S


def _is_known(lag: CellLag) -> bool:
    """Whether a lag is one time, and known well enough to be removed."""
    half = lag.figure.half
    size = abs(lag.figure.value)
    is_narrow = math.isfinite(half) and half <= max(_KNOWN_SHARE * size, _KNOWN_S)
    return lag.is_one and is_narrow and _is_seen(lag) and size <= _LONGEST_LAG_S


def decide(
    requested: RequestedCorrections,
    record: ForceRecord,
    steps: Sequence[DynoStep],
    drift: ZeroDrift | None,
) -> Corrections:
    """What is removed from a record, whose steps were computed without it."""
    lag = estimate_lag(steps) if steps and record.source == LOAD_CELL else None
    lag_s = 0.0
    if requested.lag and requested.lag_s is not None:
        lag_s = requested.lag_s
    elif requested.lag and lag is not None and _is_known(lag):
        lag_s = lag.figure.value
    removes = requested.zero and drift is not None and drift.is_known
    return Corrections(drift, removes, lag, lag_s)
