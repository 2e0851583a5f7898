"""Change-points, wear, outliers and jumps of a bench: found where planted, quiet elsewhere."""

import math

import numpy as np
import pytest

from rig.fleet.trends import (
    LEVEL,
    DatedValue,
    find_bench_jump,
    find_change_point,
    find_outliers,
    fit_drift,
    without_step,
)

WEEKS, DAMPERS, FAILS = 52, 40, 30


def series(factor, scatter, rng):
    return [
        DatedValue(7.0 * week, 20.0 * factor(week) * (1.0 + scatter * rng.standard_normal()))
        for week in range(WEEKS)
    ]


@pytest.mark.long
def test_without_a_change_it_is_found_as_often_as_its_level_says():
    rng = np.random.default_rng(1)
    p = np.array([find_change_point(series(lambda _: 1.0, 0.02, rng)).p for _ in range(1000)])
    # Binomial: 1000 draws at 10 % and 1 %, four standard deviations.
    assert abs(np.mean(p < 0.1) - 0.1) < 4.0 * math.sqrt(0.09 / 1000)
    assert np.mean(p < 0.01) < 0.01 + 4.0 * math.sqrt(0.0099 / 1000)


def test_wear_is_a_drift_and_no_change():
    """Friction up 2 % a week all the while."""
    rng = np.random.default_rng(2)
    covered = 0
    for _ in range(DAMPERS):
        points = series(lambda week: 1.0 + 0.02 * week, 0.02, rng)
        assert find_change_point(points).p > LEVEL / DAMPERS
        line = fit_drift(points)
        assert line.p < 1e-12
        covered += line.low < 0.02 * 20.0 / 7.0 < line.high
    assert covered >= 0.85 * DAMPERS


@pytest.mark.slow
@pytest.mark.parametrize("scatter", [0.005, 0.01, 0.02])
@pytest.mark.parametrize(
    ("kind", "factor"),
    [
        ("bend", lambda week: 1.0 + 0.02 * max(0, week - FAILS)),
        ("step", lambda week: 1.15 if week >= FAILS else 1.0),
        ("bend", lambda week: 1.0 + 0.01 * week + 0.03 * max(0, week - FAILS)),
    ],
)
def test_a_seal_that_fails_is_dated_within_two_weeks(kind, factor, scatter):
    """In 95 of 100, and found in all; the seed of each is its number."""
    errors = []
    for seed in range(40):
        change = find_change_point(series(factor, scatter, np.random.default_rng(seed)))
        assert change.p < LEVEL / DAMPERS
        assert change.kind == kind
        errors.append(abs(change.day / 7.0 - FAILS))
    assert np.percentile(errors, 95) <= 2.0


@pytest.mark.long
def test_the_interval_of_a_date_covers_it():
    inside = 0
    for seed in range(300):
        points = series(
            lambda week: 1.0 + 0.02 * max(0, week - FAILS), 0.02, np.random.default_rng(seed)
        )
        change = find_change_point(points)
        inside += change.low <= 7.0 * FAILS <= change.high
    assert inside / 300 > 0.89


def test_short_and_still_series_have_no_change():
    assert find_change_point([DatedValue(float(k), 1.0) for k in range(9)]) is None
    assert find_change_point([DatedValue(3.0, 1.0 + k) for k in range(20)]) is None
    assert fit_drift([DatedValue(1.0, 2.0), DatedValue(2.0, 3.0)]) is None
    assert find_change_point([DatedValue(float(k), 5.0) for k in range(20)]).p > 0.9


@pytest.mark.long
@pytest.mark.parametrize("members", [6, 40, 1000])
def test_outliers_are_as_rare_as_their_level_where_there_are_none(members):
    rng = np.random.default_rng(3)
    fleets = 400
    alarms = sum(
        bool(find_outliers({str(k): v for k, v in enumerate(rng.standard_normal(members))}, 0.05))
        for _ in range(fleets)
    )
    assert alarms / fleets < 0.05 + 4.0 * math.sqrt(0.05 * 0.95 / fleets)


def test_two_bad_ones_do_not_hide_each_other():
    rng = np.random.default_rng(4)
    values = {f"A{k}": 20.0 + 0.3 * rng.standard_normal() for k in range(40)}
    values |= {"A3": 24.0, "A9": 25.0}
    assert set(find_outliers(values, 0.01)) == {"A3", "A9"}


def bench(jump, rng, *, dampers=10, own=None):
    found = {}
    for damper in range(dampers):
        level = math.log(8000.0) + 0.05 * rng.standard_normal()
        found[f"A{damper}"] = [
            DatedValue(
                7.0 * week,
                level
                + (jump if week >= FAILS else 0.0)
                + (0.2 if own == damper and week >= FAILS else 0.0)
                + 0.005 * rng.standard_normal(),
            )
            for week in range(WEEKS)
        ]
    return found


def test_a_load_cell_that_jumps_is_the_benchs_and_not_its_dampers():
    series_of = bench(math.log(1.03), np.random.default_rng(5))
    jump = find_bench_jump(series_of, LEVEL)
    assert jump is not None
    assert jump.day == 7.0 * FAILS
    assert math.exp(jump.after - jump.before) == pytest.approx(1.03, abs=0.003)


def test_one_damper_that_changes_is_no_jump_of_its_bench():
    assert find_bench_jump(bench(0.0, np.random.default_rng(6), own=3), LEVEL) is None
    assert find_bench_jump(bench(0.0, np.random.default_rng(7)), LEVEL) is None
    assert find_bench_jump({}, LEVEL) is None


def test_a_jump_is_seen_beside_wear():
    found = bench(math.log(1.03), np.random.default_rng(8))
    worn = {
        name: [point._replace(value=point.value + 0.0003 * point.day) for point in points]
        for name, points in found.items()
    }
    jump = find_bench_jump(worn, LEVEL)
    assert jump is not None
    assert math.exp(jump.after - jump.before) == pytest.approx(1.03, abs=0.004)


@pytest.mark.long
@pytest.mark.parametrize("wear", [0.0, 0.02])
def test_in_a_fleet_of_forty_only_the_failing_seal_is_accused(wear):
    """Ten fleets, with and without a wear of 2 % a week that all of them have.

    Of 390 others 0.1 are expected at this level; two or more would be one chance in 200.
    """
    accused = 0
    for seed in range(10):
        rng = np.random.default_rng([7, seed])
        for damper in range(DAMPERS):
            fails = 0.02 if damper == 5 else 0.0

            def factor(week, fails=fails):
                return 1.0 + wear * week + fails * max(0, week - FAILS)

            change = find_change_point(series(factor, 0.01, rng))
            if damper == 5:
                assert change.p < LEVEL / DAMPERS
                assert abs(change.day / 7.0 - FAILS) <= 2.0
            else:
                accused += change.p < LEVEL / DAMPERS
    assert accused <= 1


def test_a_slope_beside_a_step_of_the_bench_is_as_wide_as_it_is():
    """Its interval covers the truth; without the step among what is unknown it would not."""
    rng = np.random.default_rng(9)
    covered = 0
    for _ in range(300):
        points = [
            DatedValue(
                7.0 * week, 20.0 + 0.01 * week + 0.5 * (week >= FAILS) + 0.2 * rng.standard_normal()
            )
            for week in range(WEEKS)
        ]
        line = fit_drift(without_step(points, 7.0 * FAILS), 7.0 * FAILS)
        covered += line.low < 0.01 / 7.0 < line.high
    assert abs(covered / 300 - 0.95) < 4.0 * math.sqrt(0.05 * 0.95 / 300)
