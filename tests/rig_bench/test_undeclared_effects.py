"""Every undeclared effect does what its textbook says."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import find_peaks

from rig.simulated_bench.effects import EFFECT_KINDS
from rig.simulated_bench.trajectory import BenchTrajectory, simulate
from tests.rig_bench.linear_bench import (
    DAMPING_N_S_PER_M,
    FREE_LENGTH_M,
    MASS_KG,
    STIFFNESS_N_PER_M,
    linear_bench,
    linear_strut,
)

SECOND_NS = 1_000_000_000
SINE = {"kind": "sine", "amplitude_n": 40.0, "frequency_hz": 2.0}


def _run(
    *effects: dict[str, dict[str, float]], seconds: float = 5.0, drive=SINE, **more
) -> BenchTrajectory:
    config = linear_bench(components=(drive,), effects=effects, **more)
    return simulate(config, round(seconds * SECOND_NS))


def _extra_force_n(trajectory: BenchTrajectory) -> np.ndarray:
    """Force beyond that of the linear spring and damper, shape (records,)."""
    linear_n = -STIFFNESS_N_PER_M * (trajectory.height_m - FREE_LENGTH_M)
    linear_n -= DAMPING_N_S_PER_M * trajectory.velocity_m_per_s
    return (trajectory.strut_force_n - linear_n)[:, 0]


def _follows(
    trajectory: BenchTrajectory, law: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> None:
    """Check that the extra force is a law of deflection and rate of height."""
    deflection_m = trajectory.height_m[:, 0] - FREE_LENGTH_M
    velocity_m_per_s = trajectory.velocity_m_per_s[:, 0]
    expected_n = law(deflection_m, velocity_m_per_s)
    assert np.ptp(deflection_m) > 0.02
    np.testing.assert_allclose(_extra_force_n(trajectory), expected_n, rtol=1e-9, atol=1e-9)


def _preload():
    trajectory = _run({"preload": {"force_n": 7.0}})
    _follows(trajectory, lambda x, _: np.full_like(x, 7.0))
    rest_m = FREE_LENGTH_M - (MASS_KG * 9.81 - 7.0) / STIFFNESS_N_PER_M
    assert trajectory.height_m[0, 0] == pytest.approx(rest_m, abs=1e-12)


def _linear_stiffness():
    _follows(_run({"linear_stiffness": {"stiffness_n_per_m": 90.0}}), lambda x, _: -90.0 * x)


def _quadratic_stiffness():
    effect = {"quadratic_stiffness": {"stiffness_n_per_m2": 500.0}}
    _follows(_run(effect), lambda x, _: -500.0 * x**2)


def _cubic_stiffness():
    effect = {"cubic_stiffness": {"stiffness_n_per_m3": 9e4}}
    _follows(_run(effect), lambda x, _: -9e4 * x**3)


def _progressive_stiffness():
    trajectory = _run({"progressive_stiffness": {"force_n": 5.0, "length_m": 0.03}})
    _follows(trajectory, lambda x, _: -5.0 * (np.sinh(x / 0.03) - x / 0.03))


def _gas_spring():
    gas = {"charge_force_n": 15.0, "gas_length_m": 0.2, "polytropic_exponent": 1.3}
    _follows(_run({"gas_spring": gas}), lambda x, _: 15.0 * (0.2 / (0.2 + x)) ** 1.3)


def _bump_stop():
    stop = {"contact_height_m": 0.46, "contact_stiffness_n_per_m1_5": 2e5}
    trajectory = _run({"bump_stop": stop | {"dissipation_s_per_m": 1.5}})
    force_n, height_m = _extra_force_n(trajectory), trajectory.height_m[:, 0]
    assert np.count_nonzero(height_m < 0.459) > 50
    assert force_n.min() > -1e-9
    assert np.abs(force_n[height_m >= 0.46]).max() < 1e-9
    undamped = _run({"bump_stop": stop})
    _follows(undamped, lambda x, _: 2e5 * np.maximum(-0.04 - x, 0.0) ** 1.5)


def _rebound_stop():
    stop = {"contact_height_m": 0.5, "contact_stiffness_n_per_m1_5": 2e5}
    trajectory = _run({"rebound_stop": stop | {"dissipation_s_per_m": 1.5}})
    force_n, height_m = _extra_force_n(trajectory), trajectory.height_m[:, 0]
    assert np.count_nonzero(height_m > 0.501) > 50
    assert force_n.max() < 1e-9
    assert np.abs(force_n[height_m <= 0.5]).max() < 1e-9
    undamped = _run({"rebound_stop": stop})
    _follows(undamped, lambda x, _: -2e5 * np.maximum(x, 0.0) ** 1.5)


def _backlash():
    link = {"centre_height_m": 0.48, "gap_m": 0.02, "stiffness_n_per_m": 3000.0}
    trajectory = _run({"backlash": link})
    force_n, off_centre_m = _extra_force_n(trajectory), trajectory.height_m[:, 0] - 0.48
    inside = np.abs(off_centre_m) < 0.01
    assert 100 < np.count_nonzero(inside) < len(inside) - 100
    assert np.abs(force_n[inside]).max() < 1e-9
    beyond_m = off_centre_m[~inside] - np.copysign(0.01, off_centre_m[~inside])
    np.testing.assert_allclose(force_n[~inside], -3000.0 * beyond_m, atol=1e-9)


def _linear_damping():
    _follows(_run({"linear_damping": {"damping_n_s_per_m": 4.0}}), lambda _, v: -4.0 * v)


def _quadratic_damping():
    effect = {"quadratic_damping": {"damping_n_s2_per_m2": 20.0}}
    _follows(_run(effect), lambda _, v: -20.0 * v * np.abs(v))


def _asymmetric_damping():
    effect = {"asymmetric_damping": {"compression_n_s_per_m": 2.0, "rebound_n_s_per_m": 9.0}}
    _follows(_run(effect), lambda _, v: np.where(v > 0.0, -9.0 * v, -2.0 * v))


def _digressive_damping():
    knee = {"damping_n_s_per_m": 20.0, "knee_velocity_m_per_s": 0.1}
    trajectory = _run({"digressive_damping": knee})
    _follows(trajectory, lambda _, v: -20.0 * v / np.sqrt(1.0 + (v / 0.1) ** 2))
    assert np.abs(_extra_force_n(trajectory)).max() < 20.0 * 0.1


def _position_dependent_damping():
    effect = {"position_dependent_damping": {"damping_n_s_per_m": 5.0, "length_m": 0.05}}
    _follows(_run(effect), lambda x, v: -5.0 * (x / 0.05) ** 2 * v)


def _friction():
    friction = {"coulomb_force_n": 10.0, "presliding_m": 1e-4}
    # Below the breakaway force the body sticks: it moves no more than the bristles bend.
    weak = {"kind": "sine", "amplitude_n": 6.0, "frequency_hz": 1.0}
    stuck = _run({"friction": friction}, drive=weak)
    assert np.ptp(stuck.height_m) < 2.5e-4
    free = _run(drive=weak)
    assert np.ptp(free.height_m) > 0.01
    # Sliding, the force is Coulomb's against the motion.
    sliding = _run({"friction": friction})
    fast = np.abs(sliding.velocity_m_per_s[:, 0]) > 0.2
    force_n = _extra_force_n(sliding)
    expected_n = -10.0 * np.sign(sliding.velocity_m_per_s[fast, 0])
    np.testing.assert_allclose(force_n[fast], expected_n, rtol=1e-6)
    assert np.abs(force_n).max() < 10.0 + 1e-6
    # With Stribeck's peak it breaks away later and slides more easily when fast.
    stribeck = {"static_to_coulomb": 1.6, "stribeck_velocity_m_per_s": 0.02}
    peaked = _extra_force_n(_run({"friction": friction | stribeck}))
    assert 11.0 < np.abs(peaked).max() <= 16.0


def _bouc_wen():
    effect = {"bouc_wen": {"stiffness_n_per_m": 2000.0, "yield_m": 0.004, "exponent": 2.0}}
    trajectory = _run(effect, seconds=6.0)
    force_n, height_m = _extra_force_n(trajectory), trajectory.height_m[:, 0]
    # It never exceeds the yield force, and each cycle encloses an area: energy lost.
    assert 7.0 < np.abs(force_n).max() <= 8.0 + 1e-9
    cycle = slice(5000, 5501)
    work_j = -np.trapezoid(force_n[cycle], height_m[cycle])
    travel_m = 2.0 * np.ptp(height_m[cycle])
    assert 0.5 * 8.0 * travel_m < work_j < 8.0 * travel_m
    # Small motions stay elastic.
    tiny = _run(effect, drive={"kind": "sine", "amplitude_n": 0.2, "frequency_hz": 1.0})
    moved_m = tiny.height_m[:, 0] - tiny.height_m[0, 0]
    np.testing.assert_allclose(_extra_force_n(tiny), -2000.0 * moved_m, atol=0.02)


def _maxwell():
    branch = {"stiffness_n_per_m": 300.0, "relaxation_time_s": 0.05}
    trajectory = _run({"maxwell": branch}, seconds=6.0)
    # Steady state under a sine: complex stiffness of a spring and a damper in series.
    t_s = trajectory.t_ns * 1e-9
    last = slice(4000, 6000)
    turn = np.exp(-2j * math.pi * 2.0 * t_s[last])
    height = 2.0 * np.mean((trajectory.height_m[last, 0]) * turn)
    force = 2.0 * np.mean(_extra_force_n(trajectory)[last] * turn)
    lag = 2j * math.pi * 2.0 * 0.05
    assert abs(force / height + 300.0 * lag / (1.0 + lag)) < 0.05


def _periodic_force():
    ripple = {"amplitude_n": 3.0, "frequency_hz": 7.0, "phase_rad": 0.4}
    trajectory = _run({"periodic_force": ripple})
    expected_n = 3.0 * np.sin(2.0 * math.pi * 7.0 * trajectory.t_ns * 1e-9 + 0.4)
    np.testing.assert_allclose(_extra_force_n(trajectory), expected_n, atol=1e-9)


def _temperature_fade():
    thermal = {"initial_c": 20.0, "heat_capacity_j_per_k": 1.0}
    fade = {"temperature_fade": {"fraction_per_k": 0.02}}
    trajectory = _run(fade, seconds=10.0, temperature=thermal)
    lost = 1.0 - np.exp(-0.02 * (trajectory.temperature_c - 20.0))
    assert lost[-1] > 0.05
    expected_n = DAMPING_N_S_PER_M * trajectory.velocity_m_per_s[:, 0] * lost
    np.testing.assert_allclose(_extra_force_n(trajectory), expected_n, atol=1e-9)


def _time_fade():
    trajectory = _run({"time_fade": {"final_fraction": 0.4, "time_constant_s": 2.0}})
    lost = 0.6 * (1.0 - np.exp(-trajectory.t_ns * 1e-9 / 2.0))
    expected_n = DAMPING_N_S_PER_M * trajectory.velocity_m_per_s[:, 0] * lost
    np.testing.assert_allclose(_extra_force_n(trajectory), expected_n, atol=1e-9)


def _hidden_mass():
    # Tuned to the drive and without damper it absorbs: the body hardly moves in the end.
    rate = 2.0 * math.pi * 2.0
    absorber = {"mass_kg": 1.0, "stiffness_n_per_m": rate**2, "damping_n_s_per_m": 0.0}
    still = _run({"hidden_mass": absorber}, seconds=30.0)
    assert np.ptp(still.height_m[-2000:]) < 0.02 * np.ptp(_run().height_m[-2000:])
    assert np.abs(_extra_force_n(still)).max() < 1e-9
    quiet = _run({"hidden_mass": absorber}, drive=SINE | {"amplitude_n": 0.0})
    assert quiet.height_m[-1, 0] == pytest.approx(
        FREE_LENGTH_M - (MASS_KG + 1.0) * 9.81 / STIFFNESS_N_PER_M, abs=1e-9
    )


def _added_mass():
    def frequency_hz(*effects):
        strut = linear_strut(damping_n_s_per_m=0.0, initial_height_m=0.6)
        height_m = _run(*effects, drive=SINE | {"amplitude_n": 0.0}, strut=strut).height_m[:, 0]
        peaks = find_peaks(height_m)[0]
        return (len(peaks) - 1) / ((peaks[-1] - peaks[0]) * 1e-3)

    heavier = frequency_hz({"added_mass": {"mass_kg": 6.0}})
    assert heavier == pytest.approx(frequency_hz() / 2.0, rel=0.01)


def _input_gain():
    trajectory = _run({"input_gain": {"gain": 0.8}})
    np.testing.assert_allclose(trajectory.acting_force_n, 0.8 * trajectory.applied_force_n)
    weaker = _run(drive=SINE | {"amplitude_n": 32.0})
    np.testing.assert_allclose(trajectory.height_m, weaker.height_m, atol=1e-12)


def _delay():
    late = _run({"delay": {"delay_s": 0.025}})
    prompt = _run()
    np.testing.assert_allclose(late.height_m[25:], prompt.height_m[:-25], atol=1e-7)
    np.testing.assert_array_equal(late.applied_force_n, prompt.applied_force_n)
    assert np.all(late.acting_force_n[:25] == 0.0)


CHECKS = {
    "preload": _preload,
    "linear_stiffness": _linear_stiffness,
    "quadratic_stiffness": _quadratic_stiffness,
    "cubic_stiffness": _cubic_stiffness,
    "progressive_stiffness": _progressive_stiffness,
    "gas_spring": _gas_spring,
    "bump_stop": _bump_stop,
    "rebound_stop": _rebound_stop,
    "backlash": _backlash,
    "linear_damping": _linear_damping,
    "quadratic_damping": _quadratic_damping,
    "asymmetric_damping": _asymmetric_damping,
    "digressive_damping": _digressive_damping,
    "position_dependent_damping": _position_dependent_damping,
    "friction": _friction,
    "bouc_wen": _bouc_wen,
    "maxwell": _maxwell,
    "periodic_force": _periodic_force,
    "temperature_fade": _temperature_fade,
    "time_fade": _time_fade,
    "hidden_mass": _hidden_mass,
    "added_mass": _added_mass,
    "input_gain": _input_gain,
    "delay": _delay,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECT_KINDS)
def test_effect_does_what_its_textbook_says(name):
    CHECKS[name]()


def test_no_effect_adds_no_force():
    _follows(_run(), lambda x, _: np.zeros_like(x))


def test_effects_add_up():
    effects = ({"preload": {"force_n": 2.0}}, {"cubic_stiffness": {"stiffness_n_per_m3": 9e4}})
    _follows(_run(*effects), lambda x, _: 2.0 - 9e4 * x**3)


def test_effects_with_memory_keep_their_own_state():
    friction = {"friction": {"coulomb_force_n": 5.0, "presliding_m": 1e-4}}
    branch = {"maxwell": {"stiffness_n_per_m": 300.0, "relaxation_time_s": 0.05}}
    one, other = _run(friction, branch), _run(branch, friction)
    np.testing.assert_allclose(one.height_m, other.height_m, atol=1e-9)
