"""Height of the strut at a reading of its position sensor."""

from collections.abc import Sequence
from typing import NamedTuple

from can_dbc.errors import InputError
from can_dbc.units import Dimension, si_conversion
from rig.bus.canopen_network import CanOpenNetwork
from rig.sensors.canopen_device import CanOpenDevice
from rig.sensors.signal_locations import locations


class HeightZero(NamedTuple):
    """Height of the strut at a reading of its position sensor.

    A reversed sensor counts up while the strut gets shorter.
    """

    height_m: float
    reading_m: float
    is_reversed: bool


def read_height_zero(
    network: CanOpenNetwork,
    devices: Sequence[CanOpenDevice],
    height_m: float,
    *,
    is_reversed: bool,
) -> HeightZero:
    """The first position sensor of the devices read while the strut has a known height.

    Raises:
        InputError: The height is none of a strut, or no device reports a length.
    """
    if not 0.0 < height_m < 100.0:
        raise InputError(f"--height-now-m {height_m}: expected the height of a strut in m")
    position = next(iter(locations(devices, Dimension.LENGTH)), None)
    if position is None or position.mapped is None or position.node_id is None:
        raise InputError("--height-now-m: no CANopen device sends a length")
    mapped = position.mapped
    content = network.read(position.node_id, mapped.index, mapped.subindex)
    if not content or mapped.meaning.is_float:
        raise InputError(
            f"--height-now-m: node {position.node_id} does not report its position as an integer"
        )
    raw = int.from_bytes(content, "little") & (1 << mapped.bits) - 1
    if mapped.meaning.is_signed and raw >> mapped.bits - 1:
        raw -= 1 << mapped.bits
    metre = si_conversion(mapped.meaning.unit, Dimension.LENGTH).factor
    return HeightZero(height_m, raw * mapped.meaning.scale * metre, is_reversed)
