"""Laws along an imposed motion, fitted to what the load cell measures.

Nothing is simulated here: the motion is known, so a law's force along it is a matter of one pass,
and the only state that is left is the memory of the laws. Stiffness, damping and preload enter
linearly and are solved for in every evaluation.

References:
    Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973), for parameters that enter linearly.
    White, Maximum likelihood estimation of misspecified models, Econometrica 50 (1982), for
    intervals where what remains is coloured.
    Cook and Stefanski, J. Am. Stat. Assoc. 89 (1994), for errors in the measured motion.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.spec import ModelSpec
from rig.identify.compiled import along, compile_loop, law
from rig.identify.least_squares import Solution, Space, solve
from rig.identify.records import Record
from rig.identify.reduced import NO_TEMPERATURE_C
from rig.identify.smoother import estimate_noise, smooth
from rig.identify.starts import Motion, space

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

LINEAR = ("linear_stiffness", "linear_damping", "preload")
"""Effects that enter linearly, in the order of the columns."""

_LONGEST_MEMORY_STEP_S = 0.6e-3
_BLOCKS = 24
_FOLDS = 6
_LEAST_BLOCK = 8
_REFITTED = 5
_BLOCK_S = 0.5
_NO_NUMBERS = np.zeros(0)

_REMEMBERED = {"bouc_wen": 1.0, "dahl": 1.0, "iwan": 0.25, "maxwell": np.inf}
"""Laws whose memory outlasts the start of a run, and the largest value of it; one number stands for
all elements of a law that has several."""


class Run(NamedTuple):
    """An imposed motion and the force that it took.

    Attributes:
        name: Name of the record.
        t_s: Times, shape (N,).
        height_m: Smoothed heights, shape (N,).
        velocity_m_per_s: Smoothed velocities, shape (N,).
        force_n: Load cell, shape (N,).
        given_n: Force of the model as given, shape (N,).
        temperature_c: Temperature, shape (N,).
        substeps: Steps for a law's memory between samples.
        counted: Samples that a fit looks at, shape (n,).
        strut: Free length, stiffness, damping and gravity, shape (4,).
        retraced: The motion again, smoothed with a second draw of the sensor's noise: heights and
            velocities, shape (2, N).
        height_noise_m: Standard deviation of the height's noise.
    """

    name: str
    t_s: Array
    height_m: Array
    velocity_m_per_s: Array
    force_n: Array
    given_n: Array
    temperature_c: Array
    substeps: int
    counted: Integers
    strut: Array
    retraced: Array
    height_noise_m: float

    @property
    def duration_s(self) -> float:
        """Time from first to last sample."""
        return float(self.t_s[-1] - self.t_s[0])

    def missing_n(self) -> Array:
        """Load cell less the model as given, at the samples that count."""
        return (self.force_n - self.given_n)[self.counted]

    def thinned(self, every: int) -> "Run":
        """The run with fewer samples that count."""
        return self._replace(counted=self.counted[::every])

    def rows(self, first: int, last: int) -> "Run":
        """Samples `first` to `last`, the last one excluded."""
        inside = self.counted[(self.counted >= first) & (self.counted < last)] - first
        cut = slice(first, last)
        return self._replace(
            t_s=self.t_s[cut],
            height_m=np.ascontiguousarray(self.height_m[cut]),
            velocity_m_per_s=np.ascontiguousarray(self.velocity_m_per_s[cut]),
            force_n=self.force_n[cut],
            given_n=self.given_n[cut],
            temperature_c=np.ascontiguousarray(self.temperature_c[cut]),
            counted=inside,
            retraced=np.ascontiguousarray(self.retraced[:, cut]),
        )


def run_of(record: Record, spec: ModelSpec) -> Run:
    """The motion of a record, smoothed over its whole length, beside its load cell.

    Args:
        record: A record with one height and a strut force.
        spec: The model, with one strut.
    """
    assert record.strut_force_n is not None
    t_s, at = _nodes(record.t_s)
    height = np.full(len(t_s), np.nan)
    height[at] = record.heights_m[:, 0]
    usual_s = float(t_s[-1] - t_s[0]) / (len(t_s) - 1)
    middle = float(np.nanmean(height))
    noise = estimate_noise(t_s, height - middle)
    states = smooth(t_s, height - middle, noise).states
    rng = np.random.default_rng(1)
    noisy = states[:, 0] + np.sqrt(noise.variance) * rng.standard_normal(len(height))
    again = smooth(t_s, np.where(np.isfinite(height), noisy, np.nan), noise).states
    strut = spec.struts[0]
    run = Run(
        record.name,
        np.ascontiguousarray(t_s),
        np.ascontiguousarray(states[:, 0] + middle),
        np.ascontiguousarray(states[:, 1]),
        np.interp(t_s, record.t_s, record.strut_force_n),
        np.zeros(len(t_s)),
        _temperature(record, t_s),
        max(1, int(np.ceil(usual_s / _LONGEST_MEMORY_STEP_S - 1e-9))),
        np.flatnonzero(np.isfinite(height)),
        np.array([
            strut.free_length_m, strut.stiffness_n_per_m, strut.damping_n_s_per_m,
            spec.gravity_m_per_s2,
        ]),
        np.ascontiguousarray([again[:, 0] + middle, again[:, 1]]),
        float(np.sqrt(noise.variance)),
    )  # fmt: skip
    return run._replace(given_n=given_force(run, spec))


def spring_damper_force(run: Run) -> Array:
    """Force of the strut's own spring and damper along a run, shape (N,)."""
    free, stiffness, damping, _ = run.strut
    return stiffness * (free - run.height_m) - damping * run.velocity_m_per_s


