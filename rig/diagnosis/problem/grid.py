"""A recording on the nodes of a computation: gaps are filled, outliers and held-out nodes apart.

Reference: Hampel, The influence curve and its role in robust estimation, JASA 69 (1974), for the
median absolute deviation as a scale that outliers do not move.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from rig.diagnosis.numerics.smoother import Noise, Smoothed, estimate_noise, smooth
from rig.diagnosis.problem.problem import Track, block_numbers
from rig.diagnosis.recording import Recording

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_OUTLIER = 10.0
"""Times the robust scale of fourth differences from which on a sample can be an outlier: of 1e6
Gaussian samples none gets there."""
_PATTERN = (-2.0 / 3.0, 0.25)
"""Neighbour over middle in the fourth difference of a single false sample, and the tolerance."""
_GAUSS = 1.4826
"""Standard deviation over median absolute deviation of a Gaussian."""
_QUIET = 0.3
"""Share of the RMS velocity below which a block shows too little motion to judge on."""


class Grid(NamedTuple):
    """A recording on nodes.

    Attributes:
        name: Name of the recording.
        t_s: Times of the nodes: measured times and, in gaps, times between, shape (N,).
        heights_m: Measured heights, NaN elsewhere and where outliers were, shape (N, struts).
        fitted: Nodes whose measurements take part in fits, shape (N,).
        kept: Nodes that are held out to be judged on, shape (N,).
        temperature_c: Temperature at the nodes, shape (N,).
        has_temperature: Whether it was measured.
        outliers: Number of heights that were left out as outliers.
    """

    name: str
    t_s: Array
    heights_m: Array
    fitted: Flags
    kept: Flags
    temperature_c: Array
    has_temperature: bool
    outliers: int

    @property
    def step_s(self) -> float:
        """Usual time between nodes."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)

    @property
    def duration_s(self) -> float:
        """Time from first to last node."""
        return float(self.t_s[-1] - self.t_s[0])

    def cut(self, nodes: slice) -> "Grid":
        """The recording at some of the nodes."""
        return self._replace(
            t_s=self.t_s[nodes],
            heights_m=self.heights_m[nodes],
            fitted=self.fitted[nodes],
            kept=self.kept[nodes],
            temperature_c=self.temperature_c[nodes],
        )

    def blocks(self, length_s: float) -> NDArray[np.int64]:
        """Block of each fitted node."""
        return block_numbers(self.t_s, length_s)[self.fitted]


def grid_of(recording: Recording) -> tuple[Grid, NDArray[np.int64]]:
    """A recording on nodes, and which node each sample is, shape (samples,)."""
    t_s, at = _nodes(recording.t_s)
    heights = np.full((len(t_s), recording.heights_m.shape[1]), np.nan)
    heights[at] = recording.heights_m
    outliers = 0
    for column in heights.T:
        false = _outliers(column)
        outliers += int(false.sum())
        column[false] = np.nan
    measured = np.all(np.isfinite(heights), axis=1)
    temperature = np.full(len(t_s), AMBIENT_C)
    if recording.temperature_c is not None:
        temperature = _smooth_temperature(recording.t_s, recording.temperature_c, t_s)
    grid = Grid(
        recording.name,
        t_s,
        heights,
        measured,
        np.zeros_like(measured),
        temperature,
        recording.temperature_c is not None,
        outliers,
    )
    return grid, at


