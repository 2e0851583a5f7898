"""Runs in every mode, with motion and load cell, as they look while they are being recorded."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import yaml

from can_dbc.frame import Frame
from rig.bridge.counts import Conditions
from rig.bridge.values import Request
from rig.bus.link import LinkFigures
from rig.log.file_names import RUN_FILE
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config

MS = 1_000_000
Filtered = Callable[[int, list[Frame]], list[Frame]]
"""Time of a tick in ms and the bench's frames -> those that arrive."""

OBSERVER = {
    "kind": "kalman",
    "filter": {"bandwidth_hz": 16.0, "noise_std_m": 1e-5},
    "force_limit_n": 5000.0,
}


class BenchPort:
    """A simulated bench whose frames may be lost, and requests of operators."""

    def __init__(self, bench: SimulatedBench, arrive: Filtered, requests: dict[int, Request]):
        self._bench, self._arrive, self._requests = bench, arrive, requests

    def receive(self, t_ns):
        ms = t_ns // MS
        frames = self._arrive(ms, list(self._bench.update(t_ns)[0]))
        return frames, Conditions(request=self._requests.get(ms))

    def send(self, frames):
        return frames


def all_of_them(_ms, frames):
    return frames


def none_from(begin_ms):
    return lambda ms, frames: frames if ms < begin_ms else []


def supervised(**settings):
    return {"stale_after_s": 0.01, "safe_after_s": 0.5, "watchdog": False, **settings}


def limit(value, high, action):
    return {"limits": [{"value": value, "low": -high, "high": high, "action": action}]}


STATES: dict[str, tuple[int, Filtered, dict[str, object]]] = {
    "running": (6000, all_of_them, supervised()),
    "waiting": (5000, none_from(0), supervised()),
    "settling": (60, all_of_them, supervised()),
    "hold": (4100, none_from(4000), supervised()),
    "safe_silent": (6000, none_from(4000), supervised()),
    "safe_innovation": (6000, all_of_them, supervised(**limit("innovation_m", 1e-4, "safe"))),
    "safe_force": (6000, all_of_them, supervised(**limit("force_n", 150.0, "safe"))),
    "safe_difference": (
        6000,
        all_of_them,
        supervised(**limit("force_difference_n", 8.0, "safe")),
    ),
    "ready": (4000, all_of_them, supervised(arming="manual")),
}
"""Length in ms, frames that arrive, supervision."""


def make_state(folder: Path, name: str, *, ended: bool = False) -> Path:
    """A run in a mode, without its ending unless it has ended."""
    length_ms, arrive, supervision = STATES[name]
    folder.mkdir(parents=True, exist_ok=True)
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    config |= {"observers": {"strut": OBSERVER}, "supervision": supervision}
    cell = {"message": "BENCH_AUXILIARY", "signal": "LOAD_CELL_FORCE"}
    config["signals"] = {**config.get("signals", {}), "load_cell_force": cell}
    config.pop("timing", None)
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    plan = load_plan(folder / "rig.yaml", duration_s=length_ms * 1e-3)
    bench = SimulatedBench(load_bench_config(CONFIGS / "reference_bench.yaml"), plan.database)
    endpoint = Endpoint(BenchPort(bench, arrive, {}), VirtualClock(), LinkFigures())
    run = folder / name
    run_with_log(plan, build_bridge(plan), endpoint, run, RunControl())
    if not ended:
        header = yaml.safe_load((run / RUN_FILE).read_text())
        del header["ending"]
        (run / RUN_FILE).write_text(yaml.safe_dump(header))
    return run


def touch(run: Path) -> None:
    """Let the files of a run have been written just now."""
    now = time.time()
    for path in run.iterdir():
        os.utime(path, (now, now))
