"""Every law against its closed form, and what every entry of the catalogue must have."""

import inspect
import itertools
import math
import random

import pytest

from dart_model.effects import (
    CATALOGUE,
    FAMILY_WORDS,
    Motion,
    UnknownEffectError,
    calling,
    effect,
)
from dart_model.effects.calling import (
    ArgumentError,
    arguments,
    force_over_arrays,
    rates_over_arrays,
)
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
    law = force_over_arrays(item)
    return law(t_s, height, velocity, applied, temperature, memory, parameters, STRUT)


def rate(name, parameters, velocity=0.0, applied=0.0, state=()):
    item = effect(name)
    out = [math.nan] * item.state_size
    memory = list(state) or [0.0] * item.state_size
    rates_over_arrays(item)(0.0, 0.5, velocity, applied, 20.0, memory, parameters, STRUT, out)
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
    ("plateau_stiffness", [30.0, 0.45, 0.1], {"height": 0.4}, 15.0),
    ("plateau_stiffness", [30.0, 0.45, 0.02], {"height": 0.4}, 30.0),
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
    # The spring of 500 N/m pulls by 15 N, of which 2.5 N are held.
    ("lift_off", [2.5], {"height": 0.53}, 12.5),
    ("coulomb_friction", [9.0, 0.01], {"velocity": 1.0}, -9.0),
    ("load_friction", [4.0, 0.5, 0.01], {"velocity": 1.0, "applied": -20.0}, -14.0),
    ("spring_load_friction", [4.0, 0.5, 0.01], {"velocity": -1.0, "height": 0.53}, 11.5),
    ("stribeck_friction", [9.0, 2.0, 1.0, 1e-3], {"velocity": 1.0}, -9.0 * (1.0 + math.exp(-1.0))),
    ("presliding_friction", [9.0, 1e-4], {"state": (0.5,)}, -4.5),
    ("elastoplastic_friction", [9.0, 1e-4], {"state": (1.2,)}, -9.0),
    ("lugre_friction", [9.0, 1.5, 0.1, 1e-4, 0.0], {"state": (0.5,)}, -4.5),
    ("quadratic_damping", [4.0], {"velocity": -0.5}, 1.0),
    ("power_damping", [4.0, 0.5], {"velocity": -0.25}, 2.0),
    ("asymmetric_damping", [4.0, 10.0], {"velocity": 0.5}, -5.0),
    ("directional_damping", [4.0, 0.5, 6.0, 2.0], {"velocity": -0.25}, 2.0),
    ("digressive_damping", [4.0, 0.5], {"velocity": 0.5}, -2.0 / math.sqrt(2.0)),
    ("saturating_damping", [4.0, 0.5, 1.0], {"velocity": 0.5}, -1.0),
    ("arctan_damping", [4.0, 0.5], {"velocity": 0.5}, -0.5 * math.pi),
    ("blow_off_damping", [4.0, 0.5], {"velocity": -0.75}, -1.0),
    ("smooth_blow_off_damping", [4.0, 0.5], {"velocity": 0.5}, 2.0 * (1.0 - math.sqrt(0.5))),
    ("valve_damping", [4.0, 0.5, 1.0, 2.0, 0.25, 2.0], {"velocity": 0.5},
     1.0 * (1.0 - math.sqrt(0.2)) - 0.5),
    ("stroke_damping", [40.0], {"height": 0.4, "velocity": 0.5}, 2.0),
    ("position_dependent_damping", [400.0], {"height": 0.4, "velocity": 0.5}, -2.0),
    ("zone_damping", [4.0, 0.5, 0.1], {"height": 0.6, "velocity": 1.0}, -4.0 * math.exp(-1.0)),
    ("end_zone_damping", [40.0, 0.5], {"height": 0.4, "velocity": 1.0}, -4.0),
    ("bouc_wen", [9.0, 0.01, 1.0, 0.5], {"state": (0.5,)}, -4.5),
    ("dahl", [9.0, 0.01, 1.0], {"state": (0.5,)}, -4.5),
    ("general_bouc_wen", [900.0, 0.01, 1.0, 0.5], {"state": (0.01,)}, -9.0),
    ("friction_behind_play", [9.0, 0.02, 0.01, 1.0], {"state": (-0.015,)}, 4.5),
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
        [2.0, 0.5 / math.pi, 0.5],
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


