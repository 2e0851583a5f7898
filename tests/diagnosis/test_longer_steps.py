"""Fits in longer steps: as far as models move alike in them, cut where a force jumps."""

import numpy as np
import pytest

from rig.diagnosis.problem.build import build_without_delays
from tests.diagnosis import little_bench as bench
from tests.diagnosis.test_derivatives import check, model_with
from tests.diagnosis.test_metamorphic import Friction, Stop

NOISE_M = 1e-5
SWITCHING = {
    "coulomb_friction": [6.0, 3e-3],
    "stribeck_friction": [6.0, 1.6, 0.05, 3e-3],
    "bump_stop": [0.335, 2e4, 40.0],
    "end_stops": [0.335, 0.42, 2e4, 40.0],
    "backlash": [1500.0, 0.01, 0.4],
    "asymmetric_damping": [20.0, 60.0],
}


def problem_of(effect, rate_hz=1000, load=bench.load_n):
    record = bench.run(effect, seed=1, noise_m=NOISE_M, duration_s=6.0, rate_hz=rate_hz, load=load)
    problem = build_without_delays(bench.model(), [record], 32, None)
    return problem.with_noise_of(model_with(problem, {}, {}))


@pytest.fixture(scope="module")
def problem():
    return problem_of(bench.Nothing())


@pytest.fixture(scope="module")
def longer(problem):
    return problem.coarser(model_with(problem, {}, {}))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("name", SWITCHING)
def test_a_law_that_switches_moves_alike(problem, longer, name):
    assert len(longer.in_strides[0].strides) < 0.4 * len(problem.runs[0].strides)
    model = model_with(problem, {(0, name): np.array(SWITCHING[name])}, {"stiffness": 0.2})
    change = longer.residual(0, model) - problem.residual(0, model)
    assert 0.0 < rms(change) < 0.05


@pytest.mark.parametrize(
    ("effect", "name", "values"),
    [
        (Friction(), "coulomb_friction", [6.0, 3e-3]),
        (Stop(), "bump_stop", [0.335, 2e4, 40.0]),
    ],
)
def test_steps_of_five_samples_follow_another_integrator(effect, name, values):
    problem = problem_of(effect)
    t_s, heights_m = bench.heights(effect, duration_s=6.0, rate_hz=1000)
    model = model_with(problem, {(0, name): np.array(values)}, {})
    start = np.array([heights_m[0], 0.0])
    moved = problem.simulate(problem.runs[0].in_strides(5), model, start)
    assert len(t_s) == len(moved.heights_m)
    np.testing.assert_allclose(moved.heights_m[:, 0], heights_m, rtol=0.0, atol=0.1 * NOISE_M)


def test_internal_states_are_simulated_in_usual_steps(problem, longer):
    model = model_with(problem, {(0, "maxwell"): np.array([150.0, 0.08])}, {})
    np.testing.assert_array_equal(longer.residual(0, model), problem.residual(0, model))


def test_without_a_law_hardly_anything_changes(problem, longer):
    model = model_with(problem, {}, {})
    assert 0.0 < rms(longer.residual(0, model) - problem.residual(0, model)) < 0.02


def test_derivatives_are_those_of_the_longer_steps(longer):
    laws = {(0, "coulomb_friction"): np.array([6.0, 0.02])}
    model = model_with(longer, laws, {"stiffness": 0.2, "delay": 0.7})
    assert check(longer, model, 5e-3) > 8
