"""EMPS: how much each of its recordings says about the Coulomb friction of the stage.

The published friction comes from one regression. Here a model of five parameters (mass, Coulomb
friction, viscous friction of either direction, constant force) is fitted to each recording in free
run with the friction held at one value after another. What remains is the profile of the error
over the friction: its minimum is what the recording asks for, its width is how well it is known.
Nothing of the diagnosis takes part: simulation and fit are of this module alone.

References:
    Venzon, Moolgavkar, "A method for computing profile-likelihood-based confidence intervals",
    Appl. Stat. 37 (1988).
    Janot, Gautier, Brunot, "Data set and reference models of EMPS" (2019): the published values.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import optimize

from rig.recordings.recording import Recording
from tests.scoreboard.table import Row

Array = NDArray[np.float64]

PUBLISHED_N = 20.39
FRICTIONS_N = (18.0, 19.0, 20.0, PUBLISHED_N, 21.0, 22.0, 23.0, 24.0)
_NAME = "EMPS, friction held, all else fitted to the recording itself"
_UNIT = "RMSE of the position in free-run simulation, mm"
_SOURCE = "computed here; independent of the diagnosis"
_START = np.array([95.1, 203.5, 203.5, 3.16, 0.0, 0.0])
"""Mass in kg, damping of either direction in N·s/m, and constant force in N, as published; start
position in mm from the first sample, start velocity in mm/s."""
_SCALES = np.where(_START, _START, 1.0)
_STEPS = 4
"""Steps of the simulation a sample; with twice as many the errors move by less than 0.01 mm."""
_EVERY = 5
"""Every fifth sample counts: the error changes by some 0.1 mm at most from one to the next."""
_MM_PER_M = 1000.0


@njit(cache=True)
def free_run(parameters: Array, force_n: Array, sample_s: float, friction_n: float) -> Array:
    """Positions of a mass with friction, in m from the first measured one, at each sample.

    The step is implicit in both frictions: the Coulomb force takes what velocity there is, at most
    to zero. Between samples the force is linear.

    Args:
        parameters: As `_START`.
        force_n: Applied force, shape `(samples,)`.
        sample_s: Time between samples.
        friction_n: Coulomb friction.
    """
    mass_kg, forth, back, constant_n = parameters[0], parameters[1], parameters[2], parameters[3]
    position_m, velocity = parameters[4] / _MM_PER_M, parameters[5] / _MM_PER_M
    step_s = sample_s / _STEPS
    positions_m = np.empty(len(force_n))
    positions_m[0] = position_m
    for i in range(len(force_n) - 1):
        for j in range(_STEPS):
            pushed_n = force_n[i] + (force_n[i + 1] - force_n[i]) * (j + 0.5) / _STEPS + constant_n
            damping = forth if velocity > 0.0 else back
            effective_kg = mass_kg + step_s * damping
            free = (mass_kg * velocity + step_s * pushed_n) / effective_kg
            most = step_s * friction_n / effective_kg
            after = np.sign(free) * max(abs(free) - most, 0.0)
            position_m += 0.5 * step_s * (velocity + after)
            velocity = after
        positions_m[i + 1] = position_m
    return positions_m


def _fit(record: Recording, friction_n: float, start: Array) -> tuple[float, Array]:
    """Error in mm, and the parameters, with the friction held."""
    force_n = np.ascontiguousarray(cast("Array", record.applied_force_n))
    sample_s = float(np.mean(np.diff(record.t_s)))
    measured_m = record.heights_m[:, 0] - record.heights_m[0, 0]

    def errors_mm(scaled: Array) -> Array:
        positions_m = free_run(scaled * _SCALES, force_n, sample_s, friction_n)
        return _MM_PER_M * (positions_m - measured_m)[::_EVERY]

    found = cast("Any", optimize).least_squares(
        errors_mm, start / _SCALES, x_scale="jac", diff_step=1e-5
    )
    return float(np.sqrt(np.mean(found.fun**2))), found.x * _SCALES


def profile(record: Recording, frictions_n: Sequence[float] = FRICTIONS_N) -> Array:
    """Least error in mm at each friction; each is fitted from either neighbour's parameters."""
    errors_mm = np.full(len(frictions_n), np.inf)
    for order in (range(len(frictions_n)), range(len(frictions_n) - 1, -1, -1)):
        at = _START
        for i in order:
            error_mm, at = _fit(record, frictions_n[i], at)
            errors_mm[i] = min(errors_mm[i], error_mm)
    return errors_mm


def friction_rows(records: Mapping[str, Recording]) -> list[Row]:
    """One row a recording, one column a friction."""
    return [
        Row(_NAME, f"{friction_n:g} N", name, error_mm, _UNIT, _SOURCE)
        for name, record in records.items()
        for friction_n, error_mm in zip(FRICTIONS_N, profile(record), strict=True)
    ]
