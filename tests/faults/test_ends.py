"""How a run ends on the bus: whatever ends it, the last that is said is invalid.

The listener is python-can's own bus, and cantools decodes what it received; the run's log is not
used.
"""

import itertools
import json
import signal
from collections import Counter

import can
import cantools
import pytest

from can_dbc.database import DEFAULT_DATABASE
from dart_model.plant import DartPlant
from rig.bridge.counts import Conditions
from rig.bridge.values import Mode, Request
from rig.bus.bus import Bus
from rig.bus.link import LinkFigures
from rig.cli.progress import stoppable
from rig.log.reader import read_run
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl
from rig.run.operator import Operator
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from tests.run.listed import ListPort, bench_frames

S = 1_000_000_000
DBC = cantools.database.load_file(DEFAULT_DATABASE)
ESTIMATE, STATUS = DBC.get_message_by_name("RIG_ESTIMATE"), DBC.get_message_by_name("RIG_STATUS")


class Listener:
    """What an independent node on the bus has received."""

    def __init__(self, channel):
        self._bus = can.Bus(interface="virtual", channel=channel, receive_own_messages=False)
        self.received = []

    def listen(self):
        while (message := self._bus.recv(0)) is not None:
            self.received.append(message)

    def close(self):
        self.listen()
        self._bus.shutdown()

    def decoded(self, message):
        return [
            message.decode(frame.data, decode_choices=False)
            for frame in self.received
            if frame.arbitration_id == message.frame_id
        ]


def run_until(folder, channel, ended_by, duration_s=3.0, **supervision):
    """A run of the reference case; `ended_by` is asked before each tick whether to end."""
    plan = load_plan(CONFIGS / "reference.yaml", duration_s=duration_s)
    content = plan.config.model_dump(mode="json")
    content["supervision"] |= supervision
    content["bus"]["channel"] = channel
    listener = Listener(channel)
    ticks = Counter()

    def stop():
        listener.listen()
        ticks["ticks"] += 1
        return ended_by(ticks["ticks"])

    try:
        ended = with_bench(
            plan.with_config(plan.config.model_validate(content)),
            load_bench_config(CONFIGS / "reference_bench.yaml"),
            folder,
            lockstep=True,
            control=RunControl(stop=stop),
        )
    finally:
        listener.close()
    return ended, listener


def assert_ends_invalid(listener, force_n=0.0):
    """The last three frames of each message are the safe output; what was before it was valid."""
    estimates, states = listener.decoded(ESTIMATE), listener.decoded(STATUS)
    assert [item["VALID"] for item in estimates[-3:]] == [0, 0, 0]
    assert [item["SPRING_DAMPER_FORCE"] for item in estimates[-3:]] == pytest.approx([force_n] * 3)
    assert [item["STATE"] for item in states[-3:]] == [Mode.SAFE] * 3
    assert estimates[-4]["VALID"] == 1
    # Frames of the end follow those before it: a receiver that checks counters accepts them.
    counters = [item["COUNTER"] for item in estimates[-20:]]
    assert [(after - before) % 16 for before, after in itertools.pairwise(counters)] == [1] * 19


def test_the_end_of_the_duration(tmp_path):
    ended, listener = run_until(tmp_path / "run", "ends_1", lambda _tick: False)
    assert_ends_invalid(listener)
    assert ended.state.mode is Mode.RUNNING
    assert read_run(tmp_path / "run").header["ending"]["status"] == "done"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal(number, tmp_path, monkeypatch):
    # Under `nohup` a hang-up is ignored, by the tests as well.
    monkeypatch.setattr(signal, "getsignal", lambda _number: signal.SIG_DFL)
    with stoppable() as is_stopped:

        def ended_by(tick):
            if tick == 2500:
                signal.raise_signal(number)
            return is_stopped()

        ended, listener = run_until(tmp_path / "run", f"ends_{number}", ended_by)
    assert ended.ticks == 2499
    assert_ends_invalid(listener)


def test_a_hang_up_that_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stoppable() as is_stopped:
            signal.raise_signal(signal.SIGHUP)
            assert not is_stopped()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_exception_within_a_tick(tmp_path, monkeypatch):
    step, calls = DartPlant.step, Counter()

    def fail_late(self, *arguments):
        calls["steps"] += 1
        if calls["steps"] == 2500:
            raise ZeroDivisionError("a fault of the program")
        return step(self, *arguments)

    monkeypatch.setattr(DartPlant, "step", fail_late)
    received = []
    monkeypatch.setattr(Listener, "close", lambda self: (self.listen(), received.append(self)))
    with pytest.raises(ZeroDivisionError):
        run_until(tmp_path / "run", "ends_exception", lambda _tick: False)
    assert_ends_invalid(received[0])
    assert read_run(tmp_path / "run").header["ending"]["status"] == "failed"


