"""The corrected model, and its figures on DART itself."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.diagnosis.problem.free_run import FreeRun, Run
from rig.diagnosis.problem.linear_part import corrected_spec, rounded
from rig.diagnosis.problem.problem import Candidate, Parts, Problem, slots_of

Array = NDArray[np.float64]

_TRIED_S = 4.0
"""Length of the part of a run on which the number of DART's steps is settled."""
_MOST_STEPS = 32
_MOST_STEPS_IN_ALL = 1_500_000
"""Steps of DART that take some ten seconds."""


def corrected_model(problem: Problem, candidate: Candidate, parts: Parts) -> ModelSpec:
    """The nominal model with a fit's linear corrections and effects."""
    spec = problem.spec
    values = [parts.effects[slot.parameters] for slot in slots_of(problem, candidate).each]
    kept = dict(zip(candidate.kept, values, strict=False))
    for i, strut in enumerate(spec.struts):
        existing = [
            EffectSpec(name=e.name, parameters=_named(e.name, kept[k]))
            for k, e in enumerate(problem.existing)
            if e.strut == i and k in kept
        ]
        spec = spec.with_effects(strut.name, existing)
    spec = corrected_spec(spec, problem.linear, parts.linear, problem.motions)
    for (i, name), own in zip(candidate.new, values[len(candidate.kept) :], strict=True):
        strut = spec.struts[i]
        new = EffectSpec(name=name, parameters=_named(name, own))
        spec = spec.with_effects(strut.name, (*strut.effects, new))
    if spec == problem.spec:
        return spec
    name = problem.spec.name.removesuffix("_corrected")
    return spec.model_copy(update={"name": f"{name[:50]}_corrected"})


def _named(name: str, values: Array) -> dict[str, float]:
    named: dict[str, float] = {}
    for parameter, value in zip(effect(name).parameters, values, strict=True):
        named[parameter.name] = rounded(float(np.clip(value, parameter.low, parameter.high)))
    return named


def dart_heights(
    problem: FreeRun,
    k: int,
    candidate: Candidate,
    parts: Parts,
    wanted_m: Array,
    tolerance_m: float,
) -> Array:
    """Heights of a model in free run in DART, shape (N, struts).

    Args:
        problem: Nominal model and recordings.
        k: Index of the recording.
        candidate: The model's effects.
        parts: Its parameters and initial vectors.
        wanted_m: Heights of the same model as the diagnosis simulates it, shape (N, struts).
        tolerance_m: Root mean square by which the two may differ; DART's steps follow from it.
    """
    plant = DartPlant(corrected_model(problem, candidate, parts))
    run, start = problem.runs[k], parts.starts[k]
    nodes = len(run.grid.t_s)
    count = min(nodes, max(50, int(_TRIED_S / run.grid.step_s)))
    states = _states(problem, candidate, start[2 * plant.coordinates :], plant)
    steps = 2 if run.substeps == 1 else 2 * run.substeps
    while steps < _MOST_STEPS and 2 * steps * nodes <= _MOST_STEPS_IN_ALL:
        there = _heights(plant, run, states, start, count, steps)
        if float(np.sqrt(np.mean((there - wanted_m[:count]) ** 2))) < tolerance_m:
            break
        steps *= 2
    return _heights(plant, run, states, start, nodes, steps)


def _states(
    problem: Problem, candidate: Candidate, given: Array, plant: DartPlant
) -> tuple[float, ...]:
    """Internal states in the order of DART's model: strut after strut, existing effects first.

    Those of an FMU, a strut's last, begin at its start.
    """
    states: list[float] = []
    for strut, mockup in enumerate(plant.mockups):
        for slot in slots_of(problem, candidate).each:
            if slot.strut == strut:
                states += given[slot.states].tolist()
        if mockup is not None:
            states += [0.0] * len(mockup.state_scales)
    return tuple(states)


def _heights(
    plant: DartPlant, run: Run, states: tuple[float, ...], start: Array, count: int, steps: int
) -> Array:
    grid = run.grid
    n = plant.coordinates
    state = plant.state(
        tuple(start[:n].tolist()), tuple(start[n : 2 * n].tolist()), states, float(grid.t_s[0])
    )
    none = (0.0,) * len(plant.spec.struts)
    heights = np.empty((count, len(none)))
    applied = _applied(run, count, steps).tolist()
    lengths = (np.diff(grid.t_s[:count]) / steps).tolist()
    temperature = grid.temperature_c.tolist()
    for k in range(count):
        heights[k] = [height_m for height_m, _ in state.struts]
        if k + 1 == count:
            break
        for step in range(steps):
            loaded = plant.load(state, none, applied[steps * k + step], temperature[k])
            state = plant.step(loaded, lengths[k], applied[steps * k + step + 1])
    return heights


def _applied(run: Run, count: int, steps: int) -> Array:
    """Applied force at `steps` points between nodes, shape (steps * (count - 1) + 1,)."""
    parts = 2 * run.substeps
    fine = run.fine_n[: parts * (count - 1) + 1]
    have = np.linspace(0.0, count - 1.0, len(fine))
    return CubicSpline(have, fine)(np.linspace(0.0, count - 1.0, steps * (count - 1) + 1))
