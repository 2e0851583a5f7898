"""A displacement-driven run, live over CAN in lockstep: logged, read back, and the same as CSV."""

from pathlib import Path

import numpy as np
import pytest

from rig.bench.config import load_bench_config
from rig.bench.trajectory import simulate
from rig.config import CONFIGS, load_setup
from rig.diagnose import read_record
from rig.runs import with_bench

DURATION_S = 3.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dyno") / "run"
    ready = load_setup(CONFIGS / "dyno.yaml", duration_s=DURATION_S)
    with_bench(
        ready,
        load_bench_config(CONFIGS / "dyno_bench.yaml"),
        folder,
        lockstep=True,
        stop=lambda: False,
        progress=lambda _t, _mode: None,
    )
    return folder


def test_the_load_cell_is_logged_with_the_height_of_the_same_time(run: Path) -> None:
    record = read_record(run)
    assert record.applied_force_n is None
    assert record.strut_force_n is not None
    truth = simulate(load_bench_config(CONFIGS / "dyno_bench.yaml"), round(DURATION_S * 1e9))
    at = np.rint(record.t_s * 1000).astype(int)
    assert len(at) >= 2990
    assert np.abs(record.heights_m[:, 0] - truth.height_m[at, 0]).max() <= 1.001e-7
    assert np.std(record.strut_force_n - truth.strut_force_n[at, 0]) == pytest.approx(0.5, rel=0.1)


def test_the_same_data_as_csv_is_the_same_record(run: Path, tmp_path: Path) -> None:
    record = read_record(run)
    assert record.strut_force_n is not None
    path = tmp_path / "run.csv"
    columns = [record.t_s, record.heights_m[:, 0], record.strut_force_n]
    np.savetxt(
        path,
        np.column_stack(columns),
        fmt="%.9f",
        delimiter=",",
        header="t_s,height_m,strut_force_n",
        comments="",
    )
    again = read_record(path)
    assert again.applied_force_n is None
    assert again.strut_force_n is not None
    np.testing.assert_allclose(again.t_s, record.t_s, atol=1e-9)
    np.testing.assert_allclose(again.heights_m, record.heights_m, atol=1e-9)
    np.testing.assert_allclose(again.strut_force_n, record.strut_force_n, atol=1e-9)
