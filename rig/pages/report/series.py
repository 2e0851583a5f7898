"""Long series thinned for display, and their spectra and surfaces.

References:
    Welch, The use of fast Fourier transform for the estimation of power spectra, IEEE Trans.
    Audio Electroacoust. 15 (1967).
    Masri and Caughey, A nonparametric identification technique for nonlinear dynamic problems,
    J. Appl. Mech. 46 (1979), for the restoring-force surface.
"""

from collections.abc import Sequence
from dataclasses import fields
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from rig.diagnosis.outcome import Array, FittedSeries, HeldOutSeries

Indices = NDArray[np.intp]

_LONGEST_SEGMENT = 8192
_SHORTEST_SEGMENT = 64
_SEGMENTS = 6
_CELLS = (28, 28)
_EXCERPT_PERIODS = 8.0
_LEAST_EXCERPT_S = 1.0


class Joined(NamedTuple):
    """Recordings one after another, with a row of NaN between two; columns (N, columns)."""

    t_s: Array
    values: Array
    begins: tuple[float, ...]
    names: tuple[str, ...]


class Spectrum(NamedTuple):
    """Amplitude spectral densities, shapes (F,)."""

    frequency_hz: Array
    before_n_per_sqrt_hz: Array
    after_n_per_sqrt_hz: Array


class Surface(NamedTuple):
    """Mean force over cells of height (H,) and velocity (V,); NaN where too few samples."""

    height_m: Array
    velocity_m_per_s: Array
    before_n: Array
    after_n: Array
    samples: Array
    least_count: int


def check_series(series: FittedSeries | HeldOutSeries) -> None:
    """Check that the arrays of a series fit together.

    Raises:
        ValueError: Times do not increase, or an array has another length than they.
    """
    where, shape = f"recording {series.run!r}, strut {series.strut!r}", series.t_s.shape
    if len(shape) != 1 or shape[0] < 2 or not bool(np.all(np.diff(series.t_s) > 0)):
        raise ValueError(f"{where}: t_s: expected two or more times that increase")
    for field in fields(series):
        value: object = getattr(series, field.name)
        if not isinstance(value, str) and np.shape(cast("Array", value)) != shape:
            raise ValueError(f"{where}: {field.name}: expected an array of shape {shape}")


def join(series: Sequence[FittedSeries | HeldOutSeries], columns: Sequence[Array]) -> Joined:
    """Recordings one after another, with columns (N, columns) each; one alone keeps its times."""
    times: list[Array] = []
    values: list[Array] = []
    begins: list[float] = []
    end_s = float(series[0].t_s[0])
    for item, column in zip(series, columns, strict=True):
        if times:
            times.append(np.array([end_s]))
            values.append(np.full((1, column.shape[1]), np.nan))
        begins.append(end_s)
        times.append(item.t_s - item.t_s[0] + end_s)
        values.append(column)
        end_s = float(times[-1][-1])
    names = tuple(item.run for item in series)
    return Joined(np.concatenate(times), np.concatenate(values), tuple(begins), names)


