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
from rig.dyno.stroke_force import ForceRange, MeanStroke
from rig.dyno.strokes import Array
from rig.recordings.clipping import find_sudden_plateaus
from rig.recordings.stretches import find_stretches

_LARGEST_N = 1e8
"""Ten times what the largest damper machines of civil engineering reach."""

_LARGEST_STROKE_M = 5.0
"""Twice the stroke of the largest seismic dampers."""

_WINDOW = 7
"""Samples of the running median: a spike of three is its minority."""

_LONGEST = 3
"""Samples of a spike at most."""

_USUAL, _BEYOND = 0.995, 4.0
"""Quantile of the distances from the running median, and how many times of it a spike has: the
peaks of a sine of 16 samples a cycle are an eighth of the samples, and a spike is rare."""

_MOST_SPIKES = 20
"""Spikes of a record: more of them are knocks of the damper, or a cell that cannot be used."""

_TOP_SHARE, _TOP_STDS = 0.004, 4.0
"""Share of a force, and standard deviations, within which a mean stroke is at its level."""

_FASTEST = 0.9
"""Share of the peak speed above which the median of a mean stroke is the level it may stay at."""

_BUT_CORNERS, _ROUNDED = 0.95, 0.01
"""Quantile of a mean stroke's forces that counts as its largest, and share of a level by which that
may exceed it: a spline overshoots at a corner."""

_LEAST_PLATEAU = 0.05
"""Share of the peak speed over which a force has to stay at its level."""

_CORNER = 0.15
"""Share of a plateau's speeds at its entry where the mean stroke rounds the corner."""

_FLAT = 0.03
"""Slope at the level over the slope below it, which a clipped cell stays under with its 95 %
interval. Of digressive dampers the slope above the knee is a twentieth to a third of that below."""

_SLOWEST_ENTRY = 0.1
"""Share of the peak speed below which a level that is reached is that of dry friction."""

_BELOW = (0.7, 0.95)
"""Shares of the speed at which a level is reached, between which the slope below it is taken."""


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
    beside = np.pad(values, 1, mode="edge")
    spikes: list[slice] = []
    for found in find_stretches(distance > least):
        # It leaves one neighbour and returns to the other; a jump to another level does not.
        leaves = float(values[found.start] - beside[found.start])
        returns = float(values[found.stop - 1] - beside[found.stop + 1])
        is_short = found.stop - found.start <= _LONGEST
        if is_short and leaves * returns > 0.0 and min(abs(leaves), abs(returns)) > least:
            spikes.append(found)
    return spikes if len(spikes) <= _MOST_SPIKES else []


def find_plateau_limits(force_n: Array) -> ForceRange:
    """Levels at which a force (N,) stays sample by sample: it has no noise behind the clipping."""
    limits = {plateau.extreme: plateau.limit for plateau in find_sudden_plateaus(force_n)}
    return ForceRange(limits.get("lowest", -math.inf), limits.get("highest", math.inf))


def find_level_limits(strokes: Sequence[MeanStroke]) -> ForceRange:
    """Levels that the mean strokes of a record reach at speed and do not exceed."""
    found = {sign: _level([it for it in strokes if it.sign == sign]) for sign in (-1, 1)}
    # Compression pushes: its largest force is the highest, that of rebound the lowest.
    return ForceRange(-found[1], found[-1])


def _level(strokes: Sequence[MeanStroke]) -> float:
    """Damping force beyond which no stroke of a direction shows anything; infinite if one does."""
    levels = [level for stroke in strokes if (level := _level_of(stroke)) is not None]
    if not levels:
        return math.inf
    largest = max(
        float(np.quantile(-stroke.sign * stroke.force_n, _BUT_CORNERS)) for stroke in strokes
    )
    is_one = max(levels) - min(levels) <= _TOP_SHARE * abs(levels[0])
    return min(levels) if is_one and largest <= (1.0 + _ROUNDED) * max(levels) else math.inf


def _level_of(stroke: MeanStroke) -> float | None:
    """The level that a mean stroke stays at about its largest speed, if it does."""
    speed = np.abs(stroke.velocity_m_per_s)
    force = -stroke.sign * stroke.force_n
    top = int(np.argmax(speed))
    peak = float(speed[top])
    level = float(np.median(force[speed >= _FASTEST * peak]))
    half = _TOP_SHARE * abs(level) + _TOP_STDS * float(stroke.covariance[top, top]) ** 0.5
    stretches = find_stretches(force >= level - half)
    inside = next((it for it in stretches if it.start <= top < it.stop), None)
    if stroke.is_constant or inside is None:
        return None
    entry = float(max(speed[inside.start], speed[inside.stop - 1]))
    if entry < _SLOWEST_ENTRY * peak or peak - entry < _LEAST_PLATEAU * peak:
        return None
    # The slope by speed is the mean of speeding up and slowing down, in which a spring cancels.
    at = np.zeros(len(speed), np.bool_)
    at[inside] = speed[inside] >= entry + _CORNER * (peak - entry)
    about = np.where(at, speed - float(speed[at].mean()), 0.0)
    row = about / float(about @ about)
    slope = float(row @ force)
    std = float(row @ stroke.covariance @ row) ** 0.5
    below = _slope_below(speed, force, entry)
    is_flat = below > 0.0 and slope + 1.96 * std <= _FLAT * below
    return float(force[at].mean()) if is_flat else None


def _slope_below(speed: Array, force: Array, entry: float) -> float:
    """Slope of force over speed below some speed, mean of both halves of the stroke."""
    low, high = (share * entry for share in _BELOW)
    top = int(np.argmax(speed))
    slopes: list[float] = []
    for half in (slice(None, top + 1), slice(top, None)):
        order = np.argsort(speed[half])
        at_low, at_high = np.interp((low, high), speed[half][order], force[half][order])
        slopes.append(float(at_high - at_low) / (high - low))
    return float(np.mean(slopes))
