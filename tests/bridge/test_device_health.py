"""Health of a device by its own frames, after CiA 301 and SAE J1939-81, and what it may be."""

import itertools
import math

import pytest
from msgspec.structs import replace
from pydantic import ValidationError

from can_dbc.frame import Frame
from rig.bridge.devices import (
    Device,
    DeviceHealth,
    DeviceSettings,
    fault,
    faults,
    initial_health,
    is_from,
    update_by_alarm,
    update_by_claim,
    update_by_data,
    update_by_frame,
)

MS = 1_000_000
NODE = 5
EMERGENCY, HEARTBEAT = 0x85, 0x705
OPERATIONAL = 5
NAME = 0x8000_2E05_1234_5678
CLAIM = 0x18EEFF00
NO_ADDRESS = 0xFE
DEVICE = Device("D", NODE, EMERGENCY, 0, alarms=2)
WATCHED = DEVICE._replace(heartbeat_ns=10 * MS)
J1939 = Device("J", 0, 0, 0, j1939_name=NAME, address=0x20)
WELL = DeviceHealth(100, alarms=(0, 0))


def emergency(code, register):
    return Frame(200, EMERGENCY, code.to_bytes(2, "little") + bytes([register]) + bytes(5))


def heartbeat(state, t_ns=200):
    return Frame(t_ns, HEARTBEAT, bytes([state]))


def after(device, *frames, health=WELL):
    for frame in frames:
        health = update_by_frame(device, health, frame)
    return health


CANOPEN = {"node_id": 1, "emergency_id": 1, "heartbeat_s": 0.001}
OF_J1939 = {"j1939_name": 0, "source_address": 0}


@pytest.mark.parametrize("given", list(itertools.product((False, True), repeat=5)))
def test_a_device_is_of_canopen_or_of_j1939(given):
    keys = [*CANOPEN, *OF_J1939]
    chosen = {key for key, is_given in zip(keys, given, strict=True) if is_given}
    is_canopen = "node_id" in chosen and chosen <= set(CANOPEN)
    settings = {key: value for key, value in (CANOPEN | OF_J1939).items() if key in chosen}
    if is_canopen or chosen == set(OF_J1939):
        assert DeviceSettings(**settings).model_dump(exclude_unset=True) == settings
    else:
        with pytest.raises(ValidationError, match="expected node_id, optionally with"):
            DeviceSettings(**settings)


@pytest.mark.parametrize(
    ("key", "within", "beyond"),
    [
        ("node_id", (1, 127), (0, 128, True, 5.0, "5")),
        ("emergency_id", (1, 0x7FF), (0, 0x800, True, 128.0)),
        ("heartbeat_s", (0.001, 165.0), (0.00099, 165.1, math.inf, math.nan)),
        ("j1939_name", (0, 2**64 - 1), (-1, 2**64, True, 7.0)),
        ("source_address", (0, 253), (-1, 254, True, 32.0)),
        ("nodeid", (), (5,)),
    ],
)
def test_settings_are_within_what_the_standards_allow(key, within, beyond):
    others = OF_J1939 if key in OF_J1939 else {"node_id": 1}
    for value in within:
        assert getattr(DeviceSettings(**others | {key: value}), key) == value
    for value in beyond:
        with pytest.raises(ValidationError, match=key):
            DeviceSettings(**others | {key: value})


def test_a_device_has_sixteen_alarms_at_most():
    alarms = [{"message": "M", "signal": f"ALARM{number}"} for number in range(17)]
    assert DeviceSettings(node_id=1, alarms=alarms[:16]).device("D", is_vital=True).alarms == 16
    with pytest.raises(ValidationError, match="alarms"):
        DeviceSettings(node_id=1, alarms=alarms)


