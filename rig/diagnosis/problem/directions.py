"""By what a free run is differentiated: parameters of a fit as columns of its derivatives."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.diagnosis.numerics.march import ByLinearPart, Directions, Model, Scenario, Steps
from rig.diagnosis.problem.driven_run import DrivenRun
from rig.diagnosis.problem.grid import fine_times
from rig.diagnosis.problem.mechanism import LinearisedMechanism
from rig.diagnosis.problem.problem import LinearParameter

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

_OF_STRUTS = ("stiffness", "damping", "preload", "free_length", "mass")


def directions_of(
    linear: Sequence[LinearParameter], varied: Flags, effects: int, run: DrivenRun
) -> tuple[Directions, dict[int, int]]:
    """Columns of a simulation's derivatives, and the column of each parameter that has one.

    `varied` are flags of linear parameters, of so many parameters of effects, and of the initial
    vector. Delays and gains of heights have no column: they do not change the motion, or change
    what drives it.
    """
    struts, inputs = run.grid.heights_m.shape[1], run.mechanism.inputs.shape[2]
    of_struts = {kind: np.full(struts, -1) for kind in _OF_STRUTS}
    gain, parameters = np.full(inputs, -1), np.full(effects, -1)
    columns: dict[int, int] = {}
    for i in np.flatnonzero(varied[: len(linear)]).tolist():
        kind = linear[i].kind
        if kind in of_struts:
            columns[i] = len(columns)
            of_struts[kind][linear[i].strut] = columns[i]
        elif kind == "gain":
            columns[i] = len(columns)
            gain[linear[i].input] = columns[i]
    first = len(linear)
    for p in np.flatnonzero(varied[first : first + effects]).tolist():
        columns[first + p] = len(columns)
        parameters[p] = columns[first + p]
    first += effects
    count, start = len(columns), -1
    if np.any(varied[first:]):
        # All of it: a part would save little.
        start = count
        count += len(varied) - first
        columns |= {i: start + i - first for i in range(first, len(varied))}
    stiffness, damping, preload, free_length, mass = of_struts.values()
    return (
        Directions(count, stiffness, damping, preload, free_length, mass, gain, parameters, start),
        columns,
    )


def by_linear_part(
    mechanism: LinearisedMechanism,
    linear: Sequence[LinearParameter],
    changes: Array,
    middles_m: Array,
) -> ByLinearPart:
    """How the linear part enters the equations; `middles_m` are mid-strokes, shape (struts,)."""
    by_kg, gains = mechanism.inputs_by_kg, mechanism.inputs
    for parameter, change in zip(linear, changes, strict=True):
        if parameter.kind == "mass" and change != 0.0:
            gains = gains + change * by_kg[:, parameter.strut]
    for parameter, change in zip(linear, changes, strict=True):
        if parameter.kind == "gain" and change != 0.0:
            by_kg = by_kg.copy()
            by_kg[..., parameter.input] *= 1.0 + change
    return ByLinearPart(
        middles_m,
        mechanism.mass_by_kg,
        mechanism.bias_by_kg,
        np.ascontiguousarray(by_kg),
        np.ascontiguousarray(gains),
    )


def pushed_by(
    forces: Sequence[tuple[int, Array]], model: Model, scenario: Scenario, steps: Steps
) -> tuple[Model, Scenario, Steps, Directions, ByLinearPart]:
    """A simulation differentiated by the gains of forces, each (N,) in a strut given by its index.

    They are further inputs, which do not push the model itself.
    """
    equations, count = model.equations, len(forces)
    points, n, before = equations.inputs.shape
    struts = equations.jacobian.shape[1]
    times = fine_times(scenario.t_s[scenario.strides], 2 * steps.substeps)
    fine = [np.interp(times, scenario.t_s, force_n) for _, force_n in forces]
    gains = np.zeros((points, n, before + count))
    gains[:, :, before:] = np.swapaxes(equations.jacobian[:, [at for at, _ in forces]], 1, 2)
    none = np.full(max(struts, len(model.parameters)), -1)
    gain = np.concatenate([np.full(before, -1), np.arange(count)])
    return (
        model._replace(equations=equations._replace(inputs=_with_more(equations.inputs, count))),
        scenario._replace(inputs=np.column_stack([scenario.inputs, *fine])),
        steps,
        Directions(count, none, none, none, none, none, gain, none, -1),
        ByLinearPart(
            np.zeros(0), np.zeros((0, 0, n, n)), np.zeros((0, 0, n)), np.zeros((0, 0, n, 0)), gains
        ),
    )


def _with_more(inputs: Array, count: int) -> Array:
    """Generalised forces per unit of inputs, and of further ones that do nothing."""
    return np.concatenate([inputs, np.zeros((*inputs.shape[:2], count))], axis=2)
