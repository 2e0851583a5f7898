"""The shipped benches under the published method's observer on a linear, defective model.

The model is advanced exactly (matrix exponential, forces held between samples), so that what is
left is the method's own error.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from can_dbc.database import DEFAULT_DATABASE, load_database
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import BenchTrajectory, simulate

CONFIGS = Path(rig.__file__).parent / "configs"
PERIOD_S = 1e-3
GRAVITY_M_PER_S2 = 9.81
PROPORTIONAL_N_PER_M = 1e5
INTEGRAL_N_PER_M_S = 1e4


class LinearModel(NamedTuple):
    """A chain of bodies on linear struts, from the ground up."""

    mass_kg: list[float]
    stiffness_n_per_m: list[float]
    damping_n_s_per_m: list[float]
    free_length_m: list[float]


SEED = LinearModel([10.0], [500.0], [100.0], [0.5])
QUARTER_CAR = LinearModel([3.0, 15.0], [20_000.0, 900.0], [120.0, 150.0], [0.3, 0.5])


def _discrete(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of one sample: states are heights and rates, inputs are forces on the bodies."""
    n = len(model.mass_kg)
    heights = np.eye(n) - np.eye(n, k=-1)
    apart = heights.T
    per_mass = heights @ np.diag(1.0 / np.array(model.mass_kg))
    system = np.zeros((3 * n, 3 * n))
    system[:n, n : 2 * n] = np.eye(n)
    system[n : 2 * n, :n] = -per_mass @ apart @ np.diag(model.stiffness_n_per_m)
    system[n : 2 * n, n : 2 * n] = -per_mass @ apart @ np.diag(model.damping_n_s_per_m)
    system[n : 2 * n, 2 * n :] = per_mass
    step = expm(system * PERIOD_S)
    return step[: 2 * n, : 2 * n], step[: 2 * n, 2 * n :]


def _observe(model: LinearModel, truth: BenchTrajectory) -> tuple[np.ndarray, np.ndarray]:
    """Model heights and estimated strut forces at each sample, shapes (samples, struts)."""
    n = len(model.mass_kg)
    free, driving = _discrete(model)
    apart = (np.eye(n) - np.eye(n, k=-1)).T
    free_length_m = np.array(model.free_length_m)
    weight_n = GRAVITY_M_PER_S2 * np.array(model.mass_kg)
    measured_m = np.round(truth.height_m / 2e-6) * 2e-6
    state = np.concatenate([measured_m[0], np.zeros(n)])
    integral = np.zeros(n)
    heights_m, forces_n = np.empty_like(measured_m), np.empty_like(measured_m)
    for k, measured in enumerate(measured_m):
        innovation_m = measured - state[:n]
        integral += innovation_m * PERIOD_S
        virtual_n = PROPORTIONAL_N_PER_M * innovation_m + INTEGRAL_N_PER_M_S * integral
        elastic_n = model.stiffness_n_per_m * (state[:n] - free_length_m)
        heights_m[k] = state[:n]
        forces_n[k] = virtual_n - elastic_n - model.damping_n_s_per_m * state[n:]
        on_bodies_n = apart @ (virtual_n + model.stiffness_n_per_m * free_length_m) - weight_n
        on_bodies_n[-1] += truth.applied_force_n[k]
        state = free @ state + driving @ on_bodies_n
    return heights_m, forces_n


def _settled(values: np.ndarray) -> np.ndarray:
    return values[500:]


@pytest.fixture(scope="module")
def reference_truth():
    return simulate(load_bench_config(CONFIGS / "reference_bench.yaml"), 20_000_000_000)


def test_reference_bench_moves_as_in_the_published_case(reference_truth):
    assert 0.595 <= _settled(reference_truth.height_m).max() <= 0.6005
    assert 430.0 <= np.abs(_settled(reference_truth.strut_force_n)).max() <= 440.0


def test_reference_observer_reaches_the_published_errors(reference_truth):
    heights_m, forces_n = _observe(SEED, reference_truth)
    height_error_m = _settled(heights_m - reference_truth.height_m)
    force_error_n = _settled(forces_n - reference_truth.strut_force_n)
    peak_n = np.abs(_settled(reference_truth.strut_force_n)).max()
    assert np.abs(height_error_m).max() <= 2.5e-3
    assert np.sqrt(np.mean(force_error_n**2)) <= 0.0114 * peak_n


def test_quarter_car_observers_follow_both_struts():
    truth = simulate(load_bench_config(CONFIGS / "quarter_car_bench.yaml"), 20_000_000_000)
    _, forces_n = _observe(QUARTER_CAR, truth)
    error_n = np.sqrt(np.mean(_settled(forces_n - truth.strut_force_n) ** 2, axis=0))
    swing_n = _settled(truth.strut_force_n).std(axis=0)
    # Two per cent even of the force's swing about its mean, let alone of its peak.
    assert np.all(error_n <= 0.02 * swing_n)
    assert np.all(truth.height_m[:, 0] < 0.3)


@pytest.mark.parametrize("name", ["reference_bench", "quarter_car_bench"])
def test_shipped_bench_fits_the_default_bus(name):
    bench = SimulatedBench(
        load_bench_config(CONFIGS / f"{name}.yaml"), load_database(DEFAULT_DATABASE)
    )
    frames, _ = bench.update(100_000_000)
    assert len(frames) > 100
    assert bench.saturated_frames == 0
