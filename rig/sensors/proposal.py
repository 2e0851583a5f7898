"""A DBC and a configuration for what was found on a bus."""

import json
from collections.abc import Iterable, Mapping, Sequence
from math import ceil
from typing import Any, NamedTuple, cast

import cantools.database
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from can_dbc.units import Dimension, si_conversion
from rig.bus.bus import BusConfig
from rig.sensors.canopen_description import Device, Mapped, Pdo
from rig.sensors.j1939 import LARGEST_VALUE, Claim, Spoken

DBC_NAME, CONFIG_NAME = "sensors.dbc", "rig.yaml"
_BRIDGE = "RIG"
_HEARTBEATS_MISSED = 2.5
"""Heartbeats after which one counts as lost: a single one that is late or lost is no fault."""

_FORMAT = "VFrameFormat"
_FORMATS = ("StandardCAN", "ExtendedCAN", "reserved", "J1939PG")
"""The attribute that marks a message of J1939, which cantools reads and does not write."""

_EXTENDED_IN_DBC = 1 << 31

_MOST_MS = 65_535
_STALE_CYCLES = 5


class Origin(NamedTuple):
    """Where the height of a position sensor begins, and which way it counts.

    Attributes:
        height_m: Height of the strut where the sensor reads `reading_m`.
        reading_m: What it reads there.
        is_reversed: Whether it counts up while the strut gets shorter.
    """

    height_m: float
    reading_m: float
    is_reversed: bool


class Place(NamedTuple):
    """Where a quantity was found on the bus.

    Attributes:
        message: Name of the message.
        signal: Name of the signal.
        node_id: Node that sends it; None of J1939.
        mapped: The object; None of J1939.
    """

    message: str
    signal: str
    node_id: int | None
    mapped: Mapped | None


def positions(devices: Sequence[Device]) -> list[Place]:
    """Where CANopen devices send a length, the likeliest height first."""
    return [item for item, dimension in _places(devices) if dimension is Dimension.LENGTH]


def dbc_text(
    devices: Sequence[Device], spoken: Sequence[Spoken], origin: Origin | None = None
) -> str:
    """A DBC of what the devices send, with what the bridge publishes.

    Args:
        devices: CANopen devices.
        spoken: Known groups of J1939.
        origin: Where the height of the first position begins; as the sensor counts if None.

    Raises:
        InputError: Two devices send under one id.
    """
    own = cast(
        "Any", cantools.database.load_file(DEFAULT_DATABASE, database_format="dbc")
    )  # with its attributes
    height = next(iter(positions(devices)), None)
    messages: dict[tuple[int, bool], Message] = {}
    for device in devices:
        for pdo in device.pdos:
            _put(messages, _message(device, pdo, height, origin))
    for item in spoken:
        _put(messages, _group_message(item))
    bridge = [item for item in own.messages if _BRIDGE in item.senders]
    _move_out_of_the_way(bridge, {key for key, is_extended in messages if not is_extended})
    names = [_BRIDGE, *[device.name for device in devices], *sorted({_node(i) for i in spoken})]
    made = Database(
        messages=[*messages.values(), *bridge],
        nodes=[Node(name, None) for name in names],
        dbc_specifics=own.dbc,
    )
    return _marked(made.as_dbc_string(), [item.arbitration_id for item in spoken])


def _move_out_of_the_way(bridge: Sequence[Message], taken: set[int]) -> None:
    """Give messages of the bridge whose ids a device sends under the next free ones."""
    used = taken | {item.frame_id for item in bridge}
    for item in bridge:
        if item.frame_id in taken:
            item.frame_id = next(key for key in range(item.frame_id + 1, 0x800) if key not in used)
            used.add(item.frame_id)


def _marked(text: str, j1939_ids: Sequence[int]) -> str:
    """A DBC with the messages of these ids marked as J1939."""
    if not j1939_ids:
        return text
    choices = ",".join(f'"{choice}"' for choice in _FORMATS)
    value = _FORMATS.index("J1939PG")
    marks = [f'BA_ "{_FORMAT}" BO_ {key | _EXTENDED_IN_DBC} {value};' for key in j1939_ids]
    added = {
        "BA_DEF_DEF_ ": [f'BA_DEF_ BO_ "{_FORMAT}" ENUM {choices};'],
        'BA_ "': [f'BA_DEF_DEF_ "{_FORMAT}" "{_FORMATS[0]}";', *marks],
    }
    lines: list[str] = []
    for line in text.splitlines():
        for start in [start for start in added if line.startswith(start)]:
            lines += added.pop(start)
        lines.append(line)
    return "\n".join(lines) + "\n"


