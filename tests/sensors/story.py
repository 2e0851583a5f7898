"""From a bus without a DBC to a diagnosis, and what faults of the sensors end with."""

import json
import multiprocessing
from collections.abc import Callable
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from typer.testing import CliRunner

from rig.bridge.values import Mode
from rig.cli.main import app
from rig.log.reader import read_run
from rig.plan.load import load_plan
from rig.run.live import live
from rig.run.logged_run import Ended
from rig.run.loop import RunControl
from rig.run.replay import replay
from tests.sensors.dyno import (
    AMPLIFIER,
    DAMPING_N_S_PER_M,
    ENCODER,
    FREE_LENGTH_M,
    FRICTION_N,
    HEARTBEAT_MS,
    STANDING_M,
    STIFFNESS_N_PER_M,
)

S = 1_000_000_000

MODEL = {
    "name": "dyno",
    "skeleton": {
        "bodies": [
            {
                "name": "body",
                "mass_kg": 10.0,
                "joint": {"type": "prismatic", "axis": [0, 0, 1], "parent": "world"},
            }
        ]
    },
    "struts": [
        {
            "name": "strut",
            "between": ["world", "body"],
            "free_length_m": FREE_LENGTH_M,
            "stiffness_n_per_m": STIFFNESS_N_PER_M,
            "damping_n_s_per_m": DAMPING_N_S_PER_M,
            "effects": [],
        }
    ],
}
"""What the dyno is without its friction."""


class Line(NamedTuple):
    """A bus, and a way to the dyno on it."""

    interface: str
    channel: str
    orders: "Queue[str]"


def queue() -> "Queue[str]":
    return multiprocessing.get_context("fork").Queue()


def rig(*arguments: object) -> str:
    result = CliRunner().invoke(app, [str(item) for item in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def configured(line: Line, folder: Path) -> Path:
    """Scan, set to work, and complete the configuration: no DBC is written by hand."""
    bus = ("--interface", line.interface, "--channel", line.channel)
    out = folder / "found"
    rig("sensor", "scan", *bus, "--listen-s", 0.5, "--out", out)
    for node in (ENCODER, AMPLIFIER):
        before = folder / f"before-{node}.yaml"
        given = ("--heartbeat-ms", HEARTBEAT_MS, "--cycle-ms", 10)
        rig("sensor", "set", node, *bus, *(given if node == ENCODER else ()), "--before", before)
    path = out / "rig.yaml"
    config = yaml.safe_load(path.read_text())
    config |= {
        "model": "dyno.yaml",
        "prescribed_motion": {"settling_s": 0.02},
        "realtime": {"fifo_priority": 0, "lock_memory": False},
        # A machine that is busy, or emulated, makes a heartbeat late.
        # Importing all anew for a watchdog takes minutes where the kernel is emulated.
        "supervision": {"stale_after_s": 0.3, "safe_after_s": 30.0, "watchdog": False},
    }
    config["devices"]["NODE_5"]["heartbeat_s"] = 1.0
    path.write_text(json.dumps(config))
    (out / "dyno.yaml").write_text(json.dumps(MODEL))
    rig("zero", path, "--length-m", STANDING_M)
    return path


def run(config: Path, folder: Path, seconds: float, at: Callable[[float], None]) -> Ended:
    """A run, with something done at times of it."""
    done: set[float] = set()

    def progress(t_ns: int, _mode: Mode) -> None:
        t_s = t_ns // (S // 10) / 10
        if t_s not in done:
            done.add(t_s)
            at(t_s)

    ready = load_plan(config, duration_s=seconds)
    return live(ready, folder, control=RunControl(progress=progress))


def diagnosed(line: Line, folder: Path, seconds: float) -> dict[str, Any]:
    """Scan, run, log, replay, diagnose: what the diagnosis found."""
    config = configured(line, folder)
    line.orders.put("move")
    ended = run(config, folder / "run", seconds, lambda _t_s: None)
    assert ended.state.mode is Mode.RUNNING
    counts = ended.state.counts
    assert (counts.device_faulty, counts.wrong_length, counts.no_value) == (0, 0, 0), counts
    assert replay(folder / "run").different == 0
    out = folder / "diagnosis"
    rig("diagnose", folder / "run", "--model", config.parent / "dyno.yaml", "--out", out)
    return json.loads((out / "diagnosis.json").read_text())


class Fault(NamedTuple):
    """What a fault ended with."""

    wrong: list[dict[str, str]]
    modes: set[int]
    ended: Ended


def with_faults(line: Line, config: Path, folder: Path) -> dict[str, Fault]:
    """Runs of six seconds, each with a fault of the height's sensor from the second one on."""
    found: dict[str, Fault] = {}
    for order, after in (("emergency", "well"), ("silent", "well"), ("short", "long")):
        given = {2.0: order}

        def at(t_s: float, given: dict[float, str] = given) -> None:
            if t_s in given:
                line.orders.put(given.pop(t_s))

        ended = run(config, folder / order, 6.0, at)
        line.orders.put(after)
        steps = read_run(folder / order).steps
        ending = yaml.safe_load((folder / order / "run.yaml").read_text())["ending"]
        wrong = [item["wrong"] for item in ending["devices"]]
        assert replay(folder / order).different == 0
        found[order] = Fault(wrong, set(steps["mode"].to_pylist()), ended)
    return found


def assert_friction_was_found(found: dict[str, Any]) -> None:
    """That a diagnosis names what the dyno has and the model lacks, and nothing else.

    Frames that wait for a busy machine are no noise of a sensor: what they leave makes the verdict
    of a right answer a partial one.
    """
    assert found["verdict"] in ("explained", "partly_explained"), found
    residual_n = found["held_out"]["residual_force_rmse_n"]
    assert residual_n["after"] < 0.1 * residual_n["before"], found
    (effect,) = found["effects"]
    assert effect["family"] == "friction"
    friction = effect["parameters"]["coulomb_force_n"]
    assert friction["value"] == pytest.approx(FRICTION_N, rel=0.05)


def assert_faults_ended(found: dict[str, Fault]) -> None:
    """That each fault ended as the table of faults says."""
    for order, wrong in (("emergency", "emergency 0x8130"), ("silent", "no heartbeat")):
        assert found[order].wrong == [{"NODE_5": wrong}]
        assert found[order].modes >= {Mode.RUNNING, Mode.HOLD}
        assert found[order].ended.state.counts.from_faulty_device > 50
    assert found["short"].ended.state.counts.wrong_length > 50
    assert found["short"].ended.state.mode is Mode.HOLD
