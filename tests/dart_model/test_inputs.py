"""What drives a model: forces along axes, torques on joints, and bodies that are moved."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from can_dbc.errors import InputError
from dart_model.errors import ModelError
from dart_model.plant import DartPlant
from dart_model.spec import dump_model, parse_model

ROAD = """
name: quarter_car_on_road
skeleton:
  bodies:
    - {name: platform, mass_kg: 3.0, joint: {type: prismatic, axis: [0, 0, -1], parent: world}}
    - {name: wheel, mass_kg: 40.0, joint: {type: prismatic, axis: [0, 0, 1], parent: world}}
    - {name: body, mass_kg: 300.0, joint: {type: prismatic, axis: [0, 0, 1], parent: world}}
inputs:
  actuator: {force_on: body}
  road: {motion_of: platform}
struts:
  - {name: tyre, between: [platform, wheel], free_length_m: 0.3, stiffness_n_per_m: 2.0e5,
     damping_n_s_per_m: 100.0}
  - {name: suspension, between: [wheel, body], free_length_m: 0.5, stiffness_n_per_m: 2.0e4,
     damping_n_s_per_m: 1500.0}
"""
AMPLITUDE_M, OMEGA = 0.02, 12.0


def model(text):
    return parse_model(text, "model.yaml")


def drive(t_s):
    """Actuator's force, and position, velocity and acceleration of the road."""
    angle = OMEGA * t_s
    return (
        50.0 * math.sin(3.0 * t_s),
        AMPLITUDE_M * math.sin(angle),
        AMPLITUDE_M * OMEGA * math.cos(angle),
        -AMPLITUDE_M * OMEGA**2 * math.sin(angle),
    )


def quarter_car(t_s, y):
    """The same bench in its own coordinates: positions of wheel and body, and their rates."""
    force_n, road_m, road, _ = drive(t_s)
    wheel_m, body_m, wheel, body = y
    tyre_n = 2e5 * (0.3 - (wheel_m - road_m)) - 100.0 * (wheel - road)
    suspension_n = 2e4 * (0.5 - (body_m - wheel_m)) - 1500.0 * (body - wheel)
    return [
        wheel,
        body,
        (tyre_n - suspension_n) / 40.0 - 9.81,
        (suspension_n + force_n) / 300.0 - 9.81,
    ]


def follow(plant, state, duration_s, steps, drive=drive):
    h = duration_s / steps
    without = (0.0,) * plant.struts
    for k in range(steps):
        loaded = plant.load(state, without, drive(k * h), 20.0)
        state = plant.step(loaded, h, drive((k + 1) * h))
    return state


def test_a_quarter_car_on_a_road_moves_as_its_own_equations_do():
    plant = DartPlant(model(ROAD))
    assert (plant.inputs, plant.coordinates, plant.free_coordinates) == (4, 3, 2)
    rest = plant.init([math.nan, math.nan])
    (tyre_m, _), (suspension_m, _) = rest.struts
    assert tyre_m == pytest.approx(0.3 - 340.0 * 9.81 / 2e5, abs=1e-9)
    assert suspension_m == pytest.approx(0.5 - 300.0 * 9.81 / 2e4, abs=1e-9)
    start = plant.init([tyre_m, suspension_m], [-AMPLITUDE_M * OMEGA, 0.0], inputs=drive(0.0))
    y0 = [tyre_m, tyre_m + suspension_m, 0.0, 0.0]
    exact = solve_ivp(quarter_car, (0.0, 1.5), y0, rtol=1e-11, atol=1e-13).y[:, -1]
    expected = np.array([exact[0] - drive(1.5)[1], exact[1] - exact[0]])
    heights = [height for height, _ in follow(plant, start, 1.5, 1500).struts]
    assert heights == pytest.approx(expected, abs=3e-9)


def test_the_motion_of_a_body_is_followed_to_the_third_order_or_better():
    plant = DartPlant(model(ROAD))
    start = plant.init([0.28, 0.35], [-AMPLITUDE_M * OMEGA, 0.0], inputs=drive(0.0))
    plant.step_s = 1.0  # one step of the integrator a call

    def without_force(t_s):
        return (0.0, *drive(t_s)[1:])

    heights = [
        np.array([it for it, _ in follow(plant, start, 0.4, steps, without_force).struts])
        for steps in (50, 100, 200, 3200)
    ]
    errors = [np.linalg.norm(item - heights[-1]) for item in heights[:-1]]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders > 2.8)


