"""A CANopen device as its own objects describe it.

Reference: CiA 301, "CANopen application layer and communication profile": 1000h device type, 1018h
identity, 1014h emergency, 1017h heartbeat, 1800h and 1A00h transmitted process data objects.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from rig.sensors.canopen_objects import CanOpenObjects, number, text
from rig.sensors.canopen_profiles import ENCODER, MEASURING_DEVICE, Meaning, meaning

COMMUNICATION, MAPPING = 0x1800, 0x1A00
COB_ID, TRANSMISSION, INHIBIT, EVENT = 1, 2, 3, 5
"""Subindices of a PDO's communication record."""

CYCLE, HEARTBEAT, EMERGENCY, SYNC, SYNC_PERIOD = 0x6200, 0x1017, 0x1014, 0x1005, 0x1006
OFF, EXTENDED = 1 << 31, 1 << 29
LAST_SYNCHRONOUS, BY_ITSELF = 240, (254, 255)
"""Largest transmission type that waits for SYNC, and those that send by themselves."""

INHIBIT_UNIT_S = 1e-4
_FLOAT_BITS = (32, 64)

MOST_PDOS = 16
"""PDOs of a device that are read and set; few have more than the four of the predefined set."""

_MOST_MAPPED = 64
"""Objects in a PDO at the most: one for each bit of its frame (CiA 301)."""

_LAST_DUMMY = 0x001F
"""Indices up to this are data types: a gap in the frame."""

_PROFILES = {ENCODER: "encoder (CiA 406)", MEASURING_DEVICE: "measuring device (CiA 404)"}


@dataclass(frozen=True)
class MappedObject:
    """An object in the frame of a PDO, in which `start` is its lowest bit."""

    index: int
    subindex: int
    start: int
    bits: int
    meaning: Meaning


