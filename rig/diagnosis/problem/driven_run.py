"""A recording of a force-driven bench, ready to be simulated, and the motion that results."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from rig.diagnosis.numerics.compiled import Trajectory
from rig.diagnosis.numerics.smoother import estimate_noise
from rig.diagnosis.problem.grid import RecordingGrid, Track, fine_times
from rig.diagnosis.problem.mechanism import LinearisedMechanism

Array = NDArray[np.float64]

_STEP_ANGLE = 0.2
"""Longest step as an angle of the model's fastest motion: the integrator errs by 1e-5 a radian."""
_LONGEST_STEP_S = 1.25e-3
"""Longest step where the motion is slow: laws that switch need it."""
_LARGEST_INPUT_NOISE = 0.01
"""Share of an applied force's range from which on its rough part is excitation, not noise."""
_TOP = 0.8
"""Share of the sampled band above which a bench excites nothing: anti-aliasing filters and the
actuator end below, so that only noise is left above."""


class DrivenRun(NamedTuple):
    """A recording as it is simulated.

    Attributes:
        applied_n: Applied force at the nodes, shape (N,).
        fine_n: Applied force at half sub-steps, shape (2 * substeps * (N - 1) + 1,).
        angle: Angle by which the fastest motion turns within such a step.
        cells: Load cells, to evaluate on: their own times, shape (samples,), and the force of each
            strut, shape (samples, struts), NaN for a strut without a cell; None where none is.
    """

    grid: RecordingGrid
    applied_n: Array
    fine_n: Array
    substeps: int
    angle: float
    mechanism: LinearisedMechanism
    cells: tuple[Array, Array] | None

    def cut(self, nodes: slice) -> "DrivenRun":
        """The recording at some of the nodes."""
        fine = slice(2 * self.substeps * nodes.start, 2 * self.substeps * (nodes.stop - 1) + 1)
        grid, cells = self.grid.cut(nodes), self.cells
        if cells is not None:
            there = (cells[0] >= grid.t_s[0]) & (cells[0] <= grid.t_s[-1])
            cells = cells[0][there], cells[1][there]
        return self._replace(
            grid=grid,
            applied_n=self.applied_n[nodes],
            fine_n=self.fine_n[fine],
            mechanism=self.mechanism.cut(nodes),
            cells=cells,
        )

    def finer(self) -> "DrivenRun":
        """The recording with steps half as long."""
        steps = 2 * self.substeps
        spline = CubicSpline(fine_times(self.grid.t_s, steps), self.fine_n)
        fine_n = np.ascontiguousarray(spline(fine_times(self.grid.t_s, 2 * steps)))
        return self._replace(fine_n=fine_n, substeps=steps, angle=0.5 * self.angle)


def track_of(motion: Trajectory, run: DrivenRun) -> Track:
    """A simulated motion as a track along which laws are evaluated."""
    heights_m, velocities, _ = motion
    return Track.of_columns(
        run.grid.t_s, heights_m, velocities, run.applied_n, run.grid.temperature_c
    )


def driven_run(
    grid: RecordingGrid,
    applied: tuple[Array, Array],
    mechanism: LinearisedMechanism,
    fastest: float,
    cells: tuple[Array, Array] | None,
) -> DrivenRun:
    """A recording ready to be simulated; the applied force as a cubic spline between its samples.

    `applied` are times and values of that, `fastest` is the model's largest eigenvalue in rad/s.
    """
    usual = grid.step_s
    substeps = max(1, int(np.ceil(usual / min(_LONGEST_STEP_S, _STEP_ANGLE / fastest) - 1e-9)))
    fine = CubicSpline(*applied)(fine_times(grid.t_s, 2 * substeps))
    fine_n = np.ascontiguousarray(fine, dtype=np.float64)
    return DrivenRun(
        grid,
        np.ascontiguousarray(fine_n[:: 2 * substeps]),
        fine_n,
        substeps,
        fastest * usual / substeps,
        mechanism,
        cells,
    )


def input_noise_n(run: "DrivenRun") -> float:
    """Standard deviation of the applied force's noise and resolution.

    White noise fills the whole band. What is not smooth, but not at the top of the band either, is
    excitation.
    """
    force = run.applied_n - run.applied_n.mean()
    variance = estimate_noise(run.grid.t_s, force).variance
    window = np.hanning(len(force))
    power = np.abs(np.fft.rfft(force * window)) ** 2 / float(window @ window)
    # Lines of a periodogram are exponentially distributed: their median is ln 2 of their mean.
    top = float(np.median(power[int(_TOP * len(power)) :])) / np.log(2.0)
    return min(float(np.sqrt(min(variance, top))), _LARGEST_INPUT_NOISE * float(np.ptp(force)))


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
