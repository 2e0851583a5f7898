"""Every law against its closed form, and what every entry of the catalogue must have."""

import math

import pytest

from dart_model.effects import CATALOGUE, UnknownEffectError, effect
from dart_model.effects.hysteresis import ELEMENTS
from dart_model.effects.restoring_surface import FIRST_FORCE, HEIGHTS, VELOCITIES

FAMILIES = {
    "preload", "stiffness", "damping", "inertia", "input_gain", "nonlinear_stiffness", "stop",
    "backlash", "friction", "nonlinear_damping", "hysteresis", "fade", "delay", "periodic_force",
    "unmodelled_mode", "restoring_surface",
}  # fmt: skip
STRUT = (0.5, 500.0, 100.0, 9.81)


def force(
    name, parameters, height=0.5, velocity=0.0, applied=0.0, t_s=0.0, temperature=20.0, state=()
):
    item = effect(name)
    memory = list(state) or [0.0] * item.state_size
    return item.force(t_s, height, velocity, applied, temperature, memory, parameters, STRUT)


def rate(name, parameters, velocity=0.0, applied=0.0, state=()):
    item = effect(name)
    out = [math.nan] * item.state_size
    memory = list(state) or [0.0] * item.state_size
    item.rate(0.0, 0.5, velocity, applied, 20.0, memory, parameters, STRUT, out)
    return out


TABLE = [0.4, 0.6, -1.0, 1.0] + [float(i) for i in range(HEIGHTS) for _ in range(VELOCITIES)]

