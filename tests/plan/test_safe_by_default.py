"""What is refused before a bench moves, and what is said of a model that runs away."""

import os
import sys
from pathlib import Path

import pytest
import yaml

from rig.bridge.values import Mode
from rig.cli.main import main
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config


def rig(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def config(folder: Path, **changes: object) -> Path:
    data = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    data["realtime"] = {"fifo_priority": 0, "lock_memory": False, "freeze_garbage": False}
    path = folder / "my.yaml"
    path.write_text(yaml.safe_dump({**data, **changes}))
    return path


UNSTABLE = {"observers": {"strut": {"proportional_n_per_m": 1e8}}}


def test_what_the_check_calls_an_error_does_not_start(tmp_path, monkeypatch, capsys):
    path = config(tmp_path, **UNSTABLE)
    assert rig(monkeypatch, "run", path, "--out", tmp_path / "run") == 2
    assert "unstable" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_forced_run_says_so(tmp_path, monkeypatch):
    path = config(tmp_path, **UNSTABLE)
    out = tmp_path / "run"
    assert rig(monkeypatch, "run", path, "--out", out, "--force", "--duration-s", 0.05) == 1
    (forced,) = read_run(out).header["forced"]
    assert forced["what"] == "poles"
    assert "unstable" in forced["text"]


def test_a_folder_that_holds_something_is_not_written_into(tmp_path, monkeypatch, capsys):
    path = config(tmp_path)
    for name in ("frames.log", "model.yaml"):
        (tmp_path / name).write_text("mine")
    assert rig(monkeypatch, "run", path, "--out", tmp_path) == 2
    assert "is not empty" in capsys.readouterr().err
    assert (tmp_path / "frames.log").read_text() == "mine"


@pytest.mark.parametrize(("mode", "code"), [(0o600, 1), (0o640, 2), (0o604, 2)])
def test_a_key_that_others_can_read_is_refused(tmp_path, monkeypatch, capsys, mode, code):
    pytest.importorskip("cryptography")
    key = tmp_path / "bench.key"
    key.write_text("00112233445566778899aabbccddeeff\n")
    key.chmod(mode)
    path = config(
        tmp_path,
        bus={
            "interface": "virtual",
            "channel": f"key-{mode}-{os.getpid()}",
            "data_bitrate": 8_000_000,
        },
        authentication={"key_file": "bench.key"},
    )
    # No bench is there: a run that may start ends without a height.
    assert rig(monkeypatch, "run", path, "--out", tmp_path / "run", "--duration-s", 0.05) == code
    assert ("can be read by others" in capsys.readouterr().err) is (code == 2)


def run_away(tmp_path, **supervision):
    """A run whose model runs away."""
    data = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    data["observers"] = {"strut": {"proportional_n_per_m": 1e9, "force_limit_n": 1e300}}
    data["supervision"] = data.get("supervision", {}) | supervision
    path = tmp_path / "my.yaml"
    path.write_text(yaml.safe_dump(data))
    return with_bench(
        load_plan(path, duration_s=1.0),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        tmp_path / "run",
        lockstep=True,
    )


def test_a_model_that_runs_away_is_stopped_at_the_range_of_the_height(tmp_path):
    ended = run_away(tmp_path)
    supervised = ended.state.supervised
    assert supervised.mode is Mode.SAFE
    assert supervised.cause.quantity == "height_m"
    (stopped_m,) = supervised.stopped_m
    # 20 bits of 2 um to both sides of zero, and a tenth of the range.
    assert abs(supervised.cause.limit) == pytest.approx(1.2 * 1.048576, abs=1e-5)
    assert abs(stopped_m) > abs(supervised.cause.limit)


def test_a_model_that_diverges_is_told_with_its_strut_and_time(tmp_path):
    none = [{"value": item, "high": 1e300, "action": "warn"} for item in ("height_m", "force_n")]
    ended = run_away(tmp_path, limits=none)
    assert ended.diverged is not None
    assert ended.diverged["strut"] == "strut"
    ending = read_run(tmp_path / "run").header["ending"]
    assert ending["diverged"] == ended.diverged
    steps = read_run(tmp_path / "run").steps
    t_ns = round(ended.diverged["t_s"] * 1e9)
    at = steps.column("t_ns").to_pylist().index(t_ns)
    assert steps.column("mode").to_pylist()[at - 1 : at + 1] == [
        Mode.SETTLING,
        Mode.SAFE,
    ]


@pytest.mark.parametrize(("interface", "is_named"), [("socketcan", True), ("virtual", False)])
def test_a_real_bench_with_the_model_of_an_example_is_a_warning(tmp_path, interface, is_named):
    path = config(tmp_path, bus={"interface": interface, "channel": "can0"})
    found = [it for it in check(load_plan(path)) if it.what == "model"]
    assert bool(found) is is_named
    assert all("reference is an example that comes with rig" in it.text for it in found)
    assert all(it.severity is Severity.WARNING for it in found)


@pytest.mark.parametrize(
    ("has", "lacking"),
    [
        ([], ["strut and applied_force"]),
        ([{}], ["applied_force"]),
        ([{"channel": "applied_force"}], ["strut"]),
        ([{}, {"channel": "applied_force"}], []),
    ],
)
def test_sensors_whose_freezing_no_limit_finds_are_named(tmp_path, has, lacking):
    limits = [{**row, "value": "unchanged_s", "high": 0.5, "action": "hold"} for row in has]
    path = config(tmp_path, supervision={"limits": limits})
    found = [it.text for it in check(load_plan(path)) if it.what == "limits of frozen sensors"]
    assert [text.split("unchanged_s of ")[1].split(":")[0] for text in found] == lacking
