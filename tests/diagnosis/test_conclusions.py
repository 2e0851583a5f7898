"""What is concluded from the sets that were fitted, where a first answer would be a wrong one."""

import math

import pytest

from dart_model.spec import load_model
from rig.diagnosis.diagnose import diagnose
from rig.recordings.read import read_recording
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import correction
from tests.truth.cases import make_case
from tests.truth.files import write_case

pytestmark = pytest.mark.long


def diagnosed(seed, kind, folder):
    write_case(make_case(seed, kind), folder)
    runs = [read_recording(folder / f"{name}.csv") for name in ("train", "test")]
    return diagnose(load_model(folder / "model.yaml"), runs[:1], runs[1:]).diagnosis


def test_a_law_with_too_many_parameters_gives_way_to_one_of_its_family(tmp_path):
    # An exponential spring that a gas spring fits best: the data bound none of its three sizes.
    found = diagnosed(2026112300180, "dyno_nonlinear_stiffness", tmp_path)
    assert found.verdict == "explained"
    assert [effect.family for effect in found.effects] == ["nonlinear_stiffness"]


def test_a_law_that_held_out_data_do_not_call_for_is_a_candidate_where_others_do(tmp_path):
    # A stop that the held-out run hardly reaches: the linear model alone is at the floor there.
    found = diagnosed(2026112301261, "stop", tmp_path)
    assert [effect.family for effect in found.effects] == ["stop"]
    assert found.effects[0].is_candidate
    assert found.verdict == "ambiguous"
    assert found.ambiguous_with == ()


class Weakening(dyno.Nothing):
    """Friction with memory and a film that thins with speed, instead of the dyno's damper."""

    size = 1

    def force(self, t, z, v, state, warm):
        return dyno.DAMPING * v - (160.0 - 400.0 * abs(v)) * state[0]

    def rate(self, t, z, v, state):
        return (v / 1.5e-3 * (1.0 - state[0] * math.copysign(1.0, v)),)


def test_friction_that_weakens_with_speed_makes_no_damper_that_pushes():
    short = {"duration_s": 4.0}
    runs = [
        dyno.run(Weakening(), **short),
        dyno.run(Weakening(), seed=2, motion=dyno.later, **short),
    ]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "partly_explained"
    assert found.effects[0].family in {"friction", "hysteresis"}
    assert correction(found, "damping_n_s_per_m").total.value == 0.0
    error = found.held_out.strut_force_rmse_n
    assert error.after < 0.25 * error.before
