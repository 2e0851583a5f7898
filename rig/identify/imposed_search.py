"""Laws compete to explain a load cell along an imposed motion, one after another, then together.

Each round tries every law beside those found before, stiffness, damping and preload free in every
trial; the best are fitted together with the others. Blocks of the runs that take no part in a fit
decide between them.

References:
    Hastie, Tibshirani, Friedman, The Elements of Statistical Learning (2009), 7.10:
        cross-validation.
    Diebold and Mariano, J. Bus. Econ. Stat. 13 (1995): rivals compared on coloured errors.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.identify.imposed_fit import (
    LINEAR,
    Fit,
    Run,
    fit,
    held_back_errors,
    law_force,
    linear_columns,
    motion_noise,
    take_out,
)
from rig.identify.least_squares import Space, solve
from rig.identify.output_error import colour
from rig.identify.starts import CANDIDATES, Motion, space, starts

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

UNSEEN = frozenset({"added_mass", "inerter", "input_gain", "delay", "hidden_mass"})
"""Effects that act on a body's motion or on the applied force: an imposed motion has neither."""

MOST_LAWS = 3
_WORKERS = 2
_MOST_TRIED = 6_000
_MOST_FITTED = 9_000
_HOPELESS = 6.0
_POLISHED = 2
_FINALISTS = 7
_A_FAMILY = 3
_LEAST_GAIN = 0.004
_LATER_GAIN = 0.03
_POLISH = 0.2
_CERTAIN = 2.0
_MOST_LOST = 0.4
_HARDLY_LOST = 0.005
_INDISTINCT = 2.0
_NEGLIGIBLE = 0.02
_MOTION_MARGIN = 2.0
_FLOOR_COLOUR = 0.03
_AT_BOUND = 1e-3
_SLOW = 0.1
_LARGEST_SWING = 8.0
_TONES = 4
_ONE_LINE = 0.9

_NATURAL_ENDS = frozenset(
    {
        ("rounding_velocity_m_per_s", "low"),
        ("presliding_m", "low"),
        ("shape", "low"),
        ("shape", "high"),
        ("phase_rad", "low"),
        ("phase_rad", "high"),
    }
)
"""Ends of the search at which a parameter still means what it says: an ideally sharp friction."""


class Candidate(NamedTuple):
    """A law in the competition of one round.

    Attributes:
        name: Effect.
        tried: Sum of squares that it leaves along the motion, in N².
        fit: Joint fit with the laws found before, or None if it did not come so far.
        held_back: Squared error of each block that took no part in the fit; empty without a fit.
        why: Why it cannot be chosen; empty if it can.
    """

    name: str
    tried: float
    fit: Fit | None
    held_back: Array
    why: str

    @property
    def score(self) -> float:
        """Squared error on blocks that took no part in the fit; infinite if it was put aside."""
        return float(self.held_back.sum()) if self.fit is not None and not self.why else np.inf


class Round(NamedTuple):
    """One round: the fit before it, and all candidates, best first."""

    before: Fit
    candidates: tuple[Candidate, ...]


class Found(NamedTuple):
    """What was found.

    Attributes:
        runs: The runs.
        base: The model as given: nothing fitted.
        final: All that was found.
        rounds: The competition.
        rivals: Laws of other families that do as well in the place of one that was found.
        motion: What the strut did.
    """

    runs: tuple[Run, ...]
    base: Fit
    final: Fit
    rounds: tuple[Round, ...]
    rivals: tuple[Candidate, ...]
    motion: Motion


