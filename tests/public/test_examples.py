"""The examples: the commands of their READMEs, run as written, find what the READMEs say."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rig

EXAMPLES = Path(rig.__file__).parent / "examples"
FOUND = {
    "foreign_dbc": ("presliding_friction", "coulomb_force_n", 40.0, 0.01),
    "quarter_car": ("presliding_friction", "coulomb_force_n", 120.0, 0.01),
    "dyno_file": ("coulomb_friction", "coulomb_force_n", 45.0, 0.02),
    "j1939": ("hertz_bump_stop", "contact_height_m", 0.3, 0.001),
}
"""Example -> the effect that its bench has, one of its parameters with its value, and a tolerance
relative to it."""


def commands_of(readme):
    """Commands of a README, but for those that serve a page until Ctrl-C."""
    lines = re.findall(r"^ {4,}(rig .+)$", readme.read_text("utf-8"), re.MULTILINE)
    return [shlex.split(line)[1:] for line in lines if not line.startswith("rig view")]


def test_every_example_is_listed_and_every_listed_one_is_there():
    listed = re.findall(r"^\| `(\w+)`", (EXAMPLES / "README.md").read_text("utf-8"), re.MULTILINE)
    folders = [path.name for path in EXAMPLES.iterdir() if path.is_dir()]
    assert sorted(listed) == sorted(folders) == sorted([*FOUND, "notebook"])


SLOW = ("foreign_dbc", "quarter_car")
"""Each takes a minute or two."""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name in SLOW)) for name in FOUND]
)
def test_an_example_finds_what_its_bench_has(tmp_path, name):
    folder = tmp_path / name
    shutil.copytree(EXAMPLES / name, folder)
    commands = commands_of(folder / "README.md")
    assert commands
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-P", "-m", "rig", *command],
            cwd=folder,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, (command, done.stdout[-2000:], done.stderr[-2000:])
    found = json.loads((folder / "found" / "diagnosis.json").read_text())
    effect, parameter, expected, tolerance = FOUND[name]
    assert found["verdict"] == "explained"
    [missing] = found["effects"]
    assert missing["name"] == effect
    assert missing["parameters"][parameter]["value"] == pytest.approx(expected, rel=tolerance)
