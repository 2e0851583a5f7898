"""Things that go wrong on benches, each with a defined end, and the end of every run."""

import contextlib

import cantools.database
import numpy as np
import pytest

from can_dbc.database import DEFAULT_DATABASE
from rig.bridge.counts import Conditions
from rig.bridge.values import Mode
from rig.bus.link import LinkFigures
from rig.log.reader import read_run
from rig.log.whole_file import WholeFile
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.bridge.cores import FIRST
from tests.faults.trial import MS, SETTLING_MS, Trial
from tests.run.listed import ListPort, bench_frames


def test_a_start_on_a_bench_that_moves_is_valid_when_it_has_settled_to_the_usual_error():
    """The model begins at the bench's height and velocity; the force that it lacks comes later."""
    begun, begin_ms, end_ms = Trial(), 5_001, 9_000
    late = begun.bench.update((begin_ms - 1) * MS)[0]  # five seconds before the bridge is there
    assert late
    truth = simulate(begun.bench.config, end_ms * MS, MS)
    started_ms = begin_ms + FIRST - 1
    assert abs(truth.velocity_m_per_s[started_ms, 0]) > 0.3
    modes, errors_n = [], []
    for index in range(begin_ms, end_ms):
        t_ns = index * MS
        frames = begun.bench.update(t_ns)[0]
        begun.state, result = begun.bridge.tick(begun.state, t_ns, frames)
        modes.append(result.output.mode)
        if index < started_ms:
            continue
        (strut,) = result.output.struts
        assert strut.valid == (modes[-1] is Mode.RUNNING)
        errors_n.append(strut.force_n - truth.strut_force_n[index, 0])
        if index == started_ms:
            assert strut.velocity_m_per_s == pytest.approx(
                truth.velocity_m_per_s[index, 0], abs=0.01
            )
        # The force that is missing at the start, over K_P, rings with sqrt(K_P / m) = 100 rad/s;
        # the damping ratio of 0.024 leaves an envelope of exp(-2.4 t).
        ringing_m = abs(errors_n[0]) / 1e5 * np.exp(-2.0 * (index - started_ms) * 1e-3)
        assert abs(strut.height_m - truth.height_m[index, 0]) < 2.5e-3 + ringing_m
    waiting, running = FIRST - 1, end_ms - started_ms - SETTLING_MS
    assert modes == (
        [Mode.WAITING] * waiting + [Mode.SETTLING] * SETTLING_MS + [Mode.RUNNING] * running
    )
    usual_n = rms(errors_n[-1000:])
    assert max(rms(errors_n[first : first + 100]) for first in range(0, 500, 100)) > 3.0 * usual_n
    assert rms(errors_n[SETTLING_MS : SETTLING_MS + 200]) < 3.0 * usual_n


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


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


class Heard(ListPort):
    """A bench of its own that keeps what it is sent."""

    def __init__(self, frames):
        super().__init__(frames)
        self.sent = []

    def send(self, frames):
        self.sent.append(list(frames))
        return frames


def decoded(frames, name):
    message = cantools.database.load_file(DEFAULT_DATABASE).get_message_by_name(name)
    return [
        message.decode(frame.data, decode_choices=False)
        for frame in frames
        if frame.arbitration_id == message.frame_id
    ]


@pytest.mark.parametrize("fails_at_ms", [None, 60])
def test_whatever_ends_a_run_the_last_that_the_bus_hears_is_the_safe_output(tmp_path, fails_at_ms):
    """Three times, one a tick; the run itself ended in the mode that it was in."""
    plan = load_plan(CONFIGS / "reference.yaml", duration_s=0.1)
    port, bridge = Heard(bench_frames(plan, 100, {})), build_bridge(plan)

    def progress(t_ns, _mode):
        if fails_at_ms is not None and t_ns == fails_at_ms * MS:
            raise RuntimeError("a fault of the program")

    endpoint = Endpoint(port, VirtualClock(), LinkFigures())
    expected = pytest.raises(RuntimeError) if fails_at_ms else contextlib.nullcontext()
    with expected:
        ended = run_with_log(
            plan, bridge, endpoint, tmp_path / "run", RunControl(progress=progress)
        )
        assert ended.state.mode is Mode.SETTLING
    ticks = 100 if fails_at_ms is None else fails_at_ms + 1
    *during, one, two, three = port.sent
    assert len(during) == ticks
    for name in ("RIG_ESTIMATE", "RIG_KINEMATICS", "RIG_STATUS", "RIG_TIMING"):
        assert [len(decoded(frames, name)) for frames in (one, two, three)] == [1, 1, 1]
    last = [*one, *two, *three]
    for values in decoded(last, "RIG_ESTIMATE"):
        assert values["VALID"] == values["SPRING_DAMPER_FORCE"] == values["VIRTUAL_FORCE"] == 0
    for values in decoded(last, "RIG_KINEMATICS"):
        assert values["MODEL_HEIGHT"] == pytest.approx(0.4, abs=0.05)
        assert values["MODEL_VELOCITY"] == 0.0
    assert [values["STATE"] for values in decoded(last, "RIG_STATUS")] == [Mode.SAFE] * 3
    # They stand in the log without a step, and a replay ends with the last step.
    folder = read_run(tmp_path / "run")
    assert [frame for frame, _ in folder.frames()][-len(last) :] == last
    assert replay(tmp_path / "run").different == 0
    if fails_at_ms is None:
        assert folder.steps.num_rows == ticks
        assert folder.steps.column("mode").to_pylist()[-1] == Mode.SETTLING


def test_two_bridges_on_one_bus_each_report_the_other():
    """Both go on; both see somebody else under their ids, and say so in their status."""
    one, other = Trial(settling_s=0.0), Trial(settling_s=0.0)
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
            assert result.output.mode is (Mode.RUNNING if index >= FIRST - 1 else Mode.WAITING)
    for trial in (one, other):
        # Every frame of the rival but those of the last tick, and a bus fault in each status.
        assert trial.state.counts.second_sender > 900
        assert flags[trial] >= 4