def search(runs: Sequence[Run], progress: Progress) -> Found:
    """Find what a model lacks along imposed motions.

    Args:
        runs: Runs to learn from.
        progress: Told what is being done and the share that is done.
    """
    whole = tuple(runs)
    samples = sum(len(run.counted) for run in runs)
    runs = [run.thinned(max(1, round(samples / _MOST_FITTED))) for run in runs]
    motion = motion_of(runs)
    base = _required(fit(runs, (), (), motion, ()))
    linear = needed_linear(runs, _required(fit(runs, (), (), motion)), motion)
    current, rounds = _required(fit(runs, (), (), motion)), list[Round]()
    rivals: tuple[Candidate, ...] = ()
    with ThreadPoolExecutor(_WORKERS) as pool:
        while len(current.effects) < MOST_LAWS and not at_floor(_lean(current, linear), runs):
            number = len(rounds)
            progress(f"round {number + 1}: trying {len(CANDIDATES)} laws", 0.1 + 0.2 * number)
            this = _round(runs, current, motion_of(runs, current), current.effects, pool)
            rounds.append(this)
            winner = _winner(this)
            if winner is None or winner.fit is None:
                break
            polishes = current.effects and not at_floor(winner.fit, runs)
            least = _POLISH if polishes else None
            if not significant(current, winner.fit, runs, least):
                break
            current = _rechosen(runs, winner.fit, motion, pool)
        progress("comparing rivals", 0.75)
        final = linear
        if current.effects:
            final, rivals = _compared(runs, current, motion, pool)
    progress("fitting all samples", 0.88)
    base, final = (_on_all(whole, there, motion) for there in (base, final))
    return Found(whole, base, final, tuple(rounds), rivals, motion)


def _on_all(whole: Sequence[Run], there: Fit, motion: Motion) -> Fit:
    """A fit led to its end on every sample."""
    if there.samples == sum(len(run.counted) for run in whole):
        return there
    again = _again(whole, there, motion, there.linear)
    kept = fit(whole, there.effects, there.values, motion, there.linear, 0, memories=there.memories)
    return _required(kept if again is None or at_bound(again, motion) else again)


def _lean(current: Fit, linear: Fit) -> Fit:
    return current if current.effects else linear


def _required(value: Fit | None) -> Fit:
    assert value is not None
    return value


def motion_of(runs: Sequence[Run], current: Fit | None = None) -> Motion:
    """What the strut did in all runs; with a fit, also the tones of what it leaves."""
    heights = [run.height_m[run.counted] for run in runs]
    temperature = np.concatenate([run.temperature_c for run in runs])
    free, stiffness, damping, _ = (float(x) for x in runs[0].strut)
    tones: tuple[tuple[float, float], ...] = ()
    if current is not None:
        longest = int(np.argmax([run.duration_s for run in runs]))
        tones = _tones(runs[longest], current.residuals[longest])
    return Motion(
        np.concatenate(heights),
        np.concatenate([run.velocity_m_per_s[run.counted] for run in runs]),
        free,
        stiffness,
        damping,
        max(run.duration_s for run in runs),
        (float(temperature.min()), float(temperature.max())),
        tones,
        1.0,
        min(float(np.ptp(height)) for height in heights),
    )


def _tones(run: Run, residual: Array) -> tuple[tuple[float, float], ...]:
    """Frequency and phase of the strongest lines of what is left.

    Where the motion is one line itself, its multiples are left out: there any law has lines.
    """
    count = len(run.counted)
    t_s = run.t_s[run.counted]
    even = np.linspace(t_s[0], t_s[-1], count)
    step = float(even[1] - even[0])
    frequencies = np.fft.rfftfreq(4 * count, step)
    resolution = 1.0 / (count * step)

    def power(values: Array) -> Array:
        put = np.interp(even, t_s, values - values.mean()) * np.hanning(count)
        return np.abs(np.fft.rfft(put, 4 * count)) ** 2

    left = power(residual)
    left[frequencies < 1.5 * resolution] = 0.0
    moved = power(run.height_m[run.counted])
    line = float(frequencies[int(np.argmax(moved))])
    if float(moved[np.abs(frequencies - line) < 2.0 * resolution].sum()) > _ONE_LINE * moved.sum():
        multiple = np.rint(frequencies / line)
        left[np.abs(frequencies - multiple * line) < 2.0 * resolution] = 0.0
    found: list[tuple[float, float]] = []
    for _ in range(_TONES):
        peak = int(np.argmax(left))
        if left[peak] <= 0.0:
            break
        frequency = float(frequencies[peak])
        left[max(0, peak - 16) : peak + 17] = 0.0
        angle = 2.0 * np.pi * frequency * t_s
        sine, cosine = float(np.sin(angle) @ residual), float(np.cos(angle) @ residual)
        found.append((frequency, float(np.arctan2(cosine, sine))))
    return tuple(found)


