"""What held-out data say of the laws of a model, and which laws they take back."""

import math
from types import SimpleNamespace

import pytest

from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.evaluate import HeldOutLaw
from rig.diagnosis.notes import notes_of_opposite_errors
from rig.diagnosis.outcome import (
    Estimate,
    HeldOut,
    LikelihoodGain,
    ModelErrors,
    NoiseFloor,
    RunFigures,
)
from rig.diagnosis.problem.problem import RunEvaluation
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.evidence import LeftOutGains
from rig.diagnosis.verdict import confirmation, confirmations, find_reason_against_laws
from tests.diagnosis import little_bench as bench

FLOOR_M = 1e-5
LAW = (0, "coulomb_friction")
CONFIRMED, IDLE = HeldOutLaw(1e4, 9e3), HeldOutLaw(3.0, -1.0)


class Stop(bench.Nothing):
    """An end stop that the full load reaches."""

    at, stiffness = 0.383, 9e4

    def force(self, t, z, v, state):
        return -self.stiffness * max(z - self.at, 0.0)


def gentle(t):
    return 0.3 * bench.load_n(t)


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (HeldOutLaw(29.0, 29.0), "not_exercised"),
        (HeldOutLaw(31.0, 12.0), "confirmed"),
        (HeldOutLaw(math.inf, math.inf), "confirmed"),
        (HeldOutLaw(500.0, -4.0), "contradicted"),
    ],
)
def test_a_law_counts_as_what_held_out_data_show_of_it(law, expected):
    assert confirmation(law, CRITERIA) == expected


class Fitted:
    """A linear fit far above the floor of what was learnt from."""

    mean_square, model = 1e4, None


class Learnt:
    def floor_level(self, model):
        return 1.0


def evaluation(after_m, linear_m, after_n=1.0, linear_n=1.0):
    heights = ModelErrors(5e-3, linear_m, after_m, 1e-2)
    forces = ModelErrors(5.0, linear_n, after_n, 10.0)
    figures = RunFigures("run", heights, forces, None)
    return RunEvaluation(figures, NoiseFloor(FLOOR_M, 0.1), 0.0, ())


def reason(after_m, linear_m, laws, after_n=1.0, linear_n=1.0):
    run = evaluation(after_m, linear_m, after_n, linear_n)
    return find_reason_against_laws(Learnt(), Fitted(), [run], laws, CRITERIA)


def test_laws_that_lose_to_the_best_linear_model_are_taken_back():
    assert reason(4e-4, 1e-3, {LAW: CONFIRMED}) is None
    why = reason(2e-3, 1e-3, {LAW: CONFIRMED})
    assert why is not None
    assert "2 times" in why


def test_laws_that_held_out_data_do_not_exercise_lose_nothing():
    assert reason(1.001e-3, 1e-3, {LAW: IDLE}) is None


def test_where_heights_drift_the_force_decides():
    assert reason(1.1e-3, 1e-3, {LAW: CONFIRMED}, after_n=0.5) is None
    assert reason(1.3e-3, 1e-3, {LAW: CONFIRMED}, after_n=0.5) is not None


MORE, OTHER = (0, "end_stops"), (0, "backlash")


def shown(after_m, linear_m=1e-1, laws=(OTHER, MORE, LAW), after_n=0.25):
    """What held-out data show of laws that they confirm, of which they need the first one most."""

    evidence = {
        law: LeftOutGains(LikelihoodGain((), gain, Estimate(2.0, 1.9, 2.1)), None)
        for law, gain in zip(laws, (9e5, 3e4, 2e3), strict=False)
    }
    found = confirmations(
        [evaluation(after_m, linear_m, after_n)],
        SimpleNamespace(evidence=evidence),
        dict.fromkeys(laws, CONFIRMED),
        CRITERIA,
    )
    return [found[law] for law in laws]


def test_near_the_floor_all_that_held_out_data_confirm_are_named():
    assert shown(4.5 * FLOOR_M, laws=(OTHER, LAW, (0, "maxwell"))) == ["confirmed"] * 3


def test_where_a_model_does_not_explain_one_of_the_laws_of_a_curve_is_named():
    assert shown(1.1 * FLOOR_M) == ["confirmed"] * 3
    assert shown(1.4 * FLOOR_M) == ["confirmed", "unsettled", "confirmed"]
    assert shown(1.4 * FLOOR_M, laws=(OTHER, (1, "end_stops"))) == ["confirmed"] * 2


def test_far_above_the_floor_only_the_law_that_data_need_most_is_named():
    assert shown(40.0 * FLOOR_M) == ["confirmed", "unsettled", "unsettled"]
    assert shown(40.0 * FLOOR_M, laws=(OTHER,)) == ["confirmed"]


def test_far_above_the_floor_a_law_without_other_formulas_is_not_named():
    assert shown(40.0 * FLOOR_M, laws=((0, "periodic_force"), MORE)) == ["unsettled"] * 2
    assert shown(4.5 * FLOOR_M, laws=((0, "periodic_force"), MORE)) == ["confirmed"] * 2


