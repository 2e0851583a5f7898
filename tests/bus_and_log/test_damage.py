"""What is damaged says so: each command on a run whose frames or steps have changed."""

import math
import os
import shutil
import zlib

import pytest
import yaml

from rig.cli.main import main
from rig.log.checksums import find_damage
from rig.log.errors import LogError
from rig.log.file_names import CHECKSUMS_FILE
from rig.log.reader import read_header, read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of two seconds, in parts of one."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    plan = load_plan(CONFIGS / "reference.yaml", duration_s=2.5)
    log = plan.config.log.model_copy(update={"rotate_s": 1.0})
    plan = plan.with_config(plan.config.model_copy(update={"log": log}))
    bench = load_bench_config(CONFIGS / "reference_bench.yaml")
    with_bench(plan, bench, folder, lockstep=True)
    return folder


@pytest.fixture
def run(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "run")


def commands(run, tmp_path):
    """Each command that reads a run, and whether it uses the frames alone."""
    return {
        "export": ["export", run, "--format", "csv", "--out", tmp_path / "run.csv"],
        "replay": ["replay", run],
        "report": ["report", run, "--out", tmp_path / "report.html"],
        "diagnose": ["diagnose", run, "--out", tmp_path / "diagnosis", "--model", "reference"],
    }


def call(monkeypatch, arguments):
    monkeypatch.setattr("sys.argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def flip(path, at):
    data = bytearray(path.read_bytes())
    data[at % len(data)] ^= 0x40
    path.write_bytes(data)


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


DAMAGES = {
    "a bit of the steps": (lambda run: flip(run / "steps.arrow", 60_000), "steps.arrow is not"),
    "a bit of a later part": (lambda run: flip(run / "steps.0001.arrow", -900), "steps.0001.arrow"),
    "the schema of the steps": (lambda run: flip(run / "steps.arrow", 40), "steps.arrow is not"),
    "a bit of the frames": (lambda run: flip(run / "frames.log", 50_000), "frames.log is not"),
    "frames cut off": (lambda run: cut(run / "frames.log", 0.05), "frames.log has"),
    "steps cut off": (lambda run: cut(run / "steps.0002.arrow", 0.5), "steps.0002.arrow has"),
    "a part is missing": (lambda run: (run / "frames.0001.log").unlink(), "0001.log is missing"),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", ["export", "replay", "report", "diagnose"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_command_names_what_is_damaged_and_fails(
    damage, command, run, tmp_path, monkeypatch, capsys
):
    make, text = DAMAGES[damage]
    make(run)
    assert call(monkeypatch, commands(run, tmp_path)[command]) == 1
    error = capsys.readouterr().err.replace("\n", "")
    assert "damaged: " in error
    assert text in error


def test_a_whole_run_is_not_damaged(run, tmp_path, monkeypatch):
    assert find_damage(run) == ()
    for command in ("export", "replay", "report"):
        assert call(monkeypatch, commands(run, tmp_path)[command]) == 0


def test_the_checksums_are_those_of_the_files(run):
    lines = [line.split() for line in (run / CHECKSUMS_FILE).read_text().splitlines()]
    names = {path.name for path in run.glob("frames.*")} | {it.name for it in run.glob("steps.*")}
    assert {name for _, _, name in lines} == names
    assert len(names) == 6
    for crc32, size, name in lines:
        data = (run / name).read_bytes()
        assert (int(crc32, 16), int(size)) == (zlib.crc32(data), len(data))


def test_no_number_of_a_damaged_file_is_read_as_a_step(run):
    whole = read_run(run).steps
    flip(run / "steps.0001.arrow", 40_000)
    found = read_run(run).steps
    assert found.num_rows < whole.num_rows
    times = whole.column("t_ns").to_pylist()
    kept = {times.index(t_ns) for t_ns in found.column("t_ns").to_pylist()}
    # As texts, in which NaN is NaN.
    assert repr(found.to_pylist()) == repr(whole.take(sorted(kept)).to_pylist())


def test_a_changed_dbc_fails_the_replay(run, monkeypatch, capsys):
    path = run / "bus.dbc"
    path.write_text(path.read_text() + "\n")
    assert call(monkeypatch, ["replay", run]) == 1
    assert "bus.dbc" in capsys.readouterr().out


def test_a_run_that_was_killed_is_not_damaged(run):
    """Its last part has no checksum: it ends where the kill came."""
    path = run / CHECKSUMS_FILE
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-2]))
    cut(run / "steps.0002.arrow", 0.5)
    assert find_damage(run) == ()


@pytest.mark.parametrize("line", ["nonsense", "00000000 -1 frames.log", "00000000 1 ../../secret"])
def test_a_line_that_is_no_checksum_is_one_line(line, run):
    (run / CHECKSUMS_FILE).write_text(line + "\n")
    with pytest.raises(LogError, match=r"checksums\.txt: line 1: .*: expected a checksum"):
        find_damage(run)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"config": None}, "config: expected a mapping"),
        ({"config": [1]}, "config: expected a mapping"),
        ({"config": {"bus": None}}, r"config\.bus: expected a mapping"),
        ({"config": {"bus": {"bitrate": 0}}}, r"config\.bus\.bitrate: 0: expected bits per second"),
        ({"config": {"bus": {"data_bitrate": "x"}}}, r"data_bitrate: x: expected bits per second"),
        ({"config": {"rate_hz": math.nan}}, r"config\.rate_hz: nan: expected a finite number"),
        ({"ending": "done"}, "ending: expected a mapping"),
        ({"ending": {"counts": [1]}}, r"ending\.counts: expected a mapping"),
        (
            {"ending": {"counts": {"lost": math.inf}}},
            r"counts\.lost: inf: expected a finite number",
        ),
        ({"ending": {"other": [1.0, [-math.inf]]}}, "ending.other: -inf: expected a finite number"),
        ({"capture": ["a fault"]}, "capture: expected a mapping"),
    ],
)
def test_a_header_of_other_entries_is_one_line(run, change, expected):
    path = run / "run.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | change))
    with pytest.raises(LogError, match=expected):
        read_header(run)


def test_a_pipe_in_place_of_a_header_is_one_line(run):
    (run / "run.yaml").unlink()
    os.mkfifo(run / "run.yaml")
    with pytest.raises(LogError, match="is no file"):
        read_header(run)
