"""From what the model misses to named effects: laws compete, one after another, then together.

Each round tries every law of the catalogue along the measured motion, and simulates the best of
them open loop together with what was found before. Blocks of the run that take no part in a fit
decide between them. An effect that later ones made needless is dropped again.

References:
    Hastie, Tibshirani, Friedman, The Elements of Statistical Learning (2009), 7.10:
        cross-validation.
    Diebold and Mariano, J. Bus. Econ. Stat. 13 (1995): rivals compared on coloured errors.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

import itertools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

from dart_model.effects import effect
from rig.identify import screen
from rig.identify.output_error import Fit, colour, fit, intervals
from rig.identify.reduced import Grid, Model, Planted, Trajectory, planted, pull_on, run, start_of
from rig.identify.smoother import Noise, Smoothed, estimate_noise, smooth
from rig.identify.starts import CANDIDATES

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

MOST_EFFECTS = 4
WORKERS = 2
_SIMULATED = 9
_FIRST_STEPS = 3
_BEHIND = 3.0
_HOPELESS = 30.0
_FAR = 12.0
_NEAR = 2.5
_LATER_GAIN = 0.1
_REPEATED_GAIN = 0.5
_INPUT_MARGIN = 2.0
_PULL_PER_S = 8.0
_ON_THE_WAY = 4
_ALONE = 3.0
_FLOOR_COLOUR = 0.03
_NEARLY = 0.25
_BLOCKS = 40
_HIDDEN = 0.05
_MOST_STEPS = 160_000
_FEWER_STEPS = 80_000
_PIECES = 4
_LEAST_NODES = 2_000
_FIRST_SHARE = 1e-3
_LEAST_GAIN = 0.004
_LEAST_LIKELIHOOD_GAIN = 25.0
_MOST_LOST = 0.4
_INDISTINCT = 10.0
_RIVAL = 5.0
_BETTER = 0.9
_RIVAL_COST = 200.0


class Candidate(NamedTuple):
    """An effect in the competition of one round.

    Attributes:
        strut: Index of the strut.
        name: Effect.
        tried: Share of the square of what is missing that it leaves in a trial.
        fit: Joint open-loop fit with the effects chosen before, or None if it was not simulated.
        score: Deviance with a penalty for parameters; lower is better; infinite without a fit.
        why: Why it was not chosen; empty for the winner.
    """

    strut: int
    name: str
    tried: float
    fit: Fit | None
    score: float
    why: str


class Round(NamedTuple):
    """One round of the competition.

    Attributes:
        before: Fit without the new effect.
        candidates: Best first.
    """

    before: Fit
    candidates: tuple[Candidate, ...]


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


class Attribution(NamedTuple):
    """What was found.

    Attributes:
        whole: The model as given on the whole runs, open loop, initial states fitted.
        base: The same on the judge's pieces of them.
        final: The model with all effects found, pulled weakly towards the measured motion.
        rounds: The competition.
        judge: Its data.
        motions: What each strut did.
        runs: The whole runs.
    """

    whole: Fit
    base: Fit
    final: Fit
    rounds: tuple[Round, ...]
    judge: Judge
    motions: tuple[screen.Motion, ...]
    runs: tuple[Grid, ...]


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


def attribute(model: Model, grids: Sequence[Grid], progress: Progress) -> Attribution:
    """Find the effects that a model lacks.

    Args:
        model: The bench.
        grids: Runs to learn from.
        progress: Told what is being done and the share that is done.
    """
    whole, noise = first_fit(model, grids)
    pieces = _pieces(grids)
    base = whole if len(pieces) == len(grids) else first_fit(model, pieces)[0]
    judge = Judge(model, pieces, noise, input_noise(model, grids))
    judge, current = _pulled(judge, base, ())
    judge, current = _fitted_along(judge, base, current)
    rounds: list[Round] = []
    motions: tuple[screen.Motion, ...] = ()
    with ThreadPoolExecutor(WORKERS) as pool:
        for number in range(MOST_EFFECTS):
            progress(f"round {number + 1}: trying {len(CANDIDATES)} laws", 0.1 + 0.18 * number)
            this, motions = _round(judge, base, current, pool)
            rounds.append(this)
            winner = this.candidates[0] if this.candidates else None
            if winner is None or winner.fit is None:
                break
            if not significant(current, winner.fit, judge.along):
                break
            current = _pruned(judge, _converged(judge, winner.fit, motions), motions)
            judge, current = _retargeted(judge, current, motions)
            if at_floor(current, judge):
                break
            if len(current.planted.effects) > len(judge.along) + 1:
                current = _swapped(judge, base, current, motions, pool)
                judge, current = _retargeted(judge, current, motions)
                if at_floor(current, judge):
                    break
    return Attribution(whole, base, current, tuple(rounds), judge, motions, tuple(grids))


def _pieces(grids: Sequence[Grid]) -> tuple[Grid, ...]:
    """The runs that rivals are compared on: of those that take many steps, evenly spread parts."""
    steps = sum(grid.substeps * len(grid.t_s) for grid in grids)
    if steps <= _MOST_STEPS:
        return tuple(grids)
    pieces: list[Grid] = []
    for grid in grids:
        nodes = len(grid.t_s)
        length = max(int(nodes * _FEWER_STEPS / steps / _PIECES), _LEAST_NODES)
        if length * _PIECES >= nodes:
            pieces.append(grid)
            continue
        firsts = [int(k * (nodes - length) / (_PIECES - 1)) for k in range(_PIECES)]
        pieces += [grid.rows(first, first + length) for first in firsts]
    return tuple(pieces)


def _fitted_along(judge: Judge, base: Fit, current: Fit) -> tuple[Judge, Fit]:
    """Linear effects that every fit holds, where the model was itself fitted to such a run.

    Then what it lacks is partly hidden in its mass, stiffness, damping and free length, and its
    residual is orthogonal to theirs: to fit them again gains nothing. They must give way as soon
    as the missing effect is there.
    """
    if at_floor(base, judge):
        return judge, current
    motions = _shared(judge, base, current, current).motions
    along: list[tuple[int, str]] = []
    values: list[float] = []
    for strut, motion in enumerate(motions):
        constants = {
            "preload": motion.stiffness_n_per_m * motion.stroke,
            "linear_stiffness": motion.stiffness_n_per_m,
            "linear_damping": motion.damping_n_s_per_m,
            "added_mass": motion.mass_kg,
        }
        along += [(strut, name) for name in constants]
        values += [_FIRST_SHARE * max(value, 1e-9) for value in constants.values()]
    there = _fitted(judge, planted(tuple(along)), np.array(values), current.starts, motions, 12)
    if there is None or there.cost < (1.0 - _HIDDEN) * current.cost:
        return judge, current
    return judge._replace(along=tuple(along)), there


def _fitted(
    judge: Judge,
    what: Planted,
    values: Array,
    starts_at: Sequence[Array],
    motions: Sequence[screen.Motion],
    iterations: int,
    tolerance: float = 1e-4,
) -> Fit | None:
    return fit(
        judge.model, what, values, starts_at, judge.grids, judge.noise_m2, motions, iterations,
        tolerance=tolerance,
    )  # fmt: skip


def _pulled(judge: Judge, current: Fit, motions: Sequence[screen.Motion]) -> tuple[Judge, Fit]:
    """Runs in which simulations are pulled weakly towards the measured motion, and the fit there.

    An impact or a stick-slip multiplies small errors, so that a law which is right but not yet
    fitted leaves as much as a wrong one when it runs alone. A weak pull, slower than what the
    effects do, keeps rivals comparable; the last fit is open loop again.
    """
    grids: list[Grid] = []
    for grid, there, columns in zip(
        judge.grids, current.trajectories, smoothed_misses(judge.grids, current), strict=True
    ):
        heights = there.heights_m + np.column_stack([c.states[:, 0] for c in columns])
        rates = there.velocities_m_per_s + np.column_stack([c.states[:, 1] for c in columns])
        grids.append(
            grid._replace(
                pull_per_s=_PULL_PER_S,
                target_m=np.ascontiguousarray(heights),
                target_m_per_s=np.ascontiguousarray(rates),
            )
        )
    judge = judge._replace(grids=tuple(grids))
    there = fit(
        judge.model,
        current.planted,
        current.values,
        current.starts,
        grids,
        judge.noise_m2,
        motions,
        4,
        fixed=True,
    )
    return judge, there or current


def _retargeted(judge: Judge, current: Fit, motions: Sequence[screen.Motion]) -> tuple[Judge, Fit]:
    """The pull renewed with what is known now.

    Smoothing blurs an impact that the model did not yet have, and a pull towards that blur would
    itself look like a force. With the effect in the model, running alone, there is little left to
    smooth.
    """
    alone = _alone(judge, current, motions, (0.0,), 10)
    best = alone if alone.mean_square < _ALONE * current.mean_square else current
    return _pulled(judge, best, motions)


def _converged(judge: Judge, result: Fit, motions: Sequence[screen.Motion]) -> Fit:
    """The fit led to its end: what it leaves by chance would be given a name in the next round."""
    return _further(judge, result, motions, 12, 1e-5)


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


def _round(
    judge: Judge, base: Fit, current: Fit, pool: ThreadPoolExecutor
) -> tuple[Round, tuple[screen.Motion, ...]]:
    model = judge.model
    shared = _shared(judge, base, current, current)
    keys = [
        (strut, name)
        for strut in range(len(model.struts))
        for name in _competing(judge)
        if name in _REPEATABLE or (strut, name) not in current.planted.effects
    ]
    trials = _shares(shared, _tried(shared, keys, pool))
    if len(current.planted.effects) > len(judge.along):
        left_over = _left_over(judge, current)
        trials = _best_of(trials, _shares(left_over, _tried(left_over, keys, pool)))
    finalists = _finalists(trials)
    fits = _raced(judge, current, finalists, shared.motions, pool)
    simulated = {(t.strut, t.name): f for t, f in zip(finalists, fits, strict=True)}
    candidates = _ranked(trials, simulated)
    return Round(current, candidates), shared.motions


_REPEATABLE = frozenset({"periodic_force"})
_LINEAR_FAMILIES = frozenset({"preload", "stiffness", "damping", "inertia", "input_gain"})


def _competing(judge: Judge) -> tuple[str, ...]:
    """Effects that compete: linear ones do not, where they are fitted along anyway."""
    if not judge.along:
        return CANDIDATES
    return tuple(name for name in CANDIDATES if effect(name).family not in _LINEAR_FAMILIES)


def _shared(judge: Judge, base: Fit, chosen: Fit, motion: Fit) -> screen.Stage:
    """What trials share that look for what is missing along the measured motion.

    Args:
        judge: Data and settings.
        base: The model without effects: from its motion on something is missing.
        chosen: Effects, whose force along the measured motion is known.
        motion: The fit that follows the measured motion best.
    """
    pieces = _sampled(judge, judge.model, base, motion)
    known = _values(chosen)
    return _stage(judge, screen.less_known(judge.model, pieces, known), known)


def _left_over(judge: Judge, current: Fit) -> screen.Stage:
    """What trials share that look for what a simulation, chosen effects and all, leaves over.

    What is left is taken as a small motion of the linear model, held by the same pull. Where the
    chosen effects are stiff that is rough, but what they do is simulated and not read off a
    smoothed motion, whose blur an impact makes large.
    """
    pull = pull_on(judge.model, judge.grids[0])
    struts = judge.model.struts.copy()
    struts[:, 1:3] += pull
    pieces = _sampled(judge, judge.model._replace(struts=struts), current, current)
    return _stage(judge, pieces, _values(current))


def _sampled(
    judge: Judge, model: Model, base: Fit, motion: Fit
) -> list[tuple[screen.Segment, screen.Linear]]:
    misses = smoothed_misses(judge.grids, motion)
    samples = sum(len(grid.t_s) for grid in judge.grids)
    pieces: list[tuple[screen.Segment, screen.Linear]] = []
    for grid, now, first, columns in zip(
        judge.grids, motion.trajectories, base.trajectories, misses, strict=True
    ):
        pieces += screen.sampled(model, grid, now, first, columns, samples)
    return pieces


def _values(chosen: Fit) -> list[tuple[int, str, Array]]:
    index = chosen.planted.slots.index
    return [
        (strut, name, chosen.values[slice(*index[row, 1:3])])
        for row, (strut, name) in enumerate(chosen.planted.effects)
    ]


def _stage(
    judge: Judge,
    pieces: list[tuple[screen.Segment, screen.Linear]],
    chosen: list[tuple[int, str, Array]],
) -> screen.Stage:
    samples = sum(len(grid.t_s) for grid in judge.grids) * len(judge.model.struts)
    compared = sum(segment.target_m.size for segment, _ in pieces)
    weight = samples / compared / float(np.mean(judge.noise_m2))
    return screen.stage(judge.model, pieces, chosen, weight)


def _tried(
    shared: screen.Stage, keys: Sequence[tuple[int, str]], pool: ThreadPoolExecutor
) -> list[screen.Trial]:
    """Every law's best along the motion, best law first; hopeless ones are not polished."""
    begun = [b for b in pool.map(lambda key: screen.begin(shared, *key), keys) if b]
    if not begun:
        return []
    nothing = float(shared.target @ shared.target) * shared.weight
    best = min(b[0].cost for b in begun)
    hopeful = [trial for b in begun for trial in b[:2] if _promising(trial, best, nothing, 0.1)]
    if not hopeful:
        return _best_of([b[0] for b in begun])
    roughly = list(pool.map(lambda t: screen.polish(shared, t, 3), hopeful))
    best = min(t.cost for t in roughly)
    kept = [t for t in roughly if _promising(t, best, nothing, 0.3)]
    fully = list(pool.map(lambda t: screen.polish(shared, t, 12), kept))
    return _best_of([b[0] for b in begun], roughly, fully)


