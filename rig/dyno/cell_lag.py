"""Lag of a load cell behind the height, from all steps of a record together.

At one speed, a damper pushes as hard while it speeds up as while it slows down, but for its spring.
A force that arrives late is that of an earlier speed: it makes a loop of the curve over velocity,
and a spring rate that rises with the square of the frequency. Once the force is shifted by the lag,
the odd part of a stroke's force about mid-stroke is the spring's alone,

    F_odd = -k x - k3 x³,

k and k3 the same in all steps, and k not negative. The lag is where weighted least squares over all
steps leave least, its interval where they leave little more.

With few steps, a lag cannot be distinguished from a spring, or from a force with memory, such as
that of a friction damper. Known is then only the largest lag: with more of it, the spring would
push upwards.

A column of oil with air in it, or a soft mount, delays the force as well, but not by one time in
all steps: it is the longer, the steeper the damping is. Where the steps contradict one lag by more
than chance, none is determined.

Reference: Seber and Wild, Nonlinear Regression (1989), 5.2, for the profile of a sum of squares.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import brentq, fminbound  # pyright: ignore[reportUnknownVariableType]
from scipy.special import fdtri  # pyright: ignore[reportUnknownVariableType]

from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import ANGLES, Figure, MeanStroke
from rig.dyno.strokes import Array

LONGEST_LAG_S = 2e-2
"""Lags beyond which two channels do not belong together."""

_FARTHEST = 1.2
"""Angle, in rad, up to which a stroke is used: nearer to its ends friction reverses."""

_EVERY = 4
"""Angles of which one is used."""

_MISFIT = 0.002
"""Share of the largest force of a step by which its odd part may differ from the equation."""

_FEWEST_STEPS, _WIDEST = 3, 2.0
"""Steps of different frequency that determine a lag, and ratio of the highest to the lowest."""

_TRIED: Array = np.linspace(-LONGEST_LAG_S, LONGEST_LAG_S, 81)
"""Lags at which a minimum is looked for, half a millisecond apart."""

_FIRST_S = 1e-7
"""Step by which the end of an interval is first looked for, and ten times what it is found to."""

_QUANTILE = 3.84
"""Rise of the sum of squares at the ends of a 95 % interval."""

_PER_M2 = 1e4
"""Of the cubic spring rate, so that both rates are of one size: 1/(10 mm)²."""

_CERTAIN = 0.999
"""Quantile of the F distribution beyond which steps contradict one another."""

_NEAR_SHARE, _NEAR_S = 0.15, 5e-5
"""Share of the lag, and time, by which the steps may differ about it whatever their certainty."""

_FULL_ANGLES: Array = np.concatenate([ANGLES, np.pi + ANGLES[1:]])
"""Angles of a stroke and of the one after it."""


class CellLag(NamedTuple):
    """A lag in s.

    Attributes:
        kind: `one`: all steps agree on it; `several`: no one time explains them; `open`: they do
            not determine one, and the interval goes from none to the largest that is possible.
    """

    figure: Figure
    kind: Literal["one", "several", "open"]


class _Equations(NamedTuple):
    """What of a stroke does not depend on the lag.

    Attributes:
        force_n: Its force and that of the stroke after it, at `_FULL_ANGLES`.
        turning: Rate at which the angle turns, in rad/s, at the angles that are used, shape (2n,).
        angles: These, the negative ones after the positive ones, shape (2n,).
        whiten: Matrix that makes the errors of the odd force independent, shape (n, n).
        design: Whitened columns of both spring rates, shape (n, 2).
    """

    force_n: Array
    turning: Array
    angles: Array
    whiten: Array
    design: Array

    def odd(self, values: Array) -> Array:
        """Whitened odd part of values at the angles, shape (n,)."""
        half = len(values) // 2
        return self.whiten @ (0.5 * (values[:half] - values[half:]))

    def target(self, lag_s: float) -> Array:
        """Whitened odd force of the stroke when it is shifted by a lag, shape (n,)."""
        at = self.angles + self.turning * lag_s
        return self.odd(np.asarray(np.interp(at, _FULL_ANGLES, self.force_n), np.float64))

    def rate(self, lag_s: float) -> Array:
        """Whitened odd part of the force's rate of change, shape (n,)."""
        at = self.angles + self.turning * lag_s
        slope = np.interp(at, _FULL_ANGLES, np.gradient(self.force_n, _FULL_ANGLES))
        return self.odd(np.asarray(slope * self.turning, np.float64))


def estimate_lag(steps: Sequence[DynoStep]) -> CellLag | None:
    """What a record's force lags its height by; None where no step would show it."""
    used: dict[float, list[_Equations]] = {}
    for step in steps:
        pairs = zip(step.strokes, step.strokes[::-1], strict=True)
        both = [_equations(a, b) for a, b in pairs if not (a.is_clipped or a.is_constant)]
        if both:
            used[step.peak_speed_m_per_s / step.amplitude_m] = both
    if not used:
        return None
    by_step = list(used.values())
    profile = _profile([stroke for both in by_step for stroke in both])
    text = f"hysteresis at equal speeds, {len(used)} steps"
    if len(used) < _FEWEST_STEPS or max(used) < _WIDEST * min(used):
        _, high = profile.interval(profile.best(_TRIED[_TRIED >= 0.0]))
        return CellLag(Figure(0.0, 0.0, high, f"{text}: the spring does not push upwards"), "open")
    best = profile.best(_TRIED)
    figure = Figure(best, *profile.interval(best), text)
    return CellLag(figure, "one" if _agree(by_step, figure.value) else "several")


