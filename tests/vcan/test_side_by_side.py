"""Three bridges on three interfaces, each with a bench and a process of its own."""

import contextlib
import json
import subprocess
from pathlib import Path

import pytest
import yaml

from rig.log.reader import read_run
from rig.plan.load import load_plan
from tests.slow_reference import RATE_HZ
from tests.vcan.conftest import Files, in_process, run_plan, run_until_terminated

pytestmark = pytest.mark.vcan

SECONDS = 12.0
COUNTED = slice(5 * RATE_HZ, 9 * RATE_HZ)
"""Ticks beside which no other starts or ends, which takes the processor from those that run."""


class Punctuality:
    """How late the ticks of a run were, and how many were missed while all others ran."""

    def __init__(self, folder: Path) -> None:
        self.ended = yaml.safe_load((folder / "run.yaml").read_text())["ending"]
        late_us = self.ended["timing"]["lateness_us"]
        self.p50_s, self.p99_s = (1e-6 * late_us[key] for key in ("p50", "p99"))
        overruns = read_run(folder).steps["overruns"].to_numpy()[COUNTED]
        self.missed, self.ticks = int(overruns.sum()), len(overruns)

    def __str__(self) -> str:
        return (
            f"{self.missed} of {self.ticks} missed, late by {1e3 * self.p50_s:.3f} ms (median), "
            f"{1e3 * self.p99_s:.3f} ms (99 %)"
        )


def side_by_side(channels: list[str], files: Files, folder: Path) -> list[Punctuality]:
    # Loaded here, so that all start at once.
    plans = {it: load_plan(files.bridge(it), duration_s=SECONDS) for it in channels}
    with contextlib.ExitStack() as stack:
        for channel in channels:
            bench = (files.bench, channel, files.dbc)
            stack.enter_context(in_process(run_until_terminated, *bench))
            subprocess.run(["candump", "-n", "1", channel], check=True, timeout=300.0)
        bridges = [
            stack.enter_context(in_process(run_plan, plan, folder / channel))
            for channel, plan in plans.items()
        ]
        for bridge in bridges:
            bridge.join(1500.0)
    return [Punctuality(folder / channel) for channel in channels]


def test_each_of_three_misses_no_more_ticks_than_one_alone(three_vcans, files, tmp_path, capsys):
    """One processor for all: a tick may wait for those of the five others, but not for its next.

    By how much it is late depends on the phases in which they happened to start.
    """
    (alone,) = side_by_side(list(three_vcans[:1]), files, tmp_path / "alone")
    together = side_by_side(list(three_vcans), files, tmp_path / "together")
    with capsys.disabled():
        print(json.dumps({"alone": str(alone), "together": [*map(str, together)]}, indent=1))
    for with_others in together:
        assert with_others.missed <= alone.missed + 0.01 * alone.ticks
