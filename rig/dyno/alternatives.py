"""What uncertain corrections add to the intervals of all figures.

A record's figures are those of its force after lag and drift were removed, as far as they are
known. What they would be under another lag or drift is computed from the mean strokes, shifted by
the difference. A correction that is known has a 95 % interval: the change of a figure towards its
end adds to the figure's interval as variances add (ISO/IEC Guide 98-3, 2008, 5.1.3, with the
sensitivity by numerical differences). Corrections of which none is likelier than the others are
possible each: the interval reaches over the figures of all of them.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from rig.dyno.figures import DynoStep, StrokeWarmth
from rig.dyno.stroke_force import ANGLES, Figure, MeanStroke
from rig.dyno.strokes import Array


class Alternative(NamedTuple):
    """Another correction than the one that was made.

    Attributes:
        lag_s: Lag that is removed further.
        drift_n: Drift, in N at times in s, that is removed further.
        is_possible: Whether it is as likely as what was removed; else it is the end of a 95 %
            interval about that.
    """

    lag_s: float = 0.0
    drift_n: Callable[[Array], Array] | None = None
    is_possible: bool = False

    def apply(self, step: DynoStep) -> DynoStep:
        """Figures of a step under it."""
        strokes, warmth = step.strokes, step.warmth
        if self.lag_s:
            down, up = strokes
            strokes = _shift(down, up, self.lag_s), _shift(up, down, self.lag_s)
        if self.drift_n is not None:
            inside_s = np.linspace(step.begin_s, step.end_s, 9)
            offset_n = float(np.mean(self.drift_n(inside_s)))
            down, up = (_lower(stroke, offset_n) for stroke in strokes)
            strokes = down, up
            warmer = [_without(it, self.drift_n(it.t_s)) for it in warmth]
            warmth = warmer[0], warmer[1]
        return step.with_forces(strokes, warmth)


def cover(best: Any, others: Sequence[tuple[Alternative, Any]]) -> Any:
    """Figures with what alternatives add to their intervals.

    `best` is a named tuple of figures, or of mappings and tuples of them; `others` are the same
    under each alternative. What is no figure, or is missing in one of them, remains.
    """
    if isinstance(best, Figure):
        figures = [(how, figure) for how, figure in others if isinstance(figure, Figure)]
        return _widen(best, figures)
    if isinstance(best, MeanStroke | StrokeWarmth):
        return best
    if isinstance(best, Mapping):
        named = cast("Mapping[str, Any]", best)
        return {
            key: cover(value, [(how, other[key]) for how, other in others if key in other])
            for key, value in named.items()
        }
    if isinstance(best, tuple):
        items = cast("tuple[Any, ...]", best)
        values = [
            cover(value, [(how, other[index]) for how, other in others if len(other) > index])
            for index, value in enumerate(items)
        ]
        kind: Any = type(items)
        return kind(*values) if hasattr(items, "_fields") else tuple(values)
    return best


def _widen(best: Figure, others: Sequence[tuple[Alternative, Figure]]) -> Figure:
    apart = [figure.value - best.value for how, figure in others if not how.is_possible]
    low = best.value - math.hypot(best.value - best.low, *apart)
    high = best.value + math.hypot(best.high - best.value, *apart)
    possible = [figure for how, figure in others if how.is_possible]
    low = min([low, *(figure.low for figure in possible)])
    high = max([high, *(figure.high for figure in possible)])
    return best._replace(low=low, high=high)


def _shift(stroke: MeanStroke, other: MeanStroke, lag_s: float) -> MeanStroke:
    """A stroke whose force is of a later time; the other one is before and after it."""
    angles = np.concatenate([ANGLES[:-1] - np.pi, ANGLES, ANGLES[1:] + np.pi])
    forces_n = np.concatenate([other.force_n[:-1], stroke.force_n, other.force_n[1:]])
    middle = np.abs(np.sin(ANGLES)) <= _INNER
    turning = np.abs(stroke.velocity_m_per_s[middle]) / np.cos(ANGLES[middle])
    by_angle = float(np.median(turning)) / stroke.amplitude_m * lag_s
    shifted_n = np.interp(ANGLES + by_angle, angles, forces_n)
    return stroke._replace(force_n=np.asarray(shifted_n, np.float64))


_INNER = 0.9
"""Share of the stroke in which the rate is taken at which the angle turns."""


def _lower(stroke: MeanStroke, by_n: float) -> MeanStroke:
    """A stroke with a force that is lower by a constant."""
    cycles = stroke.cycles._replace(mean_n=stroke.cycles.mean_n - by_n)
    return stroke._replace(force_n=stroke.force_n - by_n, cycles=cycles)


def _without(warmth: StrokeWarmth, drift_n: Array) -> StrokeWarmth:
    return warmth._replace(force_n=warmth.force_n - drift_n)
