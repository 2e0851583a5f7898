"""The plant against closed forms, conservation laws and the theory of its integrator."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from can_dbc.errors import InputError
from dart_model.plant import DartPlant, PlantState
from dart_model.spec import MODELS, ModelSpec, load_model, parse_model

GRAVITY = 9.81
AMBIENT_C = 20.0
HEIGHT_RESOLUTION_M = 2e-6

ONE_BODY = """
name: oscillator
gravity_m_per_s2: {gravity}
skeleton:
  bodies:
    - {{name: body, mass_kg: {mass}, joint: {{type: prismatic, parent: world}}}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: 0.5
    stiffness_n_per_m: {stiffness}
    damping_n_s_per_m: {damping}
"""

TWO_FREE_BODIES = """
name: dumbbell
gravity_m_per_s2: 0
skeleton:
  bodies:
    - {name: left, mass_kg: 2.0, joint: {type: free, parent: world}}
    - {name: right, mass_kg: 5.0, joint: {type: free, parent: world}}
struts:
  - name: strut
    between: [left, right]
    free_length_m: 0.4
    stiffness_n_per_m: 300.0
    damping_n_s_per_m: DAMPING
    attachments_m: [[0.1, 0.02, 0.0], [0.0, -0.03, 0.05]]
"""

PENDULUM = """
name: pendulum
skeleton:
  bodies:
    - name: arm
      mass_kg: 1.5
      inertia_kg_m2: [0.2, 0.3, 0.1]
      joint: {type: JOINT, AXIS parent: world}
struts:
  - name: strut
    between: [world, arm]
    free_length_m: 0.5
    stiffness_n_per_m: 80.0
    damping_n_s_per_m: 1.5
    attachments_m: [[0.3, 0.0, -0.9], [0.1, 0.2, -0.6]]
"""


def one_body(
    mass: float = 10.0, stiffness: float = 500.0, damping: float = 100.0, gravity: float = GRAVITY
) -> ModelSpec:
    text = ONE_BODY.format(mass=mass, stiffness=stiffness, damping=damping, gravity=gravity)
    return parse_model(text, "oscillator.yaml")


def simulated(
    plant: DartPlant,
    state: PlantState,
    duration_s: float,
    steps: int,
    applied: Callable[[float], float] = lambda _t: 0.0,
) -> PlantState:
    """The state after `duration_s`, in equal steps."""
    h = duration_s / steps
    without = (0.0,) * len(plant.spec.struts)
    for index in range(steps):
        loaded = plant.load(state, without, (applied(index * h),), AMBIENT_C)
        state = plant.step(loaded, h, (applied((index + 1) * h),))
    return state


def momentum(state: PlantState, masses: list[float]) -> np.ndarray:
    """Linear momentum of free bodies that do not rotate at the start."""
    velocities = np.array(state.velocities).reshape(-1, 6)[:, 3:]
    return np.array(masses) @ velocities


@settings(max_examples=25, deadline=None)
@given(
    mass=st.floats(0.5, 100.0),
    frequency_hz=st.floats(0.2, 5.0),
    ratio=st.floats(0.01, 0.9),
    start_m=st.floats(-0.3, 0.3),
)
def test_free_oscillation_follows_the_closed_form(mass, frequency_hz, ratio, start_m):
    natural = 2.0 * math.pi * frequency_hz
    plant = DartPlant(one_body(mass, mass * natural**2, 2.0 * ratio * natural * mass))
    rest_m = 0.5 - GRAVITY / natural**2
    duration_s = 0.4
    state = simulated(plant, plant.init([rest_m + start_m]), duration_s, 400)
    damped = natural * math.sqrt(1.0 - ratio**2)
    phase = damped * duration_s
    decay = math.exp(-ratio * natural * duration_s)
    expected = start_m * decay * (math.cos(phase) + ratio * natural / damped * math.sin(phase))
    ((height_m, _),) = state.struts
    assert height_m - rest_m == pytest.approx(expected, abs=2e-6)


def test_forced_oscillation_has_the_amplitude_of_the_transfer_function():
    mass, stiffness, damping, omega = 10.0, 500.0, 100.0, 10.0
    plant = DartPlant(one_body(mass, stiffness, damping))
    response = 100.0 / complex(stiffness - mass * omega**2, damping * omega)
    state = plant.init([0.5 - mass * GRAVITY / stiffness])
    # The transient has decayed by exp(-25) after 5 s.
    for duration_s in (5.0, 5.3):
        after = simulated(
            plant,
            state,
            duration_s,
            round(duration_s * 1000),
            lambda t: 100.0 * math.sin(omega * t),
        )
        expected = (response * np.exp(1j * omega * duration_s)).imag
        ((height_m, _),) = after.struts
        assert height_m - 0.5 + mass * GRAVITY / stiffness == pytest.approx(expected, abs=1e-6)


def observed_order(plant: DartPlant, state: PlantState, applied: Callable[[float], float]) -> float:
    """Order of convergence from errors against a much finer solution."""
    duration_s = 0.5
    fine = simulated(plant, state, duration_s, 1600, applied)
    reference = np.array([*fine.positions, *fine.velocities])
    errors: list[float] = []
    for steps in (50, 100):
        after = simulated(plant, state, duration_s, steps, applied)
        errors.append(
            float(np.linalg.norm(np.array([*after.positions, *after.velocities]) - reference))
        )
    return math.log2(errors[0] / errors[1])


def whole_steps(plant: DartPlant) -> DartPlant:
    """A plant that never divides a step, so that its own order is seen."""
    plant.step_s = 1.0
    return plant


def test_order_of_convergence_is_three_on_a_guide():
    plant = whole_steps(DartPlant(load_model(MODELS / "quarter_car.yaml")))
    start = plant.init([0.299, 0.42])
    # Linear in time, so that the linear input between two steps is exact.
    order = observed_order(plant, start, lambda t: 50.0 * t)
    assert order == pytest.approx(3.0, abs=0.25)


def test_a_sampled_input_costs_no_more_than_the_second_order_of_its_interpolation():
    plant = whole_steps(DartPlant(one_body()))
    order = observed_order(plant, plant.init([0.4]), lambda t: 100.0 * math.sin(10.0 * t))
    assert order >= 1.9


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["revolute", "ball", "free"])
def test_order_of_convergence_is_two_or_more_where_bodies_turn(joint):
    axis = "axis: [0.2, 1.0, 0.1]," if joint == "revolute" else ""
    spec = parse_model(PENDULUM.replace("JOINT", joint).replace("AXIS", axis), "pendulum.yaml")
    plant = whole_steps(DartPlant(spec))
    count = plant.coordinates
    state = plant.state(
        tuple(0.3 * math.sin(k + 1.0) for k in range(count)),
        tuple(0.8 * math.cos(2.0 * k) for k in range(count)),
        (),
        0.0,
    )
    assert observed_order(plant, state, lambda _t: 0.0) >= 1.9


def test_default_step_stays_below_a_tenth_of_the_height_resolution_on_the_seed_case():
    plant = DartPlant(load_model(MODELS / "reference.yaml"))

    def applied(t_s: float) -> float:
        return 100.0 * math.sin(10.0 * t_s)

    def heights(step_s: float) -> np.ndarray:
        state, found = plant.init([0.5]), []
        substeps = round(1e-3 / step_s)
        for tick in range(1000):
            for part in range(substeps):
                t_s = tick * 1e-3 + part * step_s
                # Both runs see the input as it is sampled at 1 kHz.
                low, high = applied(tick * 1e-3), applied((tick + 1) * 1e-3)
                rise = (high - low) / substeps
                loaded = plant.load(state, (0.0,), (low + part * rise,), AMBIENT_C)
                state = plant.step(loaded, step_s, (low + (part + 1) * rise,))
                assert state.t_s == pytest.approx(t_s + step_s)
            found.append(state.positions[0])
        return np.array(found)

    error_m = np.max(np.abs(heights(1e-3) - heights(1e-3 / 8)))
    assert error_m < HEIGHT_RESOLUTION_M / 10


@pytest.mark.parametrize("joint", ["prismatic", "free"])
def test_nothing_is_remembered_between_calls(joint):
    spec = one_body() if joint == "prismatic" else free_bodies()
    plant = DartPlant(spec)
    count = plant.coordinates
    state = plant.state((0.31,) * count, (0.7,) * count, (), 0.2)
    other = plant.state((-0.9,) * count, (-3.0,) * count, (), 7.0)
    virtual = (12.0,) * len(spec.struts)

    def answer() -> tuple[object, ...]:
        loaded = plant.load(state, virtual, (5.0,), AMBIENT_C)
        after = plant.step(loaded, 1e-3, (6.0,))
        return after, loaded.forces_n, loaded.accelerations_m_per_s2

    first = answer()
    plant.step(plant.load(other, virtual, (-40.0,), 80.0), 3e-3, (9.0,))
    plant.mechanics(np.full(count, 0.4), np.full(count, -2.0))
    assert answer() == first


def free_bodies(damping: float = 8.0) -> ModelSpec:
    return parse_model(TWO_FREE_BODIES.replace("DAMPING", str(damping)), "dumbbell.yaml")


def test_internal_forces_keep_the_momentum_of_free_bodies():
    plant = DartPlant(free_bodies())
    state = plant.state(
        (0.0,) * 9 + (0.3, 0.2, 0.5), (0.0,) * 3 + (0.4, -0.1, 0.2) + (0.0,) * 6, (), 0.0
    )
    # Spatial velocities are in the body's own frame; all start unrotated.
    before = momentum(state, [2.0, 5.0])
    world = plant._skeleton.dart
    for _ in range(300):
        loaded = plant.load(state, (35.0,), (0.0,), AMBIENT_C)
        state = plant.step(loaded, 1e-3, (0.0,))
    world.setPositions(np.array(state.positions))
    world.setVelocities(np.array(state.velocities))
    after = sum(
        body.getMass() * np.array(body.getCOMLinearVelocity()) for body in world.getBodyNodes()
    )
    assert after == pytest.approx(before, abs=1e-7)
    left = world.getBodyNode("left").getCOMLinearVelocity()
    assert np.linalg.norm(np.array(left) - [0.4, -0.1, 0.2]) > 0.1


def test_an_undamped_strut_keeps_the_energy():
    plant = DartPlant(free_bodies(damping=0.0))
    skeleton = plant._skeleton.dart

    def energy(state: PlantState) -> float:
        skeleton.setPositions(np.array(state.positions))
        skeleton.setVelocities(np.array(state.velocities))
        ((height_m, _),) = state.struts
        skeleton.setPositions(np.array(state.positions))
        kinetic = float(skeleton.computeKineticEnergy())
        return kinetic + 0.5 * 300.0 * (height_m - 0.4) ** 2

    state = plant.state((0.0,) * 9 + (0.3, 0.2, 0.5), (0.2,) * 12, (), 0.0)
    before = energy(state)
    gains = [energy(simulated(plant, state, 1.0, steps)) - before for steps in (1000, 2000)]
    assert abs(gains[0]) < 1e-5 * before
    assert abs(gains[1]) < abs(gains[0]) / 3.5


def test_struts_take_away_no_degree_of_freedom():
    """Two free bodies keep twelve coordinates, and a force across the strut turns them freely."""
    plant = DartPlant(free_bodies())
    assert plant.coordinates == 12
    positions = (0.0,) * 9 + (0.3, 0.2, 0.5)
    state = plant.state(positions, (0.0,) * 12, (), 0.0)
    accelerations = plant.load(state, (50.0,), (0.0,), AMBIENT_C).acceleration
    assert np.count_nonzero(np.abs(accelerations) > 1e-9) == 12


def test_the_virtual_force_and_the_applied_force_push_as_the_signs_say():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    state = plant.init([0.29, 0.4])

    def accelerations(virtual: tuple[float, float], applied_n: float) -> np.ndarray:
        loaded = plant.load(state, virtual, (applied_n,), AMBIENT_C)
        return np.array(loaded.accelerations_m_per_s2)

    free = accelerations((0.0, 0.0), 0.0)
    wheel, body = 3.0, 15.0
    # A force in the tyre lifts the wheel from the world; the body stays behind, above it.
    assert accelerations((30.0, 0.0), 0.0) - free == pytest.approx([30 / wheel, -30 / wheel])
    # A force in the suspension pushes the wheel down and the body up.
    apart = 30 / body + 30 / wheel
    assert accelerations((0.0, 30.0), 0.0) - free == pytest.approx([-30 / wheel, apart])
    assert accelerations((0.0, 0.0), 30.0) - free == pytest.approx([0.0, 30 / body])


@settings(max_examples=25, deadline=None)
@given(
    angle=st.floats(-2.5, 2.5),
    rate=st.floats(-4.0, 4.0),
    x=st.floats(0.2, 0.8),
    z=st.floats(-0.5, 0.5),
    arm=st.floats(0.3, 1.2),
)
def test_an_inclined_strut_follows_the_geometry_of_its_ends(angle, rate, x, z, arm):
    """Length, rate and second derivative of a strut on a lever that turns about y."""
    text = f"""
name: lever
skeleton:
  bodies:
    - name: arm
      mass_kg: 2.0
      inertia_kg_m2: [0.1, 0.4, 0.1]
      joint: {{type: revolute, axis: [0, 1, 0], parent: world}}
struts:
  - name: strut
    between: [world, arm]
    free_length_m: 0.5
    stiffness_n_per_m: 1000.0
    damping_n_s_per_m: 40.0
    attachments_m: [[{x}, 0, {z}], [0, 0, {arm}]]
"""
    plant = DartPlant(parse_model(text, "lever.yaml"))
    end = np.array([arm * math.sin(angle) - x, arm * math.cos(angle) - z])
    turned = np.array([arm * math.cos(angle), -arm * math.sin(angle)])
    length = float(np.linalg.norm(end))
    if length < 0.05:
        return
    gradient = float(end @ turned) / length
    state = plant.state((angle,), (rate,), (), 0.0)
    loaded = plant.load(state, (7.0,), (0.0,), AMBIENT_C)
    ((height_m, velocity_m_per_s),) = state.struts
    assert height_m == pytest.approx(length, abs=1e-12)
    assert velocity_m_per_s == pytest.approx(gradient * rate, abs=1e-11)
    force = -1000.0 * (length - 0.5) - 40.0 * gradient * rate
    assert loaded.forces_n[0] == pytest.approx(force, abs=1e-8)
    # The centre of mass is on the axis: only the strut turns the arm.
    angular = (force + 7.0) * gradient / 0.4
    assert loaded.acceleration[0] == pytest.approx(angular, abs=1e-7)
    centripetal = -np.array([end[0] + x, end[1] + z])
    curvature = (float(turned @ turned) + float(end @ centripetal) - gradient**2) / length
    expected = gradient * angular + curvature * rate**2
    assert loaded.accelerations_m_per_s2[0] == pytest.approx(expected, rel=1e-9, abs=1e-8)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_rate_of_a_strut_between_free_bodies_changes_as_its_acceleration_says(seed):
    """Published acceleration against the velocities of two short steps, forward and back."""
    rng = np.random.default_rng(seed)
    plant = DartPlant(free_bodies(damping=7.0))
    positions, velocities = 0.5 * rng.standard_normal(12), rng.standard_normal(12)
    state = plant.state(positions.tolist(), velocities.tolist(), (), 0.0)
    loaded = plant.load(state, (3.0,), (0.0,), AMBIENT_C)
    h = 1e-4
    rates = [plant.step(loaded, dt_s, (0.0,)).struts[0][1] for dt_s in (h, -h)]
    slope = (rates[0] - rates[1]) / (2.0 * h)
    scale = max(1.0, abs(slope))
    assert loaded.accelerations_m_per_s2[0] == pytest.approx(slope, abs=1e-4 * scale)


def test_struts_between_the_same_bodies_add_up():
    spec = one_body(stiffness=500.0, damping=100.0)
    (strut,) = spec.struts
    halves = tuple(
        strut.model_copy(
            update={
                "name": name,
                "stiffness_n_per_m": share * 500.0,
                "damping_n_s_per_m": share * 100.0,
            }
        )
        for name, share in (("first", 0.25), ("second", 0.75))
    )
    whole, split = DartPlant(spec), DartPlant(spec.model_copy(update={"struts": halves}))
    a = simulated(whole, whole.init([0.4]), 0.2, 200)
    b = simulated(split, split.init([0.4, 0.4]), 0.2, 200)
    assert a.positions == pytest.approx(b.positions, abs=1e-14)


def test_a_long_step_is_divided():
    plant = DartPlant(one_body())
    start = plant.init([0.45])
    loaded = plant.load(start, (20.0,), (10.0,), AMBIENT_C)
    after = plant.step(loaded, 0.02, (30.0,))
    state = start
    for index in range(20):
        at = plant.load(state, (20.0,), (10.0 + index,), AMBIENT_C)
        state = plant.step(at, 1e-3, (11.0 + index,))
    assert after.positions == pytest.approx(state.positions, abs=1e-15)
    assert after.t_s == pytest.approx(0.02)


def test_initial_reaches_heights_and_velocities():
    plant = DartPlant(load_model(MODELS / "quarter_car.yaml"))
    state = plant.init([0.29, 0.35], [0.1, -0.4])
    assert state.struts == [
        (pytest.approx(0.29), pytest.approx(0.1)),
        (pytest.approx(0.35), pytest.approx(-0.4)),
    ]


def test_what_no_height_gives_rests_under_its_weight():
    """The tyre that nobody measures carries wheel and body; the springless guide stays."""
    model = load_model(MODELS / "quarter_car.yaml")
    plant, nan = DartPlant(model), math.nan
    (tyre_m, _), (rise_m, _) = plant.init([nan, 0.31]).struts
    masses = sum(body.mass_kg for body in model.skeleton.bodies)
    tyre = model.struts[0]
    weight_n = masses * model.gravity_m_per_s2
    assert tyre_m == pytest.approx(tyre.free_length_m - weight_n / tyre.stiffness_n_per_m, abs=1e-9)
    assert rise_m == pytest.approx(0.31, abs=1e-12)
    slack = tyre.model_copy(update={"stiffness_n_per_m": 0.0})
    free = DartPlant(model.model_copy(update={"struts": (slack, model.struts[1])}))
    assert free.init([nan, 0.31]).struts[1][0] == pytest.approx(0.31, abs=1e-12)
    weak = tyre.model_copy(update={"stiffness_n_per_m": 5.0})  # it would rest 35 m down
    far = DartPlant(model.model_copy(update={"struts": (weak, model.struts[1])}))
    assert far.init([nan, 0.31]).struts == free.init([nan, 0.31]).struts


def test_initial_says_what_cannot_be_reached():
    spec = parse_model(
        PENDULUM.replace("JOINT", "revolute").replace("AXIS", "axis: [0, 1, 0],"), "pendulum.yaml"
    )
    with pytest.raises(InputError, match=r"model pendulum: heights \[9.0\] m: out of the joints"):
        DartPlant(spec).init([9.0])


def test_mechanics_are_the_equations_of_motion():
    spec = load_model(MODELS / "quarter_car.yaml")
    plant = DartPlant(spec)
    assert plant.is_constant
    rng = np.random.default_rng(3)
    for _ in range(5):
        heights, velocities = rng.uniform(0.2, 0.5, 2), rng.uniform(-1.0, 1.0, 2)
        virtual, applied_n = rng.uniform(-50.0, 50.0, 2), float(rng.uniform(-50.0, 50.0))
        state = plant.init(heights, velocities)
        there = plant.mechanics(np.array(state.positions), np.array(state.velocities))
        loaded = plant.load(state, virtual.tolist(), (applied_n,), AMBIENT_C)
        forces = np.array(loaded.forces_n) + virtual
        push = there.bias + there.struts.T @ forces + there.inputs @ [applied_n]
        expected = there.struts @ np.linalg.solve(there.mass, push)
        assert loaded.accelerations_m_per_s2 == pytest.approx(expected, abs=1e-10)
        assert there.heights_m == pytest.approx(heights)


def test_a_model_that_turns_is_not_constant():
    assert not DartPlant(free_bodies()).is_constant


def test_a_guide_need_not_be_vertical():
    text = ONE_BODY.format(mass=2.0, stiffness=100.0, damping=0.0, gravity=GRAVITY)
    text = text.replace("type: prismatic,", "type: prismatic, axis: [3, 0, 4],")
    plant = DartPlant(parse_model(text, "inclined.yaml"))
    loaded = plant.load(plant.init([0.5]), (0.0,), (10.0,), AMBIENT_C)
    # Weight and the applied force act along z, of which the guide takes 4/5.
    assert loaded.accelerations_m_per_s2[0] == pytest.approx(0.8 * (10.0 / 2.0 - GRAVITY))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("between: [world, body]", "between: [body, other]"), "between 'other': expected one of"),
        (
            ("name: oscillator", "name: oscillator\napplied_force_body: nobody"),
            "'nobody': did you mean body",
        ),
    ],
)
def test_a_name_that_is_nobody_s_is_refused(change, expected):
    text = ONE_BODY.format(mass=1.0, stiffness=1.0, damping=1.0, gravity=1.0)
    with pytest.raises(InputError, match=expected):
        parse_model(text.replace(*change), "oscillator.yaml")


def test_a_strut_that_no_joint_moves_is_refused():
    text = """
name: stiff
skeleton:
  bodies:
    - {name: a, mass_kg: 1.0, joint: {type: prismatic, parent: world}}
    - {name: b, mass_kg: 1.0, joint: {type: prismatic, parent: world}}
struts:
  - {name: s, between: [a, b], free_length_m: 0, stiffness_n_per_m: 1, damping_n_s_per_m: 1}
  - {name: t, between: [world, a], free_length_m: 0, stiffness_n_per_m: 1, damping_n_s_per_m: 1,
     attachments_m: [[0, 0, 0], [0, 0, 0]]}
"""
    DartPlant(parse_model(text, "stiff.yaml"))
    # Both ends on one axis of rotation: the joint turns and the ends stay where they are.
    turning = text.replace(
        "b, mass_kg: 1.0, joint: {type: prismatic,", "b, mass_kg: 1.0, joint: {type: revolute,"
    )
    turning = turning.replace("between: [a, b]", "between: [world, b]")
    with pytest.raises(InputError, match="strut s: no joint lets world and b move"):
        DartPlant(parse_model(turning, "stiff.yaml"))


def closed_form(
    mass: np.ndarray, damping: np.ndarray, stiffness: np.ndarray, start: np.ndarray, t_s: float
) -> np.ndarray:
    """Free response of a linear bench from rest."""
    n = len(mass)
    matrix = np.block(
        [
            [np.zeros((n, n)), np.eye(n)],
            [-np.linalg.solve(mass, stiffness), -np.linalg.solve(mass, damping)],
        ]
    )
    return (expm(matrix * t_s) @ np.concatenate([start, np.zeros(n)]))[:n]


CHAIN = """
name: chain
gravity_m_per_s2: 0
skeleton:
  bodies:
    - {name: a, mass_kg: %r, joint: {type: prismatic, parent: world}}
    - {name: b, mass_kg: %r, joint: {type: prismatic, parent: a}}
struts:
  - {name: s, between: [world, a], free_length_m: 0, stiffness_n_per_m: %r, damping_n_s_per_m: %r}
  - {name: t, between: [a, b], free_length_m: 0, stiffness_n_per_m: %r, damping_n_s_per_m: %r}
"""

MASS = st.floats(0.5, 200.0)
STIFFNESS = st.floats(2.0, 6.5).map(lambda power: 10.0**power)
RATIO = st.floats(0.02, 3.0)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(masses=st.tuples(MASS, MASS), stiffnesses=st.tuples(STIFFNESS, STIFFNESS), ratio=RATIO)
def test_a_linear_bench_is_right_to_a_thousandth_or_refused(masses, stiffnesses, ratio):
    """Two bodies on two struts, damped in proportion to stiffness and mass, let go from rest."""
    (m1, m2), (k1, k2) = masses, stiffnesses
    share = 2.0 * ratio / math.sqrt(k1 / (m1 + m2))
    spec = parse_model(CHAIN % (m1, m2, k1, share * k1, k2, share * k2), "chain.yaml")
    try:
        plant = DartPlant(spec)
    except InputError as error:
        assert "require steps of" in str(error)  # noqa: PT017 - either is right
        return
    mass = np.array([[m1 + m2, m2], [m2, m2]])
    stiffness = np.diag([k1, k2])
    start = np.array([0.01, -0.02])
    # A bench whose fast mode is a thousand times its slow one would take a minute.
    duration_s = min(6.0 * math.pi / math.sqrt(k1 / (m1 + m2)), 6_000 * plant.step_s)
    ticks = min(200, max(20, round(duration_s / 1e-3)))
    state = plant.init(start.tolist())
    for tick in range(1, ticks + 1):
        loaded = plant.load(state, (0.0, 0.0), (0.0,), AMBIENT_C)
        state = plant.step(loaded, duration_s / ticks, (0.0,))
        if tick % (ticks // 10) == 0:
            exact = closed_form(mass, share * stiffness, stiffness, start, state.t_s)
            assert np.abs(np.array(state.positions) - exact).max() < 1e-3 * 0.02


def test_a_strut_of_five_million_newtons_a_metre_on_half_a_kilogram_is_stable_and_right():
    """It reached 1e34 m in silence when steps were a millisecond for every bench."""
    mass, stiffness = 0.5, 5e6
    omega, ratio = math.sqrt(stiffness / mass), 0.01
    spec = one_body(mass, stiffness, 2.0 * ratio * mass * omega, gravity=0.0)
    plant = DartPlant(spec)
    assert plant.step_s == pytest.approx(0.1 / omega)
    state = plant.init([0.501])
    for _ in range(500):
        state = plant.step(plant.load(state, (0.0,), (0.0,), AMBIENT_C), 1e-3, (0.0,))
        damped = omega * math.sqrt(1.0 - ratio**2)
        decay = math.exp(-ratio * omega * state.t_s)
        phase = damped * state.t_s
        exact = 1e-3 * decay * (math.cos(phase) + ratio * omega / damped * math.sin(phase))
        ((height_m, _),) = state.struts
        assert abs(height_m - 0.5 - exact) < 2e-3 * 1e-3


def test_a_bench_that_is_too_stiff_is_refused_in_one_line():
    with pytest.raises(
        InputError, match=r"model oscillator: .* require steps of 1e-07 s"
    ) as caught:
        DartPlant(one_body(1.0, 1e12))
    assert "\n" not in str(caught.value)