def test_every_family_has_a_law_and_words():
    assert {item.family for item in CATALOGUE.values()} == FAMILIES | {"none"}
    assert set(FAMILY_WORDS) == FAMILIES


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_every_argument_of_a_law_has_a_known_name(item):
    """Of the motion, of the strut, or one of the effect's own parameters and states."""
    own = {thing.group or thing.name for thing in (*item.parameters, *item.states)}
    known = {*calling.MOTION, *calling.STRUT, *own, "rates"}
    read = set()
    for law in filter(None, (item.force, item.rate)):
        names = list(inspect.signature(law).parameters)
        assert [argument.name for argument in arguments(law, item)] == names
        assert set(names) <= known
        read |= set(names)
    # DART itself carries the mass of these.
    assert own <= read or item.name == "added_mass"


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_a_law_over_arrays_is_the_law(item):
    rng = random.Random(5)
    size = len(item.parameters)
    arrays = {
        "motion": [rng.uniform(0.1, 1.0) for _ in calling.MOTION],
        "states": [rng.uniform(0.1, 1.0) for _ in item.states],
        "strut": STRUT,
        "parameters": TABLE
        if item.name == "restoring_surface"
        else rng.choices([0.3, 1.2], k=size),
    }

    def called(law, **rates):
        given = dict(rates)
        for name, origin, first, count in arguments(law, item):
            if origin != "rates":
                row = arrays[origin][first : first + (count or 1)]
                given[name] = row[0] if count is None else row
        return law(**given)

    given = (*arrays["motion"], arrays["states"], arrays["parameters"], STRUT)
    assert force_over_arrays(item)(*given) == called(item.force)
    out = [math.nan] * item.state_size
    rates_over_arrays(item)(*given, out)
    if item.state_size > 1 and "rates" in inspect.signature(item.rate).parameters:
        expected = [math.nan] * item.state_size
        called(item.rate, rates=expected)
    elif item.state_size:
        rate = called(item.rate)
        expected = list(rate) if isinstance(rate, tuple) else [rate]
    else:
        expected = []
    assert out == expected


def test_an_argument_that_stands_for_nothing_is_refused():
    def law(velocity_m_per_s: float, coulomb_n: float) -> float:
        return coulomb_n * velocity_m_per_s

    with pytest.raises(
        ArgumentError, match=r"'coulomb_n' of its law: expected one of t_s, .*coulomb_force_n"
    ):
        arguments(law, effect("coulomb_friction"))


