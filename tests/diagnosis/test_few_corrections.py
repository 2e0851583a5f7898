"""Which linear corrections a model keeps."""

from types import SimpleNamespace

import numpy as np
import pytest

from rig.diagnosis.diagnose import first_fits
from rig.diagnosis.problem.build import build
from rig.diagnosis.search import model_selection
from rig.diagnosis.search.criteria import CRITERIA
from rig.diagnosis.search.pool import Pool
from tests.diagnosis import little_bench as bench

SHARE = 1.1
"""Damping of the bench over that of the model file."""


def corrections(monkeypatch, *, first):
    """Kinds of the corrections that stay, where a first look keeps those of some kinds."""
    record = bench.run(bench.Nothing(), noise_m=1e-5, duration_s=8.0)
    model = bench.model(damping=bench.DAMPING / SHARE)
    problem = build(model, [record], 32, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    looked_at, significant = [], model_selection._significant_parameters

    def look(result, deviations):
        found = significant(result, deviations)
        if not looked_at:
            found = found | np.array([p.kind in first for p in problem.linear])
        looked_at.append(result)
        return found

    monkeypatch.setattr(model_selection, "_significant_parameters", look)
    kept = model_selection._with_significant_corrections(pool, pool.linear)
    return {p.kind for p, free in zip(problem.linear, kept.fit.free, strict=True) if free}


def test_corrections_that_differ_from_zero_stay_alone(monkeypatch):
    assert corrections(monkeypatch, first=()) == {"damping"}


def with_gain(mass):
    """Corrections where the recorded force is a quarter larger than that of the model's bench.

    All is then a quarter larger than in the model file, but for what is missing of the mass.
    """
    record = bench.run(bench.Nothing(), noise_m=1e-5, duration_s=8.0)
    known = {"mass": mass / 1.25, "stiffness": bench.STIFFNESS / 1.25}
    model = bench.model(damping=bench.DAMPING / 1.25, gravity=0.0, **known)
    problem = build(model, [record], 32, None)
    given, linear = first_fits(problem)
    pool = Pool(problem, given, [linear], CRITERIA)
    few = model_selection._with_few_corrections(pool, pool.linear)
    kinds = [p.kind for p in problem.linear]

    def free(model):
        return {kind for kind, is_free in zip(kinds, model.fit.free, strict=True) if is_free}

    return free(few.model), [free(rival) for rival in few.rivals]


def test_a_gain_stands_for_corrections_in_one_proportion():
    kept, rivals = with_gain(bench.MASS)
    assert "gain" in kept
    assert kept.isdisjoint({"mass", "stiffness", "damping"})
    assert rivals == []


@pytest.mark.parametrize(("clock", "is_gain"), [(1e-2, True), (0.0, False)])
def test_a_gain_stands_for_corrections_in_one_proportion_as_well_as_clocks_run(
    monkeypatch, clock, is_gain
):
    """Although the corrections describe the data better: by what integration errs, say."""
    prefers = Pool.prefers

    def prefer_corrections(pool, one, other):
        gains = [p.kind == "gain" for p in pool.problem.linear]
        return bool(np.any(other.fit.free & gains)) or prefers(pool, one, other)

    monkeypatch.setattr(model_selection, "CLOCK", clock)
    monkeypatch.setattr(Pool, "prefers", prefer_corrections)
    kept, _ = with_gain(bench.MASS)
    assert ("gain" in kept) == is_gain


def test_a_gain_that_takes_the_mass_farther_is_a_rival_of_corrections_in_one_proportion():
    kept, (rival,) = with_gain(1.2 * bench.MASS)
    assert {"stiffness", "damping"} <= kept
    assert "gain" not in kept
    assert {"gain", "mass"} <= rival
    assert rival.isdisjoint({"stiffness", "damping"})


def test_a_correction_that_is_zero_once_others_are_gone_goes_too(monkeypatch):
    assert corrections(monkeypatch, first=("mass", "stiffness")) == {"damping"}


@pytest.mark.parametrize(("share", "is_kept"), [(6e-5, True), (4e-5, False)])
def test_a_correction_that_is_finer_than_a_clock_is_none(monkeypatch, share, is_kept):
    """Crystals are right to 50 ppm."""
    problem = build(bench.model(), [bench.run(bench.Nothing(), duration_s=8.0)], 32, None)
    linear = np.array([share * p.nominal if p.kind == "mass" else 1.0 for p in problem.linear])
    result = SimpleNamespace(parts=SimpleNamespace(linear=linear))
    monkeypatch.setattr(model_selection, "_significant_parameters", lambda *_: linear != 0.0)
    pool = SimpleNamespace(problem=problem, criteria=CRITERIA)
    kept = model_selection._significant_corrections(pool, result)
    assert {p.kind for p, free in zip(problem.linear, kept, strict=True) if not free} == (
        set() if is_kept else {"mass"}
    )