class _Stage(NamedTuple):
    """What the trials of a round share.

    Attributes:
        runs: Runs, thinned out.
        basis: Orthonormal rows that no law may claim, shape (rows, m).
        target: Missing force with those taken out, shape (m,).
        motion: What the strut did.
    """

    runs: tuple[Run, ...]
    basis: Array
    target: Array
    motion: Motion


def _stage(runs: Sequence[Run], current: Fit, motion: Motion) -> _Stage:
    samples = sum(len(run.counted) for run in runs)
    every = max(1, round(samples / _MOST_TRIED))
    few = tuple(run.thinned(every) for run in runs)
    target = np.concatenate([r[::every] for r in current.residuals])
    known = current.jacobian[:, : current.jacobian.shape[1] - len(current.linear)]
    ends = np.cumsum([len(run.counted) for run in runs])[:-1]
    columns = np.concatenate([part[::every] for part in np.split(known, ends)])
    columns = np.hstack([columns, np.concatenate([linear_columns(run, LINEAR) for run in few])])
    sizes = np.linalg.norm(columns, axis=0)
    basis = np.ascontiguousarray(np.linalg.qr(columns[:, sizes > 0.0] / sizes[sizes > 0.0])[0].T)
    take_out(basis, target)
    return _Stage(few, basis, target, motion)


class _Trial(NamedTuple):
    """A law along the motion: parameters, and the sum of squares that it leaves in N²."""

    name: str
    values: Array
    cost: float


def _claimed(shared: _Stage, name: str, values: Array) -> Array:
    memory = np.zeros(effect(name).state_size)
    force = np.concatenate(
        [law_force(run, name, values, memory)[run.counted] for run in shared.runs]
    )
    take_out(shared.basis, force)
    return force


def _begun(shared: _Stage, name: str) -> list[_Trial]:
    """A law at its starts, best first; empty where the run cannot show it."""
    scaled = list(effect(name).scaled)
    begun: list[_Trial] = []
    for start in starts(name, shared.motion):
        values = np.array(start, dtype=np.float64)
        bounds = space(name, shared.motion, values)
        values = np.clip(values, bounds.low, bounds.high)
        force = _claimed(shared, name, values)
        power = float(force @ force)
        if not np.isfinite(power) or power <= 0.0:
            continue
        if scaled:
            factor = float(force @ shared.target) / power
            values[scaled] *= factor
            inside = np.clip(values, bounds.low, bounds.high)
            force = force * factor
            if not np.array_equal(inside, values):
                values = inside
                force = _claimed(shared, name, values)
        left = shared.target - force
        begun.append(_Trial(name, values, float(left @ left)))
    return sorted(begun, key=lambda trial: trial.cost)


def _polished(shared: _Stage, trial: _Trial, iterations: int) -> _Trial:
    solution = solve(
        lambda p: shared.target - _claimed(shared, trial.name, p),
        trial.values,
        space(trial.name, shared.motion, trial.values),
        iterations,
        1e-3,
    )
    if solution is None or not np.isfinite(solution.cost):
        return trial
    return _Trial(trial.name, solution.values, solution.cost)


