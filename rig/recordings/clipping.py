"""Channels that are clipped: plateaus at an end of their range, which they enter at speed.

A recording with long plateaus is refused (`rig.recordings.recording_checks`); sudden ones are a
warning beside dyno figures (`rig.dyno.quality`).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_LONGEST_PLATEAU = 0.002
"""Share of the samples that a channel that is not clipped may stay at its extreme value."""
_STANDS = 4
"""Samples in a row at an extreme value that are no coincidence."""
_FULL_SPEED = 0.3
"""Share of its usual speed with which a clipped channel enters a plateau; a channel that comes to
rest slows down before."""
_COARSE = 50.0
"""Steps of its resolution that a channel spans at least, for a plateau to mean anything."""
_JUMP = 4.0
"""Steps of its resolution by which a clipped channel enters a plateau: the flat top of a channel in
steps is one step above its sides."""


class Plateaus(NamedTuple):
    """Where a channel stays at its `lowest` or `highest` value: first samples and lengths, (P,)."""

    extreme: str
    limit: float
    firsts: NDArray[np.int64]
    lengths: NDArray[np.int64]


def _find_plateaus(values: Array) -> list[Plateaus]:
    plateaus: list[Plateaus] = []
    for extreme, limit in (("lowest", float(values.min())), ("highest", float(values.max()))):
        found = find_stretches(values == limit)
        firsts = np.array([stretch.start for stretch in found], np.int64)
        lengths = np.array([stretch.stop - stretch.start for stretch in found], np.int64)
        plateaus.append(Plateaus(extreme, limit, firsts, lengths))
    return plateaus


def find_sudden_plateaus(values: Array) -> list[Plateaus]:
    """Plateaus that a channel (N,), all finite, enters with a jump, which deserve a warning."""
    steps = np.abs(np.diff(values))
    if not np.any(steps):
        return []
    resolution = float(np.min(steps[steps > 0.0]))
    sudden: list[Plateaus] = []
    for plateaus in _find_plateaus(values):
        firsts, lengths = plateaus.firsts, plateaus.lengths
        long = (lengths >= _STANDS) & (firsts > 0)
        entered = steps[firsts[long] - 1]
        if len(entered) and float(np.median(entered)) > _JUMP * resolution:
            sudden.append(plateaus._replace(firsts=firsts[long], lengths=lengths[long]))
    return sudden


def find_long_plateaus(values: Array) -> Plateaus | None:
    """Plateaus at an end of the range that make a channel (N,), all finite, useless, or None."""
    levels = np.diff(np.unique(values))
    if len(levels) == 0 or float(np.ptp(values)) <= _COARSE * float(levels.min()):
        return None
    usual = float(np.mean(np.abs(np.diff(values))))
    for plateaus in _find_plateaus(values):
        if int(np.max(plateaus.lengths)) <= max(20, _LONGEST_PLATEAU * len(values)):
            continue
        long = (plateaus.lengths > _STANDS) & (plateaus.firsts > 0)
        speeds = [
            float(np.mean(np.abs(np.diff(values[max(first - 4, 0) : first + 1]))))
            for first in plateaus.firsts[long]
        ]
        if speeds and float(np.median(speeds)) >= _FULL_SPEED * usual:
            return plateaus
    return None
