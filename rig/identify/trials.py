"""Laws on trial: along the measured motion, for what a simulation leaves over, and simulated.

A trial along a motion is a regression and costs a millisecond; the best are then simulated open
loop together with what was found before, all parameters and initial states fitted.
"""

import itertools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.identify import screen
from rig.identify.judge import Judge, smoothed_misses
from rig.identify.output_error import Fit, fit
from rig.identify.reduced import Model, Planted, planted, pull_on
from rig.identify.starts import CANDIDATES

Array = NDArray[np.float64]
WORKERS = 2
"""Threads: the simulations are machine code, which lets go of the interpreter."""

PULL_PER_S = 8.0
"""Rate at which simulations are pulled towards the measured motion while laws compete."""

ON_THE_WAY = 4
"""Steps of a fit that another one follows."""

REPEATABLE = frozenset({"periodic_force"})
"""Effects that a strut may have several of."""

_SIMULATED = 9
_FIRST_STEPS = 3
_BEHIND = 3.0
_HOPELESS = 30.0
_FAR = 12.0
_NEAR = 2.5
_LINEAR_FAMILIES = frozenset({"preload", "stiffness", "damping", "inertia", "input_gain"})


def competing(judge: Judge) -> tuple[str, ...]:
    """Effects that compete: linear ones do not, where they are fitted along anyway."""
    if not judge.along:
        return CANDIDATES
    return tuple(name for name in CANDIDATES if effect(name).family not in _LINEAR_FAMILIES)


def along_motion(judge: Judge, base: Fit, chosen: Fit, motion: Fit) -> screen.Stage:
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


def left_over(judge: Judge, current: Fit) -> screen.Stage:
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


def tried(
    shared: screen.Stage, keys: Sequence[tuple[int, str]], pool: ThreadPoolExecutor
) -> list[screen.Trial]:
    """Every law's best along the motion, best law first; hopeless ones are not polished."""

    def begin(key: tuple[int, str]) -> list[screen.Trial]:
        return screen.begin(shared, *key)

    begun = [b for b in pool.map(begin, keys) if b]
    if not begun:
        return []
    nothing = float(shared.target @ shared.target) * shared.weight
    best = min(b[0].cost for b in begun)
    hopeful = [trial for b in begun for trial in b[:2] if _promising(trial, best, nothing, 0.1)]
    if not hopeful:
        return best_of([b[0] for b in begun])
    roughly = list(pool.map(partial(screen.polish, shared, iterations=3), hopeful))
    best = min(t.cost for t in roughly)
    kept = [t for t in roughly if _promising(t, best, nothing, 0.3)]
    fully = list(pool.map(partial(screen.polish, shared, iterations=12), kept))
    return best_of([b[0] for b in begun], roughly, fully)


def shares(shared: screen.Stage, trials: Sequence[screen.Trial]) -> list[screen.Trial]:
    """The trials, their cost as a share of what is missing."""
    nothing = max(float(shared.target @ shared.target) * shared.weight, 1e-300)
    return [trial._replace(cost=trial.cost / nothing) for trial in trials]


def best_of(*trials: Sequence[screen.Trial]) -> list[screen.Trial]:
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


def finalists_of(trials: Sequence[screen.Trial]) -> list[screen.Trial]:
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


def trials_in_place(
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
    rest = less_one(judge, current, row)
    shared = along_motion(judge, base, rest, current)
    values = current.values[slice(*current.planted.slots.index[row, 1:3])]
    own = screen.polish(shared, screen.Trial(strut, name, values, np.inf), 2)
    keys = [(at, c) for at in range(len(judge.model.struts)) for c in names if c != name]
    return rest, own.cost, tried(shared, keys, pool)


def raced(
    judge: Judge,
    current: Fit,
    finalists: Sequence[screen.Trial],
    motions: Sequence[screen.Motion],
    pool: ThreadPoolExecutor,
) -> list[Fit | None]:
    """Joint fits of the finalists; those far behind after a few steps go no further."""
    joint = partial(_joint, judge, current, motions=motions)
    early = list(pool.map(joint, finalists))
    best = min((f.cost for f in early if f is not None), default=0.0)

    def further(result: Fit | None) -> Fit | None:
        if result is None or result.cost > _BEHIND * best:
            return result
        return led_on(judge, result, motions, 8, 2e-3)

    return list(pool.map(further, early))


def _joint(
    judge: Judge,
    current: Fit,
    trial: screen.Trial,
    motions: Sequence[screen.Motion],
) -> Fit | None:
    what = planted((*current.planted.effects, (trial.strut, trial.name)))
    values = np.concatenate([current.values, trial.values])
    return fitted(judge, what, values, current.starts, motions, _FIRST_STEPS, 2e-3)


def fitted(
    judge: Judge,
    what: Planted,
    values: Array,
    starts_at: Sequence[Array],
    motions: Sequence[screen.Motion],
    iterations: int,
    tolerance: float = 1e-4,
) -> Fit | None:
    """Effects fitted to the judge's runs, from given parameters and starts; None if that fails."""
    return fit(
        judge.model, what, values, starts_at, judge.grids, judge.noise_m2, motions, iterations,
        tolerance=tolerance,
    )  # fmt: skip


def led_on(
    judge: Judge, result: Fit, motions: Sequence[screen.Motion], iterations: int, tolerance: float
) -> Fit:
    """A fit led on from where it is."""
    last = fitted(
        judge, result.planted, result.values, result.starts, motions, iterations, tolerance
    )
    return last if last is not None and last.cost <= result.cost else result


def running_alone(
    judge: Judge,
    final: Fit,
    motions: Sequence[screen.Motion],
    pulls: Sequence[float] = (PULL_PER_S, 0.3 * PULL_PER_S, 0.0),
    iterations: int = 15,
) -> Fit:
    """The model running alone, reached by letting go of the pull step by step."""
    for pull in pulls:
        there = [grid._replace(pull_per_s=pull) for grid in judge.grids]
        # On the way there is nothing to be gained from a fit led to its end.
        steps, tolerance = (iterations, 1e-6) if pull == 0.0 else (ON_THE_WAY, 1e-3)
        last = fitted(
            judge._replace(grids=tuple(there)),
            final.planted, final.values, final.starts, motions, steps, tolerance,
        )  # fmt: skip
        if last is not None:
            final = last
    return final


def less_one(judge: Judge, final: Fit, row: int) -> Fit:
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
