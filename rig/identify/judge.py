"""What is judged and by what measure: the runs, their noise, and when a gain is more than chance.

References:
    Schwarz, Estimating the dimension of a model, Ann. Stat. 6 (1978), for the penalty.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from dart_model.effects import effect
from rig.identify import screen
from rig.identify.output_error import Fit, colour, fit
from rig.identify.reduced import Grid, Model, Trajectory, planted, run, start_of
from rig.identify.smoother import Noise, Smoothed, estimate_noise, smooth

Array = NDArray[np.float64]
_INPUT_MARGIN = 2.0
_FLOOR_COLOUR = 0.03
_LATER_GAIN = 0.1
_REPEATED_GAIN = 0.5
_BLOCKS = 40
_LEAST_GAIN = 0.004
_LEAST_LIKELIHOOD_GAIN = 25.0
_MOST_LOST = 0.4


class Judge(NamedTuple):
    """Data and settings of a competition.

    Attributes:
        model: The bench.
        grids: Runs.
        noise_m2: Noise variance of each height, shape (struts,).
        input_m2: Variance that the noise of the applied force adds to each height, shape (struts,).
        along: Linear effects that are fitted along with all others, see `_fitted_along`.
    """

    model: Model
    grids: tuple[Grid, ...]
    noise_m2: Array
    input_m2: Array
    along: tuple[tuple[int, str], ...] = ()


def first_fit(model: Model, grids: Sequence[Grid]) -> tuple[Fit, Array]:
    """The model as it is, its initial states fitted, and the sensor's noise.

    Returns:
        The fit, and the noise variance of each height, shape (struts,).
    """
    nothing = planted(())
    starts: list[Array] = []
    for grid in grids:
        heights, velocities = first_motion(grid)
        starts.append(start_of(model, heights, velocities, 0))
    runs = [
        _required(run(model, nothing, np.zeros(0), g, s))
        for g, s in zip(grids, starts, strict=True)
    ]
    noises = [_noise(g, r) for g, r in zip(grids, runs, strict=True)]
    noise = np.median(np.array(noises), axis=0)
    result = fit(model, nothing, np.zeros(0), starts, grids, noise, (), 8)
    assert result is not None
    return result, noise


def _required(value: Trajectory | None) -> Trajectory:
    assert value is not None
    return value


def first_motion(grid: Grid) -> tuple[Array, Array]:
    """Heights and velocities at a run's start, by a parabola through its first samples."""
    count = min(len(grid.t_s), max(20, int(0.05 / grid.step_s)))
    heights: list[float] = []
    velocities: list[float] = []
    t = grid.t_s[:count] - grid.t_s[0]
    for column in grid.heights_m[:count].T:
        there = np.isfinite(column)
        polynomial = np.polynomial.Polynomial.fit(t[there], column[there], 2)
        heights.append(float(polynomial(0.0)))
        velocities.append(float(polynomial.deriv()(0.0)))
    return np.array(heights), np.array(velocities)


def _noise(grid: Grid, motion: Trajectory) -> Array:
    difference = grid.heights_m - motion.heights_m
    return np.array([estimate_noise(grid.t_s, column).variance for column in difference.T])


def smoothed_misses(grids: Sequence[Grid], result: Fit) -> list[list[Smoothed]]:
    """Measured less simulated heights, smoothed: one list a run, one entry a strut."""
    found: list[list[Smoothed]] = []
    for grid, trajectory in zip(grids, result.trajectories, strict=True):
        difference = grid.heights_m - trajectory.heights_m
        columns: list[Smoothed] = []
        for column in difference.T:
            noise: Noise = estimate_noise(grid.t_s, column)
            columns.append(smooth(grid.t_s, column, noise))
        found.append(columns)
    return found


