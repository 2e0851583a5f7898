"""The process that sends the safe output in place of a loop that stands still or is dead."""

import mmap
import os
import signal

import cantools
import pytest

from can_dbc.database import DEFAULT_DATABASE
from rig.bridge.bridge import Sending
from rig.bridge.outgoing_messages import compile_outgoing
from rig.bus.bus import BusConfig, BusError
from rig.bus.secoc import Authentication, Authenticator
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run import watchdog as module
from rig.run.watchdog import (
    Beat,
    Wake,
    Watchdog,
    _as_values,  # pyright: ignore[reportPrivateUsage]
    _secure,  # pyright: ignore[reportPrivateUsage]
    can_watch,
    safe_frames,
    watch,
)
from tests.faults.trial import BEGIN_MS, Trial
from tests.run.test_runs import lockstep

MS = 1_000_000
S = 1_000_000_000


@pytest.fixture
def trial():
    trial = Trial(settling_s=0.0)
    trial.run(BEGIN_MS)
    return trial


def beat_of(plan):
    messages, struts = len(plan.outgoing), len(plan.struts)
    return Beat.on(mmap.mmap(-1, Beat.size_of(messages, struts)), messages)


@pytest.mark.parametrize("is_last", [False, True])
def test_its_frames_continue_the_loops_own_and_are_invalid(trial, is_last):
    beat = beat_of(trial.ready)
    beat.write(trial.state)
    outgoing = [compile_outgoing(item.message, item.signals) for item in trial.ready.outgoing]
    dbc = cantools.database.load_file(DEFAULT_DATABASE)
    force_n = trial.ticks[-1].force_n if is_last else 0.0
    for sent in range(20):
        frames = safe_frames(outgoing, beat, sent, S, is_last=is_last)
        values = {
            dbc.get_message_by_frame_id(frame.arbitration_id).name: dbc.decode_message(
                frame.arbitration_id, frame.data, decode_choices=False
            )
            for frame in frames
        }
        estimate, status = values["RIG_ESTIMATE"], values["RIG_STATUS"]
        assert estimate["VALID"] == 0
        assert estimate["SPRING_DAMPER_FORCE"] == pytest.approx(force_n, abs=0.01)
        # The simulated bench's tick count is that of the frames: one at every tick.
        assert estimate["COUNTER"] == (BEGIN_MS + sent) % 16
        assert (status["STATE"], status["FIRST_CAUSE"]) == (4, 3)
        assert estimate["VIRTUAL_FORCE"] == 0.0
        motion = values["RIG_KINEMATICS"]
        assert {motion[name] for name in motion if name not in ("CRC", "COUNTER")} == {0.0}


class Scripted:
    """Looks every 10 ms; a script says when the loop ticks, and what comes through the pipe."""

    def __init__(self, beat, ticking, received):
        self._beat, self._ticking, self._received = beat, ticking, received
        self.now = 0
        self.sent = []

    def wait(self):
        self.now += 1
        if self._ticking(self.now):
            self._beat.ticks[0] += 1
        return Wake(self.now * 10 * MS, self._received(self.now))

    def send(self, sent):
        self.sent.append((self.now, sent))


def ending_at(look, received=b"end"):
    """What comes through the pipe at a look; nothing where the process died."""
    return lambda now: received if now == look else None