def given_force(run: Run, spec: ModelSpec) -> Array:
    """Strut force of a model along the run, shape (N,).

    What its effects remember at the start of the run is fitted, for nobody measured it.
    """
    spring = spring_damper_force(run)
    items = spec.struts[0].effects
    if not items:
        return spring
    names = [item.name for item in items]
    values = [np.array(item.values()) for item in items]
    there = along_run(run._replace(given_n=spring), names, values)
    return spring + there


def along_run(run: Run, names: Sequence[str], values: Sequence[Array]) -> Array:
    """Force of given laws along a run beside `given_n`, their first memory fitted, shape (N,)."""
    total = np.zeros(len(run.t_s))
    memories = first_memories(run, names, values)
    for name, value, memory in zip(names, values, memories, strict=True):
        total += law_force(run, name, value, memory)
    return total


def first_memories(run: Run, names: Sequence[str], values: Sequence[Array]) -> tuple[Array, ...]:
    """What given laws remember at the start of a run, fitted beside `given_n`."""
    span = (float(run.temperature_c.min()), float(run.temperature_c.max()))
    free, stiffness, damping, _ = (float(x) for x in run.strut)
    motion = Motion(
        run.height_m, run.velocity_m_per_s, free, stiffness, damping, run.duration_s, span, (), 1.0
    )
    result = fit([run], names, values, motion, (), fixed=True)
    if result is None:
        return tuple(np.zeros(effect(name).state_size) for name in names)
    return result.memories[0]


def _nodes(t_s: Array) -> tuple[Array, Integers]:
    """Times with further ones in gaps, so that memory takes no long steps, and where each was."""
    steps = np.diff(t_s)
    pieces = np.maximum(1, np.rint(steps / np.median(steps))).astype(np.int64)
    at = np.concatenate([[0], np.cumsum(pieces)])
    return np.interp(np.arange(at[-1] + 1), at, t_s), at


def _temperature(record: Record, t_s: Array) -> Array:
    # Oil warms slowly; the sensor's noise would make the damper tremble.
    measured = record.temperature_c
    if measured is None or float(np.ptp(measured)) == 0.0:
        return np.full(len(t_s), NO_TEMPERATURE_C if measured is None else float(measured[0]))
    smoothed = smooth(record.t_s, measured, estimate_noise(record.t_s, measured))
    return np.interp(t_s, record.t_s, smoothed.states[:, 0])


