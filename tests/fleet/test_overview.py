"""A store of rows whose truth is known, read as a whole: each alarm where it belongs."""

import datetime

import numpy as np
import pytest

from rig.fleet import store
from rig.fleet.one_run import RunRow, RunValue
from rig.fleet.overview import date_of, read_overview
from rig.fleet.sentences import alarm_sentences
from rig.pages.fleet_page import write_fleet_page
from tests.fleet.population import FIRST

BENCHES, DAMPERS, WEEKS, JUMPS = 4, 5, 30, 16


def value(effect, parameter, number):
    return RunValue("model", "strut", effect, "friction", parameter, number, number - 1, number + 1)


def rows(truth, seed=0):
    """A row a damper and week; `truth` gives friction and gain of a bench, damper and week."""
    rng = np.random.default_rng(seed)
    for bench in range(BENCHES):
        for damper in range(DAMPERS):
            stiffness = 8000.0 * (1.0 + 0.01 * rng.standard_normal())
            for week in range(WEEKS):
                friction, gain = truth(bench, damper, week)
                day = (FIRST + datetime.timedelta(weeks=week)).isoformat()
                noise = 1.0 + 0.003 * rng.standard_normal(2)
                key = f"{bench}-{damper}-{week}"
                yield RunRow(
                    key, key, f"runs/{key}", f"bench {bench}", f"A{bench}{damper}", day, "m", "h",
                    "0.2.0", verdict="nothing_missing",
                    values=(
                        value("", "stiffness_n_per_m", gain * stiffness * noise[0]),
                        value("coulomb_friction", "coulomb_force_n", gain * friction * noise[1]),
                    ),
                )  # fmt: skip


def as_new(_bench, _damper, _week):
    return 20.0, 1.0


def jumping(bench, _damper, week):
    return 20.0, 1.08 if bench == 2 and week >= JUMPS else 1.0


def failing(bench, damper, week):
    return 20.0 * (1.0 + 0.03 * max(0, week - JUMPS) * ((bench, damper) == (1, 3))), 1.0


def test_where_nothing_happens_nothing_is_said(tmp_path):
    store.append(tmp_path, list(rows(as_new)))
    found = read_overview(tmp_path)
    assert alarm_sentences(found) == []
    assert found.runs == BENCHES * DAMPERS * WEEKS
    assert found.verdicts["bench 0"] == {"nothing_missing": DAMPERS * WEEKS}


def test_a_bench_that_jumps_is_named_and_none_of_its_dampers(tmp_path):
    store.append(tmp_path, list(rows(jumping)))
    found = read_overview(tmp_path)
    (jump,) = found.jumps
    assert jump.bench == "bench 2"
    assert jump.factor == pytest.approx(1.08, abs=0.003)
    assert date_of(jump.change.day) == (FIRST + datetime.timedelta(weeks=JUMPS)).isoformat()
    assert len(alarm_sentences(found)) == 1


def test_a_damper_that_fails_is_named_and_not_its_bench(tmp_path):
    store.append(tmp_path, list(rows(failing)))
    found = read_overview(tmp_path)
    assert found.jumps == ()
    assert {s.where.damper for s in found.series if s.is_change} == {"A13"}
    assert {o.where.damper for o in found.outliers} <= {"A13"}
    write_fleet_page(found, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "Damper A13 on bench 1" in page
    assert page.count("data:image/svg") == 1