def test_the_last_valid_force_is_invalid_too(tmp_path):
    _, listener = run_until(tmp_path / "run", "ends_last", lambda _tick: False, safe_output="last")
    last_n = listener.decoded(ESTIMATE)[-4]["SPRING_DAMPER_FORCE"]
    assert last_n != 0.0
    assert_ends_invalid(listener, last_n)


def test_an_exception_of_a_driver_is_a_fault_of_the_bus(tmp_path, monkeypatch):
    receive, calls = Bus.receive, Counter()

    def fail(_timeout):
        raise IndexError("a fault of the driver")

    def receive_and_fail_once(self, elapsed_ns=S):
        calls["received"] += self._filters is not None  # the bridge's bus, not the bench's
        if calls["received"] != 3000:
            return receive(self, elapsed_ns)
        calls["received"] += 1
        self._receive = fail
        return receive(self, elapsed_ns)

    monkeypatch.setattr(Bus, "receive", receive_and_fail_once)
    ended, listener = run_until(tmp_path / "run", "ends_driver", lambda _tick: False, 6.0)
    assert ended.ticks == 6000
    assert ended.state.counts.bus_faulty > 0
    (gap,) = read_run(tmp_path / "run").header["ending"]["bus"]["gaps"]
    assert "a fault of the driver" in gap["why"]
    assert listener.decoded(ESTIMATE)[-1]["VALID"] == 0


def test_the_end_is_in_the_log_and_replays(tmp_path):
    _, listener = run_until(tmp_path / "run", "ends_log", lambda _tick: False)
    found = read_run(tmp_path / "run")
    sent = [frame.data for frame, direction in found.frames() if direction == "T"]
    own = {0x110, 0x120, 0x300, 0x310}
    received = [bytes(item.data) for item in listener.received if item.arbitration_id in own]
    assert sent == received
    again = replay(tmp_path / "run")
    assert (again.logged, again.different, again.steps.num_rows) == (3000, 0, 3000)


def test_before_a_bench_sends_the_bridge_says_that_it_waits():
    bridge = build_bridge(load_plan(CONFIGS / "reference.yaml"))
    state, result = bridge.tick(bridge.init(0), 0, [])
    by_id = {frame.arbitration_id: frame.data for frame in result.frames}
    assert ESTIMATE.decode(by_id[ESTIMATE.frame_id])["VALID"] == "INVALID"
    assert STATUS.decode(by_id[STATUS.frame_id])["STATE"] == "WAITING"
    assert state.mode is Mode.WAITING


def test_requests_are_on_record_with_who_made_them(tmp_path):
    plan = load_plan(CONFIGS / "reference.yaml", duration_s=0.6)
    supervision = plan.config.supervision.model_copy(update={"settling_s": 0.1, "arming": "manual"})
    plan = plan.with_config(plan.config.model_copy(update={"supervision": supervision}))
    port = ListPort(bench_frames(plan, 600, {}))
    operator = Operator()

    class Asked:
        """A port that an operator makes requests to, as a bus has one."""

        send = port.send

        def receive(self, t_ns):
            frames, _ = port.receive(t_ns)
            for tick, request in ((300, Request.ARM), (400, Request.DISARM)):
                if t_ns == tick * 1_000_000:
                    operator.ask(request, "anna")
            return frames, Conditions(request=operator.take())

    endpoint = Endpoint(Asked(), VirtualClock(), LinkFigures(), operator=operator)
    run_with_log(plan, build_bridge(plan), endpoint, tmp_path / "run", RunControl())
    text = (tmp_path / "run" / "events.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    asked = [line for line in lines if "request" in line]
    assert asked == [
        {"t_s": 0.3, "request": "arm", "by": "anna"},
        {"t_s": 0.4, "request": "disarm", "by": "anna"},
    ]
    changes = [(line["t_s"], line["to"]) for line in lines if "to" in line]
    assert changes[-2:] == [(0.3, "RUNNING"), (0.4, "READY")]


def test_events_and_times_in_each_mode_are_on_record(tmp_path):
    run_until(tmp_path / "run", "ends_events", lambda _tick: False)
    text = (tmp_path / "run" / "events.jsonl").read_text()
    lines = [json.loads(line) for line in text.splitlines()]
    changes = [(line["from"], line["to"], line.get("cause")) for line in lines]
    assert changes == [
        ("INIT", "WAITING", None),
        ("WAITING", "SETTLING", "fresh"),
        ("SETTLING", "RUNNING", "settled"),
    ]
    times_s = read_run(tmp_path / "run").header["ending"]["time_in_mode_s"]
    assert sum(times_s.values()) == pytest.approx(3.0)
    assert times_s["RUNNING"] == pytest.approx(3.0 - lines[-1]["t_s"])
