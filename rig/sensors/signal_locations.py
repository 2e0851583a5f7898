"""Messages and signals in which the devices on a bus send what they measure."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from can_dbc.units import Dimension, si_conversion
from rig.sensors.canopen_device import CanOpenDevice, MappedObject, Pdo
from rig.sensors.canopen_profiles import Meaning
from rig.sensors.j1939 import GroupMessage


class SignalLocation(NamedTuple):
    """Location of a measured quantity on the bus; one of J1939 has no node id and no object.

    Attributes:
        step_m: Step of a length; 0 of a float, and of what is no length.
    """

    message: str
    signal: str
    node_id: int | None
    mapped: MappedObject | None
    cycle_s: float | None
    step_m: float


def locations(devices: Sequence[CanOpenDevice], dimension: Dimension) -> list[SignalLocation]:
    """Locations of a dimension that CANopen devices send, in the order of devices and objects."""
    return _select_locations(devices, lambda meaning: meaning.dimension is dimension)


def alarms(device: CanOpenDevice) -> list[SignalLocation]:
    """Locations of the alarms of a device."""
    return _select_locations([device], lambda meaning: meaning.is_alarm)


def _select_locations(
    devices: Sequence[CanOpenDevice], is_sought: Callable[[Meaning], bool]
) -> list[SignalLocation]:
    return [
        SignalLocation(
            message_name(device, pdo),
            name,
            device.node_id,
            item,
            pdo.cycle_s,
            _step_m(item.meaning),
        )
        for device in devices
        for pdo in device.pdos
        for item, name in signal_names(pdo).items()
        if is_sought(item.meaning)
    ]


def _step_m(meaning: Meaning) -> float:
    if meaning.is_float or meaning.dimension is not Dimension.LENGTH:
        return 0.0
    return abs(meaning.scale) * si_conversion(meaning.unit, Dimension.LENGTH).factor


def levels(groups: Sequence[GroupMessage]) -> list[SignalLocation]:
    """Locations of levels that J1939 devices send."""
    return [
        SignalLocation(
            item.message_name,
            parameter.name,
            None,
            None,
            item.group.cycle_s,
            parameter.scale * si_conversion(parameter.unit, Dimension.LENGTH).factor,
        )
        for item in groups
        for parameter in item.group.parameters
        if parameter.unit == "mm"
    ]


def signal_names(pdo: Pdo) -> dict[MappedObject, str]:
    """Names of the signals of a PDO, each once."""
    names: dict[MappedObject, str] = {}
    for item in pdo.mapped:
        name = item.meaning.name
        names[item] = name if name not in names.values() else f"{name}_AT_{item.start}"
    return names


def message_name(device: CanOpenDevice, pdo: Pdo) -> str:
    """Name of a PDO's message in a DBC."""
    return f"{device.name}_TPDO{pdo.number}"
