"""Near the noise floor every other formula for a law is tried, and further laws that tie."""

from types import SimpleNamespace

import numpy as np
import pytest

from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.progress import no_progress
from rig.diagnosis.search import pool as pool_module
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.explore import _promising, _try_formulas
from rig.diagnosis.search.pool import Pool
from rig.diagnosis.search.score_test import ModelChange
from tests.diagnosis import little_bench as bench
from tests.diagnosis.test_derivatives import model_with

COEFFICIENT, EXPONENT = 60.0, 1.75


class Orifice(bench.Nothing):
    """Between a laminar and a turbulent flow."""

    def force(self, t, z, v, state):
        return -COEFFICIENT * np.sign(v) * np.abs(v) ** EXPONENT


def pool_of(noise_m):
    """The linear model, and a damper whose force goes with the square of the velocity."""
    record = bench.run(Orifice(), noise_m=noise_m, gravity=0.0, duration_s=8.0)
    problem = build_without_delays(bench.model(gravity=0.0), [record], 32, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    pool.attempt(model_with(problem, {(0, "quadratic_damping"): np.array([COEFFICIENT])}, {}))
    return pool


def test_a_damper_that_is_nearly_right_gives_way_to_the_right_formula():
    pool = pool_of(noise_m=1e-5)
    assert not pool.at_floor(pool.least())
    _try_formulas(pool)
    found = pool.least()
    assert pool.at_floor(found)
    assert found.fit.candidate.new == ((0, "power_damping"),)
    assert found.fit.parts.effects == pytest.approx([COEFFICIENT, EXPONENT], rel=0.02)


@pytest.mark.parametrize("noise_m", [1e-3, 1e-7])
def test_at_the_floor_and_far_above_it_no_formula_is_tried(noise_m):
    pool = pool_of(noise_m)
    fitted = set(pool.fits)
    _try_formulas(pool)
    assert set(pool.fits) == fitted


def test_a_change_that_a_fit_has_surpassed_is_not_fitted():
    """The second two changes promise three and five times what the first one reaches."""
    pool = pool_of(noise_m=1e-5)
    rows = pool.linear.fit.rows
    laws = {
        "power_damping": ([COEFFICIENT, EXPONENT], 1.0),
        "quadratic_damping": ([COEFFICIENT], 1.0),
        "cubic_stiffness": ([1.0], 3.0),
        "quadratic_stiffness": ([1.0], 5.0),
    }
    changes = [
        ModelChange(model_with(pool.problem, {(0, name): np.array(values)}, {}), cost, cost)
        for name, (values, times) in laws.items()
        for cost in [times * rows]
    ]
    pool.attempt_changes(changes, no_progress)
    fitted = {name for candidate in pool.fits for _, name in candidate.new}
    assert fitted == set(laws) - {"quadratic_stiffness"}


def test_a_rough_fit_that_leaves_least_is_converged_before_it_is_judged(monkeypatch):
    """Where it ends after a single step it has a defect."""
    monkeypatch.setattr(pool_module, "ROUGH", Effort(1, 1e-3, 1))
    law = (0, "power_damping")

    monkeypatch.setattr(
        pool_module,
        "find_defect",
        lambda _, it, *__: "far" if law in it.candidate.new and it.mean_square > 1.3 else None,
    )
    pool = pool_of(noise_m=1e-5)
    begun = model_with(pool.problem, {law: np.array([COEFFICIENT, 1.9])}, {})
    pool.attempt(begun, pool_module.ROUGH)
    assert begun.candidate not in pool.invalid
    assert begun.candidate in pool.converged
    assert pool.least().fit.mean_square < 1.3


def test_what_promises_as_much_as_the_best_further_law_is_fitted_too():
    friction = (0, "stribeck_friction")

    def change(cost, name):
        return SimpleNamespace(cost=cost, begin=cost, laws=(friction, (0, name)))

    promised = {
        "stroke_damping": 100.0,
        "end_zone_damping": 100.5,
        "position_dependent_damping": 101.0,
        "cubic_stiffness": 102.0,
        "zone_damping": 150.0,
    }
    changes = [change(cost, name) for name, cost in promised.items()]
    fitted = {it.laws[1][1] for it in _promising(changes, [friction], 4, 110.0)}
    assert fitted == set(promised) - {"zone_damping"}


def test_what_promises_as_much_as_the_best_exchange_is_fitted_too():
    play, spring = (0, "backlash"), (0, "power_stiffness")
    names = ("cubic_stiffness", "quadratic_stiffness", "exponential_stiffness")
    alike = [SimpleNamespace(cost=100.0, begin=100.0, laws=(play, (0, name))) for name in names]
    worse = SimpleNamespace(cost=106.0, begin=106.0, laws=(play, (0, "progressive_stiffness")))
    assert _promising([*alike, worse], [play, spring], 4, np.inf) == alike


def test_further_laws_that_tie_without_gaining_what_a_law_has_to_are_two_of_a_family_and_few():
    friction = (0, "stribeck_friction")
    names = ("stroke_damping", "end_zone_damping", "valve_damping", "zone_damping")
    alike = [SimpleNamespace(cost=100.0, begin=100.0, laws=(friction, (0, name))) for name in names]
    assert _promising(alike, [friction], 4, 101.0) == alike
    assert _promising(alike, [friction], 4, 99.0) == alike[:2]


@pytest.mark.parametrize(("exponent", "is_preferred"), [(2.0, True), (1.75, False)])
def test_a_tone_counts_beside_a_law_if_it_leaves_noise(exponent, is_preferred):
    """Where it does not, it may stand in for what the formula of the law lacks."""

    class Humming(bench.Nothing):
        def force(self, t, z, v, state):
            tone_n = 0.3 * np.sin(2.0 * np.pi * 17.3 * t)
            return tone_n - COEFFICIENT * np.sign(v) * np.abs(v) ** exponent

    record = bench.run(Humming(), noise_m=1e-6, gravity=0.0, duration_s=8.0)
    problem = build_without_delays(bench.model(gravity=0.0), [record], 32, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    laws = {(0, "quadratic_damping"): np.array([COEFFICIENT])}
    pool.attempt(model_with(problem, laws, {}))
    laws[0, "periodic_force"] = np.array([0.3, 17.3, 0.0])
    pool.attempt(model_with(problem, laws, {}))
    alone, beside = sorted(
        (it for it in pool.fits.values() if it.size), key=lambda model: model.size
    )
    assert pool.is_formula(alone)
    assert not pool.at_floor(alone)
    assert pool.prefers(beside, alone) == is_preferred
