"""The scatter of all dampers, and what a report says that it cannot see."""

import datetime

import numpy as np
import pytest
from scipy.stats import t as student

from rig.fleet import store
from rig.fleet.one_run import RunRow, RunValue
from rig.fleet.overview import read_overview
from rig.fleet.scatter import POWER, Scatter, common_scatter
from rig.fleet.sentences import alarm_sentences, power_rows
from rig.fleet.trends import DatedValue, fit_drift
from rig.pages.fleet_page import write_fleet_page
from tests.fleet.population import FIRST
from tests.fleet.power import study


@pytest.mark.parametrize("freedom", [4.0, 20.0])
def test_the_distribution_of_variances_is_found_again(freedom):
    rng = np.random.default_rng(1)
    own = [
        Scatter(9.0 * freedom / rng.chisquare(freedom) * rng.chisquare(6) / 6.0, 6.0)
        for _ in range(4000)
    ]
    common = common_scatter(own)
    assert common.variance == pytest.approx(9.0, rel=0.05)
    assert common.freedom == pytest.approx(freedom, rel=0.25)


def test_dampers_that_scatter_alike_share_one_scatter():
    rng = np.random.default_rng(2)
    common = common_scatter([Scatter(4.0 * rng.chisquare(2) / 2.0, 2.0) for _ in range(2000)])
    assert common.freedom > 100.0
    assert common.variance == pytest.approx(4.0, rel=0.1)
    assert Scatter(1.0, 2.0).pooled(common).variance == pytest.approx(4.0, rel=0.1)


def test_of_few_or_exact_series_there_is_none():
    assert common_scatter([Scatter(1.0, 3.0)] * 3) is None
    assert common_scatter([Scatter(0.0, 3.0)] * 30) is None


@pytest.mark.parametrize("runs", [4, 8, 30])
def test_a_visible_slope_is_seen_as_often_as_stated(runs):
    """In series whose scatter is known from the series alone."""
    rng = np.random.default_rng(3)
    level, count = 0.01, 3000
    days = 7.0 * np.arange(runs)
    seen = 0
    for _ in range(count):
        values = rng.standard_normal(runs)
        line = fit_drift([DatedValue(*pair) for pair in zip(days, values, strict=True)])
        more = values + line.visible_per_day(level) * days
        drifted = fit_drift([DatedValue(*pair) for pair in zip(days, more, strict=True)])
        seen += drifted.p < level
    assert seen / count == pytest.approx(POWER, abs=4.0 * (POWER * (1.0 - POWER) / count) ** 0.5)


def test_a_visible_slope_is_that_of_a_known_scatter():
    """Critical value and quantile of the normal distribution."""
    known = Scatter(4.0, 1e9)
    expected = 2.0 / 10.0 * float(student.ppf(0.995, 1e9) + student.ppf(POWER, 1e9))
    assert known.visible_slope(100.0, 0.01) == pytest.approx(expected)


def monthly(months, loss=0.0, seed=0, dampers=8):
    """Rows of dampers that are run once a month, of which the first one loses rebound force."""
    rng = np.random.default_rng(seed)
    for month in range(months):
        date = (FIRST + datetime.timedelta(days=30 * month)).isoformat()
        for damper in range(dampers):
            factor = 1.0 - loss * month / (months - 1) * (damper == 0)
            force_n = -900.0 * factor * (1.0 + 0.005 * rng.standard_normal())
            key = f"{damper}-{month}"
            value = RunValue(
                "figure", "", "", "", "rebound_force_n_at_0.2_m_per_s", force_n, -1e3, 0.0
            )
            yield RunRow(
                *(key, key, f"runs/{key}", "bench", f"A{damper}", date, "m", "h", "0.3.0"),
                verdict="nothing_missing",
                values=(value,),
            )


@pytest.mark.parametrize("months", [4, 6, 9])
def test_eight_per_cent_of_rebound_are_seen_before_the_tenth_run(tmp_path, months):
    """At a scatter of 0.5 %, with the scatter of the other dampers."""
    store.append(tmp_path, list(monthly(months, loss=0.08)))
    lines = alarm_sentences(read_overview(tmp_path))
    assert any("A0 on bench: rebound_force_n_at_0.2_m_per_s drifts" in line for line in lines)
    assert all("A0" in line for line in lines)


@pytest.mark.parametrize("months", [2, 4, 12])
def test_what_cannot_be_seen_is_said(tmp_path, months):
    store.append(tmp_path, list(monthly(months)))
    found = read_overview(tmp_path)
    assert alarm_sentences(found) == []
    [power] = found.powers()
    [row] = power_rows(found)
    assert row.runs == str(months)
    assert row.drift.startswith("any") == (months < 3)
    assert row.step.startswith("any, 10 runs needed") == (months < 10)
    assert (power.drift_per_month is None) == (months < 3)
    assert (power.step is None) == (months < 10)
    if months == 12:
        # Twelve months of 0.5 %: a slope is known to 0.04 % a month.
        assert 0.002 < power.drift_per_month < 0.005
        assert 0.01 < power.step < 0.1
    write_fleet_page(found, tmp_path / "page.html")
    assert "What cannot be seen" in (tmp_path / "page.html").read_text()


@pytest.mark.long
def test_what_a_report_calls_visible_is_seen_and_stable_dampers_are_not_accused():
    """Twenty fleets: with 95 % seen, less than sixteen are seen once in four hundred times."""
    *_, (_, _, fleets, accused, drifts, steps, planted) = study(20, 11)
    assert fleets == 20
    assert accused <= 1
    assert drifts >= 16
    assert steps >= planted - 4
