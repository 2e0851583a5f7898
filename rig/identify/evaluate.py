"""Before and after: open loop, on data that had no part in the choice.

An observer with a high gain hides any model error. Here the model runs alone in DART, with the
applied force as its only input; only its initial state, which nobody measured, is fitted.
"""

# numba and scipy ship no types for what is used here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownLambdaType=false

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from rig.identify.compiled import along, law
from rig.identify.correct import corrected_model, dart_heights, steps_on_dart
from rig.identify.output_error import Fit, fit
from rig.identify.reduced import Grid, Model, Planted, Trajectory, mass_and_gravity, planted, run
from rig.identify.smoother import Noise, Smoothed, estimate_noise, smooth
from rig.identify.starts import Motion

Array = NDArray[np.float64]

_START_S = 3.0


class Motions(NamedTuple):
    """Smoothed motion of the struts, each of shape (N, struts)."""

    heights_m: Array
    velocities_m_per_s: Array
    accelerations_m_per_s2: Array
    deviations: tuple[Smoothed, ...]


class Missing(NamedTuple):
    """Strut force that a model lacks along the measured motion.

    Attributes:
        force_n: The force, shape (N, struts).
        deviation_n: Its standard deviation, shape (N, struts).
        motions: The motion along which it was found.
    """

    force_n: Array
    deviation_n: Array
    motions: Motions


class RunResult(NamedTuple):
    """A held-out run.

    Attributes:
        grid: The run.
        before_m: Heights of the model as given in DART, shape (N, struts).
        after_m: Heights of the corrected model in DART.
        missing_before: Strut force that the model as given lacks.
        missing_after: Strut force that the corrected model lacks.
        strut_before_n: Strut force of the model as given, shape (N, struts).
        strut_after_n: Strut force of the corrected model.
    """

    grid: Grid
    before_m: Array
    after_m: Array
    missing_before: Missing
    missing_after: Missing
    strut_before_n: Array
    strut_after_n: Array


def smoothed_motion(grid: Grid, reference: Trajectory, noises: Sequence[Noise] | None) -> Motions:
    """Measured motion: simulated plus the smoothed difference.

    Args:
        grid: The run.
        reference: A simulation of it.
        noises: Noise and random walk of each strut; estimated if absent.
    """
    found: list[Smoothed] = []
    for i, column in enumerate((grid.heights_m - reference.heights_m).T):
        noise = noises[i] if noises else estimate_noise(grid.t_s, column)
        found.append(smooth(grid.t_s, column, noise))
    parts = [np.column_stack([s.states[:, k] for s in found]) for k in range(3)]
    return Motions(
        reference.heights_m + parts[0],
        reference.velocities_m_per_s + parts[1],
        reference.accelerations_m_per_s2 + parts[2],
        tuple(found),
    )


def strut_forces(
    model: Model, what: Planted, values: Array, start: Array, grid: Grid, motion: Motions
) -> tuple[Array, list[Array]]:
    """Strut force of a model along a motion, and what each effect adds to it.

    Returns:
        Forces (N, struts), and the force of each effect (N,); an added mass counts with its
        inertia and weight.
    """
    free, stiffness, damping = (model.struts[:, k] for k in range(3))
    total = -stiffness * (motion.heights_m - free) - damping * motion.velocities_m_per_s
    n = 2 * model.coordinates
    parts: list[Array] = []
    for row, (strut, name) in enumerate(what.effects):
        at = what.slots.index[row]
        functions = law(name)
        force = np.empty(len(grid.t_s))
        along(
            functions.force, functions.rate,
            np.ascontiguousarray(values[at[1] : at[2]]), model.struts[strut], grid.t_s,
            np.ascontiguousarray(motion.heights_m[:, strut]),
            np.ascontiguousarray(motion.velocities_m_per_s[:, strut]),
            grid.applied_n, grid.temperature_c, max(2, grid.substeps),
            np.ascontiguousarray(start[n + at[3] : n + at[4]]), force,
        )  # fmt: skip
        total[:, strut] += force
        if effect(name).adds_mass:
            q = np.linalg.solve(model.rows, motion.accelerations_m_per_s2.T).T
            inertia = model.gravity_by_strut[strut] - q @ model.mass_by_strut[strut]
            force = force + values[at[1]] * np.linalg.solve(model.rows.T, inertia.T).T[:, strut]
        parts.append(force)
    return total, parts


