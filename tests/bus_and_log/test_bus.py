"""A bus through python-can's `virtual` interface."""

import errno
import json

import can
import can.util
import pytest

from can_dbc.addressing import Filter
from can_dbc.frame import Frame
from rig.bus.bus import Bus, BusConfig, BusError

ONLY_0X100 = Filter(0x100, 0x7FF, is_extended=False)


@pytest.fixture
def config(request):
    return BusConfig("virtual", request.node.name, 500_000)


@pytest.fixture
def peer(config):
    bus = Bus(config)
    yield bus
    bus.close()


@pytest.fixture
def opened(config):
    """Open a bus that is closed after the test."""
    buses = []

    def open_bus(filters=None, **options):
        buses.append(Bus(config, filters, **options))
        return buses[-1]

    yield open_bus
    for bus in buses:
        bus.close()


def test_only_configured_ids_are_heard_and_foreign_ones_do_not_end_the_poll(opened, peer):
    bus = opened([ONLY_0X100, Filter(0x18FF0001, 0x1FFFFFFF, is_extended=True)])
    wanted = [Frame(7, 0x100, b"\1"), Frame(8, 0x18FF0001, b"\2", is_extended=True)]
    foreign = [Frame(7, 0x101, b""), Frame(7, 0x100, b"", is_extended=True), Frame(7, 0x7FF, b"")]
    for frame in (*foreign, wanted[0], *foreign, wanted[1], *foreign):
        peer.send(frame)
    assert bus.receive() == wanted


def test_a_flood_is_read_in_portions_and_none_of_it_is_lost(opened, peer):
    bus = opened([ONLY_0X100])
    for number in range(200):
        peer.send(Frame(number, 0x100, bytes([number])))
    portions = [bus.receive(999_999) for _ in range(5)]
    assert [len(portion) for portion in portions] == [64, 64, 64, 8, 0]
    assert [frame.data[0] for portion in portions for frame in portion] == list(range(200))


def test_error_frames_come_whatever_is_heard(opened, config):
    bus = opened([ONLY_0X100])
    raw = can.Bus(interface="virtual", channel=config.channel)
    try:
        raw.send(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False))
    finally:
        raw.shutdown()
    (frame,) = bus.receive()
    assert frame.is_error
    assert frame.arbitration_id == 0x40


def test_listen_only_never_calls_the_interface(opened, peer, monkeypatch):
    sent = []
    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "send", lambda *args: sent.append(args))
    bus = opened(listen_only=True)
    bus.send(Frame(0, 0x110, b"\1"))
    assert bus.listens_only
    assert sent == []
    assert peer.receive() == []


@pytest.mark.parametrize(
    ("name", "expected"),
    [("nosuch", "expected one of canalystii, "), ("socketcn", "did you mean socketcan")],
)
def test_an_interface_that_does_not_exist_is_one_line(name, expected):
    with pytest.raises(BusError, match=rf"bus\.interface '{name}': {expected}") as caught:
        Bus(BusConfig(name, "x", 500_000))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("number", "cure"),
    [
        (errno.EAFNOSUPPORT, "`modprobe can_raw` as root"),
        (errno.ENODEV, "`ip link set can7 up type can bitrate 500000` as root"),
        (errno.ENETDOWN, ": expected `ip link set can7 up"),
        (errno.EIO, "os error$"),
    ],
)
def test_a_kernels_refusal_names_its_cure(monkeypatch, number, cure):
    def refuse(**_arguments):
        raise OSError(number, "os error")

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(BusError, match=rf"'can7': cannot be opened: .*{cure}"):
        Bus(BusConfig("socketcan", "can7", 500_000))


def test_a_closed_bus_is_an_error_of_the_bus(config):
    bus = Bus(config)
    bus.close()
    with pytest.raises(BusError, match="receiving failed"):
        bus.receive()
    with pytest.raises(BusError, match="sending failed"):
        bus.send(Frame(0, 1, b""))


def test_all_that_a_frame_has_goes_through(opened, peer):
    bus = opened()
    frames = [
        Frame(1_000, 0x100, bytes(range(8))),
        Frame(2_000, 0x1ABCDEF, b"", is_extended=True),
        Frame(3_000, 0x100, bytes(64), is_fd=True, bitrate_switch=True),
    ]
    for frame in frames:
        peer.send(frame)
    assert bus.receive() == frames