def test_a_device_of_canopen_follows_from_its_settings():
    plain = DeviceSettings(node_id=127).device("D", is_vital=True)
    assert plain == Device("D", 127, 0x0FF, 0, 0, True, None, NO_ADDRESS)
    assert plain.ids == (0x0FF, 0x77F)
    settings = DeviceSettings(node_id=3, emergency_id=0x123, heartbeat_s=0.0041)
    made = settings.device("D", is_vital=False)
    assert made == Device("D", 3, 0x123, 4_100_000, 0, False, None, NO_ADDRESS)
    assert isinstance(made.heartbeat_ns, int)
    assert made.ids == (0x123, 0x703)


@pytest.mark.parametrize("address", [0, 253])
def test_a_device_of_j1939_follows_from_its_settings(address):
    made = DeviceSettings(j1939_name=NAME, source_address=address).device("J", is_vital=True)
    assert (made.node_id, made.heartbeat_ns, made.j1939_name, made.address) == (
        0,
        0,
        NAME,
        address,
    )
    assert made.ids == ()
    assert initial_health(made, 7) == DeviceHealth(7, OPERATIONAL, 0, (), address)


def test_a_device_is_taken_to_be_well_until_it_says_otherwise():
    assert Device("D", NODE, EMERGENCY, 0) == Device(
        "D", NODE, EMERGENCY, 0, 0, True, None, NO_ADDRESS
    )
    assert initial_health(DEVICE, 100) == DeviceHealth(100, OPERATIONAL, 0, (0, 0), NO_ADDRESS)
    assert DeviceHealth(100) == DeviceHealth(100, OPERATIONAL, 0, (), NO_ADDRESS)
    assert fault(DEVICE, initial_health(DEVICE, 100), 10**15) is None


@pytest.mark.parametrize(
    ("code", "register", "error_code"),
    [
        (0x8130, 0x11, 0x8130),
        (0x5000, 0x00, 0x5000),  # whatever the register says
        (0x0100, 0x00, 0x0100),
        (0x0000, 0x00, 0),
        (0x00FF, 0x00, 0),  # codes 00xx report the end of an error
        (0x0000, 0x01, 0x1000),  # an error that nobody has named
        (0x0034, 0x80, 0x0034),
    ],
)
def test_an_emergency_reports_an_error_or_its_end(code, register, error_code):
    health = after(DEVICE, emergency(code, register))
    assert health == replace(WELL, error_code=error_code)
    expected = f"emergency 0x{error_code:04x}" if error_code else None
    assert fault(DEVICE, health, 300) == expected
    again = after(DEVICE, emergency(0x8130, 0x11), emergency(code, register))
    is_end = code < 0x100 and not register
    assert again.error_code == (0 if is_end else code or 0x8130)


def test_an_emergency_of_eight_bytes_alone_counts():
    for length in (0, 3, 7):
        short = Frame(200, EMERGENCY, emergency(0x8130, 0x11).data[:length])
        assert after(DEVICE, short) is WELL


@pytest.mark.parametrize("toggle", [0, 0x80])
@pytest.mark.parametrize(
    ("state", "expected"),
    [
        (5, None),
        (4, "stopped"),
        (127, "pre-operational"),
        (0, "restarted"),
        (1, "state 1"),
        (6, "state 6"),
    ],
)
def test_a_heartbeat_tells_the_state_with_or_without_the_bit_of_node_guarding(
    state, toggle, expected
):
    health = after(WATCHED, heartbeat(state | toggle))
    assert health.since_ns == 200
    assert fault(WATCHED, health, 300) == expected


def test_a_device_that_restarts_has_forgotten_its_errors_and_alarms():
    alarmed = update_by_alarm(after(DEVICE, emergency(0x8130, 0x11)), 1, 9)
    assert after(DEVICE, heartbeat(0), health=alarmed) == DeviceHealth(200, 0, 0, (0, 0))


def test_a_heartbeat_leaves_an_error_as_it_is_and_is_never_older_than_the_start():
    wrong = replace(WELL, error_code=0x8130)
    assert after(DEVICE, heartbeat(4), health=wrong) == replace(wrong, since_ns=200, state=4)
    assert after(DEVICE, heartbeat(5, t_ns=50), health=wrong) == wrong