def _tried(shared: _Stage, names: Sequence[str], pool: ThreadPoolExecutor) -> list[_Trial]:
    """Every law's best along the motion, best law first; hopeless ones are not polished."""
    begun = [b for b in pool.map(lambda name: _begun(shared, name), names) if b]
    if not begun:
        return []
    first = min(b[0].cost for b in begun)
    hopeful = [trial for b in begun for trial in b[:_POLISHED] if trial.cost < _HOPELESS * first]
    roughly = list(pool.map(lambda t: _polished(shared, t, 4), hopeful))
    second = min(t.cost for t in roughly)
    kept = [t for t in roughly if t.cost < _HOPELESS * second]
    fully = list(pool.map(lambda t: _polished(shared, t, 12), kept))
    best: dict[str, _Trial] = {}
    for trial in [*(b[0] for b in begun), *roughly, *fully]:
        if trial.name not in best or trial.cost < best[trial.name].cost:
            best[trial.name] = trial
    return sorted(best.values(), key=lambda t: t.cost)


def _finalists(trials: Sequence[_Trial]) -> list[_Trial]:
    """The best of each family, as long as they are not hopeless."""
    found: list[_Trial] = []
    families: dict[str, int] = {}
    for trial in trials:
        family = effect(trial.name).family
        if families.get(family, 0) < _A_FAMILY and trial.cost < _HOPELESS * trials[0].cost:
            families[family] = families.get(family, 0) + 1
            found.append(trial)
    return found[:_FINALISTS]


def _round(
    runs: Sequence[Run],
    current: Fit,
    motion: Motion,
    barred: Sequence[str],
    pool: ThreadPoolExecutor,
) -> Round:
    """Every law beside those of `current`; `barred` ones do not compete."""
    shared = _stage(runs, current, motion)
    names = [n for n in CANDIDATES if n not in (*UNSEEN, *LINEAR, *barred)]
    trials = _tried(shared, names, pool)
    finalists = _finalists(trials)

    def joint(trial: _Trial) -> Candidate:
        there = fit(
            runs,
            (*current.effects, trial.name),
            (*current.values, trial.values),
            motion,
            iterations=10,
            memories=_with_memory(current, trial.name, len(runs)),
        )
        if there is None:
            return Candidate(trial.name, trial.cost, None, np.zeros(0), "its force is not finite")
        errors = held_back_errors(there, runs)
        why = at_bound(there, motion) or cancelling(there, runs)
        return Candidate(trial.name, trial.cost, there, errors, why)

    fitted = list(pool.map(joint, finalists))
    far = [
        Candidate(t.name, t.cost, None, np.zeros(0), "")
        for t in trials
        if t.name not in {c.name for c in fitted}
    ]
    fitted.sort(key=lambda c: c.score)
    return Round(current, (*fitted, *far))


def _with_memory(current: Fit, name: str, runs: int) -> list[tuple[Array, ...]]:
    extra = np.zeros(effect(name).state_size)
    before = current.memories or ((),) * runs
    return [(*memory, extra) for memory in before]


def at_bound(result: Fit, motion: Motion) -> str:
    """Which parameter of a law stands at an end of its search, said in words; empty if none does.

    There the law has turned into another one, and its name would mislead. So has a fade that is
    over when the run has hardly begun: it stands for how the run began.
    """
    work_j = motion.damping_n_s_per_m * motion.speed**2 * motion.duration_s
    soonest = {"time_fade": motion.duration_s, "energy_fade": work_j}
    for name, values in zip(result.effects, result.values, strict=True):
        if name in soonest and values[1] < _SLOW * soonest[name]:
            return f"{name} is over when the run has hardly begun"
        bounds: Space = space(name, motion, values)
        inner = bounds.inner(values)
        low, high = bounds.inner(bounds.low), bounds.inner(bounds.high)
        for i, parameter in enumerate(effect(name).parameters):
            near = _AT_BOUND * max(1.0, abs(float(inner[i])))
            sides = {"low": inner[i] - low[i] < near, "high": high[i] - inner[i] < near}
            if bounds.low[i] == 0.0 and parameter.name != "final_fraction":
                sides["low"] = False  # what is absent is no other law, but nothing fades to nothing
            for side, there in sides.items():
                if there and (parameter.name, side) not in _NATURAL_ENDS:
                    whose = "its" if name == result.effects[-1] else f"{name}'s"
                    return f"{whose} {parameter.name} runs to an end of its search"
    return ""


