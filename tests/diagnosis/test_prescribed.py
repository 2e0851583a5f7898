"""Effects planted in a dyno are found by their load cell; a complete model lacks none."""

import math
from dataclasses import replace

import pytest

from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.search.criteria import CRITERIA
from rig.recordings.recording import RecordingError
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import (
    LINEAR_FAMILIES,
    correction,
    holds,
    is_at_the_floor,
    missing,
    named,
)
from tests.diagnosis.little_dyno import DAMPING, FREE, MIDDLE, STIFFNESS, Nothing


class Preload(Nothing):
    def force(self, t, z, v, state, warm):
        return 35.0


class Stiffness(Nothing):
    def force(self, t, z, v, state, warm):
        return -900.0 * (z - FREE)


class Damping(Nothing):
    def force(self, t, z, v, state, warm):
        return -150.0 * v


class Hardening(Nothing):
    def force(self, t, z, v, state, warm):
        return -4e6 * (z - FREE) ** 3


class GasColumn(Nothing):
    def force(self, t, z, v, state, warm):
        column = 0.12 + (z - FREE)
        return 400.0 * (0.12 / column) ** 1.3


class Stop(Nothing):
    def force(self, t, z, v, state, warm):
        depth = 0.286 - z
        return max(0.0, 1.5e5 * depth - 200.0 * v) if depth > 0.0 else 0.0


class Friction(Nothing):
    def force(self, t, z, v, state, warm):
        return -60.0 * math.copysign(1.0, v) * (1.0 - math.exp(-abs(v) / 2e-3))


class Orifice(Nothing):
    def force(self, t, z, v, state, warm):
        return -1500.0 * v * abs(v)


class Digressive(Nothing):
    def force(self, t, z, v, state, warm):
        return -900.0 * v / (1.0 + abs(v) / 0.15)


class Yielding(Nothing):
    """Bouc and Wen's loop in the form with stiffness, alpha, beta and gamma."""

    size = 1

    def force(self, t, z, v, state, warm):
        return -120.0 * state[0]

    def rate(self, t, z, v, state):
        s = state[0]
        return ((v - 0.6 * abs(v) * s * abs(s) - 0.4 * v * abs(s) ** 2) / 8e-4,)


class Relaxing(Nothing):
    """A damper and a spring in series; the state is the damper's travel."""

    size = 1

    def force(self, t, z, v, state, warm):
        return -4000.0 * (z - MIDDLE - state[0])

    def rate(self, t, z, v, state):
        return (4000.0 * (z - MIDDLE - state[0]) / 200.0,)


class Fade(Nothing):
    def force(self, t, z, v, state, warm):
        return DAMPING * v * 0.35 * (1.0 - math.exp(-t / 4.0))


class Ripple(Nothing):
    def force(self, t, z, v, state, warm):
        return 12.0 * math.cos(2.0 * math.pi * 13.7 * t + 0.4)


PLANTED = {
    "preload": (Preload, {"force_n": 35.0}),
    "stiffness": (Stiffness, {"stiffness_n_per_m": 900.0}),
    "damping": (Damping, {"damping_n_s_per_m": 150.0}),
    "nonlinear_stiffness": (Hardening, {"stiffness_n_per_m3": 4e6}),
    # Over this stroke an exponential spring is as good: the family is found, its formula is not.
    "gas": (GasColumn, {}),
    "stop": (Stop, {"contact_height_m": 0.286, "stiffness_n_per_m": 1.5e5}),
    "friction": (Friction, {"coulomb_force_n": 60.0}),
    "nonlinear_damping": (Orifice, {"damping_n_s2_per_m2": 1500.0}),
    "digressive": (Digressive, {"damping_n_s_per_m": 900.0, "knee_velocity_m_per_s": 0.15}),
    "hysteresis": (Yielding, {"yield_force_n": 120.0, "yield_displacement_m": 8e-4}),
    "maxwell": (Relaxing, {"stiffness_n_per_m": 4000.0, "relaxation_time_s": 0.05}),
    "fade": (Fade, {"final_fraction": 0.65, "time_constant_s": 4.0}),
    "periodic_force": (Ripple, {"amplitude_n": 12.0, "frequency_hz": 13.7}),
}
FAMILY = {
    "gas": "nonlinear_stiffness",
    "digressive": "nonlinear_damping",
    "maxwell": "hysteresis",
}
LONG = {"preload", "damping", "gas", "digressive", "maxwell", "fade", "periodic_force"}
CASES = [pytest.param(case, marks=pytest.mark.long if case in LONG else ()) for case in PLANTED]