CLOSED_FORMS = [
    ("none", [], {}, 0.0),
    ("preload", [12.0], {}, 12.0),
    ("linear_stiffness", [100.0], {"height": 0.52}, -2.0),
    ("linear_damping", [7.0], {"velocity": 0.5}, -3.5),
    ("added_mass", [2.0], {}, 0.0),
    ("inerter", [2.0], {}, 19.62),
    ("input_gain", [0.1], {"applied": -50.0}, -5.0),
    ("quadratic_stiffness", [1e3], {"height": 0.4}, -10.0),
    ("cubic_stiffness", [1e4], {"height": 0.4}, 10.0),
    ("centred_cubic_stiffness", [1e4, 0.45], {"height": 0.55}, -10.0),
    ("power_stiffness", [8.0, 3.0], {"height": 0.45}, 1.0),
    ("progressive_stiffness", [3.0, 0.1], {"height": 0.6}, -3.0 * (math.sinh(1.0) - 1.0)),
    ("exponential_stiffness", [3.0, 0.1], {"height": 0.4}, 3.0 * (math.e - 1.0)),
    ("gas_spring", [100.0, 0.2, 1.4], {"height": 0.4}, 100.0 * 2.0**1.4),
    ("balanced_gas_spring", [100.0, 0.2, 1.0], {"height": 0.4}, 100.0),
    ("bump_stop", [0.4, 1e4, 10.0], {"height": 0.39, "velocity": -1.0}, 110.0),
    ("rebound_stop", [0.6, 1e4, 10.0], {"height": 0.61, "velocity": 1.0}, -110.0),
    ("hertz_bump_stop", [0.4, 1e5, 0.5], {"height": 0.39, "velocity": -1.0}, 150.0),
    ("hertz_rebound_stop", [0.6, 1e5, 0.5], {"height": 0.61, "velocity": 1.0}, -150.0),
    ("power_bump_stop", [0.4, 7.0, 2.0, 0.0], {"height": 0.38}, 28.0),
    ("power_rebound_stop", [0.6, 7.0, 2.0, 0.0], {"height": 0.62}, -28.0),
    ("end_stops", [0.4, 0.6, 1e4, 0.0], {"height": 0.61}, -100.0),
    ("hertz_end_stops", [0.4, 0.6, 1e5, 0.0], {"height": 0.39}, 100.0),
    ("backlash", [1e3, 0.02, 0.5], {"height": 0.53}, -20.0),
    ("free_play", [0.5, 0.02], {"height": 0.53}, 5.0),
    ("coulomb_friction", [9.0, 0.01], {"velocity": 1.0}, -9.0),
    ("stribeck_friction", [9.0, 2.0, 1.0, 1e-3], {"velocity": 1.0}, -9.0 * (1.0 + math.exp(-1.0))),
    ("presliding_friction", [9.0, 1e-4], {"state": (0.5,)}, -4.5),
    ("elastoplastic_friction", [9.0, 1e-4], {"state": (1.2,)}, -9.0),
    ("lugre_friction", [9.0, 1.5, 0.1, 1e-4, 0.0], {"state": (0.5,)}, -4.5),
    ("quadratic_damping", [4.0], {"velocity": -0.5}, 1.0),
    ("power_damping", [4.0, 0.5], {"velocity": -0.25}, 2.0),
    ("asymmetric_damping", [4.0, 10.0], {"velocity": 0.5}, -5.0),
    ("digressive_damping", [4.0, 0.5], {"velocity": 0.5}, -2.0 / math.sqrt(2.0)),
    ("saturating_damping", [4.0, 0.5, 1.0], {"velocity": 0.5}, -1.0),
    ("arctan_damping", [4.0, 0.5], {"velocity": 0.5}, -0.5 * math.pi),
    ("blow_off_damping", [4.0, 0.5], {"velocity": -0.75}, -1.0),
    ("smooth_blow_off_damping", [4.0, 0.5], {"velocity": 0.5}, 2.0 * (1.0 - math.sqrt(0.5))),
    ("stroke_damping", [40.0], {"height": 0.4, "velocity": 0.5}, 2.0),
    ("position_dependent_damping", [400.0], {"height": 0.4, "velocity": 0.5}, -2.0),
    ("zone_damping", [4.0, 0.5, 0.1], {"height": 0.6, "velocity": 1.0}, -4.0 * math.exp(-1.0)),
    ("end_zone_damping", [40.0, 0.5], {"height": 0.4, "velocity": 1.0}, -4.0),
    ("bouc_wen", [9.0, 0.01, 1.0, 0.5], {"state": (0.5,)}, -4.5),
    ("dahl", [9.0, 0.01, 1.0], {"state": (0.5,)}, -4.5),
    ("iwan", [9.0, 0.01], {"state": (9.0,) * ELEMENTS}, -9.0),
    ("maxwell", [900.0, 0.1], {"state": (0.01,)}, -9.0),
    ("temperature_fade", [0.1, 20.0], {"velocity": 0.5, "temperature": 30.0},
     50.0 * (1.0 - math.exp(-1.0))),
    ("linear_temperature_fade", [0.02, 20.0], {"velocity": 0.5, "temperature": 30.0}, 10.0),
    ("time_fade", [0.6, 10.0], {"velocity": 0.5, "t_s": 10.0}, 20.0 * (1.0 - math.exp(-1.0))),
    (
        "energy_fade",
        [0.6, 10.0],
        {"velocity": 0.5, "state": (10.0,)},
        20.0 * (1.0 - math.exp(-1.0)),
    ),
    ("delay", [5e-4], {"applied": 10.0, "state": (8.0, 0.0, 0.0, 0.0)}, -2.0),
    ("periodic_force", [3.0, 2.0, 0.5 * math.pi], {"t_s": 0.25}, -3.0),
    (
        "hidden_mass",
        [2.0, 0.5 / math.pi, 0.5, 19.62],
        {"velocity": 1.0, "state": (0.1, 3.0)},
        -15.42,
    ),
    ("restoring_surface", TABLE, {"height": 0.5, "velocity": 0.3}, 4.0),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "parameters", "inputs", "expected"), CLOSED_FORMS, ids=[c[0] for c in CLOSED_FORMS]
)
def test_a_law_is_its_closed_form(name, parameters, inputs, expected):
    assert force(name, parameters, **inputs) == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_every_law_has_a_closed_form_here():
    assert {case[0] for case in CLOSED_FORMS} == set(CATALOGUE)


