"""Derivatives of a free run's residual, against differences of the residual."""

import numpy as np
import pytest

from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.problem import (
    CandidateModel,
    Parts,
    existing_values,
    first_starts,
    nominal,
)
from tests.diagnosis import little_bench as bench
from tests.diagnosis import test_moving_base as moving_base

STEP = 1e-4
"""Of differences, in units of each part's scale."""
ROUNDING = 1e-4
"""Norm of a difference of residuals that rounding makes."""


def model_with(problem, laws, linear):
    """A model with laws, given by strut and name with their parameters, and linear changes."""
    candidate = nominal(problem).with_effects(*laws)
    effects = [existing_values(problem, nominal(problem)), *(laws[at] for at in candidate.new)]
    changes = np.array([linear.get(p.kind, 0.0) * p.deviation for p in problem.linear])
    starts = first_starts(problem, candidate)
    return CandidateModel(candidate, Parts(changes, np.concatenate(effects), starts))


def check(problem, model, tolerance):
    linear, effects, starts = model.parts
    full = np.concatenate([linear, effects, starts[0]])
    scales = np.concatenate(
        [
            [p.deviation for p in problem.linear],
            np.maximum(np.abs(effects), 1e-9),
            problem.start_scales(model.candidate)[0],
        ]
    )
    exact = problem.derivative(0, model, np.ones(len(full), dtype=bool))
    assert exact.shape == (len(problem.residual(0, model)), len(full))
    moved = 0
    for i, scale in enumerate(scales):
        ends = []
        for sign in (1.0, -1.0):
            changed = full.copy()
            changed[i] += sign * STEP * scale
            parts = np.split(changed, np.cumsum([len(linear), len(effects)]))
            other = Parts(parts[0], parts[1], (parts[2],))
            ends.append(problem.residual(0, CandidateModel(model.candidate, other)))
        difference = (ends[0] - ends[1]) / (2.0 * STEP * scale)
        size = float(np.linalg.norm(difference)) * scale
        error = float(np.linalg.norm(exact[:, i] - difference)) * scale
        assert error < tolerance * size + ROUNDING, (i, error, size)
        moved += size > ROUNDING
    return moved


def test_linear_part_a_cubic_spring_and_a_relaxing_one():
    problem = build_without_delays(
        bench.model(), [bench.run(bench.Nothing(), seed=1, duration_s=4.0)], 32, None
    )
    laws = {
        (0, "cubic_stiffness"): np.array([2e4]),
        (0, "maxwell"): np.array([150.0, 0.08]),
    }
    linear = {"mass": 0.5, "stiffness": -0.4, "damping": 0.3, "gain": 1.0, "free_length": 0.1}
    model = model_with(problem, laws, linear | {"delay": 0.7})
    # Mass, stiffness, damping, preload, free length, gain, delay; three parameters; three states.
    assert check(problem, model, 1e-5) == 13


@pytest.mark.parametrize(
    ("law", "values"),
    [
        ("coulomb_friction", [6.0, 0.02]),
        ("presliding_friction", [6.0, 1e-3]),
        ("hertz_bump_stop", [0.335, 4e5, 0.3]),
        ("spring_load_friction", [1.0, 0.1, 0.02]),
    ],
)
def test_laws_that_switch(law, values):
    problem = build_without_delays(
        bench.model(), [bench.run(bench.Nothing(), seed=1, duration_s=4.0)], 32, None
    )
    model = model_with(problem, {(0, law): np.array(values)}, {"stiffness": 0.2, "delay": 0.7})
    check(problem, model, 5e-3)


def test_a_moved_base_with_late_channels_and_gains():
    record = moving_base.recording(1, duration_s=4.0)
    problem = build_without_delays(moving_base.rough(), [record], 32, None)
    problem = moving_base.replace(problem, linear=(*problem.linear, *problem.height_gains))
    laws = {(1, "asymmetric_damping"): np.array([300.0, 900.0])}
    linear = {"stiffness": 0.2, "damping": -0.3, "delay": 0.5, "height_gain": 0.5, "mass": 0.4}
    model = model_with(problem, laws, linear)
    assert check(problem, model, 2e-3) > 10
