"""Three things that go wrong on benches, each with a defined end."""

import numpy as np

from rig.bridge.counts import Conditions
from rig.bridge.values import Mode
from rig.log.reader import read_run
from rig.log.whole_file import WholeFile
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.loop import RunControl
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.faults.trial import MS, Trial


def test_a_start_on_a_bench_that_moves_settles_to_the_usual_error():
    """The model begins at rest at the first height; the bench moves at half a metre a second."""
    begun = Trial()
    late = begun.bench.update(5_000 * MS)  # five seconds of the bench before the bridge is there
    assert late
    truth = simulate(begun.bench.config, 9_000 * MS, MS)
    for index in range(5_001, 9_000):
        t_ns = index * MS
        frames = begun.bench.update(t_ns)[0]
        begun.state, result = begun.bridge.tick(begun.state, t_ns, frames)
        if index == 5_001:
            first = abs(truth.velocity_m_per_s[index, 0])
            assert first > 0.3
        (strut,) = result.output.struts
        assert result.output.mode is Mode.RUNNING
        # The model lacks the bench's velocity and rings with sqrt(K_P / m) = 100 rad/s; the damping
        # ratio of 0.024 leaves an envelope of exp(-2.4 t).
        ringing_m = first / 100.0 * np.exp(-2.0 * (index - 5_001) * 1e-3)
        assert abs(strut.height_m - truth.height_m[index, 0]) < 2.5e-3 + ringing_m


def test_an_emergency_stop_while_the_disk_is_full_ends_the_run_in_order(tmp_path, monkeypatch):
    """What the disk took is whole and replays; `run.yaml` says what it did not take."""
    now_ns, full = [0], []
    append = WholeFile.append

    def broken(self, piece):
        if full:
            raise OSError(28, "No space left on device")
        append(self, piece)

    def progress(t_ns, _mode):
        now_ns[0] = t_ns
        if t_ns >= 400 * MS:
            full.append(True)

    monkeypatch.setattr(WholeFile, "append", broken)
    ended = with_bench(
        load_plan(CONFIGS / "reference.yaml"),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        tmp_path / "run",
        lockstep=True,
        control=RunControl(stop=lambda: now_ns[0] >= 600 * MS, progress=progress),
    )
    assert ended.ticks == 601
    ending = read_run(tmp_path / "run").header["ending"]
    assert ending["status"] == "done"
    assert ending["log_fault"] == "No space left on device"
    # From the last batch that went out whole up to the stop.
    assert 200 <= ending["dropped_steps"] <= 400
    monkeypatch.undo()
    found = replay(tmp_path / "run")
    assert found.different == 0
    assert found.steps.num_rows >= 400


def test_two_bridges_on_one_bus_each_report_the_other():
    """Both go on; both see somebody else under their ids, and say so in their status."""
    one, other = Trial(), Trial()
    sent = {one: [], other: []}
    flags = {one: 0, other: 0}
    for index in range(500):
        t_ns = index * MS
        measured = one.bench.update(t_ns)[0]
        before = dict(sent)
        for trial, rival in ((one, other), (other, one)):
            frames = [*measured, *before[rival]]
            trial.state, result = trial.bridge.tick(trial.state, t_ns, frames, Conditions())
            sent[trial] = result.frames
            for frame in result.frames:
                if frame.arbitration_id == 0x300:
                    flags[trial] += frame.data[7] >> 6 & 1
            assert result.output.mode is Mode.RUNNING or index < 5
    for trial in (one, other):
        # Every frame of the rival but those of the last tick, and a bus fault in each status.
        assert trial.state.counts.second_sender > 900
        assert flags[trial] >= 4
