"""The corrected model as a model file has it, and its free run in DART itself."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.diagnosis.problem.driven_run import DrivenRun
from rig.diagnosis.problem.linear_part import round_for_file, spec_with_linear_changes
from rig.diagnosis.problem.problem import CandidateModel, Problem, rms, slots_of

Array = NDArray[np.float64]

_TRIED_S = 4.0
"""Length of the part of a recording on which the number of DART's steps is determined."""
_MOST_STEPS = 32
"""Steps of DART between two nodes from which on no more are tried."""
_MOST_STEPS_IN_ALL = 1_500_000
"""Steps of DART that take some ten seconds."""


def spec_with_corrections(problem: Problem, model: CandidateModel) -> ModelSpec:
    """The nominal model with a fit's linear corrections and effects."""
    candidate, parts = model
    spec = problem.spec
    values = [parts.effects[slot.parameters] for slot in slots_of(problem, candidate).each]
    kept = dict(zip(candidate.kept, values, strict=False))
    for i, strut in enumerate(spec.struts):
        existing = [
            EffectSpec(name=e.name, parameters=_parameters_by_name(e.name, kept[k]))
            for k, e in enumerate(problem.existing)
            if e.strut == i and k in kept
        ]
        spec = spec.with_effects(strut.name, existing)
    spec = spec_with_linear_changes(spec, problem.linear, parts.linear, problem.motions)
    for (i, name), own in zip(candidate.new, values[len(candidate.kept) :], strict=True):
        strut = spec.struts[i]
        new = EffectSpec(name=name, parameters=_parameters_by_name(name, own))
        spec = spec.with_effects(strut.name, (*strut.effects, new))
    if spec == problem.spec:
        return spec
    name = problem.spec.name.removesuffix("_corrected")
    return spec.model_copy(update={"name": f"{name[:50]}_corrected"})


def _parameters_by_name(name: str, values: Array) -> dict[str, float]:
    values_by_name: dict[str, float] = {}
    for parameter, value in zip(effect(name).parameters, values, strict=True):
        values_by_name[parameter.name] = round_for_file(
            float(np.clip(value, parameter.low, parameter.high))
        )
    return values_by_name


def dart_heights(
    problem: Problem,
    run: DrivenRun,
    model: CandidateModel,
    start: Array,
    expected_m: Array,
    tolerance_m: float,
) -> Array:
    """Heights of a model in free run in DART, shape (N, struts).

    Its steps are refined until its heights differ from `expected_m`, those of the same model as the
    diagnosis simulates it, or from those with steps of twice the length, by less than `tolerance_m`
    RMS: where joints turn, a model that does not follow the bench moves otherwise in DART.
    """
    plant = DartPlant(spec_with_corrections(problem, model))
    nodes = len(run.grid.t_s)
    tried = min(nodes, max(50, int(_TRIED_S / run.grid.step_s)))
    states = _plant_states(problem, model, start[2 * plant.free_coordinates :], plant)
    steps, heights_m = run.substeps, expected_m
    for count in (tried, nodes):  # The first seconds show what suffices at least.
        known = [expected_m[:count]]
        while True:
            heights_m = _simulate_heights(plant, run, (states, start), count, steps)
            is_fine = any(rms(heights_m - other) < tolerance_m for other in known)
            if is_fine or steps >= _MOST_STEPS or 2 * steps * nodes > _MOST_STEPS_IN_ALL:
                break
            known, steps = [expected_m[:count], heights_m], 2 * steps
    return heights_m


def _plant_states(
    problem: Problem, model: CandidateModel, given: Array, plant: DartPlant
) -> tuple[float, ...]:
    """Internal states in the order of DART's model: strut after strut, existing effects first.

    Those of an FMU, a strut's last, begin at its start.
    """
    states: list[float] = []
    for strut, mockup in enumerate(plant.mockups):
        for slot in slots_of(problem, model.candidate).each:
            if slot.strut == strut:
                states += given[slot.states].tolist()
        if mockup is not None:
            states += [0.0] * len(mockup.state_scales)
    return tuple(states)


def _simulate_heights(
    plant: DartPlant, run: DrivenRun, begin: tuple[tuple[float, ...], Array], count: int, steps: int
) -> Array:
    """Heights (count, struts) at the first nodes; `begin`: internal states, initial vector."""
    states, start = begin
    grid = run.grid
    n, inputs = plant.free_coordinates, _interpolate_inputs(run, count, steps)
    numbers = (*start[: 2 * n].tolist(), *states)
    state = plant.state_of(numbers, float(grid.t_s[0]), inputs[0].tolist())
    drive = inputs.tolist()
    no_forces = (0.0,) * len(plant.spec.struts)
    heights = np.empty((count, len(no_forces)))
    lengths = (np.diff(grid.t_s[:count]) / steps).tolist()
    temperature = grid.temperature_c.tolist()
    for k in range(count):
        heights[k] = [height_m for height_m, _ in state.struts]
        if k + 1 == count:
            break
        for step in range(steps):
            loaded = plant.load(state, no_forces, drive[steps * k + step], temperature[k])
            state = plant.step(loaded, lengths[k], drive[steps * k + step + 1])
    return heights


def _interpolate_inputs(run: DrivenRun, count: int, steps: int) -> Array:
    """Input vector at `steps` points between nodes, shape (steps * (count - 1) + 1, inputs)."""
    parts = 2 * run.substeps
    fine = run.fine[: parts * (count - 1) + 1]
    at = np.linspace(0.0, count - 1.0, len(fine))
    return CubicSpline(at, fine)(np.linspace(0.0, count - 1.0, steps * (count - 1) + 1))
