"""Habits of other tools: JSON, JUnit, versions, colours, a status where there is no terminal."""

import json
import os
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import typer
import yaml

from dart_model.spec import MODELS
from rig.bridge.counts import Counts
from rig.bridge.values import Mode, StepOutput, StrutOutput
from rig.cli.end_of_run import diagnosis_of
from rig.cli.main import app, main
from rig.cli.progress import status_line
from rig.cli.terminal import console, table
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.loop import Look
from tests.view.serving import make_run


def rig(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_versions_are_those_of_rig_and_what_it_stands_on(monkeypatch, capsys):
    assert rig(monkeypatch, "--version") == 0
    said = capsys.readouterr()
    assert [line.split()[0] for line in said.out.splitlines()] == [
        "rig", "dartpy", "python-can", "numpy", "Python",
    ]  # fmt: skip
    assert said.err == ""


def test_a_check_as_json_and_as_junit(monkeypatch, capsys, tmp_path):
    path = tmp_path / "check.xml"
    config = CONFIGS / "reference.yaml"
    assert rig(monkeypatch, "check", config, "--json", "--junit", path) == 0
    findings = json.loads(capsys.readouterr().out)
    suite = ElementTree.parse(path).getroot()
    assert suite.tag == "testsuite"
    assert int(suite.get("tests")) == len(findings) == len(suite.findall("testcase"))
    assert suite.get("failures") == "0"
    assert [case.get("name") for case in suite] == [item["what"] for item in findings]
    assert rig(monkeypatch, "check", config, "--junit", path) == 2
    assert "exists, expected a new file" in capsys.readouterr().err


def test_what_fails_a_check_fails_its_test_case(monkeypatch, capsys, tmp_path):
    text = (CONFIGS / "reference.yaml").read_text()
    (tmp_path / "far.yaml").write_text(
        text + "\nrate_hz: 20\n"
        if "rate_hz" not in text
        else text.replace("rate_hz: 1000", "rate_hz: 20")
    )
    path = tmp_path / "check.xml"
    assert rig(monkeypatch, "check", tmp_path / "far.yaml", "--json", "--junit", path) == 1
    findings = json.loads(capsys.readouterr().out)
    failed = {
        case.get("name")
        for case in ElementTree.parse(path).getroot()
        if case.find("failure") is not None
    }
    assert failed == {item["what"] for item in findings if item["severity"] == "error"} != set()


def commands_of(group, prefix="rig"):
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands_of(command, f"{prefix} {name}")
        else:
            yield f"{prefix} {name}", command


def test_every_command_that_prints_a_result_prints_it_as_json():
    without = {
        name
        for name, command in commands_of(typer.main.get_command(app))
        if not any("--json" in parameter.opts for parameter in command.params)
    }
    # It serves pages until Ctrl-C.
    assert without == {"rig view"}


def test_a_report_an_export_and_an_import_as_json(monkeypatch, capsys, tmp_path):
    make_run(tmp_path / "run", 200)

    def found(*arguments):
        assert rig(monkeypatch, *arguments, "--json") == 0
        return json.loads(capsys.readouterr().out)

    run, table_file = tmp_path / "run", tmp_path / "run.csv"
    page = str(run / "report.html")
    assert found("report", run) == {"report": page, "pdf": None}
    archive = tmp_path / "run.mf4"
    assert found("export", run, "--format", "mf4", "--out", archive) == {"written": [str(archive)]}
    assert found("import", archive, "--out", tmp_path / "again") == {"run": str(tmp_path / "again")}
    table_file.write_text("t;z;f\n" + "".join(f"{k};{k % 7};{k % 5}\n" for k in range(200)))
    mapping = {
        "table": {"separator": ";"},
        "time": {"column": "t", "unit": "ms"},
        "height": {"column": "z", "unit": "mm", "zero": {"reads": 0.0, "at_m": 0.3}},
        "strut_force": {"column": "f", "unit": "N"},
    }
    (tmp_path / "mapping.yaml").write_text(yaml.safe_dump(mapping))
    out = tmp_path / "table.csv"
    report = found("import", table_file, "--mapping", tmp_path / "mapping.yaml", "--out", out)
    assert (report["out"], report["samples"]) == (str(out), 200)
    assert report["columns"] == ["t_s", "height_m", "strut_force_n"]
    unit = tmp_path / "strut.fmu"
    model = run / "model.yaml"
    exported = found("export", model, "--fmu", "--out", unit)
    assert exported["written"] == [str(unit)]
    assert exported["inputs"]


def test_a_replay_as_json(monkeypatch, capsys, tmp_path):
    make_run(tmp_path / "run", 200)
    assert rig(monkeypatch, "replay", tmp_path / "run", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["different_ticks"] == 0
    assert found["ticks"] == 200
    assert found["changed_files"] == []


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["run", CONFIGS / "reference_bench.yaml"], "is a simulated bench: `rig bench` runs it"),
        (["check", MODELS / "reference.yaml"], "is a model: `model:` of a configuration"),
        (["bench", CONFIGS / "reference.yaml"], "is a configuration of the bridge: `rig run`"),
    ],
)
def test_a_file_of_another_kind_is_named(monkeypatch, capsys, given, says):
    assert rig(monkeypatch, *given) == 2
    assert says in capsys.readouterr().err