def cancelling(result: Fit, runs: Sequence[Run]) -> str:
    """Which law swings far more than all that is missing, said in words; empty if none does.

    Such a law and a linear effect take each other away, and what is left of both is a curve that
    neither of them stands for.
    """
    missing = np.concatenate([run.missing_n() for run in runs])
    most = _LARGEST_SWING * float(np.sqrt(np.mean(missing**2)))
    for row, (name, values) in enumerate(zip(result.effects, result.values, strict=True)):
        parts = [
            law_force(run, name, values, result.memories[k][row])[run.counted]
            for k, run in enumerate(runs)
        ]
        if float(np.std(np.concatenate(parts))) > most:
            return f"{name} swings far more than all that is missing, and is cancelled by others"
    return ""


def _winner(this: Round) -> Candidate | None:
    """The best candidate, or a simpler one that does as well."""
    able = [c for c in this.candidates if np.isfinite(c.score)]
    if not able:
        return None
    best = min(able, key=lambda c: c.score)
    same = [c for c in able if indistinct(c, best)]
    return min(same, key=lambda c: (len(effect(c.name).parameters), c.score))


def indistinct(candidate: Candidate, best: Candidate) -> bool:
    """Whether a candidate does as well as the best one, on blocks that took no part in the fit."""
    worse = candidate.held_back - best.held_back
    share = float(worse.sum()) / max(float(best.held_back.sum()), 1e-300)
    close = _certainty(worse) < _INDISTINCT and share < 5.0 * _NEGLIGIBLE
    return share < _NEGLIGIBLE or close


def _certainty(gains: Array) -> float:
    """Sum of the gains of blocks over its standard deviation."""
    spread = float(np.sqrt(len(gains) * np.var(gains, ddof=1)))
    return float(gains.sum()) / max(spread, 1e-300)


def significant(before: Fit, after: Fit, runs: Sequence[Run], least: float | None = None) -> bool:
    """Whether blocks that took no part in the fits gain more than by chance.

    Args:
        before: Fit with less.
        after: Fit with more.
        runs: The runs.
        least: Share of the squared error that must be gained; by default what a first or a later
            effect must gain. A law that is one too many polishes what another shape would have
            fitted, and does worse elsewhere.
    """
    old, new = held_back_errors(before, runs), held_back_errors(after, runs)
    gain = old - new
    if least is None:
        least = _LATER_GAIN if before.effects else _LEAST_GAIN
    lost, won = -float(gain[gain < 0.0].sum()), float(gain[gain > 0.0].sum())
    broad = _certainty(gain) > _CERTAIN and lost < _MOST_LOST * won
    # A stop that is met now and then gains in few blocks, but it costs in none.
    rare = lost < _HARDLY_LOST * won
    return (broad or rare) and float(gain.sum()) > least * float(old.sum())


def without(result: Fit, row: int, runs: Sequence[Run], motion: Motion) -> Fit | None:
    """The fit without one law, the others fitted again."""
    keep = [i for i in range(len(result.effects)) if i != row]
    return fit(
        runs,
        [result.effects[i] for i in keep],
        [result.values[i] for i in keep],
        motion,
        result.linear,
        10,
        memories=[tuple(memory[i] for i in keep) for memory in result.memories],
    )


def _rechosen(runs: Sequence[Run], current: Fit, motion: Motion, pool: ThreadPoolExecutor) -> Fit:
    """Early choices made again: what was best alone need not be best beside what came later."""
    if len(current.effects) < 2:
        return current
    for name in current.effects[:-1]:
        row = current.effects.index(name)
        less = without(current, row, runs, motion)
        if less is None:
            continue
        if not significant(less, current, runs):
            current = less
            continue
        again = _round(runs, less, motion_of(runs, less), less.effects, pool)
        winner = _winner(again)
        if winner is not None and winner.fit is not None and winner.name != name:
            own = held_back_errors(current, runs)
            if float(winner.held_back.sum()) < (1.0 - _NEGLIGIBLE) * float(own.sum()):
                current = winner.fit
    return current


