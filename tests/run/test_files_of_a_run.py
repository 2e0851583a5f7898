"""A run's folder holds every file that its replay needs, and says which is not the one that ran."""

import shutil
import sys

import pytest
import yaml

from rig.cli.main import main
from rig.log.errors import LogError
from rig.log.reader import find_changed_files, read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.replay import replay
from tests.run.listed import ListPort, bench_frames, live

BODY = """
  <worldbody>
    <body name="body">
      <joint name="guide" type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="10" diaginertia="1 1 1"/>
      <geom type="sphere" size="0.1"/>
    </body>
  </worldbody>
"""

MODEL = """
name: bench
skeleton: {file: bodies/bench.xml}
struts:
  - {name: strut, between: [world, body], free_length_m: 0.5, stiffness_n_per_m: 500,
     damping_n_s_per_m: 100}
"""

NEEDED = ["bodies/bench.xml", "bodies/parts/body.xml"]


@pytest.fixture
def run(tmp_path):
    """A run whose model is in several files, with a window captured around its safe state."""
    source = tmp_path / "source"
    (source / "bodies" / "parts").mkdir(parents=True)
    (source / "bench.yaml").write_text(MODEL)
    include = '<mujoco><include file="parts/body.xml"/></mujoco>'
    (source / "bodies" / "bench.xml").write_text(include)
    (source / "bodies" / "parts" / "body.xml").write_text(f"<mujoco>{BODY}</mujoco>")
    text = (CONFIGS / "reference.yaml").read_text().replace("model: reference", "model: bench.yaml")
    (source / "bench_run.yaml").write_text(text + "log: {most_captures: 1}\n")
    ready = load_plan(source / "bench_run.yaml", duration_s=2.0)
    live(ready, tmp_path / "run", ListPort(bench_frames(ready, 1000, {})))
    shutil.rmtree(source)
    return tmp_path / "run"


def test_a_changed_file_of_the_model_is_named(run, monkeypatch, capsys):
    assert find_changed_files(run) == []
    for name in NEEDED:
        path = run / name
        path.write_text(path.read_text().replace('mass="10"', 'mass="11"') + "\n")
    assert find_changed_files(run) == NEEDED
    monkeypatch.setattr(sys, "argv", ["rig", "replay", str(run)])
    with pytest.raises(SystemExit):
        main()
    assert "bodies/parts/body.xml is not the one that ran" in " ".join(
        capsys.readouterr().out.split()
    )


def test_a_run_and_its_captures_replay_without_the_files_they_were_started_from(run):
    captures = list((run / "captures").iterdir())
    assert len(captures) == 1
    for folder in (run, *captures):
        assert replay(folder).different == 0
        assert find_changed_files(folder) == []


def test_a_run_without_hashes_of_the_models_files_is_read(run):
    header = yaml.safe_load((run / "run.yaml").read_text())
    for name in NEEDED:
        del header["files_sha256"][name]
    (run / "run.yaml").write_text(yaml.safe_dump(header))
    (run / NEEDED[0]).write_text((run / NEEDED[0]).read_text() + "\n")
    assert read_run(run).steps.num_rows == 2000
    assert find_changed_files(run) == []


@pytest.mark.parametrize("name", ["/dev/zero", "../run.yaml", "bodies/../../run.yaml"])
def test_a_hash_of_a_file_elsewhere_is_refused(run, name):
    header = yaml.safe_load((run / "run.yaml").read_text())
    header["files_sha256"] = {name: "00"}
    (run / "run.yaml").write_text(yaml.safe_dump(header))
    with pytest.raises(LogError, match=r"files_sha256: .* expected a file in the folder"):
        find_changed_files(run)
