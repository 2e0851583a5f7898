"""Knee and slopes of a damper's force over speed, from all steps together.

Force over speed is described by two straight lines that meet at the knee, where the valves open.
Each step gives the force at the speeds that its strokes pass through, as the mean of speeding up
and slowing down, in which a straight spring and a small lag cancel; the bend of a gas spring is
removed, as the slowest step shows it. Slow steps determine the line below the
knee, fast ones the line above; the covariances of the mean strokes are their weights.

Reference: Seber and Wild, Nonlinear Regression (1989), 9, for segmented regression and the interval
of a joint from the sum of squares.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag  # pyright: ignore[reportUnknownVariableType]

from rig.dyno.stroke_force import ANGLES, Figure, MeanStroke
from rig.dyno.strokes import Array

_STRAIGHT = 1.25
"""Ratio of the slopes below and above, under which there is no knee."""

_CHANCE = 10.83
"""Fall of the sum of squares by a bend that straight curves reach once in a thousand (chi-squared
with one degree of freedom)."""

_QUANTILE = 3.84
"""Rise of the sum of squares at the ends of a 95 % interval."""

_POINTS, _SLOWEST_SHARE, _FASTEST_SHARE = 32, 0.1, 0.985
"""Speeds at which a stroke is used, and shares of its largest between which they lie. In the slower
part of a fast stroke, just behind the turning point, friction reverses and the mean stroke is
smoother than the force."""

_SAMPLES = 4.0
"""Samples from the turning point on within which no speed is used, for the same reason."""

_SLOWEST_M_PER_S, _LEAST_SHARE = 5e-3, 0.5
"""Speed, or share of the largest one if that is slower, below which dry friction that builds up
over a travel takes part."""

_MISFIT = 0.005
"""Share of the largest force by which a mean curve may bend between the samples of its strokes."""

_KNEES = 240
"""Knees that are tried, evenly spread by their logarithm: over two decades 2 % apart."""

_END, _BEND = 1.4, 0.2
"""Angle, in rad, at which a spring's change over half a stroke is read, and how much of it is bent:
a gas column of twice the stroke has a fifth."""

_FEWEST = 6
"""Speeds from which on a knee is looked for: two lines that meet have four parameters."""

_LOWEST, _HIGHEST = 1.15, 0.9
"""Times the slowest and share of the fastest speed between which a knee is searched."""


class Knee(NamedTuple):
    """Where force over speed bends, and its slopes below and above it, in N·s/m."""

    speed_m_per_s: Figure
    below_n_s_per_m: Figure
    above_n_s_per_m: Figure


def find_knee(
    strokes: Sequence[MeanStroke], spring: Callable[[Array], Array] | None
) -> Knee | None:
    """The knee of one direction, from the mean strokes of its steps; None where there is none.

    `spring` gives the spring force at heights, which is removed from each stroke; None where it is
    not known.
    """
    if not strokes:
        return None
    points = [_points(stroke, spring) for stroke in strokes]
    speed, force_n = (np.concatenate([item[i] for item in points]) for i in (0, 1))
    if len(speed) < _FEWEST:
        return None
    whitening = _whitening([covariance for *_, covariance in points], force_n)
    target = whitening @ force_n
    lines = whitening @ np.column_stack([np.ones_like(speed), speed])
    tried = np.geomspace(_LOWEST * float(speed.min()), _HIGHEST * float(speed.max()), _KNEES)
    freedom = len(target) - 4
    if tried[-1] <= tried[0]:
        return None
    bends = whitening @ np.maximum(speed[:, None] - tried, 0.0)
    fits = [_fit(np.column_stack([lines, bend]), target) for bend in bends.T]
    sums = np.array([squares for _, squares in fits])
    best = int(np.argmin(sums))
    weights, least = fits[best]
    scale = max(1.0, least / freedom)
    below, above = abs(float(weights[1])), abs(float(weights[1] + weights[2]))
    straight = _fit(lines, target)[1]
    if straight - least < _CHANCE * scale or max(below, above) < _STRAIGHT * min(below, above):
        return None
    inside = tried[sums <= least + _QUANTILE * scale]
    slowest = min(float(np.abs(stroke.velocity_m_per_s).max()) for stroke in strokes)
    if slowest >= tried[best]:
        return None
    step = float(tried[1] / tried[0])
    method = f"two straight lines through force over speed, {len(strokes)} steps"
    knee = Figure(
        float(tried[best]), float(inside.min()) / step, float(inside.max()) * step, method
    )
    # A knee elsewhere changes the slopes, too.
    moved = whitening @ (-weights[2] * (speed > tried[best]))
    jacobian = np.column_stack([lines, bends[:, best], moved])
    covariance = np.asarray(scale * np.linalg.pinv(jacobian.T @ jacobian), np.float64)[:3, :3]
    slopes = [
        _slope(row, weights, covariance, sign=strokes[0].sign)
        for row in (np.array([0.0, 1.0, 0.0]), np.array([0.0, 1.0, 1.0]))
    ]
    return Knee(knee, *slopes)


def _whitening(covariances: Sequence[Array], force_n: Array) -> Array:
    """Matrix by which the errors of all forces (N,) become independent, of variance one."""
    misfit_n = _MISFIT * float(np.abs(force_n).max())
    factors = [
        np.linalg.cholesky(covariance + misfit_n**2 * np.eye(len(covariance)))
        for covariance in covariances
    ]
    return np.asarray(np.linalg.inv(block_diag(*factors)), np.float64)


def _fit(design: Array, target: Array) -> tuple[Array, float]:
    """Weights of least squares, and the sum of squares that they leave."""
    weights = np.asarray(np.linalg.lstsq(design, target, rcond=None)[0], np.float64)
    residual = target - design @ weights
    return weights, float(residual @ residual)


def _slope(row: Array, weights: Array, covariance: Array, *, sign: int) -> Figure:
    """A slope, positive for a damper."""
    value, half = -sign * float(row @ weights), 1.96 * float(np.sqrt(row @ covariance @ row))
    return Figure.around(value, half, "line on its side of the knee")


def _points(
    stroke: MeanStroke, spring: Callable[[Array], Array] | None
) -> tuple[Array, Array, Array]:
    """Speeds of a stroke, forces there without the spring, and their covariance.

    Speeds at which the force was clipped are left out.
    """
    speed = np.abs(stroke.velocity_m_per_s)
    top = int(np.argmax(speed))
    if stroke.is_constant or not 0 < top < len(speed) - 1:
        at, rows = np.array([float(speed[len(speed) // 2])]), stroke.row(0.0)
    else:
        peak = float(speed[top])
        # The cycles' means are of two samples each where these are few.
        angle = min(_SAMPLES / 2.0 * np.pi / len(stroke.cycles.angle), 0.25 * np.pi)
        least = max(_SLOWEST_SHARE, float(np.sin(angle)))
        at = np.geomspace(least, _FASTEST_SHARE, _POINTS) * peak
        at = at[at >= min(_SLOWEST_M_PER_S, _LEAST_SHARE * peak)]
        rows = np.array(
            [
                0.5 * (_row_at(speed[: top + 1], v, 0) + _row_at(speed[top:], v, top))
                for v in at.tolist()
            ]
        )
    rows = np.atleast_2d(rows)
    whole = ~np.any(rows[:, stroke.beyond != 0] != 0.0, axis=1)
    at, rows = at[whole], rows[whole]
    covariance = rows @ stroke.covariance @ rows.T
    if spring is not None:
        return at, rows @ (stroke.force_n - spring(stroke.height_m)), covariance
    # Of a spring that is not known, the straight part cancels, and its bend remains.
    straight_n = abs(float((stroke.row(-_END) - stroke.row(_END))[0] @ stroke.force_n)) / 2.0
    bend_n = _BEND * straight_n * (1.0 - (at / float(speed.max())) ** 2)
    return at, rows @ stroke.force_n, covariance + np.outer(bend_n, bend_n)


def _row_at(speed: Array, value: float, offset: int) -> Array:
    """Row over the angles that gives the force where a half stroke has a speed."""
    order = np.argsort(speed)
    position = float(np.interp(value, speed[order], order.astype(np.float64)))
    before = min(int(position), len(speed) - 2)
    row = np.zeros(len(ANGLES))
    row[offset + before] = 1.0 - (position - before)
    row[offset + before + 1] = position - before
    return row
