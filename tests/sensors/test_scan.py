"""Scanning a bus on which devices of another stack are."""

import itertools
import json
import math

import can
import cantools
import pytest
from durand import CANBusNetwork, set_scheduler
from durand.scheduler import VirtualScheduler
from typer.testing import CliRunner

from can_dbc.codec import compile_decoder
from can_dbc.database import load_database
from can_dbc.errors import InputError
from can_dbc.units import Dimension, si_conversion
from rig.bus.bus import BusConfig
from rig.bus.canopen_network import CanOpenNetwork
from rig.cli.main import app
from rig.observers.kalman import KalmanObserver
from rig.plan.load import load_plan
from rig.plan.preflight_checks import check
from rig.sensors.bus_scan import scan
from rig.sensors.canopen_device import describe_device
from rig.sensors.canopen_set_up import (
    CanOpenSettings,
    DeviceWriter,
    ObjectChange,
    configure_device,
    restore,
)
from rig.sensors.proposed_config import dbc_text
from rig.sensors.undo_file import configure_with_undo, read_undo, write_undo
from tests.sensors.peer import KILONEWTON, amplifier, encoder, with_timer

NO_REMOTE_REQUEST = 1 << 30
_channels = itertools.count()


@pytest.fixture
def channel():
    return f"sensors-{next(_channels)}"


@pytest.fixture
def bus(channel):
    """The devices' ends of a bus of its own."""
    opened, networks = [], []

    def end():
        opened.append(can.Bus(interface="virtual", channel=channel))
        networks.append(CANBusNetwork(opened[-1]))
        networks[-1]._notifier.timeout = 0.05  # a second would be waited for at the end
        return networks[-1]

    set_scheduler(VirtualScheduler())  # no timer goes off by itself
    yield end
    for one in networks:
        one.stop()
    for one in opened:
        one.shutdown()


@pytest.fixture
def network(channel):
    made = CanOpenNetwork(BusConfig("virtual", channel, 500_000))
    yield made
    made.close()


def unheard(_what, _share):
    pass


def found_on(network):
    return scan(network, 0.05, progress=unheard)


def test_an_encoder_describes_itself(bus, network):
    encoder(bus(), 5, step_nm=5000, cycle_ms=4).object_dictionary.write(0x1017, 0, 100)
    (device,) = found_on(network).devices
    assert (device.node_id, device.label, device.heartbeat_s) == (5, "Linear encoder", 0.1)
    assert device.identity == (0x1A2, 7, 0x10002, 4711)
    assert device.kind == "encoder (CiA 406)"
    (pdo,) = device.pdos
    assert (pdo.arbitration_id, pdo.cycle_s, pdo.length_bytes) == (0x185, 0.004, 6)
    position, alarms = pdo.mapped
    assert position.meaning.scale == pytest.approx(0.005)
    assert (position.meaning.unit, position.meaning.is_signed) == ("mm", True)
    assert alarms.meaning.is_alarm
    assert alarms.start == 32


def test_an_amplifier_tells_unit_and_digits(bus, network):
    amplifier(bus(), 6, unit=KILONEWTON, digits=3)
    (device,) = found_on(network).devices
    force, status = device.pdos[0].mapped
    assert (force.meaning.name, force.meaning.unit) == ("FORCE_1", "kN")
    assert force.meaning.scale == pytest.approx(1e-3)
    assert status.meaning.is_alarm


def test_who_is_silent_and_who_is_no_device(bus, network):
    stranger = bus()
    stranger.send(0x70A, b"\x05")
    stranger.send(0x123, b"\x05")
    found = found_on(network)
    assert found.devices == ()
    assert found.silent == (10,)
    assert 0x123 in [item.arbitration_id for item in found.traffic]


def test_listening_only_sends_nothing(channel):
    other = can.Bus(interface="virtual", channel=channel)
    network = CanOpenNetwork(BusConfig("virtual", channel, 500_000), listen_only=True)
    found_on(network)
    network.close()
    assert other.recv(0) is None
    other.shutdown()