def retraced(run: Run) -> Run:
    """The run along the motion of the second draw."""
    height, velocity = run.retraced
    return run._replace(height_m=height, velocity_m_per_s=velocity)


def law_force(run: Run, name: str, values: Array, memory: Array) -> Array:
    """Force of a law along the run, its memory beginning at `memory`, shape (N,)."""
    force = np.empty(len(run.t_s))
    functions = law(name)
    along(
        functions.force,
        functions.rate,
        np.ascontiguousarray(values),
        run.strut,
        run.t_s,
        run.height_m,
        run.velocity_m_per_s,
        np.zeros(len(run.t_s)),
        run.temperature_c,
        run.substeps,
        memory,
        force,
    )
    return force


def linear_columns(run: Run, names: Sequence[str]) -> Array:
    """Force of each linear effect per unit, along the samples that count, shape (n, names)."""
    all_of = {
        "linear_stiffness": run.strut[0] - run.height_m,
        "linear_damping": -run.velocity_m_per_s,
        "preload": np.ones(len(run.t_s)),
    }
    return np.column_stack(
        [all_of[name][run.counted] for name in names] or [np.zeros((len(run.counted), 0))]
    )


def _take_out(basis: Array, values: Array) -> None:
    for i in range(basis.shape[0]):
        share = 0.0
        for k in range(values.shape[0]):
            share += basis[i, k] * values[k]
        for k in range(values.shape[0]):
            values[k] -= share * basis[i, k]


take_out = compile_loop(
    _take_out, types.void(types.Array(types.float64, 2, "C"), types.Array(types.float64, 1, "C"))
)
"""Take orthonormal rows (k, m) out of values (m,), in place: on one core, where a pool of threads
would cost more than it gives."""


class Fit(NamedTuple):
    """Laws fitted to the load cell.

    Attributes:
        effects: Names of the laws.
        values: Parameters of each, in order.
        memories: Memory of each law at the start of each run: `memories[run][law]`.
        linear: Linear effects that were fitted beside them.
        amounts: Their parameters, shape (linear,).
        residuals: Load cell less model of each run, at the samples that count.
        jacobian: Derivative of the residual by search variables and linear amounts, shape (m, p).
        bounds: Where the laws' parameters and memories were searched.
        cost: Sum of squares in N².
    """

    effects: tuple[str, ...]
    values: tuple[Array, ...]
    memories: tuple[tuple[Array, ...], ...]
    linear: tuple[str, ...]
    amounts: Array
    residuals: tuple[Array, ...]
    jacobian: Array
    bounds: Space
    cost: float

    @property
    def samples(self) -> int:
        """Number of samples."""
        return sum(len(residual) for residual in self.residuals)

    @property
    def mean_square(self) -> float:
        """Mean square of the residual in N²."""
        return self.cost / self.samples

    @property
    def parameter_count(self) -> int:
        """Parameters of the laws; linear effects, which everybody has, are not counted."""
        return sum(len(values) for values in self.values)


class _Layout(NamedTuple):
    """Where a search vector holds what: slices of each law, and the memory of (run, law)."""

    laws: tuple[slice, ...]
    memories: dict[tuple[int, int], int]


def _layout(effects: Sequence[str], runs: int) -> _Layout:
    laws: list[slice] = []
    first = 0
    for name in effects:
        count = len(effect(name).parameters)
        laws.append(slice(first, first + count))
        first += count
    remembered = [i for i, name in enumerate(effects) if name in _REMEMBERED]
    keys = [(run, i) for run in range(runs) for i in remembered]
    return _Layout(tuple(laws), {key: first + n for n, key in enumerate(keys)})


