"""Health of the devices on the bus while a run is going on: settings, state, and what is a fault.

The frames of a CANopen device that reports an error, falls silent or leaves the operational state
are refused until it is healthy again. A J1939 device is identified by its NAME: its frames are
those from the address that it claimed last.

References: CiA 301, "CANopen application layer and communication profile", 7.2.7 (emergency) and
7.2.8.3.2 (heartbeat, boot-up); SAE J1939-81, "Network management" (address claim).
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

from msgspec import Struct
from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.frame import Frame
from can_dbc.yaml_file import Finite
from rig.channels.channel import SignalName

EMERGENCY_ID, HEARTBEAT_ID, LARGEST_NODE_ID = 0x080, 0x700, 127
_BOOT_UP, _STOPPED, OPERATIONAL, _PRE_OPERATIONAL = 0, 4, 5, 127
_STATES = {_BOOT_UP: "restarted", _STOPPED: "stopped", _PRE_OPERATIONAL: "pre-operational"}
_TOGGLE = 0x80
"""Bit of an answer to node guarding that is not part of the state."""

CLAIM, CLAIM_MASK = 0x18EEFF00, 0x03FFFF00
"""Identifier of an address claim, and which of its bits say that it is one."""

_NO_ADDRESS = 0xFE
_NO_ERROR = 0x00
"""High byte of the error codes that report the end of an error."""


class DeviceSettings(BaseModel):
    """A device that reports its state; its frames are refused while it is at fault.

    Attributes:
        node_id: Node id of a CANopen device. Either this or `j1939_name` is required.
        emergency_id: Arbitration id of a CANopen device's emergency frames; 128 plus the node id if
            absent.
        heartbeat_s: Longest permitted time between two heartbeats of a CANopen device; not
            monitored if absent.
        alarms: List of signals that are not zero while the device is at fault.
        j1939_name: NAME of a J1939 device: the 64 bits with which it claims its address; requires
            `source_address`.
        source_address: Address of a J1939 device at the start; a later address claim changes it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: Annotated[int, Field(ge=1, le=LARGEST_NODE_ID, strict=True)] | None = None
    emergency_id: Annotated[int, Field(ge=1, le=0x7FF, strict=True)] | None = None
    heartbeat_s: Annotated[Finite, Field(ge=0.001, le=165.0)] | None = None
    alarms: Annotated[tuple[SignalName, ...], Field(max_length=16)] = ()
    j1939_name: Annotated[int, Field(ge=0, lt=2**64, strict=True)] | None = None
    source_address: Annotated[int, Field(ge=0, le=253, strict=True)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> "DeviceSettings":
        of_canopen = (self.node_id, self.emergency_id, self.heartbeat_s)
        of_j1939 = (self.j1939_name, self.source_address)
        is_canopen = self.node_id is not None and of_j1939 == (None, None)
        if not is_canopen and (of_canopen != (None, None, None) or None in of_j1939):
            raise ValueError(
                "expected node_id, optionally with emergency_id and heartbeat_s, or j1939_name and "
                "source_address"
            )
        return self

    def device(self, name: str, *, is_vital: bool) -> "Device":
        """The device of these settings, by its node's name; the estimate rests on a vital one."""
        node_id = self.node_id or 0
        return Device(
            name,
            node_id,
            self.emergency_id or EMERGENCY_ID + node_id,
            round((self.heartbeat_s or 0.0) * 1e9),
            len(self.alarms),
            is_vital,
            self.j1939_name,
            _NO_ADDRESS if self.source_address is None else self.source_address,
        )


class Device(NamedTuple):
    """A device as the bridge watches it.

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


class DeviceHealth(Struct, frozen=True, gc=False):
    """Health of a device.

    Attributes:
        since_ns: Time of its last heartbeat, or of the start.
        state: State in the last heartbeat; operational before the first.
        error_code: Error code of the emergency that is not over, else 0.
        alarms: Raw value of each of its alarms.
        address: Source address that it claimed last.
    """

    since_ns: int
    state: int = OPERATIONAL
    error_code: int = 0
    alarms: tuple[int, ...] = ()
    address: int = _NO_ADDRESS


def initial_health(device: Device, t_ns: int) -> DeviceHealth:
    """Health of a device at the start."""
    return DeviceHealth(t_ns, alarms=(0,) * device.alarms, address=device.address)


def update_by_frame(device: Device, health: DeviceHealth, frame: Frame) -> DeviceHealth:
    """Health after an emergency or a heartbeat; one of another length is ignored."""
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
        return replace(initial_health(device, frame.t_ns), state=state)
    # One that queued before the start makes the device no older than the start.
    return replace(health, since_ns=max(health.since_ns, frame.t_ns), state=state)


def update_by_claim(device: Device, health: DeviceHealth, frame: Frame) -> DeviceHealth:
    """Health after an address claim on a J1939 bus."""
    if device.j1939_name is None or len(frame.data) != 8:
        return health
    address = frame.arbitration_id & 0xFF
    if int.from_bytes(frame.data, "little") == device.j1939_name:
        return replace(health, address=address)
    # Another device took it: what it sends is not this device's until that claims again.
    return replace(health, address=_NO_ADDRESS) if address == health.address else health


def is_from(device: Device, health: DeviceHealth, frame: Frame) -> bool:
    """Whether a frame of a device's messages is from the device itself."""
    return device.j1939_name is None or frame.arbitration_id & 0xFF == health.address


def update_by_data(device: Device, health: DeviceHealth) -> DeviceHealth:
    """Health after a frame with its data.

    A device that restarted sends data when it is operational, which replaces a heartbeat where none
    is watched.
    """
    if device.heartbeat_ns or health.state != _BOOT_UP:
        return health
    return replace(health, state=OPERATIONAL)


def update_by_alarm(health: DeviceHealth, index: int, raw: int) -> DeviceHealth:
    """Health after a frame with an alarm, by its index among the device's; raw 0 is none."""
    alarms = health.alarms
    if alarms[index] == raw:
        return health
    return replace(health, alarms=(*alarms[:index], raw, *alarms[index + 1 :]))


def fault(device: Device, health: DeviceHealth, t_ns: int) -> str | None:
    """Fault of a device at a time, as a phrase; None if it is healthy."""
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


def faults(
    devices: Sequence[Device], healths: Sequence[DeviceHealth], t_ns: int
) -> tuple[tuple[int, str], ...]:
    """Indices of the devices that are at fault at a time, and their faults."""
    every = [
        (index, fault(device, health, t_ns))
        for index, (device, health) in enumerate(zip(devices, healths, strict=True))
    ]
    return tuple((index, why) for index, why in every if why is not None)
