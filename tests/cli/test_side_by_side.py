"""Several bridges by one command, over buses that nobody sends on."""

import json
import signal
import subprocess
import sys
import time

import pytest
import yaml

from rig.plan.config import CONFIGS


@pytest.fixture
def two(tmp_path):
    """Two configurations that differ by their names."""
    content = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    paths = [tmp_path / f"{name}.yaml" for name in ("left", "right")]
    for path in paths:
        path.write_text(
            yaml.safe_dump(content | {"bus": {"interface": "virtual", "channel": path.stem}})
        )
    return paths


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "rig", "run", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def eventually(holds, within_s):
    """Wait for what another process does; it tells nobody when it is done."""
    until_s = time.monotonic() + within_s
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.1)


@pytest.mark.long
def test_each_has_a_process_and_a_folder_and_the_worst_exit_code_counts(two, tmp_path):
    out = tmp_path / "runs"
    with started(*two, "--out", out, "--duration-s", 0.5, "--json") as process:
        printed, said = process.communicate(timeout=120)
    assert process.returncode == 1
    found = json.loads(printed)
    assert {name: item["exit_code"] for name, item in found.items()} == {"left": 1, "right": 1}
    assert {item["mode"] for item in found.values()} == {"WAITING"}
    for name in ("left", "right"):
        assert yaml.safe_load((out / name / "run.yaml").read_text())["ending"]["ticks"] > 100
        assert f"{name}: The model did not start: no valid height arrived" in said


@pytest.mark.long
def test_ctrl_c_ends_all_of_them_in_order(two, tmp_path):
    out = tmp_path / "runs"
    with started(*two, "--out", out) as process:
        eventually(lambda: all((out / path.stem / "timing.json").exists() for path in two), 60.0)
        process.send_signal(signal.SIGINT)
        printed, _ = process.communicate(timeout=60)
    assert process.returncode == 1  # no height ever came
    for path in two:
        assert "ending" in yaml.safe_load((out / path.stem / "run.yaml").read_text())
        assert path.stem in printed


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="the kernel says there that a parent died")
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGKILL])
def test_no_bridge_runs_on_without_its_parent(two, tmp_path, number):
    """A closed terminal, and a parent that is killed: each ends in order."""
    out = tmp_path / "runs"
    with started(*two, "--out", out) as process:
        eventually(lambda: all((out / path.stem / "timing.json").exists() for path in two), 60.0)
        process.send_signal(number)
        process.communicate(timeout=60)
    for path in two:
        file = out / path.stem / "run.yaml"
        eventually(lambda file=file: "ending" in yaml.safe_load(file.read_text()), 30.0)


def test_one_name_twice_and_a_folder_that_is_full_are_refused(two, tmp_path):
    (tmp_path / "other").mkdir()
    again = tmp_path / "other" / "left.yaml"
    again.write_text(two[0].read_text())
    with started(*two, again, "--out", tmp_path / "runs") as process:
        _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "left: two configurations of this name" in said
    full = tmp_path / "full" / "right"
    full.mkdir(parents=True)
    (full / "mine").touch()
    with started(*two, "--out", tmp_path / "full") as process:
        _, said = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "is not empty" in said
    assert not (tmp_path / "full" / "left").exists()


@pytest.mark.slow
def test_no_bridge_imports_a_module_of_the_working_directory(foreign_modules):
    for name in ("left", "right"):
        (foreign_modules.folder / f"{name}.yaml").write_text("rate_hz: none")
    command = [sys.executable, "-P", "-m", "rig", "run", "left.yaml", "right.yaml", "--out", "runs"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert foreign_modules.imported == []
    assert done.returncode == 2
    assert "left: rig: " in done.stderr  # it is rig that refuses
