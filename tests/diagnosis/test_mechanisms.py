"""A trailing arm, a quarter car, and guides with springs of their own."""

import pytest

from dart_model.spec import MODELS, load_model
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.linear_part import moving_mass_kg
from rig.diagnosis.problem.mechanism import constant_mechanism, open_plants
from rig.recordings.read import read_recording
from tests.diagnosis.answers import is_at_the_floor, missing
from tests.diagnosis.mechanisms import (
    ArmWithStop,
    QuarterCar,
    QuarterCarWithFriction,
    SprungGuide,
    TrailingArm,
)


@pytest.mark.long
def test_a_bump_stop_of_a_trailing_arm_is_found(tmp_path):
    arm = ArmWithStop()
    train, test = arm.recording(), arm.recording(2, arm.later_n, duration_s=8.0)
    found = diagnose(arm.model(tmp_path), [train], [test]).diagnosis
    assert found.effects[0].family == "stop"
    assert len(missing(found)) == 1
    assert found.verdict == "explained"
    assert is_at_the_floor(found)
    assert found.held_out.height_rmse_m.before > 10.0 * found.noise_floor.height_rmse_m
    parameters = found.effects[0].parameters
    assert parameters["contact_height_m"].value == pytest.approx(arm.contact_m, abs=3e-4)
    if found.effects[0].name == "bump_stop":
        stiffness = parameters["stiffness_n_per_m"]
        assert stiffness.value == pytest.approx(arm.stop_n_per_m, rel=0.05)


@pytest.mark.long
def test_a_complete_trailing_arm_lacks_nothing(tmp_path):
    arm = TrailingArm()
    train, test = arm.recording(), arm.recording(2, arm.later_n, duration_s=8.0)
    found = diagnose(arm.model(tmp_path), [train], [test]).diagnosis
    assert found.verdict == "nothing_missing"
    assert found.effects == ()


def test_a_mass_is_that_of_a_struts_upper_body_with_what_it_carries():
    spec = load_model(MODELS / "quarter_car.yaml")
    wheel, body = (part.mass_kg for part in spec.skeleton.bodies)
    mechanism = constant_mechanism(open_plants(spec))
    assert moving_mass_kg(spec, mechanism, 0) == pytest.approx(wheel + body)
    assert moving_mass_kg(spec, mechanism, 1) == pytest.approx(body)


def quarter_car(car, folder):
    files = car.csv(folder / "train.csv"), car.csv(folder / "test.csv", 2, car.later_n)
    model = load_model(MODELS / "quarter_car.yaml")
    struts = [strut.name for strut in model.struts]
    train, test = (read_recording(file, struts) for file in files)
    return diagnose(model, [train], [test]).diagnosis


@pytest.mark.long
def test_friction_in_the_suspension_of_a_quarter_car_is_found(tmp_path):
    found = quarter_car(QuarterCarWithFriction(), tmp_path)
    assert [(effect.family, effect.strut) for effect in found.effects] == [
        ("friction", "suspension")
    ]
    friction = found.effects[0].parameters["coulomb_force_n"]
    assert friction.value == pytest.approx(12.0, rel=0.05)
    assert found.verdict == "explained"
    assert is_at_the_floor(found)
    assert found.held_out.height_rmse_m.before > 10.0 * found.noise_floor.height_rmse_m


@pytest.mark.long
def test_a_complete_quarter_car_lacks_nothing(tmp_path):
    found = quarter_car(QuarterCar(), tmp_path)
    assert found.verdict == "nothing_missing"
    assert found.effects == ()


@pytest.mark.parametrize("suffix", ["skel", pytest.param("urdf", marks=pytest.mark.long)])
def test_a_spring_and_damper_of_the_joint_itself_are_not_missing(suffix, tmp_path):
    guide = SprungGuide(suffix)
    train, test = guide.recording(), guide.recording(2, guide.later_n)
    found = diagnose(guide.model(tmp_path), [train], [test]).diagnosis
    assert found.verdict == "nothing_missing"
    assert found.effects == ()
    assert found.linear == ()
    assert is_at_the_floor(found)