@dataclass(frozen=True)
class Pdo:
    """A process data object that a device sends.

    Attributes:
        number: Its number, from 1 on.
        cycle_s: Time between two frames; None where the device does not report it.
        note: Entry of its mapping that cannot be read, empty if none.
    """

    number: int
    arbitration_id: int
    is_extended: bool
    transmission: int
    cycle_s: float | None
    mapped: tuple[MappedObject, ...]
    note: str = ""

    @property
    def length_bytes(self) -> int:
        """Length of its payload."""
        return -(-max((item.start + item.bits for item in self.mapped), default=0) // 8)


@dataclass(frozen=True)
class CanOpenDevice:
    """A CANopen device as it describes itself.

    Attributes:
        device_type: Content of 1000h.
        label: Name that its manufacturer gives it.
        identity: Vendor, product, revision and serial number; None for one that it does not report.
        heartbeat_s: Time between two heartbeats; 0 for none.
        emergency_id: Arbitration id of its emergency frames.
        notes: Remarks for the reader of a scan.
    """

    node_id: int
    device_type: int
    label: str
    identity: tuple[int | None, int | None, int | None, int | None]
    heartbeat_s: float
    emergency_id: int
    pdos: tuple[Pdo, ...]
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the node in a DBC."""
        return f"NODE_{self.node_id}"

    @property
    def kind(self) -> str:
        """Kind of device, by its profile."""
        profile = self.device_type & 0xFFFF
        return _PROFILES.get(profile, f"CiA {profile}" if profile else "of no profile")


def describe_device(objects: CanOpenObjects, node_id: int) -> CanOpenDevice | None:
    """A device by its objects; None without a device type: it is no CANopen device then."""
    device_type = number(objects, 0x1000)
    if device_type is None:
        return None
    vendor, product, revision, serial = (number(objects, 0x1018, item) for item in range(1, 5))
    emergency_id = number(objects, EMERGENCY)
    if emergency_id is None or emergency_id & OFF:
        emergency_id = 0
    pdos = tuple(_pdos(objects, device_type))
    notes = [
        f"TPDO {pdo.number}, {item.meaning.name}: {item.meaning.note}"
        for pdo in pdos
        for item in pdo.mapped
        if item.meaning.note
    ]
    if not pdos:
        notes.append("no process data object is switched on (1800h and following)")
    notes += [f"TPDO {pdo.number}: {pdo.note}" for pdo in pdos if pdo.note]
    notes += [
        f"TPDO {pdo.number}: the device reports no cycle, so frames are expected at changes only"
        for pdo in pdos
        if pdo.cycle_s is None
    ]
    return CanOpenDevice(
        node_id=node_id,
        device_type=device_type,
        label=text(objects, 0x1008),
        identity=(vendor, product, revision, serial),
        heartbeat_s=(number(objects, HEARTBEAT) or 0) * 1e-3,
        emergency_id=emergency_id & 0x7FF or 0x080 + node_id,
        pdos=pdos,
        notes=tuple(notes),
    )


def _pdos(objects: CanOpenObjects, device_type: int) -> Iterator[Pdo]:
    """Process data objects that are switched on and not empty."""
    for index in range(MOST_PDOS):
        cob_id = number(objects, COMMUNICATION + index, COB_ID)
        if cob_id is None or cob_id & OFF:
            continue
        mapped, note = _read_mapping(objects, device_type, MAPPING + index)
        if not mapped and not note:
            continue
        is_extended = bool(cob_id & EXTENDED)
        transmission = number(objects, COMMUNICATION + index, TRANSMISSION) or 0
        yield Pdo(
            number=index + 1,
            arbitration_id=cob_id & (0x1FFFFFFF if is_extended else 0x7FF),
            is_extended=is_extended,
            transmission=transmission,
            cycle_s=_cycle_s(objects, device_type, index, transmission),
            mapped=mapped,
            note=note,
        )


def _read_mapping(
    objects: CanOpenObjects, device_type: int, index: int
) -> tuple[tuple[MappedObject, ...], str]:
    """Mapped objects, and a note on an entry that cannot be read."""
    mapped: list[MappedObject] = []
    start = 0
    for subindex in range(1, min(number(objects, index) or 0, _MOST_MAPPED) + 1):
        entry = number(objects, index, subindex)
        bits = 0 if entry is None else entry & 0xFF
        if entry is None or bits == 0 or start + bits > 64:
            what = "cannot be read" if entry is None else f"has {bits} bits from bit {start} on"
            return tuple(mapped), f"entry {subindex} {what}: this and later entries are left out"
        target, target_subindex = entry >> 16, entry >> 8 & 0xFF
        if target > _LAST_DUMMY:
            known = meaning(objects, device_type, target, target_subindex)
            if known.is_float and bits not in _FLOAT_BITS:
                known = Meaning(known.name, note=f"a REAL of {bits} bits, expected 32 or 64")
            mapped.append(MappedObject(target, target_subindex, start, bits, known))
        start += bits
    return tuple(mapped), ""


def _cycle_s(
    objects: CanOpenObjects, device_type: int, index: int, transmission: int
) -> float | None:
    """Time between two frames of the PDO at `index` (0: TPDO 1), as the objects report it."""
    if transmission not in BY_ITSELF:
        # Type 0 waits for a change and SYNC, types above 240 for a request.
        is_cyclic = 0 < transmission <= LAST_SYNCHRONOUS
        period_us = number(objects, SYNC_PERIOD) if is_cyclic else None
        return transmission * period_us * 1e-6 if period_us else None
    event_ms = number(objects, COMMUNICATION + index, EVENT)
    if not event_ms and index == 0 and device_type & 0xFFFF == ENCODER:
        event_ms = number(objects, CYCLE)
    if not event_ms:
        return None
    inhibit = number(objects, COMMUNICATION + index, INHIBIT) or 0
    return max(event_ms * 1e-3, inhibit * INHIBIT_UNIT_S)
