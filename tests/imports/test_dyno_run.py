"""A displacement-driven run, live over CAN in lockstep: logged, read back, and the same as CSV."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from can_dbc.errors import InputError
from dart_model.spec import load_model
from rig.demo.cases import DemoOptions, run_case
from rig.diagnosis.files import diagnose_runs
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import check
from rig.recordings.read import read_recording
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate

DURATION_S = 3.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dyno") / "run"
    ready = load_plan(CONFIGS / "dyno.yaml", duration_s=DURATION_S)
    with_bench(
        ready,
        load_bench_config(CONFIGS / "dyno_bench.yaml"),
        folder,
        lockstep=True,
    )
    return folder


def test_the_load_cell_is_logged_with_the_height_of_the_same_time(run: Path) -> None:
    record = read_recording(run)
    assert record.applied_force_n is None
    assert record.strut_forces_n is not None
    truth = simulate(load_bench_config(CONFIGS / "dyno_bench.yaml"), round(DURATION_S * 1e9))
    at = np.rint(record.t_s * 1000).astype(int)
    assert len(at) >= 2990
    assert np.abs(record.heights_m[:, 0] - truth.height_m[at, 0]).max() <= 1.001e-7
    assert np.std(record.strut_forces_n[:, 0] - truth.strut_force_n[at, 0]) == pytest.approx(
        0.5, rel=0.1
    )


def test_the_same_data_as_csv_is_the_same_record(run: Path, tmp_path: Path) -> None:
    record = read_recording(run)
    assert record.strut_forces_n is not None
    path = tmp_path / "run.csv"
    columns = [record.t_s, record.heights_m[:, 0], record.strut_forces_n[:, 0]]
    np.savetxt(
        path,
        np.column_stack(columns),
        fmt="%.9f",
        delimiter=",",
        header="t_s,height_m,strut_force_n",
        comments="",
    )
    again = read_recording(path)
    assert again.applied_force_n is None
    assert again.strut_forces_n is not None
    np.testing.assert_allclose(again.t_s, record.t_s, atol=1e-9)
    np.testing.assert_allclose(again.heights_m, record.heights_m, atol=1e-9)
    np.testing.assert_allclose(again.strut_forces_n, record.strut_forces_n, atol=1e-9)


def test_the_virtual_force_is_the_force_that_the_model_lacks(run: Path) -> None:
    steps = pa.ipc.open_stream(pa.OSFile(str(run / "steps.arrow"))).read_all()
    t_ns, virtual_n, force_n = (
        steps.column(name).to_numpy() for name in ("t_ns", "strut.virtual_force_n", "strut.force_n")
    )
    truth = simulate(load_bench_config(CONFIGS / "dyno_bench.yaml"), round(DURATION_S * 1e9))
    at = np.rint(t_ns * 1e-6).astype(int)
    measured_n = truth.strut_force_n[at, 0]
    (strut,) = load_model(CONFIGS / "dyno_model.yaml").struts
    law_n = strut.stiffness_n_per_m * (strut.free_length_m - truth.height_m[at, 0])
    law_n = law_n - strut.damping_n_s_per_m * truth.velocity_m_per_s[at, 0]
    settled = slice(100, None)
    missing_n = (measured_n - law_n)[settled]
    assert np.std(force_n[settled] - measured_n[settled]) == pytest.approx(0.5, rel=0.1)
    assert np.std(virtual_n[settled] - missing_n) < 0.02 * np.std(missing_n)


def test_the_run_is_repeated_bit_for_bit(run: Path) -> None:
    again = replay(run)
    assert again.logged == round(DURATION_S * 1000)
    assert again.different == 0


@pytest.mark.slow
def test_the_run_is_diagnosed_as_its_own_data_are_as_csv(run: Path, tmp_path: Path) -> None:
    record = read_recording(run)
    assert record.strut_forces_n is not None
    path = tmp_path / "run.csv"
    np.savetxt(
        path,
        np.column_stack([record.t_s, record.heights_m[:, 0], record.strut_forces_n[:, 0]]),
        fmt="%.9f",
        delimiter=",",
        header="t_s,height_m,strut_force_n",
        comments="",
    )
    model = load_model(CONFIGS / "dyno_model.yaml")
    over_can, as_csv = (
        diagnose_runs([source], model, [], tmp_path / name, lambda _what, _share: None).diagnosis
        for source, name in ((run, "can"), (path, "csv"))
    )
    assert over_can.verdict == as_csv.verdict == "explained"
    (found,), (same,) = over_can.effects, as_csv.effects
    assert found.name == same.name == "bouc_wen"
    for name, estimate in found.parameters.items():
        assert estimate.value == pytest.approx(same.parameters[name].value, rel=1e-4)
    truth = {"yield_force_n": 320.0, "yield_displacement_m": 8e-4, "exponent": 2.0, "shape": 0.6}
    for name, value in truth.items():
        assert found.parameters[name].value == pytest.approx(value, rel=0.02)


@pytest.mark.slow
def test_the_corrected_model_on_the_bus_lacks_nothing(run: Path, tmp_path: Path) -> None:
    model = load_model(CONFIGS / "dyno_model.yaml")
    diagnose_runs([run], model, [], tmp_path / "found", lambda _what, _share: None)
    corrected = tmp_path / "found" / "corrected.yaml"
    with_bench(
        load_plan(CONFIGS / "dyno.yaml", model=corrected, duration_s=DURATION_S),
        load_bench_config(CONFIGS / "dyno_bench.yaml"),
        tmp_path / "again",
        lockstep=True,
    )
    steps = [
        pa.ipc.open_stream(pa.OSFile(str(folder / "steps.arrow"))).read_all()
        for folder in (run, tmp_path / "again")
    ]
    before, after = (np.std(s.column("strut.virtual_force_n").to_numpy()[100:]) for s in steps)
    assert after < 0.05 * before


def test_a_dyno_asks_for_a_load_cell_and_no_applied_force(tmp_path: Path) -> None:
    given = (CONFIGS / "dyno.yaml").read_text()
    path = tmp_path / "dyno.yaml"
    path.write_text(given.replace("load_cell_force:", "applied_force:"))
    with pytest.raises(InputError, match=r"prescribed_motion: requires signals\.load_cell_force"):
        load_plan(path)


def test_a_dyno_has_no_loop_that_could_ring() -> None:
    findings = {item.what: item.text for item in check(load_plan(CONFIGS / "dyno.yaml"))}
    assert "the motion is prescribed" in findings["poles"]


def test_the_case_that_comes_with_the_package_tells_how_far_the_model_is(tmp_path: Path) -> None:
    case = run_case(
        "dyno",
        tmp_path / "case",
        DemoOptions(True, 1.5, stop=lambda: False, watch=lambda _look: None),
    )
    (strut,) = case.struts
    alone, observed = strut.figures(strut.defective), strut.figures(strut.observed)
    assert alone.force_error_rms_n > 0.2 * alone.force_peak_n
    assert observed.force_error_rms_n == pytest.approx(0.5, rel=0.2)
    assert alone.height_error_max_m < 2e-6
