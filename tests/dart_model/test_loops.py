"""Closed loops against motions in a minimal coordinate, and what is refused."""

import copy
import json
import math
from pathlib import Path

import numpy as np
import pytest

import rig
from can_dbc.errors import InputError
from dart_model.errors import ModelError
from dart_model.plant import DartPlant
from dart_model.spec import dump_model, parse_model
from dart_model.virtual_sensors import VirtualSensor
from tests.dart_model.mechanisms import (
    GRAVITY,
    LOWER,
    PIVOT,
    TICK_S,
    double_wishbone,
    exact_angles,
    macpherson,
    run,
)

MECHANISMS = [double_wishbone, macpherson]


def plant_of(content):
    return DartPlant(parse_model(json.dumps(content), "a test"))


@pytest.mark.slow
@pytest.mark.parametrize("make", MECHANISMS)
def test_a_mechanism_moves_as_in_its_minimal_coordinate(make):
    mechanism = make()
    plant = plant_of(mechanism.content)
    states = run(plant, mechanism.strut_m(0.0), 20.0)
    angles = exact_angles(mechanism, TICK_S * np.arange(len(states)))
    lengths = np.array([mechanism.strut_m(angle) for angle in angles])
    stroke = np.ptp(lengths)
    assert stroke > 0.05
    found = np.array([state.struts[0][0] for state in states])
    assert np.abs(found - lengths).max() < 1e-6 * stroke


@pytest.mark.parametrize("make", MECHANISMS)
def test_a_strut_is_accelerated_as_in_the_minimal_coordinate(make):
    mechanism = make()
    plant = plant_of(mechanism.content)
    assert plant.free_coordinates == 1
    for angle, rate, force in [(0.0, 0.0, 0.0), (0.2, 1.5, 900.0), (-0.3, -2.0, -400.0)]:
        velocity = mechanism.slope(mechanism.strut_m, angle) * rate
        state = plant.init([mechanism.strut_m(angle)], [velocity])
        assert state.struts[0] == pytest.approx((mechanism.strut_m(angle), velocity), abs=1e-9)
        loaded = plant.load(state, (0.0,), (force,), 23.0)
        expected = mechanism.strut_acceleration(angle, rate, force)
        assert loaded.accelerations_m_per_s2[0] == pytest.approx(expected, rel=1e-7, abs=1e-7)
        # The same by the equations on the free coordinate.
        again = plant.state_of(plant.numbers(state))
        assert again.positions == pytest.approx(state.positions, abs=1e-9)
        here = plant.mechanics(np.array(state.positions), np.array(state.velocities))
        forces = here.bias + here.struts.T @ loaded.forces_n + here.inputs @ [force]
        free = np.array(loaded.acceleration)[plant.free]
        assert np.linalg.solve(here.mass, forces) == pytest.approx(free, rel=1e-9, abs=1e-9)


def changed(make=double_wishbone, **loop):
    content = copy.deepcopy(make().content)
    content["skeleton"]["loops"][0] |= loop
    return content


def spatial():
    """The double wishbone with a ball joint at its lower end, too: the upright can be steered."""
    content = changed()
    content["skeleton"]["bodies"][1]["joint"] |= {"type": "ball"}
    return content


def reversed_loop():
    """The same point in the upright's frame, whose origin is the lower ball joint."""
    _, y, z = changed()["skeleton"]["loops"][0]["at"]
    at = [0, y + PIVOT[0] - LOWER, z + PIVOT[1]]
    return changed(between=["upright", "upper"], at=at)


@pytest.mark.parametrize(
    "other",
    [changed(type="revolute", axis=[1, 0, 0]), spatial(), reversed_loop()],
)
def test_other_joints_that_allow_the_same_motion_give_the_same(other):
    """Rows that a plane satisfies by itself carry nothing; an upright is not steered by itself."""
    start_m = double_wishbone().strut_m(0.0)
    states = [run(plant_of(content), start_m, 0.5) for content in (changed(), other)]
    heights = [[state.struts[0][0] for state in run_] for run_ in states]
    assert heights[1] == pytest.approx(heights[0], abs=1e-8)


def test_free_coordinates_are_those_of_joints_with_one():
    plant = plant_of(spatial())
    assert plant.coordinates == 5
    assert plant.free_coordinates == 2
    state = plant.init([double_wishbone().strut_m(0.1)])
    assert plant.numbers(plant.state_of(plant.numbers(state))) == pytest.approx(
        plant.numbers(state), abs=1e-12
    )


