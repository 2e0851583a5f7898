"""Virtual sensors of bodies and joints, by closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.errors import ModelError
from dart_model.plant import DartPlant
from dart_model.plant.virtual_sensors import turning_joints
from dart_model.spec import MODELS, load_model
from dart_model.virtual_sensors import KINDS, QUANTITIES, VirtualSensor

MASS, LENGTH, INERTIA, GRAVITY = 3.0, 0.8, 0.05, 9.81

PENDULUM = f"""<?xml version="1.0"?>
<robot name="pendulum"><link name="ground"/>
<link name="rod"><inertial><origin xyz="0 0 {-LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="0.01" iyy="{INERTIA}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pivot" type="revolute"><origin xyz="0.1 0 2"/><parent link="ground"/>
<child link="rod"/><axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="1e9" velocity="1e9"/>
</joint></robot>"""

MODEL = """
name: pendulum
gravity_m_per_s2: 9.81
skeleton: {file: pendulum.urdf}
inputs:
  push: {force_on: rod, at: [0, 0, -0.5], axis: [1, 0, 0]}
struts:
  - name: spring
    between: [world, rod]
    attachments_m: [[1.0, 0.2, 1.5], [0.05, 0, -0.7]]
    free_length_m: 0.6
    stiffness_n_per_m: 400.0
    damping_n_s_per_m: 12.0
