"""A CANopen device as its own objects describe it.

Reference: CiA 301, "CANopen application layer and communication profile": 1000h device type, 1018h
identity, 1014h emergency, 1017h heartbeat, 1800h and 1A00h process data objects that are sent.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from rig.sensors.objects import Objects, number, text
from rig.sensors.profiles import ENCODER, MEASURING_DEVICE, Meaning, meaning

COMMUNICATION, MAPPING = 0x1800, 0x1A00
COB_ID, TRANSMISSION, INHIBIT, EVENT = 1, 2, 3, 5
"""Subindices of a PDO's communication record."""

CYCLE, HEARTBEAT, EMERGENCY, SYNC, SYNC_PERIOD = 0x6200, 0x1017, 0x1014, 0x1005, 0x1006
OFF, EXTENDED = 1 << 31, 1 << 29
LAST_SYNCHRONOUS, BY_ITSELF = 240, (254, 255)
"""Largest transmission type that waits for SYNC, and those that send by themselves."""

INHIBIT_UNIT_S = 1e-4
_FLOAT_BITS = (32, 64)

_MOST_PDOS, _MOST_MAPPED = 16, 64
_LAST_DUMMY = 0x001F
"""Indices up to this are data types: a gap in the frame."""

_PROFILES = {ENCODER: "encoder (CiA 406)", MEASURING_DEVICE: "measuring device (CiA 404)"}


@dataclass(frozen=True)
class Mapped:
    """An object in the frame of a PDO.

    Attributes:
        index: Index of the object.
        subindex: Its subindex.
        start: Its lowest bit in the frame.
        bits: How many it has.
        meaning: What it means.
    """

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
        arbitration_id: Id of its frames.
        is_extended: Whether the id has 29 bits.
        transmission: Transmission type.
        cycle_s: Time between two frames; None where the device does not tell.
        mapped: What stands in it.
        note: What of its mapping cannot be read, empty if nothing.
    """

    number: int
    arbitration_id: int
    is_extended: bool
    transmission: int
    cycle_s: float | None
    mapped: tuple[Mapped, ...]
    note: str = ""

    @property
    def length_bytes(self) -> int:
        """Length of its payload."""
        return -(-max((item.start + item.bits for item in self.mapped), default=0) // 8)


@dataclass(frozen=True)
class Device:
    """A device as it describes itself.

    Attributes:
        node_id: CANopen node id.
        device_type: Content of 1000h.
        label: What its maker calls it.
        identity: Vendor, product, revision and serial number, as far as they are told.
        heartbeat_s: Time between two heartbeats; 0 for none.
        emergency_id: Arbitration id of its emergency frames.
        pdos: What it sends.
        notes: What its reader should know.
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
        """What it is, by its profile."""
        profile = self.device_type & 0xFFFF
        return _PROFILES.get(profile, f"CiA {profile}" if profile else "of no profile")


def described(objects: Objects, node_id: int) -> Device | None:
    """A device by its objects.

    Args:
        objects: Its objects.
        node_id: Its node id.

    Returns:
        The device; None if it has no device type, which is no CANopen device.
    """
    device_type = number(objects, 0x1000)
    if device_type is None:
        return None
    vendor, product, revision, serial = (number(objects, 0x1018, item) for item in range(1, 5))
    emergency_id = number(objects, EMERGENCY)
    pdos = tuple(_pdos(objects, device_type))
    notes = [
        f"TPDO {pdo.number}, {item.meaning.name}: {item.meaning.note}"
        for pdo in pdos
        for item in pdo.mapped
        if item.meaning.note
    ]
    if not pdos:
        notes.append("it sends no process data that is switched on (1800h and after)")
    notes += [f"TPDO {pdo.number}: {pdo.note}" for pdo in pdos if pdo.note]
    notes += [
        f"TPDO {pdo.number} tells no cycle: its frames are only expected when something changes"
        for pdo in pdos
        if pdo.cycle_s is None
    ]
    return Device(
        node_id=node_id,
        device_type=device_type,
        label=text(objects, 0x1008),
        identity=(vendor, product, revision, serial),
        heartbeat_s=(number(objects, HEARTBEAT) or 0) * 1e-3,
        emergency_id=_eleven_bits(emergency_id) or 0x080 + node_id,
        pdos=pdos,
        notes=tuple(notes),
    )


def _eleven_bits(cob_id: int | None) -> int:
    return 0 if cob_id is None or cob_id & OFF else cob_id & 0x7FF


def _pdos(objects: Objects, device_type: int) -> Iterator[Pdo]:
    """What it sends, as far as it is switched on and holds anything."""
    for place in range(_MOST_PDOS):
        cob_id = number(objects, COMMUNICATION + place, COB_ID)
        if cob_id is None or cob_id & OFF:
            continue
        mapped, note = _mapped(objects, device_type, MAPPING + place)
        if not mapped and not note:
            continue
        is_extended = bool(cob_id & EXTENDED)
        transmission = number(objects, COMMUNICATION + place, TRANSMISSION) or 0
        yield Pdo(
            number=place + 1,
            arbitration_id=cob_id & (0x1FFFFFFF if is_extended else 0x7FF),
            is_extended=is_extended,
            transmission=transmission,
            cycle_s=_cycle_s(objects, device_type, place, transmission),
            mapped=mapped,
            note=note,
        )


def _mapped(objects: Objects, device_type: int, index: int) -> tuple[tuple[Mapped, ...], str]:
    """What is mapped, and what of it cannot be read."""
    made: list[Mapped] = []
    start = 0
    for place in range(1, min(number(objects, index) or 0, _MOST_MAPPED) + 1):
        entry = number(objects, index, place)
        bits = 0 if entry is None else entry & 0xFF
        if entry is None or bits == 0 or start + bits > 64:
            what = "cannot be read" if entry is None else f"has {bits} bits from bit {start} on"
            return tuple(made), f"entry {place} {what}: it and what follows are left out"
        found, subindex = entry >> 16, entry >> 8 & 0xFF
        if found > _LAST_DUMMY:
            means = meaning(objects, device_type, found, subindex)
            if means.is_float and bits not in _FLOAT_BITS:
                note = f"a REAL of {bits} bits, which is none"
                means = Meaning(means.name, note=note)
            made.append(Mapped(found, subindex, start, bits, means))
        start += bits
    return tuple(made), ""


def _cycle_s(objects: Objects, device_type: int, place: int, transmission: int) -> float | None:
    """Time between two frames as the objects tell it."""
    if transmission not in BY_ITSELF:
        # Type 0 waits for a change and SYNC, types above 240 for a request.
        is_cyclic = 0 < transmission <= LAST_SYNCHRONOUS
        period_us = number(objects, SYNC_PERIOD) if is_cyclic else None
        return transmission * period_us * 1e-6 if period_us else None
    event_ms = number(objects, COMMUNICATION + place, EVENT)
    if not event_ms and place == 0 and device_type & 0xFFFF == ENCODER:
        event_ms = number(objects, CYCLE)
    if not event_ms:
        return None
    inhibit = number(objects, COMMUNICATION + place, INHIBIT) or 0
    return max(event_ms * 1e-3, inhibit * INHIBIT_UNIT_S)
