"""Faults of the interface, the disk, the clock and the process."""

import dataclasses
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import yaml
from msgspec.structs import replace

from can_dbc.frame import Frame
from rig.bridge.counts import Conditions
from rig.bridge.values import Mode
from rig.bus.bus import BusError
from rig.bus.link import Link
from rig.log.reader import read_run
from rig.log.step_columns import LOG_FAULT
from rig.log.whole_file import WholeFile
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.loop import RunControl
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from tests.bridge.cores import FIRST
from tests.bus_and_log.at_once import AtOnce
from tests.faults.trial import (
    BEGIN_MS,
    BEGIN_NS,
    MS,
    SETTLING_MS,
    Trial,
    first_ms,
    force_error_n,
)

BUS_OFF = Frame(0, 0x040, bytes(8), is_error=True)
RESTARTED = Frame(0, 0x100, bytes(8), is_error=True)
END_MS = BEGIN_MS + 1000


AGAIN_MS = BEGIN_MS + 600 + SETTLING_MS + 1000
"""Time by which the estimate has settled again after a fault, and a second more."""


def assert_it_settled_again(ticks, since_ns):
    """The estimate is valid at the end, and from then on about as good as ever.

    Invalid from a time on until it had settled, and within three times the usual error since.
    """
    valid = [tick.t_ns for tick in ticks if tick.t_ns >= since_ns and tick.is_valid]
    begun_ns = next(t.t_ns for t in ticks if t.t_ns >= since_ns and t.mode is Mode.SETTLING)
    assert valid[0] == begun_ns + SETTLING_MS * MS
    assert valid == list(range(valid[0], len(ticks) * MS, MS))
    undisturbed_n = force_error_n(Trial().run(len(ticks)), valid[0])
    assert force_error_n(ticks, since_ns) < 3.0 * undisturbed_n


class Wire:
    """A bus whose frames are put into it, and that can be gone."""

    def __init__(self):
        self.epoch_ns = 0
        self.listens_only = False
        self.frames = []
        self.is_gone = False

    def receive(self, elapsed_ns):
        assert elapsed_ns >= 0
        if self.is_gone:
            raise BusError("receiving failed: Network is down")
        frames, self.frames = self.frames, []
        return frames

    def close(self):
        pass


class OnWire:
    """A trial whose frames come through a link."""

    def __init__(self, epoch_now_ns=lambda: 0):
        self.wire = Wire()
        self.link = Link(self._open, epoch_now_ns, AtOnce())
        self.trial = Trial()

    def _open(self):
        if self.wire.is_gone:
            raise BusError("cannot be opened")
        return self.wire

    def run(self, until_ms, change):
        def inject(t_ns, frames):
            self.wire.frames += change(t_ns, frames)
            return list(self.link.receive(t_ns))

        def conditions(_t_ns):
            return Conditions(bus_fault=self.link.fault is not None)

        return self.trial.run(until_ms, inject, conditions)


def test_bus_off(row):
    on_wire = OnWire()

    def fault(t_ns, frames):
        since_ms = (t_ns - BEGIN_NS) / MS
        if 0 <= since_ms <= 200:
            return [BUS_OFF] if since_ms == 0 else [RESTARTED] if since_ms == 200 else []
        return frames

    ticks = on_wire.run(AGAIN_MS, fault)
    figures = on_wire.link.figures
    assert (figures.bus_off, figures.error_frames) == (1, 2)
    assert ticks[-1].counts.bus_faulty == 200
    invalid_ms = first_ms(ticks, lambda tick: not tick.is_valid)
    hold_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    back_ms = first_ms(ticks, lambda tick: tick.mode is Mode.RUNNING, BEGIN_NS + 100 * MS) + 100
    # The frame of the restart itself is the first tick without a measurement less.
    assert back_ms == 200 + FIRST + SETTLING_MS
    assert_it_settled_again(ticks, BEGIN_NS + 100 * MS)
    row(
        13,
        "bus-off for 200 ms",
        f"BUS_FAULT; estimate invalid after {invalid_ms:.0f} ms, HOLD after {hold_ms:.0f} ms; the "
        "controller's restart is detected; the estimate is valid again when it has settled, "
        f"{back_ms - 200:.0f} ms after the restart",
        first_ms(ticks, lambda tick: tick.counts.bus_faulty > 0),
        "the frames during this time",
    )