@pytest.mark.parametrize("case", CASES)
def test_a_planted_effect_is_named_first(case):
    effect, truth = PLANTED[case]
    train, test = dyno.run(effect()), dyno.run(effect(), seed=2, duration_s=6.0, motion=dyno.later)
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    family = FAMILY.get(case, case)
    assert found.effects[0].family == family
    assert {e.family for e in found.effects} - LINEAR_FAMILIES <= {family}
    assert found.verdict == "explained"
    force = found.held_out.strut_force_rmse_n
    assert force is not None
    assert is_at_the_floor(found)
    assert force.before > 2.0 * force.after
    estimates = found.effects[0].parameters
    for name, value in truth.items():
        assert estimates[name].value == pytest.approx(value, rel=0.05)
        assert holds(estimates[name], value)


def test_a_complete_model_lacks_nothing():
    found = diagnose(dyno.model(), [dyno.run(Nothing())], [dyno.run(Nothing(), seed=2)])
    assert found.diagnosis.verdict == "nothing_missing"
    assert found.diagnosis.effects == ()
    assert found.diagnosis.linear == ()
    assert found.diagnosis.residual_white.before
    assert is_at_the_floor(found.diagnosis)
    assert found.corrected.struts == dyno.model().struts


@pytest.mark.long
def test_the_corrected_model_lacks_nothing():
    runs = [dyno.run(Yielding()), dyno.run(Yielding(), seed=2, motion=dyno.later)]
    corrected = diagnose(dyno.model(), runs[:1], runs[1:]).corrected
    again = diagnose(corrected, runs[1:], runs[:1]).diagnosis
    assert again.verdict == "nothing_missing"


class SteepStop(Nothing):
    """Grows with a power of 6: the laws of stops end at 4."""

    def force(self, t, z, v, state, warm):
        return 900.0 * (max(0.29 - z, 0.0) / 0.02) ** 6.0


def test_a_parameter_at_the_end_of_its_range_is_noted_and_has_an_open_interval():
    parameters = (
        "{contact_height_m: 0.28, force_at_10_mm_n: 300.0, exponent: 3.5, dissipation_s_per_m: 0}"
    )
    model = dyno.model(effects=f"[{{name: power_bump_stop, parameters: {parameters}}}]")
    runs = [dyno.run(SteepStop()), dyno.run(SteepStop(), seed=2)]
    found = diagnose(model, runs[:1], runs[1:]).diagnosis
    assert any(
        "exponent of power_bump_stop is at the upper end of its range (4" in n for n in found.notes
    )
    assert not any("lower end" in note for note in found.notes)
    (exponent,) = (item.parameters["exponent"] for item in found.existing)
    assert exponent.low is not None
    assert exponent.high is None


class Creep(Nothing):
    """A force at standstill that no law follows."""

    def force(self, t, z, v, state, warm):
        return 12.0 * math.sin(1.3 * t * t) * math.exp(-((v / 2e-3) ** 2))


@pytest.mark.slow
def test_a_force_that_remains_at_standstill_is_noted():
    runs = [dyno.run(Creep(), motion=dyno.resting), dyno.run(Creep(), seed=2, motion=dyno.resting)]
    notes = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis.notes
    assert any("at standstill" in note and "recording of motion alone" in note for note in notes)
    moving = [dyno.run(Friction()), dyno.run(Friction(), seed=2)]
    notes = diagnose(dyno.model(), moving[:1], moving[1:]).diagnosis.notes
    assert not any("standstill" in note for note in notes)


class FrictionAndHardening(Nothing):
    def force(self, t, z, v, state, warm):
        friction = -60.0 * v / math.sqrt(v * v + 4e-6)
        return friction + Hardening().force(t, z, v, state, warm)


