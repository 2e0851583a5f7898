"""Configures a CANopen device for a run (cycle, heartbeat, operational state), and undoes it.

Nothing is stored in the device: switching it off undoes it too.

Reference: CiA 301, 7.5.2: a PDO's communication record is changed while the PDO is switched off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from can_dbc.errors import InputError
from rig.bus.canopen_network import OPERATIONAL, PRE_OPERATIONAL, RefusedError
from rig.sensors.canopen_device import (
    BY_ITSELF,
    COB_ID,
    COMMUNICATION,
    CYCLE,
    EVENT,
    HEARTBEAT,
    INHIBIT,
    INHIBIT_UNIT_S,
    MAPPING,
    MOST_PDOS,
    OFF,
    SYNC,
    SYNC_PERIOD,
    TRANSMISSION,
)
from rig.sensors.canopen_profiles import ENCODER

_BY_EVENT, _AT_EVERY_SYNC = 255, 1
_PRODUCES_SYNC = 1 << 30
SETTABLE = frozenset(
    {HEARTBEAT, SYNC, SYNC_PERIOD, CYCLE, *range(COMMUNICATION, COMMUNICATION + MOST_PDOS)}
)
"""Indices that are ever written; 1010h, which would store them, is not among them."""


class ObjectAccess(Protocol):
    """A bus on which objects are read and written."""

    def read(self, node_id: int, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object, or None where there is none."""
        ...

    def write(self, node_id: int, index: int, subindex: int, content: bytes) -> None:
        """Write an object."""
        ...

    def command(self, node_id: int, command: int) -> None:
        """Send a command of network management."""
        ...


@dataclass(frozen=True)
class ObjectChange:
    """Change of an object.

    Attributes:
        node_id: Node id of the device.
        index: Index.
        subindex: Subindex.
        before: Content before, in hex.
    """

    node_id: int
    index: int
    subindex: int
    before: str


@dataclass
class DeviceWriter:
    """Writes objects and records their content before, also of a device that fails on the way.

    Attributes:
        access: The bus.
        changes: Recorded changes, in order.
    """

    access: ObjectAccess
    changes: list[ObjectChange] = field(default_factory=list[ObjectChange])

    def set_value(
        self, node_id: int, index: int, subindex: int, value: int, *, is_recorded: bool = True
    ) -> None:
        """Write an object if its value differs, and check that the device took it.

        Args:
            node_id: Node id of the device.
            index: Index.
            subindex: Subindex.
            value: New value.
            is_recorded: Whether `restore` has to write the content before.

        Raises:
            RefusedError: The device refuses it, or holds another value afterwards.
            BusError: The device does not answer.
        """
        before = self.access.read(node_id, index, subindex)
        where = f"node {node_id}, object {index:04X}h.{subindex}"
        if before is None or not before:
            raise RefusedError(f"{where}: the device has no such object")
        try:
            content = value.to_bytes(len(before), "little")
        except OverflowError:
            raise RefusedError(f"{where}: {value} does not fit in {len(before)} bytes") from None
        if content == before:
            return
        if is_recorded:  # before the write: its answer may get lost
            self.changes.append(ObjectChange(node_id, index, subindex, before.hex()))
        self.access.write(node_id, index, subindex, content)
        after = self.access.read(node_id, index, subindex)
        if after != content:
            held = "nothing" if after is None else str(int.from_bytes(after, "little"))
            raise RefusedError(f"{where}: holds {held} after {value} was written")


class CanOpenSettings(NamedTuple):
    """Settings of a device for a run.

    Attributes:
        cycle_ms: Time between two frames of every PDO that is switched on; unchanged if None.
        sync: Send at SYNC, which this device then produces, instead of by a timer.
        heartbeat_ms: Time between two heartbeats; unchanged if None.
    """

    cycle_ms: int | None = None
    sync: bool = False
    heartbeat_ms: int | None = None


def configure_device(writer: DeviceWriter, node_id: int, settings: CanOpenSettings) -> None:
    """Set cycle and heartbeat of a device, and switch it to operational.

    Args:
        writer: Records the changes.
        node_id: The device.
        settings: The settings.

    Raises:
        InputError: The device cannot do it.
        BusError: It does not answer.
    """
    access = writer.access
    if access.read(node_id, 0x1000) is None:
        raise InputError(f"node {node_id}: has no device type (1000h), expected a CANopen device")
    access.command(node_id, PRE_OPERATIONAL)
    if settings.heartbeat_ms is not None:
        writer.set_value(node_id, HEARTBEAT, 0, settings.heartbeat_ms)
    if settings.cycle_ms is not None:
        pdos = _active_pdos(access, node_id)
        if not pdos:
            raise InputError(f"node {node_id}: has no process data that is switched on")
        for pdo in pdos:
            _set_cycle(writer, node_id, pdo, settings.cycle_ms, sync=settings.sync)
        if settings.sync:
            _produce_sync(writer, node_id, settings.cycle_ms)
    access.command(node_id, OPERATIONAL)