def test_arguments_in_another_order_are_refused():
    def law(coulomb_force_n: float, velocity_m_per_s: float) -> float:
        return coulomb_force_n * velocity_m_per_s

    with pytest.raises(ArgumentError, match=r"expected those of motion, then states"):
        arguments(law, effect("coulomb_friction"))


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_an_entry_is_complete(item):
    assert CATALOGUE[item.name] is item
    assert item.excitation
    assert item.reference
    assert item.words
    assert len([other for other in CATALOGUE.values() if other.words == item.words]) == 1
    assert item.benches
    assert set(item.benches) <= {"force_given", "motion_given"}
    assert item.name not in item.simpler
    assert set(item.simpler) <= set(CATALOGUE)
    assert all(scale > 0.0 for scale in item.state_scales)
    assert item.state_scales or not item.fits_state
    assert (item.rate is None) == (item.state_size == 0)
    assert all(0 <= i < len(item.parameters) for i in item.scaled)
    names = [parameter.name for parameter in item.parameters]
    assert len(set(names)) == len(names)
    assert set(item.shown) <= set(names)
    assert item.shown or item.name in {"none", "restoring_surface"}
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


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_a_law_of_size_zero_gives_no_force(item):
    case = next(c for c in CLOSED_FORMS if c[0] == item.name)
    if not item.scaled:
        return
    parameters = [0.0 if i in item.scaled else value for i, value in enumerate(case[1])]
    assert force(item.name, parameters, **case[2]) == 0.0


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_the_closed_form_s_parameters_are_within_the_law_s_limits(item):
    case = next(c for c in CLOSED_FORMS if c[0] == item.name)
    for value, parameter in zip(case[1], item.parameters, strict=True):
        assert parameter.low <= value <= parameter.high, parameter.name


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_friction_stops_and_loops_take_energy(item):
    """Where a parameter's sign alone would make energy out of nothing, that sign is refused."""
    if item.family not in {"friction", "stop", "hysteresis"}:
        return
    for parameter in item.parameters:
        if "height" not in parameter.name and parameter.name != "angle_rad":
            assert parameter.low >= 0.0, parameter.name
        if parameter.name == "static_to_coulomb":
            assert parameter.low == 1.0


UNPROPOSED = {
    "none", "preload", "linear_stiffness", "linear_damping", "added_mass", "inerter", "input_gain",
    "delay", "restoring_surface",
}  # fmt: skip

# Exponents of length, force and time.
DIMENSIONS = {
    "": (0, 0, 0), "rad": (0, 0, 0), "1/K": (0, 0, 0), "°C": (0, 0, 0),
    "m": (1, 0, 0), "N": (0, 1, 0), "s": (0, 0, 1), "Hz": (0, 0, -1), "J": (1, 1, 0),
    "kg": (-1, 1, 2), "m/s": (1, 0, -1), "s/m": (-1, 0, 1),
    "N/m": (-1, 1, 0), "N/m²": (-2, 1, 0), "N/m³": (-3, 1, 0), "N/m^1.5": (-1.5, 1, 0),
    "N·s/m": (-1, 1, 1), "N·s/m²": (-2, 1, 1), "N·s/m³": (-3, 1, 1), "N·s²/m²": (-2, 1, 2),
}  # fmt: skip
LENGTH, FORCE, TIME = 1e-3, 1e-5, 40.0


def scaled(value, unit):
    length, newtons, time = DIMENSIONS[unit]
    return value * LENGTH**length * FORCE**newtons * TIME**time


MOTION = Motion(
    low_m=0.42,
    high_m=0.53,
    speed_m_per_s=0.3,
    top_speed_m_per_s=0.8,
    least_stroke_m=0.05,
    duration_s=20.0,
    step_s=2e-3,
    free_length_m=0.5,
    stiffness_n_per_m=500.0,
    damping_n_s_per_m=100.0,
    mass_kg=10.0,
    force_n=8.0,
    temperatures_c=(18.0, 40.0),
    tones=((7.0, 0.3), (12.0, -2.0)),
)
UNITS = {
    "low_m": "m", "high_m": "m", "speed_m_per_s": "m/s", "top_speed_m_per_s": "m/s",
    "least_stroke_m": "m", "duration_s": "s", "step_s": "s", "free_length_m": "m",
    "stiffness_n_per_m": "N/m", "damping_n_s_per_m": "N·s/m", "mass_kg": "kg", "force_n": "N",
}  # fmt: skip
OTHER_BENCH = MOTION._replace(
    **{name: scaled(getattr(MOTION, name), unit) for name, unit in UNITS.items()},
    tones=tuple((scaled(hz, "Hz"), phase) for hz, phase in MOTION.tones),
)
MOTIONS = {
    "usual": MOTION,
    "other_bench": OTHER_BENCH,
    "far_free_length": MOTION._replace(free_length_m=3.0),
    "free_length_below": MOTION._replace(free_length_m=-3.0),
    "one_small_recording": MOTION._replace(least_stroke_m=1e-3),
    "no_stiffness": MOTION._replace(stiffness_n_per_m=0.0),
}