def test_data_after_a_restart_replaces_the_heartbeat_of_a_device_that_sends_none():
    for state in (0, 4, 5, 127):
        health = replace(WELL, state=state)
        assert update_by_data(WATCHED, health) is health
        expected = OPERATIONAL if state == 0 else state
        assert update_by_data(DEVICE, health) == replace(health, state=expected)


def test_a_device_is_silent_when_its_heartbeat_is_older_than_it_may_be():
    last = after(WATCHED, heartbeat(5))
    assert fault(WATCHED, last, 200 + 10 * MS) is None
    assert fault(WATCHED, last, 201 + 10 * MS) == "no heartbeat"


def claim(address, name=NAME):
    return Frame(200, CLAIM | address, name.to_bytes(8, "little"), is_extended=True)


def test_a_device_of_j1939_is_where_it_claimed_its_address_last():
    health = initial_health(J1939, 0)
    moved = update_by_claim(J1939, health, claim(0x21))
    assert moved == replace(health, address=0x21)
    # Somebody else claims another address, this one, and another one again.
    assert update_by_claim(J1939, moved, claim(0x20, name=5)) is moved
    lost = update_by_claim(J1939, moved, claim(0x21, name=5))
    assert lost == replace(health, address=NO_ADDRESS)
    assert fault(J1939, moved, 10**15) is None
    assert fault(J1939, lost, 0) == "has no address"
    assert update_by_claim(J1939, lost, claim(0x22)).address == 0x22
    assert update_by_claim(J1939, moved, claim(NO_ADDRESS)).address == NO_ADDRESS


def test_a_claim_of_another_length_or_of_no_interest_says_nothing():
    health = initial_health(J1939, 0)
    for data in (b"", NAME.to_bytes(8, "little") + b"\0", NAME.to_bytes(8, "little")[:7]):
        assert update_by_claim(J1939, health, Frame(1, CLAIM | 0x20, data, True)) is health
    known = replace(WELL, address=0x20)
    assert update_by_claim(DEVICE, known, claim(0x20)) is known


def test_a_frame_is_of_the_device_whose_address_it_carries():
    health = replace(initial_health(J1939, 0), address=0x21)
    of_group = [Frame(0, 0x18FE5900 | address, bytes(8), True) for address in (0x20, 0x21)]
    assert [is_from(J1939, health, frame) for frame in of_group] == [False, True]
    assert [is_from(DEVICE, WELL, frame) for frame in of_group] == [True, True]


def test_an_alarm_is_kept_at_its_place():
    raised = update_by_alarm(WELL, 1, 9)
    assert raised == replace(WELL, alarms=(0, 9))
    assert update_by_alarm(raised, 0, 3) == replace(WELL, alarms=(3, 9))
    assert update_by_alarm(raised, 1, 9) is raised
    three = replace(WELL, alarms=(1, 2, 3))
    assert update_by_alarm(three, 1, 0).alarms == (1, 0, 3)
    assert fault(DEVICE, update_by_alarm(WELL, 0, 0x1F), 200) == "alarm 0x1f"


def test_what_a_device_says_itself_is_named_before_what_is_concluded():
    device = WATCHED._replace(j1939_name=NAME)
    late_ns = 101 + 10 * MS
    health = DeviceHealth(100, 4, 0x8130, (0, 7))
    named = [fault(device, health, late_ns)]
    for repaired in ({"error_code": 0}, {"alarms": (0, 0)}, {"address": 3}, {"state": 5}):
        health = replace(health, **repaired)
        named.append(fault(device, health, late_ns))
    assert named == ["emergency 0x8130", "alarm 0x7", "has no address", "stopped", "no heartbeat"]
    assert fault(device, health, late_ns - 1) is None


def test_the_devices_that_are_at_fault_are_listed_by_their_indices():
    devices = [DEVICE, J1939, WATCHED]
    healths = [replace(WELL, state=4), initial_health(J1939, 0), WELL]
    assert faults(devices, healths, 100) == ((0, "stopped"),)
    assert faults(devices, healths, 101 + 10 * MS) == ((0, "stopped"), (2, "no heartbeat"))
    assert faults((), (), 100) == ()
