"""Configures a CANopen device for a run (cycle, heartbeat, operational state), and undoes it.

Nothing is stored in the device: switching it off undoes it too.

Reference: CiA 301, 7.5.2: a PDO's communication record is changed while the PDO is switched off.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from can_dbc.errors import InputError
from rig.bus.bus import BusError
from rig.bus.canopen_network import (
    OPERATIONAL,
    PRE_OPERATIONAL,
    CanOpenNetwork,
    RefusedError,
)
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
from rig.sensors.canopen_profiles import ENCODER, MEASURING_DEVICE

_DEVICE_TYPE = 0x1000
_BY_EVENT, _AT_EVERY_SYNC = 255, 1
_PRODUCES_SYNC = 1 << 30
SETTABLE = frozenset(
    {HEARTBEAT, SYNC, SYNC_PERIOD, CYCLE, *range(COMMUNICATION, COMMUNICATION + MOST_PDOS)}
)
"""Indices that are ever written; 1010h, which would store them, is not among them."""


def _settable(index: int) -> int:
    if index not in SETTABLE:
        raise ValueError("expected an object that `rig sensor set` changes")
    return index


class ObjectChange(BaseModel):
    """Change of an object of a device: the content `before`, in hex."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    node_id: Annotated[int, Field(ge=1, le=127)]
    index: Annotated[int, AfterValidator(_settable)]
    subindex: Annotated[int, Field(ge=0, le=255)]
    before: Annotated[str, Field(pattern=r"^([0-9a-f]{2}){1,8}$")]


@dataclass
class DeviceWriter:
    """Writes objects of a device and records their content before, even if it fails on the way."""

    network: CanOpenNetwork
    node_id: int
    changes: list[ObjectChange] = field(default_factory=list[ObjectChange])

    def read(self, index: int, subindex: int = 0) -> bytes | None:
        """Content of an object, or None where there is none."""
        return self.network.read(self.node_id, index, subindex)

    def number(self, index: int, subindex: int = 0) -> int | None:
        """The content as an unsigned integer."""
        content = self.read(index, subindex)
        return int.from_bytes(content, "little") if content else None

    def set_value(self, index: int, subindex: int, value: int, *, is_recorded: bool = True) -> None:
        """Write an object if its value differs, and check that the device took it.

        It is recorded unless something else than `restore` writes the content before.

        Raises:
            RefusedError: The device refuses it, or holds another value afterwards.
            BusError: The device does not answer.
        """
        before = self.read(index, subindex)
        where = f"node {self.node_id}, object {index:04X}h.{subindex}"
        if not before:
            raise RefusedError(f"{where}: the device has no such object")
        try:
            content = value.to_bytes(len(before), "little")
        except OverflowError:
            raise RefusedError(f"{where}: {value} does not fit in {len(before)} bytes") from None
        if content == before:
            return
        if is_recorded:  # before the write: its answer may get lost
            change = ObjectChange.model_construct(
                node_id=self.node_id, index=index, subindex=subindex, before=before.hex()
            )
            self.changes.append(change)
        self.network.write(self.node_id, index, subindex, content)
        after = self.read(index, subindex)
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


def give_node_id(network: CanOpenNetwork, node_id: int) -> Sequence[int]:
    """Give a node id to the sensor that has none; returns its identity.

    Raises:
        InputError: Another device has it, no device is without one, or the device is no sensor: it
            is without one again.
        BusError: The device does not take it, or keeps it although it is no sensor.
    """
    if _answers(network, node_id):
        raise InputError(f"--new: node {node_id} is on the bus, expected a node id that is free")
    identity = network.find_unconfigured()
    if identity is None:
        raise InputError("--new: no device without a node id answers")
    network.give_node_id(node_id)
    try:  # not before, because its objects have no address without a node id
        _refuse_other_than_sensor(network, node_id)
    except InputError as error:
        network.take_node_id_back(node_id, identity)
        raise InputError(f"{error}; it is without a node id again") from error
    return identity


def _answers(network: CanOpenNetwork, node_id: int) -> bool:
    try:
        network.read(node_id, _DEVICE_TYPE)
    except BusError:
        return False
    return True


def configure_device(writer: DeviceWriter, settings: CanOpenSettings) -> None:
    """Set cycle and heartbeat of a sensor, and switch it to operational.

    Raises:
        InputError: The device is no sensor, or cannot do it.
        BusError: It does not answer.
    """
    network, node_id = writer.network, writer.node_id
    _refuse_other_than_sensor(network, node_id)
    network.command(node_id, PRE_OPERATIONAL)
    try:
        _set_objects(writer, settings)
    except InputError as error:
        raise InputError(f"{error}; the device may still be pre-operational") from error
    network.command(node_id, OPERATIONAL)