def test_a_search_proposes_all_but_what_every_model_has():
    assert {name for name, item in CATALOGUE.items() if not item.starts(MOTION)} == UNPROPOSED
    linear = {name for name, item in CATALOGUE.items() if item.linear}
    assert linear == UNPROPOSED - {"none", "restoring_surface"}


HELD = ("reference_c",)
"""Parameters that no data can tell from another: their bounds are one value."""


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_starts_are_few_and_within_their_bounds(item, motion):
    starts = item.starts(motion)
    bounds = item.bounds(motion)
    assert len(starts) <= (32 if item.name == "hidden_mass" else 24)
    assert len(set(starts)) == len(starts)
    assert set(bounds) <= {parameter.name for parameter in item.parameters}
    for start, (i, parameter) in itertools.product(starts, enumerate(item.parameters)):
        low, high = bounds.get(parameter.name, (parameter.low, parameter.high))
        assert parameter.low <= low <= high <= parameter.high, parameter.name
        assert low < high or parameter.name in HELD, parameter.name
        assert low <= start[i] <= high, parameter.name


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_a_search_is_the_same_on_a_bench_of_another_size(item):
    here, there = item.bounds(MOTION), item.bounds(OTHER_BENCH)
    units = {parameter.name: parameter.unit for parameter in item.parameters}
    assert set(here) == set(there)
    for name, limits in here.items():
        expected = [scaled(limit, units[name]) for limit in limits]
        assert there[name] == pytest.approx(expected, rel=1e-9), name
    for a, b in zip(item.starts(MOTION), item.starts(OTHER_BENCH), strict=True):
        for i, parameter in enumerate(item.parameters):
            if i not in item.scaled:
                assert b[i] == pytest.approx(scaled(a[i], parameter.unit), rel=1e-9)
        # The force's size is arbitrary: what must scale is one of its parameters over another.
        for i in item.scaled:
            first = item.scaled[0]
            if a[first] == 0.0:
                continue
            factor = scaled(1.0, item.parameters[i].unit)
            factor /= scaled(1.0, item.parameters[first].unit)
            assert b[i] / b[first] == pytest.approx(a[i] / a[first] * factor, rel=1e-9)


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_bounds_leave_no_unscaled_parameter_with_a_unit_to_the_catalogue(item):
    """The catalogue's limits only say what makes sense at all: a search would run away in them."""
    named = set(item.bounds(MOTION)) | {"phase_rad", "angle_rad", "fraction_per_k"}
    if item.name in UNPROPOSED:
        return
    for i, parameter in enumerate(item.parameters):
        if i not in item.scaled and parameter.unit:
            assert parameter.name in named, parameter.name


@pytest.mark.parametrize("item", CATALOGUE.values(), ids=CATALOGUE)
def test_a_strut_at_rest_shows_only_what_needs_no_motion(item):
    still = MOTION._replace(
        high_m=MOTION.low_m, least_stroke_m=0.0, speed_m_per_s=0.0, top_speed_m_per_s=0.0
    )
    assert bool(item.starts(still)) == (item.name == "periodic_force")
    for name, (low, high) in item.bounds(still).items():
        assert low <= high, name


def test_a_temperature_that_does_not_change_shows_no_fade():
    even = MOTION._replace(temperatures_c=(20.0, 20.5))
    assert effect("temperature_fade").starts(even) == []
    assert effect("linear_temperature_fade").starts(even) == []


def test_a_strut_without_a_damper_shows_no_fade():
    undamped = MOTION._replace(damping_n_s_per_m=0.0)
    assert effect("time_fade").starts(undamped) == []
    assert effect("energy_fade").starts(undamped) == []


def test_too_short_a_recording_shows_no_slow_laws():
    short = MOTION._replace(duration_s=20.0 * MOTION.step_s)
    assert effect("maxwell").starts(short) == []
    assert effect("hidden_mass").starts(short) == []


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


