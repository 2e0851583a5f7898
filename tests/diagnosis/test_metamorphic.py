"""What must not change an answer, or change it in a known way; none of it needs the truth."""

import functools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dart_model.effects import effect
from rig.diagnosis.diagnose import diagnose
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import (
    correction,
    holds,
    is_at_the_floor,
    linear_part,
    missing,
    overlap,
    same_answer,
    same_names,
)
from tests.diagnosis.similar import Scale, cut, mirrored, shifted, thinned


class Friction(bench.Nothing):
    def force(self, t, z, v, state):
        return -6.0 * math.tanh(v / 3e-3)


class Hardening(bench.Nothing):
    def force(self, t, z, v, state):
        return -1.2e5 * (z - bench.FREE) ** 3


class Stop(bench.Nothing):
    """Touched by the bench with its weight and without."""

    fine = 40

    def __init__(self, contact=0.335):
        self.contact = contact

    def force(self, t, z, v, state):
        depth = self.contact - z
        return max(0.0, 2e4 * depth - 40.0 * v) if depth > 0.0 else 0.0


class Stiffness(bench.Nothing):
    def force(self, t, z, v, state):
        return -200.0 * (z - bench.FREE)


class Asymmetry(bench.Nothing):
    def force(self, t, z, v, state):
        return -60.0 * v if v < 0.0 else 0.0


class Ripple(bench.Nothing):
    def force(self, t, z, v, state):
        return 4.0 * math.cos(2.0 * math.pi * 5.3 * t)


