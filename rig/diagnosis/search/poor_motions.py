"""What a motion of one frequency, or of one direction, cannot distinguish.

Along such a motion other laws are the linear part, and a search among laws does not see them: the
linear part explains all.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.effects.friction import COULOMB_FRICTION
from dart_model.effects.hysteresis import MAXWELL
from rig.diagnosis.problem.channel_delays import is_undetermined, search_undetermined
from rig.diagnosis.problem.problem import strut_constants
from rig.diagnosis.problem.track import law_force
from rig.diagnosis.search.fit import Fit, fit, model_for
from rig.diagnosis.search.pool import FINAL, Pool, ValidatedModel
from rig.diagnosis.search.screen import law_starts
from rig.diagnosis.search.validity import is_linear_along

Flags = NDArray[np.bool_]


def rivals_of_poor_motion(pool: Pool, chosen: ValidatedModel) -> tuple[ValidatedModel, ...]:
    """Models without one of the linear corrections that explain as much."""
    return _rivals_of_one_frequency(pool, chosen) or _rivals_of_one_way(pool, chosen)


def springs_and_dampers(pool: Pool, free: Flags) -> list[int]:
    """Corrections of stiffness or damping among the free linear parameters (L,), by index."""
    linear = pool.problem.linear
    return [i for i in np.flatnonzero(free).tolist() if linear[i].kind in ("stiffness", "damping")]


def _rivals_of_one_frequency(pool: Pool, chosen: ValidatedModel) -> tuple[ValidatedModel, ...]:
    """A late channel, or a law with memory, that explains as much as corrections of a strut.

    Along a single sine whatever is linear is a stiffness and a damping. The first estimate of the
    delays shows whether a recording is such a one.
    """
    unknown = [i for i, p in enumerate(pool.problem.linear) if is_undetermined(p)]
    corrected = springs_and_dampers(pool, chosen.fit.free)
    if not unknown or not corrected:
        return ()
    rivals = [_with_delays_instead(pool, chosen, corrected, unknown)]
    for strut in {pool.problem.linear[i].strut for i in corrected}:
        own = [i for i in corrected if pool.problem.linear[i].strut == strut]
        rivals.append(_with_memory_instead(pool, chosen, own, unknown, strut))
    return tuple(rival for rival in rivals if rival is not None)


def _as_good(pool: Pool, chosen: ValidatedModel, result: Fit | None) -> ValidatedModel | None:
    """A fit with its cross-validation; None where the chosen model is preferred to it."""
    if result is None or pool.prefers(chosen, rival := pool.validate(result)):
        return None
    return rival


def _with_delays_instead(
    pool: Pool, chosen: ValidatedModel, corrected: Sequence[int], unknown: Sequence[int]
) -> ValidatedModel | None:
    """The chosen model with delays in place of one or all of its corrections."""
    problem = replace(pool.problem, linear=search_undetermined(pool.problem.linear))
    for dropped in (corrected, *([i] for i in corrected)):
        linear, free = chosen.fit.parts.linear.copy(), chosen.fit.free.copy()
        linear[list(dropped)], free[list(dropped)], free[list(unknown)] = 0.0, False, True
        first = chosen.fit.model.with_linear(linear)
        if rival := _as_good(pool, chosen, fit(problem, first, free, FINAL)):
            return rival
    return None


def _with_memory_instead(
    pool: Pool, chosen: ValidatedModel, corrected: Sequence[int], unknown: Sequence[int], strut: int
) -> ValidatedModel | None:
    """The chosen model with a relaxing spring in place of a strut's corrections."""
    linear, free = chosen.fit.parts.linear.copy(), chosen.fit.free.copy()
    for indices in (corrected, unknown):
        linear[list(indices)], free[list(indices)] = 0.0, False
    law = (strut, MAXWELL.name)
    candidate = chosen.fit.candidate.with_effects(law)
    if candidate == chosen.fit.candidate:
        return None
    plain = chosen.fit.model.with_linear(linear)
    for start in MAXWELL.starts(pool.problem.motions[strut]):
        first = model_for(pool.problem, plain, candidate, {law: np.array(start)})
        if rival := _as_good(pool, chosen, fit(pool.problem, first, free, FINAL)):
            return rival
    return None


def _rivals_of_one_way(pool: Pool, chosen: ValidatedModel) -> tuple[ValidatedModel, ...]:
    """Dry friction that explains as much as a correction of preload or damping.

    Where a strut moves one way, friction is a preload; at one speed a damping, too.
    """
    rivals = [
        _with_friction_instead(pool, chosen, strut)
        for strut in range(len(pool.problem.motions))
        if not any(
            at == strut and effect(name).family == COULOMB_FRICTION.family
            for at, name in chosen.fit.candidate.new
        )
    ]
    return tuple(rival for rival in rivals if rival is not None)


def _with_friction_instead(pool: Pool, chosen: ValidatedModel, strut: int) -> ValidatedModel | None:
    """The chosen model with friction for a correction, if along the motion that is linear."""
    problem, law = pool.problem, (strut, COULOMB_FRICTION.name)
    corrected = [
        i
        for i in np.flatnonzero(chosen.fit.free).tolist()
        if problem.linear[i].strut == strut and problem.linear[i].kind in ("preload", "damping")
    ]
    starts = law_starts(problem, law, {}) if corrected else []
    if not len(starts):
        return None
    along = [track for _, track in pool.along]
    constants = strut_constants(problem, chosen.fit.parts.linear)
    force_n = np.concatenate([law_force(track, *law, starts[0], constants) for track in along])
    if not is_linear_along(along, strut, force_n, pool.criteria):
        return None
    candidate = chosen.fit.candidate.with_effects(law)
    for dropped in corrected:
        linear, free = chosen.fit.parts.linear.copy(), chosen.fit.free.copy()
        linear[dropped], free[dropped] = 0.0, False
        plain = chosen.fit.model.with_linear(linear)
        first = model_for(problem, plain, candidate, {law: starts[0]})
        if rival := _as_good(pool, chosen, fit(problem, first, free, FINAL)):
            return rival
    return None