def cycled(name, parameters, heights, turns, steps=4000):
    """States and forces along heights that go straight from turn to turn at 0.1 m/s."""
    item = effect(name)
    state = [0.0] * item.state_size
    found = []
    for start, end in itertools.pairwise([heights, *turns]):
        velocity = math.copysign(0.1, end - start)
        h = abs(end - start) / 0.1 / steps
        for k in range(steps):
            first = rate(name, parameters, velocity=velocity, state=tuple(state))
            middle = tuple(s + 0.5 * h * r for s, r in zip(state, first, strict=True))
            second = rate(name, parameters, velocity=velocity, state=middle)
            state = [s + h * r for s, r in zip(state, second, strict=True)]
            newtons = force(name, parameters, velocity=velocity, state=tuple(state))
            found.append((start + velocity * h * (k + 1), newtons))
    return found


def work_j(path):
    """Work that the strut puts into the law along a path."""
    return -sum(0.5 * (f0 + f1) * (x1 - x0) for (x0, f0), (x1, f1) in itertools.pairwise(path))


@pytest.mark.parametrize(("exponent", "shape"), [(1.0, 0.5), (2.0, 0.9), (1.5, 0.2)])
def test_the_general_bouc_wen_law_holds_the_usual_one(exponent, shape):
    yield_n, yield_m = 9.0, 0.01
    # beta = cos(angle) / bend**n and gamma = sin(angle) / bend**n, for which the usual law has
    # shape / yield_m**n and (1 - shape) / yield_m**n.
    bend = yield_m * math.hypot(shape, 1.0 - shape) ** (-1.0 / exponent)
    general = [yield_n / yield_m, bend, exponent, math.atan2(1.0 - shape, shape)]
    turns = [0.02, -0.015, 0.004, 0.001, 0.01]
    a = cycled("bouc_wen", [yield_n, yield_m, exponent, shape], 0.0, turns, 500)
    b = cycled("general_bouc_wen", general, 0.0, turns, 500)
    assert [n for _, n in b] == pytest.approx([n for _, n in a], rel=1e-6, abs=1e-6)


def test_below_a_quarter_turn_the_general_bouc_wen_loop_hardens():
    def slopes(angle):
        path = cycled("general_bouc_wen", [900.0, 0.02, 1.0, angle], 0.0, [0.02], 400)
        forces = [-newtons for _, newtons in path]
        return forces[1] - forces[0], forces[-1] - forces[-2]

    first, last = slopes(-0.3)
    assert last < 0.9 * first
    first, last = slopes(-0.95)
    assert last > 1.1 * first
    first, last = slopes(-0.25 * math.pi)
    assert last == pytest.approx(first, rel=1e-6)


LOOPS = [
    ("general_bouc_wen", [900.0, 0.01, exponent, angle])
    for exponent in (0.5, 1.0, 2.0)
    for angle in (-1.5, -0.95, -0.3, 0.25 * math.pi, 1.5)
] + [
    ("friction_behind_play", [9.0, gap, travel, exponent])
    for gap in (0.001, 0.008)
    for travel in (0.001, 0.006)
    for exponent in (0.4, 1.0, 3.0)
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameters"), LOOPS, ids=str)
def test_a_closed_loop_takes_energy(name, parameters):
    """The last of several equal cycles, whose states begin and end alike."""
    path = cycled(name, parameters, 0.0, [0.01, *[-0.01, 0.01] * 5], 1000)
    cycle = path[9 * 1000 - 1 :]
    assert cycle[0] == pytest.approx(cycle[-1], abs=0.05)
    assert all(math.isfinite(newtons) for _, newtons in path)
    assert work_j(cycle) > -1e-9


def test_play_is_crossed_without_force():
    gap, travel = 0.008, 0.002
    path = cycled("friction_behind_play", [9.0, gap, travel, 1.0], 0.0, [0.02, 0.0], 2000)
    for height, newtons in path:
        if path.index((height, newtons)) < 2000:
            # Half of the play first, then friction that bends as Dahl's does.
            beyond = max(height - 0.5 * gap, 0.0) / travel
            assert newtons == pytest.approx(-9.0 * (1.0 - math.exp(-beyond)), abs=1e-2)
        else:
            # It unloads, crosses the play, and holds the other way round.
            if 0.02 - travel < height < 0.02:
                expected = -9.0 * (1.0 - (0.02 - height) / travel)
            elif height > 0.02 - travel - gap:
                expected = 0.0
            else:
                expected = 9.0 * (1.0 - math.exp(-(0.02 - travel - gap - height) / travel))
            assert newtons == pytest.approx(expected, abs=2e-2)


def test_less_travel_than_the_play_meets_no_friction():
    path = cycled("friction_behind_play", [9.0, 0.008, 0.002, 1.0], 0.0, [0.0039, -0.0039, 0.0], 99)
    assert all(newtons == 0.0 for _, newtons in path)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 3.0])