def _space(effects: Sequence[str], first: Array, layout: _Layout, motion: Motion) -> Space:
    parts = [
        space(name, motion, first[part]) for name, part in zip(effects, layout.laws, strict=True)
    ]
    reach = np.array([_REMEMBERED[effects[i]] for _, i in layout.memories])
    scale = np.where(np.isfinite(reach), 1.0, motion.stroke)
    return Space(
        np.concatenate([_NO_NUMBERS, *(s.low for s in parts), -reach]),
        np.concatenate([_NO_NUMBERS, *(s.high for s in parts), reach]),
        np.concatenate([_NO_NUMBERS, *(s.scale for s in parts), scale]),
        np.concatenate([*(s.logarithmic for s in parts), np.zeros(len(reach), dtype=np.bool_)]),
    )


def _memory(layout: _Layout, x: Array, run: int, row: int, name: str) -> Array:
    memory = np.zeros(effect(name).state_size)
    if (run, row) in layout.memories:
        memory[:] = x[layout.memories[run, row]]
    return memory


class _Forces:
    """Forces of laws along runs, kept as long as their own parameters stay the same."""

    def __init__(self, effects: Sequence[str], runs: Sequence[Run], layout: _Layout) -> None:
        self._effects, self._runs, self._layout = effects, runs, layout
        self._one = lru_cache(maxsize=4 * max(1, len(effects) * len(runs)))(self._computed)

    def _computed(self, run: int, row: int, values: bytes, memory: bytes) -> Array:
        there, name = self._runs[run], self._effects[row]
        force = law_force(there, name, np.frombuffer(values).copy(), np.frombuffer(memory).copy())
        return force[there.counted]

    def total(self, x: Array) -> Array:
        """Force of all laws along all runs."""
        parts: list[Array] = []
        for number, run in enumerate(self._runs):
            total = np.zeros(len(run.counted))
            for row, name in enumerate(self._effects):
                memory = _memory(self._layout, x, number, row, name)
                total += self._one(
                    number, row, x[self._layout.laws[row]].tobytes(), memory.tobytes()
                )
            parts.append(total)
        return np.concatenate(parts)


def fit(
    runs: Sequence[Run],
    effects: Sequence[str],
    values: Sequence[Array],
    motion: Motion,
    linear: Sequence[str] = LINEAR,
    iterations: int = 15,
    tolerance: float = 1e-4,
    memories: Sequence[Sequence[Array]] | None = None,
    fixed: bool = False,
) -> Fit | None:
    """Fit laws and linear effects to the load cell.

    Args:
        runs: The runs.
        effects: Names of the laws.
        values: First parameters of each.
        motion: What the strut did, for the bounds.
        linear: Linear effects that are free; the others stay as in the model as given.
        iterations: Most steps.
        tolerance: Relative gain below which the fit ends.
        memories: First memories, as in `Fit`; zero if absent.
        fixed: Only the memories at the start of the runs are fitted.

    Returns:
        The fit, or None if a law has no finite force at its start.
    """
    layout = _layout(effects, len(runs))
    first = np.concatenate([_NO_NUMBERS, *values, np.zeros(len(layout.memories))])
    if memories is not None:
        for (run, row), place in layout.memories.items():
            first[place] = memories[run][row][0]
    whole = _space(effects, first, layout, motion)
    free = np.ones(len(first), dtype=np.bool_)
    if fixed:
        free[: len(first) - len(layout.memories)] = False
    bounds = Space(whole.low[free], whole.high[free], whole.scale[free], whole.logarithmic[free])
    columns = np.concatenate([linear_columns(run, linear) for run in runs])
    basis = np.ascontiguousarray(np.linalg.qr(columns)[0].T)
    target = np.concatenate([run.missing_n() for run in runs])
    forces = _Forces(effects, runs, layout)

    def at(inner: Array) -> Array:
        x = first.copy()
        x[free] = inner
        return x

    def left(inner: Array) -> Array | None:
        missed = target - forces.total(at(inner))
        take_out(basis, missed)
        return missed if np.isfinite(np.sum(missed)) else None

    begin = np.clip(first[free], bounds.low, bounds.high)
    solution = solve(left, begin, bounds, iterations, tolerance)
    if solution is None:
        return None
    missed = target - forces.total(at(solution.values))
    amounts = _solved(columns, missed)
    jacobian = np.column_stack([_differences(forces, at, solution, bounds), -columns])
    x = at(solution.values)
    return Fit(
        tuple(effects),
        tuple(x[part] for part in layout.laws),
        tuple(
            tuple(_memory(layout, x, run, row, name) for row, name in enumerate(effects))
            for run in range(len(runs))
        ),
        tuple(linear),
        amounts,
        _split(missed - columns @ amounts, runs),
        jacobian,
        bounds,
        solution.cost,
    )