def test_dbc_and_configuration_are_read_back(bus, channel, tmp_path):
    node = encoder(bus(), 5, step_nm=1000, cycle_ms=2)
    node.object_dictionary.write(0x1017, 0, 100)
    node.object_dictionary.write(0x6004, 0, 250_000)
    amplifier(bus(), 6)
    out = tmp_path / "found"
    result = CliRunner().invoke(
        app,
        [
            *("sensor", "scan", "--interface", "virtual", "--channel", channel),
            *("--listen-s", "0.05", "--out", str(out)),
        ],
        catch_exceptions=False,
    )
    assert result.exit_code == 0, result.output
    database = load_database(out / "sensors.dbc")
    message = database.message("NODE_5_TPDO1")
    assert (message.sender, message.cycle_time_ns) == ("NODE_5", 2_000_000)
    decode = compile_decoder(message, ["POSITION"], [Dimension.LENGTH])
    # 1 µm a step.
    assert decode((250_000).to_bytes(4, "little") + b"\0\0")[0] == pytest.approx(0.25)
    force = compile_decoder(database.message("NODE_6_TPDO1"), ["FORCE_1"], [Dimension.FORCE])
    assert force((-1234).to_bytes(4, "little", signed=True) + b"\0")[0] == pytest.approx(-123.4)
    assert database.message("RIG_ESTIMATE").protection is not None
    ready = load_plan(out / "rig.yaml")
    assert ready.config.devices["NODE_5"].heartbeat_s == pytest.approx(0.25)
    assert [item.signal for item in ready.config.devices["NODE_5"].alarms] == ["ALARMS"]
    assert [item.signal for item in ready.config.devices["NODE_6"].alarms] == ["STATUS_1"]
    (observer,) = ready.observers
    expected = KalmanObserver.before_tuning(1e-6 / math.sqrt(12.0), 2_000_000)
    assert observer.kind == expected.kind
    assert observer.filter.bandwidth_hz == pytest.approx(expected.filter.bandwidth_hz, rel=1e-3)
    assert observer.filter.noise_std_m == pytest.approx(expected.filter.noise_std_m, rel=1e-3)
    findings = check(ready)
    assert any("step" in finding.text for finding in findings)
    assert not any("unstable" in finding.text for finding in findings)


def test_a_timer_of_its_own_is_set_and_put_back(bus, network, tmp_path):
    node = encoder(bus(), 5)
    with_timer(node, 10)
    objects = node.object_dictionary
    setting = DeviceWriter(network, 5)
    configure_device(setting, CanOpenSettings(cycle_ms=2, heartbeat_ms=100))
    assert objects.read(0x1800, 5) == 2
    assert objects.read(0x1017, 0) == 100
    assert objects.read(0x1800, 1) & ~NO_REMOTE_REQUEST == 0x185
    network.listen(0.05)
    assert node.nmt.state == 5
    write_undo(tmp_path / "before.yaml", setting.changes)
    restore(network, read_undo(tmp_path / "before.yaml"))
    assert objects.read(0x1800, 5) == 10
    assert objects.read(0x1017, 0) == 0
    network.listen(0.05)
    assert node.nmt.state == 127


def test_an_encoder_without_an_event_timer_has_its_own(bus, network):
    node = encoder(bus(), 5, cycle_ms=10)
    setting = DeviceWriter(network, 5)
    configure_device(setting, CanOpenSettings(cycle_ms=3))
    assert node.object_dictionary.read(0x6200, 0) == 3
    assert [(item.index, item.before) for item in setting.changes] == [(0x6200, "0a00")]


@pytest.mark.slow
def test_a_device_without_a_node_id_is_given_one(bus, network):
    encoder(bus(), 0xFF)
    found = found_on(network)
    assert found.unconfigured == (0x1A2, 7, 0x10002, 4711)
    network.give_node_id(9)
    network.search()
    network.listen(0.1)
    assert 9 in [device.node_id for device in found_on(network).devices]


def test_json_is_json(bus, channel):
    encoder(bus(), 5)
    arguments = ["sensor", "scan", "--interface", "virtual", "--channel", channel]
    result = CliRunner().invoke(app, [*arguments, "--listen-s", "0.05", "--json"])
    (device,) = json.loads(result.stdout)["devices"]
    assert device["pdos"][0]["mapped"][0]["meaning"]["unit"] == "mm"


class Listed:
    """Objects of a device that is not there."""

    def __init__(self, objects):
        self._objects = objects

    def read(self, index, subindex=0):
        found = self._objects.get((index, subindex))
        return None if found is None else found[0].to_bytes(found[1], "little")

    def is_signed(self, index, subindex):
        return None


