"""What a recording says about the friction of a stage: closed forms and a planted friction."""

import numpy as np
import pytest

from rig.recordings.recording import Recording
from tests.diagnosis.driven import driven_by
from tests.scoreboard.emps_friction import free_run, profile

MASS_KG, FRICTION_N, SAMPLE_S = 90.0, 20.0, 1e-3
PUSH_N, PUSH_S, PUSHES = 100.0, 0.48, 8


def parameters(mass_kg: float = MASS_KG, damping: float = 0.0) -> np.ndarray:
    return np.array([mass_kg, damping, damping, 0.0, 0.0, 0.0])


def test_a_constant_force_above_the_friction_gives_a_parabola() -> None:
    t_s = SAMPLE_S * np.arange(200)
    force_n = np.full(len(t_s), 65.0)
    found_m = free_run(parameters(), force_n, SAMPLE_S, FRICTION_N)
    np.testing.assert_allclose(found_m, 0.5 * (65.0 - FRICTION_N) / MASS_KG * t_s**2, atol=1e-9)


def test_a_force_below_the_friction_moves_nothing() -> None:
    force_n = 0.99 * FRICTION_N * np.sin(np.arange(300.0))
    assert not free_run(parameters(), force_n, SAMPLE_S, FRICTION_N).any()


def test_a_damped_stage_comes_near_its_top_speed() -> None:
    force_n = np.full(15_000, 65.0)
    found_m = free_run(parameters(damping=200.0), force_n, SAMPLE_S, FRICTION_N)
    assert np.diff(found_m)[-1] / SAMPLE_S == pytest.approx(45.0 / 200.0, rel=1e-6)


def pushed_stage() -> Recording:
    """A stage pushed forth and back, in closed form: pieces of parabolas.

    Each push accelerates from rest, the opposite one stops the mass sooner than it began, since
    friction brakes both times; the rest of that time no force acts and the mass stands.
    """
    speed = (PUSH_N - FRICTION_N) / MASS_KG * PUSH_S
    stop_s = speed * MASS_KG / (PUSH_N + FRICTION_N)
    t_s = SAMPLE_S * np.arange(round(2 * PUSH_S * PUSHES / SAMPLE_S))
    z_m, force_n = np.zeros_like(t_s), np.zeros_like(t_s)
    begin_m = 0.0
    for i in range(PUSHES):
        sign = (-1.0) ** i
        after_s = t_s - 2 * PUSH_S * i
        forth = (after_s >= -1e-9) & (after_s < PUSH_S - 1e-9)
        back = (after_s >= PUSH_S - 1e-9) & (after_s < 2 * PUSH_S - 1e-9)
        gained_m = 0.5 * speed * PUSH_S
        slowed_s = np.minimum(after_s - PUSH_S, stop_s)
        braked_m = speed * (slowed_s - 0.5 * slowed_s**2 / stop_s)
        z_m[forth] = begin_m + sign * 0.5 * speed / PUSH_S * after_s[forth] ** 2
        z_m[back] = begin_m + sign * (gained_m + braked_m[back])
        force_n[forth] = sign * PUSH_N
        force_n[back & (after_s < PUSH_S + stop_s)] = -sign * PUSH_N
        begin_m += sign * (gained_m + 0.5 * speed * stop_s)
    return Recording("stage", t_s, 0.5 + z_m[:, np.newaxis], driven_by(force_n))


def test_the_planted_friction_leaves_the_least_error() -> None:
    frictions_n = (16.0, 18.0, FRICTION_N, 22.0, 24.0)
    errors_mm = profile(pushed_stage(), frictions_n)
    assert frictions_n[int(np.argmin(errors_mm))] == FRICTION_N
    assert np.all(np.diff(errors_mm[:3]) < 0.0)
    assert np.all(np.diff(errors_mm[2:]) > 0.0)