def _solved(columns: Array, target: Array) -> Array:
    if columns.shape[1] == 0:
        return _NO_NUMBERS
    sizes = np.linalg.norm(columns, axis=0)
    sizes[sizes <= 0.0] = 1.0
    return np.linalg.lstsq(columns / sizes, target, rcond=None)[0] / sizes


def _split(values: Array, runs: Sequence[Run]) -> tuple[Array, ...]:
    ends = np.cumsum([len(run.counted) for run in runs])[:-1]
    return tuple(np.split(values, ends))


def _differences(
    forces: _Forces, at: Callable[[Array], Array], solution: Solution, bounds: Space
) -> Array:
    """Derivative of the residual by the search variables, linear effects held."""
    x = bounds.inner(solution.values)
    base = forces.total(at(bounds.outer(x)))
    columns = np.zeros((len(base), len(x)))
    for i in range(len(x)):
        size = 1e-4 * (1.0 if bounds.logarithmic[i] else max(1.0, abs(x[i])))
        for step in (size, -size):
            trial = x.copy()
            trial[i] += step
            moved_by = float(bounds.inner(bounds.outer(trial))[i] - x[i])
            if abs(moved_by) >= 0.5 * size:
                columns[:, i] = (base - forces.total(at(bounds.outer(trial)))) / moved_by
                break
    return columns


