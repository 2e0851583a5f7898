"""Sensors that come without a DBC on the kernel's CAN stack: CANopen by another stack, J1939 by the
kernel's own and can-utils."""

import json
import shutil
import subprocess
import time
from collections.abc import Iterator

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

NAME = "1122334455667788"
ASC3 = "0xfe59"


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


def test_a_level_sensor_of_the_kernels_j1939(second_vcan, tmp_path):
    for tool in ("j1939acd", "testj1939"):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed; it is part of can-utils")
    claims = ["j1939acd", "-r", "128-140", "-c", tmp_path / "name.jacd", NAME, second_vcan]
    bus = ("--interface", "socketcan", "--channel", second_vcan)
    with running(claims):
        send = ["testj1939", "-B", "-s8", f"{second_vcan}:,{ASC3},0x{NAME}", f":,{ASC3}"]
        for _ in range(100):  # sending fails until the address is claimed
            if subprocess.run(send, check=False, timeout=60.0).returncode == 0:
                break
            time.sleep(0.1)
        with running(["sh", "-c", f"while true; do {' '.join(send)}; sleep 0.1; done"]):
            out = tmp_path / "found"
            text = rig("sensor", "scan", *bus, "--listen-s", 1.0, "--json", "--out", out)
    found = json.loads(text)
    (claim,) = found["claims"]
    address = claim["address"]
    assert 128 <= address <= 140
    assert claim["name"] == int(NAME, 16)
    assert [item["address"] for item in found["groups"]] == [address]
    assert f"source_address: {address}" in (out / "rig.yaml").read_text()