def test_link_down(row):
    on_wire = OnWire()

    def fault(t_ns, frames):
        on_wire.wire.is_gone = 0 <= (t_ns - BEGIN_NS) / MS < 300
        return [] if on_wire.wire.is_gone else frames

    ticks = on_wire.run(AGAIN_MS, fault)
    (gap,) = on_wire.link.figures.gaps
    assert len(ticks) == AGAIN_MS
    assert_it_settled_again(ticks, BEGIN_NS + 100 * MS)
    hold_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    late_ms = (gap.to_ns - BEGIN_NS) / MS - 300
    assert 0 <= late_ms < 350
    row(
        14,
        "link down for 300 ms (`ip link down/up`, adapter unplugged)",
        f"BUS_FAULT, HOLD after {hold_ms:.0f} ms; tries to open the interface after 50, 100, 200, "
        f"... ms, then once a second (here opened {late_ms:.0f} ms after it was up); the gap is "
        "recorded in `run.yaml`",
        first_ms(ticks, lambda tick: tick.counts.bus_faulty > 0),
        "the frames during this time",
    )


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_clock_jump(row, step_s):
    step_ns = step_s * 1_000_000_000
    wall = [0]
    on_wire = OnWire(lambda: wall[0])
    reference_n = force_error_n(OnWire().run(END_MS, lambda _t_ns, frames: frames))

    def fault(t_ns, frames):
        wall[0] = step_ns if t_ns >= BEGIN_NS else 0
        shift_ns = wall[0] - on_wire.wire.epoch_ns
        return [replace(frame, t_ns=frame.t_ns + shift_ns) for frame in frames]

    ticks = on_wire.run(END_MS, fault)
    assert on_wire.link.figures.clock_steps == 1
    assert {tick.mode for tick in ticks[BEGIN_MS:]} == {Mode.RUNNING}
    assert force_error_n(ticks) == pytest.approx(reference_n, rel=1e-3)
    if step_s > 0:
        row(
            19,
            "the system's clock is set by an hour, forwards or backwards",
            "none: the run's clock is monotonic, and the frames' time stamps are converted to it; "
            "counted in `run.yaml`",
            "0 ms",
            "nothing",
        )


def lockstep(folder, name, duration_s, progress=lambda _t_ns, _mode: None):
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=duration_s)
    bus = dataclasses.replace(ready.config.bus, channel=name)
    return with_bench(
        ready.with_config(ready.config.model_copy(update={"bus": bus})),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        folder,
        lockstep=True,
        control=RunControl(progress=progress),
    )