def test_a_body_on_a_shaker_answers_by_its_transmissibility():
    """The joint's parent is the shaker, so that its acceleration acts as inertia."""
    mass, stiffness, damping = 10.0, 4000.0, 60.0
    plant = DartPlant(
        model(
            """
name: shaker
gravity_m_per_s2: 0.0
skeleton:
  bodies:
    - {name: table, mass_kg: 1.0, joint: {type: prismatic, parent: world}}
    - {name: body, mass_kg: 10.0, joint: {type: prismatic, parent: table}}
inputs:
  shaker: {motion_of: table}
struts:
  - {name: mount, between: [table, body], free_length_m: 0.1, stiffness_n_per_m: 4000.0,
     damping_n_s_per_m: 60.0}
"""
        )
    )
    omega, rate_hz = 15.0, 1000.0
    relative = mass * omega**2 / (stiffness - mass * omega**2 + 1j * omega * damping)
    h = 1.0 / rate_hz

    def shaker(t_s):
        wave = 0.01 * np.exp(1j * omega * t_s)
        return [(wave * (1j * omega) ** k).imag for k in range(3)]

    state = plant.init([0.1], inputs=shaker(0.0))
    found, expected = [], []
    for k in range(6000):
        loaded = plant.load(state, (0.0,), shaker(k * h), 20.0)
        state = plant.step(loaded, h, shaker((k + 1) * h))
        found.append(state.struts[0][0] - 0.1)
        expected.append((0.01 * relative * np.exp(1j * omega * (k + 1) * h)).imag)
    assert found[4000:] == pytest.approx(expected[4000:], abs=1e-7)


PENDULUM = """
name: pendulum
gravity_m_per_s2: {gravity}
skeleton:
  bodies:
    - {{name: arm, mass_kg: 2.0, inertia_kg_m2: [0.3, 0.3, 0.3],
        joint: {{type: revolute, axis: [0, 1, 0], parent: world}}}}
    - {{name: tip, mass_kg: 1.5, joint: {{type: prismatic, axis: [1, 0, 0], parent: arm,
        offset_m: [0.4, 0, 0]}}}}
inputs: {inputs}
struts:
  - {{name: strut, between: [arm, tip], free_length_m: 0.0, stiffness_n_per_m: 1.0e3,
     damping_n_s_per_m: 5.0}}
"""


def pendulum(inputs, gravity=0.0):
    return DartPlant(model(PENDULUM.format(inputs=inputs, gravity=gravity)))


def turning(plant, inputs):
    """Angular acceleration of the arm at rest."""
    state = plant.state((0.0, 0.0), (0.0, 0.0), (), 0.0)
    return plant.load(state, (0.0,), inputs, 20.0).acceleration[0]


def test_a_torque_turns_its_joint():
    # The tip's moments are those of its mass, as no others are stated.
    inertia = 0.3 + 1.5 + 1.5 * 0.4**2
    plant = pendulum("{motor: {torque_on: arm_joint}}")
    assert turning(plant, (7.0,)) == pytest.approx(7.0 / inertia, rel=1e-12)


def test_forces_act_along_their_axes_at_their_points():
    inertia = 0.3 + 1.5 + 1.5 * 0.4**2
    up = "{force_on: tip, axis: [0, 0, 2]}"
    slanted = "{force_on: arm, at: [0.2, 0, 0], axis: [3, 0, 4]}"
    plant = pendulum(f"{{a: {up}, b: {slanted}}}")
    # A force upwards at x turns about -y.
    moment = -(0.4 * 10.0 + 0.2 * 0.8 * 5.0)
    assert turning(plant, (10.0, 5.0)) == pytest.approx(moment / inertia, rel=1e-12)
    both = turning(plant, (10.0, 0.0)) + turning(plant, (0.0, 5.0))
    assert both == pytest.approx(moment / inertia, rel=1e-12)