def slider_crank():
    """A crank of 0.1 m that turns a slider to and fro over a rod of 0.3 m."""
    crank, rod = 0.1, 0.3
    turning = {"type": "revolute", "axis": [1, 0, 0]}
    guide = {"type": "prismatic", "axis": [0, 1, 0]}
    bodies = [
        ("crank", turning),
        ("rod", turning | {"parent": "crank", "offset_m": [0, 0, crank]}),
        ("slider", guide | {"offset_m": [0, math.sqrt(rod**2 - crank**2), 0]}),
    ]
    return {
        "name": "slider_crank",
        "gravity_m_per_s2": 0.0,
        "skeleton": {
            "bodies": [
                {"name": name, "mass_kg": 2.0, "inertia_kg_m2": [0.02] * 3, "joint": joint}
                for name, joint in bodies
            ],
            "loops": [{"between": ["slider", "rod"], "at": [0, 0, 0], "type": "ball"}],
        },
        "struts": [
            {
                "name": "strut",
                "between": ["world", "slider"],
                "free_length_m": 0.3,
                "stiffness_n_per_m": 0.0,
                "damping_n_s_per_m": 0.0,
            }
        ],
    }


def test_a_crank_turns_through_its_dead_centres():
    """Whole turns: the loop stays closed, and the kinetic energy is what it was."""
    plant = plant_of(slider_crank())
    rate = 12.0
    free = [0.0] * plant.free_coordinates
    [index] = plant.free.tolist()
    assert index in (0, 2)
    state = plant.init([math.sqrt(0.08)])
    # The crank stands upright: the slider moves as fast as the pin, and the rod does not turn.
    velocities = [-rate, rate, rate * 0.1]
    state = plant.state(state.positions, velocities, (), 0.0)
    assert len(free) == 1

    def energy(state):
        turn, slide = math.sin(state.positions[0]), state.positions[2]
        y = -0.1 * turn
        assert y + 0.3 * math.cos(rod_angle(state)) == pytest.approx(
            math.sqrt(0.08) + slide, abs=1e-9
        )
        crank, rod, slider = state.velocities
        pin = (0.1 * crank) ** 2
        return 0.5 * (0.02 * crank**2 + 2.0 * pin + 0.02 * (crank + rod) ** 2 + 2.0 * slider**2)

    def rod_angle(state):
        return state.positions[0] + state.positions[1] - math.asin(1.0 / 3.0)

    begin, turned = energy(state), 0.0
    for _ in range(2000):
        state = plant.step(plant.load(state, (0.0,), (0.0,), 23.0), TICK_S, (0.0,))
        assert energy(state) == pytest.approx(begin, rel=1e-6)
        turned = state.positions[0]
    assert abs(turned) > 4.0 * math.pi


def redundant():
    content = changed()
    content["skeleton"]["loops"] *= 2
    return content


def locked():
    """The upright's lower joint is the world's, too: nothing is left that moves."""
    content = changed()
    loop = {"between": ["world", "upright"], "at": [0, 0.4, 0], "type": "ball"}
    content["skeleton"]["loops"].append(loop)
    return content


def folded():
    """A parallelogram whose bars lie in one line: only there, it may unfold in two ways."""
    joint = {"type": "revolute", "axis": [1, 0, 0]}
    content = slider_crank()
    rod, slider = content["skeleton"]["bodies"][1:]
    rod["joint"] = joint | {"parent": "crank", "offset_m": [0, 0.2, 0]}
    slider["joint"] = joint | {"offset_m": [0, 0.3, 0]}
    content["skeleton"]["loops"][0]["at"] = [0, 0.2, 0]
    content["struts"][0] |= {"attachments_m": [[0, 0, 0.4], [0, 0.2, 0]]}
    return content


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (redundant(), "loops.1: redundant: the other joints hold upper and upright like this"),
        (locked(), "nothing is left that moves"),
        (folded(), "the place where all coordinates are zero is singular"),
        (changed(between=["upper", "hub"]), "loops.0: between 'hub': expected one of"),
        (changed(between=["upper", "upper"]), "expected two different bodies"),
        (changed(axis=[1, 0, 0]), "axis of a ball joint: expected none"),
        (changed(type="revolute"), "axis of a revolute joint: expected one, a direction"),
        (changed(at=[0, 0.3]), "loops.0.at"),
        (changed(type="weld"), "loops.0.type: 'weld': expected one of ball, revolute"),
    ],
)
def test_a_wrong_loop_is_refused(content, message):
    with pytest.raises(InputError) as refused:
        plant_of(content)
    assert message in str(refused.value)


def test_a_height_out_of_reach_is_refused():
    with pytest.raises(ModelError, match=r"corner: (skeleton.loops: cannot be closed|heights)"):
        plant_of(changed()).init([1.5])


