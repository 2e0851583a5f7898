"""A strut whose motion is given: its residual is the load-cell force that its law does not explain.

Nothing is simulated: the motion is smoothed over the whole recording, and a law's force along it
takes one pass. What is left of initial states are the laws' internal ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import Bench
from dart_model.spec import ModelSpec
from rig.diagnosis.numerics.smoother import estimate_noise
from rig.diagnosis.problem import linear_part, track
from rig.diagnosis.problem.grid import Grid, SmoothMotion
from rig.diagnosis.problem.problem import (
    Candidate,
    Flags,
    Integers,
    Parts,
    Problem,
    ResidualForces,
    Segment,
    Track,
    block_numbers,
    placed,
    state_scales,
)
from rig.diagnosis.recording import Recording

Array = NDArray[np.float64]

_UNCERTAIN = 1.5
"""Times its median from which on the deviation of the smoothed velocity is that of a recording's
end, where nothing follows to smooth with."""


class Drive(NamedTuple):
    """A prescribed motion and the forces that it took.

    Attributes:
        grid: Nodes of the recording.
        along: The smoothed motion at the nodes.
        cells_n: Load cells at the nodes, shape (struts, N); NaN where a strut has none.
        certain: Nodes at which the motion is well known, shape (N,).
        height_noise_m: Standard deviation of each height's noise, shape (struts,).
        velocity_noise_m_per_s: Of the smoothed velocity, shape (struts,).
        cell_noise_n: Of each load cell, shape (struts,).
    """

    grid: Grid
    along: Track
    cells_n: Array
    certain: Flags
    height_noise_m: Array
    velocity_noise_m_per_s: Array
    cell_noise_n: Array

    @property
    def fitted(self) -> Flags:
        """Nodes that take part in fits."""
        return self.grid.fitted & self.certain


def _cut(drive: Drive, nodes: slice) -> Drive:
    return drive._replace(
        grid=drive.grid.cut(nodes),
        along=drive.along.cut(nodes),
        cells_n=drive.cells_n[:, nodes],
        certain=drive.certain[nodes],
    )


def drive_of(grid: Grid, at: Integers, recording: Recording, smooth: SmoothMotion) -> Drive:
    """A recording with load cells as a prescribed motion.

    Args:
        grid: Its nodes.
        at: Which node each sample is.
        recording: The recording.
        smooth: Its motion.
    """
    motion, states, noises = smooth
    spread = np.array([s.deviations[:, 1] for s in states])
    cells = np.full((len(states), len(grid.t_s)), np.nan)
    noise_n = np.full(len(states), np.nan)
    given = recording.strut_forces_n
    for i in range(len(states)):
        if given is not None and np.all(np.isfinite(given[:, i])):
            cells[i] = np.interp(grid.t_s, grid.t_s[at], given[:, i])
            noise_n[i] = np.sqrt(estimate_noise(grid.t_s, cells[i]).variance)
    return Drive(
        grid,
        motion,
        cells,
        np.all(spread < _UNCERTAIN * np.median(spread, axis=1, keepdims=True), axis=0),
        np.sqrt([noise.variance for noise in noises]),
        np.median(spread, axis=1),
        noise_n,
    )


def noise_of(spec: ModelSpec, drives: Sequence[Drive]) -> Array:
    """Standard deviation of each load cell's residual (struts,); NaN where a strut has no cell.

    Noise of the velocity passes through the damping, noise of the height through the spring.
    """
    slopes = np.array([(s.stiffness_n_per_m, s.damping_n_s_per_m) for s in spec.struts])
    motion_n = [
        np.hypot(slopes[:, 0] * d.height_noise_m, slopes[:, 1] * d.velocity_noise_m_per_s)
        for d in drives
    ]
    cells_n = [d.cell_noise_n for d in drives]
    return np.median(np.hypot(motion_n, cells_n), axis=0)


@dataclass(frozen=True, eq=False)
class Prescribed(Problem):
    """A model held against recordings of a displacement-controlled bench.

    Attributes:
        drives: The recordings.
        noise_n: Standard deviation of each load cell's residual, shape (struts,).
    """

    bench: ClassVar[Bench] = "motion_given"
    drives: tuple[Drive, ...]
    noise_n: Array

    @property
    def recordings(self) -> int:
        """Number of recordings."""
        return len(self.drives)

    def fitted(self, k: int) -> Flags:
        """Nodes of a recording that take part in fits, shape (N,)."""
        return self.drives[k].fitted

    def cut(self, pieces: Sequence[tuple[int, slice]]) -> "Prescribed":
        """The same of pieces of recordings."""
        return replace(self, drives=tuple(_cut(self.drives[k], nodes) for k, nodes in pieces))

    @cached_property
    def _celled(self) -> Integers:
        return np.flatnonzero(np.isfinite(self.noise_n))

    def _rows(self, k: int) -> Integers:
        return np.flatnonzero(self.drives[k].fitted)

    def blocks(self, k: int) -> Integers:
        """Block of each row of a recording's residual."""
        numbers = block_numbers(self.drives[k].grid.t_s, self.block_s)[self._rows(k)]
        return np.repeat(numbers, len(self._celled))

    def start(self, k: int, candidate: Candidate) -> Array:
        """Internal states at zero."""
        del k
        return np.zeros(len(state_scales(placed(self, candidate))[0]))

    def start_scales(self, candidate: Candidate) -> tuple[Array, Flags]:
        """The laws' own scales."""
        return state_scales(placed(self, candidate))

    def states(self, k: int, candidate: Candidate, parts: Parts) -> Array:
        """Internal states at the beginning of a recording."""
        del candidate
        return parts.starts[k]

    def _missed_n(self, k: int, candidate: Candidate, parts: Parts) -> Array:
        drive = self.drives[k]
        forces = track.strut_forces(self, candidate, parts, drive.along, parts.starts[k])
        return drive.cells_n - forces

    def residual(self, k: int, candidate: Candidate, parts: Parts) -> Array | None:
        """Load cells less the model's forces over the noise, at the fitted nodes, flat."""
        missed = self._missed_n(k, candidate, parts)
        return self._whitened(missed, self._rows(k))

    def _whitened(self, forces: Array, rows: Integers) -> Array:
        return (forces[np.ix_(self._celled, rows)].T / self.noise_n[self._celled]).ravel()

    def floor_level(self, candidate: Candidate, parts: Parts) -> float:
        """One: noise of the motion is in what whitens the residual."""
        del candidate, parts
        return 1.0

    def residual_forces(self, k: int, candidate: Candidate, parts: Parts) -> ResidualForces | None:
        """Load cells less the model's forces along the smoothed motion."""
        missed = self._missed_n(k, candidate, parts)
        deviation = np.broadcast_to(self.noise_n[:, np.newaxis], missed.shape)
        return ResidualForces(self.drives[k].grid.name, self.drives[k].along, missed, deviation)

    def segments(
        self, candidate: Candidate, parts: Parts, most_samples: int, most_thinned: int
    ) -> tuple[Segment, ...]:
        """The regression about a model's force along the motion."""
        nodes = [len(drive.grid.t_s) for drive in self.drives]
        found: list[Segment] = []
        for k, drive in enumerate(self.drives):
            missed = self._missed_n(k, candidate, parts)
            cuts = track.pieces(nodes[k], sum(nodes), most_samples, most_thinned)
            found += [self._segment(k, missed, cut) for cut in cuts if np.any(drive.fitted[cut])]
        return tuple(found)

    def _segment(self, k: int, missed: Array, cut: slice) -> Segment:
        drive = self.drives[k]
        whole = drive.along
        along = whole.cut(cut)
        rows = np.flatnonzero(drive.fitted[cut])
        numbers = block_numbers(whole.t_s, self.block_s)[cut][rows]

        def respond(strut: int, force: Array) -> Array:
            forces = np.zeros((len(self.noise_n), len(force)))
            forces[strut] = force
            return self._whitened(forces, rows)

        columns = [
            respond(
                p.strut,
                linear_part.strut_force(
                    p.kind, along.heights_m[p.strut], along.velocities_m_per_s[p.strut],
                    self.motions[p.strut],
                ),
            )
            for p in self.linear
        ]  # fmt: skip
        target = self._whitened(missed[:, cut], rows)
        return Segment(
            along,
            along,
            None if cut == slice(0, len(whole.t_s), cut.step) else (whole, whole),
            respond,
            target,
            np.column_stack(columns),
            np.zeros((len(target), 0)),
            np.repeat(numbers - numbers[0], len(self._celled)),
        )
