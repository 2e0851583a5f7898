"""A recording of a driven bench, ready to be simulated, and the motion that results."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from rig.diagnosis.numerics.march import Trajectory
from rig.diagnosis.problem.drive import Drive
from rig.diagnosis.problem.grid import RecordingGrid, Track, fine_times
from rig.diagnosis.problem.mechanism import LinearisedMechanism

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_STEP_ANGLE = 0.2
"""Longest step as an angle of the model's fastest motion: the integrator errs by 1e-5 a radian."""
_LONGEST_STEP_S = 1.25e-3
"""Longest step where the motion is slow: laws that switch need it."""


class LoadCells(NamedTuple):
    """Load cells of a driven bench, which models are evaluated on.

    Attributes:
        t_s: Their own times, shape (samples,).
        forces_n: Force of each strut, shape (samples, struts); NaN for a strut without a cell.
        delays_s: Delays that these times are free of already, shape (struts,).
    """

    t_s: Array
    forces_n: Array
    delays_s: Array

    def cut(self, first_s: float, last_s: float) -> "LoadCells":
        """Their samples from one time to another."""
        there = (self.t_s >= first_s) & (self.t_s <= last_s)
        return self._replace(t_s=self.t_s[there], forces_n=self.forces_n[there])


class DrivenRun(NamedTuple):
    """A recording as it is simulated.

    Attributes:
        drive: What drove it.
        strides: Nodes between which it is simulated in `substeps` each, shape (S + 1,): all of
            them, or for a faster simulation one in so many.
        fine: Input vector at half sub-steps, shape (2 * substeps * S + 1, inputs).
        reference_m: Positions of moved bodies there about which the mechanism is linear, shape (as
            above, motions): along its table those that were measured, else zero.
        moved: What moved bodies add to heights and to their rates there, shape (as above, 2,
            struts); empty where no body is moved.
        angle: Angle by which the fastest motion turns within such a step.
        cells: Load cells; None where no strut has one.
    """

    grid: RecordingGrid
    drive: Drive
    strides: Integers
    fine: Array
    reference_m: Array
    moved: Array
    substeps: int
    angle: float
    mechanism: LinearisedMechanism
    cells: LoadCells | None

    @property
    def fastest(self) -> float:
        """Largest eigenvalue of the model, by size, in rad/s."""
        return self.angle * self.substeps * (len(self.strides) - 1) / self.grid.duration_s

    @property
    def inputs(self) -> Array:
        """Input vector at the nodes, shape (N, inputs)."""
        return np.ascontiguousarray(self.fine[:: 2 * self.substeps])

    @property
    def applied_n(self) -> Array:
        """Applied force of laws at the nodes, shape (N,)."""
        return self.drive.applied_n(self.inputs)

    @property
    def moved_at_nodes(self) -> Array:
        """What moved bodies add to heights and their rates at the nodes, shape (N, 2, struts)."""
        if not len(self.moved):
            return np.zeros((len(self.grid.t_s), 2, self.grid.heights_m.shape[1]))
        return self.moved[:: 2 * self.substeps]

    def cut(self, nodes: slice) -> "DrivenRun":
        """The recording at some of the nodes."""
        fine = slice(2 * self.substeps * nodes.start, 2 * self.substeps * (nodes.stop - 1) + 1)
        grid, cells = self.grid.cut(nodes), self.cells
        if cells is not None:
            cells = cells.cut(grid.t_s[0], grid.t_s[-1])
        return self._replace(
            grid=grid,
            strides=np.arange(len(grid.t_s)),
            fine=self.fine[fine],
            reference_m=self.reference_m[fine],
            moved=self.moved[fine],
            mechanism=self.mechanism.cut(nodes),
            cells=cells,
        )

    def held_to(self, motion: Track, rate_rad_per_s: float) -> "DrivenRun":
        """The recording of a model that is held to a motion, as `LinearisedMechanism.held_to`."""
        heights_m, velocities = motion.heights_m.T, motion.velocities_m_per_s.T
        mechanism = self.mechanism.held_to(
            heights_m, velocities, self.moved_at_nodes, rate_rad_per_s
        )
        return self._replace(mechanism=mechanism)

    def finer(self) -> "DrivenRun":
        """The recording with steps half as long."""
        steps = 2 * self.substeps
        before_s, times = (fine_times(self.grid.t_s, by * steps) for by in (1, 2))
        fine, reference = (
            np.ascontiguousarray(CubicSpline(before_s, values)(times))
            for values in (self.fine, self.reference_m)
        )
        finer = self._replace(reference_m=reference, substeps=steps, angle=0.5 * self.angle)
        return finer.driven_by(fine)

    def before_delays(self, delays_s: Array) -> "DrivenRun":
        """The recording with its inputs as they were, measured with a delay each, (inputs,)."""
        if not np.any(delays_s):
            return self
        times = fine_times(self.grid.t_s[self.strides], 2 * self.substeps)
        return self.driven_by(np.ascontiguousarray(self.drive.before_delays(times, delays_s)))

    def disturbed(self, noise: Array) -> "DrivenRun":
        """The recording with other inputs, the difference given as `fine`."""
        return self.driven_by(self.fine + noise)

    def driven_by(self, fine: Array) -> "DrivenRun":
        """The recording with another input vector, as `fine`."""
        moved = _moved(self.drive, self.mechanism, self.strides, fine, self.reference_m)
        return self._replace(fine=fine, moved=moved)

    def in_strides(self, every: int) -> "DrivenRun":
        """The recording simulated in steps of so many nodes, which show its forces smoothed."""
        strides = np.append(np.arange(0, len(self.grid.t_s) - 1, every), len(self.grid.t_s) - 1)
        times = fine_times(self.grid.t_s[strides], 2)
        drive = self.drive.smoothed(self.grid.t_s, self.grid.t_s[strides])
        fine = np.ascontiguousarray(drive.at(times), dtype=np.float64)
        reference = _reference(self.mechanism, drive, fine)
        return self._replace(
            drive=drive,
            strides=strides,
            fine=fine,
            reference_m=reference,
            moved=_moved(drive, self.mechanism, strides, fine, reference),
            substeps=1,
            angle=self.angle * self.substeps * every,
        )


