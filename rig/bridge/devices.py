"""What devices on the bus say of themselves while a run goes on.

A CANopen device that reports an error, falls silent or leaves the operational state sends nothing
to be believed: its frames are refused until it is well again. A J1939 device is known by its NAME:
its frames are those from the address that it claimed last.

References: CiA 301, "CANopen application layer and communication profile", 7.2.7 (emergency) and
7.2.8.3.2 (heartbeat, boot-up); SAE J1939-81, "Network management" (address claim).
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

CLAIM, CLAIM_MASK = 0x18EEFF00, 0x03FFFF00
"""Identifier of an address claim, and which of its bits say that it is one."""

_NO_ADDRESS = 0xFE
_NO_ERROR = 0x00
"""High byte of the error codes that report the end of an error."""


class Device(NamedTuple):
    """A device as the bridge knows it.

    Attributes:
        name: Name of the node in the DBC.
        node_id: CANopen node id; 0 of a J1939 device.
        emergency_id: Arbitration id of its emergency frames.
        heartbeat_ns: Longest time between two heartbeats; 0 where they are not watched.
        alarms: How many signals of its frames are alarms.
        is_vital: Whether the estimate rests on it.
        j1939_name: NAME of a J1939 device; None of a CANopen device.
        address: Source address of a J1939 device at the start.
    """

    name: str
    node_id: int
    emergency_id: int
    heartbeat_ns: int
    alarms: int = 0
    is_vital: bool = True
    j1939_name: int | None = None
    address: int = _NO_ADDRESS

    @property
    def ids(self) -> tuple[int, ...]:
        """Arbitration ids of its emergency and heartbeat frames."""
        return (self.emergency_id, HEARTBEAT_ID + self.node_id) if self.node_id else ()


class Health(Struct, frozen=True, gc=False):
    """What is known of a device.

    Attributes:
        since_ns: Time of its last heartbeat, or of the start.
        state: What the last heartbeat said; operational before the first.
        error_code: Error code of the emergency that is not over, else 0.
        alarms: Raw value of each of its alarms.
        address: Source address that it claimed last.
    """

    since_ns: int
    state: int = OPERATIONAL
    error_code: int = 0
    alarms: tuple[int, ...] = ()
    address: int = _NO_ADDRESS


def well(device: Device, t_ns: int) -> Health:
    """What is known of a device at the start."""
    return Health(t_ns, alarms=(0,) * device.alarms, address=device.address)


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


def after_claim(device: Device, health: Health, frame: Frame) -> Health:
    """Health after somebody claimed an address on a J1939 bus.

    Args:
        device: The device.
        health: Its health before.
        frame: An address claim.
    """
    if device.j1939_name is None or len(frame.data) != 8:
        return health
    address = frame.arbitration_id & 0xFF
    if int.from_bytes(frame.data, "little") == device.j1939_name:
        return replace(health, address=address)
    # Somebody else took it: what comes from there is not the device's until it claims again.
    return replace(health, address=_NO_ADDRESS) if address == health.address else health


def is_from(device: Device, health: Health, frame: Frame) -> bool:
    """Whether a frame of a device's messages is from the device itself."""
    return device.j1939_name is None or frame.arbitration_id & 0xFF == health.address


def after_data(device: Device, health: Health) -> Health:
    """Health after a frame with its data.

    A device that restarted sends such when it is operational, which tells what a heartbeat would
    where none are watched.
    """
    if device.heartbeat_ns or health.state != _BOOT_UP:
        return health
    return replace(health, state=OPERATIONAL)


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
    if device.j1939_name is not None and health.address == _NO_ADDRESS:
        return "has no address"
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
