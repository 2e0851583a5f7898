"""The equations of motion and the integrator against closed forms."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from rig.simulated_bench.assembly import assemble
from rig.simulated_bench.curves import curve_force
from rig.simulated_bench.schema import BenchConfig, BenchConfigError
from rig.simulated_bench.trajectory import BenchDivergedError, simulate
from tests.rig_bench.linear_bench import (
    DAMPING_N_S_PER_M,
    FREE_LENGTH_M,
    MASS_KG,
    STIFFNESS_N_PER_M,
    linear_bench,
    linear_strut,
)

SECOND_NS = 1_000_000_000


def test_free_vibration_follows_the_closed_form():
    trajectory = simulate(linear_bench(strut=linear_strut(initial_height_m=0.6)), 2 * SECOND_NS)
    rest_m = FREE_LENGTH_M - MASS_KG * 9.81 / STIFFNESS_N_PER_M
    decay_per_s = DAMPING_N_S_PER_M / (2.0 * MASS_KG)
    rate = math.sqrt(STIFFNESS_N_PER_M / MASS_KG - decay_per_s**2)
    t_s = trajectory.t_ns * 1e-9
    shape = np.cos(rate * t_s) + decay_per_s / rate * np.sin(rate * t_s)
    expected_m = rest_m + (0.6 - rest_m) * np.exp(-decay_per_s * t_s) * shape
    np.testing.assert_allclose(trajectory.height_m[:, 0], expected_m, rtol=0.0, atol=1e-9)


def test_steady_response_to_a_sine_has_the_amplitude_of_the_transfer_function():
    sine = {"kind": "sine", "amplitude_n": 5.0, "frequency_hz": 2.0}
    trajectory = simulate(linear_bench(components=(sine,)), 12 * SECOND_NS)
    rate = 2.0 * math.pi * 2.0
    dynamic = complex(STIFFNESS_N_PER_M - MASS_KG * rate**2, DAMPING_N_S_PER_M * rate)
    last = trajectory.height_m[-5000:, 0]
    assert (last.max() - last.min()) / 2.0 == pytest.approx(5.0 / abs(dynamic), rel=1e-5)


@pytest.mark.parametrize("step_ns", [8_000_000, 4_000_000])
def test_integrator_is_of_fourth_order(step_ns):
    def end_height(step_ns):
        sine = {"kind": "sine", "amplitude_n": 20.0, "frequency_hz": 1.5, "phase_rad": 0.3}
        effects = ({"cubic_stiffness": {"stiffness_n_per_m3": 4000.0}},)
        config = linear_bench(
            strut=linear_strut(initial_height_m=0.6),
            components=(sine,),
            effects=effects,
            step_ns=step_ns,
        )
        return simulate(config, 400_000_000, period_ns=80_000_000).height_m[-1, 0]

    reference = end_height(100_000)
    coarse = abs(end_height(step_ns) - reference)
    fine = abs(end_height(step_ns // 2) - reference)
    assert math.log2(coarse / fine) == pytest.approx(4.0, abs=0.3)


def _energy_j(trajectory):
    stretch_m = trajectory.height_m[:, 0] - FREE_LENGTH_M
    return (
        0.5 * MASS_KG * trajectory.velocity_m_per_s[:, 0] ** 2
        + 0.5 * STIFFNESS_N_PER_M * stretch_m**2
        + MASS_KG * 9.81 * trajectory.height_m[:, 0]
    )


def test_energy_is_kept_without_damper():
    strut = linear_strut(damping_n_s_per_m=0.0, initial_height_m=0.6)
    energy_j = _energy_j(simulate(linear_bench(strut=strut), 20 * SECOND_NS))
    assert np.ptp(energy_j) < 1e-7 * abs(energy_j[0])


def test_energy_falls_with_damper():
    energy_j = _energy_j(
        simulate(linear_bench(strut=linear_strut(initial_height_m=0.6)), SECOND_NS)
    )
    assert np.all(np.diff(energy_j) < 1e-12)


def test_starts_at_rest_and_stays_there():
    trajectory = simulate(linear_bench(), SECOND_NS)
    rest_m = FREE_LENGTH_M - MASS_KG * 9.81 / STIFFNESS_N_PER_M
    np.testing.assert_allclose(trajectory.height_m, rest_m, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(trajectory.strut_force_n, MASS_KG * 9.81, rtol=1e-12)


def test_two_bodies_follow_the_matrix_exponential():
    upper = linear_strut(300.0, 5.0, initial_height_m=0.45) | {"between": ["wheel", "body"]}
    lower = linear_strut(2000.0, 8.0, initial_height_m=0.52) | {
        "name": "tyre",
        "between": ["world", "wheel"],
    }
    config = BenchConfig.model_validate(
        {
            "name": "two",
            "gravity_m_per_s2": 0.0,
            "masses": [{"name": "body", "mass_kg": 3.0}, {"name": "wheel", "mass_kg": 1.0}],
            "struts": [lower, upper],
            "applied_force": {"body": "body"},
        }
    )
    trajectory = simulate(config, SECOND_NS)
    stiffness = np.array([[2300.0, -300.0], [-300.0, 300.0]])
    damping = np.array([[13.0, -5.0], [-5.0, 5.0]])
    inverse_mass = np.diag([1.0, 1.0 / 3.0])
    system = np.block(
        [[np.zeros((2, 2)), np.eye(2)], [-inverse_mass @ stiffness, -inverse_mass @ damping]]
    )
    positions = (expm(system * 1.0) @ [0.02, -0.03, 0.0, 0.0])[:2]
    heights = [0.5 + positions[0], 0.5 + positions[1] - positions[0]]
    np.testing.assert_allclose(trajectory.height_m[-1], heights, rtol=0.0, atol=1e-9)


def test_curve_meets_its_points_and_is_straight_beyond():
    strut = linear_strut() | {
        "spring": {"height_m": [0.1, 0.2, 0.4, 0.5], "force_n": [90.0, 40.0, 10.0, 0.0]}
    }
    springs = assemble(linear_bench(strut=strut, gravity_m_per_s2=0.0)).mechanics.springs
    for height_m, force_n in ((0.1, 90.0), (0.2, 40.0), (0.4, 10.0), (0.5, 0.0)):
        assert curve_force(springs, 0, height_m) == pytest.approx(force_n, abs=1e-10)
    for edge_m, outwards in ((0.1, -1.0), (0.5, 1.0)):
        at = [curve_force(springs, 0, edge_m + outwards * x) for x in (0.0, 0.1, 0.2)]
        inside = curve_force(springs, 0, edge_m - outwards * 1e-6)
        assert at[2] - at[1] == pytest.approx(at[1] - at[0], rel=1e-9)
        assert (at[1] - at[0]) / 0.1 == pytest.approx((at[0] - inside) / 1e-6, rel=1e-3)


def test_motion_does_not_depend_on_the_time_between_records():
    sine = {"kind": "sine", "amplitude_n": 20.0, "frequency_hz": 1.5}
    config = linear_bench(components=(sine,))
    fine = simulate(config, SECOND_NS, period_ns=1_000_000)
    coarse = simulate(config, SECOND_NS, period_ns=10_000_000)
    np.testing.assert_allclose(fine.height_m[::10], coarse.height_m, rtol=0.0, atol=1e-13)


def test_two_runs_are_identical():
    sine = {"kind": "sine", "amplitude_n": 20.0, "frequency_hz": 1.5}
    first, second = (simulate(linear_bench(components=(sine,)), SECOND_NS) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_temperature_rises_by_what_the_damper_dissipates():
    strut = linear_strut(initial_height_m=0.6)
    config = linear_bench(strut=strut, temperature={"heat_capacity_j_per_k": 0.5})
    trajectory = simulate(config, 10 * SECOND_NS)
    energy_j = _energy_j(trajectory)
    warmer_k = trajectory.temperature_c[-1] - 20.0
    assert 0.5 * warmer_k == pytest.approx(energy_j[0] - energy_j[-1], rel=1e-6)


def test_temperature_cools_to_that_of_the_air():
    thermal = {"initial_c": 60.0, "ambient_c": 20.0, "cooling_time_s": 2.0}
    trajectory = simulate(linear_bench(temperature=thermal), 2 * SECOND_NS)
    assert trajectory.temperature_c[-1] == pytest.approx(20.0 + 40.0 / math.e, rel=1e-6)


def test_no_rest_is_said():
    strut = linear_strut(stiffness_n_per_m=0.0)
    with pytest.raises(BenchConfigError, match=r"struts\.0\.initial_height_m is missing"):
        assemble(linear_bench(strut=strut))


def test_motion_that_leaves_the_finite_numbers_is_said():
    strut = linear_strut(damping_n_s_per_m=-1e6, initial_height_m=0.6)
    with pytest.raises(BenchDivergedError, match="not finite"):
        simulate(linear_bench(strut=strut), SECOND_NS)