def _refuse_other_than_sensor(network: CanOpenNetwork, node_id: int) -> None:
    """Refuse a device that may move something, such as a drive, before anything is written."""
    device_type = network.read(node_id, _DEVICE_TYPE)
    if not device_type:
        raise InputError(f"node {node_id}: has no device type (1000h), expected a CANopen device")
    profile = int.from_bytes(device_type, "little") & 0xFFFF
    if profile not in (ENCODER, MEASURING_DEVICE):
        raise InputError(
            f"node {node_id}: device profile {profile} (1000h), expected {ENCODER} (encoder) or "
            f"{MEASURING_DEVICE} (measuring device): another device is set by its maker's tool"
        )


def _set_objects(writer: DeviceWriter, settings: CanOpenSettings) -> None:
    """Set cycle and heartbeat of a device that is pre-operational."""
    node_id = writer.node_id
    if settings.heartbeat_ms is not None:
        writer.set_value(HEARTBEAT, 0, settings.heartbeat_ms)
    if settings.cycle_ms is not None:
        pdos = [pdo for pdo in range(MOST_PDOS) if _is_active(writer, pdo)]
        if not pdos:
            raise InputError(f"node {node_id}: has no process data that is switched on")
        for pdo in pdos:
            _set_cycle(writer, pdo, settings.cycle_ms, sync=settings.sync)
        if settings.sync:
            _produce_sync(writer, settings.cycle_ms)


def restore(network: CanOpenNetwork, changes: Sequence[ObjectChange]) -> None:
    """Undo changes, the last one first, and switch every device to pre-operational.

    Raises:
        InputError: A device is no sensor (another may have got its node id), or refuses it.
        BusError: It does not answer.
    """
    node_ids = dict.fromkeys(item.node_id for item in changes)
    for node_id in node_ids:
        _refuse_other_than_sensor(network, node_id)
    for node_id in node_ids:
        network.command(node_id, PRE_OPERATIONAL)
    for item in reversed(changes):
        node_id, index = item.node_id, item.index
        # An object of a PDO is written while the PDO is switched off.
        is_pdo = COMMUNICATION <= index < COMMUNICATION + MOST_PDOS and item.subindex != COB_ID
        on = network.read(node_id, index, COB_ID) if is_pdo else None
        if on is not None:
            off = (int.from_bytes(on, "little") | OFF).to_bytes(len(on), "little")
            network.write(node_id, index, COB_ID, off)
        try:
            network.write(node_id, index, item.subindex, bytes.fromhex(item.before))
        finally:
            if on is not None:
                network.write(node_id, index, COB_ID, on)


def _is_active(writer: DeviceWriter, pdo: int) -> bool:
    """Whether a PDO is switched on and not empty; 0 is TPDO 1."""
    cob_id = writer.number(COMMUNICATION + pdo, COB_ID)
    is_mapped = bool(writer.number(MAPPING + pdo))
    return cob_id is not None and not cob_id & OFF and is_mapped


def _set_cycle(writer: DeviceWriter, pdo: int, cycle_ms: int, *, sync: bool) -> None:
    index = COMMUNICATION + pdo
    cob_id = writer.number(index, COB_ID) or 0
    writer.set_value(index, COB_ID, cob_id | OFF, is_recorded=False)
    try:
        before = writer.number(index, TRANSMISSION) or 0
        by_timer = before if before in BY_ITSELF else _BY_EVENT
        writer.set_value(index, TRANSMISSION, _AT_EVERY_SYNC if sync else by_timer)
        inhibit = writer.number(index, INHIBIT) or 0
        if inhibit * INHIBIT_UNIT_S > cycle_ms * 1e-3:
            writer.set_value(index, INHIBIT, 0)
        if not sync:
            _set_event_timer(writer, pdo, cycle_ms)
    finally:
        writer.set_value(index, COB_ID, cob_id, is_recorded=False)


def _set_event_timer(writer: DeviceWriter, pdo: int, cycle_ms: int) -> None:
    """Set the event timer of a PDO; an encoder may have an object for it that others lack."""
    if writer.read(COMMUNICATION + pdo, EVENT) is not None:
        writer.set_value(COMMUNICATION + pdo, EVENT, cycle_ms)
        return
    profile = (writer.number(_DEVICE_TYPE) or 0) & 0xFFFF
    if pdo == 0 and profile == ENCODER and writer.read(CYCLE) is not None:
        writer.set_value(CYCLE, 0, cycle_ms)
        return
    raise RefusedError(
        f"node {writer.node_id}: TPDO {pdo + 1} has no event timer (1800h.5, 6200h), expected "
        "--sync"
    )


def _produce_sync(writer: DeviceWriter, cycle_ms: int) -> None:
    cob_id = writer.number(SYNC)
    if cob_id is None or writer.read(SYNC_PERIOD) is None:
        raise RefusedError(
            f"node {writer.node_id}: produces no SYNC (1005h, 1006h), expected a cycle without "
            "--sync"
        )
    writer.set_value(SYNC_PERIOD, 0, cycle_ms * 1000)
    writer.set_value(SYNC, 0, cob_id | _PRODUCES_SYNC)
