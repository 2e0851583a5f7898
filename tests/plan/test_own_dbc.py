"""A foreign bus: one message in and one out, big-endian, without protection."""

from pathlib import Path

import can
import cantools
import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bridge.values import Mode
from rig.bus.bus import Bus
from rig.bus.link import Link, LinkFigures
from rig.machine.clock import VirtualClock
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check, errors
from rig.recordings.run_folder import _samples
from rig.run.logged_run import Endpoint, run_with_log
from rig.run.loop import RunControl
from rig.run.ports import BusPort
from rig.run.replay import replay
from tests.bridge.cores import FIRST
from tests.bus_and_log.at_once import AtOnce
from tests.new_bench.proposing import propose

MS = 1_000_000

DBC = """VERSION ""

NS_ :

BS_:

BU_: SENSOR CONTROL

BO_ 288 SENSOR_1: 8 SENSOR
 SG_ Travel : 7|16@0- (0.05,0) [-1600|1600] "mm" CONTROL
 SG_ OilTemp : 23|8@0+ (1,-40) [-40|215] "degC" CONTROL

BO_ 400 CONTROL_1: 8 CONTROL
 SG_ EstimatedForce : 7|16@0- (0.001,0) [-32|32] "kN" SENSOR
 SG_ Setpoint : 23|16@0- (0.1,0) [-3000|3000] "N" SENSOR

BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_ "GenMsgCycleTime" BO_ 288 1;
"""


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "my.dbc"
    path.write_text(DBC)
    return path


def test_what_was_proposed_runs_over_a_bus_and_replays(dbc, tmp_path):
    config = tmp_path / "my.yaml"
    text = propose(dbc).replace("interface: socketcan", "interface: virtual")
    text = text.replace("channel: can0", "channel: own-dbc")
    lines = [line for line in text.splitlines() if "temperature" not in line]
    config.write_text("\n".join([*lines, "unsafe: {publish_without_valid: true}"]))
    ready = load_plan(config, duration_s=0.3)
    assert not errors(ready)
    bridge = build_bridge(ready)
    clock = VirtualClock()
    bus = ready.config.bus
    link = Link(lambda: Bus(bus, bridge.filters), clock.epoch_now_ns, executor=AtOnce())
    peer = Bus(bus)
    other = cantools.database.load_file(dbc)

    class Bench:
        """Sends a height with another program's codec before each tick."""

        def __init__(self) -> None:
            self.forces: list[float] = []

        def receive(self, t_ns):
            payload = other.encode_message("SENSOR_1", {"Travel": 300.0, "OilTemp": 25})
            message = can.Message(timestamp=t_ns * 1e-9, arbitration_id=288, data=payload)
            message.is_extended_id = False
            peer._bus.send(message)
            return port.receive(t_ns)

        def send(self, frames):
            sent = port.send(frames)
            for frame in peer.receive():
                decoded = other.decode_message(frame.arbitration_id, frame.data)
                self.forces.append(decoded["EstimatedForce"])
            return sent

    port, bench = BusPort(link), Bench()
    try:
        endpoint = Endpoint(bench, clock, LinkFigures())
        ended = run_with_log(ready, bridge, endpoint, tmp_path / "run", RunControl())
    finally:
        link.close()
        peer.close()
    assert (ended.ticks, ended.state.counts.refused) == (300, 0)
    # The body's weight of 98.1 N, carried by the strut at rest, in steps of a newton.
    *during, last = bench.forces[:300]
    assert last * 1000.0 == pytest.approx(98.0, abs=25.0)
    # Nothing is known before the model starts, and nothing is said after the end.
    assert during[: FIRST - 1] == [0.0] * (FIRST - 1)
    assert bench.forces[300:] == [0.0] * 3
    found = replay(tmp_path / "run")
    assert (found.logged, found.different) == (300, 0)


