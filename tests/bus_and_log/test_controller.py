"""What error frames say of the controller."""

import pytest

from can_dbc.frame import Frame
from rig.bus.controller import Controller, state_after


def error(number: int, detail: int = 0) -> Frame:
    return Frame(0, number, bytes([0, detail, 0, 0, 0, 0, 0, 0]), is_error=True)


@pytest.mark.parametrize(
    ("frame", "expected"),
    [
        (error(0x004, 0x08), Controller.WARNING),
        (error(0x004, 0x04), Controller.WARNING),
        (error(0x004, 0x10), Controller.PASSIVE),
        (error(0x004, 0x28), Controller.PASSIVE),
        (error(0x040), Controller.BUS_OFF),
        (error(0x0C4, 0x20), Controller.BUS_OFF),
        (error(0x008), Controller.ACTIVE),
        (error(0x002), Controller.ACTIVE),
    ],
)
def test_an_active_controller_after_an_error_frame(frame, expected):
    assert state_after(Controller.ACTIVE, frame) is expected


@pytest.mark.parametrize(
    ("before", "frame", "expected"),
    [
        (Controller.PASSIVE, error(0x004, 0x40), Controller.ACTIVE),
        (Controller.PASSIVE, error(0x004, 0x08), Controller.WARNING),
        (Controller.BUS_OFF, error(0x100), Controller.ACTIVE),
        (Controller.BUS_OFF, Frame(0, 0x100, b"\0"), Controller.ACTIVE),
        (Controller.PASSIVE, Frame(0, 0x100, b"\0"), Controller.PASSIVE),
        (Controller.PASSIVE, error(0x008), Controller.PASSIVE),
    ],
)
def test_the_way_back(before, frame, expected):
    assert state_after(before, frame) is expected


def test_an_error_frame_without_its_payload_changes_nothing():
    frame = Frame(0, 0x004, b"", is_error=True)
    assert state_after(Controller.WARNING, frame) is Controller.WARNING
