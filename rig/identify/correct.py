"""The corrected model, and its last fit on DART itself.

The reduced model gives the start and the sensitivities; the residual is DART's. Two or three runs of
DART are then enough.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dart_model.effects import effect
from dart_model.plant import DartPlant, PlantState
from dart_model.spec import EffectSpec, ModelSpec
from rig.identify.output_error import Fit, with_solution
from rig.identify.reduced import Grid, Model

Array = NDArray[np.float64]

_SIGNIFICANT = 12
_AGREED = 0.002


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


def dart_heights(spec: ModelSpec, grid: Grid, start: Array) -> Array:
    """Heights of the model running alone in DART, shape (N, struts).

    Args:
        spec: The model.
        grid: The applied force.
        start: Coordinates, velocities and memory at the first node.
    """
    plant = DartPlant(spec)
    n = plant.coordinates
    memory = np.zeros(plant.memory_size)
    given = start[2 * n :]
    if len(given):
        memory[plant.memory_size - len(given) :] = given
    state = PlantState(
        tuple(start[:n].tolist()),
        tuple(start[n : 2 * n].tolist()),
        tuple(memory.tolist()),
        float(grid.t_s[0]),
    )
    none = (0.0,) * len(spec.struts)
    heights = np.empty((len(grid.t_s), len(spec.struts)))
    # Two steps between nodes, so that DART sees the same applied force as the reduced model.
    applied = grid.fine_n[:: grid.substeps].tolist()
    steps = (0.5 * np.diff(grid.t_s)).tolist()
    temperature = grid.temperature_c.tolist()
    last = len(grid.t_s) - 1
    for k in range(len(grid.t_s)):
        loaded = plant.load(state, none, applied[2 * k], temperature[k])
        heights[k] = [motion.height_m for motion in loaded.motions]
        if k == last:
            break
        state = plant.step(loaded, steps[k], applied[2 * k + 1])
        loaded = plant.load(state, none, applied[2 * k + 1], temperature[k])
        state = plant.step(loaded, steps[k], applied[2 * k + 2])
    return heights


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

    def on_dart(trial: Fit) -> Array:
        spec = corrected_model(model, trial)
        parts = [
            ((grid.heights_m - dart_heights(spec, grid, start))[grid.measured] * weights).ravel()
            for grid, start in zip(grids, trial.starts, strict=True)
        ]
        return np.concatenate(parts)

    residual = on_dart(result)
    cost = float(residual @ residual)
    solution, bounds = result.solution, result.space
    if solution is None or bounds is None or cost < (1.0 + _AGREED) * result.cost:
        return result, cost / result.count
    change = np.linalg.lstsq(solution.jacobian, -residual, rcond=None)[0]
    moved = bounds.outer(bounds.inner(solution.values) + change)
    trial = with_solution(model, result, grids, moved)
    if trial is None:
        return result, cost / result.count
    there = on_dart(trial)
    if float(there @ there) >= cost:
        return result, cost / result.count
    return trial, float(there @ there) / result.count