def test_every_family_has_a_law():
    assert {item.family for item in CATALOGUE.values()} == FAMILIES | {"none"}


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_an_entry_is_complete(item):
    assert CATALOGUE[item.name] is item
    assert item.excitation
    assert item.reference
    assert (item.rate is None) == (item.state_size == 0)
    assert all(0 <= i < len(item.parameters) for i in item.scaled)
    names = [parameter.name for parameter in item.parameters]
    assert len(set(names)) == len(names)
    for parameter in item.parameters:
        assert parameter.low < parameter.high
        assert parameter.meaning
        assert _unit_is_in_name(parameter), parameter.name


SUFFIXES = {
    "N": "_n", "m": "_m", "s": "_s", "kg": "_kg", "J": "_j", "Hz": "_hz", "rad": "_rad",
    "N/m": "_n_per_m", "N/m²": "_n_per_m2", "N/m³": "_n_per_m3", "N/m^1.5": "_n_per_m1_5",
    "N·s/m": "_n_s_per_m", "N·s/m²": "_n_s_per_m2", "N·s/m³": "_n_s_per_m3",
    "N·s²/m²": "_n_s2_per_m2", "m/s": "_m_per_s", "s/m": "_s_per_m", "1/K": "_per_k", "°C": "_c",
    "": "",
}  # fmt: skip


def _unit_is_in_name(parameter):
    return parameter.name.endswith(SUFFIXES[parameter.unit])


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_scaled_parameters_scale_the_force(item):
    case = next(c for c in CLOSED_FORMS if c[0] == item.name)
    if not item.scaled:
        return
    parameters = list(case[1])
    before = force(item.name, parameters, **case[2])
    for i in item.scaled:
        parameters[i] *= 3.0
    assert force(item.name, parameters, **case[2]) == pytest.approx(3.0 * before, rel=1e-9)


@pytest.mark.parametrize("name", ["bump_stop", "hertz_bump_stop", "power_bump_stop"])
def test_a_bump_stop_never_pulls_and_acts_only_in_contact(name):
    parameters = {
        "bump_stop": [0.4, 1e4, 1e3],
        "hertz_bump_stop": [0.4, 1e5, 5.0],
        "power_bump_stop": [0.4, 7.0, 2.0, 5.0],
    }[name]
    assert force(name, parameters, height=0.401, velocity=-1.0) == 0.0
    assert force(name, parameters, height=0.399, velocity=5.0) == 0.0


@pytest.mark.parametrize("name", ["rebound_stop", "hertz_rebound_stop", "power_rebound_stop"])
def test_a_rebound_stop_never_pushes_and_acts_only_in_contact(name):
    parameters = {
        "rebound_stop": [0.6, 1e4, 1e3],
        "hertz_rebound_stop": [0.6, 1e5, 5.0],
        "power_rebound_stop": [0.6, 7.0, 2.0, 5.0],
    }[name]
    assert force(name, parameters, height=0.599, velocity=1.0) == 0.0
    assert force(name, parameters, height=0.601, velocity=-5.0) == 0.0


def memory_after(name, parameters, speed, duration_s, steps=4000):
    item = effect(name)
    state = [0.0] * item.state_size
    h = duration_s / steps
    for _ in range(steps):
        first = rate(name, parameters, velocity=speed, state=tuple(state))
        middle = tuple(s + 0.5 * h * r for s, r in zip(state, first, strict=True))
        second = rate(name, parameters, velocity=speed, state=middle)
        state = [s + h * r for s, r in zip(state, second, strict=True)]
    return state


def test_dahl_bends_exponentially():
    (state,) = memory_after("dahl", [9.0, 0.01, 1.0], 0.1, 0.1)
    assert state == pytest.approx(1.0 - math.exp(-1.0), rel=1e-5)


def test_bouc_wen_of_exponent_two_bends_as_a_hyperbolic_tangent():
    (state,) = memory_after("bouc_wen", [9.0, 0.01, 2.0, 0.5], 0.1, 0.1)
    assert state == pytest.approx(math.tanh(1.0), rel=1e-5)


def test_maxwell_settles_at_speed_times_relaxation_time():
    (state,) = memory_after("maxwell", [900.0, 0.05], 0.1, 1.0)
    assert state == pytest.approx(0.1 * 0.05, rel=1e-6)