def test_disk_full(row, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The kernel lets no file grow beyond this: the disk is full after 0.7 s or so.
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        ended = lockstep(tmp_path / "run", "full", 1.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert ended.ticks == 1500
    assert "large" in ended.log_fault
    found = read_run(tmp_path / "run")
    frames = list(found.frames())
    assert len(frames) > 1000
    assert found.steps.num_rows > 300
    ending = found.header["ending"]
    assert ending["log_fault"] == ended.log_fault
    assert ending["dropped_steps"] > 0
    assert replay(tmp_path / "run").different == 0
    row(
        15,
        "the disk is full during a run",
        "continues, LOG_FAULT; the written part remains complete and can be replayed; ticks wait "
        "in memory (two minutes at 1 kHz) and are written when there is space again",
        "1 ms",
        "the ticks that were not written when the run ended; `run.yaml` contains their number",
    )


def test_a_fault_of_the_log_is_in_the_next_ticks_status(tmp_path, monkeypatch):
    failing = []
    append = WholeFile.append

    def broken(self, piece):
        if failing:
            raise OSError(28, "No space left on device")
        append(self, piece)

    def progress(t_ns, _mode):
        if t_ns == 500 * MS:
            failing.append(True)
        elif t_ns == 600 * MS:
            failing.clear()

    monkeypatch.setattr(WholeFile, "append", broken)
    lockstep(tmp_path / "run", "broken", 1.0, progress)
    steps = read_run(tmp_path / "run").steps
    faulty_ms = np.flatnonzero(steps["flags"].to_numpy() & LOG_FAULT)
    # The tick after the one that could not be written, and up to the first that could.
    assert faulty_ms.tolist() == list(range(502, 602))
    assert steps.num_rows == 1000


def test_slow_disk(row, tmp_path, monkeypatch):
    released, reached = threading.Event(), threading.Event()
    append = WholeFile.append

    def slow(self, piece):
        if reached.is_set():
            released.wait(60.0)
        append(self, piece)

    modes = []

    def progress(t_ns, mode):
        modes.append(mode)
        if t_ns >= 500 * MS:
            reached.set()

    monkeypatch.setattr(WholeFile, "append", slow)
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=1.0)
    quiet = {"fifo_priority": 0, "lock_memory": False, "freeze_garbage": False}
    config = ready.config.model_copy(
        update={
            "bus": dataclasses.replace(ready.config.bus, channel="slow"),
            "realtime": ready.config.realtime.model_copy(update=quiet),
        }
    )
    timer = threading.Timer(1.5, released.set)
    timer.start()
    ended = with_bench(
        ready.with_config(config),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        tmp_path / "run",
        lockstep=False,
        control=RunControl(progress=progress),
    )
    timer.join()
    assert len(modes) == ended.ticks
    found = read_run(tmp_path / "run")
    assert found.steps.num_rows == ended.ticks
    assert found.header["ending"]["dropped_steps"] == 0
    assert replay(tmp_path / "run").different == 0
    row(
        16,
        "slow disk: a write takes one second",
        "the loop does not wait, because a separate thread writes; LOG_FAULT once 2 000 ticks wait "
        "in memory",
        "0 ms",
        "nothing",
    )


PROGRAM = Path(sys.executable).parent / "rig"


def demo_until_logged(folder, number):
    """A demo in real time; ends it with a signal when its log has grown, gives its exit code."""
    command = [PROGRAM, "demo", "--case", "reference", "--out", folder, "--duration-s", "60"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    frames, steps = folder / "run" / "frames.log", folder / "run" / "steps.arrow"

    def is_logged():
        # Steps too: their first batch is written after the first 0.2 s.
        return frames.exists() and frames.stat().st_size > 150_000 and steps.stat().st_size > 20_000

    try:
        while not is_logged():
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.05)
        process.send_signal(number)
        return process.wait(60.0)
    finally:
        process.kill()


@pytest.mark.slow
def test_sigkill(row, tmp_path):
    assert demo_until_logged(tmp_path / "demo", signal.SIGKILL) == -signal.SIGKILL
    found = read_run(tmp_path / "demo" / "run")
    again = replay(tmp_path / "demo" / "run")
    last_ns = max(frame.t_ns for frame, _ in found.frames())
    assert again.different == 0
    recomputed_ms = (last_ns - found.steps["t_ns"].to_numpy()[-1]) / MS
    assert again.steps["t_ns"].to_numpy()[-1] >= last_ns - MS
    row(
        17,
        "SIGKILL",
        "the process ends; all frames but those of the last 10 ms are on the disk, and a replay "
        "computes from them the ticks that the log does not have (here those of "
        f"{recomputed_ms:.0f} ms)",
        "0 ms",
        "frames of the last 10 ms",
    )


@pytest.mark.slow
def test_sigterm(row, tmp_path):
    assert demo_until_logged(tmp_path / "demo", signal.SIGTERM) == 0
    ending = yaml.safe_load((tmp_path / "demo" / "run" / "run.yaml").read_text())["ending"]
    # A machine that stands still for half a second leads to the safe state, and as orderly an end.
    assert ending["status"] == ("safe" if ending["mode"] == "SAFE" else "done")
    assert replay(tmp_path / "demo" / "run").different == 0
    row(
        18,
        "SIGTERM",
        "ends properly: the log is closed, `run.yaml` states the end",
        "one tick",
        "nothing",
    )