def test_a_group_lets_in_every_source_address_of_it(opened, peer):
    bus = opened([Filter(0x18FEF100, 0x03FFFF00, is_extended=True)])
    wanted = [Frame(k, 0x0CFEF100 + k, b"", is_extended=True) for k in (0, 7, 255)]
    for frame in (*wanted, Frame(0, 0x18FEF200, b"", is_extended=True), Frame(0, 0x100, b"")):
        peer.send(frame)
    assert bus.receive() == wanted


def test_a_flood_of_foreign_identifiers_fills_no_memory(opened, peer):
    bus = opened([ONLY_0X100])
    for number in range(12_000):
        peer.send(Frame(0, number + 0x10000, b"", is_extended=True))
        if number % 60 == 0:
            bus.receive()
    bus.receive()
    assert len(bus._accepted) <= 10_001


def test_frames_that_come_back_are_no_second_senders():
    config = BusConfig("virtual", "returning", options={"receive_own_messages": True})
    bus, other = Bus(config), Bus(BusConfig("virtual", "returning"))
    own = Frame(0, 0x110, b"\x01", is_extended=False)
    try:
        for _ in range(2):
            bus.send(own)
        assert bus.receive() == []
        # One of the same content that was not sent here is a second sender's, whichever it is.
        bus.send(own)
        other.send(own)
        assert [frame.data for frame in bus.receive()] == [b"\x01"]
        other.send(own)
        assert [frame.data for frame in bus.receive()] == [b"\x01"]
    finally:
        bus.close()
        other.close()


OF_THE_USER = {"receive_own_messages": "True", "data_bitrate": "8000000"}
"""Settings of python-can that a user's own files may hold, for other programs."""


@pytest.mark.parametrize(
    "environment",
    [
        {"CAN_CONFIG": json.dumps(OF_THE_USER)},
        {"CAN_CONFIG": "no JSON"},
        {"CAN_INTERFACE": "nosuch", "CAN_CHANNEL": "other", "CAN_BITRATE": "5"},
    ],
)
def test_the_environment_of_python_can_changes_no_bus(opened, monkeypatch, environment):
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    hears_only_the_other_one(opened(), opened())


def test_the_files_of_python_can_change_no_bus(opened, monkeypatch, tmp_path):
    path = tmp_path / "can.ini"
    path.write_text("\n".join(["[default]", *map(" = ".join, OF_THE_USER.items())]))
    monkeypatch.setattr(can.util, "CONFIG_FILES", [str(path)])
    hears_only_the_other_one(opened(), opened())


def hears_only_the_other_one(bus, other):
    bus.send(Frame(1, 0x100, b"\1"))
    other.send(Frame(2, 0x101, b"\2"))
    assert bus.receive() == [Frame(2, 0x101, b"\2")]


TIMING = {"f_clock": 8_000_000, "brp": 1, "tseg1": 11, "tseg2": 4, "sjw": 2, "nof_samples": 1}


@pytest.mark.parametrize(
    ("channel", "options", "expected"),
    [
        ("can0", {"serial": "0123"}, {"channel": "can0", "serial": "0123"}),
        ("1", {}, {"channel": 1}),
        ("can0", {"state": "PASSIVE"}, {"state": can.BusState.PASSIVE}),
        ("can0", TIMING, {"timing": can.BitTiming(**TIMING)}),
    ],
)
def test_an_interface_is_given_what_a_file_can_only_describe(
    monkeypatch, channel, options, expected
):
    given = {}

    class Recorded(can.interfaces.virtual.VirtualBus):
        def __init__(self, channel, **others):
            given.update(others, channel=channel)
            super().__init__(channel)

    monkeypatch.setattr(can.interfaces.virtual, "VirtualBus", Recorded)
    Bus(BusConfig("virtual", channel, 500_000, options=options)).close()
    assert {key: given[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"state": "LOUD"}, r"^bus\.options\.state 'LOUD': expected one of ACTIVE, .*$"),
        (TIMING | {"brp": 0}, r"^bus\.options: expected a bit timing: .*$"),
        (TIMING | {"brp": "few"}, r"^bus\.options: expected a bit timing: .*$"),
    ],
)
def test_options_that_are_none_are_one_line(options, line):
    with pytest.raises(BusError, match=line):
        Bus(BusConfig("virtual", "x", 500_000, options=options))
