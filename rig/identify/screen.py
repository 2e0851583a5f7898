"""Fast trial of every law along the measured motion.

A law's force along the smoothed motion, passed through the linear model, gives the height it would
have added. Compared with the height that the model misses, this is a regression whose noise is the
sensor's, not its second derivative's, and it needs no simulation of the law.

References:
    Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973), for parameters that enter linearly.
    Ljung, System Identification (1999), 4.3 and 16.4, output error and residual analysis.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.linalg import expm

from dart_model.effects import effect
from rig.identify.compiled import along, law, respond
from rig.identify.least_squares import solve
from rig.identify.reduced import Grid, Model, Trajectory
from rig.identify.smoother import Smoothed
from rig.identify.starts import Motion, space, starts

Array = NDArray[np.float64]

MOST_SAMPLES = 8_000
"""Samples of all runs together that a trial looks at."""

_THINNEST_ANGLE = 0.6
_FINEST_ANGLE = 0.25
_BLOCKS = 8

_LONGEST_MEMORY_STEP_S = 0.6e-3
_TONES = 4


class Segment(NamedTuple):
    """A run or a piece of one, on a grid that suits the linear model.

    Attributes:
        t_s: Even times, shape (N,).
        heights_m: Smoothed heights, shape (N, struts).
        velocities_m_per_s: Their rates.
        accelerations_m_per_s2: Their second derivatives.
        applied_n: Applied force, shape (N,).
        temperature_c: Temperature, shape (N,).
        missing_m: Height that the linear model misses, shape (N, struts).
        substeps: Steps for a law's memory between samples.
        compared: One of how many samples is compared; those between only serve the forces.
    """

    t_s: Array
    heights_m: Array
    velocities_m_per_s: Array
    accelerations_m_per_s2: Array
    applied_n: Array
    temperature_c: Array
    missing_m: Array
    substeps: int
    compared: int

    @property
    def target_m(self) -> Array:
        """Missing height at the samples that are compared, the first excluded, flat."""
        return self.missing_m[self.compared :: self.compared].ravel()


class Linear(NamedTuple):
    """The linear model, discretised for forces that are linear between samples."""

    transition: Array
    early: Array
    late: Array
    output: Array


class Stage(NamedTuple):
    """All that the trials of one round share.

    Attributes:
        model: The bench.
        segments: Runs, thinned out.
        linear: The linear model on each run's grid.
        basis: Orthonormal columns that no law may claim: free motion, and small changes of the
            effects already chosen, shape (m, columns).
        target: Missing height with those taken out, shape (m,).
        weight: Samples that one thinned sample stands for, over the noise variance.
        motions: What each strut did.
    """

    model: Model
    segments: tuple[Segment, ...]
    linear: tuple[Linear, ...]
    basis: Array
    target: Array
    weight: float
    motions: tuple[Motion, ...]


class Trial(NamedTuple):
    """How well a law does along the motion.

    Attributes:
        strut: Index of the strut.
        name: Name of the effect.
        values: Its parameters, shape (k,).
        cost: Sum of squares that it leaves, over the noise variance.
    """

    strut: int
    name: str
    values: Array
    cost: float


def linear_model(model: Model, step_s: float, duration_s: float) -> tuple[Linear, Array, Array]:
    """The linear model on a grid, and the stiffness and damping added to keep it settled.

    Returns:
        The discretisation; added stiffness and damping, each of shape (n, n).
    """
    n = model.coordinates
    rows, mass = model.rows, model.mass_kg
    stiffness = rows.T @ np.diag(model.struts[:, 1]) @ rows
    damping = rows.T @ np.diag(model.struts[:, 2]) @ rows
    more_stiffness, more_damping = np.zeros((n, n)), np.zeros((n, n))
    slowest = 6.0 * np.pi / duration_s
    if float(np.min(np.linalg.eigvals(np.linalg.solve(mass, stiffness)).real)) < slowest**2:
        more_stiffness = mass * slowest**2
    a = _system(mass, stiffness + more_stiffness, damping)
    if float(np.max(np.linalg.eigvals(a).real)) > -8.0 / duration_s:
        more_damping = mass * (16.0 / duration_s)
        a = _system(mass, stiffness + more_stiffness, damping + more_damping)
    b = np.vstack([np.zeros((n, n)), np.linalg.inv(mass)])
    m = 2 * n
    augmented = np.zeros((m + 2 * n, m + 2 * n))
    augmented[:m, :m] = a * step_s
    augmented[:m, m : m + n] = b * step_s
    augmented[m : m + n, m + n :] = np.eye(n)
    e = expm(augmented)
    late = e[:m, m + n :]
    early = e[:m, m : m + n] - late
    output = np.hstack([rows, np.zeros_like(rows)])
    parts = (e[:m, :m], early, late, output)
    linear = Linear(*(np.ascontiguousarray(p, dtype=np.float64) for p in parts))
    return linear, more_stiffness, more_damping


def _system(mass: Array, stiffness: Array, damping: Array) -> Array:
    n = len(mass)
    lower = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    return np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower], dtype=np.float64)


def response(linear: Linear, forces_n: Array) -> Array:
    """Heights (N, struts) of the linear model from rest under forces (N, n)."""
    heights = np.empty((len(forces_n), linear.output.shape[0]))
    respond(*linear, np.ascontiguousarray(forces_n), heights)
    return heights


class Sampling(NamedTuple):
    """How a run is sampled for the trials.

    Attributes:
        every: Which nodes are kept.
        finer: Samples for each of them: an input that is linear between samples must turn by a
            small angle of the fastest motion only.
        pieces: Nodes of each piece, as first and past the last.
    """

    every: int
    finer: int
    pieces: tuple[tuple[int, int], ...]


def sampling(model: Model, grid: Grid, samples: int) -> Sampling:
    """How a run is sampled: thinned out, or where its motion is too fast for that, in pieces.

    Args:
        model: The bench.
        grid: The run.
        samples: Nodes of all runs together.
    """
    angle = model.fastest_rad_per_s * grid.step_s
    every = max(1, round(samples / MOST_SAMPLES))
    every = max(1, min(every, int(_THINNEST_ANGLE / angle)))
    nodes = len(grid.t_s)
    share = MOST_SAMPLES * nodes / samples
    whole = ((0, nodes),)
    if nodes / every < 2.0 * share:
        return Sampling(every, max(1, int(np.ceil(angle * every / _FINEST_ANGLE))), whole)
    blocks = max(2, round(_BLOCKS * nodes / samples))
    length = int(share * every / blocks)
    firsts = [int(k * (nodes - length) / (blocks - 1)) for k in range(blocks)]
    pieces = tuple((first, first + length) for first in firsts)
    return Sampling(every, max(1, int(np.ceil(angle * every / _FINEST_ANGLE))), pieces)


def sampled(
    model: Model,
    grid: Grid,
    reference: Trajectory,
    base: Trajectory,
    smoothed: list[Smoothed],
    samples: int,
) -> list[tuple[Segment, Linear]]:
    """A run on the samples of the trials, and the linear model on each piece's grid.

    Args:
        model: The bench.
        grid: The run.
        reference: Simulated motion to which the smoothed difference belongs.
        base: Motion from which on something is missing.
        smoothed: Measured less `reference` heights, smoothed, one a strut.
        samples: Nodes of all runs together.
    """
    how = sampling(model, grid, samples)
    parts = [np.column_stack([s.states[:, k] for s in smoothed]) for k in range(3)]
    motion = Trajectory(*(there + more for there, more in zip(reference, parts, strict=True)))
    missing = motion.heights_m - base.heights_m
    if how.finer > 1:
        # A few samples a period are too few for the smoother: it would take motion for noise.
        missing = np.where(grid.measured[:, np.newaxis], grid.heights_m - base.heights_m, missing)
    missing_rate = motion.velocities_m_per_s - base.velocities_m_per_s
    return [
        _piece(
            model,
            grid.rows(first, last),
            Trajectory(*(values[first:last] for values in motion)),
            (missing[first:last], missing_rate[first:last]),
            how,
        )
        for first, last in how.pieces
    ]


def _piece(
    model: Model, grid: Grid, motion: Trajectory, missing: tuple[Array, Array], how: Sampling
) -> tuple[Segment, Linear]:
    # Times may be uneven: everything is put on an even grid first.
    count = ((len(grid.t_s) - 1) // how.every) * how.finer + 1
    even = grid.t_s[0] + np.arange(count) * ((grid.t_s[-1] - grid.t_s[0]) / (count - 1))
    heights, velocities, accelerations = motion
    if how.finer == 1:
        heights, velocities, accelerations = (_put(even, grid.t_s, values) for values in motion)
    else:
        heights = CubicHermiteSpline(grid.t_s, heights, velocities)(even)
        velocities = CubicHermiteSpline(grid.t_s, velocities, accelerations)(even)
        accelerations = CubicSpline(grid.t_s, accelerations)(even)
    target, target_rate = (_put(even, grid.t_s, values) for values in missing)
    step_s = float(even[1] - even[0])
    linear, stiffness, damping = linear_model(model, step_s, float(even[-1] - even[0]))
    if np.any(stiffness) or np.any(damping):
        inverse = np.linalg.inv(model.rows).T
        held = (target @ inverse) @ stiffness + (target_rate @ inverse) @ damping
        target = target - response(linear, held)
    fine_t = np.linspace(0.0, len(grid.t_s) - 1.0, len(grid.fine_n))
    node = np.interp(even, grid.t_s, np.arange(len(grid.t_s), dtype=np.float64))
    segment = Segment(
        even,
        np.ascontiguousarray(heights),
        np.ascontiguousarray(velocities),
        np.ascontiguousarray(accelerations),
        np.interp(node, fine_t, grid.fine_n),
        _put(even, grid.t_s, grid.temperature_c),
        target,
        max(1, int(np.ceil(step_s / _LONGEST_MEMORY_STEP_S - 1e-9))),
        how.finer,
    )
    return segment, linear


def _put(even: Array, t_s: Array, values: Array) -> Array:
    if values.ndim == 1:
        return np.interp(even, t_s, values)
    return np.column_stack([np.interp(even, t_s, column) for column in values.T])


def law_force(model: Model, segment: Segment, strut: int, name: str, values: Array) -> Array:
    """Generalised force of an effect along the motion, shape (N, n)."""
    item = effect(name)
    force = np.empty(len(segment.t_s))
    functions = law(name)
    along(
        functions.force,
        functions.rate,
        values,
        model.struts[strut],
        segment.t_s,
        np.ascontiguousarray(segment.heights_m[:, strut]),
        np.ascontiguousarray(segment.velocities_m_per_s[:, strut]),
        segment.applied_n,
        segment.temperature_c,
        segment.substeps,
        np.zeros(item.state_size),
        force,
    )
    general = force[:, np.newaxis] * model.rows[strut]
    if item.adds_mass:
        q = np.linalg.solve(model.rows, segment.accelerations_m_per_s2.T).T
        general = general + values[0] * (
            model.gravity_by_strut[strut] - q @ model.mass_by_strut[strut]
        )
    return general


def _heights(
    model: Model,
    segments: tuple[Segment, ...],
    linear: tuple[Linear, ...],
    strut: int,
    name: str,
    values: Array,
) -> Array:
    parts = [
        response(lin, law_force(model, seg, strut, name, values))[
            seg.compared :: seg.compared
        ].ravel()
        for seg, lin in zip(segments, linear, strict=True)
    ]
    return np.concatenate(parts)


def less_known(
    model: Model,
    pieces: list[tuple[Segment, Linear]],
    chosen: list[tuple[int, str, Array]],
) -> list[tuple[Segment, Linear]]:
    """The pieces, what effects add along the measured motion taken from what is missing.

    Args:
        model: The bench.
        pieces: Runs, on their samples.
        chosen: Effects found so far: strut, name, parameters.
    """
    left: list[tuple[Segment, Linear]] = []
    for segment, linear in pieces:
        missing = segment.missing_m
        for strut, name, values in chosen:
            missing = missing - response(linear, law_force(model, segment, strut, name, values))
        left.append((segment._replace(missing_m=missing), linear))
    return left


def stage(
    model: Model,
    pieces: list[tuple[Segment, Linear]],
    chosen: list[tuple[int, str, Array]],
    weight: float,
) -> Stage:
    """What the trials of a round share.

    Args:
        model: The bench.
        pieces: Runs, on their samples.
        chosen: Effects found so far: strut, name, parameters. What they add is no longer in what
            is missing, but small changes of them may still be.
        weight: See `Stage`.
    """
    segments = tuple(segment for segment, _ in pieces)
    linear = tuple(lin for _, lin in pieces)
    target = np.concatenate([segment.target_m for segment in segments])
    columns = _free_motion(segments, linear)
    for strut, name, values in chosen:
        there = _heights(model, segments, linear, strut, name, values)
        for i, value in enumerate(values):
            moved = values.copy()
            moved[i] += 1e-4 * max(abs(value), 1e-6)
            change = _heights(model, segments, linear, strut, name, moved) - there
            columns.append(change)
    sizes = [float(np.linalg.norm(c)) for c in columns]
    kept = [c / s for c, s in zip(columns, sizes, strict=True) if 0.0 < s < np.inf]
    basis = np.linalg.qr(np.column_stack(kept))[0]
    target = target - basis @ (basis.T @ target)
    motions = tuple(_motion(model, segments, linear, i, target) for i in range(len(model.struts)))
    return Stage(model, segments, linear, basis, target, weight, motions)


def _free_motion(segments: tuple[Segment, ...], linear: tuple[Linear, ...]) -> list[Array]:
    columns: list[Array] = []
    sizes = [segment.target_m.size for segment in segments]
    for k, (segment, lin) in enumerate(zip(segments, linear, strict=True)):
        size = lin.transition.shape[0]
        for i in range(size):
            impulse = np.zeros((len(segment.t_s), size))
            impulse[0, i] = 1.0
            free = np.empty_like(segment.missing_m)
            respond(lin.transition, np.eye(size), np.zeros((size, size)), lin.output, impulse, free)
            whole = np.zeros(sum(sizes))
            whole[sum(sizes[:k]) : sum(sizes[: k + 1])] = free[
                segment.compared :: segment.compared
            ].ravel()
            columns.append(whole)
    return columns


def _motion(
    model: Model,
    segments: tuple[Segment, ...],
    linear: tuple[Linear, ...],
    strut: int,
    target: Array,
) -> Motion:
    z = np.concatenate([s.heights_m[:, strut] for s in segments])
    v = np.concatenate([s.velocities_m_per_s[:, strut] for s in segments])
    temperature = np.concatenate([s.temperature_c for s in segments])
    free_length, stiffness, damping, _ = (float(x) for x in model.struts[strut])
    return Motion(
        z,
        v,
        free_length,
        stiffness,
        damping,
        max(float(s.t_s[-1] - s.t_s[0]) for s in segments),
        (float(temperature.min()), float(temperature.max())),
        tuple(_tones(model, segments, linear, strut, target)),
        float(np.trace(model.mass_by_strut[strut] @ model.mass_kg)
              / max(float(np.trace(model.mass_by_strut[strut])), 1e-12)),
    )  # fmt: skip


def _tones(
    model: Model,
    segments: tuple[Segment, ...],
    linear: tuple[Linear, ...],
    strut: int,
    target: Array,
) -> list[tuple[float, float]]:
    """Frequency and phase of the lines that explain most of the target's longest run."""
    longest = int(np.argmax([len(s.t_s) for s in segments]))
    segment = segments[longest]
    struts = segment.missing_m.shape[1]
    first = sum(s.target_m.size for s in segments[:longest])
    y = target[first : first + segment.target_m.size].reshape(-1, struts)[:, strut]
    n = len(y)
    step = float(segment.t_s[1] - segment.t_s[0]) * segment.compared
    spectrum = np.abs(np.fft.rfft(y * np.hanning(n), 4 * n)) ** 2
    frequencies = np.fft.rfftfreq(4 * n, step)
    spectrum[frequencies < 1.5 / (n * step)] = 0.0
    # A line stands out of its own neighbourhood, whatever the model's resonance does to both.
    around = _moving_mean(spectrum, 4 * 12) + 1e-3 * float(spectrum.mean()) + 1e-300
    found: list[tuple[float, float]] = []
    for ranking in (spectrum, spectrum / around):
        left = ranking.copy()
        for _ in range(_TONES):
            peak = int(np.argmax(left))
            frequency = float(frequencies[peak])
            left[max(0, peak - 16) : peak + 17] = 0.0
            if all(abs(frequency - f) > 0.3 / (n * step) for f, _ in found):
                found.append(
                    (frequency, _phase(segment, linear[longest], y, frequency, strut, model))
                )
    return found


