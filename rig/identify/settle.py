"""The last word on what was found: fitted to its end, simplified, and its rivals named."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.identify import screen
from rig.identify.attribute import Attribution, Candidate
from rig.identify.judge import (
    Judge,
    at_floor,
    coloured,
    effective_samples,
    preferred,
    score,
    significant,
)
from rig.identify.output_error import Fit, intervals
from rig.identify.starts import CANDIDATES
from rig.identify.trials import (
    ON_THE_WAY,
    WORKERS,
    along_motion,
    best_of,
    competing,
    less_one,
    raced,
    running_alone,
    trials_in_place,
)

Array = NDArray[np.float64]
_NEARLY = 0.25
_INDISTINCT = 10.0
_RIVAL = 5.0
_RIVAL_COST = 200.0


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
    final = _needed(judge, found, running_alone(judge, final, found.motions))
    if final.planted.effects and len(judge.grids) > len(found.runs):
        final = _on_whole(judge, found, final)
    return Settled(final, rivals if final.planted.effects else (), found.motions)


def _on_whole(judge: Judge, found: Attribution, final: Fit) -> Fit:
    """The fit led to its end on the whole runs."""
    n = 2 * judge.model.coordinates
    whole = final._replace(starts=tuple(start[:n] for start in found.whole.starts))
    return running_alone(judge._replace(grids=found.runs), whole, found.motions, (0.0,))


def _needed(judge: Judge, found: Attribution, final: Fit) -> Fit:
    """Without the effects that the model running alone does not need."""
    for key in tuple(e for e in final.planted.effects if e not in judge.along):
        row = final.planted.effects.index(key)
        if len(final.planted.effects) == 1:
            less = found.base
        else:
            rest = less_one(judge, final, row)
            less = running_alone(judge, rest, found.motions, (0.0,), ON_THE_WAY)
        if significant(less, final):
            continue
        final = less
        if less is not found.base:
            final = running_alone(judge, less, found.motions, (0.0,))
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
        final = less_one(judge, final, final.planted.effects.index(key))
    return running_alone(judge, final, found.motions, (0.0,)) if idle else final


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
        rest = less_one(judge, final, row)
        shared = along_motion(judge, found.base, rest, final)
        begun = [b[0] for b in (screen.begin(shared, *key) for key in keys) if b]
        polish = partial(screen.polish, shared, iterations=10)
        best = best_of(list(pool.map(polish, begun)))[:2]
        final = preferred(final, raced(judge, rest, best, found.motions, pool), 2.0)
    return final


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
        names = [c for c in competing(judge) if len(effect(c).parameters) <= size]
        rest, own, trials = trials_in_place(judge, found.base, final, row, names, pool)
        near = [t for t in trials if t.cost < _RIVAL * own + _RIVAL_COST]
        simplest = sorted(near, key=lambda t: len(effect(t.name).parameters))[:4]
        fits = raced(judge, rest, simplest, found.motions, pool)
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
