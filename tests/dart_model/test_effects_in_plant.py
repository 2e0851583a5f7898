"""Every law of the catalogue acts in the plant as it says: force, memory and mass."""

import itertools
import math

import numpy as np
import pytest

from can_dbc.errors import InputError
from dart_model.effects import CATALOGUE, Effect
from dart_model.effects.calling import force_over_arrays
from dart_model.plant import LONGEST_STEP_S, DartPlant, PlantState, equations_of_motion
from dart_model.plant.equations_of_motion import count_steps
from dart_model.plant.strut import SlopeTable
from dart_model.spec import MODELS, EffectSpec, ModelSpec, load_model, parse_model

AMBIENT_C = 20.0
SEED = load_model(MODELS / "reference.yaml")
STRUT = (0.5, 500.0, 100.0, 9.81)


def usual(law: Effect) -> dict[str, float]:
    """Parameters in the middle of their ranges, in size rather than in distance."""
    if law.name == "restoring_surface":
        return {item.name: 0.1 * (index + 1) for index, item in enumerate(law.parameters)}
    found: dict[str, float] = {}
    for item in law.parameters:
        low, high = max(item.low, 1e-3 if item.high > 0.0 else item.low), item.high
        found[item.name] = math.sqrt(low * min(high, 100.0)) if low > 0.0 else 0.5 * (low + high)
    return found


def with_effect(name: str, spec: ModelSpec = SEED, **parameters: float) -> DartPlant:
    effect = EffectSpec(name=name, parameters=parameters or usual(CATALOGUE[name]))
    return DartPlant(spec.with_effects(spec.struts[0].name, [effect]))


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_law_s_force_is_in_the_strut(name):
    law = CATALOGUE[name]
    parameters = usual(law)
    plant = with_effect(name)
    state = plant.init([0.43], [0.2])
    memory = tuple(0.01 * (k + 1) for k in range(law.state_size))
    state = plant.state(state.positions, state.velocities, memory, 1.5)
    ((height_m, velocity),) = state.struts
    values = [parameters[item.name] for item in law.parameters]
    force = force_over_arrays(law)
    expected = force(1.5, height_m, velocity, 30.0, AMBIENT_C, memory, values, STRUT)
    (force_n,) = plant.load(state, (0.0,), (30.0,), AMBIENT_C).forces_n
    linear = -500.0 * (height_m - 0.5) - 100.0 * velocity
    assert force_n == pytest.approx(linear + expected, rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_step_with_a_law_is_finite_and_repeatable(name):
    plant = with_effect(name)
    state = plant.init([0.45], [0.1])
    loaded = plant.load(state, (2.0,), (10.0,), AMBIENT_C)
    after = plant.step(loaded, 1e-3, (12.0,))
    assert all(math.isfinite(value) for value in (*after.positions, *after.velocities))
    assert len(after.internal) == CATALOGUE[name].state_size
    plant.step(plant.load(plant.init([0.2]), (-50.0,), (-90.0,), 60.0), 1e-3, (0.0,))
    assert plant.step(plant.load(state, (2.0,), (10.0,), AMBIENT_C), 1e-3, (12.0,)) == after


def test_no_effect_changes_nothing():
    plain, none = DartPlant(SEED), with_effect("none")
    state = plain.init([0.4])
    a = plain.step(plain.load(state, (3.0,), (10.0,), AMBIENT_C), 1e-3, (12.0,))
    b = none.step(none.load(state, (3.0,), (10.0,), AMBIENT_C), 1e-3, (12.0,))
    assert a.positions == pytest.approx(b.positions, abs=1e-15)


def accelerations(plant: DartPlant, heights: tuple[float, ...], applied_n: float) -> list[float]:
    without = (0.0,) * len(heights)
    loaded = plant.load(plant.init(heights), without, (applied_n,), AMBIENT_C)
    return loaded.accelerations_m_per_s2


def test_an_added_mass_has_inertia_and_weight():
    plant = with_effect("added_mass", mass_kg=2.5)
    (acceleration,) = accelerations(plant, (0.4,), 70.0)
    assert acceleration == pytest.approx((500.0 * 0.1 + 70.0) / 12.5 - 9.81)


def test_an_inerter_has_inertia_and_no_weight():
    plant = with_effect("inerter", inertance_kg=2.5)
    (acceleration,) = accelerations(plant, (0.4,), 70.0)
    assert acceleration == pytest.approx((500.0 * 0.1 + 70.0 - 10.0 * 9.81) / 12.5)


def test_a_law_in_one_strut_of_two_is_felt_by_both_bodies():
    spec = load_model(MODELS / "quarter_car.yaml")
    effect = EffectSpec(name="preload", parameters={"force_n": 30.0})
    plain = accelerations(DartPlant(spec), (0.29, 0.4), 0.0)
    loaded = accelerations(DartPlant(spec.with_effects("suspension", [effect])), (0.29, 0.4), 0.0)
    assert loaded[0] - plain[0] == pytest.approx(-30.0 / 3.0)
    assert loaded[1] - plain[1] == pytest.approx(30.0 / 3.0 + 30.0 / 15.0)


def test_memory_relaxes_as_the_maxwell_branch_does():
    """A branch that is stretched and then held lets go with its relaxation time."""
    text = (MODELS / "reference.yaml").read_text("utf-8")
    # So heavy that it does not move: what is left is the branch.
    text = text.replace("mass_kg: 10.0", "mass_kg: 1.0e+12").replace("9.81", "0.0")
    heavy = parse_model(text, "heavy.yaml")
    parameters = {"stiffness_n_per_m": 1000.0, "relaxation_time_s": 0.05}
    plant = with_effect("maxwell", heavy, **parameters)

    def branch_n(state: PlantState) -> float:
        ((height_m, velocity_m_per_s),) = state.struts
        (force_n,) = plant.load(state, (0.0,), (0.0,), AMBIENT_C).forces_n
        return force_n + 500.0 * (height_m - 0.5) + 100.0 * velocity_m_per_s

    state = plant.init([0.5], [0.3])
    for _ in range(100):
        state = plant.step(plant.load(state, (0.0,), (0.0,), AMBIENT_C), 1e-3, (0.0,))
    start_n = branch_n(state)
    assert start_n == pytest.approx(-1000.0 * 0.05 * 0.3 * (1.0 - math.exp(-0.1 / 0.05)), rel=1e-3)
    still = plant.state(state.positions, (0.0,), state.internal, state.t_s)
    for _ in range(50):
        still = plant.step(plant.load(still, (0.0,), (0.0,), AMBIENT_C), 1e-3, (0.0,))
    assert branch_n(still) == pytest.approx(start_n * math.exp(-1.0), rel=1e-4)


def test_a_stiff_law_shortens_the_step():
    assert DartPlant(SEED).step_s == LONGEST_STEP_S
    stiff = with_effect("linear_stiffness", stiffness_n_per_m=1e8)
    assert stiff.step_s < 0.6e-3
    state = stiff.init([0.5])
    for _ in range(200):
        state = stiff.step(stiff.load(state, (0.0,), (0.0,), AMBIENT_C), 1e-3, (0.0,))
    # It swings about its rest position a micrometre below, and does not run away.
    assert state.positions[0] == pytest.approx(0.5, abs=3e-6)


def heights_and_steps(monkeypatch, plant, applied_n):
    """Heights under an applied force, shape (ticks,), and the steps that each tick took."""
    steps = []

    def count(dt_s, longest_s):
        steps.append(count_steps(dt_s, longest_s))
        return steps[-1]

    monkeypatch.setattr(equations_of_motion, "count_steps", count)
    state, heights_m = plant.init([0.4]), []
    for begin_n, end_n in itertools.pairwise(applied_n.tolist()):
        state = plant.step(plant.load(state, (0.0,), (begin_n,), AMBIENT_C), 1e-3, (end_n,))
        heights_m.append(state.struts[0][0])
    return np.array(heights_m), np.array(steps)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("coulomb_friction", {"coulomb_force_n": 20.0, "rounding_velocity_m_per_s": 2e-4}),
        ("power_damping", {"force_at_1_m_per_s_n": 60.0, "exponent": 0.3}),
        (
            "bump_stop",
            {"contact_height_m": 0.45, "stiffness_n_per_m": 2e8, "damping_n_s_per_m": 0.0},
        ),
    ],
)
def test_steps_are_short_where_a_force_is_steep_alone(monkeypatch, name, parameters):
    plant = with_effect(name, **parameters)
    t_s = np.arange(2000) * 1e-3
    applied_n = 60.0 * np.sin(2.0 * np.pi * 1.5 * t_s) + 90.0
    found_m, steps = heights_and_steps(monkeypatch, plant, applied_n)
    assert steps.min() == 1
    assert steps.max() > 2
    assert steps.mean() < 0.5 * steps.max()
    everywhere = with_effect(name, **parameters)
    everywhere._smooth_step_s = everywhere.step_s  # as short as the steepest force asks for
    exact_m, _ = heights_and_steps(monkeypatch, everywhere, applied_n)
    assert np.sqrt(np.mean((found_m - exact_m) ** 2)) < 1e-4 * np.ptp(exact_m)


