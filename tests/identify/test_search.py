"""What the search does that a single planted effect does not show."""

import math

import numpy as np
import pytest

from rig.identify.diagnose import diagnose
from rig.identify.judge import first_motion
from rig.identify.least_squares import Rows, Space, solve
from rig.identify.reduced import grid_of, planted, reduced_model, run, start_of
from rig.scoreboard import driven_start
from tests.identify import little_bench as bench
from tests.identify.little_bench import Nothing
from tests.identify.test_planted_effects import Hardening, Ripple, Stop


def simulated(grid):
    model = reduced_model(bench.model())
    start = start_of(model, *first_motion(grid), 0)
    return run(model, planted(()), np.zeros(0), grid, start)


def test_half_as_long_steps_change_the_motion_by_a_sixteenth():
    grid = grid_of(bench.run(Nothing(), duration_s=3.0), reduced_model(bench.model()))
    coarse, fine = simulated(grid), simulated(grid.finer())
    finest = simulated(grid.finer().finer())
    first = np.abs(coarse.heights_m - fine.heights_m).max()
    second = np.abs(fine.heights_m - finest.heights_m).max()
    assert first / second == pytest.approx(16.0, rel=0.2)


def test_the_error_of_the_input_between_samples_is_about_what_is_said():
    # Sampled 125 times a second, 6.81 Hz turn by 0.34 rad a sample.
    model = reduced_model(bench.model())
    record = bench.run(Nothing(), duration_s=4.0, rate_hz=125)
    grid = grid_of(record, model)
    fine_t = np.linspace(record.t_s[0], record.t_s[-1], len(grid.fine_n))
    true_n = np.array([bench.load_n(t) for t in fine_t])
    inner = slice(200, -200)
    said = (grid.input_moved().fine_n - grid.fine_n)[inner]
    error = (true_n - grid.fine_n)[inner]
    assert np.sqrt(np.mean(said**2)) == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.5)


def test_parameters_that_move_some_rows_cost_those_rows_only():
    rng = np.random.default_rng(4)
    x = rng.normal(size=(30, 1))
    y = np.concatenate([2.0 + 3.0 * x[:15, 0], -1.0 + 3.0 * x[15:, 0]])
    asked: list[int] = []

    def part(k):
        rows = slice(15 * k, 15 * (k + 1))

        def residual_of(values):
            asked.append(k)
            return y[rows] - values[1 + k] - values[0] * x[rows, 0]

        return residual_of

    def whole(values):
        return np.concatenate([part(k)(values) for k in (0, 1)])

    space = Space(np.full(3, -9.0), np.full(3, 9.0), np.ones(3), np.zeros(3, dtype=bool))
    rows = {1: Rows(0, 15, part(0)), 2: Rows(15, 30, part(1))}
    plain = solve(whole, np.zeros(3), space, 8)
    asked.clear()
    found = solve(whole, np.zeros(3), space, 8, rows=rows)
    np.testing.assert_allclose(found.values, [3.0, 2.0, -1.0], atol=1e-9)
    np.testing.assert_allclose(found.jacobian, plain.jacobian, atol=1e-9)
    assert asked.count(0) == asked.count(1)


class StopAndRipple(Nothing):
    def force(self, t, z, v, state):
        return 3.0 * Stop().force(t, z, v, state) + Ripple().force(t, z, v, state)


def test_a_ripple_beside_hard_impacts_is_found():
    runs = [bench.run(StopAndRipple()), bench.run(StopAndRipple(), seed=2, duration_s=6.0)]
    found = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert {"stop", "periodic_force"} <= {e.family for e in found.effects}
    ripple = next(e for e in found.effects if e.family == "periodic_force")
    assert ripple.parameters["frequency_hz"].value == pytest.approx(5.3, rel=1e-3)
    assert ripple.parameters["amplitude_n"].value == pytest.approx(4.0, rel=0.05)


class Stiffened(Nothing):
    def force(self, t, z, v, state):
        return 3.0 * Hardening().force(t, z, v, state)


def test_what_a_fitted_linear_model_hides_is_found():
    record, test = bench.run(Stiffened()), bench.run(Stiffened(), seed=2, duration_s=6.0)
    found = diagnose(driven_start(record, "fitted"), [record], [test])
    names = [e.name for e in found.diagnosis.effects]
    assert found.diagnosis.effects[0].family == "nonlinear_stiffness"
    assert "linear_stiffness" in names
    assert any("hid a part" in said for said in found.assumptions)
    figures = found.diagnosis.held_out.height_rmse_m
    assert figures.before > 5.0 * found.diagnosis.noise_floor.height_rmse_m
    assert figures.after < 1.5 * found.diagnosis.noise_floor.height_rmse_m


def held_load_n(t):
    return bench.load_n(math.floor(t * 250.0 + 1e-6) / 250.0)


def test_an_input_that_is_held_gets_no_physical_name():
    record = bench.run(Nothing(), load=held_load_n)
    found = diagnose(bench.model(), [record], [bench.run(Nothing(), seed=2, load=held_load_n)])
    assert {e.family for e in found.diagnosis.effects} == {"delay"}
    assert found.diagnosis.effects[0].parameters["delay_s"].value == pytest.approx(2e-3, rel=0.1)
    assert any("held between samples" in said for said in found.assumptions)
