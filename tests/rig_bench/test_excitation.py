"""The applied force in all its forms."""

import math

import numpy as np
import pytest

from rig.simulated_bench.trajectory import simulate
from tests.rig_bench.linear_bench import linear_bench

SECOND_NS = 1_000_000_000


def _applied(*components, seconds=10, **more):
    trajectory = simulate(linear_bench(components=components, **more), seconds * SECOND_NS)
    return trajectory.t_ns * 1e-9, trajectory.applied_force_n


def test_sine_by_either_frequency():
    t_s, in_hz = _applied({"kind": "sine", "amplitude_n": 3.0, "frequency_hz": 2.0})
    by_rate = {"kind": "sine", "amplitude_n": 3.0, "angular_frequency_rad_per_s": 4.0 * math.pi}
    np.testing.assert_allclose(in_hz, 3.0 * np.sin(4.0 * math.pi * t_s), atol=1e-12)
    np.testing.assert_array_equal(_applied(by_rate)[1], in_hz)


def test_components_add_up():
    sine = {"kind": "sine", "amplitude_n": 3.0, "frequency_hz": 2.0, "phase_rad": 1.0}
    other = {"kind": "sine", "amplitude_n": -1.0, "frequency_hz": 0.5}
    together = _applied(sine, other)[1]
    np.testing.assert_allclose(together, _applied(sine)[1] + _applied(other)[1], atol=1e-12)


def test_multisine_has_its_power_in_its_band():
    multisine = {"kind": "multisine", "rms_n": 7.0, "low_hz": 2.0, "high_hz": 5.0, "seed": 3}
    _, force_n = _applied(multisine | {"lines": 31}, seconds=10)
    force_n = force_n[:-1]
    assert math.sqrt(np.mean(force_n**2)) == pytest.approx(7.0, rel=1e-6)
    power = np.abs(np.fft.rfft(force_n)) ** 2
    frequency_hz = np.fft.rfftfreq(len(force_n), 1e-3)
    inside = (frequency_hz > 1.95) & (frequency_hz < 5.05)
    assert np.count_nonzero(inside) == 31
    np.testing.assert_allclose(power[inside], power[inside].mean(), rtol=1e-6)
    assert power[~inside].sum() < 1e-12 * power.sum()


def test_multisine_follows_its_seed():
    multisine = {"kind": "multisine", "rms_n": 7.0, "low_hz": 2.0, "high_hz": 5.0}
    one, same, other = (_applied(multisine | {"seed": seed})[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1.0


@pytest.mark.parametrize("spacing", ["linear", "logarithmic"])
def test_sweep_runs_through_its_frequencies(spacing):
    sweep = {"kind": "sweep", "amplitude_n": 1.0, "start_hz": 1.0, "end_hz": 16.0}
    t_s, force_n = _applied(sweep | {"duration_s": 8.0, "spacing": spacing})
    rising = np.flatnonzero((force_n[:-1] < 0.0) & (force_n[1:] >= 0.0))
    share = -force_n[rising] / (force_n[rising + 1] - force_n[rising])
    crossings_s = (rising + share) * 1e-3
    middle_s = 0.5 * (crossings_s[1:] + crossings_s[:-1])
    expected_hz = 1.0 + 15.0 * middle_s / 8.0 if spacing == "linear" else 16.0 ** (middle_s / 8.0)
    np.testing.assert_allclose(1.0 / np.diff(crossings_s), expected_hz, rtol=0.01)
    assert np.all(force_n[t_s > 8.0] == 0.0)


def test_sweep_of_one_frequency_is_a_sine():
    sweep = {"kind": "sweep", "amplitude_n": 2.0, "start_hz": 3.0, "end_hz": 3.0}
    t_s, force_n = _applied(sweep | {"duration_s": 20.0, "spacing": "logarithmic"})
    np.testing.assert_allclose(force_n, 2.0 * np.sin(6.0 * math.pi * t_s), atol=1e-9)


def test_file_is_interpolated_and_zero_outside(tmp_path, monkeypatch):
    (tmp_path / "force.csv").write_text("note,t_s,applied_force_n\na,1.0,0\nb,2.0,10\nc,4.0,-10\n")
    monkeypatch.chdir(tmp_path)
    t_s, force_n = _applied({"kind": "file", "path": "force.csv"}, seconds=5)
    expected_n = np.interp(t_s, [1.0, 2.0, 4.0], [0.0, 10.0, -10.0], left=0.0, right=0.0)
    np.testing.assert_allclose(force_n, expected_n, atol=1e-9)


def test_files_add_up(tmp_path, monkeypatch):
    (tmp_path / "one.csv").write_text("t_s,applied_force_n\n0,1\n9,1\n")
    (tmp_path / "two.csv").write_text("t_s,applied_force_n\n0,2\n9,2\n")
    monkeypatch.chdir(tmp_path)
    files = ({"kind": "file", "path": "one.csv"}, {"kind": "file", "path": "two.csv"})
    np.testing.assert_allclose(_applied(*files, seconds=5)[1], 3.0)
