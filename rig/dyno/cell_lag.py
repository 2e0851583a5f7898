"""Lag of a load cell behind the height, from all steps of a record together.

At one speed, a damper pushes as hard while it speeds up as while it slows down, but for its spring.
A force that arrives late is that of an earlier speed: it makes a loop of the curve over velocity,
and a spring rate that rises with the square of the frequency. Along a stroke, the odd part of the
force about mid-stroke is

    F_odd = -k x - k3 x³ - lag dF/dt

in which k and k3 are the spring's, the same in all steps, and dF/dt is computed from the mean
stroke itself. Weighted least squares over all steps gives the lag with its interval; the record is
shifted by it, and the rest is estimated again, until nothing is left of it.

A column of oil with air in it, or a soft mount, delays the force as well, but not by one time in
all steps: it is the longer, the steeper the damping is. Where the steps contradict one lag by more
than chance, none is determined.

Reference: Seber and Lee, Linear Regression Analysis (2003), 3.10, for generalised least squares.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri  # pyright: ignore[reportUnknownVariableType]

from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import ANGLES, Figure, MeanStroke, student_factor
from rig.dyno.strokes import Array

_FARTHEST = 1.2
"""Angle, in rad, up to which a stroke is used: nearer to its ends friction reverses."""

_EVERY = 4
"""Angles of which one is used."""

_MISFIT = 0.002
"""Share of the largest force of a step by which its odd part may differ from the equation."""


_FEWEST_STEPS, _WIDEST = 3, 2.0
"""Steps of different frequency that determine a lag, and ratio of the highest to the lowest."""

_ITERATIONS, _CONVERGED = 8, 0.02
"""Most shifts by what is found, and share of its standard deviation below which no more is needed.
"""

_PER_M2 = 1e4
"""Of the cubic spring rate, so that both rates are of one size: 1/(10 mm)²."""

_CERTAIN = 0.999
"""Quantile of the F distribution beyond which steps contradict one another."""

_NEAR_SHARE, _NEAR_S = 0.15, 5e-5
"""Share of the lag, and time, by which the steps may differ about it whatever their certainty."""


class _Rows(NamedTuple):
    """Whitened equations of a stroke: spring rates and lag, shape (n, 3), and the odd force."""

    design: Array
    target: Array


class CellLag(NamedTuple):
    """A lag in s, and whether all steps agree on it."""

    figure: Figure
    is_one: bool


def estimate_lag(steps: Sequence[DynoStep]) -> CellLag | None:
    """What a record's force lags its height by; None with too few steps or frequencies.

    A step alone does not tell a lag from a force with memory, such as that of a friction damper.
    """
    used = {
        step.peak_speed_m_per_s / step.amplitude_m: both
        for step in steps
        if (both := [it for it in step.strokes if not (it.is_clipped or it.is_constant)])
    }
    strokes = list(used.values())
    if len(used) < _FEWEST_STEPS or max(used) < _WIDEST * min(used):
        return None
    fit = _fit(strokes, 0.0)
    for _ in range(_ITERATIONS):
        if abs(fit.more_s) < _CONVERGED * fit.std_s:
            break
        fit = _fit(strokes, fit.lag_s + fit.more_s)
    half = student_factor(fit.freedom) * fit.std_s
    text = f"hysteresis at equal speeds, {len(strokes)} steps"
    figure = Figure.around(fit.lag_s, half, text)
    return CellLag(figure, _agree(fit))


class _LagFit(NamedTuple):
    """A fit to strokes that are shifted by a lag, and what lag they show in excess of it."""

    by_step: list[list[_Rows]]
    lag_s: float
    more_s: float
    std_s: float
    squares: float
    freedom: int


def _fit(strokes: Sequence[Sequence[MeanStroke]], lag_s: float) -> _LagFit:
    """One lag and one spring for all steps."""
    by_step = [[_rows(stroke, lag_s) for stroke in both] for both in strokes]
    design = np.concatenate([row.design for rows in by_step for row in rows])
    target = np.concatenate([row.target for rows in by_step for row in rows])
    weights, squares, inverse = _solve(design, target)
    freedom = len(target) - design.shape[1]
    std_s = (float(inverse[-1, -1]) * max(1.0, squares / freedom)) ** 0.5
    return _LagFit(by_step, lag_s, float(weights[-1]), std_s, squares, freedom)


def _rows(stroke: MeanStroke, lag_s: float) -> _Rows:
    """Equations of a stroke that is shifted by a lag already."""
    angles = np.flatnonzero((ANGLES > 0.0) & (ANGLES <= _FARTHEST))[_EVERY - 1 :: _EVERY]
    mirrored = len(ANGLES) - 1 - angles
    odd = np.zeros((len(angles), len(ANGLES)))
    odd[np.arange(len(angles)), angles] = 0.5
    odd[np.arange(len(angles)), mirrored] = -0.5
    x_m = odd @ (stroke.height_m - stroke.middle_m)
    # Along a stroke the angle turns with the speed over the amplitude's projection.
    turning = np.abs(stroke.velocity_m_per_s) / (stroke.amplitude_m * np.cos(ANGLES).clip(1e-6))
    force_n = np.interp(ANGLES + turning * lag_s, ANGLES, stroke.force_n)
    rate = np.gradient(force_n, ANGLES) * turning
    design = np.column_stack([-x_m, -(x_m**3) * _PER_M2, -(odd @ rate)])
    misfit_n = _MISFIT * float(np.abs(stroke.force_n).max())
    covariance = odd @ stroke.covariance @ odd.T + misfit_n**2 * np.eye(len(angles))
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    return _Rows(whiten @ design, whiten @ (odd @ force_n))


def _solve(design: Array, target: Array) -> tuple[Array, float, Array]:
    """Weights of least squares, the sum of squares that they leave, and their covariance."""
    weights = np.linalg.lstsq(design, target, rcond=None)[0]
    residual = target - design @ weights
    inverse = np.asarray(np.linalg.pinv(design.T @ design), np.float64)
    return np.asarray(weights, np.float64), float(residual @ residual), inverse


def _agree(fit: _LagFit) -> bool:
    """Whether one lag for all steps explains as much as one for each, or nearly."""
    by_step, count = fit.by_step, len(fit.by_step)
    parts: list[Array] = []
    for number, rows in enumerate(by_step):
        for row in rows:
            own = np.zeros((len(row.target), 2 + count))
            own[:, :2], own[:, 2 + number] = row.design[:, :2], row.design[:, 2]
            parts.append(own)
    design = np.concatenate(parts)
    target = np.concatenate([row.target for rows in by_step for row in rows])
    weights, own_squares, inverse = _solve(design, target)
    freedom = len(target) - design.shape[1]
    scale = max(1.0, own_squares / freedom)
    by_chance = float(fdtri(count - 1, freedom, _CERTAIN))  # pyright: ignore[reportUnknownArgumentType]
    if fit.squares - own_squares <= by_chance * (count - 1) * scale:
        return True
    # Weighted by what each step says of it.
    information = 1.0 / np.diag(inverse)[2:]
    apart_s = float(np.sqrt(information @ (weights[2:] - fit.more_s) ** 2 / information.sum()))
    return apart_s <= max(_NEAR_SHARE * abs(fit.lag_s), _NEAR_S)