@pytest.mark.slow
def test_friction_beside_a_hardening_spring_is_found_as_two():
    runs = [dyno.run(FrictionAndHardening()), dyno.run(FrictionAndHardening(), seed=2)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert {e.family for e in found.effects} == {"friction", "nonlinear_stiffness"}
    assert len(found.effects) == 2
    assert found.verdict == "explained"


class WrongConstantsAndFriction(Nothing):
    def force(self, t, z, v, state, warm):
        friction = -20.0 * v / math.sqrt(v * v + 4e-6)
        return friction - 700.0 * (z - FREE) - 90.0 * v + 25.0


def test_linear_constants_are_corrected_beside_a_law():
    runs = [dyno.run(WrongConstantsAndFriction()), dyno.run(WrongConstantsAndFriction(), seed=2)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert [e.family for e in found.effects] == ["friction"]
    assert len(missing(found)) == 1
    friction = named(found, "friction")
    assert friction.parameters["coulomb_force_n"].value == pytest.approx(20.0, rel=0.02)
    assert {item.parameter for item in found.linear} == {
        "stiffness_n_per_m",
        "damping_n_s_per_m",
        "preload_n",
    }
    stiffness = correction(found, "stiffness_n_per_m")
    assert stiffness.nominal == STIFFNESS
    assert stiffness.total.value - STIFFNESS == pytest.approx(700.0, rel=0.02)
    damping = correction(found, "damping_n_s_per_m")
    assert damping.nominal == DAMPING
    assert damping.total.value - DAMPING == pytest.approx(90.0, rel=0.03)
    preload = correction(found, "preload_n")
    assert preload.about_height_m == pytest.approx(MIDDLE, abs=0.01)
    # About mid-stroke, to which the stiffness adds.
    added_n = 25.0 - 700.0 * (preload.about_height_m - FREE)
    assert preload.total.value - preload.nominal == pytest.approx(added_n, rel=0.02)


def test_no_interval_is_finer_than_a_clock():
    exact = {"height_noise_m": 1e-12, "resolution_m": 1e-12, "force_noise_n": 1e-6}
    exact["duration_s"] = 4.0
    runs = [dyno.run(Stiffness(), **exact), dyno.run(Stiffness(), seed=2, **exact)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    total = correction(found, "stiffness_n_per_m").total
    assert total.value == pytest.approx(STIFFNESS + 900.0, rel=1e-3)
    assert total.high - total.value == pytest.approx(5e-5 * total.value, rel=0.3)


def test_a_model_without_spring_and_damper_gets_both():
    runs = [dyno.run(Nothing()), dyno.run(Nothing(), seed=2, motion=dyno.later)]
    found = diagnose(dyno.model(stiffness=0.0, damping=0.0), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "explained"
    assert missing(found) == []
    for parameter, truth in (("stiffness_n_per_m", STIFFNESS), ("damping_n_s_per_m", DAMPING)):
        assert holds(correction(found, parameter).total, truth)


def test_more_effects_than_a_simulation_carries_are_one_line():
    effects = ", ".join(11 * ["{name: preload, parameters: {force_n: 1.0}}"])
    model = dyno.model(effects=f"[{effects}]")
    with pytest.raises(RecordingError, match="little_dyno: 11 effects, expected at most 7"):
        diagnose(model, [dyno.run(Nothing())])


class Cogging(Nothing):
    def force(self, t, z, v, state, warm):
        return 40.0 * math.sin(2.0 * math.pi * z / 0.004)


@pytest.mark.long
def test_a_force_outside_the_catalogue_is_not_explained():
    runs = [dyno.run(Cogging()), dyno.run(Cogging(), seed=2, motion=dyno.later)]
    found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
    assert found.verdict in {"not_explained", "partly_explained"}


@pytest.mark.long
def test_an_interval_holds_the_truth():
    inside = 0
    for seed in range(20):
        runs = [dyno.run(Damping(), seed=seed, duration_s=5.0), dyno.run(Damping(), seed=99)]
        found = diagnose(dyno.model(), runs[:1], runs[1:]).diagnosis
        (effect,) = found.effects
        inside += holds(effect.parameters["damping_n_s_per_m"], 150.0, slack=0.0)
    assert inside >= 17


def test_without_a_part_to_hold_out_a_recording_is_refused():
    two_blocks = replace(CRITERIA, blocks=2)
    with pytest.raises(RecordingError, match="dyno1: no part with motion can be held out"):
        diagnose(dyno.model(), [dyno.run(dyno.Nothing(), duration_s=3.0)], criteria=two_blocks)
