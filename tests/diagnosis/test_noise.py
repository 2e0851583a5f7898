"""Noise, outliers and rests: what is no effect is given no name, what is one is found beside it."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from rig.diagnosis.diagnose import diagnose, first_fits
from rig.diagnosis.problem.build import build_problems
from rig.diagnosis.problem.problem import rms, rms_about_mean
from rig.diagnosis.search.criteria import CRITERIA
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.answers import is_at_the_floor, missing
from tests.diagnosis.driven import driven_by


class Friction(bench.Nothing):
    def force(self, t, z, v, state):
        return -6.0 * math.tanh(v / 3e-3)


class DynoFriction(dyno.Nothing):
    def force(self, t, z, v, state, warm):
        return -60.0 * math.tanh(v / 3e-3)


class Knock(bench.Nothing):
    """A stiff stop which the bench touches in the held-out recording only."""

    def force(self, t, z, v, state):
        return max(0.0, 2e4 * (0.335 - z))


def with_force_noise(record, seed, noise_n):
    rng = np.random.default_rng(seed)
    noise = rng.normal(0.0, noise_n, len(record.t_s))
    return replace(record, inputs=driven_by(record.applied_force_n + noise))


def test_noise_of_the_recorded_force_is_no_effect():
    runs = [
        with_force_noise(bench.run(bench.Nothing(), seed=seed), seed + 50, 1.0) for seed in (1, 2)
    ]
    found = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "nothing_missing"
    assert found.effects == ()


@pytest.mark.parametrize(("noise_n", "is_predictable"), [(1.0, True), (300.0, False)])
def test_noise_of_the_force_excuses_no_more_than_a_tenth_of_the_motion(noise_n, is_predictable):
    run = with_force_noise(bench.run(bench.Nothing()), 51, noise_n)
    problem = build_problems(bench.model(), [run], [], CRITERIA.blocks, 5).learnt
    disturbances_m = problem.disturbances_m(0, first_fits(problem)[0].model, 4)
    largest_m = max(rms(it) for it in disturbances_m)
    motion_m = rms_about_mean(problem.grids[0].heights_m)
    assert largest_m <= (1.0 + 1e-9) * 0.1 * motion_m
    assert (largest_m < 0.099 * motion_m) is is_predictable


@pytest.mark.long
def test_an_effect_is_found_beside_noise_of_the_recorded_force():
    runs = [with_force_noise(bench.run(Friction(), seed=seed), seed + 50, 1.0) for seed in (1, 2)]
    found = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    assert [effect.family for effect in found.effects] == ["friction"]
    friction = found.effects[0].parameters["coulomb_force_n"]
    assert friction.value == pytest.approx(6.0, rel=0.05)
    assert is_at_the_floor(found)


def noisy_dyno(effect):
    return [
        dyno.run(effect, seed=1, height_noise_m=1e-5),
        dyno.run(effect, seed=2, height_noise_m=1e-5, motion=dyno.later),
    ]


def test_noise_of_a_prescribed_height_is_no_effect():
    train, test = noisy_dyno(dyno.Nothing())
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    assert found.verdict == "nothing_missing"
    assert found.effects == ()


def test_friction_is_explained_beside_noise_of_a_prescribed_height():
    train, test = noisy_dyno(DynoFriction())
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    assert [effect.family for effect in found.effects] == ["friction"]
    assert found.verdict == "explained"
    friction = found.effects[0].parameters["coulomb_force_n"]
    assert friction.value == pytest.approx(60.0, rel=0.03)
    assert is_at_the_floor(found)


def with_outliers(record, seed=7):
    """The same with 0.5 % of its heights 5 mm off, and how many those are."""
    rng = np.random.default_rng(seed)
    count = round(0.005 * len(record.t_s))
    rows = rng.choice(len(record.t_s), count, replace=False)
    heights = record.heights_m.copy()
    heights[rows, 0] += rng.choice([-5e-3, 5e-3], count)
    return replace(record, heights_m=heights), count


def counted(notes):
    """Numbers in the notes that speak of outliers."""
    said = " ".join(note for note in notes if "outlier" in note.lower())
    return [int(number) for number in re.findall(r"\b\d+\b", said)]


@pytest.mark.slow
def test_outliers_change_nothing_and_are_counted():
    clean, test = bench.run(Friction()), bench.run(Friction(), seed=2, duration_s=6.0)
    train, count = with_outliers(clean)
    one = diagnose(bench.model(), [clean], [test]).diagnosis
    other = diagnose(bench.model(), [train], [test]).diagnosis
    assert missing(one) == missing(other)
    assert one.effects[0].family == "friction"
    assert other.verdict == one.verdict
    assert is_at_the_floor(other)
    before, after = (d.effects[0].parameters["coulomb_force_n"] for d in (one, other))
    assert after.value == pytest.approx(before.value, rel=0.01)
    assert counted(one.notes) == []
    assert any(abs(number - count) <= 1 for number in counted(other.notes))


@pytest.mark.long
def test_outliers_of_a_complete_bench_are_no_effect():
    train, count = with_outliers(bench.run(bench.Nothing()))
    test, _ = with_outliers(bench.run(bench.Nothing(), seed=2), seed=8)
    found = diagnose(bench.model(), [train], [test]).diagnosis
    assert found.verdict == "nothing_missing"
    assert any(number >= count - 1 for number in counted(found.notes))


@pytest.mark.slow
def test_a_model_that_fails_on_held_out_data_does_not_lack_nothing():
    def quiet_n(t):
        return 0.2 * bench.load_n(t)

    train = bench.run(Knock(), load=quiet_n)
    assert train.heights_m.min() > 0.336  # the stop is never touched
    test = bench.run(Knock(), seed=2)
    found = diagnose(bench.model(), [train], [test]).diagnosis
    assert found.held_out.height_rmse_m.before > 100.0 * found.noise_floor.height_rmse_m
    assert found.verdict not in {"nothing_missing", "explained"}


@pytest.mark.parametrize(
    "effect",
    [dyno.Nothing(), pytest.param(DynoFriction(), marks=pytest.mark.long)],
    ids=["complete", "friction"],
)
def test_a_strut_that_rests_at_an_end_of_its_stroke_is_accepted(effect):
    train, test = (
        dyno.run(effect, seed=seed, motion=dyno.resting, height_noise_m=0.0, resolution_m=2e-6)
        for seed in (1, 2)
    )
    at_the_end = train.heights_m[:, 0] == train.heights_m.min()
    assert at_the_end.sum() > 3 * 1.6 * 500  # several rests, each exactly at one height
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    if isinstance(effect, DynoFriction):
        assert [item.family for item in found.effects] == ["friction"]
        assert found.verdict == "explained"
    else:
        assert found.verdict == "nothing_missing"
