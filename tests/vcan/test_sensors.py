"""Sensors that come without a DBC on the kernel's CAN stack: CANopen by another stack, J1939 by the
kernel's own and can-utils."""

import errno
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import can
import pytest

from tests.sensors.dyno import serve
from tests.sensors.story import (
    Line,
    assert_faults_ended,
    assert_friction_was_found,
    configured,
    diagnosed,
    queue,
    rig,
    with_faults,
)
from tests.slow_reference import running
from tests.vcan.conftest import in_process

pytestmark = pytest.mark.vcan

NAME = 0x1122334455667788
ASC3 = 0xFE59


@pytest.fixture
def line(second_vcan: str) -> Iterator[Line]:
    """A dyno with an encoder after CiA 406 and an amplifier after CiA 404, each a CANopen node."""
    made = Line("socketcan", second_vcan, queue())
    with in_process(serve, *made):
        yield made
        made.orders.put("end")


def test_from_a_scan_to_a_diagnosis(line, tmp_path):
    found = diagnosed(line, tmp_path, 20.0)
    assert_friction_was_found(found)


def test_faults_of_a_sensor(line, tmp_path):
    config = configured(line, tmp_path)
    found = with_faults(line, config, tmp_path)
    assert_faults_ended(found)


def test_what_was_set_is_put_back(line, tmp_path):
    bus = ("--interface", "socketcan", "--channel", line.channel)
    before = tmp_path / "before.yaml"
    rig("sensor", "set", 5, *bus, "--cycle-ms", 20, "--before", before)
    assert cycle_ms(bus) == 20
    rig("sensor", "set", "--restore", before, *bus)
    assert cycle_ms(bus) == 10


def cycle_ms(bus: tuple[str, ...]) -> float:
    found = json.loads(rig("sensor", "scan", *bus, "--listen-s", 0.2, "--json"))
    (wire,) = [device for device in found["devices"] if device["node_id"] == 5]
    return round(wire["pdos"][0]["cycle_s"] * 1e3)


@contextmanager
def sending(channel: str) -> Iterator[None]:
    """A level sensor's group (ASC3) ten times a second, from the address claimed for `NAME`.

    By a thread: in the emulated kernel the clock runs on while a program is loaded, on a loaded
    machine for seconds.
    """
    ended = threading.Event()
    with socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_J1939) as group:
        group.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        group.bind((channel, NAME, socket.J1939_NO_PGN, socket.J1939_NO_ADDR))
        to_all = (channel, socket.J1939_NO_NAME, ASC3, socket.J1939_NO_ADDR)

        def send() -> None:
            while not ended.wait(0.1):
                try:
                    group.sendto(bytes(8), to_all)
                except OSError as error:
                    if error.errno != errno.EADDRNOTAVAIL:  # until the address is claimed
                        raise

        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()


def test_a_level_sensor_of_the_kernels_j1939(second_vcan, tmp_path):
    claims = [
        "j1939acd",
        "-r",
        "128-140",
        "-c",
        tmp_path / "name.jacd",
        f"{NAME:016x}",
        second_vcan,
    ]
    bus = ("--interface", "socketcan", "--channel", second_vcan)
    out = tmp_path / "found"
    listener = can.Bus(channel=second_vcan, interface="socketcan")
    with listener, running(claims), sending(second_vcan):
        assert any(is_level(message) for message in received(listener, 60.0))
        text = rig("sensor", "scan", *bus, "--listen-s", 1.0, "--json", "--out", out)
    found = json.loads(text)
    (claim,) = found["claims"]
    address = claim["address"]
    assert 128 <= address <= 140
    assert claim["name"] == NAME
    assert [item["address"] for item in found["groups"]] == [address]
    assert f"source_address: {address}" in (out / "rig.yaml").read_text()


def received(bus: can.BusABC, limit_s: float) -> Iterator[can.Message]:
    end_s = time.monotonic() + limit_s
    while (left_s := end_s - time.monotonic()) > 0.0:
        message = bus.recv(left_s)
        if message is not None:
            yield message


def is_level(message: can.Message) -> bool:
    return message.is_extended_id and message.arbitration_id >> 8 & 0xFFFF == ASC3
