"""What CANopen devices on the bus say of themselves while a run goes on.

A device that reports an error, falls silent or leaves the operational state sends nothing to be
believed: its frames are refused until it is well again.

References: CiA 301, "CANopen application layer and communication profile", 7.2.7 (emergency) and
7.2.8.3.2 (heartbeat, boot-up).
"""

from collections.abc import Sequence
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from can_dbc.frame import Frame

HEARTBEAT_ID, LARGEST_NODE_ID = 0x700, 127
_BOOT_UP, _STOPPED, OPERATIONAL, _PRE_OPERATIONAL = 0, 4, 5, 127
_STATES = {_BOOT_UP: "restarted", _STOPPED: "stopped", _PRE_OPERATIONAL: "pre-operational"}
_TOGGLE = 0x80
"""Bit of an answer to node guarding that is not of the state."""

_NO_ERROR = 0x00
"""High byte of the error codes that report the end of an error."""


class Device(NamedTuple):
    """A device as the bridge knows it.

    Attributes:
        name: Name of the node in the DBC.
        node_id: CANopen node id.
        emergency_id: Arbitration id of its emergency frames.
        heartbeat_ns: Longest time between two heartbeats; 0 where they are not watched.
        alarms: How many signals of its frames are alarms.
        is_vital: Whether the estimate rests on it.
    """

    name: str
    node_id: int
    emergency_id: int
    heartbeat_ns: int
    alarms: int = 0
    is_vital: bool = True

    @property
    def ids(self) -> tuple[int, int]:
        """Arbitration ids of its emergency and heartbeat frames."""
        return self.emergency_id, HEARTBEAT_ID + self.node_id


class Health(Struct, frozen=True, gc=False):
    """What is known of a device.

    Attributes:
        since_ns: Time of its last heartbeat, or of the start.
        state: What the last heartbeat said; operational before the first.
        error_code: Error code of the emergency that is not over, else 0.
        alarms: Raw value of each of its alarms.
    """

    since_ns: int
    state: int = OPERATIONAL
    error_code: int = 0
    alarms: tuple[int, ...] = ()


def well(device: Device, t_ns: int) -> Health:
    """What is known of a device at the start."""
    return Health(t_ns, alarms=(0,) * device.alarms)


def after_frame(device: Device, health: Health, frame: Frame) -> Health:
    """Health after an emergency or a heartbeat; one of another length says nothing.

    Args:
        device: The device.
        health: Its health before.
        frame: A frame with one of its ids.
    """
    data = frame.data
    if frame.arbitration_id == device.emergency_id:
        if len(data) != 8:
            return health
        code, register = data[0] | data[1] << 8, data[2]
        is_over = code >> 8 == _NO_ERROR and register == 0
        # With a code of "no error" and bits left in the register, another error lasts.
        return replace(health, error_code=0 if is_over else code or health.error_code or 0x1000)
    if len(data) != 1:
        return health
    state = data[0] & ~_TOGGLE
    if state == _BOOT_UP:
        return replace(well(device, frame.t_ns), state=state)
    return replace(health, since_ns=frame.t_ns, state=state)


def after_alarm(health: Health, place: int, raw: int) -> Health:
    """Health after a frame with an alarm in it.

    Args:
        health: Health before.
        place: Which of its alarms.
        raw: Its raw value; 0 for none.
    """
    alarms = health.alarms
    if alarms[place] == raw:
        return health
    return replace(health, alarms=(*alarms[:place], raw, *alarms[place + 1 :]))


def trouble(device: Device, health: Health, t_ns: int) -> str | None:
    """What is wrong with a device at a time, in words; None if nothing is."""
    if health.error_code:
        return f"emergency {health.error_code:#06x}"
    if any(health.alarms):
        return f"alarm {next(filter(None, health.alarms)):#x}"
    if health.state != OPERATIONAL:
        return _STATES.get(health.state, f"state {health.state}")
    if device.heartbeat_ns and t_ns - health.since_ns > device.heartbeat_ns:
        return "no heartbeat"
    return None


def troubles(
    devices: Sequence[Device], healths: Sequence[Health], t_ns: int
) -> tuple[tuple[int, str], ...]:
    """Places of the devices with something wrong at a time, and what it is."""
    found = [
        (place, why)
        for place, (device, health) in enumerate(zip(devices, healths, strict=True))
        if (why := trouble(device, health, t_ns)) is not None
    ]
    return tuple(found)