class DynoStop(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        depth = 0.286 - z
        return max(0.0, 1.5e5 * depth - 200.0 * v) if depth > 0.0 else 0.0


class DynoFriction(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return -60.0 * math.tanh(v / 3e-3)


class DynoOrifice(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return -1500.0 * v * abs(v)


EFFECTS = {
    "complete": bench.Nothing(),
    "friction": Friction(),
    "hardening": Hardening(),
    "stop": Stop(),
    "stiffness": Stiffness(),
    "ripple": Ripple(),
    "weightless stop": Stop(0.37),
    "weightless asymmetry": Asymmetry(),
    "dyno complete": dyno.Nothing(),
    "dyno stop": DynoStop(),
    "dyno friction": DynoFriction(),
    "dyno orifice": DynoOrifice(),
}


def kind_of(case):
    return dyno if case.startswith("dyno") else bench


def gravity_of(case):
    return 0.0 if case.startswith("weightless") else kind_of(case).GRAVITY


@functools.cache
def recordings(case, first_seed=1):
    """One to learn from and one held out."""
    planted = EFFECTS[case]
    if kind_of(case) is dyno:
        return (
            dyno.run(planted, seed=first_seed, duration_s=8.0),
            dyno.run(planted, seed=first_seed + 1, duration_s=6.0, motion=dyno.later),
        )
    gravity = gravity_of(case)
    return (
        bench.run(planted, seed=first_seed, duration_s=10.0, gravity=gravity),
        bench.run(planted, seed=first_seed + 1, duration_s=6.0, gravity=gravity, start=0.37),
    )


@functools.cache
def answer(case):
    """Diagnosis of the bench as it is, with its exact nominal model."""
    train, test = recordings(case)
    return diagnose(kind_of(case).model(gravity=gravity_of(case)), [train], [test])


# --- 1. Units ----------------------------------------------------------------------------------

UNIT = {
    "mass_kg": "kg",
    "stiffness_n_per_m": "N/m",
    "damping_n_s_per_m": "N·s/m",
    "preload_n": "N",
    "input_gain": "",
}


def scaled_back(name, parameters, scale):
    units = {parameter.name: parameter.unit for parameter in effect(name).parameters}
    return {key: each.value / scale.factor(units[key]) for key, each in parameters.items()}


def check_scaled(case, scale):
    one = answer(case).diagnosis
    train, test = (scale.recording(record) for record in recordings(case))
    model = scale.model(kind_of(case), gravity=gravity_of(case))
    other = diagnose(model, [train], [test]).diagnosis
    assert other.verdict == one.verdict
    assert [e.name for e in other.effects] == [e.name for e in one.effects]
    for before, after in zip(one.effects, other.effects, strict=True):
        back = scaled_back(after.name, after.parameters, scale)
        for name, estimate in before.parameters.items():
            # The last digits of a sum may decide where a fit stops, within its interval.
            if estimate.low is None or estimate.high is None:
                continue  # The data do not bind it.
            width = estimate.high - estimate.low
            assert back[name] == pytest.approx(estimate.value, rel=0.005, abs=0.5 * width), name
        assert after.force_rms_n == pytest.approx(before.force_rms_n * scale.force, rel=0.02)
    assert [item.parameter for item in other.linear] == [item.parameter for item in one.linear]
    for before, after in zip(one.linear, other.linear, strict=True):
        back = after.total.value / scale.factor(UNIT[after.parameter])
        assert back == pytest.approx(before.total.value, rel=0.01)
    # The floor of the figure that decides; that of the force along a smoothed motion is indicative.
    if kind_of(case) is dyno:
        floor = one.noise_floor.residual_force_rmse_n * scale.force
        assert other.noise_floor.residual_force_rmse_n == pytest.approx(floor, rel=0.05)
    else:
        floor = one.noise_floor.height_rmse_m * scale.length
        assert other.noise_floor.height_rmse_m == pytest.approx(floor, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "scale"),
    [
        ("friction", Scale(3.0, 0.05, 2.0)),
        ("dyno stop", Scale(0.2, 40.0, 0.5)),
        pytest.param("friction", Scale(0.3, 100.0, 0.5), marks=pytest.mark.long),
        pytest.param("dyno stop", Scale(5.0, 0.1, 3.0), marks=pytest.mark.long),
        pytest.param("complete", Scale(0.2, 10.0, 2.0), marks=pytest.mark.long),
        pytest.param("stop", Scale(4.0, 10.0, 1.0), marks=pytest.mark.long),
    ],
)
def test_units_change_nothing_but_the_numbers(case, scale):
    check_scaled(case, scale)


def factors(least, most):
    return st.floats(math.log(least), math.log(most)).map(math.exp)


@pytest.mark.long
@settings(max_examples=4, derandomize=True, deadline=None)
@given(
    case=st.sampled_from(["friction", "dyno stop"]),
    scale=st.builds(Scale, factors(0.2, 5.0), factors(0.01, 100.0), factors(0.4, 3.0)),
)
def test_any_units_change_nothing_but_the_numbers(case, scale):
    check_scaled(case, scale)


def test_units_are_read():
    scale = Scale(2.0, 3.0, 5.0)
    assert scale.factor("N·s²/m²") == pytest.approx(3.0 * 25.0 / 4.0)
    assert scale.factor("N/m^1.5") == pytest.approx(3.0 / 2.0**1.5)
    assert scale.factor("kg") == pytest.approx(3.0 * 25.0 / 2.0)
    assert scale.factor("1/K") == 1.0
    assert scale.factor("") == 1.0


# --- 2. Nominal values -------------------------------------------------------------------------


def check_rough(case, mass, stiffness, damping):
    one = answer(case)
    kind = kind_of(case)
    train, test = recordings(case)
    nominal = {
        "stiffness": kind.STIFFNESS * stiffness,
        "damping": kind.DAMPING * damping,
    }
    if kind is bench:
        nominal["mass"] = kind.MASS * mass
    rough = diagnose(kind.model(**nominal), [train], [test])
    found = rough.diagnosis
    assert missing(found) == missing(one.diagnosis)
    assert found.verdict == "explained"
    assert is_at_the_floor(found)
    named = {effect.name: effect for effect in found.effects}
    for before in one.diagnosis.effects:
        after = named[before.name]
        for name, estimate in before.parameters.items():
            assert overlap(estimate, after.parameters[name]), name
    middle = float((train.heights_m.min() + train.heights_m.max()) / 2.0)
    wanted, got = (linear_part(result.corrected, middle) for result in (one, rough))
    assert got.stiffness_n_per_m == pytest.approx(wanted.stiffness_n_per_m, rel=0.01)
    assert got.rebound_n_s_per_m == pytest.approx(wanted.rebound_n_s_per_m, rel=0.02)
    weight = (wanted.mass_kg - got.mass_kg) * kind.GRAVITY
    if kind is bench:
        assert got.mass_kg == pytest.approx(wanted.mass_kg, rel=0.01)
        assert got.force_n + weight == pytest.approx(wanted.force_n, abs=0.3)
    else:
        assert got.force_n == pytest.approx(wanted.force_n, abs=1.0)
    truth = {"stiffness_n_per_m": kind.STIFFNESS, "damping_n_s_per_m": kind.DAMPING}
    for parameter, total in truth.items():
        item = correction(found, parameter)
        assert item.nominal == pytest.approx(nominal[parameter.partition("_")[0]])
        assert holds(item.total, total, slack=5e-3)


CORNERS = [
    ("friction", 1.05, 0.8, 1.4),
    ("complete", 1.04, 0.87, 1.3),
    ("dyno orifice", 1.0, 1.2, 0.6),
]
LONG_CORNERS = [
    ("friction", 0.95, 1.2, 0.6),
    ("friction", 0.95, 0.8, 1.4),
    ("complete", 0.95, 1.2, 0.6),
    ("stop", 1.05, 0.8, 1.4),
    ("stop", 0.95, 1.2, 0.6),
    ("hardening", 1.05, 1.2, 1.4),
    ("hardening", 0.95, 0.8, 0.6),
    ("dyno stop", 1.0, 0.8, 1.4),
    ("dyno friction", 1.0, 1.2, 0.6),
    ("dyno complete", 1.0, 0.8, 1.4),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "mass", "stiffness", "damping"),
    CORNERS + [pytest.param(*corner, marks=pytest.mark.long) for corner in LONG_CORNERS],
)
def test_rough_nominal_values_change_no_answer(case, mass, stiffness, damping):
    check_rough(case, mass, stiffness, damping)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    ["friction", "dyno orifice"]
    + [pytest.param(case, marks=pytest.mark.long) for case in ("hardening", "stop", "dyno stop")],
)
def test_the_fourth_digit_of_the_model_file_changes_no_answer(case):
    kind, (train, test) = kind_of(case), recordings(case)
    nominal = {"stiffness": 1.0001 * kind.STIFFNESS, "damping": 0.9999 * kind.DAMPING}
    if kind is bench:
        nominal["mass"] = 0.9999 * kind.MASS
    other = diagnose(kind.model(**nominal), [train], [test])
    same_answer(answer(case).diagnosis, other.diagnosis)