def restore(access: ObjectAccess, changes: Sequence[ObjectChange]) -> None:
    """Undo changes, the last one first, and switch every device to pre-operational.

    Raises:
        InputError: A device refuses it.
        BusError: It does not answer.
    """
    for node_id in dict.fromkeys(item.node_id for item in changes):
        access.command(node_id, PRE_OPERATIONAL)
    for item in reversed(changes):
        _write_with_pdo_off(access, item, bytes.fromhex(item.before))


def _write_with_pdo_off(access: ObjectAccess, item: ObjectChange, content: bytes) -> None:
    """Write an object; an object of a PDO while the PDO is switched off."""
    is_pdo = COMMUNICATION <= item.index < COMMUNICATION + MOST_PDOS and item.subindex != COB_ID
    on = access.read(item.node_id, item.index, COB_ID) if is_pdo else None
    if on is None:
        access.write(item.node_id, item.index, item.subindex, content)
        return
    off = (int.from_bytes(on, "little") | OFF).to_bytes(len(on), "little")
    access.write(item.node_id, item.index, COB_ID, off)
    try:
        access.write(item.node_id, item.index, item.subindex, content)
    finally:
        access.write(item.node_id, item.index, COB_ID, on)


def _number(access: ObjectAccess, node_id: int, index: int, subindex: int) -> int | None:
    content = access.read(node_id, index, subindex)
    return None if not content else int.from_bytes(content, "little")


def _active_pdos(access: ObjectAccess, node_id: int) -> list[int]:
    """Indices of the PDOs that are switched on and not empty; 0 is TPDO 1."""
    active: list[int] = []
    for pdo in range(MOST_PDOS):
        cob_id = _number(access, node_id, COMMUNICATION + pdo, COB_ID)
        is_mapped = bool(_number(access, node_id, MAPPING + pdo, 0))
        if cob_id is not None and not cob_id & OFF and is_mapped:
            active.append(pdo)
    return active


def _set_cycle(writer: DeviceWriter, node_id: int, pdo: int, cycle_ms: int, *, sync: bool) -> None:
    access, index = writer.access, COMMUNICATION + pdo
    cob_id = _number(access, node_id, index, COB_ID) or 0
    writer.set_value(node_id, index, COB_ID, cob_id | OFF, is_recorded=False)
    try:
        before = _number(access, node_id, index, TRANSMISSION) or 0
        by_timer = before if before in BY_ITSELF else _BY_EVENT
        writer.set_value(node_id, index, TRANSMISSION, _AT_EVERY_SYNC if sync else by_timer)
        inhibit = _number(access, node_id, index, INHIBIT) or 0
        if inhibit * INHIBIT_UNIT_S > cycle_ms * 1e-3:
            writer.set_value(node_id, index, INHIBIT, 0)
        if not sync:
            _set_event_timer(writer, node_id, pdo, cycle_ms)
    finally:
        writer.set_value(node_id, index, COB_ID, cob_id, is_recorded=False)


def _set_event_timer(writer: DeviceWriter, node_id: int, pdo: int, cycle_ms: int) -> None:
    """Set the event timer of a PDO; an encoder may have an object for it that others lack."""
    access = writer.access
    if access.read(node_id, COMMUNICATION + pdo, EVENT) is not None:
        writer.set_value(node_id, COMMUNICATION + pdo, EVENT, cycle_ms)
        return
    profile = (_number(access, node_id, 0x1000, 0) or 0) & 0xFFFF
    if pdo == 0 and profile == ENCODER and access.read(node_id, CYCLE) is not None:
        writer.set_value(node_id, CYCLE, 0, cycle_ms)
        return
    raise RefusedError(
        f"node {node_id}: TPDO {pdo + 1} has no event timer (1800h.5, 6200h), expected --sync"
    )


def _produce_sync(writer: DeviceWriter, node_id: int, cycle_ms: int) -> None:
    access = writer.access
    cob_id = _number(access, node_id, SYNC, 0)
    if cob_id is None or access.read(node_id, SYNC_PERIOD) is None:
        raise RefusedError(
            f"node {node_id}: produces no SYNC (1005h, 1006h), expected a cycle without --sync"
        )
    writer.set_value(node_id, SYNC_PERIOD, 0, cycle_ms * 1000)
    writer.set_value(node_id, SYNC, 0, cob_id | _PRODUCES_SYNC)
