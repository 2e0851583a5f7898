"""No command overwrites what somebody has, and every wrong input is one line and exit code 2."""

import dataclasses
import sys
from pathlib import Path

import pytest

from rig.cli.main import main
from rig.formats import export as exported
from rig.log.reader import find_changed_files, read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from tests.run.listed import ListPort, bench_frames, live


def rig(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.2)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 200, {})))
    return tmp_path / "run"


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize(
    "arguments",
    [
        ("import", "RUN/frames.log", "--config", CONFIGS / "reference.yaml", "--out", "RUN"),
        ("run", CONFIGS / "reference.yaml", "--out", "RUN"),
        ("replay", "RUN", "--out", "RUN"),
        ("check", CONFIGS / "reference.yaml", "--out", "RUN"),
        ("diagnose", "RUN", "--model", "reference", "--out", "RUN"),
        ("export", "RUN", "--format", "csv", "--out", "RUN/frames.log"),
        ("demo", "--out", "RUN"),
    ],
)
def test_a_run_is_never_written_into(run, monkeypatch, capsys, arguments):
    before = content(run)
    given = [str(item).replace("RUN", str(run)) for item in arguments]
    assert rig(monkeypatch, *given) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("rig: ")
    assert content(run) == before


def test_an_earlier_diagnosis_is_not_overwritten(run, tmp_path, monkeypatch, capsys):
    found = tmp_path / "found"
    found.mkdir()
    (found / "corrected.yaml").write_text("mine")
    arguments = ("diagnose", run, "--model", "reference", "--out", found)
    assert rig(monkeypatch, *arguments) == 2
    assert "holds corrected.yaml already" in capsys.readouterr().err
    assert (found / "corrected.yaml").read_text() == "mine"


def test_an_export_that_fails_leaves_nothing_under_its_name(run, tmp_path, monkeypatch):
    def broken(_found, out):
        out.write_text("half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(exported, "FORMATS", {"csv": broken})
    assert rig(monkeypatch, "export", run, "--format", "csv", "--out", tmp_path / "run.csv") == 2
    assert not (tmp_path / "run.csv").exists()


def test_a_file_that_is_not_the_one_that_ran_is_named(run, monkeypatch, capsys):
    assert find_changed_files(run) == []
    model = run / "model.yaml"
    model.write_text(model.read_text() + "# by hand\n")
    assert find_changed_files(run) == ["model.yaml"]
    assert rig(monkeypatch, "replay", run) == 1
    assert "model.yaml is not the one that ran" in capsys.readouterr().out


def test_a_run_of_another_layout_is_refused(run, monkeypatch, capsys):
    path = run / "run.yaml"
    path.write_text(path.read_text().replace("schema: 3", "schema: 1"))
    assert rig(monkeypatch, "replay", run) == 2
    assert "schema 1: expected 3" in capsys.readouterr().err


def test_a_run_without_a_tick_is_no_success(run, monkeypatch, capsys):
    (run / "frames.log").write_bytes(b"")
    (run / "steps.arrow").write_bytes(b"")
    assert rig(monkeypatch, "replay", run) == 1
    assert "nothing was compared" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("channel", "written"), [("two words", "two_words"), ("zwölf\n", "zw_lf_"), ("can0", "can0")]
)
def test_a_channel_of_any_name_gives_a_log_that_can_be_read(tmp_path, channel, written):
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.05)
    bus = dataclasses.replace(ready.config.bus, channel=channel)
    ready = ready.with_config(ready.config.model_copy(update={"bus": bus}))
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 50, {})))
    assert len(list(read_run(tmp_path / "run").frames())) > 50
    assert f" {written} " in (tmp_path / "run" / "frames.log").read_text().splitlines()[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('rate_hz: !!int ""', "is no valid YAML"),
        ("rate_hz: !!bool maybe", "is no valid YAML"),
        ("rate_hz: !!timestamp soon", "is no valid YAML"),
        ("rate_hz: 1.0e-300", "rate_hz: 1e-300"),
        ("rate_hz: true", "rate_hz: True"),
        ("bus: {bitrate: 1" + "0" * 39 + "}", "bus.bitrate"),
        ("bus: {bitrate: 1" + "0" * 400 + "}", "line 1 is no valid YAML"),
        ("bus: {bitrate: 0x1" + "0" * 4000 + "}", "line 1 is no valid YAML"),
        ("bus: {bitrate: 1:30:00}", "bus.bitrate"),
        ("realtime: {cpu: 100000000000000000000}", "realtime.cpu"),
        ("nonsense: 1", "nonsense: unknown key"),
        ('"two\\nlines\\e[31m": 1', "unknown key"),
        ("signals: {height: {message: A, signal: B}, oil: {message: A, signal: C}}", "oil"),
        ("observers: {strut: {kind: magic}}", "magic"),
        ("publish: {force: {message: RIG_ESTIMATE}}", "signal"),
        ("publish: {strut: {torque: {message: A, signal: B}}}", "torque"),
        ("publish: {frce: {message: A, signal: B}}", "frce: unknown key"),
        ("publish: {force: RIG_ESTIMATE}", "expected keys and values"),
        ("signals: {heigth: {message: A, signal: B}}", "heigth: unknown key"),
        ("observers: {strut: {proportional: 1.0}}", "strut.proportional: unknown key"),
    ],
)  # fmt: skip
def test_a_wrong_configuration_is_one_line(tmp_path, monkeypatch, capsys, text, words):
    path = tmp_path / "my.yaml"
    path.write_text(text + "\n")
    assert rig(monkeypatch, "check", path) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "my.yaml" in error
    assert words in error
    assert "\x1b" not in error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run",), "CONFIG"),
        (("run", "x.yaml", "--duration-s", "inf"), "no such file"),
        (("run", CONFIGS / "reference.yaml", "--duration-s", "inf"), "expected a finite number"),
        (("nosuch",), "nosuch"),
        (("demo", "--seed", "minus"), "--seed"),
        (("replay", "x" * 300), "x"),
        (("export", "."), "--out"),
    ],
)
def test_a_wrong_command_line_is_one_line(monkeypatch, capsys, arguments, words):
    assert rig(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error


def test_a_run_that_never_had_a_height_is_no_success(tmp_path, monkeypatch, capsys):
    path = tmp_path / "my.yaml"
    text = (CONFIGS / "reference.yaml").read_text().replace("channel: rig", "channel: silent")
    path.write_text(text + "realtime: {fifo_priority: 0, lock_memory: false}\n")
    arguments = ("run", path, "--out", tmp_path / "run", "--duration-s", 0.05)
    assert rig(monkeypatch, *arguments) == 1
    assert "expected frames of BENCH_MEASUREMENT" in capsys.readouterr().err


def test_a_run_with_heights_alone_is_not_diagnosed(tmp_path, monkeypatch, capsys):
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=1.0)
    signals = ready.config.signals.model_copy(
        update=dict.fromkeys(("applied_force", "load_cell_force", "temperature"))
    )
    config = ready.config.model_copy(update={"signals": signals})
    ready = ready.with_config(config)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 1000, {})))
    arguments = ("diagnose", tmp_path / "run", "--model", "reference", "--out", tmp_path / "found")
    assert rig(monkeypatch, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "has heights alone" in error
