"""A CAN frame as a value."""

from msgspec import Struct


class Frame(Struct, frozen=True, gc=False):
    """One CAN or CAN FD frame.

    Attributes:
        t_ns: Time of reception or transmission on the run's clock, in ns.
        data: Payload, 0 to 8 bytes (0 to 64 with `is_fd`).
        bitrate_switch: Whether the payload of a CAN FD frame was sent at the data bit rate.
        is_error: Whether this is an error frame, which carries no payload of the bus.
    """

    t_ns: int
    arbitration_id: int
    data: bytes
    is_extended: bool = False
    is_fd: bool = False
    bitrate_switch: bool = False
    is_error: bool = False