def test_a_model_with_loops_is_written_and_read_back():
    spec = parse_model(json.dumps(changed()), "a test")
    assert parse_model(dump_model(spec), "again") == spec


def second_slope(function, mechanism, angle, rate, turn):
    """Second derivative by the time of a function of the angle."""
    curved = mechanism.slope(lambda at: mechanism.slope(function, at), angle)
    return mechanism.slope(function, angle) * turn + curved * rate * rate


def test_a_pivot_carries_what_its_arm_and_the_joint_of_the_loop_need():
    """Newton and Euler of each body, in the plane, from the motion in the minimal coordinate."""
    mechanism, angle, rate, applied_n = double_wishbone(), 0.2, 1.5, 900.0
    turn = mechanism.acceleration(angle, rate, applied_n)
    moving = second_slope(mechanism.places, mechanism, angle, rate, turn)
    (_, low, pivot), (arm, upright, upper) = mechanism.places(angle)[:, :2], mechanism.bodies
    y, z, tilt = mechanism.places(angle)[1]
    start = np.array(changed()["skeleton"]["loops"][0]["at"][1:]) + PIVOT - [LOWER, 0.0]
    turned = np.array([[math.cos(tilt), -math.sin(tilt)], [math.sin(tilt), math.cos(tilt)]])
    high = [y, z] + turned @ start
    # The upper ball joint turns the upright about its centre of mass and the arm about its pivot.
    rows = [[-(high - low)[1], (high - low)[0]], [(high - pivot)[1], -(high - pivot)[0]]]
    moments = upright.moment_kg_m2 * moving[1, 2], upper.moment_kg_m2 * moving[2, 2]
    above = np.linalg.solve(rows, moments)
    weight = np.array([0.0, -GRAVITY])
    below = upright.mass_kg * (moving[1, :2] - weight) - [0.0, applied_n] - above
    strut = mechanism.content["struts"][0]
    end = np.array(strut["attachments_m"][0][1]) * np.array([math.cos(angle), math.sin(angle)])
    gap = np.array(strut["attachments_m"][1][1:]) - end
    plant = plant_of(mechanism.content)
    velocity = mechanism.slope(mechanism.strut_m, angle) * rate
    loaded = plant.load(
        plant.init([mechanism.strut_m(angle)], [velocity]), (0.0,), (applied_n,), 23.0
    )
    push = -loaded.forces_n[0] * gap / np.hypot(*gap)
    needed = below - push - arm.mass_kg * weight
    sensors = {
        "y": VirtualSensor(reaction_of="lower_joint", axis=(0, 1, 0)),
        "z": VirtualSensor(reaction_of="lower_joint"),
        "upper_y": VirtualSensor(reaction_of="upper_joint", axis=(0, 1, 0)),
        "upper_z": VirtualSensor(reaction_of="upper_joint"),
        "free": VirtualSensor(torque_of="lower_joint", axis=(1, 0, 0)),
        "upper_free": VirtualSensor(torque_of="upper_joint", axis=(1, 0, 0)),
    }
    shown = plant.virtual_sensors(sensors).read(loaded, (0.0,))
    expected = [*needed, *(above - upper.mass_kg * weight), 0.0, 0.0]
    assert shown == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_a_closed_chain_has_the_gains_of_its_minimal_coordinate():
    """Derivatives of an upright's place by the strut, of a mechanism with one coordinate."""
    mechanism = double_wishbone()
    plant = plant_of(mechanism.content)
    sensors = {
        "up": VirtualSensor(position_of="upright"),
        "arm": VirtualSensor(coordinate_of="lower_joint"),
    }
    reader = plant.virtual_sensors(sensors)
    for angle in (-0.1, 0.05):
        heights = [mechanism.strut_m(angle + change) for change in (0.0, -1e-5, 1e-5)]
        here, low, high = (
            plant.load(plant.init([m]), (0.0,), (0.0,) * plant.inputs, 20.0) for m in heights
        )
        change = np.array(reader.read(high, (0.0,))) - np.array(reader.read(low, (0.0,)))
        gains = reader.motion_gains(here, (0,)).by_heights[:, 0]
        assert gains == pytest.approx(change / (heights[2] - heights[1]), rel=1e-5)


# --- files ----------------------------------------------------------------------------------------

_LINK = """<link name="{name}"><pose>0 {y} {z} 0 0 0</pose><inertial><mass>{mass}</mass><inertia>
<ixx>{moment}</ixx><iyy>{moment}</iyy><izz>{moment}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
</inertia></inertial></link>"""
_JOINT = """<joint name="{child}_of_{parent}" type="{kind}"><parent>{parent}</parent>
<child>{child}</child>{pose}<axis><xyz>{axis}</xyz></axis></joint>"""