def _shares(shared: screen.Stage, trials: Sequence[screen.Trial]) -> list[screen.Trial]:
    """The trials, their cost as a share of what is missing."""
    nothing = max(float(shared.target @ shared.target) * shared.weight, 1e-300)
    return [trial._replace(cost=trial.cost / nothing) for trial in trials]


def _best_of(*trials: Sequence[screen.Trial]) -> list[screen.Trial]:
    """Each law's best trial, best law first."""
    found: dict[tuple[int, str], screen.Trial] = {}
    for trial in itertools.chain(*trials):
        key = (trial.strut, trial.name)
        if key not in found or trial.cost < found[key].cost:
            found[key] = trial
    return sorted(found.values(), key=lambda t: t.cost)


def _promising(trial: screen.Trial, best: float, nothing: float, share: float) -> bool:
    """Whether a trial is worth more work, or gains too little of what the best one gains."""
    return trial.cost < _HOPELESS * best and nothing - trial.cost >= share * (nothing - best)


def _finalists(trials: Sequence[screen.Trial]) -> list[screen.Trial]:
    """The best of each family, and the best of all, as long as they are not hopeless."""
    found: list[screen.Trial] = []
    families: dict[str, int] = {}
    best = trials[0].cost if trials else 0.0
    for trial in trials:
        if trial.cost > _FAR * best:
            break
        family = effect(trial.name).family
        most = 3 if trial.cost < _NEAR * best else 1
        if families.get(family, 0) < most and len(found) < _SIMULATED:
            families[family] = families.get(family, 0) + 1
            found.append(trial)
    return found


