"""From the models that were fitted to what is reported: no law and no correction too many."""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.diagnosis.outcome import RejectedEffect
from rig.diagnosis.problem.problem import (
    Candidate,
    Placed,
    Problem,
    nominal,
)
from rig.diagnosis.progress import Progress
from rig.diagnosis.search.explore import FirstRound
from rig.diagnosis.search.fit import Fit, fit, law_values, parts_for, spread
from rig.diagnosis.search.pool import FINAL, FULL, Pool, Scored
from rig.diagnosis.search.screen import Screening, plain, proposed, ranked, refined
from rig.diagnosis.search.sound import unmeasured

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

_SCALED_BY_GAIN = ("mass", "stiffness", "damping")
"""Linear parameters that, changed in one proportion, are another gain of the applied force."""
_ALIKE = 0.01
"""Difference of two shares up to which they count as one, however narrow their intervals."""


class Found(NamedTuple):
    """What a search found.

    Attributes:
        given: The nominal model, only initial states fitted.
        linear: The best linear model.
        plain: The same with those corrections alone that the data call for.
        chosen: The model that was chosen.
        rivals: Models with other families that the data cannot distinguish from it.
        superfluous: Existing effects, by index, without which the data are as well described.
        rejected: Laws that were not chosen, best first.
        gain_alike: Whether a gain of the applied force stands for mass, stiffness and damping, or
            two of them, that changed in one proportion.
    """

    given: Fit
    linear: Scored
    plain: Scored
    chosen: Scored
    rivals: tuple[Scored, ...]
    superfluous: tuple[int, ...]
    rejected: tuple[RejectedEffect, ...]
    gain_alike: bool


def conclude(pool: Pool, first: Pool, seen: FirstRound | None, progress: Progress) -> Found:
    """What was found.

    Args:
        pool: Models to choose from.
        first: Those about the linear model, for what was not chosen.
        seen: Single laws there.
        progress: Called with what is being done and the share that is done.
    """
    progress("leaving out what is needless", 0.85)
    most_laws = pool.criteria.most_laws
    while True:
        chosen = _without_needless(pool, pool.chosen(most_laws))
        final, alike = _with_few_linear(pool, chosen)
        why = unmeasured(pool.problem, final.fit) if final.size else None
        if why is None:
            break
        pool.reject(chosen.fit.candidate, why)
        # Data that do not bind so many laws bind no larger number of others.
        most_laws = chosen.size
        _try_plainer(pool, chosen)
    progress("comparing rivals", 0.9)
    rivals = _rivals(pool, chosen)
    superfluous = _superfluous(pool, chosen)
    lawless = _with_few_linear(pool, pool.linear)[0] if final.size else final
    rejected = () if seen is None else _rejected(first, seen, pool.linear, final, rivals)
    return Found(pool.given, pool.linear, lawless, final, rivals, superfluous, rejected, alike)


# --- no law too many ------------------------------------------------------------------------------


def _without_needless(pool: Pool, chosen: Scored) -> Scored:
    """Each law left out, or replaced by a simpler one, where that loses nothing."""
    while True:
        simpler = (
            rival
            for placed in chosen.fit.candidate.new
            for rival in _simpler(pool, chosen, placed)
            if not pool.worth(rival, chosen)
        )
        rival = next(simpler, None)
        if rival is None:
            return chosen
        chosen = rival


def _simpler(pool: Pool, chosen: Scored, placed: Placed) -> Iterable[Scored]:
    """Models without a law of a chosen one, or with a simpler one for it; fitted as asked for."""
    stage, known = pool.linear_stage, law_values(pool.problem, chosen.fit)
    laws = chosen.fit.candidate.new
    less = chosen.fit.candidate.without(placed)

    @cache
    def most() -> float:
        """What is hopeful beside the chosen laws along the motion, where a fit costs little."""
        whole = refined(stage, laws, [known[law] for law in laws])
        criteria, nothing = pool.criteria, plain(stage).score
        near = 0.0 if whole is None else criteria.hopeless * whole.score
        return max(near, criteria.formula**2 * nothing)

    def is_hopeful(screening: Screening | None) -> bool:
        return screening is not None and screening.score <= most()

    if chosen.size > 1:
        # Its own fit may have ended in a side valley, which the larger set has left.
        is_fitted = less in pool.fits and pool.is_near(pool.fits[less], chosen)
        is_fitted |= less in pool.settled and less in pool.unsound
        if not is_fitted and is_hopeful(refined(stage, less.new, [known[law] for law in less.new])):
            pool.attempt(less, parts_for(pool.problem, chosen.fit, less))
        yield from _settled(pool, less, chosen)
    for name in effect(placed[1]).simpler:
        other = (placed[0], name)
        if effect(name).linear or other in less.new:
            continue
        candidate = less.added(other)
        if candidate not in pool.fits:
            for screening in ranked(stage, _as_screening(less.new, known), 1, [other]):
                if screening.values and is_hopeful(screening):
                    pool.attempt_screened(stage, pool.linear, screening, FULL)
        yield from _settled(pool, candidate, chosen)