def _moving_mean(values: Array, half: int) -> Array:
    sums = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    low, high = np.maximum(index - half, 0), np.minimum(index + half + 1, len(values))
    return (sums[high] - sums[low]) / (high - low)


def _phase(
    segment: Segment, linear: Linear, y: Array, frequency: float, strut: int, model: Model
) -> float:
    angle = 2.0 * np.pi * frequency * segment.t_s
    columns = [
        response(linear, f(angle)[:, np.newaxis] * model.rows[strut])[
            segment.compared :: segment.compared, strut
        ]
        for f in (np.sin, np.cos)
    ]
    sine, cosine = np.linalg.lstsq(np.column_stack(columns), y, rcond=None)[0]
    return float(np.arctan2(cosine, sine))


def begin(shared: Stage, strut: int, name: str) -> list[Trial]:
    """A law at its starts, best first; empty where the run cannot show it.

    Args:
        shared: The round.
        strut: Index of the strut.
        name: Name of the effect.
    """
    motion = shared.motions[strut]
    scaled = list(effect(name).scaled)
    begun: list[Trial] = []
    for start in starts(name, motion):
        values = np.array(start, dtype=np.float64)
        bounds = space(name, motion, values)
        values = np.clip(values, bounds.low, bounds.high)
        h = _claimed(shared, strut, name, values)
        power = float(h @ h)
        if not np.isfinite(power) or power <= 0.0:
            continue
        if scaled:
            factor = float(h @ shared.target) / power
            values[scaled] *= factor
            inside = np.clip(values, bounds.low, bounds.high)
            h = h * factor
            if not np.array_equal(inside, values):
                values = inside
                h = _claimed(shared, strut, name, values)
        left = shared.target - h
        begun.append(Trial(strut, name, values, float(left @ left) * shared.weight))
    return sorted(begun, key=lambda trial: trial.cost)


def polish(shared: Stage, trial: Trial, iterations: int) -> Trial:
    """The best that a law does along the motion, from a start on."""
    bounds = space(trial.name, shared.motions[trial.strut], trial.values)
    solution = solve(
        lambda p: shared.target - _claimed(shared, trial.strut, trial.name, p),
        trial.values,
        bounds,
        iterations,
        1e-3,
    )
    if solution is None or not np.isfinite(solution.cost):
        return trial
    return Trial(trial.strut, trial.name, solution.values, solution.cost * shared.weight)


def _claimed(shared: Stage, strut: int, name: str, values: Array) -> Array:
    h = _heights(shared.model, shared.segments, shared.linear, strut, name, values)
    return h - shared.basis @ (shared.basis.T @ h)
