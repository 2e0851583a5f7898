"""Where an effect shows: against the regions in which formulas act."""

import numpy as np
import pytest

from rig.diagnosis.acting_range import find_acting_range

LOW_M, HIGH_M = 0.30, 0.40
RESIDUAL_N = 0.2
BIN_M, BIN_M_PER_S = (HIGH_M - LOW_M) / 40, 2.0 * 0.6 / 40


@pytest.fixture(scope="module")
def motion():
    """Heights and velocities of a sweep that fills its stroke at all speeds up to 0.6 m/s."""
    rng = np.random.default_rng(3)
    phase = np.linspace(0.0, 400.0, 40_000)
    sizes = np.interp(phase, np.linspace(0.0, 400.0, 60), rng.uniform(0.2, 1.0, 60))
    heights_m = 0.5 * (LOW_M + HIGH_M) + 0.5 * (HIGH_M - LOW_M) * sizes * np.sin(phase)
    velocities = 0.6 * sizes * np.cos(phase)
    return heights_m, velocities


@pytest.fixture(scope="module")
def residual_n():
    return RESIDUAL_N * np.random.default_rng(4).standard_normal(40_000)


def overlap(parts, low, high):
    """F1 of shown parts with a planted region."""
    shared = sum(max(0.0, min(b, high) - max(a, low)) for a, b in parts)
    return 2.0 * shared / (sum(b - a for a, b in parts) + high - low)


@pytest.mark.parametrize("contact_m", [0.31, 0.33, 0.36])
def test_a_stop_shows_beyond_its_contact(motion, residual_n, contact_m):
    heights_m, velocities = motion
    force_n = 5e4 * np.maximum(contact_m - heights_m, 0.0)
    where = find_acting_range(heights_m, velocities, force_n, residual_n)
    assert overlap(where.height_m, heights_m.min(), contact_m) > 0.9
    assert where.recorded_height_m == (heights_m.min(), heights_m.max())


@pytest.mark.parametrize("knee_m_per_s", [0.1, 0.25])
def test_a_valve_shows_beyond_its_knee_in_rebound_alone(motion, residual_n, knee_m_per_s):
    heights_m, velocities = motion
    force_n = -400.0 * np.maximum(velocities - knee_m_per_s, 0.0)
    where = find_acting_range(heights_m, velocities, force_n, residual_n)
    assert overlap(where.velocity_m_per_s, knee_m_per_s, velocities.max()) > 0.9


def test_two_zones_are_two_parts(motion, residual_n):
    heights_m, velocities = motion
    is_inside = (heights_m < 0.32) | (heights_m > 0.385)
    where = find_acting_range(heights_m, velocities, -90.0 * velocities * is_inside, residual_n)
    assert len(where.height_m) == 2
    (_, first), (second, _) = where.height_m
    assert (first, second) == pytest.approx((0.32, 0.385), abs=BIN_M)


def test_a_force_below_what_is_left_shows_nowhere(motion, residual_n):
    heights_m, velocities = motion
    force_n = 0.02 * RESIDUAL_N * np.sign(velocities)
    where = find_acting_range(heights_m, velocities, force_n, residual_n)
    assert where.height_m == where.velocity_m_per_s == ()


def test_friction_shows_at_all_heights_and_speeds(motion, residual_n):
    heights_m, velocities = motion
    where = find_acting_range(heights_m, velocities, -10.0 * np.sign(velocities), residual_n)
    assert where.height_m == (where.recorded_height_m,)
    assert overlap(where.velocity_m_per_s, -0.6, 0.6) > 0.95
