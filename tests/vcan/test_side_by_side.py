"""Three bridges on three interfaces, each with a bench and a process of its own."""

import contextlib
import json
import subprocess
from pathlib import Path

import pytest
import yaml

from rig.log.reader import read_run
from tests.slow_reference import RATE_HZ
from tests.vcan.conftest import Files, in_process, run_for, run_until_terminated

pytestmark = pytest.mark.vcan

SECONDS = 20.0
PERIOD_S = 1.0 / RATE_HZ
SETTLED = 5 * RATE_HZ
"""Ticks within which the others start too, which takes the processor from those that run."""


class Punctuality:
    """How late the ticks of a run were, and how many were missed once all had started."""

    def __init__(self, folder: Path) -> None:
        self.ended = yaml.safe_load((folder / "run.yaml").read_text())["ending"]
        late_us = self.ended["timing"]["lateness_us"]
        self.p50_s, self.p99_s = (1e-6 * late_us[key] for key in ("p50", "p99"))
        overruns = read_run(folder).steps["overruns"].to_numpy()[SETTLED:]
        self.missed, self.ticks = int(overruns.sum()), len(overruns)

    def __str__(self) -> str:
        return (
            f"{self.missed} of {self.ticks} missed, late by {1e3 * self.p50_s:.3f} ms (median), "
            f"{1e3 * self.p99_s:.3f} ms (99 %)"
        )


def side_by_side(channels: list[str], files: Files, folder: Path) -> list[Punctuality]:
    with contextlib.ExitStack() as stack:
        for channel in channels:
            bench = (files.bench, channel, files.dbc)
            stack.enter_context(in_process(run_until_terminated, *bench))
            subprocess.run(["candump", "-n", "1", channel], check=True, timeout=300.0)
        bridges = [
            stack.enter_context(
                in_process(run_for, files.bridge(channel), folder / channel, SECONDS)
            )
            for channel in channels
        ]
        for bridge in bridges:
            bridge.join(1500.0)
    return [Punctuality(folder / channel) for channel in channels]


def test_each_of_three_is_as_punctual_as_alone(three_vcans, files, tmp_path, capsys):
    """One processor for all, so that a tick may wait for those of five others: the time of each."""
    alone = [side_by_side([name], files, tmp_path / "alone")[0] for name in three_vcans]
    together = side_by_side(list(three_vcans), files, tmp_path / "together")
    with capsys.disabled():
        print(
            json.dumps({"alone": [*map(str, alone)], "together": [*map(str, together)]}, indent=1)
        )
    for one, with_others in zip(alone, together, strict=True):
        assert with_others.missed <= one.missed + 0.01 * one.ticks
        assert with_others.p50_s < one.p50_s + 0.1 * PERIOD_S
        assert with_others.p99_s < one.p99_s + 0.5 * PERIOD_S
