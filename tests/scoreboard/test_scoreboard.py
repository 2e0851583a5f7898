"""The scoreboard: its linear starts, its tables, and where it finds its sets."""

import csv
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from can_dbc.errors import InputError
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from rig.plan.config import CONFIGS
from rig.recordings.recording import Recording
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.driven import driven_by
from tests.scoreboard import silverbox
from tests.scoreboard.run import run_scoreboard
from tests.scoreboard.silverbox import PUBLISHED, TESTS, TRAINING, open_loop_rmse_m
from tests.scoreboard.starts import driven_start, dyno_start
from tests.scoreboard.table import PAGE_FILE, TABLE_FILE, Row, page, write_scoreboard

# Measured data lie beside the checkout, never in it.
SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
MASS_KG, DAMPING, STIFFNESS, LENGTH_M = 0.6, 9.0, 9000.0, 0.52


def driven_record(samples: int = 4000, rate_hz: float = 600.0) -> Recording:
    """A linear bench under a multisine, in closed form: every line has its own response."""
    rng = np.random.default_rng(5)
    t_s = np.arange(samples) / rate_hz
    omega = 2.0 * np.pi * np.arange(1, 400) * rate_hz / samples
    force = 20.0 * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, len(omega)))
    response = force / (STIFFNESS - MASS_KG * omega**2 + 1j * omega * DAMPING)
    turn = np.exp(1j * np.outer(t_s, omega))
    noise_m = 1e-6 * rng.standard_normal(samples)
    height_m = LENGTH_M + (turn @ response).real + noise_m
    return Recording("linear", t_s, height_m[:, np.newaxis], driven_by((turn @ force).real))


def test_the_rough_start_of_a_driven_bench_has_its_stiffness_and_the_stated_resonance() -> None:
    resonance_hz = np.sqrt(STIFFNESS / MASS_KG) / (2.0 * np.pi)
    spec = driven_start(driven_record(), "linear", resonance_hz)
    (strut,), (body,) = spec.struts, spec.skeleton.bodies
    assert strut.stiffness_n_per_m == pytest.approx(STIFFNESS, rel=0.15)
    resonance = np.sqrt(strut.stiffness_n_per_m / body.mass_kg) / (2.0 * np.pi)
    assert resonance == pytest.approx(resonance_hz, rel=1e-9)
    assert strut.free_length_m == pytest.approx(LENGTH_M, abs=1e-3)


def test_the_right_model_alone_comes_near_its_own_bench() -> None:
    record = driven_record()
    rough = driven_start(record, "linear", 19.5)
    body = rough.skeleton.bodies[0].model_copy(update={"mass_kg": MASS_KG})
    strut = rough.struts[0].model_copy(
        update={
            "stiffness_n_per_m": STIFFNESS,
            "damping_n_s_per_m": DAMPING,
            "free_length_m": LENGTH_M,
        }
    )
    skeleton = rough.skeleton.model_copy(update={"bodies": (body,)})
    spec = rough.model_copy(update={"skeleton": skeleton, "struts": (strut,)})
    assert open_loop_rmse_m(spec, record, 50) < 0.02 * np.std(record.heights_m)


def test_the_linear_start_of_a_dyno_is_found_from_its_record() -> None:
    t_s = np.arange(2000) * 1e-3
    height_m = 0.3 + 0.01 * np.sin(12.0 * t_s) + 0.004 * np.sin(31.0 * t_s)
    rate = 0.12 * np.cos(12.0 * t_s) + 0.124 * np.cos(31.0 * t_s)
    force_n = -4000.0 * (height_m - 0.31) - 700.0 * rate
    spec = dyno_start(
        [Recording("dyno", t_s, height_m[:, np.newaxis], {}, force_n[:, np.newaxis])], "dyno"
    )
    (strut,) = spec.struts
    assert strut.stiffness_n_per_m == pytest.approx(4000.0, rel=1e-2)
    assert strut.damping_n_s_per_m == pytest.approx(700.0, rel=1e-2)
    assert strut.free_length_m == pytest.approx(0.31, abs=1e-4)


def test_the_split_is_the_published_one() -> None:
    assert TRAINING[1:] == (40_650, 105_712)
    assert [part[1:] for part in TESTS] == [
        (105_712, 127_400),
        (100, 40_575),
        (100, 32_100),
    ]