def test_friction_behind_no_play_is_a_bouc_wen_loop_that_unloads_elastically(exponent):
    turns = [0.02, -0.015, 0.004, 0.001, 0.01]
    a = cycled("bouc_wen", [9.0, 0.01, exponent, 0.5], 0.0, turns, 500)
    b = cycled("friction_behind_play", [9.0, 1e-12, 0.01, exponent], 0.0, turns, 500)
    assert [n for _, n in b] == pytest.approx([n for _, n in a], rel=1e-2, abs=2e-2)


def test_friction_behind_no_play_that_bends_sharply_is_elastoplastic():
    turns = [0.02, -0.015, 0.004, 0.001, 0.01]
    a = cycled("elastoplastic_friction", [9.0, 0.001], 0.0, turns, 500)
    b = cycled("friction_behind_play", [9.0, 1e-12, 0.001, 4.0], 0.0, turns, 500)
    differences = [abs(y[1] - x[1]) for x, y in zip(a, b, strict=True)]
    assert max(differences) < 0.15 * 9.0
    assert sum(differences) / len(differences) < 0.03 * 9.0


def runge_kutta(name, parameters, speed_m_per_s, h, steps):
    """Largest force of a strut that swings with long steps of the plant's own integrator."""
    state, largest = [0.0] * effect(name).state_size, 0.0
    for k in range(steps):
        speeds = [speed_m_per_s * math.sin(12.0 * h * (k + x)) for x in (0.0, 0.5, 0.5, 1.0)]
        slopes = []
        for weight, speed in zip((0.0, 0.5, 0.5, 1.0), speeds, strict=True):
            last = slopes[-1] if slopes else [0.0] * len(state)
            at = tuple(s + weight * h * r for s, r in zip(state, last, strict=True))
            slopes.append(rate(name, parameters, velocity=speed, state=at))
        for i in range(len(state)):
            a, b, c, d = (slope[i] for slope in slopes)
            state[i] += h / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        largest = max(largest, abs(force(name, parameters, state=tuple(state))))
    return largest, state


@pytest.mark.parametrize("exponent", [0.3, 1.0, 4.0])
def test_friction_behind_play_survives_steps_longer_than_its_travel(exponent):
    parameters = [9.0, 1e-3, 1e-5, exponent]
    largest, (deflection,) = runge_kutta("friction_behind_play", parameters, 1.0, 1e-3, 3000)
    assert 0.99 * 9.0 < largest <= 9.0
    assert abs(deflection) < 0.5e-3 + 1.0 * 1e-3 + 1e-5


@pytest.mark.parametrize("angle", [-1.57, -0.95, 0.0, 1.57])
@pytest.mark.parametrize("exponent", [0.5, 5.0])
def test_a_general_bouc_wen_loop_stays_finite(angle, exponent):
    _, (deflection,) = runge_kutta(
        "general_bouc_wen", [900.0, 1e-4, exponent, angle], 1.0, 1e-3, 3000
    )
    assert math.isfinite(deflection)


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