def configuration_text(
    devices: Sequence[Device],
    spoken: Sequence[Spoken],
    claims: Sequence[Claim],
    bus: BusConfig,
) -> str:
    """A configuration that reads what was found: to be read before it runs.

    Args:
        devices: CANopen devices.
        spoken: Known groups of J1939.
        claims: J1939 devices that claim an address.
        bus: The bus they are on.

    Raises:
        InputError: Nothing measures a length.
    """
    heights = positions(devices)
    levels = _levels(spoken)
    forces = [item for item, dimension in _places(devices) if dimension is Dimension.FORCE]
    warm = [item for item, dimension in _places(devices) if dimension is Dimension.TEMPERATURE]
    if not (heights or levels):
        raise InputError("nothing that was found measures a length, expected the height of a strut")
    rest = "" if bus.data_bitrate is None else f", data_bitrate: {bus.data_bitrate}"
    lines = [
        "model: reference          # the bench's own model file",
        f"dbc: {DBC_NAME}",
        f"bus: {{interface: {bus.interface}, channel: {_quoted(bus.channel)}, "
        f"bitrate: {bus.bitrate}{rest}}}",
        "signals:",
        _line("height", [*heights, *levels]),
    ]
    used = [(heights or levels)[0]]
    if forces:
        lines.append(_line("load_cell_force", forces))
        used.append(forces[0])
    if warm:
        lines.append(_line("temperature", warm))
        used.append(warm[0])
    lines += _devices_block(devices, spoken, claims, used)
    slowest_s = max((_cycle_s(devices, spoken, item) or 0.0 for item in used[:1]), default=0.0)
    if slowest_s * _STALE_CYCLES > 0.01:
        stale_s = slowest_s * _STALE_CYCLES
        lines.append(
            f"supervision: {{stale_after_s: {stale_s:g}, safe_after_s: {max(0.5, 2 * stale_s):g}}}"
        )
        lines.append(f"rate_hz: {min(1000.0, max(1.0, round(1 / slowest_s))):g}")
    return "\n".join(lines) + "\n"


def _places(devices: Sequence[Device]) -> Iterable[tuple[Place, Dimension | None]]:
    for device in devices:
        for pdo in device.pdos:
            names = _names(pdo)
            for item in pdo.mapped:
                place = Place(_message_name(device, pdo), names[item], device.node_id, item)
                yield place, item.meaning.dimension


def _names(pdo: Pdo) -> dict[Mapped, str]:
    """Names of the signals of a PDO, each once."""
    names: dict[Mapped, str] = {}
    for item in pdo.mapped:
        name = item.meaning.name
        names[item] = name if name not in names.values() else f"{name}_AT_{item.start}"
    return names


def _message_name(device: Device, pdo: Pdo) -> str:
    return f"{device.name}_TPDO{pdo.number}"


def _message(device: Device, pdo: Pdo, height: Place | None, origin: Origin | None) -> Message:
    names = _names(pdo)
    message_name = _message_name(device, pdo)
    signals: list[Signal] = []
    for item in pdo.mapped:
        scale, offset = item.meaning.scale, 0.0
        if origin is not None and height == (message_name, names[item], device.node_id, item):
            scale = -scale if origin.is_reversed else scale
            reading_m = -origin.reading_m if origin.is_reversed else origin.reading_m
            metre = si_conversion(item.meaning.unit, Dimension.LENGTH).factor
            offset = (origin.height_m - reading_m) / metre
        signals.append(_signal(item, names[item], scale, offset))
    return Message(
        frame_id=pdo.arbitration_id,
        is_extended_frame=pdo.is_extended,
        name=message_name,
        length=pdo.length_bytes,
        signals=signals,
        senders=[device.name],
        cycle_time=_cycle_ms(pdo.cycle_s),
        comment=f"{device.label or device.kind}, TPDO {pdo.number} of node {device.node_id}",
        dbc_specifics=None,
        sort_signals=None,
    )