# --- 3. Mirror ---------------------------------------------------------------------------------

ABOUT_M = 0.45


@functools.cache
def in_the_mirror(case):
    kind = kind_of(case)
    train, test = (mirrored(record, ABOUT_M) for record in recordings(case))
    model = kind.model(gravity=0.0, free=2.0 * ABOUT_M - kind.FREE)
    return diagnose(model, [train], [test])


@pytest.mark.parametrize(
    "case", ["dyno stop", pytest.param("weightless stop", marks=pytest.mark.long)]
)
def test_a_bump_stop_is_a_rebound_stop_in_the_mirror(case):
    one, other = answer(case).diagnosis, in_the_mirror(case).diagnosis
    assert [e.name for e in one.effects] == ["bump_stop"]
    assert [e.name for e in other.effects] == ["rebound_stop"]
    assert one.verdict == other.verdict == "explained"
    bump, rebound = one.effects[0].parameters, other.effects[0].parameters
    for name in ("stiffness_n_per_m", "damping_n_s_per_m"):
        assert rebound[name].value == pytest.approx(bump[name].value, rel=0.01)
    contact_m = 2.0 * ABOUT_M - bump["contact_height_m"].value
    assert rebound["contact_height_m"].value == pytest.approx(contact_m, abs=2e-5)


@pytest.mark.slow
def test_compression_and_rebound_change_places_in_the_mirror():
    case = "weightless asymmetry"
    one, other = answer(case), in_the_mirror(case)
    assert missing(one.diagnosis) == missing(other.diagnosis) == ["asymmetric_damping"]
    assert one.diagnosis.verdict == other.diagnosis.verdict == "explained"
    here, there = (linear_part(result.corrected, bench.FREE) for result in (one, other))
    assert here.compression_n_s_per_m == pytest.approx(bench.DAMPING + 60.0, rel=0.02)
    assert here.rebound_n_s_per_m == pytest.approx(bench.DAMPING, rel=0.02)
    assert there.compression_n_s_per_m == pytest.approx(here.rebound_n_s_per_m, rel=0.01)
    assert there.rebound_n_s_per_m == pytest.approx(here.compression_n_s_per_m, rel=0.01)


@pytest.mark.long
def test_a_complete_bench_is_complete_in_the_mirror():
    train, test = (
        mirrored(bench.run(bench.Nothing(), seed=seed, gravity=0.0), ABOUT_M) for seed in (1, 2)
    )
    model = bench.model(gravity=0.0, free=2.0 * ABOUT_M - bench.FREE)
    assert diagnose(model, [train], [test]).diagnosis.verdict == "nothing_missing"


# --- 4. Parts, order, time, names --------------------------------------------------------------


@functools.cache
def of_two_parts(case, order):
    train, test = recordings(case)
    parts = cut(train)
    return diagnose(kind_of(case).model(), [parts[k] for k in order], [test]).diagnosis