def _raced(
    judge: Judge,
    current: Fit,
    finalists: Sequence[screen.Trial],
    motions: Sequence[screen.Motion],
    pool: ThreadPoolExecutor,
) -> list[Fit | None]:
    """Joint fits of the finalists; those far behind after a few steps go no further."""
    early = list(pool.map(lambda t: _joint(judge, current, t, motions, _FIRST_STEPS), finalists))
    best = min((f.cost for f in early if f is not None), default=0.0)

    def further(result: Fit | None) -> Fit | None:
        if result is None or result.cost > _BEHIND * best:
            return result
        return _further(judge, result, motions, 8, 2e-3)

    return list(pool.map(further, early))


def _joint(
    judge: Judge,
    current: Fit,
    trial: screen.Trial,
    motions: Sequence[screen.Motion],
    iterations: int = 8,
) -> Fit | None:
    what = planted((*current.planted.effects, (trial.strut, trial.name)))
    values = np.concatenate([current.values, trial.values])
    return _fitted(judge, what, values, current.starts, motions, iterations, 2e-3)


def _further(
    judge: Judge, result: Fit, motions: Sequence[screen.Motion], iterations: int, tolerance: float
) -> Fit:
    """A fit led on from where it is."""
    last = _fitted(
        judge, result.planted, result.values, result.starts, motions, iterations, tolerance
    )
    return last if last is not None and last.cost <= result.cost else result


