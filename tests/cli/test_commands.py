"""The commands as a user types them: results, exit codes, and one line for every wrong input."""

import json
import sys
from pathlib import Path

import pytest
import yaml

from dart_model.spec import dump_model, load_model
from rig.cli.diagnose import print_gains
from rig.cli.main import main
from rig.diagnosis.progress import no_progress
from rig.plan.config import CONFIGS
from rig.plan.load import plan_of_run
from rig.tuning.gains import Aim
from rig.tuning.tune import settings_of, tune

EXAMPLE = CONFIGS / "reference.yaml"


def rig(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit code of the command."""
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    try:
        main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


@pytest.fixture(scope="module")
def case_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished demo of three seconds."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch:
        arguments = ("--case", "reference", "--lockstep", "--duration-s", 3, "--out", folder)
        assert rig(monkeypatch, "demo", *arguments) == 0
    return folder


def test_demo_writes_every_figure_of_its_table(case_folder: Path) -> None:
    summary = json.loads((case_folder / "summary.json").read_text("utf-8"))
    names = {"height_error_max_m", "force_error_rms_n", "force_error_max_n", "force_peak_n"}
    assert set(summary["defective"]) == set(summary["observed"]) == names
    assert summary["observed"]["height_error_max_m"] < summary["defective"]["height_error_max_m"]
    assert summary["observed"]["force_peak_n"] == summary["defective"]["force_peak_n"]
    assert summary["ticks"] == 3000
    assert (case_folder / "strut.png").stat().st_size > 10_000


def test_demo_leaves_a_run_that_replays(
    case_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rig(monkeypatch, "replay", case_folder / "run", "--out", tmp_path) == 0
    summary = json.loads((tmp_path / "summary.json").read_text("utf-8"))
    assert (summary["logged_ticks"], summary["different_ticks"]) == (3000, 0)


def test_a_changed_log_fails_the_replay(
    case_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changed = tmp_path / "run"
    changed.mkdir()
    for path in (case_folder / "run").iterdir():
        (changed / path.name).write_bytes(path.read_bytes())
    model = (changed / "model.yaml").read_text("utf-8")
    (changed / "model.yaml").write_text(model.replace("500.0", "501.0"), "utf-8")
    assert rig(monkeypatch, "replay", changed) == 1


def test_demo_does_not_write_over_anything(
    case_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig(monkeypatch, "demo", "--lockstep", "--out", case_folder) == 2
    assert "not empty" in one_line(capsys)


def test_check_passes_the_seed_and_finds_its_poles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert rig(monkeypatch, "check", EXAMPLE, "--out", tmp_path) == 0
    findings = json.loads((tmp_path / "summary.json").read_text("utf-8"))["findings"]
    assert {"signals", "bus load", "poles"} <= {finding["what"] for finding in findings}


@pytest.mark.parametrize(
    ("key", "value", "what"),
    [
        ("observers", {"strut": {"integral_n_per_m_s": 1.0e6}}, "poles"),
        ("bus", {"bitrate": 250_000}, "bus load"),
        ("supervision", {"stale_after_s": 0.001}, "supervision.stale_after_s"),
    ],
)
def test_check_refuses_what_cannot_work(
    key: str, value: object, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = write_config(tmp_path, {key: value})
    assert rig(monkeypatch, "check", config, "--out", tmp_path) == 1
    findings = json.loads((tmp_path / "summary.json").read_text("utf-8"))["findings"]
    assert [item["what"] for item in findings if item["severity"] == "error"] == [what]


WRONG_CONFIGS = {
    "no YAML": ("a: [", "YAML"),
    "a list": ("- 1\n", "keys and values"),
    "empty": ("", "is empty"),
    "unknown key": ('{"ratte_hz": 3}', "ratte_hz"),
    "rate of zero": ('{"rate_hz": 0}', "rate_hz"),
    "key twice": ("rate_hz: 1\nrate_hz: 2\n", "twice"),
    "alias": ("a: &x 1\nb: *x\n", "alias"),
    "tag": ("a: !!python/object/apply:os.system [ls]\n", "YAML"),
    "no signal": ('{"signals": {"height": {"message": "BENCH_MEASUREMENT"}}}', "height"),
    "no message": (
        '{"signals": {"height": {"message": "BENCH_MEASURMENT", "signal": "HEIGHT"}}}',
        "signals.height.strut: ",
    ),
    "not a signal": (
        '{"signals": {"height": {"message": "BENCH_MEASUREMENT", "signal": "HIGHT"}}}',
        "HEIGHT",
    ),
    "a force as height": (
        '{"signals": {"height": {"message": "BENCH_MEASUREMENT", "signal": "APPLIED_FORCE"}}}',
        "length",
    ),
    "no such model": (
        '{"model": "sed", "signals": {"height": {"message": "BENCH_MEASUREMENT",'
        ' "signal": "HEIGHT"}}}',
        "reference",
    ),
    "no such DBC": (
        '{"dbc": "none.dbc", "signals": {"height": {"message": "BENCH_MEASUREMENT",'
        ' "signal": "HEIGHT"}}}',
        "none.dbc",
    ),
    "no such strut": (
        '{"observers": {"spring": {}}, "signals": {"height": {"message": "BENCH_MEASUREMENT",'
        ' "signal": "HEIGHT"}}}',
        "spring",
    ),
}


@pytest.mark.parametrize("command", ["check", "run"])
@pytest.mark.parametrize("name", WRONG_CONFIGS)
def test_a_wrong_configuration_is_one_line_and_exit_code_2(
    command: str,
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    text, expected = WRONG_CONFIGS[name]
    config = tmp_path / "wrong.yaml"
    config.write_text(text, "utf-8")
    monkeypatch.chdir(tmp_path)
    assert rig(monkeypatch, command, config) == 2
    line = one_line(capsys)
    assert expected in line
    assert "rig" in line


@pytest.mark.parametrize("command", ["check", "run", "bench", "replay"])
def test_a_missing_file_is_one_line_and_exit_code_2(
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert rig(monkeypatch, command, tmp_path / "nothing.yaml") == 2
    assert "nothing.yaml" in one_line(capsys)


@pytest.mark.slow
def test_an_interface_that_is_not_there_is_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_config(tmp_path, {"bus": {"interface": "carrier_pigeon"}})
    assert rig(monkeypatch, "run", config, "--force", "--out", tmp_path / "run") == 2
    assert "carrier_pigeon" in one_line(capsys)


@pytest.mark.parametrize("name", ["run.yaml", "frames.log", "steps.arrow", "model.yaml", "bus.dbc"])
def test_a_run_without_a_file_is_one_line_and_exit_code_2(
    name: str,
    case_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damaged = tmp_path / "run"
    damaged.mkdir()
    for path in (case_folder / "run").iterdir():
        if path.name != name:
            (damaged / path.name).write_bytes(path.read_bytes())
    assert rig(monkeypatch, "replay", damaged) == 2
    assert name in one_line(capsys)


@pytest.mark.parametrize(
    ("model", "out", "expected"),
    [
        ("reference", "run", "holds a run, expected another folder"),
        (
            "sead",
            "found",
            "model 'sead': expected a file in ., or one of bench, four_post, quarter_car, "
            "quarter_car_road, reference",
        ),
        ("none.yaml", "found", "model 'none.yaml': expected a file"),
    ],
)
def test_a_diagnosis_that_cannot_begin_is_one_line_and_exit_code_2(
    model: str,
    out: str,
    expected: str,
    case_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = case_folder / out if out == "run" else tmp_path / out
    arguments = (case_folder / "run", "--model", model, "--out", folder)
    assert rig(monkeypatch, "diagnose", *arguments) == 2
    assert expected in one_line(capsys)


def test_a_diagnosis_into_a_file_is_refused_before_it_begins(
    case_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "file").touch()
    arguments = (case_folder / "run", "--model", "reference", "--out", tmp_path / "file" / "found")
    assert rig(monkeypatch, "diagnose", *arguments) == 2
    assert "expected a folder to write into" in one_line(capsys)


def test_a_diagnosis_prints_the_gains_of_its_corrected_model_for_the_run(
    case_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "corrected.yaml"
    spec = load_model(case_folder / "run" / "model.yaml")
    (strut,) = spec.struts
    stiffer = strut.model_copy(update={"stiffness_n_per_m": 1.5 * strut.stiffness_n_per_m})
    model.write_text(dump_model(spec.model_copy(update={"struts": (stiffer,)})), "utf-8")
    print_gains(case_folder / "run", model)
    head, *lines = capsys.readouterr().out.split(" of CONFIG:\n")
    assert f"at {1e9 / plan_of_run(case_folder / 'run').period_ns:g} Hz" in " ".join(head.split())
    (settings,) = yaml.safe_load("".join(lines)).values()
    source, plan = case_folder / "run", plan_of_run(case_folder / "run", load_model(model))
    (tuned,) = tune(plan, source, "kalman", Aim(), no_progress)
    expected = settings_of(tuned.tuned.observer)
    assert settings["kind"] == expected["kind"] == "kalman"
    assert settings["filter"] == pytest.approx(expected["filter"], rel=1e-3)


def test_a_run_that_is_held_out_too_is_refused(
    case_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, again = case_folder / "run", case_folder / "run" / ".." / "run"
    arguments = (run, "--model", "reference", "--held-out", again, "--out", tmp_path / "found")
    assert rig(monkeypatch, "diagnose", *arguments) == 2
    assert "given twice" in one_line(capsys)


def test_every_command_has_help_with_an_example(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("demo", "run", "bench", "check", "replay"):
        assert rig(monkeypatch, command, "--help") == 0
        assert f"rig {command}" in capsys.readouterr().out.split("Example")[1]


def write_config(folder: Path, changes: dict[str, object]) -> Path:
    """The reference case's configuration with other values, as JSON, which is YAML."""
    height = {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"}
    path = folder / "config.yaml"
    path.write_text(json.dumps({"signals": {"height": height}, **changes}), "utf-8")
    return path


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed as an error: one line and no traceback."""
    error = capsys.readouterr().err
    assert "Traceback" not in error
    assert error.count("\n") == 1
    return error