@pytest.mark.parametrize(
    "text",
    [
        ROAD,
        ROAD.replace("parent: world}}\n    - {name: body", "parent: platform}}\n    - {name: body"),
    ],
)
def test_mechanics_are_the_equations_of_motion_of_what_is_free(text):
    plant = DartPlant(model(text))
    rng = np.random.default_rng(4)
    for _ in range(4):
        inputs, virtual = rng.uniform(-1.0, 1.0, 4), rng.uniform(-50.0, 50.0, 2)
        state = plant.init(rng.uniform(0.2, 0.5, 2), rng.uniform(-1.0, 1.0, 2), inputs=inputs)
        q, v = np.array(state.positions), np.array(state.velocities)
        there = plant.mechanics(q, v)
        loaded = plant.load(state, virtual.tolist(), inputs.tolist(), 20.0)
        forces = np.array(loaded.forces_n) + virtual
        push = there.bias + there.struts.T @ forces + there.inputs @ inputs
        own = np.linalg.solve(there.mass, push)
        expected = there.struts @ own + there.moved @ [inputs[3]]
        assert loaded.accelerations_m_per_s2 == pytest.approx(expected, abs=1e-9)
        assert there.heights_m == pytest.approx([height for height, _ in state.struts])


def test_answers_depend_on_arguments_alone_with_a_moved_body():
    plant = DartPlant(model(ROAD))
    state = plant.init([0.28, 0.35], [0.1, -0.2], inputs=drive(0.3))
    loaded = plant.load(state, (3.0, -2.0), drive(0.3), 20.0)
    after = plant.step(loaded, 1e-3, drive(0.301))
    other = plant.init([0.2, 0.3], inputs=drive(2.0))
    plant.step(plant.load(other, (9.0, 0.0), drive(2.0), 60.0), 5e-3, drive(2.005))
    plant.mechanics(np.ones(3), np.ones(3))
    assert plant.step(plant.load(state, (3.0, -2.0), drive(0.3), 20.0), 1e-3, drive(0.301)) == after
    # Numbers for differences are of what is free, with the platform at zero.
    numbers = plant.numbers(state)
    assert len(numbers) == 4
    assert plant.numbers(plant.state_of(numbers)) == numbers


def test_a_model_with_inputs_is_written_and_read():
    spec = model(ROAD)
    assert parse_model(dump_model(spec), "again.yaml") == spec
    assert list(spec.drive) == ["actuator", "road"]


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("force_on: body", "force_on: cab", "inputs.actuator: force_on 'cab': expected"),
        ("motion_of: platform", "motion_of: world", "inputs.road: motion_of 'world': expected"),
        ("motion_of: platform", "torque_on: platform", "did you mean platform_joint?"),
        ("force_on: body", "push: body", "expected one of force_on, torque_on and motion_of"),
        ("{force_on: body}", "{force_on: body, axis: [0, 0, 0]}", "expected a direction"),
        ("name: quarter_car_on_road", "name: road\napplied_force_body: body", "expected none"),
    ],
)
def test_a_wrong_input_is_one_line_that_names_it(before, after, named):
    with pytest.raises(InputError, match=r"^model\.yaml: ") as caught:
        model(ROAD.replace(before, after))
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("motion_of: platform", "motion_of: platform, axis: [1, 0, 0]", "expected that of its jo"),
        ("motion_of: platform}", "motion_of: platform}\n  other: {motion_of: platform}", "twice"),
        ("motion_of: platform", "torque_on: platform_joint", "expected a revolute joint"),
        ("type: prismatic, axis: [0, 0, -1]", "type: free", "is a FreeJoint, expected a prismatic"),
        (
            "motion_of: platform}",
            "motion_of: platform}\n  a: {motion_of: wheel}\n  b: {motion_of: body}",
            "every joint is moved",
        ),
    ],
)
def test_a_joint_that_cannot_be_driven_so_is_refused(before, after, named):
    with pytest.raises(ModelError, match="model quarter_car_on_road: inputs") as caught:
        DartPlant(model(ROAD.replace(before, after)))
    assert named in str(caught.value)
