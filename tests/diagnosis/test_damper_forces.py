"""Force and slope of a damper from its laws, and their intervals."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dart_model.effects import effect
from rig.diagnosis.damper_forces import Damper, list_velocities, with_half_widths
from rig.diagnosis.search.fit import FitCovariance


def constants_with(damping_n_s_per_m):
    return 0.5, 900.0, damping_n_s_per_m, 9.81


@given(damping=st.floats(1.0, 1e4), speed=st.floats(1e-3, 3.0), sign=st.sampled_from([-1.0, 1.0]))
def test_a_linear_damper_is_its_damping(damping, speed, sign):
    force_n, slope = Damper((), constants_with(damping), 0.4).figures(np.array([sign * speed]))
    assert force_n[0] == pytest.approx(-damping * sign * speed, rel=1e-12)
    assert slope[0] == pytest.approx(damping, rel=1e-9)


def test_below_and_beyond_a_sharp_knee_are_the_two_slopes():
    law = effect("blow_off_damping")
    values = {"lost_damping_n_s_per_m": 590.0, "knee_velocity_m_per_s": 0.14}
    parameters = [values[parameter.name] for parameter in law.parameters]
    damper = Damper(((law, parameters),), constants_with(650.0), 0.4)
    force_n, slope = damper.figures(np.array([-0.3, -0.05, 0.05, 0.3]))
    assert slope == pytest.approx([60.0, 650.0, 650.0, 60.0], rel=1e-9)
    beyond_n = 650.0 * 0.14 + 60.0 * 0.16
    assert force_n == pytest.approx([beyond_n, 32.5, -32.5, -beyond_n], rel=1e-9)


@given(st.floats(2e-3, 5.0), st.floats(2e-3, 5.0))
def test_speeds_are_round_and_reached(slow, fast):
    motion = np.concatenate([np.linspace(-slow, 0.0, 500), np.linspace(0.0, fast, 500)])
    velocities = list_velocities(motion)
    assert np.all(np.diff(velocities) > 0.0)
    assert velocities.min() >= -slow
    assert velocities.max() <= fast
    assert {f"{abs(v):e}"[0] for v in velocities} <= set("1235")
    for sign, largest in ((-1.0, slow), (1.0, fast)):
        assert np.any(sign * velocities > 0.3 * largest)


def test_a_strut_at_rest_has_no_speeds():
    assert not len(list_velocities(np.zeros(100)))


def test_intervals_follow_from_the_covariance():
    """A sum and a product of correlated variables, one of them searched as a logarithm."""
    values = np.array([3.0, 0.2])
    space = SimpleNamespace(logarithmic=np.array([False, True]), scale=np.array([0.5, 1.0]))
    fit = SimpleNamespace(solution=SimpleNamespace(values=values), space=space)
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    found, halves = with_half_widths(
        lambda it: np.array([it[0] + it[1], it[0] * it[1]]), fit, FitCovariance(covariance, 2.0)
    )
    assert found == pytest.approx([3.2, 0.6])
    for gradient, half in zip(([0.5, 0.2], [0.1, 0.6]), halves, strict=True):
        expected = 2.0 * math.sqrt(np.array(gradient) @ covariance @ np.array(gradient))
        assert half == pytest.approx(expected, rel=1e-3)
