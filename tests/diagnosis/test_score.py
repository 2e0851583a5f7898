"""The score test about a fitted model: what it promises, and what it sees beside dry friction."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dart_model.effects import effect
from dart_model.spec import MODELS, load_model
from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.numerics.least_squares import Effort
from rig.diagnosis.problem.build import build
from rig.diagnosis.problem.problem import free_linear, nominal, strut_constants
from rig.diagnosis.problem.track import forces_along
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.damper_with_friction import screen_damper_with_friction
from rig.diagnosis.search.fit import fit, law_values, model_for, project_out_fit
from rig.diagnosis.search.pool import FULL, Pool
from rig.diagnosis.search.score_test import (
    _Base,
    _remove_law_force,
    _replace_law,
    find_changes,
)
from rig.diagnosis.search.screen import is_compatible, linear_changes, no_law, rank_laws
from rig.recordings.read import read_recording
from tests.criteria_study.cases import Regressive
from tests.diagnosis import little_bench, little_dyno
from tests.diagnosis.mechanisms import QuarterCarWithFriction
from tests.diagnosis.test_planted_effects import FrictionAndHardening, FrictionAndValves
from tests.diagnosis.test_prescribed import Orifice

OF_FORCE = ("stiffness", "damping", "preload")
"""Linear parameters that are forces of a strut."""


def pool_of(bench, force, **kwargs):
    problem = build(bench.model(), [bench.run(force, **kwargs)], CRITERIA.blocks, None)
    given, linear = first_fits(problem)
    return Pool(problem, given, [linear], CRITERIA)


def with_laws(pool, **laws):
    """The model with laws that were fitted from where they are said to begin."""
    at = {(0, name): np.array(values) for name, values in laws.items()}
    candidate = nominal(pool.problem).with_effects(*at)
    pool.attempt(model_for(pool.problem, pool.linear.fit.model, candidate, at), FULL)
    return pool.fits[candidate].fit


def test_a_damper_that_drives_beyond_the_recorded_velocities_is_not_valid():
    pool = pool_of(little_dyno, Regressive())
    fitted = with_laws(pool, blow_off_damping=[1000.0, 0.1])
    assert law_values(pool.problem, fitted)[0, "blow_off_damping"][0] > 1000.0
    assert "at higher velocities" in pool.invalid[fitted.candidate]


def test_friction_and_valves_begin_where_the_motion_shows_both():
    pool = pool_of(little_bench, FrictionAndValves())
    stage = pool.linear_stage
    found = screen_damper_with_friction(stage, no_law(stage), 0)
    (coulomb_n, _), valves = found.values
    assert coulomb_n == pytest.approx(6.0, rel=0.2)
    linear = pool.linear.fit.parts.linear + linear_changes(stage, found)
    (damping,) = (
        change for change, p in zip(linear, pool.problem.linear, strict=True) if p.kind == "damping"
    )
    for v in (-0.4, -0.2, -0.1, 0.1, 0.2, 0.4):
        shown = effect("valve_damping").force(v, *valves) - damping * v
        true = FrictionAndValves().force(0.0, 0.0, v, ()) + math.copysign(6.0, v)
        assert shown == pytest.approx(true, abs=0.1 * 0.4 * little_bench.DAMPING)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("absurd", "is_named"), [({}, True), ({"dry": 1e9}, False), ({"slow": 0.0}, False)]
)
def test_beside_a_damper_friction_is_named_for_what_it_does_at_low_velocity(absurd, is_named):
    pool = pool_of(little_bench, FrictionAndValves())
    screening = screen_damper_with_friction(pool.linear_stage, no_law(pool.linear_stage), 0)
    pool.attempt_screening(pool.linear_stage, pool.linear, screening, FULL)
    (both,) = (model for model in pool.fits.values() if model.size == 2)
    friction = next(law for law in both.fit.candidate.new if law[1] != "valve_damping")
    damper = both.fit.candidate.without(friction)
    pool.attempt(model_for(pool.problem, both.fit.model, damper))
    pool.criteria = replace(CRITERIA, **absurd)
    assert pool.adds_dry_friction(pool.fits[damper], both) is is_named


def test_a_start_for_friction_needs_friction():
    pool = pool_of(little_dyno, Regressive())
    stage = pool.linear_stage
    found = screen_damper_with_friction(stage, no_law(stage), 0)
    assert found is None or found.values[0][0] < 1.0


def test_a_strut_has_one_damper_force_over_velocity():
    curve, other, zone = (
        (0, name) for name in ("power_damping", "blow_off_damping", "zone_damping")
    )
    assert not is_compatible(other, [curve])
    assert not is_compatible(other, [zone, curve])
    assert is_compatible((1, other[1]), [curve])
    assert is_compatible(zone, [curve])
    assert is_compatible(curve, [zone])
    assert not is_compatible(zone, [zone])


def changes_of(pool, fitted):
    return find_changes(pool.problem, fitted, pool.along, CRITERIA.most_laws)


def test_where_the_answer_is_linear_the_promise_is_what_a_fit_reaches():
    pool = pool_of(little_dyno, Orifice())
    found = changes_of(pool, pool.linear.fit)
    change = next(c for c in found if c.laws == ((0, "quadratic_damping"),))
    assert change is found[0] or found[0].cost > 0.5 * change.cost
    pool.attempt(change.model, FULL)
    cost = pool.fits[change.model.candidate].fit.solution.cost
    assert change.cost == pytest.approx(cost, rel=0.02)
    (reached,) = law_values(pool.problem, pool.fits[change.model.candidate].fit).values()
    assert change.model.parts.effects == pytest.approx(reached, rel=0.02)


def test_what_lies_beside_dry_friction_is_seen():
    pool = pool_of(little_bench, FrictionAndHardening())
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3])
    best = next(c for c in changes_of(pool, fitted) if len(c.laws) == 2)
    families = {effect(name).family for _, name in best.laws}
    assert families == {"friction", "nonlinear_stiffness"}
    assert best.cost < 0.3 * fitted.solution.cost


def test_a_like_law_begins_where_its_force_is_the_other_ones():
    pool = pool_of(little_bench, FrictionAndHardening())
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3])
    found = changes_of(pool, fitted)
    like = next(c for c in found if c.laws == ((0, "stribeck_friction"),))
    assert like.cost < 1.5 * fitted.solution.cost
    assert like.model.parts.effects[0] == pytest.approx(fitted.parts.effects[0], rel=0.3)


def test_a_formula_that_is_nowhere_like_that_of_the_model_is_no_change_of_it():
    pool = pool_of(little_bench, FrictionAndHardening())
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3], cubic_stiffness=[1e5])
    exchanges = [change.laws for change in changes_of(pool, fitted) if len(change.laws) == 2]
    others = {name for laws in exchanges for _, name in laws}
    assert {"stribeck_friction", "power_stiffness"} <= others
    assert {"quadratic_stiffness", "plateau_stiffness"}.isdisjoint(others)


def strut_force_n(pool, model):
    """Force of the whole strut along the motion, shape (N,), and linear forces (N, 3)."""
    (_, track), *_ = pool.along
    constants = strut_constants(pool.problem, model.parts.linear)
    ((free_m, stiffness, damping, _, preload_n),) = constants
    z, v = track.heights_m[0], track.velocities_m_per_s[0]
    force_n = preload_n - stiffness * (z - free_m) - damping * v
    for _, law_n in forces_along(pool.problem, model, [(0, track)]):
        force_n = force_n + law_n
    return force_n, np.column_stack([np.ones_like(z), z - z.mean(), v])


def test_another_formula_begins_beside_the_linear_part_that_makes_up_for_its_linear_force():
    """The noise is so large that other springs than the right one are alike, too."""
    pool = pool_of(little_bench, FrictionAndHardening(), noise_m=1e-3)
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3], cubic_stiffness=[1e5])
    before_n, linear_n = strut_force_n(pool, fitted.model)
    springs = [
        change
        for change in changes_of(pool, fitted)
        if len(change.laws) == 2 and (0, "cubic_stiffness") not in change.laws
    ]
    assert len(springs) > 2
    for change in springs:
        begun_n, _ = strut_force_n(pool, change.model)
        linear = np.linalg.lstsq(linear_n, begun_n - before_n, rcond=None)[0] * linear_n
        assert np.linalg.norm(linear, axis=0).max() < 1e-3 * np.linalg.norm(before_n)


@pytest.mark.parametrize("strut", [0, 1])
def test_another_formula_changes_the_linear_part_of_its_own_strut_alone(strut, tmp_path):
    car, spec = QuarterCarWithFriction(), load_model(MODELS / "quarter_car.yaml")
    run = read_recording(car.csv(tmp_path / "run.csv"), [item.name for item in spec.struts])
    problem = build(spec, [run], CRITERIA.blocks, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    at = {(strut, "coulomb_friction"): np.array([20.0, 1e-3])}
    candidate = nominal(problem).with_effects(*at)
    begun = model_for(problem, pool.linear.fit.model, candidate, at)
    fitted = fit(problem, begun, free_linear(problem, candidate), Effort(3))
    own = np.array([p.strut == strut and p.kind in OF_FORCE for p in problem.linear])
    assert own.sum() == len(OF_FORCE)
    tracks = tuple(track for _, track in pool.along)
    base = _Base(
        problem, fitted, tracks, strut_constants(problem, fitted.parts.linear),
        *project_out_fit(fitted), (problem, fitted.residual),
    )  # fmt: skip
    old = _remove_law_force(base, (strut, "coulomb_friction"))
    other = (strut, "stribeck_friction")
    begun = _replace_law(base, other, np.array([30.0, 1.5, 0.1, 1e-3]), old)
    moved = begun.parts.linear - fitted.parts.linear
    assert np.all(moved[~own] == 0.0)
    assert np.any(moved[own] != 0.0)


def test_what_a_linearisation_misses_of_a_model_it_misses_of_its_changes():
    pool = pool_of(little_bench, FrictionAndHardening())
    at = {(0, "coulomb_friction"): np.array([3.0, 1e-3])}
    candidate = nominal(pool.problem).with_effects(*at)
    begun = model_for(pool.problem, pool.linear.fit.model, candidate, at)
    ended_early = fit(pool.problem, begun, free_linear(pool.problem, candidate), Effort(0))
    shown = project_out_fit(ended_early)[1]
    missed = ended_early.solution.cost / float(shown @ shown)
    assert missed > 2.0
    for change in changes_of(pool, ended_early):
        assert change.missed == pytest.approx(missed)
        assert change.missed * change.unchanged == pytest.approx(ended_early.solution.cost)
        assert change.cost <= change.begin * (1.0 + 1e-9)


def test_no_change_holds_a_family_twice_or_the_law_it_stands_for():
    pool = pool_of(little_bench, FrictionAndHardening())
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3])
    for change in changes_of(pool, fitted):
        families = [effect(name).family for _, name in change.laws]
        assert change.model.candidate != fitted.candidate
        assert families.count("friction") <= 1
        assert change.cost >= 0.0


def test_a_model_with_as_many_laws_as_may_be_is_not_added_to():
    pool = pool_of(little_bench, FrictionAndHardening())
    fitted = with_laws(pool, coulomb_friction=[5.0, 1e-3])
    for change in find_changes(pool.problem, fitted, pool.along, 1):
        assert len(change.laws) == 1


def test_a_law_of_which_the_size_overflows_is_no_start():
    pool = pool_of(little_dyno, Orifice())
    stage = pool.linear_stage
    huge = stage._replace(target=1e160 * stage.target, coarse=None)
    assert rank_laws(huge, no_law(stage), 5, [(0, "quadratic_damping")]) == []
