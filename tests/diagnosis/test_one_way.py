"""A strut that moves one way: dry friction and a preload are the same force there."""

import math

import pytest

from rig.diagnosis.diagnose import diagnose
from tests.diagnosis import little_dyno as dyno

FRICTION_N = 40.0


def slow_rebound(t):
    """Rising all the time, at 1 to 9 mm/s."""
    rate, swing, omega = 5e-3, 4e-3, 1.7
    z = dyno.MIDDLE - 0.03 + rate * t - swing / omega * (math.cos(omega * t) - 1.0)
    return z, rate + swing * math.sin(omega * t)


def both_ways(t):
    z, v = slow_rebound(t)
    return z + 0.01 * math.sin(3.0 * t), v + 0.03 * math.cos(3.0 * t)


class Friction(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return -FRICTION_N * math.tanh(v / 1e-5)


class Preload(dyno.Nothing):
    def __init__(self, force_n):
        self.force_n = force_n

    def force(self, t, z, v, state, warm):
        return self.force_n


def diagnosed(effect, motion):
    runs = [dyno.run(effect, seed=seed, motion=motion) for seed in (1, 2)]
    return diagnose(dyno.model(), runs[:1], held_out=runs[1:]).diagnosis


@pytest.mark.parametrize("effect", [Friction(), Preload(-FRICTION_N)], ids=["friction", "preload"])
def test_friction_and_preload_are_reported_together_where_a_strut_moves_one_way(effect):
    found = diagnosed(effect, slow_rebound)
    assert found.verdict == "ambiguous"
    assert [item.family for item in found.effects] == ["preload"]
    assert found.ambiguous_with == ("friction",)
    assert "reverses" in found.suggested_excitation


def test_a_preload_that_pushes_along_the_motion_is_no_friction():
    found = diagnosed(Preload(FRICTION_N), slow_rebound)
    assert found.verdict == "explained"
    assert [item.family for item in found.effects] == ["preload"]


@pytest.mark.parametrize(
    ("effect", "family"), [(Friction(), "friction"), (Preload(-FRICTION_N), "preload")]
)
def test_motion_both_ways_distinguishes_them(effect, family):
    found = diagnosed(effect, both_ways)
    assert found.verdict == "explained"
    assert [item.family for item in found.effects] == [family]