def sdf(kind="ball", pose="<pose>{} {} {} 0 0 0</pose>", axis="1 0 0"):
    """The double wishbone in SDF, whose upright is the child of both arms."""
    places = [(0.0, 0.0), (LOWER, 0.0), PIVOT]
    links = [
        _LINK.format(name=body.name, y=y, z=z, mass=body.mass_kg, moment=body.moment_kg_m2)
        for body, (y, z) in zip(double_wishbone().bodies, places, strict=True)
    ]
    _, y, z = reversed_loop()["skeleton"]["loops"][0]["at"]
    joints = [("world", "lower"), ("lower", "upright"), ("world", "upper")]
    revolute = [
        _JOINT.format(parent=parent, child=child, kind="revolute", axis="1 0 0", pose="")
        for parent, child in joints
    ]
    closing = _JOINT.format(
        parent="upper", child="upright", kind=kind, axis=axis, pose=pose.format(0, y, z)
    )
    inside = "\n".join([*links, *revolute, closing])
    return f'<sdf version="1.6"><model name="corner">{inside}</model></sdf>'


def mjcf(equality=None):
    """The double wishbone in MJCF, whose arms are bodies of the world."""
    hinge = '<joint type="hinge" axis="1 0 0"/>'
    bodies = [
        f'{hinge}<geom type="sphere" size="0.1" mass="{body.mass_kg}"/>'
        for body in double_wishbone().bodies
    ]
    _, y, z = changed()["skeleton"]["loops"][0]["at"]
    if equality is None:
        equality = f'<connect body1="upper" body2="upright" anchor="0 {y} {z}"/>'
    return f"""<mujoco><compiler angle="radian"/><worldbody>
    <body name="lower">{bodies[0]}<body name="upright" pos="0 {LOWER} 0">{bodies[1]}</body></body>
    <body name="upper" pos="0 {PIVOT[0]} {PIVOT[1]}">{bodies[2]}</body>
    </worldbody><equality>{equality}</equality></mujoco>"""


def plant_of_file(folder, name, text):
    (folder / name).write_text(text)
    content = changed() | {"skeleton": {"file": name}}
    return DartPlant(parse_model(json.dumps(content), "a test", folder))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("corner.sdf", sdf()),
        ("corner.sdf", sdf("revolute")),
        ("corner.sdf", sdf("revolute", "<pose>{} {} {} 0 0 1.5707963267948966</pose>", "0 -1 0")),
        ("corner.xml", mjcf()),
    ],
)
def test_a_file_closes_its_own_loops(tmp_path, name, text):
    plant, inline = plant_of_file(tmp_path, name, text), plant_of(changed())
    for angle in (-0.2, 0.0, 0.25):
        heights = [double_wishbone().strut_m(angle)]
        here, there = plant.init(heights), inline.init(heights)
        assert sorted(here.positions) == pytest.approx(sorted(there.positions), abs=1e-9)
        if name.endswith("sdf"):
            loads = [
                it.load(state, (0.0,), (700.0,), 23.0).accelerations_m_per_s2
                for it, state in ((plant, here), (inline, there))
            ]
            assert loads[0] == pytest.approx(loads[1], rel=1e-8)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.sdf", sdf("prismatic"), "joint 'upright_of_upper': type 'prismatic': closes a loop"),
        ("a.sdf", sdf(pose='<pose relative_to="upper">{} {} {} 0 0 0</pose>'), "pose relative_to"),
        ("a.xml", mjcf('<weld body1="upper" body2="upright"/>'), "equality weld: is not supported"),
        ("a.xml", mjcf('<connect body1="upper"/>'), "expected body1 and anchor"),
        ("a.xml", mjcf('<connect body1="upper" body2="hub" anchor="0 0 0"/>'), "between 'hub'"),
        (
            "a.xml",
            mjcf('<connect body1="upper" anchor="0 0"/>'),
            "connect anchor: '0 0': expected 3",
        ),
    ],
)
def test_a_loop_of_a_file_that_is_not_supported_is_refused(tmp_path, name, text, message):
    with pytest.raises(InputError) as refused:
        plant_of_file(tmp_path, name, text)
    assert message in str(refused.value)


def test_the_model_of_the_guide_is_one_with_a_single_free_coordinate():
    page = Path(rig.__file__).parent / "guide/pages/how-to/closed-loops.md"
    block = page.read_text("utf-8").split("name: corner", 1)[1].split("\n\n", 1)[0]
    plant = DartPlant(parse_model(f"    name: corner{block}", str(page)))
    assert plant.free_coordinates == 1
    assert plant.init([0.56]).struts[0][0] == pytest.approx(0.56)
