"""From what the model misses to named effects: laws compete, one after another, then together.

Each round tries every law of the catalogue along the measured motion, and simulates the best of
them open loop together with what was found before. A law has to gain nearly everywhere in the run,
and more than coloured residuals do by chance; rivals are ranked with a penalty for parameters. An
effect that later ones made needless is dropped again. Data that took no part in any of this have
the last word, see `rig.identify.verdict`.

References:
    Diebold and Mariano, J. Bus. Econ. Stat. 13 (1995): rivals compared on coloured errors.
    Schwarz, Ann. Stat. 6 (1978): the penalty for parameters.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.identify import screen
from rig.identify.judge import (
    Judge,
    at_floor,
    effective_samples,
    first_fit,
    input_noise,
    preferred,
    score,
    significant,
    smoothed_misses,
)
from rig.identify.output_error import Fit, fit
from rig.identify.reduced import Grid, Model, planted
from rig.identify.starts import CANDIDATES
from rig.identify.trials import (
    PULL_PER_S,
    REPEATABLE,
    WORKERS,
    along_motion,
    best_of,
    competing,
    finalists_of,
    fitted,
    led_on,
    left_over,
    less_one,
    raced,
    running_alone,
    shares,
    trials_in_place,
    tried,
)

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
MOST_EFFECTS = 4
_ALONE = 3.0
_HIDDEN = 0.05
_FIRST_SHARE = 1e-3
_MOST_STEPS = 160_000
_FEWER_STEPS = 80_000
_PIECES = 4
_LEAST_NODES = 2_000
_BETTER = 0.9


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
    motions = along_motion(judge, base, current, current).motions
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
    there = fitted(judge, planted(tuple(along)), np.array(values), current.starts, motions, 12)
    if there is None or there.cost < (1.0 - _HIDDEN) * current.cost:
        return judge, current
    return judge._replace(along=tuple(along)), there


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
                pull_per_s=PULL_PER_S,
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
    alone = running_alone(judge, current, motions, (0.0,), 10)
    best = alone if alone.mean_square < _ALONE * current.mean_square else current
    return _pulled(judge, best, motions)


def _converged(judge: Judge, result: Fit, motions: Sequence[screen.Motion]) -> Fit:
    """The fit led to its end: what it leaves by chance would be given a name in the next round."""
    return led_on(judge, result, motions, 12, 1e-5)


def _round(
    judge: Judge, base: Fit, current: Fit, pool: ThreadPoolExecutor
) -> tuple[Round, tuple[screen.Motion, ...]]:
    model = judge.model
    shared = along_motion(judge, base, current, current)
    keys = [
        (strut, name)
        for strut in range(len(model.struts))
        for name in competing(judge)
        if name in REPEATABLE or (strut, name) not in current.planted.effects
    ]
    trials = shares(shared, tried(shared, keys, pool))
    if len(current.planted.effects) > len(judge.along):
        rest = left_over(judge, current)
        trials = best_of(trials, shares(rest, tried(rest, keys, pool)))
    finalists = finalists_of(trials)
    fits = raced(judge, current, finalists, shared.motions, pool)
    simulated = {(t.strut, t.name): f for t, f in zip(finalists, fits, strict=True)}
    candidates = _ranked(trials, simulated)
    return Round(current, candidates), shared.motions


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


def _pruned(judge: Judge, current: Fit, motions: Sequence[screen.Motion]) -> Fit:
    """Without the effects that the others made needless."""
    while len(current.planted.effects) > len(judge.along) + 1:
        rows = range(len(judge.along), len(current.planted.effects) - 1)
        dropped: Fit | None = None
        for row in rows:
            less = _without(judge, current, row, motions)
            if less is not None and not significant(less, current, judge.along):
                dropped = less
                break
        if dropped is None:
            return current
        current = dropped
    return current


def _without(judge: Judge, current: Fit, row: int, motions: Sequence[screen.Motion]) -> Fit | None:
    """The fit without one effect, the others fitted again."""
    rest = less_one(judge, current, row)
    n = 2 * judge.model.coordinates
    starts = [start[:n] for start in rest.starts]
    return fitted(judge, rest.planted, rest.values, starts, motions, 8, 1e-3)


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
        rest, own, trials = trials_in_place(judge, base, current, row, competing(judge), pool)
        better = [t for t in trials if t.cost < _BETTER * own][:3]
        current = preferred(current, raced(judge, rest, better, motions, pool), 5.0)
    return _converged(judge, current, motions)