def _equations(stroke: MeanStroke, other: MeanStroke) -> _Equations:
    """Equations of a stroke, after which the other one follows."""
    above = np.flatnonzero((ANGLES > 0.0) & (ANGLES <= _FARTHEST))[_EVERY - 1 :: _EVERY]
    both = np.concatenate([above, len(ANGLES) - 1 - above])
    odd = np.zeros((len(above), len(ANGLES)))
    odd[np.arange(len(above)), above] = 0.5
    odd[np.arange(len(above)), both[len(above) :]] = -0.5
    x_m = odd @ (stroke.height_m - stroke.middle_m)
    misfit_n = _MISFIT * float(np.abs(stroke.force_n).max())
    covariance = odd @ stroke.covariance @ odd.T + misfit_n**2 * np.eye(len(above))
    whiten = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)
    # Along a stroke the angle turns with the speed over the amplitude's projection.
    turning = np.abs(stroke.velocity_m_per_s[both]) / (stroke.amplitude_m * np.cos(ANGLES[both]))
    return _Equations(
        np.concatenate([stroke.force_n, other.force_n[1:]]),
        turning,
        ANGLES[both],
        whiten,
        whiten @ np.column_stack([-x_m, -(x_m**3) * _PER_M2]),
    )


class _Profile(NamedTuple):
    """Least sum of squares over the spring, as a function of the lag.

    Attributes:
        spring: Orthonormal columns of both spring rates, shape (N, 2).
        bend: The column of the cubic one alone, normalised, shape (N, 1).
        to_rate: What gives the linear rate of a target, shape (N,).
    """

    strokes: Sequence[_Equations]
    spring: Array
    bend: Array
    to_rate: Array

    def squares(self, lag_s: float) -> float:
        """What a spring leaves whose rate is not negative."""
        target = np.concatenate([stroke.target(lag_s) for stroke in self.strokes])
        columns = self.spring if self.to_rate @ target >= 0.0 else self.bend
        left = target - columns @ (columns.T @ target)
        return float(left @ left)

    def _excess(self, lag_s: float, most: float) -> float:
        return self.squares(lag_s) - most

    def best(self, tried: Array) -> float:
        """The lag between the lowest and the highest one of those tried that leaves least."""
        at = int(np.argmin([self.squares(lag_s) for lag_s in tried.tolist()]))
        bounds = float(tried[max(at - 1, 0)]), float(tried[min(at + 1, len(tried) - 1)])
        return float(fminbound(self.squares, *bounds, xtol=_FIRST_S / 10.0))

    def interval(self, best_s: float) -> tuple[float, float]:
        """Ends of the 95 % interval about the best lag."""
        least = self.squares(best_s)
        freedom = len(self.spring) - 3
        most = least + _QUANTILE * max(1.0, least / freedom)
        return self._end(best_s, -_FIRST_S, most), self._end(best_s, _FIRST_S, most)

    def _end(self, best_s: float, step_s: float, most: float) -> float:
        """The lag, in one direction from the best one, at which the sum of squares is too large."""
        inside_s = best_s
        while abs(best_s + step_s) < LONGEST_LAG_S:
            if self.squares(best_s + step_s) > most:
                outside_s = best_s + step_s
                return float(brentq(self._excess, inside_s, outside_s, (most,), _FIRST_S / 10.0))
            inside_s = best_s + step_s
            step_s *= 2.0
        return float(np.copysign(LONGEST_LAG_S, step_s))


def _profile(strokes: Sequence[_Equations]) -> _Profile:
    design = np.concatenate([stroke.design for stroke in strokes])
    bend = design[:, 1:] / np.linalg.norm(design[:, 1:])
    spring = np.linalg.qr(design)[0]
    return _Profile(strokes, spring, bend, np.linalg.pinv(design)[0])


def _agree(by_step: Sequence[Sequence[_Equations]], lag_s: float) -> bool:
    """Whether one lag for all steps explains as much as one for each, or nearly."""
    count = len(by_step)
    parts: list[Array] = []
    for number, strokes in enumerate(by_step):
        for stroke in strokes:
            more = np.zeros((len(stroke.design), count))
            more[:, number] = -stroke.rate(lag_s)
            parts.append(np.column_stack([stroke.design, more]))
    design = np.concatenate(parts)
    target = np.concatenate([it.target(lag_s) for strokes in by_step for it in strokes])
    common = np.column_stack([design[:, :2], design[:, 2:].sum(axis=1)])
    one_squares, own_squares = (_squares(columns, target) for columns in (common, design))
    freedom = len(target) - design.shape[1]
    scale = max(1.0, own_squares / freedom)
    by_chance = float(fdtri(count - 1, freedom, _CERTAIN))  # pyright: ignore[reportUnknownArgumentType]
    if one_squares - own_squares <= by_chance * (count - 1) * scale:
        return True
    # Weighted by what each step says of it.
    more_s = np.linalg.lstsq(design, target, rcond=None)[0][2:]
    information = 1.0 / np.diag(np.linalg.pinv(design.T @ design))[2:]
    apart_s = float(np.sqrt(information @ more_s**2 / information.sum()))
    return apart_s <= max(_NEAR_SHARE * abs(lag_s), _NEAR_S)


def _squares(design: Array, target: Array) -> float:
    """The sum of squares that least squares leave."""
    residual = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
    return float(residual @ residual)