"""


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pendulum")
    (folder / "pendulum.urdf").write_text(PENDULUM)
    (folder / "pendulum.yaml").write_text(MODEL)
    return DartPlant(load_model(folder / "pendulum.yaml"))


def read(plant, sensors, angle, rate, virtual_n=0.0, push_n=0.0, residual_n=None):
    reader = plant.virtual_sensors(sensors)
    state = plant.state((angle,), (rate,), (), 0.0)
    loaded = plant.load(state, (virtual_n,), (push_n,), 20.0)
    residual = (virtual_n if residual_n is None else residual_n,)
    return dict(zip(sensors, reader.read(loaded, residual), strict=True)), loaded


def spring(angle, rate):
    """Point, force vector on the rod, by the geometry of MODEL."""

    def point(q):
        x, z = 0.05, -0.7
        return np.array(
            [0.1 + x * math.cos(q) + z * math.sin(q), 0.0, 2.0 - x * math.sin(q) + z * math.cos(q)]
        )

    fixed = np.array([1.0, 0.2, 1.5])
    gap = point(angle) - fixed
    length = float(np.linalg.norm(gap))
    step = 1e-6
    speed = (
        float(np.linalg.norm(point(angle + step * rate) - fixed))
        - float(np.linalg.norm(point(angle - step * rate) - fixed))
    ) / (2.0 * step)
    return point(angle), (-400.0 * (length - 0.6) - 12.0 * speed), gap / length


@settings(max_examples=30, deadline=None)
@given(
    angle=st.floats(-1.2, 1.2),
    rate=st.floats(-5.0, 5.0),
    residual_n=st.floats(-50.0, 50.0),
    push_n=st.floats(-30.0, 30.0),
)
def test_a_pendulum_has_the_motion_and_the_reaction_of_its_own_equations(
    pendulum, angle, rate, residual_n, push_n
):
    sensors = {
        "x": VirtualSensor(position_of="rod", at=(0.0, 0.0, -LENGTH), axis=(1, 0, 0)),
        "vz": VirtualSensor(velocity_of="rod", at=(0.0, 0.0, -LENGTH)),
        "ax": VirtualSensor(acceleration_of="rod", at=(0.0, 0.0, -LENGTH), axis=(2, 0, 0)),
        "angle": VirtualSensor(angle_of="rod", axis=(0, 1, 0)),
        "rate": VirtualSensor(rate_of="rod", axis=(0, 3, 0)),
        "q": VirtualSensor(coordinate_of="pivot"),
        "dq": VirtualSensor(speed_of="pivot"),
        "rx": VirtualSensor(reaction_of="pivot", axis=(1, 0, 0)),
        "rz": VirtualSensor(reaction_of="pivot"),
        "free": VirtualSensor(torque_of="pivot", axis=(0, 1, 0)),
        "held": VirtualSensor(torque_of="pivot", axis=(1, 0, 0)),
    }
    found, _ = read(pendulum, sensors, angle, rate, 0.0, push_n, residual_n)
    point, law_n, along = spring(angle, rate)
    force = (law_n + residual_n) * along
    s, c = math.sin(angle), math.cos(angle)
    mass_at = np.array([-LENGTH * s, 0.0, -LENGTH * c])
    weight, push = np.array([0.0, 0.0, -MASS * GRAVITY]), np.array([push_n, 0.0, 0.0])
    pivot, push_at = np.array([0.1, 0.0, 2.0]), np.array([-0.5 * s, 0.0, -0.5 * c])
    moment = np.cross(point - pivot, force) + np.cross(mass_at, weight) + np.cross(push_at, push)
    turn = moment[1] / (INERTIA + MASS * LENGTH**2)
    acceleration = np.array([0.0, turn, 0.0])
    a = np.cross(acceleration, mass_at) - rate**2 * mass_at
    reaction = MASS * a - weight - force - push
    expected = {
        "x": 0.1 - LENGTH * s, "vz": LENGTH * s * rate, "ax": a[0], "angle": angle, "rate": rate,
        "q": angle, "dq": rate, "rx": reaction[0], "rz": reaction[2], "free": 0.0,
        "held": -moment[0],
    }  # fmt: skip
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-5), name


def test_straight_guides_are_read_by_a_matrix_with_the_same_numbers():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    sensors = {
        "body": VirtualSensor(position_of="body"),
        "hub": VirtualSensor(acceleration_of="wheel", at=(0.1, 0.0, 0.0)),
        "rate": VirtualSensor(velocity_of="body"),
        "angle": VirtualSensor(angle_of="body", axis=(1, 0, 0)),
        "reaction": VirtualSensor(reaction_of="body_joint"),
    }
    reader = plant.virtual_sensors(sensors)
    loaded = plant.load(plant.init([0.28, 0.35], [0.1, -0.2]), (30.0, 50.0), (10.0,), 20.0)
    quick = reader.read(loaded, (0.0, 70.0))
    reader._affine = None
    assert quick == pytest.approx(reader.read(loaded, (0.0, 70.0)), abs=1e-9)
    again = plant.load(loaded.state, (0.0, 70.0), (10.0,), 20.0)
    assert quick[1] == pytest.approx(again.acceleration[0])
    assert quick[4] == pytest.approx(0.0, abs=1e-9)


def test_a_newton_in_a_strut_changes_what_it_accelerates():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    sensors = {
        "hub": VirtualSensor(acceleration_of="wheel"),
        "body": VirtualSensor(acceleration_of="body"),
        "place": VirtualSensor(position_of="body"),
    }
    loaded = plant.load(plant.init([0.28, 0.35]), (0.0, 0.0), (0.0,), 20.0)
    masses = {body.name: body.mass_kg for body in plant.spec.skeleton.bodies}
    expected = [
        [1.0 / masses["wheel"], -1.0 / masses["wheel"]],
        [0.0, 1.0 / masses["body"]],
        [0.0, 0.0],
    ]
    gains = plant.virtual_sensors(sensors).force_gains(loaded)
    np.testing.assert_allclose(gains, expected, atol=1e-9)


def test_gains_of_a_motion_are_its_slopes_along_what_moves(pendulum):
    """Where the only joint turns, by differences of two places."""
    sensors = {
        "x": VirtualSensor(position_of="rod", at=(0.0, 0.0, -LENGTH), axis=(1, 0, 0)),
        "vz": VirtualSensor(velocity_of="rod", at=(0.0, 0.0, -LENGTH)),
        "angle": VirtualSensor(angle_of="rod", axis=(0, 1, 0)),
        "q": VirtualSensor(coordinate_of="pivot"),
        "rz": VirtualSensor(reaction_of="pivot"),
    }
    reader = pendulum.virtual_sensors(sensors)
    assert not reader.has_constant_gains
    for angle in (-0.9, 0.2, 0.8):
        loaded = pendulum.load(pendulum.state((angle,), (0.0,), (), 0.0), (0.0,), (0.0,), 20.0)
        gains, by_motions, directly = reader.motion_gains(loaded, (0,))
        assert by_motions.shape == directly.shape == (5, 0)
        ends = [
            pendulum.load(pendulum.state((q,), (0.0,), (), 0.0), (0.0,), (0.0,), 20.0)
            for q in (angle - 1e-5, angle + 1e-5)
        ]
        low, high = (np.array(reader.read(end, (0.0,))) for end in ends)
        height = ends[1].state.struts[0][0] - ends[0].state.struts[0][0]
        by_height = (high - low) / height
        assert gains[[0, 2, 3], 0] == pytest.approx(by_height[[0, 2, 3]], rel=1e-6)
        # A velocity changes by the strut's rate as the point's place by its height.
        assert gains[1, 0] == pytest.approx(LENGTH * math.sin(angle) * by_height[3], rel=1e-6)
        assert math.isnan(gains[4, 0])


def test_gains_of_guides_are_sums_of_heights_and_of_the_road():
    """The road carries the tyre, the tyre the wheel, the wheel the suspension, that the body."""
    plant = DartPlant(load_model(MODELS / "quarter_car_road.yaml"))
    sensors = {
        "body": VirtualSensor(position_of="body"),
        "hub": VirtualSensor(velocity_of="wheel"),
        "load": VirtualSensor(acceleration_of="wheel"),
    }
    reader = plant.virtual_sensors(sensors)
    names = [strut.name for strut in plant.spec.struts]
    tyre, suspension = names.index("tyre"), names.index("suspension")
    heights = [strut.free_length_m for strut in plant.spec.struts]
    loaded = plant.load(plant.init(heights), (0.0,) * 2, (0.0,) * plant.inputs, 20.0)
    assert reader.has_constant_gains
    gains, by_road, directly = reader.motion_gains(loaded, (tyre, suspension))
    np.testing.assert_allclose(gains[:2], [[1.0, 1.0], [1.0, 0.0]], atol=1e-9)
    np.testing.assert_allclose(by_road[:2], [[1.0], [1.0]], atol=1e-9)
    np.testing.assert_allclose(directly[:2], [[0.0], [0.0]], atol=1e-9)
    assert np.isnan(gains[2]).all()
    # Without the suspension's height the wheel is known, and the body is not.
    gains = reader.motion_gains(loaded, (tyre,)).by_heights
    assert math.isnan(gains[0, 0])
    assert gains[1, 0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (VirtualSensor(position_of="rodd"), "did you mean rod"),
        (VirtualSensor(reaction_of="rod"), "expected .*pivot"),
    ],
)
def test_what_the_model_has_not_is_refused(pendulum, sensor, message):
    with pytest.raises(ModelError, match=message):
        pendulum.virtual_sensors({"x": sensor})


def test_a_sensor_has_one_kind():
    assert set(KINDS) < set(VirtualSensor.model_fields)
    assert len(QUANTITIES) == len(KINDS) + 2
    for kinds in ({}, {"position_of": "a", "rate_of": "a"}):
        with pytest.raises(ValueError, match="expected one of"):
            VirtualSensor(**kinds)
    with pytest.raises(ValueError, match="at: expected with"):
        VirtualSensor(angle_of="a", at=(1, 0, 0))
    with pytest.raises(ValueError, match="axis: expected none"):
        VirtualSensor(force_of="a", axis=(1, 0, 0))


def test_joints_that_turn_are_in_radians(pendulum):
    assert turning_joints(pendulum.spec) == {"pivot"}
    sensor = VirtualSensor(coordinate_of="pivot")
    assert sensor.quantity(is_turning=True).suffix == "coordinate_rad"
    assert sensor.quantity(is_turning=False).suffix == "coordinate_m"