def test_a_page_has_a_table_a_set_and_the_file_holds_every_row(tmp_path: Path) -> None:
    rows = [
        Row("A", "one", "ours", 0.25, "RMSE in mV", "here"),
        Row("A", "two", "ours", None, "RMSE in mV", "here"),
        Row("A", "two", "theirs", 0.3, "RMSE in mV", "paper"),
        Row("B", "one", "ours", 9.0, "RMSE in %", "here"),
    ]
    text = page(rows)
    assert "| ours | 0.25 | - | here |" in text
    assert "| theirs | - | 0.3 | paper |" in text
    assert text.count("## ") == 2
    write_scoreboard(rows, tmp_path)
    with (tmp_path / TABLE_FILE).open(newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(rows)
    assert table[1]["value"] == ""
    assert (tmp_path / PAGE_FILE).read_text() == text


def test_published_figures_cover_the_tests() -> None:
    assert {len(values) for _, values in PUBLISHED} == {len(TESTS)}


def without_package_data(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    utilities = pytest.importorskip(
        "nonlinear_benchmarks.utilities", reason="wants the package nonlinear_benchmarks"
    )
    monkeypatch.setattr(utilities, "get_tmp_benchmark_directory", lambda: str(folder))


def test_no_set_at_all_is_one_line_and_nothing_is_downloaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_package_data(monkeypatch, tmp_path)
    with pytest.raises(InputError, match="holds no measured set, expected") as caught:
        run_scoreboard(tmp_path, tmp_path / "out", lambda _what, _share: None)
    assert "\n" not in str(caught.value)


def test_the_package_is_a_source_where_it_has_kept_the_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    without_package_data(monkeypatch, tmp_path)
    kept = tmp_path / "Silverbox" / "SilverboxFiles.zip"
    kept.parent.mkdir()
    kept.write_bytes(b"")
    package = pytest.importorskip("nonlinear_benchmarks")

    class Data(SimpleNamespace):
        def __len__(self) -> int:
            return len(self.u)

    data = Data(u=np.array([0.01, 0.02, 0.03]), y=np.array([0.1, 0.2, 0.3]))
    monkeypatch.setattr(package, "Silverbox", lambda **_: [Data(u=[1.0], y=[1.0]), data])
    table = silverbox._table(None, tmp_path)
    assert table is not None
    mapping = load_mapping(CONFIGS / "silverbox_mapping.yaml")
    report = import_table(table, mapping, tmp_path / "made.csv")
    made = np.loadtxt(report.out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(made[:, 1], 0.5 + 0.1 * data.y)
    np.testing.assert_allclose(made[:, 2], 1e4 * data.u)


@pytest.mark.skipif(not SHARED.is_dir(), reason="no measured data beside the checkout")
def test_the_measured_damper_is_read_as_its_file_says(tmp_path: Path) -> None:
    mapping = load_mapping(CONFIGS / "dyno_mapping.yaml")
    source = SHARED / "mr_damper" / "5mm3Hz1A.txt"
    report = import_table(source, mapping, tmp_path / "made.csv")
    raw = np.loadtxt(source)
    made = np.loadtxt(report.out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(made[:, 0], raw[:, 0], atol=1e-9)
    np.testing.assert_allclose(made[:, 1], 0.3 + 1e-3 * raw[:, 1], atol=1e-10)
    np.testing.assert_allclose(made[:, 2], -raw[:, 3], rtol=1e-9)
    assert report.rate_hz == pytest.approx(1000.0)


def test_a_set_that_is_none_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="set 'duffing': expected one of silverbox, emps, brfd"):
        run_scoreboard(tmp_path, tmp_path / "out", lambda _what, _share: None, ["duffing"])


def test_each_damper_record_is_told_from_the_others_of_its_current(tmp_path: Path) -> None:
    folder = tmp_path / "mr_damper"
    folder.mkdir()
    for seed, name in enumerate(("1mm1Hz1A", "2mm1Hz1A", "1mm1Hz0A"), start=1):
        record = dyno.run(dyno.Nothing(), seed=seed, duration_s=6.0)
        z_mm = 1e3 * record.heights_m[:, 0] - 300.0
        columns = [record.t_s, z_mm, np.gradient(z_mm, record.t_s), -record.strut_forces_n[:, 0]]
        np.savetxt(folder / f"{name}.txt", np.column_stack(columns), "%.9g")
    rows = run_scoreboard(tmp_path, tmp_path / "out", lambda _what, _share: None, ["mr_damper"])
    assert [(row.test, row.model) for row in rows] == [
        (test, model)
        for test in ("1mm1Hz1A", "2mm1Hz1A")
        for model in ("rig, spring and damper", "rig, corrected")
    ]
    assert "trained on `2mm1Hz1A`; nothing missing" in rows[1].source
    size = float(np.std(record.strut_forces_n))
    for row in rows:
        assert row.value is not None
        assert row.value / 100.0 * size == pytest.approx(1.0, rel=0.2)  # The load cell's noise.
