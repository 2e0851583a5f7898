"""Friction that grows with a load, contacts that are lost and met again, preloaded springs."""

import math

import pytest

from rig.diagnosis.diagnose import diagnose
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import holds


class UnderLoad(bench.Nothing):
    fine = 20

    def force(self, t, z, v, state):
        return -(1.0 + 0.25 * abs(bench.load_n(t))) * math.tanh(v / 2e-3)


class UnderSpring(bench.Nothing):
    fine = 20

    def force(self, t, z, v, state):
        spring_n = abs(bench.STIFFNESS * (z - bench.FREE))
        return -(0.5 + 0.04 * spring_n) * math.tanh(v / 2e-3)


class Lifting(bench.Nothing):
    """A spring and a damper that only push."""

    fine = 40

    def force(self, t, z, v, state):
        return max(bench.STIFFNESS * (z - bench.FREE) + bench.DAMPING * v, 0.0)


class Preloaded(bench.Nothing):
    """A spring that holds up to 12 N, and gives way on either side."""

    fine = 40

    def force(self, t, z, v, state):
        return -12.0 * min(max((z - 0.36) / 0.003, -1.0), 1.0)


class LiftingStrut(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return max(dyno.STIFFNESS * (z - dyno.FREE) + dyno.DAMPING * v, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "name", "truth"),
    [
        (UnderLoad, "load_friction", {"coulomb_force_n": 1.0, "load_share": 0.25}),
        (UnderSpring, "spring_load_friction", {"coulomb_force_n": 0.5, "load_share": 0.04}),
    ],
)
def test_friction_under_a_load_is_found_with_its_share(effect, name, truth):
    runs = [bench.run(effect(), seed=seed) for seed in (1, 2)]
    found = diagnose(bench.model(damping=0.9 * bench.DAMPING), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, [item.name for item in found.effects]) == ("explained", [name])
    for key, value in truth.items():
        estimate = found.effects[0].parameters[key]
        assert estimate.value == pytest.approx(value, rel=0.03)
        assert holds(estimate, value)


@pytest.mark.slow
def test_a_preloaded_spring_is_found_with_its_plateau():
    runs = [bench.run(Preloaded(), seed=seed) for seed in (1, 2)]
    found = diagnose(bench.model(stiffness=0.9 * bench.STIFFNESS), runs[:1], runs[1:]).diagnosis
    names = [item.name for item in found.effects]
    assert (found.verdict, names) == ("explained", ["plateau_stiffness"])
    truth = {"plateau_force_n": 12.0, "centre_height_m": 0.36, "half_width_m": 0.003}
    for key, value in truth.items():
        assert holds(found.effects[0].parameters[key], value)


@pytest.mark.slow
def test_a_contact_that_is_lost_and_met_again_is_found():
    """A longer flight, of which nothing is known but its ends, is another matter."""
    runs = [
        bench.run(Lifting(), seed=seed, load=lambda t: 1.5 * bench.load_n(t)) for seed in (1, 2)
    ]
    rough = bench.model(stiffness=1.05 * bench.STIFFNESS, damping=0.95 * bench.DAMPING)
    found = diagnose(rough, runs[:1], runs[1:]).diagnosis
    assert (found.verdict, [item.name for item in found.effects]) == ("explained", ["lift_off"])
    assert found.held_out.height_rmse_m.after < 1.1 * found.noise_floor.height_rmse_m


def test_a_strut_that_lifts_off_on_a_dyno_is_found():
    runs = [dyno.run(LiftingStrut(), seed=seed) for seed in (1, 2)]
    found = diagnose(dyno.model(damping=0.9 * dyno.DAMPING), runs[:1], runs[1:]).diagnosis
    assert (found.verdict, [item.name for item in found.effects]) == ("explained", ["lift_off"])
    assert holds(found.effects[0].parameters["holding_force_n"], 0.0)
