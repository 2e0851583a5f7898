"""The stack itself, before anything is said of the bridge."""

import subprocess

import pytest

from can_dbc.frame import Frame
from rig.io.bus import Bus, BusConfig

pytestmark = pytest.mark.vcan


def test_cansend_is_heard_and_unconfigured_ids_are_not(vcan):
    bus = Bus(BusConfig("socketcan", vcan, 500_000), {(0x100, False)})
    try:
        for text in ("101#01", "100#0203", "00000100#04"):
            subprocess.run(["cansend", vcan, text], check=True)
        heard = bus.receive()
    finally:
        bus.close()
    assert [(frame.arbitration_id, frame.data) for frame in heard] == [(0x100, b"\x02\x03")]
    assert isinstance(heard[0], Frame)