def missing_force(
    model: Model, what: Planted, values: Array, start: Array, grid: Grid, motion: Motions
) -> Missing:
    """Strut force that a model lacks along a motion, without any observer's lag."""
    mass, gravity = mass_and_gravity(model, what, values)
    q = np.linalg.solve(model.rows, motion.accelerations_m_per_s2.T).T
    needed = q @ mass - gravity - grid.applied_n[:, np.newaxis] * model.applied_row
    needed = np.linalg.solve(model.rows.T, needed.T).T
    inertia = np.abs(np.linalg.solve(model.rows.T, mass @ np.linalg.inv(model.rows)))
    spread = [np.column_stack([s.deviations[:, k] for s in motion.deviations]) for k in range(3)]
    deviation = (
        spread[2] @ inertia.T + model.struts[:, 2] * spread[1] + model.struts[:, 1] * spread[0]
    )
    force = needed - strut_forces(model, what, values, start, grid, motion)[0]
    return Missing(force, deviation, motion)


def with_fitted_start(
    model: Model,
    what: Planted,
    values: Array,
    grid: Grid,
    guess: Array,
    noise_m2: Array,
    motions: Sequence[Motion],
) -> tuple[Array, Trajectory] | None:
    """Initial state, hidden states too, with which the model follows a run best."""
    result = fit(model, what, values, [guess], [grid], noise_m2, motions, iterations=8, fixed=True)
    if result is None:
        return None
    return result.starts[0], result.trajectories[0]


def evaluate_run(
    model: Model,
    found: Fit,
    grid: Grid,
    guess: Array,
    noise_m2: Array,
    motions: Sequence[Motion],
) -> RunResult | None:
    """One held-out run, before and after; None if a model runs away on it.

    Args:
        model: The bench.
        found: The corrected model.
        grid: The run.
        guess: Coordinates and velocities at its start.
        noise_m2: Noise variance of each height, shape (struts,).
        motions: Motion of each strut in the runs that were learnt from.
    """
    nothing, none = planted(()), np.zeros(0)
    before = with_fitted_start(model, nothing, none, grid, guess, noise_m2, ())
    after = with_fitted_start(model, found.planted, found.values, grid, guess, noise_m2, motions)
    if before is None or after is None:
        return None
    plain = model.spec
    corrected = corrected_model(model, found)
    motion = smoothed_motion(grid, after[1], None)
    wide = smoothed_motion(grid, before[1], None)
    missing_before = missing_force(model, nothing, none, before[0], grid, wide)
    missing_after = missing_force(model, found.planted, found.values, after[0], grid, motion)
    simulated_before = Motions(*before[1], wide.deviations)
    simulated_after = Motions(*after[1], motion.deviations)
    tolerance = 0.1 * float(np.sqrt(np.min(noise_m2)))
    heights: list[Array] = []
    for spec, (start, there) in ((plain, before), (corrected, after)):
        steps = steps_on_dart(spec, grid, start, there.heights_m, tolerance)
        heights.append(dart_heights(spec, grid, start, steps))
    return RunResult(
        grid,
        heights[0],
        heights[1],
        missing_before,
        missing_after,
        strut_forces(model, nothing, none, before[0], grid, simulated_before)[0],
        strut_forces(model, found.planted, found.values, after[0], grid, simulated_after)[0],
    )


def rms(values: Array) -> float:
    """Root mean square of what is not NaN."""
    return float(np.sqrt(np.nanmean(values**2)))


__all__ = [
    "Missing",
    "Motions",
    "RunResult",
    "evaluate_run",
    "missing_force",
    "rms",
    "run",
    "smoothed_motion",
    "strut_forces",
]
