"""Faults of the sensors, judged before a figure is given: spikes, clipping, units.

A spike is removed: it leaves samples on either side of it by far more than the force ever does, and
returns within three samples. Where a load cell is clipped, the true force lies beyond what it
shows: a figure that depends on such samples is a bound, or none at all.

Without noise behind the clipping, samples stay at one value. With noise behind it they scatter
about one level, and what gives it away is the mean stroke: it rises with speed up to a level, and
from there on not at all, in every step that reaches it and in none beyond it. A valve that blows
off flattens the force too, but its force goes on rising with speed.

Reference: Hampel, The influence curve and its role in robust estimation, JASA 69 (1974), for the
running median.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter  # pyright: ignore[reportUnknownVariableType]

from can_dbc.errors import InputError
from rig.dyno.figures import ForceRecord
from rig.dyno.stroke_force import ANGLES, FINE, ForceRange, MeanStroke
from rig.dyno.strokes import Array
from rig.recordings.clipping import find_sudden_plateaus
from rig.recordings.stretches import find_stretches

_LARGEST_N = 1e8
"""Ten times what the largest damper machines of civil engineering reach."""

_LARGEST_STROKE_M = 5.0
"""Twice the stroke of the largest seismic dampers."""

_WINDOW = 7
"""Samples of the running median: a spike of three is its minority."""

_LONGEST, _BESIDE = 3, 4
"""Samples of a spike at most, and samples on either side with which it is compared."""

_USUAL, _BEYOND = 0.995, 4.0
"""Quantile of the distances from the running median, and how many times of it a spike has: the
peaks of a sine of 16 samples a cycle are an eighth of the samples, and a spike is rare."""

_MOST_SPIKES = 20
"""Spikes of a record: more of them are knocks of the damper, or a cell that cannot be used."""

_TOP_SHARE, _TOP_STDS = 0.004, 4.0
"""Share of a force, and standard deviations, within which a mean stroke is at its level."""

_SHARES = (0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 0.94)
"""Shares of the peak speed from which on a force may stay at its level."""

_FEWEST_PLACES, _FEWEST_SAMPLES = 6, 12
"""Places along a stroke, and samples, that such a line is fitted to."""

_BUT_CORNERS, _ROUNDED = 0.95, 0.01
"""Quantile of a mean stroke's forces that counts as its largest, and share of a level by which that
may exceed it: a spline overshoots at a corner."""

_FLAT = 0.1
"""Slope at the level over the slope below it, which a clipped cell stays under with its 95 %
interval: above their knee dampers have a tenth to a third."""

_NOT_ABOVE = 3.0
"""Standard deviations up to which a slope may be zero: of many steps one is above two by chance."""

_SLOWEST_ENTRY = 0.1
"""Share of a level that the force has to rise by with speed: dry friction is there at once."""

_BELOW = (0.4, 0.95)
"""Shares of the speed from which on a force may stay at its level, between which the slope below it
is taken."""


class SensorFaults(NamedTuple):
    """What was found, for the reader of the figures.

    Attributes:
        spikes: By channel the times of its spikes, and by how much they left their neighbours.
        limits: Forces at which the load cell was clipped.
    """

    spikes: Mapping[str, Sequence[tuple[float, float]]]
    limits: ForceRange

    def words(self) -> Iterator[str]:
        """A sentence on each fault."""
        for channel, spikes in self.spikes.items():
            if spikes:
                at_s, size = max(spikes, key=lambda item: abs(item[1]))
                unit = "mm" if channel == "height" else "N"
                shown = 1e3 * size if channel == "height" else size
                count = "1 spike was" if len(spikes) == 1 else f"{len(spikes)} spikes were"
                yield (
                    f"{count} removed from the {channel}, the largest of {shown:+.4g} {unit} at "
                    f"{at_s:.3f} s"
                )
        for extreme, limit_n in zip(("lowest", "highest"), self.limits, strict=True):
            if math.isfinite(limit_n):
                yield (
                    f"the force never leaves its {extreme} level of {limit_n:.4g} N once it is "
                    "there, at whatever speed: the load cell or its amplifier was clipped. A "
                    "figure that depends on it is a bound (≥ or ≤) or is missing (–)"
                )


def judge_sensors(record: ForceRecord) -> tuple[ForceRecord, SensorFaults]:
    """The record without spikes, and what was found in its samples alone.

    Raises:
        InputError: Its values are not those of a damper in SI units.
    """
    refuse_implausible(record.name, record.height_m, record.force_n)
    channels = {"height": record.height_m, "force": record.force_n}
    is_spike = np.zeros(len(record.t_s), np.bool_)
    spikes: dict[str, list[tuple[float, float]]] = {}
    for name, values in channels.items():
        found = find_spikes(values)
        for spike in found:
            is_spike[spike] = True
        spikes[name] = [
            (float(record.t_s[it.start]), float(values[it.start] - values[it.start - 1]))
            for it in found
        ]
    cleaned = record.without(is_spike)
    return cleaned, SensorFaults(spikes, find_plateau_limits(cleaned.force_n))


def refuse_implausible(name: str, height_m: Array, force_n: Array) -> None:
    """Refuse a record of shape (N,) whose values are not those of a damper in SI units.

    Raises:
        InputError: A force or the range of heights is beyond any damper's.
    """
    largest_n = float(np.abs(force_n).max(initial=0.0))
    if largest_n > _LARGEST_N:
        raise InputError(f"{name}: a force of {largest_n:.3g} N, expected at most {_LARGEST_N:g}")
    stroke_m = float(np.ptp(height_m)) if len(height_m) else 0.0
    if stroke_m > _LARGEST_STROKE_M:
        raise InputError(
            f"{name}: heights over a range of {stroke_m:.4g} m, expected at most "
            f"{_LARGEST_STROKE_M:g} m: state their unit in the mapping of `rig import --mapping`"
        )


def find_spikes(values: Array) -> list[slice]:
    """Stretches of up to three samples that stand alone, far from both neighbours.

    The channel has the shape (N,), all finite. With more than twenty of them none is a spike.
    """
    distance = np.abs(values - median_filter(values, _WINDOW, mode="nearest"))
    least = _BEYOND * float(np.quantile(distance, _USUAL))
    spikes: list[slice] = []
    for found in find_stretches(distance > least):
        before = values[max(found.start - _BESIDE, 0) : found.start]
        after = values[found.stop : found.stop + _BESIDE]
        if found.stop - found.start > _LONGEST or min(len(before), len(after)) < 2:
            continue
        # It leaves one neighbour and returns to the other, by far more than these move; a jump to
        # another level does not, nor does the peak of a fast stroke.
        leaves = float(values[found.start] - before[-1])
        returns = float(values[found.stop - 1] - after[0])
        usual = max(float(np.abs(np.diff(side)).max()) for side in (before, after))
        if leaves * returns > 0.0 and min(abs(leaves), abs(returns)) > max(least, _BEYOND * usual):
            spikes.append(found)
    return spikes if len(spikes) <= _MOST_SPIKES else []


def find_plateau_limits(force_n: Array) -> ForceRange:
    """Levels at which a force (N,) stays sample by sample: it has no noise behind the clipping."""
    limits = {plateau.extreme: plateau.limit for plateau in find_sudden_plateaus(force_n)}
    return ForceRange(limits.get("lowest", -math.inf), limits.get("highest", math.inf))


def find_level_limits(strokes: Sequence[MeanStroke]) -> ForceRange:
    """Levels that the mean strokes of a record reach at speed and do not exceed."""
    # Compression pushes: its largest force is the highest, that of rebound the lowest.
    down, up = ([it for it in strokes if it.sign == sign] for sign in (-1, 1))
    high_n, low_n = _level(down), _level(up)
    # An amplifier is clipped in both directions alike: one may reach it for a moment only.
    if math.isinf(high_n) and math.isfinite(low_n) and _reaches(down, low_n):
        high_n = low_n
    if math.isinf(low_n) and math.isfinite(high_n) and _reaches(up, high_n):
        low_n = high_n
    return ForceRange(-low_n, high_n)


def _level(strokes: Sequence[MeanStroke]) -> float:
    """Damping force beyond which no stroke of a direction shows anything; infinite if one does."""
    levels = [level for stroke in strokes if (level := _level_of(stroke)) is not None]
    if not levels:
        return math.inf
    level_n = min(levels, key=lambda level: level.half_n).value_n
    is_one = all(abs(it.value_n - level_n) <= it.half_n for it in levels)
    return level_n if is_one and not any(_exceeds(it, level_n) for it in strokes) else math.inf


def _exceeds(stroke: MeanStroke, level_n: float) -> bool:
    """Whether a mean stroke is above a level, but for the overshoot of a spline at corners."""
    force_n = -stroke.sign * stroke.force_n
    largest_n = float(np.quantile(force_n, _BUT_CORNERS))
    at = int(np.argmin(np.abs(force_n - largest_n)))
    std_n = float(stroke.covariance[at, at]) ** 0.5
    return largest_n > (1.0 + _ROUNDED) * level_n + _TOP_STDS * std_n


def _reaches(strokes: Sequence[MeanStroke], level_n: float) -> bool:
    """Whether strokes reach a level, and none exceeds it."""
    largest_n = max((float((-it.sign * it.force_n).max()) for it in strokes), default=0.0)
    is_there = largest_n >= (1.0 - _ROUNDED) * level_n
    return is_there and not any(_exceeds(it, level_n) for it in strokes)


class _Level(NamedTuple):
    """A level at which a mean stroke stays, and by how much it is uncertain."""

    value_n: float
    half_n: float


def _level_of(stroke: MeanStroke) -> _Level | None:
    """The level that a stroke stays at about its largest speed, if it does.

    Samples faster than some share of the largest speed are fitted by a level, a slope over speed
    and one over height: of a clipped force both slopes are zero.
    """
    peak = float(np.abs(stroke.velocity_m_per_s).max())
    if stroke.is_constant:
        return None
    for share in _SHARES:
        top = _fit_line(stroke, share * peak, peak)
        below = _fit_line(stroke, _BELOW[0] * share * peak, _BELOW[1] * share * peak)
        if top is None or below is None or below.slope <= 0.0:
            continue
        half = 1.96 * top.slope_std
        is_flat = (
            top.slope <= _NOT_ABOVE * top.slope_std and top.slope + half <= _FLAT * below.slope
        )
        # A level that is reached at no speed is that of dry friction.
        rises = below.slope * share * peak > _SLOWEST_ENTRY * top.level_n
        if (
            is_flat
            and rises
            and abs(top.spring_n) <= 1.96 * top.spring_std_n + _TOP_SHARE * top.level_n
        ):
            half_n = _TOP_SHARE * top.level_n + _TOP_STDS * top.level_std_n
            return _Level(top.level_n, half_n)
    return None


class _Line(NamedTuple):
    """Force at the mean of some speeds, its slope over speed, and its change over half a stroke."""

    level_n: float
    level_std_n: float
    slope: float
    slope_std: float
    spring_n: float
    spring_std_n: float


def _fit_line(stroke: MeanStroke, slow: float, fast: float) -> _Line | None:
    """A line through the samples between two speeds; None where there are too few."""
    speed = np.abs(np.interp(FINE, ANGLES, stroke.velocity_m_per_s))
    here = (stroke.samples > 0.0) & (speed >= slow) & (speed <= fast)
    counts = stroke.samples[here]
    if np.count_nonzero(here) < _FEWEST_PLACES or counts.sum() < _FEWEST_SAMPLES:
        return None
    force_n = -stroke.sign * stroke.sums_n[here] / counts
    columns = (
        np.ones(len(counts)),
        speed[here] - np.average(speed[here], weights=counts),
        np.sin(FINE[here]),
    )
    design = np.column_stack(columns) * np.sqrt(counts)[:, None]
    target = force_n * np.sqrt(counts)
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    residual = target - design @ weights
    variance = float(residual @ residual) / max(len(counts) - 3, 1)
    stds = np.sqrt(variance * np.diag(np.linalg.pinv(design.T @ design)))
    pairs = zip(weights.tolist(), stds.tolist(), strict=True)
    return _Line(*(float(value) for pair in pairs for value in pair))