def encoder_with(mapping, **changed):
    """A linear encoder with some mapping, by index, subindex and bits."""
    objects = {
        (0x1000, 0): (0x00080196, 4),
        (0x1800, 1): (0x185, 4),
        (0x1800, 2): (changed.get("transmission", 254), 1),
        (0x1800, 3): (changed.get("inhibit", 0), 2),
        (0x1800, 5): (10, 2),
        (0x1A00, 0): (len(mapping), 1),
        (0x6005, 1): (5000, 4),
    }
    for place, (index, subindex, bits) in enumerate(mapping, 1):
        objects[0x1A00, place] = (index << 16 | subindex << 8 | bits, 4)
    return describe_device(Listed(objects), 5)


def test_a_mapping_that_cannot_be_read_is_said():
    device = encoder_with([(0x6004, 0, 32), (0x6503, 0, 0), (0x6030, 1, 16)])
    assert [item.meaning.name for item in device.pdos[0].mapped] == ["POSITION"]
    assert any("entry 2 has 0 bits" in note for note in device.notes)
    whole = encoder_with([(0x6004, 0, 100)])
    assert any("entry 1 has 100 bits" in note for note in whole.notes)


@pytest.mark.parametrize(
    ("changed", "cycle_s"),
    [
        ({}, 0.01),
        ({"inhibit": 500}, 0.05),
        ({"transmission": 253}, None),
        ({"transmission": 0}, None),
    ],
)
def test_how_often_a_device_sends(changed, cycle_s):
    assert encoder_with([(0x6004, 0, 32)], **changed).pdos[0].cycle_s == cycle_s


@pytest.mark.parametrize(("unit", "digits"), [(0x00010000, 4), (0xFD010000, 1), (0xFA010000, 0)])
def test_a_height_is_one_in_any_unit(unit, digits):
    """A length of a measuring device in m, mm or µm."""
    objects = {
        (0x1000, 0): (0x00020194, 4),
        (0x1800, 1): (0x185, 4),
        (0x1800, 2): (254, 1),
        (0x1800, 5): (10, 2),
        (0x1A00, 0): (1, 1),
        (0x1A00, 1): (0x91300120, 4),
        (0x6131, 1): (unit, 4),
        (0x6132, 1): (digits, 1),
    }
    device = describe_device(Listed(objects), 5)
    mapped = device.pdos[0].mapped[0]
    metre = si_conversion(mapped.meaning.unit, Dimension.LENGTH).factor
    raw = round(0.25 / (metre * mapped.meaning.scale))
    (made,) = [
        message
        for message in cantools.database.load_string(dbc_text([device], ())).messages
        if message.name == "NODE_5_TPDO1"
    ]
    (value,) = made.decode(raw.to_bytes(4, "little")).values()
    assert float(value) * metre == pytest.approx(0.25, abs=1e-6)


def test_a_real_of_no_size_is_no_number():
    objects = {
        (0x1000, 0): (0x00020194, 4),
        (0x1800, 1): (0x185, 4),
        (0x1A00, 0): (1, 1),
        (0x1A00, 1): (0x61300110, 4),
    }
    device = describe_device(Listed(objects), 5)
    assert not device.pdos[0].mapped[0].meaning.is_float
    assert "NODE_5_TPDO1" in dbc_text([device], ())


def test_the_bridge_gives_way_to_a_sensor_with_one_of_its_ids():
    objects = {
        (0x1000, 0): (0x00080196, 4),
        (0x1800, 1): (0x110, 4),
        (0x1A00, 0): (1, 1),
        (0x1A00, 1): (0x60040020, 4),
    }
    text = dbc_text([describe_device(Listed(objects), 5)], ())
    by_name = {item.name: item for item in cantools.database.load_string(text).messages}
    assert by_name["NODE_5_TPDO1"].frame_id == 0x110
    assert by_name["RIG_ESTIMATE"].frame_id not in (0x110, 0x111)


def test_a_node_that_is_not_there_is_not_set(channel, tmp_path):
    before = tmp_path / "before.yaml"
    arguments = ["sensor", "set", "99", "--interface", "virtual", "--channel", channel]
    result = CliRunner().invoke(app, [*arguments, "--before", str(before)])
    assert "no answer" in str(result.exception)
    assert not before.exists()


DRIVE, GENERIC = 0x00020192, 0


