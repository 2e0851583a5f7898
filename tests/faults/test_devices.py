"""Faults that a CANopen device reports of itself, between bench and bridge, at 1 kHz."""

import json
from dataclasses import replace

import pytest
from msgspec import structs

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bridge.devices import Device, fault, initial_health, update_by_alarm, update_by_frame
from rig.bridge.values import Mode
from rig.plan.build import build_bridge
from rig.plan.load import load_plan
from tests.bridge.cores import FIRST
from tests.faults.trial import (
    BEGIN_MS,
    BEGIN_NS,
    MEASUREMENT,
    MS,
    SETTLING_MS,
    Trial,
    after,
    first_ms,
    force_error_n,
    height_of,
)

NODE = 5
EMERGENCY, HEARTBEAT = 0x80 + NODE, 0x700 + NODE
OPERATIONAL, PRE_OPERATIONAL, STOPPED, BOOT_UP = b"\x05", b"\x7f", b"\x04", b"\x00"
DEVICES = {"BENCH": {"node_id": NODE, "heartbeat_s": 0.25}}
HEIGHT = {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"}
END_MS = BEGIN_MS + 600


def emergency(code, register, t_ns):
    data = code.to_bytes(2, "little") + bytes([register]) + bytes(5)
    return Frame(t_ns, EMERGENCY, data, is_extended=False)


def heartbeats(until_ns=10**12, state=OPERATIONAL):
    """A heartbeat every 100 ms beside the bench's frames."""

    def inject(t_ns, frames):
        if t_ns % (100 * MS) or t_ns >= until_ns:
            return frames
        return [*frames, Frame(t_ns, HEARTBEAT, state, is_extended=False)]

    return inject


def beside(*injections):
    def inject(t_ns, frames):
        for one in injections:
            frames = one(t_ns, frames)
        return frames

    return inject


def at(ms, *frames):
    return lambda t_ns, others: [*others, *frames] if t_ns == ms * MS else others


def reported(trial):
    """Whether RIG_STATUS says MEASUREMENT_FAULT, frame by frame."""
    message = trial.ready.database.message("RIG_STATUS")
    bit = message.signals["MEASUREMENT_FAULT"].start
    return [
        (tick.t_ns, bool(frame.data[bit // 8] >> bit % 8 & 1))
        for tick in trial.ticks
        for frame in tick.result.frames
        if frame.arbitration_id == message.arbitration_id
    ]


def test_a_device_that_is_well_changes_nothing():
    silent, watched = Trial(), Trial(DEVICES)
    without = silent.run(END_MS)
    with_heartbeats = watched.run(END_MS, heartbeats())
    outputs = [[tick.result.output for tick in ticks] for ticks in (without, with_heartbeats)]
    assert outputs[0] == outputs[1]
    assert without[-1].is_valid
    assert watched.state.counts == silent.state.counts


def test_a_bridge_listens_to_the_frames_of_its_devices_and_to_no_claims():
    """Claims of addresses are J1939's: a CANopen device makes none."""
    keys = {item.arbitration_id for item in Trial(DEVICES).bridge.filters}
    assert keys - {item.arbitration_id for item in Trial().bridge.filters} == {EMERGENCY, HEARTBEAT}


def test_an_emergency(row):
    trial = Trial(DEVICES)
    begin = emergency(0x8130, 0x11, BEGIN_NS)
    over = emergency(0x0000, 0x00, BEGIN_NS + 100 * MS)
    over_ms = BEGIN_MS + 100
    settled_ms = over_ms + FIRST - 1 + SETTLING_MS
    end_ms = settled_ms + 1000
    ticks = trial.run(end_ms, beside(heartbeats(), at(BEGIN_MS, begin), at(over_ms, over)))
    found_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    held = [tick for tick in ticks if tick.mode is Mode.HOLD]
    assert found_ms <= 1
    # After the gap the model starts again from measurements.
    assert len(held) in (100 + FIRST - 1, 101 + FIRST - 1)
    refused = held[1:100]
    assert all(trial.value(tick.result.step_input, "strut") is None for tick in refused)
    assert held[3].result.device_faults == ((0, "emergency 0x8130"),)
    assert {tick.mode for tick in ticks[over_ms + FIRST : settled_ms - 1]} == {Mode.SETTLING}
    assert {tick.mode for tick in ticks[settled_ms + 1 :]} == {Mode.RUNNING}
    assert [tick.is_valid for tick in ticks] == [tick.mode is Mode.RUNNING for tick in ticks]
    undisturbed_n = force_error_n(Trial().run(end_ms), settled_ms * MS)
    assert force_error_n(ticks, over_ms * MS) < 3.0 * undisturbed_n
    counts = ticks[-1].counts
    assert counts.device_faulty == 100
    assert counts.from_faulty_device == counts.refused
    assert 108 <= counts.refused <= 111  # every ms a height, every 10 ms the slow channels
    assert counts.limited == 0
    assert any(is_faulty for t_ns, is_faulty in reported(trial) if t_ns > BEGIN_NS)
    assert not reported(trial)[-1][1]
    row(
        31,
        "emergency of a CANopen device (EMCY) that sends the height",
        "refuses its frames, estimate invalid (HOLD), MEASUREMENT_FAULT; after the device has "
        "reported the end of the error, the estimate settles and is valid again; the safe state if "
        "the error lasts longer than 0.5 s",
        found_ms,
        "the frames during this time",
    )


def test_a_lost_heartbeat(row):
    trial = Trial(DEVICES)
    ticks = trial.run(END_MS, heartbeats(until_ns=BEGIN_NS))
    found_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    # The last one came 100 ms before the fault began, and 250 ms are allowed.
    assert found_ms == pytest.approx(151, abs=1)
    row(
        32,
        "a CANopen device stops sending its heartbeat (`heartbeat_s: 0.25`), but continues to send "
        "measurements",
        "as after an emergency",
        "250 ms after the last heartbeat",
        "the frames from then on",
    )


@pytest.mark.parametrize("state", [PRE_OPERATIONAL, STOPPED, BOOT_UP])
def test_a_device_that_left_the_operational_state(state):
    trial = Trial(DEVICES)
    left = Frame(BEGIN_NS, HEARTBEAT, state, is_extended=False)
    ticks = trial.run(BEGIN_MS + 50, beside(heartbeats(), at(BEGIN_MS, left)))
    assert ticks[BEGIN_MS - 1].mode is Mode.RUNNING
    assert ticks[-1].mode is Mode.HOLD


def test_an_alarm_in_the_measurement_itself(row):
    alarm = {"message": "BENCH_MEASUREMENT", "signal": "COUNTER"}
    trial = Trial()
    trial.run(BEGIN_MS)
    # The counter stands in for an alarm: 1 to 15 are alarms, 0 is none. It counts from here on.
    alarmed = Trial({"BENCH": {"node_id": NODE, "alarms": [alarm]}})
    healths = alarmed.state.memory.healths
    memory = structs.replace(trial.state.memory, healths=healths)
    trial.bridge, trial.state = alarmed.bridge, structs.replace(trial.state, memory=memory)
    before, ticks = trial.ticks[BEGIN_MS - 1], trial.run(BEGIN_MS + 200)[BEGIN_MS:]
    assert before.mode is Mode.RUNNING
    assert [tick.mode is Mode.RUNNING for tick in ticks[:10]] == [
        not tick.result.device_faults for tick in ticks[:10]
    ]
    assert all(tick.mode is not Mode.RUNNING for tick in ticks if tick.result.device_faults)
    used = [tick for tick in ticks if height_of(tick.result) is not None]
    assert len(used) == pytest.approx(len(ticks) / 16, abs=2)
    assert not any(tick.result.device_faults for tick in used)
    # One measurement in sixteen starts no model.
    assert ticks[-1].mode is Mode.HOLD
    row(
        33,
        "alarm of a device in the measurement's own frame (`alarms`)",
        "refuses this frame; then as after an emergency",
        first_ms(ticks, lambda tick: tick.mode is Mode.HOLD),
        "the frames during this time",
    )


def test_a_payload_of_another_length(row):
    trial = Trial(DEVICES)

    def shorter(_t_ns, frames):
        return [
            Frame(f.t_ns, f.arbitration_id, f.data[:-1], is_extended=False)
            if f.arbitration_id == MEASUREMENT
            else f
            for f in frames
        ]

    ticks = trial.run(END_MS, beside(heartbeats(), after(BEGIN_NS, shorter)))
    found_ms = first_ms(ticks, lambda tick: tick.mode is Mode.HOLD)
    assert found_ms <= 12
    assert ticks[-1].counts.wrong_length == END_MS - BEGIN_MS
    row(
        34,
        "frames whose length differs from the DBC (the PDO mapping was changed)",
        "refuses and counts each frame (`wrong_length`); estimate invalid (HOLD), then the safe "
        "state",
        found_ms,
        "the frames",
    )


def test_a_device_without_a_height_does_not_hold_the_estimate():
    device = Device("CELL", 7, 0x87, 0, is_vital=False)
    trial = Trial()
    plan = replace(trial.ready, devices=(device,))
    bridge = build_bridge(plan)
    trial.bridge, trial.state = bridge, bridge.init(0)
    told = Frame(BEGIN_NS, 0x87, b"\x30\x81\x01" + bytes(5), is_extended=False)
    ticks = trial.run(BEGIN_MS + 100, at(BEGIN_MS, told))
    assert ticks[-1].mode is Mode.RUNNING
    assert ticks[-1].counts.device_faulty == 100


def test_errors_that_overlap_last_until_the_register_is_clear():
    device = Device("D", NODE, EMERGENCY, 0)
    health = initial_health(device, 0)
    health = update_by_frame(device, health, emergency(0x5000, 0x21, 1))
    health = update_by_frame(device, health, emergency(0x8130, 0x31, 2))
    health = update_by_frame(device, health, emergency(0x0000, 0x20, 3))
    assert fault(device, health, 4) == "emergency 0x8130"
    health = update_by_frame(device, health, emergency(0x0000, 0x00, 5))
    assert fault(device, health, 6) is None


def test_frames_of_another_length_say_nothing():
    device = Device("D", NODE, EMERGENCY, MS)
    health = initial_health(device, 0)
    for key, data in ((EMERGENCY, b"\x00\x50"), (HEARTBEAT, b""), (HEARTBEAT, b"\x04\x04")):
        assert update_by_frame(device, health, Frame(1, key, data, is_extended=False)) == health


def test_a_heartbeat_that_queued_before_the_start_makes_no_device_silent():
    device = Device("D", NODE, EMERGENCY, MS)
    health = initial_health(device, 10 * MS)
    queued = Frame(2 * MS, HEARTBEAT, b"\x05", is_extended=False)
    health = update_by_frame(device, health, queued)
    assert fault(device, health, 11 * MS) is None
    assert fault(device, health, 11 * MS + 1) == "no heartbeat"


def test_alarms_are_kept_apart():
    device = Device("D", NODE, EMERGENCY, 0, alarms=2)
    health = update_by_alarm(update_by_alarm(initial_health(device, 0), 0, 3), 1, 9)
    assert fault(device, update_by_alarm(health, 0, 0), 1) == "alarm 0x9"
    assert fault(device, update_by_alarm(update_by_alarm(health, 0, 0), 1, 0), 1) is None


@pytest.mark.parametrize(
    ("devices", "expected"),
    [
        ({"NOBODY": {"node_id": 5}}, "expected the name of a node that does: BENCH"),
        ({"BENCH": {"node_id": 0}}, "devices.BENCH.node_id"),
        ({"BENCH": {"node_id": True}}, "devices.BENCH.node_id"),
        ({"BENCH": {"node_id": 5, "emergency_id": 0x705}}, "the id of its heartbeats"),
        ({"BENCH": {"j1939_name": 7, "source_address": 3}}, "no message of J1939"),
        ({"BENCH": {"j1939_name": 7}}, "expected node_id"),
        ({"BENCH": {"node_id": 5, "emergency_id": 0x100}}, "0x100 is an id of BENCH_MEASUREMENT"),
        ({"BENCH": {"node_id": 5, "heartbeat_s": -1}}, "devices.BENCH.heartbeat_s"),
        (
            {
                "BENCH": {
                    "node_id": 5,
                    "alarms": [{"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"}],
                }
            },
            "expected an integer without scale",
        ),
        (
            {"BENCH": {"node_id": 5, "alarms": [{"message": "RIG_STATUS", "signal": "STATE"}]}},
            "RIG_STATUS is also published",
        ),
    ],
)
def test_devices_that_cannot_be(tmp_path, devices, expected):
    config = {
        "signals": {"height": HEIGHT},
        "devices": devices,
    }
    (tmp_path / "rig.yaml").write_text(json.dumps(config))
    with pytest.raises(InputError, match=r".") as error:
        build_bridge(load_plan(tmp_path / "rig.yaml"))
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_data_after_a_restart_tells_that_a_device_is_operational_where_no_heartbeat_does():
    trial = Trial({"BENCH": {"node_id": NODE}})
    ticks = trial.run(BEGIN_MS + 100, at(BEGIN_MS, Frame(BEGIN_NS, HEARTBEAT, BOOT_UP)))
    assert ticks[-1].mode is Mode.RUNNING