def _signal(item: Mapped, name: str, scale: float, offset: float) -> Signal:
    found = item.meaning
    conversion = BaseConversion.factory(scale=scale, offset=offset, is_float=found.is_float)
    return Signal(
        name=name,
        start=item.start,
        length=item.bits,
        byte_order="little_endian",
        is_signed=found.is_signed and not found.is_float,
        conversion=conversion,
        unit=found.unit or None,
        receivers=[_BRIDGE],
        comment=found.note or None,
    )


def _node(item: Spoken) -> str:
    return f"ADDRESS_{item.address}"


def _group_message(item: Spoken) -> Message:
    signals = [
        Signal(
            name=found.name,
            start=8 * found.byte,
            length=16,
            byte_order="little_endian",
            is_signed=False,
            conversion=BaseConversion.factory(scale=found.scale, offset=found.offset),
            minimum=found.offset,
            maximum=LARGEST_VALUE * found.scale + found.offset,
            unit=found.unit,
            receivers=[_BRIDGE],
        )
        for found in item.group.parameters
    ]
    return Message(
        frame_id=item.arbitration_id,
        is_extended_frame=True,
        name=f"{item.group.name}_FROM_{item.address}",
        length=8,
        signals=signals,
        senders=[_node(item)],
        cycle_time=_cycle_ms(item.group.cycle_s),
        protocol="j1939",
    )


def _put(messages: dict[tuple[int, bool], Message], message: Message) -> None:
    other = messages.setdefault((message.frame_id, message.is_extended_frame), message)
    if other is not message:
        raise InputError(
            f"{other.name} and {message.name} have the same id {message.frame_id:#x}, expected "
            "each device to send under ids of its own"
        )


def _cycle_ms(cycle_s: float | None) -> int | None:
    """Whole ms, as a DBC has it, and no less than the device's."""
    if cycle_s is None:
        return None
    return min(max(1, ceil(cycle_s * 1e3 - 1e-6)), _MOST_MS)


def _levels(spoken: Sequence[Spoken]) -> list[Place]:
    return [
        Place(f"{item.group.name}_FROM_{item.address}", found.name, None, None)
        for item in spoken
        for found in item.group.parameters
        if found.unit == "mm"
    ]


def _line(key: str, found: Sequence[Place]) -> str:
    best, *others = found
    text = f"  {key}: {{message: {best.message}, signal: {best.signal}}}"
    if others:
        text += f"   # or {', '.join(f'{item.message}.{item.signal}' for item in others[:4])}"
    return text


def _devices_block(
    devices: Sequence[Device],
    spoken: Sequence[Spoken],
    claims: Sequence[Claim],
    used: Sequence[Place],
) -> list[str]:
    nodes = {item.node_id for item in used}
    lines = [
        f"  {device.name}: {json.dumps(_entry(device))}"
        for device in devices
        if device.node_id in nodes
    ]
    names: Mapping[int, int] = {claim.address: claim.name for claim in claims}
    messages = [item.message for item in used if item.node_id is None]
    lines += [
        f"  {_node(item)}: {{j1939_name: {names[item.address]:#018x}, "
        f"source_address: {item.address}}}"
        for item in spoken
        if item.address in names and f"{item.group.name}_FROM_{item.address}" in messages
    ]
    return ["devices:", *lines] if lines else []


def _entry(device: Device) -> dict[str, object]:
    """Entry of a device under `devices`."""
    entry: dict[str, object] = {"node_id": device.node_id, "emergency_id": device.emergency_id}
    if device.heartbeat_s:
        entry["heartbeat_s"] = round(_HEARTBEATS_MISSED * device.heartbeat_s, 4)  # up to 164 s
    alarms = [
        {"message": _message_name(device, pdo), "signal": names[item]}
        for pdo in device.pdos
        for names in [_names(pdo)]
        for item in pdo.mapped
        if item.meaning.is_alarm
    ]
    return entry | ({"alarms": alarms} if alarms else {})


def _cycle_s(devices: Sequence[Device], spoken: Sequence[Spoken], place: Place) -> float | None:
    for device in devices:
        for pdo in device.pdos:
            if _message_name(device, pdo) == place.message:
                return pdo.cycle_s
    groups = {f"{item.group.name}_FROM_{item.address}": item.group.cycle_s for item in spoken}
    return groups.get(place.message)


def _quoted(text: str) -> str:
    return text if text.replace("_", "").isalnum() else json.dumps(text)