def track_of(motion: Trajectory, run: DrivenRun) -> Track:
    """A simulated motion as a track along which laws are evaluated."""
    heights_m, velocities, _ = motion
    return Track.of_columns(
        run.grid.t_s, heights_m, velocities, run.applied_n, run.grid.temperature_c
    )


def driven_run(
    grid: RecordingGrid,
    drive: Drive,
    mechanism: LinearisedMechanism,
    fastest: float,
    cells: LoadCells | None,
) -> DrivenRun:
    """A recording ready to be simulated.

    `fastest` is the model's largest eigenvalue in rad/s.
    """
    usual, strides = grid.step_s, np.arange(len(grid.t_s))
    substeps = max(1, int(np.ceil(usual / min(_LONGEST_STEP_S, _STEP_ANGLE / fastest) - 1e-9)))
    fine = np.ascontiguousarray(drive.at(fine_times(grid.t_s, 2 * substeps)), dtype=np.float64)
    reference = _reference(mechanism, drive, fine)
    return DrivenRun(
        grid,
        drive,
        strides,
        fine,
        reference,
        _moved(drive, mechanism, strides, fine, reference),
        substeps,
        fastest * usual / substeps,
        mechanism,
        cells,
    )


def _reference(mechanism: LinearisedMechanism, drive: Drive, fine: Array) -> Array:
    """Positions about which a mechanism is linear, as `DrivenRun.reference_m`."""
    if mechanism.is_tabulated:
        return fine[:, drive.moved]
    return np.zeros((len(fine), len(drive.moved)))


def _moved(
    drive: Drive, mechanism: LinearisedMechanism, strides: Integers, fine: Array, reference: Array
) -> Array:
    """What moved bodies add to heights and to their rates, as `DrivenRun.moved`."""
    if not drive.moved:
        return np.empty((0, 2, mechanism.heights_m.shape[1]))
    jacobian = mechanism.moved
    if mechanism.is_tabulated:
        jacobian = jacobian[strides]
        share = np.linspace(0.0, len(jacobian) - 1.0, len(fine))
        before = np.minimum(share.astype(np.int64), len(jacobian) - 2)
        share = (share - before)[:, np.newaxis, np.newaxis]
        jacobian = jacobian[before] + share * (jacobian[before + 1] - jacobian[before])
    positions = fine[:, drive.moved] - reference
    rates = fine[:, [first + 1 for first in drive.moved]]
    both = np.stack([positions, rates], axis=1)
    return np.ascontiguousarray(both @ np.swapaxes(jacobian, 1, 2))


def first_motion(grid: RecordingGrid) -> tuple[Array, Array]:
    """Heights and velocities at a recording's start, by a parabola through its first samples."""
    count = min(len(grid.t_s), max(20, int(0.05 / grid.step_s)))
    heights: list[float] = []
    velocities: list[float] = []
    t = grid.t_s[:count] - grid.t_s[0]
    for column in grid.heights_m[:count].T:
        measured = np.isfinite(column)
        polynomial = np.polynomial.Polynomial.fit(t[measured], column[measured], 2)
        heights.append(float(polynomial(0.0)))
        velocities.append(float(polynomial.deriv()(0.0)))
    return np.array(heights), np.array(velocities)
