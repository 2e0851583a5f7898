"""What is installed, under which name, and what a reader is told to install."""

import re
import tomllib
from importlib.metadata import requires
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from rig.machine.installed_versions import DISTRIBUTION, version_of
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from tests.run.listed import ListPort, bench_frames, live

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
OF_OTHERS = ("dask[distributed]", "pyserial")
"""Projects of others that a message names."""
HASHES = ".hashes.txt"
_HINT = re.compile(r"""\bpip\s+install\s+((?:-\S+\s+|[.]constraints[.]txt\s+)*)['"]?([^\s'"`)]+)""")
_TEXTS = [
    *(path for name in ("rig", "dart_model", "can_dbc") for path in (ROOT / name).rglob("*.*")),
    *ROOT.glob("*.md"),
]


def hints():
    """File, options and requirement of each `pip install` in code, documents and pages."""
    for path in _TEXTS:
        if path.suffix in (".py", ".md", ".html", ".ipynb", ".yaml", ".js"):
            for options, wanted in _HINT.findall(path.read_text("utf-8")):
                yield str(path.relative_to(ROOT)), options.split(), wanted


def test_the_distribution_has_no_name_of_another_project_and_goes_to_no_index():
    assert PROJECT["name"] == DISTRIBUTION == "shock-rig"
    assert "Private :: Do Not Upload" in PROJECT["classifiers"]
    assert PROJECT["scripts"] == {"rig": "rig.cli.main:main"}


def test_no_extra_takes_the_name_of_another_project():
    wanted = [item for extra in PROJECT["optional-dependencies"].values() for item in extra]
    assert not [item for item in [*wanted, *PROJECT["dependencies"]] if re.match(r"rig\b", item)]


def test_every_hint_installs_the_local_clone():
    found = list(hints())
    assert {file for file, _, _ in found} >= {"README.md", "rig/bus/canopen_network.py"}
    assert [
        (file, wanted)
        for file, options, wanted in found
        if wanted not in (*OF_OTHERS, HASHES)
        and not (re.match(r"\.($|\[)", wanted) and "-e" in options)
    ] == []


def test_every_hint_names_an_extra_that_there_is():
    extras = {name for _, _, wanted in hints() for name in re.findall(r"^\.\[(\w+)\]", wanted)}
    assert len(extras) > 5
    assert extras <= set(PROJECT["optional-dependencies"])


def pinned(file):
    """Version of each package, and its hashes, by its name on an index."""
    text = (ROOT / file).read_text("utf-8").replace("\\\n", " ")
    lines = [line.split() for line in text.splitlines() if not line.startswith("#")]
    pins = [(*pin.split("=="), hashes) for pin, *hashes in lines]
    return {canonicalize_name(name): (version, hashes) for name, version, hashes in pins}


def test_hashes_are_those_of_the_versions_that_are_tested_together():
    versions, hashed = pinned(".constraints.txt"), pinned(HASHES)
    assert {name: version for name, (version, _) in hashed.items()} == {
        name: version for name, (version, _) in versions.items() if name in hashed
    }
    for _, hashes in hashed.values():
        assert hashes
        assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", item) for item in hashes)


def test_what_is_run_has_hashes():
    waiting = [*PROJECT["dependencies"]]
    needed = set()
    while waiting:
        requirement = Requirement(waiting.pop())
        name, marker = canonicalize_name(requirement.name), requirement.marker
        if name not in needed and (marker is None or marker.evaluate({"extra": ""})):
            needed.add(name)
            waiting += requires(name) or ()
    assert {*needed, "setuptools"} <= set(pinned(HASHES))


@pytest.mark.parametrize("package", ["rig", "numpy"])
def test_a_version_is_found_by_the_name_of_the_package(package):
    assert re.match(r"\d+\.\d+", version_of(package))


def test_a_run_has_the_version_under_the_name_rig(tmp_path):
    plan = load_plan(CONFIGS / "reference.yaml", duration_s=0.05)
    live(plan, tmp_path / "run", ListPort(bench_frames(plan, 50, {})))
    header = yaml.safe_load((tmp_path / "run" / "run.yaml").read_text("utf-8"))
    assert header["versions"]["rig"] == PROJECT["version"]