def test_a_force_without_valid_is_an_error_that_the_user_may_take_upon_themselves(dbc, tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text(propose(dbc))
    (found,) = errors(load_plan(path))
    assert found.what == "publish.strut"
    assert "expected publish.valid, or unsafe: {publish_without_valid: true}" in found.text
    path.write_text(path.read_text() + "unsafe: {publish_without_valid: true}\n")
    assert not errors(load_plan(path))
    assert Severity.WARNING in [
        it.severity for it in check(load_plan(path)) if it.what == "publish.strut"
    ]


def test_a_frozen_height_is_no_estimate_as_it_was_proposed(dbc, tmp_path):
    """The measured height stays the same for longer than a sensor's noise allows."""
    (tmp_path / "my.yaml").write_text(propose(dbc) + "unsafe: {publish_without_valid: true}\n")
    bridge = build_bridge(load_plan(tmp_path / "my.yaml"))
    encode = cantools.database.load_file(dbc).encode_message
    state, modes = bridge.init(0), []
    for tick in range(2000):
        height_mm = 300.0 + 0.05 * (tick % 3 if tick < 500 else 0)
        data = encode("SENSOR_1", {"Travel": height_mm, "OilTemp": 25})
        state, result = bridge.tick(state, tick * MS, [Frame(tick * MS, 288, data)])
        modes.append(result.output.mode)
    assert modes[1000] is Mode.RUNNING
    assert set(modes[1502:]) == {Mode.HOLD}
    assert state.supervised.cause.quantity == "unchanged_s"


VALID_DBC = DBC.replace(
    " SG_ OilTemp", ' SG_ TravelOk : 32|2@0+ (1,0) [0|3] "" CONTROL\n SG_ OilTemp'
)


def with_valid(folder, valid):
    """A configuration whose height has a signal that says whether it is valid."""
    (folder / "my.dbc").write_text(VALID_DBC)
    config = yaml.safe_load(propose(folder / "my.dbc"))
    config["signals"]["height"]["valid"] = valid
    config["unsafe"] = {"publish_without_valid": True}
    path = folder / "my.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def test_frames_whose_sensor_says_that_it_does_not_measure_are_refused(tmp_path):
    bridge = build_bridge(load_plan(with_valid(tmp_path, {"signal": "TravelOk", "value": 2})))
    encode = cantools.database.load_file(tmp_path / "my.dbc").encode_message
    state, modes = bridge.init(0), []
    for tick in range(1300):
        # It says so in the frames of 100 ms, whose heights are far off.
        is_valid = not 900 <= tick < 1000
        height_mm = 300.0 + 0.05 * (tick % 3) if is_valid else 0.0
        said = 2 if is_valid else tick % 2
        data = encode("SENSOR_1", {"Travel": height_mm, "TravelOk": said, "OilTemp": 25})
        state, result = bridge.tick(state, tick * MS, [Frame(tick * MS, 288, data)])
        modes.append(result.output.mode)
    assert (state.counts.no_value, state.counts.refused) == (100, 100)
    assert modes[899] is modes[-1] is Mode.RUNNING
    assert set(modes[911:1000]) == {Mode.HOLD}


def test_a_diagnosis_leaves_out_what_the_sensor_does_not_measure(tmp_path):
    (channel,) = load_plan(with_valid(tmp_path, {"signal": "TravelOk", "value": 2})).heights
    encode = cantools.database.load_file(tmp_path / "my.dbc").encode_message
    data = [
        encode(
            "SENSOR_1", {"Travel": 10.0 * tick, "TravelOk": 2 if tick != 3 else 1, "OilTemp": 25}
        )
        for tick in range(6)
    ]
    payloads = np.frombuffer(b"".join(data), np.uint8).reshape(6, 8)
    t_s, height_m = _samples({"SENSOR_1": (np.arange(6) * MS, payloads)}, channel)
    assert t_s == pytest.approx([0.0, 0.001, 0.002, 0.004, 0.005])
    assert height_m == pytest.approx([0.0, 0.01, 0.02, 0.04, 0.05])


@pytest.mark.parametrize(
    ("valid", "text"),
    [
        ({"signal": "Nothing"}, r"height\.strut\.valid\.signal: .*Nothing"),
        (
            {"signal": "OilTemp"},
            r"valid\.signal: OilTemp has the unit degC, expected a",
        ),
        ({"signal": "TravelOk", "value": "yes"}, r"valid\.value"),
    ],
)
def test_a_signal_that_cannot_say_it_is_one_line(valid, text, tmp_path):
    with pytest.raises(InputError, match=text):
        load_plan(with_valid(tmp_path, valid))


def test_an_engine_that_is_not_there_is_one_line(tmp_path):
    text = (CONFIGS / "reference.yaml").read_text() + "\nengine: magic\n"
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(InputError, match=r"my\.yaml: engine 'magic': expected dart"):
        build_bridge(load_plan(tmp_path / "my.yaml"))
