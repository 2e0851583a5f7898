"""`rig bench`: what it writes, and what it takes from a bridge's configuration."""

import json

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.log.reader import read_header, read_run
from rig.plan.config import CONFIGS


def test_it_takes_bus_and_key_from_the_bridge_and_writes_a_summary(tmp_path):
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    config["bus"] = {"interface": "virtual", "channel": "bench", "data_bitrate": 5_000_000}
    config["authentication"] = {"key_file": "bench.key"}
    bridge = tmp_path / "bridge.yaml"
    bridge.write_text(yaml.safe_dump(config))
    arguments = ["bench", str(CONFIGS / "reference_bench.yaml"), "--bridge", str(bridge)]
    arguments += ["--duration-s", "0.05", "--out", str(tmp_path / "out")]
    # Without the key it does not start.
    assert CliRunner().invoke(app, arguments).exit_code != 0
    assert not (tmp_path / "out").exists()
    (tmp_path / "bench.key").write_text("00" * 16)
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary == {"bench": "reference_bench", "frames": summary["frames"]}
    assert f"Sent {summary['frames']} frames" in done.output
    assert summary["frames"] > 0


def bench(*arguments):
    return CliRunner().invoke(app, ["bench", str(CONFIGS / "reference_bench.yaml"), *arguments])


def test_it_runs_a_bridge_with_it_without_its_bus(tmp_path):
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    # An interface that cannot be opened here: nothing is to open it.
    config["bus"] = {"interface": "pcan", "channel": "PCAN_USBBUS1"}
    bridge = tmp_path / "bridge.yaml"
    bridge.write_text(yaml.safe_dump(config))
    out = tmp_path / "run"
    arguments = ["--bridge", str(bridge), "--lockstep", "--duration-s", "3", "--out", str(out)]
    done = bench(*arguments, "--json")
    assert done.exit_code == 0
    assert json.loads(done.output)["mode"] == "RUNNING"
    assert read_header(out)["config"]["bus"]["interface"] == "virtual"
    again = bench(*arguments)
    assert isinstance(again.exception, InputError)
    assert "expected" in str(again.exception)


@pytest.mark.parametrize("kind", ["kalman", "pi"])
def test_its_end_reports_the_deviation_that_an_observer_states(kind, tmp_path):
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    if kind == "kalman":
        smoothing = {"bandwidth_hz": 20.0, "noise_std_m": 2e-5}
        config["observers"] = {"strut": {"kind": kind, "filter": smoothing}}
    bridge, out = tmp_path / "bridge.yaml", tmp_path / "run"
    bridge.write_text(yaml.safe_dump(config))
    done = bench(
        "--bridge", str(bridge), "--lockstep", "--duration-s", "3", "--out", str(out)
    )  # fmt: skip
    assert done.exit_code == 0
    said = " ".join(done.output.split())
    assert ("observer of strut stated while valid: median" in said) is (kind == "kalman")
    if kind == "kalman":
        steps = read_run(out).steps
        std_n = steps.column("strut.force_std_n").to_numpy()
        std_n = std_n[steps.column("strut.valid").to_numpy() == 1.0]
        assert f"median {np.median(std_n):.3g} N" in said


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--lockstep"], "--lockstep: expected --bridge CONFIG and --out DIR"),
        (["--model", "reference"], "--model: expected --lockstep"),
    ],
)
def test_options_that_need_others_are_refused_without_them(arguments, expected):
    done = bench(*arguments)
    assert isinstance(done.exception, InputError)
    assert expected in str(done.exception)
