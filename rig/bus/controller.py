"""State of a CAN controller, from its error frames.

python-can reports a state for few interfaces (SocketCAN's is always "active"), but SocketCAN passes
on the state that the controller reports, in the payload of error frames.

Reference: Linux kernel, include/uapi/linux/can/error.h; ISO 11898-1, fault confinement.
"""

from enum import IntEnum

from can_dbc.frame import Frame

_CONTROLLER_PROBLEM, _BUS_OFF, _RESTARTED = 0x004, 0x040, 0x100


class Controller(IntEnum):
    """State of a controller, the severest last."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


_DETAILS = ((0x30, Controller.PASSIVE), (0x0C, Controller.WARNING), (0x40, Controller.ACTIVE))
"""Bits of the second byte of a controller problem, the severest first, and the state they mean."""


def state_after(state: Controller, frame: Frame) -> Controller:
    """State of the controller after a frame of the bus, or an error frame.

    No controller receives frames of the bus while it is bus-off. An error frame that does not
    report the state (a bit error, a lost arbitration) leaves it unchanged.
    """
    if not frame.is_error:
        return Controller.ACTIVE if state is Controller.BUS_OFF else state
    error = frame.arbitration_id
    if error & _BUS_OFF:
        return Controller.BUS_OFF
    if error & _RESTARTED:
        return Controller.ACTIVE
    if error & _CONTROLLER_PROBLEM and len(frame.data) >= 2:
        detail = frame.data[1]
        return next((after for bits, after in _DETAILS if detail & bits), state)
    return state