def envelope(values: Array, limit: int) -> Indices:
    """Indices of at most about `limit` points that keep every extreme of a series.

    Of each stretch, the first of its smallest and of its largest values stay. A stretch of NaN
    keeps its first point, so that a gap stays a gap.
    """
    count = len(values)
    if count <= limit:
        return np.arange(count)
    size = -(-count // max(limit // 2, 1))
    rows = -(-count // size)
    padded = np.full(rows * size, np.nan)
    padded[:count] = values
    table = padded.reshape(rows, size)
    first = np.arange(rows) * size
    lowest = first + np.argmin(np.where(np.isnan(table), np.inf, table), axis=1)
    highest = first + np.argmax(np.where(np.isnan(table), -np.inf, table), axis=1)
    ends = np.array([0, count - 1])
    return np.unique(np.concatenate([lowest, highest, ends]))


def cloud(against: Array, values: Array, limit: int) -> Indices:
    """Indices of about `limit` points of a scatter plot: evenly spread, and every extreme.

    Args:
        against: Abscissa, shape (N,).
        values: Ordinates, shape (N, columns); the extremes of each column along `against` stay.
        limit: Number of points.
    """
    count = len(against)
    if count <= limit:
        return np.arange(count)
    # Steps of a sequence with low discrepancy do not beat with a periodic excitation.
    spread = np.floor(np.arange(limit // 2) * 0.6180339887498949 % 1.0 * count).astype(np.intp)
    order = np.argsort(against, kind="stable")
    extremes = [
        order[envelope(column[order], limit // (2 * values.shape[1]))] for column in values.T
    ]
    return np.unique(np.concatenate([spread, *extremes]))


def spectrum(series: Sequence[FittedSeries]) -> Spectrum | None:
    """Welch spectra of the residual, averaged over recordings; None if all are too short."""
    step_s = max(float(np.median(np.diff(item.t_s))) for item in series)
    runs = [_resample(item, step_s) for item in series]
    runs = [run for run in runs if len(run) >= _SHORTEST_SEGMENT]
    if not runs:
        return None
    shortest = min(len(run) for run in runs)
    size = min(max(max(len(run) for run in runs) // _SEGMENTS, _SHORTEST_SEGMENT), shortest)
    size = min(size, _LONGEST_SEGMENT)
    # A constant part is the preload, which the other panels show; here it would leak.
    densities = [
        signal.welch(run, 1.0 / step_s, nperseg=size, axis=0, detrend="constant") for run in runs
    ]
    weights = [len(run) for run in runs]
    mean: Array = np.average([density for _, density in densities], axis=0, weights=weights)
    amplitude = np.sqrt(mean[1:])
    return Spectrum(densities[0][0][1:], amplitude[:, 0], amplitude[:, 1])


def _resample(item: FittedSeries, step_s: float) -> Array:
    residuals = np.column_stack([item.residual_before_n, item.residual_after_n])
    there = np.all(np.isfinite(residuals), axis=1)
    if np.count_nonzero(there) < 2:
        return np.zeros((0, 2))
    count = int((item.t_s[-1] - item.t_s[0]) / step_s) + 1
    even = item.t_s[0] + np.arange(count) * step_s
    columns: list[Array] = [
        np.interp(even, item.t_s[there], column[there]) for column in residuals.T
    ]
    return np.column_stack(columns)


def surface(series: Sequence[FittedSeries]) -> Surface | None:
    """Mean residual over cells of height and velocity; None if nothing moves."""
    height, velocity, before, after = (
        np.concatenate([np.asarray(getattr(item, name), dtype=np.float64) for item in series])
        for name in ("height_m", "velocity_m_per_s", "residual_before_n", "residual_after_n")
    )
    there = np.isfinite(height) & np.isfinite(velocity) & np.isfinite(before) & np.isfinite(after)
    height, velocity = height[there], velocity[there]
    if len(height) < 2 or np.ptp(height) <= 0.0 or np.ptp(velocity) <= 0.0:
        return None
    values = [before[there], after[there], np.ones_like(height)]
    binned = stats.binned_statistic_2d(velocity, height, values, statistic="sum", bins=_CELLS)
    before_n, after_n, count = cast("Array", binned.statistic)
    rows, columns = cast("Array", binned.x_edge), cast("Array", binned.y_edge)
    least = max(3, len(height) // 20_000)
    divisor = np.where(count >= least, count, np.nan)
    heights, velocities = 0.5 * (columns[1:] + columns[:-1]), 0.5 * (rows[1:] + rows[:-1])
    return Surface(heights, velocities, before_n / divisor, after_n / divisor, count, least)


def excerpt(series: HeldOutSeries) -> slice:
    """A few periods of a recording around the largest error of the nominal model."""
    error = np.abs(series.before - series.measured)
    middle = int(np.nanargmax(error)) if np.any(np.isfinite(error)) else 0
    t_s = series.t_s
    length_s = max(_EXCERPT_PERIODS * _period_s(series), _LEAST_EXCERPT_S)
    begin_s = min(max(t_s[middle] - 0.5 * length_s, t_s[0]), max(t_s[-1] - length_s, t_s[0]))
    first, last = np.searchsorted(t_s, [begin_s, begin_s + length_s])
    return slice(int(first), int(last) + 1)


def _period_s(series: HeldOutSeries) -> float:
    there = np.isfinite(series.height_m)
    if np.count_nonzero(there) < 2:
        return 0.0
    deviation = series.height_m[there] - np.mean(series.height_m[there])
    # A crossing counts only after a swing of this size, so that noise about the mean does not.
    swing = 0.3 * float(np.std(deviation))
    side = np.sign(deviation[np.abs(deviation) > swing])
    crossings = int(np.count_nonzero(np.diff(side)))
    return 2.0 * float(series.t_s[-1] - series.t_s[0]) / max(crossings, 1)
