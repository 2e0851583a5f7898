"""The first model of a bench, from closed-form motions."""

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from dart_model.spec import load_model
from rig.new_bench.first_model import FirstModel, fit_linear, rough_damping_n_s_per_m

MASS_KG, STIFFNESS_N_PER_M, DAMPING_N_S_PER_M, REST_M = 24.0, 9000.0, 150.0, 0.36


def driven(t_s, noise_m=0.0, seed=0):
    """Steady motion under two tones, with its applied force: the transfer function at each."""
    height, force = np.full_like(t_s, REST_M), np.zeros_like(t_s)
    for hz, amplitude_n in ((1.7, 80.0), (3.9, 120.0)):
        omega = 2.0 * np.pi * hz
        receptance = 1.0 / (STIFFNESS_N_PER_M - MASS_KG * omega**2 + 1j * omega * DAMPING_N_S_PER_M)
        height += (amplitude_n * receptance * np.exp(1j * omega * t_s)).real
        force += amplitude_n * np.cos(omega * t_s)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, t_s.shape) if noise_m else 0.0
    return height + noise, force


def test_stiffness_damping_and_rest_of_a_driven_body():
    t_s = np.arange(0.0, 20.0, 0.002)
    found = fit_linear(t_s, *driven(t_s), MASS_KG)
    assert found.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=1e-3)
    assert found.damping_n_s_per_m == pytest.approx(DAMPING_N_S_PER_M, rel=1e-2)
    assert found.rest_m == pytest.approx(REST_M, abs=1e-5)
    assert found.explained > 0.999


def test_noise_of_a_draw_wire_and_frames_that_jitter_hardly_matter():
    rng = np.random.default_rng(3)
    t_s = np.arange(0.0, 20.0, 0.002) + rng.uniform(0.0, 3e-4, 10_000)
    found = fit_linear(t_s, *driven(t_s, noise_m=2e-5), MASS_KG)
    assert found.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=0.02)
    assert found.damping_n_s_per_m == pytest.approx(DAMPING_N_S_PER_M, rel=0.05)


def test_a_free_response_gives_them_over_the_mass():
    t_s = np.arange(0.0, 6.0, 0.002)
    decay = DAMPING_N_S_PER_M / (2.0 * MASS_KG)
    omega = np.sqrt(STIFFNESS_N_PER_M / MASS_KG - decay**2)
    height = REST_M + 0.03 * np.exp(-decay * t_s) * np.cos(omega * t_s)
    found = fit_linear(t_s, height, None, 1.0)
    assert found.stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M / MASS_KG, rel=1e-3)
    assert found.damping_n_s_per_m == pytest.approx(DAMPING_N_S_PER_M / MASS_KG, rel=1e-2)


def test_a_recording_that_shows_nothing_is_answered_by_what_to_record():
    t_s = np.arange(0.0, 20.0, 0.002)
    noise = np.random.default_rng(1).normal(0.0, 1e-5, t_s.shape)
    with pytest.raises(
        InputError, match=r"explain .* expected a recording in which the body moves"
    ):
        fit_linear(t_s, REST_M + noise, None, MASS_KG)
    slow_s = np.arange(0.0, 2.0, 0.02)
    with pytest.raises(InputError, match=r"windows of .* expected 30 or more: record some seconds"):
        fit_linear(slow_s, *driven(slow_s), MASS_KG)


def test_the_file_is_a_model_that_rests_at_the_measured_length(tmp_path):
    model = FirstModel(24.0, 0.36, 9000.0, rough_damping_n_s_per_m(24.0, 9000.0))
    path = tmp_path / "model.yaml"
    path.write_text(model.text("bench", "from a catalogue"))
    (strut,) = load_model(path).struts
    weight_n = 24.0 * 9.81
    assert strut.stiffness_n_per_m * (strut.free_length_m - 0.36) == pytest.approx(
        weight_n, rel=1e-4
    )
    # A damping ratio of 0.2.
    assert strut.damping_n_s_per_m == pytest.approx(0.4 * np.sqrt(24.0 * 9000.0), rel=1e-4)
    assert yaml.safe_load(path.read_text())["struts"][0]["effects"] == []