def test_the_steepest_slope_within_a_range():
    table = SlopeTable([0.0, 1.0, 2.0, 3.0], [5.0, 1.0, 7.0])
    assert table.largest == 7.0
    assert table.largest_within(1.2, 1.4) == table.largest_within(1.0, 2.0) == 1.0
    assert table.largest_within(0.5, 1.5) == 5.0
    assert table.largest_within(1.5, 2.1) == 7.0
    assert table.largest_within(-4.0, -3.0) == table.largest_within(0.2, 0.2) == 5.0
    assert table.largest_within(3.0, 9.0) == 7.0


def test_a_force_that_no_bench_reaches_does_not_shorten_the_step():
    # Half a metre from its free length this spring would give 1e24 N, and 1 µs was too long.
    rubber = with_effect("exponential_stiffness", force_n=50.0, length_m=0.01)
    assert rubber.step_s > 5e-5
    state = rubber.init([0.5], [-3.0])  # thrown against it: 45 J
    lowest_m = 0.5
    for _ in range(1000):
        state = rubber.step(rubber.load(state, (0.0,), (0.0,), AMBIENT_C), 1e-3, (0.0,))
        lowest_m = min(lowest_m, state.positions[0])
        assert math.isfinite(state.positions[0])
    assert 0.4 < lowest_m < 0.47
    assert abs(state.velocities[0]) < 3.0


def test_parameters_that_give_no_force_are_refused():
    names = [item.name for item in CATALOGUE["restoring_surface"].parameters]
    with pytest.raises(InputError, match="strut strut: effects restoring_surface: no force with"):
        with_effect("restoring_surface", **dict.fromkeys(names, 1.0))


def test_a_negative_mass_that_leaves_nothing_is_refused():
    with pytest.raises(ValueError, match=r"effect added_mass leaves body a mass of -1\.0 kg"):
        with_effect("added_mass", mass_kg=-11.0)
