"""`rig bench`: what it writes, and what it takes from a bridge's configuration."""

import json

import yaml
from typer.testing import CliRunner

from rig.cli.main import app
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
