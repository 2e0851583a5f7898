"""Where along stroke and speed recordings show an effect.

Reference: Ljung, System Identification (1999), 13.2: data inform of where they have been.
"""

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.outcome import ActingRange, Interval
from rig.diagnosis.problem.problem import rms

Array = NDArray[np.float64]

_BINS = 40
"""Parts of the recorded range, of equal width: an end is known to a fortieth of it."""
_SHOWN = 3.0
"""Standard deviations from which on a force is shown in a part of the range."""
_LEAST = 0.02
"""Share of an effect's largest force below which it does not act: rounded laws never vanish."""


def find_acting_range(
    heights_m: Array, velocities_m_per_s: Array, force_n: Array, residual_n: Array
) -> ActingRange:
    """The parts of the recorded stroke and speed in which an effect's force is shown.

    In a part of the range, its RMS has to exceed that of the residual force's mean over the visits:
    the residual of one visit is correlated, those of two are not.

    Args:
        heights_m: Heights of its strut along all recordings, shape (N,).
        velocities_m_per_s: Their rates.
        force_n: Its force there.
        residual_n: Residual force of the corrected model there; NaN where it is not known.
    """
    noise_n = rms(residual_n)
    return ActingRange(
        _shown_parts(heights_m, force_n, noise_n),
        _shown_parts(velocities_m_per_s, force_n, noise_n),
        _range(heights_m),
        _range(velocities_m_per_s),
    )


def _range(coordinate: Array) -> Interval:
    return float(coordinate.min()), float(coordinate.max())


def _shown_parts(coordinate: Array, force_n: Array, noise_n: float) -> tuple[Interval, ...]:
    low, high = _range(coordinate)
    edges = np.linspace(low, high, _BINS + 1)
    bins = np.clip(np.searchsorted(edges, coordinate, side="right") - 1, 0, _BINS - 1)
    samples = np.bincount(bins, minlength=_BINS)
    sizes = np.sqrt(np.bincount(bins, force_n**2, _BINS) / np.maximum(samples, 1))
    entered = bins[np.flatnonzero(np.diff(bins, prepend=-1))]
    visits = np.bincount(entered, minlength=_BINS)
    is_shown = (sizes * np.sqrt(visits) > _SHOWN * noise_n) & (sizes > _LEAST * sizes.max())
    turns = np.flatnonzero(np.diff(np.concatenate([[False], is_shown, [False]]).astype(np.int8)))
    return tuple(
        (float(edges[first]), float(edges[last])) for first, last in turns.reshape(-1, 2).tolist()
    )