@pytest.mark.slow
@pytest.mark.parametrize("case", ["friction", pytest.param("dyno stop", marks=pytest.mark.long)])
def test_a_recording_cut_in_two_gives_the_same_answer(case):
    same_answer(answer(case).diagnosis, of_two_parts(case, (0, 1)), rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize("case", ["friction", "dyno stop"])
def test_the_order_of_recordings_changes_nothing(case):
    same_answer(of_two_parts(case, (0, 1)), of_two_parts(case, (1, 0)), rel=0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    ["friction", *(pytest.param(c, marks=pytest.mark.long) for c in ("dyno stop", "complete"))],
)
def test_a_later_time_changes_nothing(case):
    train, test = (shifted(record, 1e4) for record in recordings(case))
    other = diagnose(kind_of(case).model(), [train], [test]).diagnosis
    same_answer(answer(case).diagnosis, other, rel=0.005)


@pytest.mark.long
def test_a_later_time_changes_a_periodic_force_in_its_phase_only():
    one = answer("ripple").diagnosis
    train, test = (shifted(record, 1e4) for record in recordings("ripple"))
    other = diagnose(bench.model(), [train], [test]).diagnosis
    assert [e.name for e in one.effects] == [e.name for e in other.effects] == ["periodic_force"]
    assert other.verdict == one.verdict
    before, after = (d.effects[0].parameters for d in (one, other))
    assert after["amplitude_n"].value == pytest.approx(before["amplitude_n"].value, rel=0.01)
    assert after["frequency_hz"].value == pytest.approx(before["frequency_hz"].value, rel=1e-4)
    turns = before["frequency_hz"].value * 10.0 + (before["phase_rad"].value / (2.0 * math.pi))
    later = after["frequency_hz"].value * 10010.0 + after["phase_rad"].value / (2.0 * math.pi)
    assert (later - turns + 0.5) % 1.0 - 0.5 == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("case", ["dyno stop", pytest.param("friction", marks=pytest.mark.long)])
def test_another_name_of_the_strut_changes_the_name_only(case):
    train, test = recordings(case)
    other = diagnose(kind_of(case).model(strut="front.left"), [train], [test]).diagnosis
    same_answer(answer(case).diagnosis, other, rel=1e-9)
    assert {effect.strut for effect in other.effects} == {"front.left"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", ["stop", *(pytest.param(c, marks=pytest.mark.long) for c in ("friction", "complete"))]
)
def test_the_sampling_rate_changes_nothing(case):
    """Of one record at 1000 Hz, each second, fourth and tenth sample."""
    train, test = (
        bench.run(EFFECTS[case], seed=seed, duration_s=seconds, rate_hz=1000, start=start)
        for seed, seconds, start in ((1, 10.0, None), (2, 6.0, 0.37))
    )
    whole, *others = (
        diagnose(bench.model(), [thinned(train, every)], [thinned(test, every)]).diagnosis
        for every in (1, 2, 4, 10)
    )
    for other in others:
        same_names(whole, other)
        for one, thin in zip(whole.effects, other.effects, strict=True):
            shown = effect(one.name).shown
            assert all(overlap(one.parameters[name], thin.parameters[name]) for name in shown)


# --- 5. Idempotence ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        "friction",
        "dyno stop",
        *(
            pytest.param(case, marks=pytest.mark.long)
            for case in ("hardening", "stop", "stiffness", "dyno friction", "dyno orifice")
        ),
    ],
)
def test_the_corrected_model_lacks_nothing_on_fresh_data(case):
    train, test = recordings(case, 11)
    again = diagnose(answer(case).corrected, [train], [test])
    found = again.diagnosis
    assert found.verdict == "nothing_missing"
    assert found.effects == ()
    assert not [item for item in found.existing if item.change == "superfluous"]
    assert is_at_the_floor(found)


# --- 6. An effect of size zero -----------------------------------------------------------------

ZERO = {
    "friction": "[{name: coulomb_friction,"
    " parameters: {coulomb_force_n: 0.0, rounding_velocity_m_per_s: 0.003}}]",
    "hardening": "[{name: cubic_stiffness, parameters: {stiffness_n_per_m3: 0.0}}]",
}


@pytest.mark.parametrize(
    ("case", "zero"),
    [
        ("complete", "friction"),
        *(
            pytest.param(case, zero, marks=pytest.mark.long)
            for case, zero in (
                ("hardening", "friction"),
                ("dyno stop", "friction"),
                ("friction", "hardening"),
                ("complete", "hardening"),
                ("dyno complete", "friction"),
            )
        ),
    ],
)
def test_an_effect_of_size_zero_changes_nothing(case, zero):
    train, test = recordings(case)
    other = diagnose(kind_of(case).model(effects=ZERO[zero]), [train], [test]).diagnosis
    same_answer(answer(case).diagnosis, other, rel=0.01)