def block_ends(runs: Sequence[Run]) -> list[slice]:
    """Consecutive stretches of the runs' samples, of about the same number in all."""
    samples = sum(len(run.counted) for run in runs)
    size = max(_LEAST_BLOCK, samples // max(_BLOCKS, 4 * len(runs)))
    found: list[slice] = []
    first = 0
    for run in runs:
        count = len(run.counted)
        pieces = max(4, round(count / size))
        edges = first + np.linspace(0, count, pieces + 1).astype(np.int64)
        found += [slice(int(a), int(b)) for a, b in pairwise(edges)]
        first += count
    return found


def held_back_errors(result: Fit, runs: Sequence[Run]) -> Array:
    """Squared error of each block when it takes no part in the fit, shape (blocks,).

    Every sixth block is left out at a time, and the laws are fitted anew to the others; what they
    remember at the start of a run, which the first block alone can tell, stays as it is.
    """
    blocks = block_ends(runs)
    layout = _layout(result.effects, len(runs))
    forces = _Forces(result.effects, runs, layout)
    x = np.concatenate([_NO_NUMBERS, *result.values, np.zeros(len(layout.memories))])
    for (run, row), place in layout.memories.items():
        x[place] = result.memories[run][row][0]
    laws = slice(0, result.parameter_count)
    whole = result.bounds
    bounds = Space(whole.low[laws], whole.high[laws], whole.scale[laws], whole.logarithmic[laws])
    columns = np.concatenate([linear_columns(run, result.linear) for run in runs])
    target = np.concatenate([run.missing_n() for run in runs])
    errors = np.empty(len(blocks))

    def missed_by(values: Array) -> Array:
        return target - forces.total(np.concatenate([values, x[laws.stop :]]))

    for fold in range(_FOLDS):
        within = np.ones(len(target), dtype=np.bool_)
        for block in blocks[fold::_FOLDS]:
            within[block] = False
        kept = np.flatnonzero(within)
        basis = np.ascontiguousarray(np.linalg.qr(columns[kept])[0].T)

        def left(values: Array) -> Array | None:
            missed = missed_by(values)[kept]  # noqa: B023
            take_out(basis, missed)  # noqa: B023
            return missed if np.isfinite(np.sum(missed)) else None

        solution = solve(left, x[laws], bounds, _REFITTED, 1e-3) if laws.stop else None
        missed = missed_by(x[laws] if solution is None else solution.values)
        missed = missed - columns @ _solved(columns[kept], missed[kept])
        for number in range(fold, len(blocks), _FOLDS):
            there = missed[blocks[number]]
            errors[number] = float(there @ there)
    return errors


def motion_noise(result: Fit, run: Run, number: int) -> Array:
    """Force that noise of the measured heights makes, at the samples that count.

    Args:
        result: A fit.
        run: A run.
        number: Its place among the runs of the fit.
    """
    again = retraced(run)
    total = spring_damper_force(run) - spring_damper_force(again)
    for name, values, memory in zip(
        result.effects, result.values, result.memories[number], strict=True
    ):
        total = (
            total + law_force(run, name, values, memory) - law_force(again, name, values, memory)
        )
    columns = linear_columns(run, result.linear) - linear_columns(again, result.linear)
    return total[run.counted] + columns @ result.amounts


class Interval(NamedTuple):
    """95 % intervals: ends for the laws' parameters and for the linear effects."""

    low: Array
    high: Array
    linear_low: Array
    linear_high: Array


def intervals(result: Fit, runs: Sequence[Run]) -> Interval:
    """95 % intervals of all parameters.

    Sums of the score over stretches of half a second or more stand for the colour of what remains
    (White's sandwich), and the covariance for white noise is a lower limit. What smoothing and
    noise of the measured motion do to the parameters is seen from smoothing it once more
    (simulation and extrapolation), and added.
    """
    jacobian, residual = result.jacobian, np.concatenate(result.residuals)
    size = np.linalg.norm(jacobian, axis=0)
    size[size <= 0.0] = 1.0
    scaled = jacobian / size
    inverse = np.linalg.pinv(scaled.T @ scaled, rcond=1e-12)
    count = len(residual)
    white = inverse * float(residual @ residual) / max(count - len(size), 1)
    blocks = _score_blocks(runs)
    scores = np.array([scaled[b].T @ residual[b] for b in blocks])
    robust = inverse @ (scores.T @ scores) @ inverse * (len(blocks) / max(len(blocks) - 1, 1))
    of_motion = np.concatenate([motion_noise(result, run, k) for k, run in enumerate(runs)])
    shift = inverse @ (scaled.T @ of_motion)
    variance = (np.maximum(np.diag(white), np.diag(robust)) + shift**2) / size**2
    reach = 2.0 * np.sqrt(np.maximum(variance, 0.0))
    k, whole = result.parameter_count, result.jacobian.shape[1] - len(result.linear)
    values = np.concatenate([_NO_NUMBERS, *result.values])
    bounds = result.bounds
    logarithmic, scale = bounds.logarithmic[:k], bounds.scale[:k]
    growth = np.exp(np.minimum(reach[:k], 50.0))
    low = np.where(logarithmic, values / growth, values - reach[:k] * scale)
    high = np.where(logarithmic, values * growth, values + reach[:k] * scale)
    return Interval(
        np.maximum(low, bounds.low[:k]),
        np.minimum(high, bounds.high[:k]),
        result.amounts - reach[whole:],
        result.amounts + reach[whole:],
    )


def _score_blocks(runs: Sequence[Run]) -> list[slice]:
    found: list[slice] = []
    first = 0
    for run in runs:
        count = len(run.counted)
        pieces = int(np.clip(run.duration_s / _BLOCK_S, 6, 60))
        edges = first + np.linspace(0, count, pieces + 1).astype(np.int64)
        found += [slice(int(a), int(b)) for a, b in pairwise(edges)]
        first += count
    return found