def _compared(
    runs: Sequence[Run], current: Fit, motion: Motion, pool: ThreadPoolExecutor
) -> tuple[Fit, tuple[Candidate, ...]]:
    """The fit led to its end, and rivals of other families for each law, where little is left."""
    last = fit(
        runs, current.effects, current.values, motion, current.linear, 25, 1e-6, current.memories
    )
    if last is not None and last.cost <= current.cost and not at_bound(last, motion):
        current = last
    if not at_floor(current, runs):
        return needed_linear(runs, current, motion), ()
    current = needed_linear(runs, current, motion)
    rivals: list[Candidate] = []
    for name in current.effects:
        row = current.effects.index(name)
        less = without(current, row, runs, motion)
        if less is None:
            continue
        own = Candidate(name, 0.0, current, held_back_errors(current, runs), "")
        again = _round(runs, less, motion_of(runs, less), (*less.effects, name), pool)
        able = [c for c in again.candidates if np.isfinite(c.score) and indistinct(c, own)]
        lean = [_without_needless(runs, c, motion) for c in able]
        rivals += [c for c in lean if _size(c) <= _size(own) and indistinct(c, own)]
        best = min([own, *rivals], key=lambda c: (_size(c), c.score))
        if _size(best) < _size(own) and best.fit is not None:
            current = best.fit
            rivals.append(own)
    chosen = {effect(name).family for name in current.effects}
    left = [
        c
        for c in rivals
        if effect(c.name).family not in chosen
        and c.fit is not None
        and _size(c) <= _size(c._replace(fit=current))
    ]
    return current, tuple(sorted(left, key=lambda c: c.score))


def _size(candidate: Candidate) -> int:
    """Number of parameters and of effects, linear ones too."""
    there = _required(candidate.fit)
    return there.parameter_count + len(there.effects) + 2 * len(there.linear)


def _without_needless(runs: Sequence[Run], candidate: Candidate, motion: Motion) -> Candidate:
    lean = needed_linear(runs, _required(candidate.fit), motion)
    return candidate._replace(fit=lean, held_back=held_back_errors(lean, runs))


def needed_linear(runs: Sequence[Run], current: Fit, motion: Motion) -> Fit:
    """The fit with those linear effects alone that the runs call for."""
    linear = list(current.linear)
    least = _LATER_GAIN if current.effects else _LEAST_GAIN
    while linear:
        weakest: tuple[float, str, Fit] | None = None
        for name in linear:
            rest = [n for n in linear if n != name]
            less = _again(runs, current, motion, rest)
            if less is None or at_bound(less, motion):
                continue
            if significant(less, current, runs, least):
                continue
            if weakest is None or less.cost < weakest[0]:
                weakest = (less.cost, name, less)
        if weakest is None:
            return current
        current = weakest[2]
        linear.remove(weakest[1])
    return current


def _again(runs: Sequence[Run], current: Fit, motion: Motion, linear: Sequence[str]) -> Fit | None:
    return fit(runs, current.effects, current.values, motion, linear, 15, 1e-5, current.memories)


def coloured(result: Fit, runs: Sequence[Run]) -> float:
    """Share of what remains that is neither white nor comes from noise of the measured motion."""
    worst = 0.0
    for number, run in enumerate(runs):
        residual = result.residuals[number]
        square = float(np.mean(residual**2))
        if square <= 0.0:
            continue
        of_motion = float(np.mean(motion_noise(result, run, number) ** 2))
        worst = max(worst, colour(residual) - _MOTION_MARGIN * of_motion / square)
    return worst


def at_floor(result: Fit, runs: Sequence[Run]) -> bool:
    """Whether nothing is left but noise."""
    return coloured(result, runs) < _FLOOR_COLOUR
