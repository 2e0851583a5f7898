"""The corrected model, and its last fit on DART itself.

The reduced model gives the start and the sensitivities; the residual is DART's. Two or three runs
of DART are then enough.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.identify.output_error import Fit, with_solution
from rig.identify.reduced import Grid, Model

Array = NDArray[np.float64]

_SIGNIFICANT = 12
_AGREED = 0.002
_TRIED_S = 4.0
_MOST_STEPS = 32
_MOST_STEPS_IN_ALL = 1_500_000
_FIT_TOLERANCE = 0.01


def corrected_model(model: Model, result: Fit) -> ModelSpec:
    """The model with the effects of a fit, after those that it already had."""
    spec = model.spec
    index = result.planted.slots.index
    for position, strut in enumerate(spec.struts):
        found = [
            EffectSpec(name=name, parameters=_named(name, result.values[slice(*index[row, 1:3])]))
            for row, (at, name) in enumerate(result.planted.effects)
            if at == position
        ]
        if found:
            spec = spec.with_effects(strut.name, (*strut.effects, *found))
    return (
        spec.model_copy(update={"name": f"{spec.name[:50]}_corrected"})
        if (result.planted.effects)
        else spec
    )


def _named(name: str, values: Array) -> dict[str, float]:
    return {
        parameter.name: float(np.format_float_scientific(value, precision=_SIGNIFICANT))
        for parameter, value in zip(effect(name).parameters, values, strict=True)
    }


def dart_heights(spec: ModelSpec, grid: Grid, start: Array, steps: int = 2) -> Array:
    """Heights of the model running alone in DART, shape (N, struts).

    Args:
        spec: The model.
        grid: The applied force.
        start: Coordinates, velocities and memory at the first node.
        steps: DART's steps between nodes.
    """
    plant = DartPlant(spec)
    n = plant.coordinates
    memory = np.zeros(plant.memory_size)
    given = start[2 * n :]
    if len(given):
        memory[plant.memory_size - len(given) :] = given
    state = plant.state(
        tuple(start[:n].tolist()),
        tuple(start[n : 2 * n].tolist()),
        tuple(memory.tolist()),
        float(grid.t_s[0]),
    )
    none = (0.0,) * len(spec.struts)
    heights = np.empty((len(grid.t_s), len(spec.struts)))
    applied = _applied(grid, steps).tolist()
    lengths = (np.diff(grid.t_s) / steps).tolist()
    temperature = grid.temperature_c.tolist()
    last = len(grid.t_s) - 1
    for k in range(len(grid.t_s)):
        at = steps * k
        heights[k] = [height_m for height_m, _ in state.struts]
        if k == last:
            break
        for step in range(steps):
            loaded = plant.load(state, none, applied[at + step], temperature[k])
            state = plant.step(loaded, lengths[k], applied[at + step + 1])
    return heights


def _applied(grid: Grid, steps: int) -> Array:
    """Applied force at `steps` points between nodes, shape (steps * (N - 1) + 1,)."""
    fine = np.linspace(0.0, len(grid.t_s) - 1.0, 2 * grid.substeps * (len(grid.t_s) - 1) + 1)
    wanted = np.linspace(0.0, len(grid.t_s) - 1.0, steps * (len(grid.t_s) - 1) + 1)
    return CubicSpline(fine, grid.fine_n)(wanted)


def steps_on_dart(
    spec: ModelSpec, grid: Grid, start: Array, wanted: Array, tolerance_m: float
) -> int:
    """How many of DART's steps between nodes bring it within a tolerance of the reduced model.

    Args:
        spec: The model.
        grid: A run; its first seconds are tried.
        start: Coordinates, velocities and memory at the first node.
        wanted: Heights of the reduced model, shape (N, struts).
        tolerance_m: Root mean square by which the two may differ.
    """
    count = min(len(grid.t_s), max(50, int(_TRIED_S / grid.step_s)))
    part = grid.rows(0, count)
    steps = 2 if grid.substeps == 1 else 2 * grid.substeps
    while steps < _MOST_STEPS and 2 * steps * len(grid.t_s) <= _MOST_STEPS_IN_ALL:
        there = dart_heights(spec, part, start, steps)
        if float(np.sqrt(np.mean((there - wanted[:count]) ** 2))) < tolerance_m:
            break
        steps *= 2
    return steps


def _steps(model: Model, result: Fit, grids: Sequence[Grid], noise_m2: Array) -> int:
    # Coarser steps would be made up for by parameters that are wrong.
    tolerance = _FIT_TOLERANCE * float(np.sqrt(np.min(noise_m2)))
    spec = corrected_model(model, result)
    return steps_on_dart(
        spec, grids[0], result.starts[0], result.trajectories[0].heights_m, tolerance
    )


def fitted_on_dart(
    model: Model,
    result: Fit,
    grids: Sequence[Grid],
    noise_m2: Array,
) -> tuple[Fit, float]:
    """The fit led to its end on DART.

    Gauss-Newton with DART's residual and the reduced model's sensitivities; a step is kept if DART
    agrees.

    Returns:
        The fit, and its mean square on DART over the noise variance.
    """
    weights = 1.0 / np.sqrt(noise_m2)

    steps = _steps(model, result, grids, noise_m2)

    def on_dart(trial: Fit) -> Array:
        spec = corrected_model(model, trial)
        parts = [
            (
                (grid.heights_m - dart_heights(spec, grid, start, steps))[grid.measured] * weights
            ).ravel()
            for grid, start in zip(grids, trial.starts, strict=True)
        ]
        return np.concatenate(parts)

    residual = on_dart(result)
    cost = float(residual @ residual)
    solution, bounds = result.solution, result.space
    if solution is None or bounds is None or cost < (1.0 + _AGREED) * result.cost:
        return result, cost / result.samples
    change = np.linalg.lstsq(solution.jacobian, -residual, rcond=None)[0]
    moved = bounds.outer(bounds.inner(solution.values) + change)
    trial = with_solution(model, result, grids, moved)
    if trial is None:
        return result, cost / result.samples
    there = on_dart(trial)
    if float(there @ there) >= cost:
        return result, cost / result.samples
    return trial, float(there @ there) / result.samples
