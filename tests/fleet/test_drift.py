"""Forty dampers over a year, each run diagnosed: one seal fails."""

import datetime

import pytest

from rig.fleet.campaign import load_fleet_model, run_campaign
from rig.fleet.executors import processes
from rig.fleet.overview import read_overview
from rig.fleet.sources import find_sources
from tests.fleet.population import FIRST, Piece, write_fleet, write_model

WEEKS, DAMPERS, FAILS, WHICH, SEED = 52, 40, 30, 23, 41


def piece(damper, week, rng):
    """Friction goes up by 2 % a week from the failure on; every run scatters by 1 %."""
    worn = 0.02 * max(0, week - FAILS) if damper == WHICH else 0.0
    return Piece(
        friction=(1.0 + worn) * (1.0 + 0.01 * rng.standard_normal()),
        damping=1.0 + 0.005 * rng.standard_normal(),
    )


@pytest.mark.long
def test_a_seal_that_fails_in_week_30_is_dated_and_the_others_are_not_accused(tmp_path):
    write_fleet(tmp_path / "runs", DAMPERS, WEEKS, piece, seed=SEED)
    model = load_fleet_model(write_model(tmp_path))
    sources = find_sources([str(tmp_path / "runs")], "{bench}/{date}/{damper}")
    engine = processes(2)
    end = run_campaign(sources, model, tmp_path / "store", engine.make, engine.window)
    assert (end.done, end.failed) == (WEEKS * DAMPERS, 0)
    found = read_overview(tmp_path / "store")
    (item,) = [series for series in found.series if series.is_change]
    assert item.where.damper == f"A{WHICH}"
    assert item.quantity.parameter == "coulomb_force_n"
    assert item.change.kind == "bend"
    fails = (FIRST + datetime.timedelta(weeks=FAILS)).toordinal()
    assert abs(item.change.day - fails) <= 14.0
    assert found.jumps == ()
    assert not any(series.is_drift for series in found.series)
    assert {outlier.where.damper for outlier in found.outliers} <= {f"A{WHICH}"}
