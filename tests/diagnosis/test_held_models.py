"""Models that are held to the measured motion: their errors do not add up."""

import numpy as np
import pytest

from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.problem import free_linear, nominal, rms
from rig.diagnosis.progress import no_progress
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.fit import fit
from rig.diagnosis.search.pool import FULL, Pool, _is_stuck
from rig.diagnosis.search.score_test import ModelChange
from rig.diagnosis.search.validity import smooth_tracks
from tests.diagnosis import little_bench as bench
from tests.diagnosis.test_derivatives import model_with

PRELOAD_N = 5.0
DAMPING = 4.0
GAP_M = 0.06


class WidePlay(bench.Nothing):
    """Hardly damped, and with so much play that neighbouring motions soon part."""

    fine = 40

    def force(self, t, z, v, state):
        slack_m = min(max(z - 0.4, -0.5 * GAP_M), 0.5 * GAP_M)
        return (bench.DAMPING - DAMPING) * v + bench.STIFFNESS * slack_m


def problem_of(effect, damping=bench.DAMPING, **kwargs):
    record = bench.run(effect, noise_m=1e-6, gravity=0.0, **kwargs)
    return build_without_delays(bench.model(gravity=0.0, damping=damping), [record], 32, None)


@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
def test_a_constant_force_bends_a_held_model_against_its_spring_and_the_holding_one(share):
    problem = problem_of(bench.Nothing())
    given = first_fits(problem)[0]
    held = problem.held_to(smooth_tracks(problem, given), share)
    forces = [PRELOAD_N * (p.kind == "preload") for p in problem.linear]
    wrong = given.model.with_linear(np.array(forces))
    rate = share * problem.runs[0].fastest
    stiffness = bench.STIFFNESS + bench.MASS * rate**2
    settled = len(held.residual(0, wrong)) // 2
    bent_m = float(np.mean(held.residual(0, wrong)[settled:] * held.noise_m[0]))
    assert bent_m == pytest.approx(-PRELOAD_N / stiffness, rel=0.01)


def test_a_right_model_is_not_moved_by_what_holds_it():
    problem = problem_of(bench.Nothing())
    given = first_fits(problem)[0]
    held = problem.held_to(smooth_tracks(problem, given), 1.0)
    assert rms(held.residual(0, given.model)) < 1.05 * rms(problem.residual(0, given.model))


@pytest.mark.parametrize("promised", [1.0, 1000.0])
def test_a_fit_finds_a_free_run_from_which_it_parts_where_it_begins(promised):
    """A mean square of 1000 is no nearly right model, but far less than the linear one leaves."""
    problem = problem_of(
        WidePlay(), damping=DAMPING, duration_s=20.0, load=lambda t: 0.3 * bench.load_n(t)
    )
    given, linear = first_fits(problem)
    law = (0, "free_play")
    candidate = nominal(problem).with_effects(law)
    begun = model_with(problem, {law: np.array([0.4, 1.01 * GAP_M])}, {})
    directly = fit(problem, begun, free_linear(problem, candidate), FULL)
    assert directly.mean_square > 1e6
    pool = Pool(problem, given, [linear], CRITERIA)
    pool.attempt_changes(
        [ModelChange(begun, promised * directly.rows, promised * directly.rows)], no_progress
    )
    found = pool.fits[candidate].fit
    assert found.mean_square < 1.5
    assert found.parts.effects == pytest.approx([0.4, GAP_M], rel=1e-4)


def test_a_fit_that_promised_no_more_than_the_best_model_is_left_where_it_ends():
    problem = problem_of(
        WidePlay(), damping=DAMPING, duration_s=20.0, load=lambda t: 0.3 * bench.load_n(t)
    )
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    law = (0, "free_play")
    begun = model_with(problem, {law: np.array([0.4, 1.01 * GAP_M])}, {})
    pool.attempt_changes([ModelChange(begun, pool.linear.cost, pool.linear.cost)], no_progress)
    assert pool.fits[nominal(problem).with_effects(law)].fit.mean_square > 1e3


def test_a_fit_is_stuck_where_its_linearisation_promises_much_less_than_the_best_model():
    problem = problem_of(WidePlay(), damping=DAMPING, duration_s=4.0)
    law = (0, "free_play")
    candidate = nominal(problem).with_effects(law)
    begun = model_with(problem, {law: np.array([0.4, 1.0001 * GAP_M])}, {})
    free = free_linear(problem, candidate)
    ended_early, converged = (fit(problem, begun, free, effort) for effort in (Effort(0), FULL))
    assert converged.mean_square < 1.5
    assert ended_early.mean_square > 3.0
    assert _is_stuck(ended_early, np.inf)
    assert not _is_stuck(ended_early, 0.5 * converged.solution.cost)
    assert not _is_stuck(converged, np.inf)
