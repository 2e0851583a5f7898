"""A CANopen device set to work: its cycle, its heartbeat, operational; and put back as it was.

Nothing is stored in the device: switched off and on, it is as it was too.

Reference: CiA 301, 7.5.2: a PDO's communication record is changed while the PDO is switched off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from can_dbc.errors import InputError
from rig.bus.canopen_network import OPERATIONAL, PRE_OPERATIONAL, RefusedError
from rig.sensors.canopen_description import (
    BY_ITSELF,
    COB_ID,
    COMMUNICATION,
    CYCLE,
    EVENT,
    HEARTBEAT,
    INHIBIT,
    INHIBIT_UNIT_S,
    MAPPING,
    OFF,
    SYNC,
    SYNC_PERIOD,
    TRANSMISSION,
)
from rig.sensors.profiles import ENCODER

_BY_EVENT, _AT_EVERY_SYNC = 255, 1
_PRODUCES_SYNC = 1 << 30
_MOST_PDOS = 16
SETTABLE = frozenset(
    {HEARTBEAT, SYNC, SYNC_PERIOD, CYCLE, *range(COMMUNICATION, COMMUNICATION + _MOST_PDOS)}
)
"""Indices that are ever written; 1010h, which would store them, is not among them."""


class Line(Protocol):
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
class Changed:
    """An object that was changed.

    Attributes:
        node_id: Whose.
        index: Index.
        subindex: Subindex.
        before: What it held, in hex.
    """

    node_id: int
    index: int
    subindex: int
    before: str


@dataclass
class Setting:
    """Objects being changed, and what they held before: kept also when a device breaks off.

    Attributes:
        changed: What was changed, in order.
    """

    line: Line
    changed: list[Changed] = field(default_factory=list[Changed])

    def put(self, node_id: int, index: int, subindex: int, value: int, *, noted: bool) -> None:
        """Write an object if it holds something else, and see that it took the value.

        Args:
            node_id: Whose.
            index: Index.
            subindex: Subindex.
            value: What it is to hold.
            noted: Whether what it held is what it is put back to.

        Raises:
            RefusedError: The device refuses it, or holds something else afterwards.
            BusError: It does not answer.
        """
        before = self.line.read(node_id, index, subindex)
        place = f"node {node_id}, object {index:04X}h.{subindex}"
        if before is None or not before:
            raise RefusedError(f"{place}: the device has none")
        try:
            content = value.to_bytes(len(before), "little")
        except OverflowError:
            raise RefusedError(f"{place}: {value} does not fit in {len(before)} bytes") from None
        if content == before:
            return
        if noted:  # before: the answer to a write may get lost
            self.changed.append(Changed(node_id, index, subindex, before.hex()))
        self.line.write(node_id, index, subindex, content)
        after = self.line.read(node_id, index, subindex)
        if after != content:
            held = "nothing" if after is None else str(int.from_bytes(after, "little"))
            raise RefusedError(f"{place}: holds {held} after {value} was written")


def set_to_work(
    setting: Setting, node_id: int, *, cycle_ms: int | None, sync: bool, heartbeat_ms: int | None
) -> None:
    """Bring a device's cycle, heartbeat and state to what a run needs.

    Args:
        setting: Where changes are noted.
        node_id: The device.
        cycle_ms: Time between two frames of every PDO that is switched on; as it is if None.
        sync: Send at SYNC, which this device then produces itself, instead of by its own timer.
        heartbeat_ms: Time between two heartbeats; as it is if None.

    Raises:
        InputError: The device cannot do it.
        BusError: It does not answer.
    """
    line = setting.line
    if line.read(node_id, 0x1000) is None:
        raise InputError(f"node {node_id}: has no device type (1000h), expected a CANopen device")
    line.command(node_id, PRE_OPERATIONAL)
    if heartbeat_ms is not None:
        setting.put(node_id, HEARTBEAT, 0, heartbeat_ms, noted=True)
    if cycle_ms is not None:
        places = _switched_on(line, node_id)
        if not places:
            raise InputError(f"node {node_id}: has no process data that is switched on")
        for place in places:
            _cycle(setting, node_id, place, cycle_ms, sync=sync)
        if sync:
            _produce_sync(setting, node_id, cycle_ms)
    line.command(node_id, OPERATIONAL)


def restore(line: Line, changes: Sequence[Changed]) -> None:
    """Put back what was changed, the last one first, and every device into pre-operational.

    Raises:
        InputError: A device refuses it.
        BusError: It does not answer.
    """
    for node_id in dict.fromkeys(item.node_id for item in changes):
        line.command(node_id, PRE_OPERATIONAL)
    for item in reversed(changes):
        _with_pdo_off(line, item, bytes.fromhex(item.before))


def _with_pdo_off(line: Line, item: Changed, content: bytes) -> None:
    """Write an object; one of a PDO while the PDO is switched off."""
    is_pdo = COMMUNICATION <= item.index < COMMUNICATION + _MOST_PDOS and item.subindex != COB_ID
    on = line.read(item.node_id, item.index, COB_ID) if is_pdo else None
    if on is None:
        line.write(item.node_id, item.index, item.subindex, content)
        return
    off = (int.from_bytes(on, "little") | OFF).to_bytes(len(on), "little")
    line.write(item.node_id, item.index, COB_ID, off)
    try:
        line.write(item.node_id, item.index, item.subindex, content)
    finally:
        line.write(item.node_id, item.index, COB_ID, on)


def _number(line: Line, node_id: int, index: int, subindex: int) -> int | None:
    content = line.read(node_id, index, subindex)
    return None if not content else int.from_bytes(content, "little")


def _switched_on(line: Line, node_id: int) -> list[int]:
    found: list[int] = []
    for place in range(_MOST_PDOS):
        cob_id = _number(line, node_id, COMMUNICATION + place, COB_ID)
        is_mapped = bool(_number(line, node_id, MAPPING + place, 0))
        if cob_id is not None and not cob_id & OFF and is_mapped:
            found.append(place)
    return found


def _cycle(setting: Setting, node_id: int, place: int, cycle_ms: int, *, sync: bool) -> None:
    """Have a PDO sent at a cycle."""
    line, index = setting.line, COMMUNICATION + place
    cob_id = _number(line, node_id, index, COB_ID) or 0
    setting.put(node_id, index, COB_ID, cob_id | OFF, noted=False)
    try:
        before = _number(line, node_id, index, TRANSMISSION) or 0
        wanted = _AT_EVERY_SYNC if sync else before if before in BY_ITSELF else _BY_EVENT
        setting.put(node_id, index, TRANSMISSION, wanted, noted=True)
        inhibit = _number(line, node_id, index, INHIBIT) or 0
        if inhibit * INHIBIT_UNIT_S > cycle_ms * 1e-3:
            setting.put(node_id, index, INHIBIT, 0, noted=True)
        if not sync:
            _own_timer(setting, node_id, place, cycle_ms)
    finally:
        setting.put(node_id, index, COB_ID, cob_id, noted=False)


def _own_timer(setting: Setting, node_id: int, place: int, cycle_ms: int) -> None:
    """Set the event timer; an encoder may have its own object for it alone."""
    line = setting.line
    if line.read(node_id, COMMUNICATION + place, EVENT) is not None:
        setting.put(node_id, COMMUNICATION + place, EVENT, cycle_ms, noted=True)
        return
    profile = (_number(line, node_id, 0x1000, 0) or 0) & 0xFFFF
    if place == 0 and profile == ENCODER and line.read(node_id, CYCLE) is not None:
        setting.put(node_id, CYCLE, 0, cycle_ms, noted=True)
        return
    raise RefusedError(
        f"node {node_id}: TPDO {place + 1} has no timer of its own (1800h.5, 6200h), expected "
        "--sync"
    )


def _produce_sync(setting: Setting, node_id: int, cycle_ms: int) -> None:
    line = setting.line
    cob_id = _number(line, node_id, SYNC, 0)
    if cob_id is None or line.read(node_id, SYNC_PERIOD) is None:
        raise RefusedError(
            f"node {node_id}: produces no SYNC (1005h, 1006h), expected a cycle without --sync"
        )
    setting.put(node_id, SYNC_PERIOD, 0, cycle_ms * 1000, noted=True)
    setting.put(node_id, SYNC, 0, cob_id | _PRODUCES_SYNC, noted=True)
