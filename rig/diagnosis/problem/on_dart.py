"""The corrected model as a model file has it, and its free run in DART itself."""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from dart_model.effects import effect
from dart_model.plant import DartPlant
from dart_model.spec import EffectSpec, ModelSpec
from rig.diagnosis.problem.driven_run import DrivenRun
from rig.diagnosis.problem.linear_part import round_for_file, spec_with_linear_changes
from rig.diagnosis.problem.problem import CandidateModel, Problem, rms, slots_of

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

_MOST_STEPS = 32
"""Steps of DART between two nodes from which on no more are tried."""
_MOST_STEPS_IN_ALL = 1_500_000
"""Steps of DART that take some ten seconds."""
_OF_A_MOTION = 3
"""Inputs of a motion: position, velocity, acceleration."""


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
    parts: Integers | None = None,
) -> Array:
    """Heights of a model in free run in DART, shape (N, struts); between strides by cubics.

    Its steps are refined until its heights differ from `expected_m`, those of the same model as the
    diagnosis simulates it, or from those with steps of twice the length, by less than `tolerance_m`
    RMS: where joints turn, a model that does not follow the bench moves otherwise in DART. They are
    so many times shorter in each stride as `parts` (S + 1,) has it: where forces jump.
    """
    plant = DartPlant(spec_with_corrections(problem, model))
    states = _plant_states(problem, model, start[2 * plant.free_coordinates :], plant)
    steps = np.full(len(run.strides), run.substeps)
    if parts is not None and run.substeps * int(parts.sum()) <= _MOST_STEPS_IN_ALL:
        steps *= parts
    known = [expected_m]
    while True:
        heights_m = _simulate_heights(plant, run, (states, start), steps)
        is_fine = any(rms(heights_m - other) < tolerance_m for other in known)
        least, most = 2 * int(steps.min()), 2 * int(steps.sum())
        if is_fine or least > _MOST_STEPS or most > _MOST_STEPS_IN_ALL:
            return heights_m
        known, steps = [expected_m, heights_m], 2 * steps


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
    plant: DartPlant, run: DrivenRun, begin: tuple[tuple[float, ...], Array], steps: Integers
) -> Array:
    """Heights (N, struts) in so many steps in each stride, (S + 1,).

    `begin` are internal states and the initial vector.
    """
    states, start = begin
    t_s, count = run.grid.t_s[run.strides], len(run.strides)
    n, (begins, ends) = plant.free_coordinates, (it.tolist() for it in _inputs_of_steps(run, steps))
    numbers = (*start[: 2 * n].tolist(), *states)
    state = plant.state_of(numbers, float(t_s[0]), begins[0])
    no_forces = (0.0,) * len(plant.spec.struts)
    motion = np.empty((count, len(no_forces), 2))
    lengths, step = (np.diff(t_s) / steps[:-1]).tolist(), 0
    temperature = run.grid.temperature_c[run.strides].tolist()
    for k in range(count):
        motion[k] = state.struts
        if k + 1 == count:
            break
        for _ in range(steps[k]):
            loaded = plant.load(state, no_forces, begins[step], temperature[k])
            state = plant.step(loaded, lengths[k], ends[step])
            step += 1
    if count == len(run.grid.t_s):
        return motion[:, :, 0]
    return CubicHermiteSpline(t_s, motion[:, :, 0], motion[:, :, 1])(run.grid.t_s)


def _inputs_of_steps(run: DrivenRun, steps: Integers) -> tuple[Array, Array]:
    """Input vectors with which each step begins and ends, shape (all steps, inputs).

    Within a step a force is a straight line: the one with the mean and the first moment of the
    measured force, with which a step errs by its fourth order. The chord errs by its second.
    """
    nodes = np.arange(len(steps) - 1)
    first, count = np.cumsum(steps) - steps, np.repeat(steps[:-1], steps[:-1])
    within = np.arange(first[-1]) - np.repeat(first[:-1], steps[:-1])
    points = np.repeat(nodes, steps[:-1]) + within / count
    inputs = CubicSpline(np.linspace(0.0, len(nodes), len(run.fine)), run.fine)
    begin, middle, end = (inputs(points + share / count) for share in (0.0, 0.5, 1.0))
    lift = (2.0 * middle - begin - end) / 3.0
    for motion in run.drive.moved:
        lift[:, motion : motion + _OF_A_MOTION] = 0.0
    return begin + lift, end + lift