def input_noise(model: Model, grids: Sequence[Grid]) -> Array:
    """Variance of each height that comes from noise and resolution of the applied force.

    The noise is what the quietest tenth of the force's spectrum holds (Welch's periodogram), but
    never more than a thousandth of its range.
    """
    variances: list[Array] = []
    for grid in grids:
        force = grid.applied_n
        _, power = welch(force, 1.0 / grid.step_s, nperseg=min(1024, len(force) // 4))
        quiet = float(np.quantile(power[1:], 0.05)) * 0.5 / grid.step_s
        noise = min(float(np.sqrt(quiet)), 1e-3 * float(np.ptp(force)))
        linear, _, _ = screen.linear_model(model, grid.step_s, float(grid.t_s[-1] - grid.t_s[0]))
        impulse = np.zeros((min(len(force), 20_000), model.coordinates))
        impulse[1] = noise * model.applied_row
        variances.append(np.sum(screen.response(linear, impulse) ** 2, axis=0))
    return np.max(np.array(variances), axis=0)


def coloured(result: Fit, noise_m2: Array, input_m2: Array) -> float:
    """Share of what remains that is neither white nor noise of the applied force; the worst strut.

    Args:
        result: A fit.
        noise_m2: Noise variance of each height, shape (struts,).
        input_m2: From `input_noise`.
    """
    worst = 0.0
    for residual in result.residuals:
        for i, column in enumerate(residual.T):
            square = float(np.nanmean(column**2))
            left = colour(column) * square - _INPUT_MARGIN * float(input_m2[i])
            worst = max(worst, left / max(square, float(noise_m2[i])))
    return worst


def at_floor(result: Fit, judge: Judge) -> bool:
    """Whether nothing is left but noise."""
    return coloured(result, judge.noise_m2, judge.input_m2) < _FLOOR_COLOUR


def score(result: Fit, effective: float) -> float:
    """Deviance with a penalty for parameters (BIC), on an effective number of samples."""
    k = result.planted.parameter_count
    return effective * float(np.log(result.mean_square)) + k * float(np.log(effective))


def effective_samples(result: Fit) -> float:
    """How many independent samples a coloured residual is worth (first-order)."""
    shares = [colour(column) for residual in result.residuals for column in residual.T]
    rho = float(np.clip(np.mean(shares), 0.0, 0.9999))
    return float(np.clip(result.samples * (1.0 - rho) / (1.0 + rho), 60.0, result.samples))


def preferred(current: Fit, rivals: Sequence[Fit | None], margin: float) -> Fit:
    """The fit, or a rival whose score is better by a margin; None is a rival that failed."""
    for rival in rivals:
        if rival is None:
            continue
        effective = effective_samples(min((rival, current), key=lambda f: f.cost))
        if score(rival, effective) < score(current, effective) - margin:
            current = rival
    return current


def significant(before: Fit, after: Fit, along: tuple[tuple[int, str], ...] = ()) -> bool:
    """Whether an effect's gain is more than chance, given the colour of what remains.

    Args:
        before: Fit without the effect.
        after: Fit with it.
        along: Effects that every fit holds, and that do not count as found.
    """
    gain = _block_sums(before) - _block_sums(after)
    lost, won = float(-gain[gain < 0.0].sum()), float(gain[gain > 0.0].sum())
    share = 1.0 - after.cost / before.cost
    added = after.planted.parameter_count - before.planted.parameter_count
    likelihood = effective_samples(after) * float(np.log(before.cost / after.cost))
    need = _LEAST_LIKELIHOOD_GAIN + 5.0 * max(added, 0)
    least = _least_gain(before, after, along)
    return share > least and likelihood > need and lost < _MOST_LOST * won


def _block_sums(result: Fit) -> Array:
    sums: list[float] = []
    for residual in result.residuals:
        parts = np.array_split(residual, max(4, _BLOCKS // len(result.residuals)))
        sums.extend(float(np.nansum(part**2)) for part in parts)
    return np.array(sums)


def _least_gain(before: Fit, after: Fit, along: tuple[tuple[int, str], ...]) -> float:
    """Share of the squares that an effect must take away.

    A further effect must do more than the first: what is left by then is also what the first one's
    formula does not get quite right. One of a family that is there already must do most of all.
    """
    found = set(before.planted.effects) - set(along)
    if not found:
        return _LEAST_GAIN
    families = {(strut, effect(name).family) for strut, name in found}
    new = set(after.planted.effects) - set(before.planted.effects)
    repeated = any((strut, effect(name).family) in families for strut, name in new)
    return _REPEATED_GAIN if repeated else _LATER_GAIN