def watched(ticking, received):
    beat = Beat.on(mmap.mmap(-1, Beat.size_of(1, 1)), 1)
    scripted = Scripted(beat, ticking, received)
    return watch(beat, S // 2, scripted.wait, scripted.send), scripted.sent


def test_a_loop_that_ticks_is_left_alone():
    assert watched(lambda _now: True, ending_at(1000)) == (None, [])


def test_it_sends_from_the_age_on_until_the_loop_ticks_again():
    found = watched(lambda now: now <= 100 or 200 <= now <= 300, ending_at(400))
    # The last ticks are seen at looks 100 and 300: half a second is 50 of them.
    first = [(now, now - 151) for now in range(151, 200)]
    second = [(now, now - 351) for now in range(351, 400)]
    assert found == (None, first + second)


def test_a_loop_that_stands_still_after_its_first_tick_is_noticed():
    found, sent = watched(lambda now: now == 20, ending_at(100))
    assert found is None
    assert sent == [(now, now - 71) for now in range(71, 100)]


def test_before_the_first_tick_there_is_nothing_to_watch():
    assert watched(lambda _now: False, ending_at(300, b"")) == (None, [])
    assert watched(lambda _now: False, ending_at(300)) == (None, [])


def test_a_process_that_died_is_told_from_one_that_ended():
    assert watched(lambda _now: True, ending_at(30, b"")) == (0, [])
    # It stood still before: the counters go on from there.
    found, sent = watched(lambda now: now <= 10, ending_at(70, b""))
    assert found == len(sent) == 70 - 10 - 50 - 1


def test_only_a_shared_interface_of_a_run_that_sends_has_one():
    config = load_plan(CONFIGS / "reference.yaml").config
    shared = config.model_copy(update={"bus": BusConfig("socketcan", "vcan0")})
    off = config.supervision.model_copy(update={"watchdog": False})
    assert can_watch(shared, listen_only=False)
    assert not can_watch(shared, listen_only=True)
    assert not can_watch(config, listen_only=False)
    assert not can_watch(shared.model_copy(update={"supervision": off}), listen_only=False)


def test_its_frames_are_authenticated_as_the_loops_are(trial):
    how = Authentication(bytes(range(16)), 1, 3, S, S)
    secure = _secure(_as_values(how))
    beat = beat_of(trial.ready)
    outgoing = [compile_outgoing(item.message, item.signals) for item in trial.ready.outgoing]
    frames = [secure(it) for it in safe_frames(outgoing, beat, 0, 1000 * S, is_last=False)]
    received = Authenticator(how, 1000 * S).authenticate(
        [frame.__class__(0, frame.arbitration_id, frame.data, is_fd=True) for frame in frames]
    )
    assert len(received) == len(frames) > 0


def test_a_watchdog_that_cannot_start_ends_the_run_with_a_reason(tmp_path):
    watchdog = Watchdog(load_plan(CONFIGS / "reference.yaml"), tmp_path)
    assert watchdog.describe() == "watched"
    with pytest.raises(BusError, match=r"watchdog could not be started: .*run\.yaml"):
        watchdog.start()
    assert watchdog.describe().startswith("ended")
    watchdog.stop()


def process_of(watchdog):
    return watchdog._process.pid  # pyright: ignore[reportPrivateUsage]


def test_one_that_died_before_the_run_is_a_reason_at_once(tmp_path):
    watchdog = Watchdog(load_plan(CONFIGS / "reference.yaml"), tmp_path)
    os.kill(process_of(watchdog), signal.SIGKILL)
    with pytest.raises(BusError, match="could not be started: it has ended"):
        watchdog.start()
    watchdog.stop()


def test_one_that_does_not_get_ready_is_a_reason(tmp_path, monkeypatch):
    folder = lockstep(tmp_path / "run", "reference", 0.02)
    monkeypatch.setattr(module, "_READY_S", 0.0)  # less than its imports take
    watchdog = Watchdog(load_plan(CONFIGS / "reference.yaml"), folder)
    with pytest.raises(BusError, match="could not be started: not ready in 0 s"):
        watchdog.start()
    watchdog.stop()


def test_it_runs_on_every_core_and_ends_with_the_run(tmp_path):
    folder = lockstep(tmp_path / "run", "reference", 0.02)
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        watchdog = Watchdog(load_plan(CONFIGS / "reference.yaml"), folder)
    finally:
        os.sched_setaffinity(0, before)
    watchdog.start()
    assert os.sched_getaffinity(process_of(watchdog)) >= before
    watchdog.stop()
    assert watchdog.describe().endswith("exit code 0")


def test_a_beat_costs_nothing_but_numbers(trial):
    beat = beat_of(trial.ready)
    state = trial.state
    assert all(isinstance(item, Sending) for item in state.sendings)
    beat.write(state)
    beat.write(state)
    assert beat.ticks.tolist() == [2, *(item.number for item in state.sendings)]
    assert beat.forces_n.tolist() == [state.supervised.last_valid[0].force_n]