def _as_screening(laws: Sequence[Placed], known: Mapping[Placed, Array]) -> Screening:
    """Fitted laws as a set that others are tried beside."""
    return Screening(tuple(laws), tuple(known[law] for law in laws), 0.0, np.zeros(1))


def _settled(pool: Pool, candidate: Candidate, chosen: Scored) -> Iterable[Scored]:
    """A set, fitted to its end if it is near the chosen one; none where there is no sound fit."""
    if candidate in pool.fits:
        pool.settle(pool.fits[candidate], chosen)
        if candidate not in pool.unsound:
            yield pool.fits[candidate]


def _try_plainer(pool: Pool, unbound: Scored) -> None:
    """Fit laws of the same families with fewer parameters, of which data bind more."""
    known = law_values(pool.problem, unbound.fit)
    for placed in unbound.fit.candidate.new:
        less = unbound.fit.candidate.without(placed).new
        base = _as_screening(less, known)
        plainer = [at for at in proposed(pool.problem) if _is_plainer(at, placed)]
        for screening in ranked(pool.linear_stage, base, len(plainer), plainer)[
            : pool.criteria.fitted_a_size
        ]:
            if screening.values:
                pool.attempt_screened(pool.linear_stage, pool.linear, screening, FULL)


def _is_plainer(one: Placed, other: Placed) -> bool:
    (strut, law), (other_strut, other_law) = one, other
    a, b = effect(law), effect(other_law)
    alike = strut == other_strut and a.family == b.family
    return alike and len(a.parameters) < len(b.parameters)


def _rivals(pool: Pool, chosen: Scored) -> tuple[Scored, ...]:
    """Sets of the same size and other families that the data cannot distinguish from the chosen."""
    found: dict[tuple[str, ...], Scored] = {}
    for other in sorted(pool.sound(), key=lambda s: s.score):
        if other.size != chosen.size or other.families in (chosen.families, *found):
            continue
        if not _degenerate(other, chosen) and pool.is_alike(other, chosen):
            found[other.families] = other
    return tuple(found.values())


def _degenerate(other: Scored, chosen: Scored) -> bool:
    """Whether a set is the chosen one with a law that only degenerates to one of its laws."""
    more = set(other.fit.candidate.new) - set(chosen.fit.candidate.new)
    less = set(chosen.fit.candidate.new) - set(other.fit.candidate.new)
    return all(any(at == s and n in _simpler_names(name) for s, n in less) for at, name in more)


def _simpler_names(name: str) -> set[str]:
    direct = set(effect(name).simpler)
    return direct.union(*(_simpler_names(other) for other in direct)) if direct else direct


def _superfluous(pool: Pool, chosen: Scored) -> tuple[int, ...]:
    """Existing effects that act on the recordings and without which nothing is lost."""
    found: list[int] = []
    problem, reference = pool.problem, chosen.fit
    for i in reference.candidate.kept:
        if not problem.existing[i].free:
            continue
        kept = tuple(j for j in reference.candidate.kept if j != i)
        candidate = Candidate(kept, reference.candidate.new)
        result = pool.refit(candidate, parts_for(problem, reference, candidate), FULL)
        if result is not None and not pool.worth(pool.scored(result), chosen):
            found.append(i)
    return tuple(found)


# --- no linear correction too many ----------------------------------------------------------------


def _with_few_linear(pool: Pool, chosen: Scored) -> tuple[Scored, bool]:
    """The chosen model, fitted to its end, with those linear corrections that data call for."""
    problem = pool.problem
    settled = fit(problem, chosen.fit.candidate, chosen.fit.parts, chosen.fit.free, *FINAL)
    if settled is not None:
        chosen = pool.scored(settled)
    result = _called_for(pool, chosen)
    if not result.size and not pool.worth(as_given := pool.scored(pool.given), result):
        # Corrections that are away from nothing and change nothing that can be measured.
        return as_given, False
    found = _as_gain(problem, result.fit)
    if found is None:
        return result, False
    linear, free = found
    gain = fit(problem, chosen.fit.candidate, result.fit.parts._replace(linear=linear), free)
    if gain is not None and not pool.worth(lean := pool.scored(gain), result):
        return _called_for(pool, lean), True
    return result, False


def _called_for(pool: Pool, chosen: Scored) -> Scored:
    """A model with those of its linear corrections alone that are away from nothing."""
    model = chosen.fit
    needed = _needed(model, pool.criteria.significant)
    parts = model.parts._replace(linear=np.where(needed, model.parts.linear, 0.0))
    fewer = fit(pool.problem, model.candidate, parts, needed, *FINAL)
    if fewer is not None and not pool.worth(lean := pool.scored(fewer), chosen):
        return lean
    return chosen