def test_far_above_the_floor_parts_of_one_curve_are_not_named():
    spring = (0, "power_stiffness")
    assert shown(40.0 * FLOOR_M, laws=(spring, OTHER)) == ["unsettled"] * 2
    assert shown(40.0 * FLOOR_M, laws=(spring, (1, "backlash"))) == ["confirmed", "unsettled"]
    assert shown(40.0 * FLOOR_M, laws=(LAW, spring, OTHER))[0] == "confirmed"
    stops = (0, "power_bump_stop"), (0, "power_rebound_stop")
    assert shown(40.0 * FLOOR_M, laws=stops) == ["unsettled"] * 2
    assert shown(4.5 * FLOOR_M, laws=(spring, OTHER)) == ["confirmed", "unsettled"]
    over_velocity = (0, "coulomb_friction"), (0, "saturating_damping")
    assert shown(4.5 * FLOOR_M, laws=over_velocity) == ["confirmed", "unsettled"]
    elsewhere = (0, "coulomb_friction"), (1, "saturating_damping")
    assert shown(4.5 * FLOOR_M, laws=elsewhere) == ["confirmed"] * 2


def test_none_is_named_that_leaves_much_of_what_the_linear_model_leaves():
    assert shown(40.0 * FLOOR_M, linear_m=1.2e-3, after_n=1.0) == ["unsettled"] * 3
    assert shown(40.0 * FLOOR_M, after_n=0.35) == ["unsettled"] * 3
    assert shown(4.5 * FLOOR_M, after_n=0.35, laws=(LAW,)) == ["confirmed"]
    # Heights drift: where they are about as far off, the force decides.
    assert shown(40.0 * FLOOR_M, linear_m=34.0 * FLOOR_M, laws=(LAW,)) == ["confirmed"]
    assert shown(40.0 * FLOOR_M, linear_m=33.0 * FLOOR_M, laws=(LAW,)) == ["unsettled"]


def test_what_held_out_data_do_not_exercise_stays_so_far_above_the_floor():
    search = SimpleNamespace(evidence={})
    found = confirmations([evaluation(1e-3, 0.1)], search, {LAW: IDLE}, CRITERIA)
    assert found == {LAW: "not_exercised"}


@pytest.fixture(scope="module")
def learnt():
    return [bench.run(Stop(), seed=1, duration_s=20.0)]


@pytest.mark.slow
def test_a_stop_that_held_out_runs_reach_is_confirmed_and_weighed(learnt):
    held_out = bench.run(Stop(), seed=2, duration_s=20.0)
    found = diagnose(bench.model(), learnt, [held_out]).diagnosis
    assert found.verdict == "explained"
    (effect,) = found.effects
    assert effect.family == "stop"
    assert effect.evidence.held_out == "confirmed"
    assert not effect.is_candidate
    assert effect.evidence.held_out_log_likelihood > 15.0
    without = effect.evidence.without
    assert without.over == ()
    assert without.error_ratio.value > 2.0
    assert 1.0 < without.error_ratio.low < without.error_ratio.value < without.error_ratio.high
    assert without.log_likelihood > 100.0
    rival = effect.evidence.rival
    assert rival is not None
    assert 1.0 < rival.error_ratio.low < rival.error_ratio.value <= without.error_ratio.value * 1.01
    heights = found.held_out.height_rmse_m
    assert heights.after < 0.5 * heights.linear
    assert heights.linear <= heights.before
    assert 1e-3 < heights.signal < 0.1
    assert found.left == pytest.approx(1.0 / without.error_ratio.value, rel=0.05)
    assert all(item.left >= found.left for item in found.rejected if item.left is not None)


@pytest.mark.slow
def test_a_stop_that_no_held_out_run_reaches_is_a_candidate(learnt):
    held_out = bench.run(Stop(), seed=2, duration_s=20.0, load=gentle)
    found = diagnose(bench.model(), learnt, [held_out]).diagnosis
    (effect,) = found.effects
    assert effect.family == "stop"
    assert effect.evidence.held_out == "not_exercised"
    assert effect.is_candidate
    assert found.verdict == "ambiguous"
    assert found.ambiguous_with == ()
    assert found.suggested_excitation


@pytest.mark.parametrize(("after_n", "notes"), [(0.5, 0), (1.05, 0), (1.5, 1)])
def test_a_force_that_rises_while_heights_come_nearer_is_noted(after_n, notes):
    heights = ModelErrors(1e-3, 1e-3, 1e-4, 1e-2)
    held_out = HeldOut(heights, ModelErrors(1.0, 1.0, after_n, 10.0), None, (), "runs")
    assert len(notes_of_opposite_errors(held_out)) == notes


@pytest.mark.slow
def test_a_recording_without_a_held_out_block_is_left_out():
    runs = [bench.run(Stop(), seed=2, duration_s=1.5), bench.run(Stop(), seed=1, duration_s=20.0)]
    found = diagnose(bench.model(), runs).diagnosis
    assert found.held_out.source == "blocks"
    assert [run.run for run in found.held_out.runs] == [runs[1].name]
    assert [effect.evidence.held_out for effect in found.effects] == ["confirmed"]