def test_iwan_elements_slip_one_after_another_to_the_full_force():
    state = memory_after("iwan", [9.0, 0.01], 0.01, 1.0)
    assert force("iwan", [9.0, 0.01], state=tuple(state)) == pytest.approx(-9.0 * 7.0 / 9.0)
    state = memory_after("iwan", [9.0, 0.01], 0.1, 1.0)
    # Each element stops within the last step in which it slips.
    assert force("iwan", [9.0, 0.01], state=tuple(state)) == pytest.approx(-9.0, rel=1e-3)


@pytest.mark.parametrize("name", ["presliding_friction", "elastoplastic_friction"])
def test_a_bristle_holds_below_its_limit_and_slides_at_it(name):
    (state,) = memory_after(name, [9.0, 1e-3], 1e-3, 0.1)
    assert force(name, [9.0, 1e-3], state=(state,)) == pytest.approx(-9.0 * 0.1, rel=0.1)
    (state,) = memory_after(name, [9.0, 1e-3], 0.1, 1.0)
    assert force(name, [9.0, 1e-3], state=(state,)) == pytest.approx(-9.0, rel=1e-3)


def test_lugre_slides_with_its_stribeck_curve():
    parameters = [9.0, 1.5, 0.1, 1e-4, 0.0]
    (state,) = memory_after("lugre_friction", parameters, 0.1, 1.0)
    expected = -9.0 * (1.0 + 0.5 * math.exp(-1.0))
    assert force("lugre_friction", parameters, velocity=0.1, state=(state,)) == pytest.approx(
        expected, rel=1e-6
    )


def test_energy_fade_counts_the_work_of_the_faded_damper():
    out = rate("energy_fade", [0.5, 10.0], velocity=2.0, state=(1e9,))
    assert out == pytest.approx([0.5 * 100.0 * 4.0])


@pytest.mark.parametrize("delay_s", [0.0004, 0.0015, 0.004, 0.02])
def test_a_delay_shifts_a_sine(delay_s):
    item = effect("delay")
    omega, h = 2.0 * math.pi * 4.0, 1e-4
    state, out = [0.0] * 4, [0.0] * 4
    worst = 0.0
    for k in range(10_000):
        t_s = k * h
        total = math.sin(omega * t_s) + item.force(
            t_s, 0.5, 0.0, math.sin(omega * t_s), 20.0, state, [delay_s], STRUT
        )
        if t_s > 0.5:
            worst = max(worst, abs(total - math.sin(omega * (t_s - delay_s))))
        applied = math.sin(omega * (t_s + 0.5 * h))
        item.rate(t_s, 0.5, 0.0, math.sin(omega * t_s), 20.0, state, [delay_s], STRUT, out)
        middle = [s + 0.5 * h * r for s, r in zip(state, out, strict=True)]
        item.rate(t_s, 0.5, 0.0, applied, 20.0, middle, [delay_s], STRUT, out)
        state = [s + h * r for s, r in zip(state, out, strict=True)]
    assert worst < 2e-4


def test_a_hidden_mass_feels_what_it_gives():
    parameters = [2.0, 1.2, 0.1, 0.0]
    state = (0.1, 3.0)
    stretch_rate, acceleration = rate("hidden_mass", parameters, velocity=1.0, state=state)
    assert stretch_rate == pytest.approx(2.0)
    given = force("hidden_mass", parameters, velocity=1.0, state=state)
    assert 2.0 * acceleration == pytest.approx(-given)


def test_the_surface_is_flat_beyond_its_edge():
    assert FIRST_FORCE == 4
    inside = force("restoring_surface", TABLE, height=0.6, velocity=1.0)
    outside = force("restoring_surface", TABLE, height=0.9, velocity=5.0)
    assert outside == pytest.approx(inside, abs=1e-4)


def test_an_unknown_effect_is_answered_with_the_nearest_names():
    with pytest.raises(UnknownEffectError, match="coulomb_friction") as caught:
        effect("coulomb_frction")
    assert caught.value.name == "coulomb_frction"
    assert len(str(caught.value).splitlines()) == 1