@pytest.mark.parametrize(("device_type", "profile"), [(DRIVE, 402), (GENERIC, 0)])
def test_what_is_no_sensor_is_refused_before_anything_is_sent_to_it(
    bus, channel, tmp_path, monkeypatch, device_type, profile
):
    node = encoder(bus(), 5)
    node.object_dictionary.write(0x1000, 0, device_type)
    sent = []
    for name in ("write", "command"):
        monkeypatch.setattr(CanOpenNetwork, name, lambda *given: sent.append(given))
    undo = tmp_path / "before.yaml"
    write_undo(undo, [ObjectChange(node_id=5, index=0x1017, subindex=0, before="6400")])
    arguments = ["sensor", "set", "--interface", "virtual", "--channel", channel]
    for given in (
        ("5", "--cycle-ms", "2", "--heartbeat-ms", "50", "--before", str(tmp_path / "new.yaml")),
        ("--restore", str(undo)),
    ):
        result = CliRunner().invoke(app, [*arguments, *given])
        assert isinstance(result.exception, InputError)
        assert str(result.exception).startswith(f"node 5: device profile {profile} (1000h), ")
        assert "pre-operational" not in str(result.exception)
        assert "\n" not in str(result.exception)
    assert sent == []
    assert [path.name for path in tmp_path.iterdir()] == ["before.yaml"]


def set_new(channel, undo, node_id=9):
    arguments = ["sensor", "set", str(node_id), "--interface", "virtual", "--channel", channel]
    return CliRunner().invoke(app, [*arguments, "--new", "--cycle-ms", "3", "--before", str(undo)])


@pytest.mark.slow
def test_a_new_sensor_is_given_a_node_id_and_set(bus, channel, tmp_path):
    node = encoder(bus(), 0xFF)
    result = set_new(channel, tmp_path / "before.yaml")
    assert result.exit_code == 0, result.output
    assert "Node id 9 given to vendor 0x1a2" in result.stdout
    assert node.node_id == 9
    assert node.object_dictionary.read(0x6200, 0) == 3


@pytest.mark.slow
def test_a_new_device_that_is_no_sensor_keeps_no_node_id(bus, channel, tmp_path):
    node = encoder(bus(), 0xFF)
    node.object_dictionary.write(0x1000, 0, DRIVE)
    before = node.object_dictionary.read(0x6200, 0)
    result = set_new(channel, tmp_path / "before.yaml")
    assert isinstance(result.exception, InputError)
    assert str(result.exception).startswith("node 9: device profile 402 (1000h), ")
    assert str(result.exception).endswith("; it is without a node id again")
    assert (node.node_id, node.nmt.pending_node_id) == (0xFF, 0xFF)
    assert node.object_dictionary.read(0x6200, 0) == before
    assert list(tmp_path.iterdir()) == []


def test_a_node_id_is_not_given_twice(bus, channel, tmp_path):
    encoder(bus(), 9)
    unconfigured = encoder(bus(), 0xFF)
    result = set_new(channel, tmp_path / "before.yaml")
    assert isinstance(result.exception, InputError)
    assert "node 9 is on the bus, expected a node id that is free" in str(result.exception)
    assert unconfigured.node_id == 0xFF


def test_an_amplifier_is_set_and_put_back(bus, network, tmp_path):
    node = amplifier(bus(), 6)
    undo = tmp_path / "before.yaml"
    configure_with_undo(network, 6, CanOpenSettings(heartbeat_ms=100), undo)
    assert node.object_dictionary.read(0x1017, 0) == 100
    restore(network, read_undo(undo))
    assert node.object_dictionary.read(0x1017, 0) == 0


def test_a_device_that_refuses_on_the_way_may_be_pre_operational(bus, network, tmp_path):
    encoder(bus(), 5).object_dictionary[0x6200].access = "ro"
    refused = pytest.raises(InputError, match=r"the device may still be pre-operational; .* holds")
    with refused:
        configure_with_undo(
            network, 5, CanOpenSettings(cycle_ms=3, heartbeat_ms=100), tmp_path / "before.yaml"
        )
    assert [item.index for item in read_undo(tmp_path / "before.yaml")] == [0x1017, 0x6200]


def test_an_undo_that_cannot_be_written_is_said_before_anything_is_changed(bus, channel):
    node = encoder(bus(), 5)
    arguments = ["sensor", "set", "5", "--interface", "virtual", "--channel", channel]
    given = ["--heartbeat-ms", "50", "--before", "/nonexistent/x.yaml"]
    result = CliRunner().invoke(app, [*arguments, *given])
    assert "cannot be written" in str(result.exception)
    assert node.object_dictionary.read(0x1017, 0) == 0