def _needed(result: Fit, significant: float) -> Flags:
    """Backward elimination by Wald's test with the covariance of an autocorrelated residual."""
    variables = np.flatnonzero(result.free)
    count = len(variables)
    known = spread(result).covariance[:count, :count].copy()
    x = result.space.inner(result.solution.values)[:count].copy()
    left = list(range(count))
    while left:
        part = np.array(left)
        sizes = np.abs(x[part]) / np.sqrt(np.maximum(np.diag(known)[part], 1e-300))
        worst = int(part[np.argmin(sizes)])
        if float(np.min(sizes)) >= significant:
            break
        # The others, given that this one is nothing.
        x = x - known[:, worst] / max(known[worst, worst], 1e-300) * x[worst]
        outer = np.outer(known[:, worst], known[worst]) / max(known[worst, worst], 1e-300)
        known = known - outer
        left.remove(worst)
    needed = np.zeros_like(result.free)
    needed[variables[left]] = True
    return needed


def _as_gain(problem: Problem, result: Fit) -> tuple[Array, Flags] | None:
    """Fewer corrections, one of which is the gain of the applied force; None where it saves none.

    The gain is degenerate with mass, stiffness and damping changed in one proportion. Those of them
    that changed so, within their intervals, are then as the model has them. With several struts a
    mass carries others, and nothing is that simple.

    Returns:
        Where to begin, and which linear parameters are free, shapes (L,).
    """
    linear = problem.linear
    if len(problem.motions) > 1 or not any(p.kind == "gain" for p in linear):
        return None
    half, values = spread(result).half, result.solution.values
    scaled = {i for i, p in enumerate(linear) if p.kind in _SCALED_BY_GAIN and p.nominal > 0.0}
    shares: dict[int, tuple[float, float]] = {}
    for i, place in enumerate(np.flatnonzero(result.free).tolist()):
        p = linear[place]
        if place in scaled and values[i] > p.least:
            known = max(half[i] * p.deviation / p.nominal, _ALIKE)
            shares[place] = float(values[i]) / p.nominal, float(known)
    alike: set[int] = set()
    for middle, _ in shares.values():
        same = {i for i, (share, known) in shares.items() if abs(share - middle) < known}
        alike = max(alike, same, key=len)
    # What did not change would have to, for the gain to stand for the others.
    unchanged = sum(1 for i in scaled if not result.free[i])
    if len(alike) < 2 + unchanged:
        return None
    share = float(np.median([shares[i][0] for i in alike]))
    changes, free = result.parts.linear.copy(), result.free.copy()
    for i, p in enumerate(linear):
        if p.kind == "gain":
            changes[i], free[i] = 1.0 / (1.0 + share) - 1.0, True
        elif i in alike:
            changes[i], free[i] = 0.0, False
        elif p.kind != "free_length":
            own = p.nominal if i in scaled else 0.0
            changes[i] = (own + changes[i]) / (1.0 + share) - own
            free[i] |= p.kind == "preload"
    return changes, free


# --- what was not chosen --------------------------------------------------------------------------


def _rejected(
    first: Pool, seen: FirstRound, linear: Scored, chosen: Scored, rivals: Sequence[Scored]
) -> tuple[RejectedEffect, ...]:
    """Laws that were not chosen, with one line each, best first."""
    # Of what the linear model leaves: the first search may know the noise less well, or see a part.
    share = chosen.score / max(linear.score, 1e-300)
    found: dict[Placed, RejectedEffect] = {}
    taken = set(chosen.fit.candidate.new)
    tied = {placed for rival in rivals for placed in rival.fit.candidate.new} - taken
    for screening in seen.screenings:
        placed = screening.laws[-1]
        if placed in taken or placed in found:
            continue
        left = float(np.sqrt(max(screening.cost, 0.0) / max(seen.nothing.cost, 1e-300)))
        why = (
            "cannot be told from what was chosen by these data"
            if placed in tied
            else _why(first, chosen.size, share, placed, left)
        )
        strut, name = first.problem.spec.struts[placed[0]].name, placed[1]
        found[placed] = RejectedEffect(effect(name).family, name, strut, why, min(left, 1.0))
    return tuple(sorted(found.values(), key=lambda r: 1.0 if r.left is None else r.left))


def _why(first: Pool, laws: int, share: float, placed: Placed, left: float) -> str:
    candidate = nominal(first.problem).added(placed)
    if candidate in first.unsound:
        return first.unsound[candidate]
    if candidate in first.fits and laws > 0:
        alone = first.fits[candidate].score / max(first.linear.score, 1e-300)
        ratio = float(np.sqrt(alone / max(share, 1e-300)))
        if laws == 1:
            return f"its out-of-sample residual is {ratio:.3g} times that of the chosen model"
        return f"alone it leaves {ratio:.3g} times the out-of-sample residual of the chosen set"
    taken = 100.0 * (1.0 - min(left, 1.0))
    return f"along the motion it takes {taken:.3g} % off the residual of the linear model"