def unlimited_lugre_n(parameters, velocity, h):
    """Forces of bristles that settle as fast as they like, by exact steps of a held velocity."""
    coulomb_n, static, stribeck, presliding_m, damping = parameters
    deflection, forces_n = 0.0, []
    for v in velocity:
        fall = math.exp(-((v / stribeck) ** 2))
        level, speed = 1.0 + (static - 1.0) * fall, abs(v) / presliding_m
        settled = math.copysign(level, v)
        deflection = settled + (deflection - settled) * math.exp(-speed / level * h)
        bending = (math.copysign(speed, v) - speed * deflection / level) * presliding_m
        forces_n.append(-coulomb_n * deflection - damping * fall * bending)
    return forces_n


def test_bristles_that_settle_faster_than_the_limit_slide_as_if_there_were_none():
    # Bristles of 20 µm at up to 0.4 m/s would settle at 20 000/s, ten times the limit.
    parameters, h = [27.0, 1.5, 0.07, 2e-5, 2000.0], 1e-5
    velocity = [0.4 * math.sin(12.0 * h * k) for k in range(60_000)]
    exact_n = unlimited_lugre_n(parameters, velocity, h)
    deflection, errors_n, late_n = 0.0, [], []
    for v, expected_n in zip(velocity, exact_n, strict=True):
        state = (deflection,)
        errors_n.append(force("lugre_friction", parameters, velocity=v, state=state) - expected_n)
        late_n.append(-27.0 * deflection - expected_n)
        deflection += h * rate("lugre_friction", parameters, velocity=v, state=state)[0]
    assert max(map(abs, errors_n)) < 0.15
    sliding = [k for k, v in enumerate(velocity) if abs(v) > 0.06]
    assert max(abs(errors_n[k]) for k in sliding) < 0.01
    # The deflection alone is late by a hundred times as much.
    assert max(abs(late_n[k]) for k in sliding) > 0.5


def test_energy_fade_counts_the_work_of_the_faded_damper():
    out = rate("energy_fade", [0.5, 10.0], velocity=2.0, state=(1e9,))
    assert out == pytest.approx([0.5 * 100.0 * 4.0])


@pytest.mark.parametrize("delay_s", [0.0004, 0.0015, 0.004, 0.02])
def test_a_delay_shifts_a_sine(delay_s):
    force, rates = force_over_arrays(effect("delay")), rates_over_arrays(effect("delay"))
    omega, h = 2.0 * math.pi * 4.0, 1e-4
    state, out = [0.0] * 4, [0.0] * 4
    worst = 0.0
    for k in range(10_000):
        t_s = k * h
        total = math.sin(omega * t_s) + force(
            t_s, 0.5, 0.0, math.sin(omega * t_s), 20.0, state, [delay_s], STRUT
        )
        if t_s > 0.5:
            worst = max(worst, abs(total - math.sin(omega * (t_s - delay_s))))
        applied = math.sin(omega * (t_s + 0.5 * h))
        rates(t_s, 0.5, 0.0, math.sin(omega * t_s), 20.0, state, [delay_s], STRUT, out)
        middle = [s + 0.5 * h * r for s, r in zip(state, out, strict=True)]
        rates(t_s, 0.5, 0.0, applied, 20.0, middle, [delay_s], STRUT, out)
        state = [s + h * r for s, r in zip(state, out, strict=True)]
    assert worst < 2e-4


def test_a_hidden_mass_feels_what_it_gives():
    parameters = [2.0, 1.2, 0.1]
    state = (0.1, 3.0)
    stretch_rate, acceleration = rate("hidden_mass", parameters, velocity=1.0, state=state)
    assert stretch_rate == pytest.approx(2.0)
    given = force("hidden_mass", parameters, velocity=1.0, state=state)
    # Counted from rest: there the spring carries the mass and the body the spring.
    assert 2.0 * acceleration == pytest.approx(-given - 2.0 * STRUT[3])


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
