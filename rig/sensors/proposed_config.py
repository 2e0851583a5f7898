"""A DBC and a configuration for the devices on a bus, to be read before they are used."""

import json
from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import cast

import cantools.database
from cantools.database.can import Database, Message, Node, Signal
from cantools.database.conversion import BaseConversion

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from can_dbc.units import Dimension
from rig.bus.bus import BusConfig
from rig.new_bench.proposal import propose_observer
from rig.sensors.bus_scan import BusSurvey
from rig.sensors.canopen_device import CanOpenDevice, MappedObject, Pdo
from rig.sensors.j1939 import LARGEST_VALUE, AddressClaim, GroupMessage
from rig.sensors.signal_locations import (
    SignalLocation,
    alarms,
    levels,
    locations,
    message_name,
    signal_names,
)

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


def write_proposal(folder: Path, survey: BusSurvey, bus: BusConfig) -> tuple[Path, Path]:
    """Write a DBC and a configuration for the devices on a bus; returns their files.

    The folder is new.

    Raises:
        InputError: No device measures a length, two devices send under one id, or the folder cannot
            be written.
    """
    configuration = configuration_text(survey.devices, survey.groups, survey.claims, bus)
    database = dbc_text(survey.devices, survey.groups)
    dbc_path, config_path = folder / DBC_NAME, folder / CONFIG_NAME
    try:
        folder.mkdir(parents=True)
        dbc_path.write_text(database, "utf-8")
        config_path.write_text(configuration, "utf-8")
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
    return dbc_path, config_path


def dbc_text(devices: Sequence[CanOpenDevice], groups: Sequence[GroupMessage]) -> str:
    """A DBC of the devices' messages, with those that the bridge publishes.

    Raises:
        InputError: Two devices send under one id.
    """
    own = cast(
        "Database", cantools.database.load_file(DEFAULT_DATABASE, database_format="dbc")
    )  # with its attributes
    messages: dict[tuple[int, bool], Message] = {}
    for device in devices:
        for pdo in device.pdos:
            _add_message(messages, _pdo_message(device, pdo))
    for item in groups:
        _add_message(messages, _group_message(item))
    bridge = [item for item in own.messages if _BRIDGE in item.senders]
    _move_out_of_the_way(bridge, {key for key, is_extended in messages if not is_extended})
    names = [_BRIDGE, *[device.name for device in devices]]
    names += sorted({item.node_name for item in groups})
    database = Database(
        messages=[*messages.values(), *bridge],
        nodes=[Node(name, None) for name in names],
        dbc_specifics=own.dbc,
    )
    return _mark_j1939(database.as_dbc_string(), [item.arbitration_id for item in groups])


def _move_out_of_the_way(bridge: Sequence[Message], taken: set[int]) -> None:
    """Give messages of the bridge whose ids a device sends under the next free ones."""
    used = taken | {item.frame_id for item in bridge}
    for item in bridge:
        if item.frame_id in taken:
            item.frame_id = next(key for key in range(item.frame_id + 1, 0x800) if key not in used)
            used.add(item.frame_id)


def _mark_j1939(text: str, ids: Sequence[int]) -> str:
    """Text of a DBC with the messages of these ids marked as J1939."""
    if not ids:
        return text
    choices = ",".join(f'"{choice}"' for choice in _FORMATS)
    value = _FORMATS.index("J1939PG")
    marks = [f'BA_ "{_FORMAT}" BO_ {key | _EXTENDED_IN_DBC} {value};' for key in ids]
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
    devices: Sequence[CanOpenDevice],
    groups: Sequence[GroupMessage],
    claims: Sequence[AddressClaim],
    bus: BusConfig,
) -> str:
    """A configuration for the devices on a bus, with the known groups and the claims of J1939.

    Raises:
        InputError: No device measures a length.
    """
    heights = [*locations(devices, Dimension.LENGTH), *levels(groups)]
    if not heights:
        raise InputError("no device on the bus measures a length, expected the height of a strut")
    rest = "" if bus.data_bitrate is None else f", data_bitrate: {bus.data_bitrate}"
    channel = bus.channel if bus.channel.replace("_", "").isalnum() else json.dumps(bus.channel)
    lines = [
        "model: reference          # an example: set the bench's own model file",
        f"dbc: {DBC_NAME}",
        f"bus: {{interface: {bus.interface}, channel: {channel}, bitrate: {bus.bitrate}{rest}}}",
        "signals:",
    ]
    used: list[SignalLocation] = []
    for key, sources in (
        ("height", heights),
        ("load_cell_force", locations(devices, Dimension.FORCE)),
        ("temperature", locations(devices, Dimension.TEMPERATURE)),
    ):
        if sources:
            lines.append(_signal_line(key, sources))
            used.append(sources[0])
    lines += _devices_block(devices, groups, claims, used)
    cycle_s = heights[0].cycle_s or 0.0
    lines += propose_observer(heights[0].step_m, round(cycle_s * 1e9) or None)
    if cycle_s * _STALE_CYCLES > 0.01:
        stale_s = cycle_s * _STALE_CYCLES
        lines.append(
            f"supervision: {{stale_after_s: {stale_s:g}, safe_after_s: {max(0.5, 2 * stale_s):g}}}"
        )
        lines.append(f"rate_hz: {min(1000.0, max(1.0, round(1 / cycle_s))):g}")
    return "\n".join(lines) + "\n"