def score(result: Fit, effective: float) -> float:
    """Deviance with a penalty for parameters (BIC), on an effective number of samples."""
    k = result.planted.parameter_count
    return effective * float(np.log(result.mean_square)) + k * float(np.log(effective))


def effective_samples(result: Fit) -> float:
    """How many independent samples a coloured residual is worth (first-order)."""
    shares = [colour(column) for residual in result.residuals for column in residual.T]
    rho = float(np.clip(np.mean(shares), 0.0, 0.9999))
    return float(np.clip(result.samples * (1.0 - rho) / (1.0 + rho), 60.0, result.samples))


def _ranked(
    trials: Sequence[screen.Trial], simulated: dict[tuple[int, str], Fit | None]
) -> tuple[Candidate, ...]:
    fits = [f for f in simulated.values() if f is not None]
    if not fits:
        return ()
    best = min(fits, key=lambda f: f.cost)
    effective = effective_samples(best)
    listed: list[Candidate] = []
    for trial in trials:
        result = simulated.get((trial.strut, trial.name))
        value = score(result, effective) if result is not None else float("inf")
        listed.append(Candidate(trial.strut, trial.name, trial.cost, result, value, ""))
    listed.sort(key=lambda c: (c.score, c.tried))
    return tuple(listed)


def _block_sums(result: Fit) -> Array:
    sums: list[float] = []
    for residual in result.residuals:
        parts = np.array_split(residual, max(4, _BLOCKS // len(result.residuals)))
        sums.extend(float(np.nansum(part**2)) for part in parts)
    return np.array(sums)


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


def _pruned(judge: Judge, current: Fit, motions: Sequence[screen.Motion]) -> Fit:
    """Without the effects that the others made needless."""
    while len(current.planted.effects) > len(judge.along) + 1:
        rows = range(len(judge.along), len(current.planted.effects) - 1)
        dropped: Fit | None = None
        for row in rows:
            less = without(judge, current, row, motions)
            if less is not None and not significant(less, current, judge.along):
                dropped = less
                break
        if dropped is None:
            return current
        current = dropped
    return current


def without(judge: Judge, current: Fit, row: int, motions: Sequence[screen.Motion]) -> Fit | None:
    """The fit without one effect, the others fitted again."""
    effects = tuple(e for i, e in enumerate(current.planted.effects) if i != row)
    index = current.planted.slots.index
    values = np.concatenate(
        [
            current.values[slice(*index[i, 1:3])]
            for i in range(len(current.planted.effects))
            if i != row
        ]
    )
    n = 2 * judge.model.coordinates
    starts = [start[:n] for start in current.starts]
    return _fitted(judge, planted(effects), values, starts, motions, 8, 1e-3)


class Settled(NamedTuple):
    """The last word.

    Attributes:
        final: The model with all effects found, fitted to the end.
        rivals: Candidates of other families that do as well with as few parameters.
        motions: What each strut did.
    """

    final: Fit
    rivals: tuple[Candidate, ...]
    motions: tuple[screen.Motion, ...]


def settle(found: Attribution) -> Settled:
    """Fit what was found to the end, and list the rivals that cannot be told from it."""
    final, judge = found.final, found.judge
    if not final.planted.effects:
        return Settled(found.whole, (), found.motions)
    with ThreadPoolExecutor(WORKERS) as pool:
        final = _refined(judge, found, final, pool)
        rivals: tuple[Candidate, ...] = ()
        if coloured(final, judge.noise_m2, judge.input_m2) < _NEARLY:
            final, rivals = _rivals(judge, found, final, pool)
    final = _needed(judge, found, _alone(judge, final, found.motions))
    if final.planted.effects and len(judge.grids) > len(found.runs):
        final = _on_whole(judge, found, final)
    return Settled(final, rivals if final.planted.effects else (), found.motions)


def _on_whole(judge: Judge, found: Attribution, final: Fit) -> Fit:
    """The fit led to its end on the whole runs."""
    n = 2 * judge.model.coordinates
    whole = final._replace(starts=tuple(start[:n] for start in found.whole.starts))
    return _alone(judge._replace(grids=found.runs), whole, found.motions, (0.0,))


def _alone(
    judge: Judge,
    final: Fit,
    motions: Sequence[screen.Motion],
    pulls: Sequence[float] = (_PULL_PER_S, 0.3 * _PULL_PER_S, 0.0),
    iterations: int = 15,
) -> Fit:
    """The model running alone, reached by letting go of the pull step by step."""
    for pull in pulls:
        there = [grid._replace(pull_per_s=pull) for grid in judge.grids]
        # On the way there is nothing to be gained from a fit led to its end.
        steps, tolerance = (iterations, 1e-6) if pull == 0.0 else (_ON_THE_WAY, 1e-3)
        last = _fitted(
            judge._replace(grids=tuple(there)),
            final.planted, final.values, final.starts, motions, steps, tolerance,
        )  # fmt: skip
        if last is not None:
            final = last
    return final


def _needed(judge: Judge, found: Attribution, final: Fit) -> Fit:
    """Without the effects that the model running alone does not need."""
    for key in tuple(e for e in final.planted.effects if e not in judge.along):
        row = final.planted.effects.index(key)
        if len(final.planted.effects) == 1:
            less = found.base
        else:
            less = _alone(judge, _rest(judge, final, row), found.motions, (0.0,), _ON_THE_WAY)
        if not significant(less, final):
            final = less if less is found.base else _alone(judge, less, found.motions, (0.0,))
    return _without_idle(judge, found, final)


def _without_idle(judge: Judge, found: Attribution, final: Fit) -> Fit:
    """Without the linear effects fitted along whose interval holds zero."""
    if not judge.along or not final.planted.effects:
        return final
    _, low, high = intervals(final, judge.grids)
    index = final.planted.slots.index
    idle = [
        key
        for row, key in enumerate(final.planted.effects)
        if key in judge.along and low[index[row, 1]] < 0.0 < high[index[row, 1]]
    ]
    for key in idle:
        final = _rest(judge, final, final.planted.effects.index(key))
    return _alone(judge, final, found.motions, (0.0,)) if idle else final


def _refined(judge: Judge, found: Attribution, final: Fit, pool: ThreadPoolExecutor) -> Fit:
    """The same families, each by its best law: an early choice was made amid what others did."""
    if at_floor(final, judge):
        return final
    for strut, name in tuple(e for e in final.planted.effects if e not in judge.along):
        row = final.planted.effects.index((strut, name))
        family = effect(name).family
        keys = [(strut, c) for c in CANDIDATES if effect(c).family == family and c != name]
        if not keys:
            continue
        rest = _rest(judge, final, row)
        shared = _shared(judge, found.base, rest, final)
        begun = [b[0] for b in (screen.begin(shared, *key) for key in keys) if b]
        trials = list(pool.map(lambda t: screen.polish(shared, t, 10), begun))  # noqa: B023
        trials.sort(key=lambda t: t.cost)
        fits = _raced(judge, rest, trials[:2], found.motions, pool)
        for rival in fits:
            if rival is None:
                continue
            effective = effective_samples(min((rival, final), key=lambda f: f.cost))
            if score(rival, effective) < score(final, effective) - 2.0:
                final = rival
    return final


def _rest(judge: Judge, final: Fit, row: int) -> Fit:
    """The fit less one effect, the others as they are."""
    keep = [i for i in range(len(final.planted.effects)) if i != row]
    index = final.planted.slots.index
    what = planted(tuple(final.planted.effects[i] for i in keep))
    values = np.concatenate([np.zeros(0), *(final.values[slice(*index[i, 1:3])] for i in keep)])
    n = 2 * judge.model.coordinates
    starts = tuple(
        np.concatenate([start[:n], *(start[n + index[i, 3] : n + index[i, 4]] for i in keep)])
        for start in final.starts
    )
    return final._replace(planted=what, values=values, starts=starts)


def _trials_in_place(
    judge: Judge,
    base: Fit,
    current: Fit,
    row: int,
    names: Sequence[str],
    pool: ThreadPoolExecutor,
) -> tuple[Fit, float, list[screen.Trial]]:
    """Laws tried in the place of one effect.

    Returns:
        The fit without the effect; what the effect leaves along the motion; the laws' trials,
        best first.
    """
    strut, name = current.planted.effects[row]
    rest = _rest(judge, current, row)
    shared = _shared(judge, base, rest, current)
    values = current.values[slice(*current.planted.slots.index[row, 1:3])]
    own = screen.polish(shared, screen.Trial(strut, name, values, np.inf), 2)
    keys = [(at, c) for at in range(len(judge.model.struts)) for c in names if c != name]
    return rest, own.cost, _tried(shared, keys, pool)


def _swapped(
    judge: Judge,
    base: Fit,
    current: Fit,
    motions: Sequence[screen.Motion],
    pool: ThreadPoolExecutor,
) -> Fit:
    """Early choices made again: what was best alone need not be best beside what came later."""
    for key in current.planted.effects[len(judge.along) : -1]:
        row = current.planted.effects.index(key)
        rest, own, trials = _trials_in_place(judge, base, current, row, _competing(judge), pool)
        better = [t for t in trials if t.cost < _BETTER * own][:3]
        fits = _raced(judge, rest, better, motions, pool)
        for rival in fits:
            if rival is None:
                continue
            effective = effective_samples(min((rival, current), key=lambda f: f.cost))
            if score(rival, effective) < score(current, effective) - 5.0:
                current = rival
    return _converged(judge, current, motions)


def _rivals(
    judge: Judge, found: Attribution, final: Fit, pool: ThreadPoolExecutor
) -> tuple[Fit, tuple[Candidate, ...]]:
    """Effects with no more parameters that do as well as one that was found, in its place.

    Returns:
        The fit, an effect that a simpler one replaces exchanged; rivals of other families.
    """
    rivals: dict[tuple[int, str], Candidate] = {}
    for strut, name in tuple(e for e in final.planted.effects if e not in judge.along):
        item = effect(name)
        row = final.planted.effects.index((strut, name))
        size = len(item.parameters)
        names = [c for c in _competing(judge) if len(effect(c).parameters) <= size]
        rest, own, trials = _trials_in_place(judge, found.base, final, row, names, pool)
        near = [t for t in trials if t.cost < _RIVAL * own + _RIVAL_COST]
        simplest = sorted(near, key=lambda t: len(effect(t.name).parameters))[:4]
        fits = _raced(judge, rest, simplest, found.motions, pool)
        best = final
        effective = effective_samples(final)
        for trial, result in zip(simplest, fits, strict=True):
            if result is None:
                continue
            value = score(result, effective)
            if value < score(best, effective) - 2.0:
                best = result
            if (
                effect(trial.name).family != item.family
                and value - score(final, effective) < _INDISTINCT
            ):
                key = (trial.strut, trial.name)
                rivals[key] = Candidate(*key, trial.cost, result, value, "")
        final = best
    chosen = {effect(name).family for _, name in final.planted.effects}
    effective = effective_samples(final)
    left = [
        c
        for c in rivals.values()
        if effect(c.name).family not in chosen
        and c.fit is not None
        and score(c.fit, effective) - score(final, effective) < _INDISTINCT
    ]
    return final, tuple(sorted(left, key=lambda c: c.score))