def with_blocks_kept(grid: Grid, length_s: float, every: int) -> Grid:
    """One block of every few held out, spread over the recording where there is motion."""
    numbers = block_numbers(grid.t_s, length_s)
    speed = np.zeros(len(grid.t_s))
    for column in grid.heights_m.T:
        there = np.isfinite(column)
        speed += np.gradient(np.interp(grid.t_s, grid.t_s[there], column[there]), grid.t_s) ** 2
    moving = [
        number
        for number in range(int(numbers[-1]) + 1)
        if float(np.mean(speed[numbers == number])) > _QUIET**2 * float(np.mean(speed))
    ]
    # The first block holds the initial state, which the fit needs.
    chosen = [number for number in moving if number > 0][every // 2 :: every]
    kept = np.isin(numbers, chosen) & grid.fitted
    return grid._replace(kept=kept, fitted=grid.fitted & ~kept)


def smoothed(grid: Grid, reference_m: Array) -> tuple[list[Smoothed], list[Noise]]:
    """Measured less reference heights, smoothed, and their noise: one entry a strut."""
    difference = grid.heights_m - reference_m
    noises = [estimate_noise(grid.t_s, column) for column in difference.T]
    states = [
        smooth(grid.t_s, column, noise) for column, noise in zip(difference.T, noises, strict=True)
    ]
    return states, noises


SmoothMotion = tuple[Track, list[Smoothed], list[Noise]]
"""A smoothed motion, and of each strut its deviations and its sensor's noise."""


def smooth_motion(grid: Grid) -> SmoothMotion:
    """Measured motion, smoothed without any model."""
    middle_m = np.nanmean(grid.heights_m, axis=0)
    found, noises = smoothed(grid, np.broadcast_to(middle_m, grid.heights_m.shape))
    heights_m, velocities_m_per_s = (
        np.column_stack([s.states[:, i] for s in found]) for i in (0, 1)
    )
    none_n = np.zeros(len(grid.t_s))
    motion = Track.of_columns(
        grid.t_s, heights_m + middle_m, velocities_m_per_s, none_n, grid.temperature_c
    )
    return motion, found, noises


def fine_times(t_s: Array, parts: int) -> Array:
    """The nodes with `parts` - 1 even times between each two."""
    share = np.arange(parts) / parts
    fine = t_s[:-1, np.newaxis] + np.diff(t_s)[:, np.newaxis] * share
    return np.append(fine.ravel(), t_s[-1])


def _nodes(t_s: Array) -> tuple[Array, NDArray[np.int64]]:
    steps = np.diff(t_s)
    usual = float(np.median(steps))
    pieces = np.maximum(1, np.rint(steps / usual)).astype(np.int64)
    first = np.repeat(t_s[:-1], pieces)
    part = np.concatenate([np.arange(count) for count in pieces]) if pieces.max() > 1 else 0.0
    nodes = np.append(first + part * np.repeat(steps / pieces, pieces), t_s[-1])
    return np.ascontiguousarray(nodes), np.concatenate([[0], np.cumsum(pieces)]).astype(np.int64)


def _outliers(height_m: Array) -> Flags:
    """Single false samples, by the pattern that they leave in the fourth difference."""
    false = np.zeros(len(height_m), dtype=np.bool_)
    at = np.flatnonzero(np.isfinite(height_m))
    z = height_m[at]
    if len(z) < 16:
        return false
    around = 4.0 * (z[1:-3] + z[3:-1]) - z[:-4] - z[4:]
    error = np.concatenate([[0.0, 0.0], z[2:-2] - around / 6.0, [0.0, 0.0]])
    scale = _GAUSS * float(np.median(np.abs(error)))
    high = np.abs(error[1:-1]) > _OUTLIER * max(scale, 1e-300)
    middle = np.where(high, error[1:-1], 1.0)
    shape, slack = _PATTERN
    alike = (np.abs(error[:-2] / middle - shape) < slack) & (
        np.abs(error[2:] / middle - shape) < slack
    )
    false[at[1:-1][high & alike]] = True
    return false


def _smooth_temperature(own_t_s: Array, temperature_c: Array, t_s: Array) -> Array:
    # Oil warms slowly; the sensor's noise would make the damper tremble.
    if float(np.ptp(temperature_c)) == 0.0:
        return np.full(len(t_s), float(temperature_c[0]))
    states = smooth(own_t_s, temperature_c, estimate_noise(own_t_s, temperature_c)).states
    return np.interp(t_s, own_t_s, states[:, 0])