def _pdo_message(device: CanOpenDevice, pdo: Pdo) -> Message:
    names = signal_names(pdo)
    signals = [_signal(item, names[item]) for item in pdo.mapped]
    return Message(
        frame_id=pdo.arbitration_id,
        is_extended_frame=pdo.is_extended,
        name=message_name(device, pdo),
        length=pdo.length_bytes,
        signals=signals,
        senders=[device.name],
        cycle_time=_cycle_ms(pdo.cycle_s),
        comment=f"{device.label or device.kind}, TPDO {pdo.number} of node {device.node_id}",
        dbc_specifics=None,
        sort_signals=None,
    )


def _signal(item: MappedObject, name: str) -> Signal:
    meaning = item.meaning
    conversion = BaseConversion.factory(scale=meaning.scale, is_float=meaning.is_float)
    return Signal(
        name=name,
        start=item.start,
        length=item.bits,
        byte_order="little_endian",
        is_signed=meaning.is_signed and not meaning.is_float,
        conversion=conversion,
        unit=meaning.unit or None,
        receivers=[_BRIDGE],
        comment=meaning.note or None,
    )


def _group_message(item: GroupMessage) -> Message:
    signals = [
        Signal(
            name=parameter.name,
            start=8 * parameter.byte,
            length=16,
            byte_order="little_endian",
            is_signed=False,
            conversion=BaseConversion.factory(scale=parameter.scale, offset=parameter.offset),
            minimum=parameter.offset,
            maximum=LARGEST_VALUE * parameter.scale + parameter.offset,
            unit=parameter.unit,
            receivers=[_BRIDGE],
        )
        for parameter in item.group.parameters
    ]
    return Message(
        frame_id=item.arbitration_id,
        is_extended_frame=True,
        name=item.message_name,
        length=8,
        signals=signals,
        senders=[item.node_name],
        cycle_time=_cycle_ms(item.group.cycle_s),
        protocol="j1939",
    )


def _add_message(messages: dict[tuple[int, bool], Message], message: Message) -> None:
    other = messages.setdefault((message.frame_id, message.is_extended_frame), message)
    if other is not message:
        raise InputError(
            f"{other.name} and {message.name} have the same id {message.frame_id:#x}, expected "
            "different ids of different devices"
        )


def _cycle_ms(cycle_s: float | None) -> int | None:
    """Whole ms, as a DBC has it, and no less than the device's."""
    if cycle_s is None:
        return None
    return min(max(1, ceil(cycle_s * 1e3 - 1e-6)), _MOST_MS)


def _signal_line(key: str, sources: Sequence[SignalLocation]) -> str:
    """Entry under `signals` for the first source; a comment names the others."""
    best, *others = sources
    text = f"  {key}: {{message: {best.message}, signal: {best.signal}}}"
    if others:
        text += f"   # or {', '.join(f'{item.message}.{item.signal}' for item in others[:4])}"
    return text


def _devices_block(
    devices: Sequence[CanOpenDevice],
    groups: Sequence[GroupMessage],
    claims: Sequence[AddressClaim],
    used: Sequence[SignalLocation],
) -> list[str]:
    nodes = {item.node_id for item in used}
    lines = [
        f"  {device.name}: {json.dumps(_device_entry(device))}"
        for device in devices
        if device.node_id in nodes
    ]
    names = {claim.address: claim.name for claim in claims}
    messages = [item.message for item in used if item.node_id is None]
    lines += [
        f"  {item.node_name}: {{j1939_name: {names[item.address]:#018x}, "
        f"source_address: {item.address}}}"
        for item in groups
        if item.address in names and item.message_name in messages
    ]
    return ["devices:", *lines] if lines else []


def _device_entry(device: CanOpenDevice) -> dict[str, object]:
    """Entry of a device under `devices`."""
    entry: dict[str, object] = {"node_id": device.node_id, "emergency_id": device.emergency_id}
    if device.heartbeat_s:
        entry["heartbeat_s"] = round(_HEARTBEATS_MISSED * device.heartbeat_s, 4)  # up to 164 s
    signals = [{"message": item.message, "signal": item.signal} for item in alarms(device)]
    return entry | ({"alarms": signals} if signals else {})