def test_the_next_command_after_a_run_can_be_typed(monkeypatch, tmp_path):
    """Results go into a folder that is free; a corrected model is evaluated."""
    monkeypatch.chdir(tmp_path)
    plan, run = load_plan(CONFIGS / "reference.yaml"), Path("run1")
    assert diagnosis_of(plan, run) == "rig diagnose run1 --model reference --out found"
    (tmp_path / "found").mkdir()
    assert diagnosis_of(plan, run).endswith("--out found_2")
    (tmp_path / "found" / "diagnosis.json").write_text("{}")
    following = diagnosis_of(plan, run, "found/corrected.yaml")
    assert following == "rig evaluate run1 --model found/corrected.yaml"


def test_no_name_is_cut_in_a_table(capsys):
    name = "nonlinear_stiffness: centred_cubic_stiffness"
    shown = table("effect", "parameter", "value", "95 % interval")
    shown.add_row(name, "stiffness_n_per_m3", "1" * 30, "2" * 40)
    console.print(shown)
    said = capsys.readouterr().out
    assert "…" not in said
    cells = [line.split("│")[1].strip() for line in said.splitlines() if line.startswith("│")]
    assert "".join(cells).replace(" ", "") == name.replace(" ", "")


def look(t_s, force_n=-123.4):
    strut = StrutOutput(force_n, 5.0, True, 0.4, 0.1, 0.0, 2e-5)
    return Look(
        round(t_s * 1e9),
        round(t_s * 990),
        StepOutput(Mode.RUNNING, (strut,)),
        Counts(lost=3, overruns=2),
        120_000,
    )


def test_a_reader_that_went_away_ends_no_run():
    read, write = os.pipe()
    kept = os.dup(2)
    os.dup2(write, 2)
    os.close(write)
    os.close(read)  # as `| head -1` leaves it
    try:
        with status_line(60.0) as watch:
            for second in range(0, 60, 10):
                watch(look(second))
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def test_a_reader_that_does_not_read_stops_no_run():
    read, write = os.pipe()
    kept = os.dup(2)
    os.dup2(write, 2)
    os.close(write)
    try:
        with status_line(None) as watch:
            for second in range(0, 20_000_000, 1000):
                watch(look(second))
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(read)


def test_the_status_of_a_second_run_is_shown_too(capfd):
    with status_line(20.0) as watch:
        for _ in range(2):
            for second in range(21):
                watch(look(second))
    assert len(capfd.readouterr().err.splitlines()) >= 4


def test_without_a_terminal_the_status_is_a_line_every_ten_seconds(capfd):
    with status_line(60.0) as watch:
        for tenth in range(0, 400, 2):
            watch(look(tenth / 10))
    lines = capfd.readouterr().err.splitlines()
    assert [line.split()[0] for line in lines] == ["10.0", "20.0", "30.0"]
    assert "of 60 s" in lines[0]
    for part in (
        "RUNNING",
        "force  -123.4 N",
        "height error  +0.020 mm",
        "lost 3",
        "missed 2",
        "late ≤ 0.12 ms",
    ):
        assert part in lines[0]
    assert "\r" not in lines[0]
    assert "\x1b" not in "".join(lines)


def test_on_a_terminal_of_80_columns_the_line_has_mode_and_reason(monkeypatch):
    said = []
    monkeypatch.setattr("rig.cli.progress._write", lambda text: said.append(text.decode()))
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    cause = {"cause": "beyond_safe", "quantity": "innovation_m", "value": 0.0101, "limit": 0.01}
    with status_line(60.0) as watch:
        watch(look(10.0))
        safe = look(20.0)
        watch(safe._replace(output=StepOutput(Mode.SAFE, safe.output.struts), cause=cause))
    running, stopped = (line.strip("\r").rstrip() for line in said[:2])
    assert max(map(len, (running, stopped))) < 80
    assert running.startswith("10.0 of 60 s  RUNNING  990 Hz  force  -123.4 N  height error")
    expected = "20.0 of 60 s  SAFE: height error (innovation) 10.1 mm (limit 10 mm)"
    assert stopped.replace("\u00a0", " ").startswith(expected)


def test_a_line_says_the_rate_that_was_kept(monkeypatch):
    said = []
    monkeypatch.setattr("rig.cli.progress._write", lambda text: said.append(text.decode()))
    with status_line(60.0) as watch:
        for second in (10.0, 20.0):
            watch(look(second))
    assert all("  990 Hz  " in line for line in said)
    assert len(said) == 2


def test_a_case_as_json(monkeypatch, capsys, tmp_path):
    asked = ("--case", "dyno", "--lockstep", "--duration-s", 1, "--json")
    assert rig(monkeypatch, "demo", *asked, "--out", tmp_path / "dyno") == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "dyno" / "summary.json").read_text())
    assert found["counts"]["lost"] == 0


def test_foxglove_takes_no_control(monkeypatch, capsys, tmp_path):
    assert rig(monkeypatch, "view", tmp_path, "--foxglove", "--control") == 2
    assert "--foxglove: expected neither --control nor --model" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["k[/red]", "k[bold]", "k\x1b[31m"])
def test_what_stands_in_a_table_is_neither_markup_nor_control(tmp_path, monkeypatch, capsys, name):
    """A path and an interface from outside stand in the table of `rig check`."""
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    config["bus"]["interface"] = f"virtual{name}"
    path = tmp_path / f"{name.replace('/', '')}.yaml"
    path.write_text(yaml.safe_dump(config))
    rig(monkeypatch, "check", path)
    shown = "".join(capsys.readouterr().out.split())
    assert f"virtual{name}".replace("\x1b", "\\x1b") in shown
    assert "\x1b" not in shown
