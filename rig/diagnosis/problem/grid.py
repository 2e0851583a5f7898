"""Recordings on the nodes of a computation: gaps filled, outliers removed, heights smoothed.

Reference: Hampel, The influence curve and its role in robust estimation, JASA 69 (1974), for the
median absolute deviation as a scale that outliers do not move.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C, Motion
from dart_model.spec import ModelSpec
from rig.channels.measured_quantities import APPLIED_FORCE
from rig.diagnosis.numerics.smoother import Noise, Smoothed, estimate_noise, smooth
from rig.recordings.recording import Recording, RecordingError

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Integers = NDArray[np.int64]

_OUTLIER = 10.0
"""Times the robust scale of fourth differences from which on a sample can be an outlier: of 1e6
Gaussian samples none gets there."""
_PATTERN = (-2.0 / 3.0, 0.25)
"""Neighbour over middle in the fourth difference of a single false sample, and the tolerance."""
_GAUSS = 1.4826
"""Standard deviation over median absolute deviation of a Gaussian."""
_LEAST_SWING = 5.0
"""Motion over sensor noise below which no law can be determined."""
_LEAST_PIECE_S, _LEAST_PIECE_NODES = 0.5, 100
"""The shortest piece between two gaps that is used: its two initial states are fitted to it."""
_QUIET = 0.3
"""Share of the RMS velocity below which a block shows too little motion to evaluate on."""


class Track(NamedTuple):
    """A motion on a grid, along which laws are evaluated.

    Times, applied force (zero where there is none) and temperature are of shape (N,), heights and
    their rates of shape (struts, N).
    """

    t_s: Array
    heights_m: Array
    velocities_m_per_s: Array
    applied_n: Array
    temperature_c: Array

    @classmethod
    def of_columns(
        cls,
        t_s: Array,
        heights_m: Array,
        velocities_m_per_s: Array,
        applied_n: Array,
        temperature_c: Array,
    ) -> "Track":
        """A motion whose heights and velocities are given as columns, shape (N, struts)."""
        rows = t_s, heights_m.T, velocities_m_per_s.T, applied_n, temperature_c
        return cls(*(np.ascontiguousarray(row) for row in rows))

    def cut(self, nodes: slice) -> "Track":
        """The motion at some of the nodes."""
        return Track(*(np.ascontiguousarray(part[..., nodes]) for part in self))


class RecordingGrid(NamedTuple):
    """A recording on nodes.

    Attributes:
        t_s: Times of the nodes: measured times and, in gaps, times between, shape (N,).
        heights_m: Measured heights, NaN elsewhere and where outliers were, shape (N, struts).
        fitted: Nodes whose measurements take part in fits, shape (N,).
        held_out: Nodes that are held out of fits, to evaluate on, shape (N,).
        temperature_c: Temperature at the nodes, shape (N,).
        outliers: Number of heights that were removed as outliers.
        recording: Index of the recording, of which this may be a piece.
    """

    name: str
    t_s: Array
    heights_m: Array
    fitted: Flags
    held_out: Flags
    temperature_c: Array
    has_temperature: bool
    outliers: int
    recording: int = 0

    @property
    def step_s(self) -> float:
        """Usual time between nodes."""
        return float(self.t_s[-1] - self.t_s[0]) / (len(self.t_s) - 1)

    @property
    def duration_s(self) -> float:
        """Time from first to last node."""
        return float(self.t_s[-1] - self.t_s[0])

    def cut(self, nodes: slice) -> "RecordingGrid":
        """The recording at some of the nodes."""
        return self._replace(
            t_s=self.t_s[nodes],
            heights_m=self.heights_m[nodes],
            fitted=self.fitted[nodes],
            held_out=self.held_out[nodes],
            temperature_c=self.temperature_c[nodes],
        )

    @property
    def of_held_out(self) -> "RecordingGrid":
        """The recording with its held-out nodes alone as those that take part in fits."""
        return self._replace(fitted=self.held_out)

    def pieces_between(self, gaps_s: Sequence[tuple[float, float]]) -> list[slice]:
        """Nodes between gaps, given by begin and end of each, without pieces that are too short."""
        begins = [self.t_s[0], *(end for _, end in gaps_s)]
        ends = [*(begin for begin, _ in gaps_s), self.t_s[-1]]
        pieces = [
            slice(*np.searchsorted(self.t_s, (begin, np.nextafter(end, np.inf))).tolist())
            for begin, end in zip(begins, ends, strict=True)
            if end - begin >= _LEAST_PIECE_S
        ]
        return [piece for piece in pieces if piece.stop - piece.start >= _LEAST_PIECE_NODES]

    def blocks(self, length_s: float) -> Integers:
        """Block of each fitted node."""
        return block_numbers(self.t_s, length_s)[self.fitted]

    def with_held_out_blocks(self, length_s: float, every: int) -> "RecordingGrid":
        """The recording with one block in `every` held out, spread over where there is motion."""
        numbers = block_numbers(self.t_s, length_s)
        speed = np.zeros(len(self.t_s))
        for column in self.heights_m.T:
            measured = np.isfinite(column)
            height_m = np.interp(self.t_s, self.t_s[measured], column[measured])
            speed += np.gradient(height_m, self.t_s) ** 2
        moving = [
            number
            for number in range(int(numbers[-1]) + 1)
            if float(np.mean(speed[numbers == number])) > _QUIET**2 * float(np.mean(speed))
        ]
        # The first block holds the initial state, which the fit needs.
        chosen = [number for number in moving if number > 0][every // 2 :: every]
        held_out = np.isin(numbers, chosen) & self.fitted
        return self._replace(held_out=held_out, fitted=self.fitted & ~held_out)

    def residual_states(self, reference_m: Array) -> tuple[list[Smoothed], list[Noise]]:
        """Measured less reference heights, smoothed, and their noise: one entry a strut."""
        difference = self.heights_m - reference_m
        noises = [estimate_noise(self.t_s, column) for column in difference.T]
        states = [
            smooth(self.t_s, column, noise)
            for column, noise in zip(difference.T, noises, strict=True)
        ]
        return states, noises


class SmoothRecording(NamedTuple):
    """A recording on nodes, with its motion smoothed without any model.

    Attributes:
        sample_nodes: Node of each sample, shape (samples,).
        deviations: The smoothed difference from the mean height, one entry a strut.
    """

    recording: Recording
    grid: RecordingGrid
    sample_nodes: Integers
    motion: Track
    deviations: list[Smoothed]
    noises: list[Noise]


def smooth_recording(
    recording: Recording, blocks: tuple[float, int] | None = None
) -> SmoothRecording:
    """A recording on nodes and smoothed; of blocks of a length (s) one in so many is held out."""
    grid, sample_nodes = _place_on_nodes(recording)
    if blocks is not None:
        grid = grid.with_held_out_blocks(*blocks)
    middle_m = np.nanmean(grid.heights_m, axis=0)
    states, noises = grid.residual_states(np.broadcast_to(middle_m, grid.heights_m.shape))
    heights_m, velocities_m_per_s = (
        np.column_stack([s.states[:, i] for s in states]) for i in (0, 1)
    )
    no_force_n = np.zeros(len(grid.t_s))
    motion = Track.of_columns(
        grid.t_s, heights_m + middle_m, velocities_m_per_s, no_force_n, grid.temperature_c
    )
    return SmoothRecording(recording, grid, sample_nodes, motion, states, noises)


def _place_on_nodes(recording: Recording) -> tuple[RecordingGrid, Integers]:
    """A recording on nodes, and the node of each sample, shape (samples,)."""
    t_s, sample_nodes = _nodes(recording.t_s)
    heights = np.full((len(t_s), recording.heights_m.shape[1]), np.nan)
    heights[sample_nodes] = recording.heights_m
    outliers = 0
    for column in heights.T:
        false = _outliers(column)
        outliers += int(false.sum())
        column[false] = np.nan
    measured = np.all(np.isfinite(heights), axis=1)
    temperature = np.full(len(t_s), AMBIENT_C)
    if recording.temperature_c is not None:
        temperature = _smooth_temperature(recording.t_s, recording.temperature_c, t_s)
    grid = RecordingGrid(
        recording.name,
        t_s,
        heights,
        measured,
        np.zeros_like(measured),
        temperature,
        recording.temperature_c is not None,
        outliers,
    )
    return grid, sample_nodes


def _largest_force_std_n(recordings: Sequence[SmoothRecording]) -> float:
    """Largest standard deviation of a measured force; 1 N where none was measured."""
    forces = [r.recording.strut_forces_n for r in recordings]
    inputs = [item for r in recordings for item in r.recording.inputs.values()]
    forces += [item.values for item in inputs if item.quantity is APPLIED_FORCE]
    return max((float(np.nanstd(c)) for c in forces if c is not None), default=1.0)


def strut_motions(spec: ModelSpec, recordings: Sequence[SmoothRecording]) -> tuple[Motion, ...]:
    """What each strut did on the recordings."""
    grids, tracks = [r.grid for r in recordings], [r.motion for r in recordings]
    largest_n = _largest_force_std_n(recordings)
    warm = [grid.temperature_c for grid in grids if grid.has_temperature]
    celsius = (AMBIENT_C, AMBIENT_C)
    if warm:
        celsius = (float(min(w.min() for w in warm)), float(max(w.max() for w in warm)))
    motions: list[Motion] = []
    for i, strut in enumerate(spec.struts):
        z = np.concatenate([t.heights_m[i] for t in tracks])
        w = np.concatenate([t.velocities_m_per_s[i] for t in tracks])
        stroke = float(z.max() - z.min())
        force = strut.stiffness_n_per_m * stroke + strut.damping_n_s_per_m * float(np.std(w))
        motions.append(
            Motion(
                float(z.min()),
                float(z.max()),
                float(np.sqrt(np.mean(w**2))),
                float(np.max(np.abs(w))),
                min(float(np.ptp(t.heights_m[i])) for t in tracks),
                max(grid.duration_s for grid in grids),
                float(np.median([grid.step_s for grid in grids])),
                strut.free_length_m,
                strut.stiffness_n_per_m,
                strut.damping_n_s_per_m,
                1.0,
                force or largest_n,
                celsius,
                (),
            )
        )
    return tuple(motions)


def block_numbers(t_s: Array, length_s: float) -> Integers:
    """Block of each time of a recording, at least two of equal length, shape (N,)."""
    count = max(2, round(float(t_s[-1] - t_s[0]) / length_s))
    share = (t_s - t_s[0]) / float(t_s[-1] - t_s[0])
    return np.minimum((share * count).astype(np.int64), count - 1)


def check_swing(grid: RecordingGrid) -> None:
    """Refuse a recording whose motion hardly exceeds the sensor's noise.

    Raises:
        RecordingError: See above.
    """
    for column in grid.heights_m.T:
        swing = float(np.nanstd(column))
        noise = float(np.sqrt(estimate_noise(grid.t_s, column).variance))
        if swing < _LEAST_SWING * noise:
            raise RecordingError(
                f"{grid.name}: height_m moves by {swing:.3g} m RMS and its noise is {noise:.3g} m, "
                "expected a run with more motion: apply a larger force, or widen the stroke"
            )


def fine_times(t_s: Array, parts: int) -> Array:
    """The nodes with `parts` - 1 even times between each two."""
    share = np.arange(parts) / parts
    fine = t_s[:-1, np.newaxis] + np.diff(t_s)[:, np.newaxis] * share
    return np.append(fine.ravel(), t_s[-1])


def _nodes(t_s: Array) -> tuple[Array, Integers]:
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
