"""J1939 devices that send levels and pressures: their names, and the content of their groups.

References: SAE J1939-21 (identifiers), J1939-81 (address claim and NAME), J1939-71 (parameters).
"""

from collections.abc import Sequence
from typing import NamedTuple

from can_dbc.frame import Frame

_CLAIM = 0xEE00
_NO_ADDRESS = 0xFE
_DESTINATION_BELOW = 240


class AddressClaim(NamedTuple):
    """Claim of an address by a device with a NAME of 64 bits."""

    address: int
    name: int

    @property
    def manufacturer(self) -> int:
        """Manufacturer code."""
        return self.name >> 21 & 0x7FF

    @property
    def function(self) -> int:
        """Function code."""
        return self.name >> 40 & 0xFF

    @property
    def identity(self) -> int:
        """Identity number, which the manufacturer gives each device."""
        return self.name & 0x1FFFFF


class GroupParameter(NamedTuple):
    """A value in a parameter group, two bytes, low one first.

    Attributes:
        name: Name of its signal in a DBC.
        byte: Its first byte, from 0 on.
        scale: Value of one raw step.
        offset: Value of raw 0.
    """

    name: str
    byte: int
    scale: float
    offset: float
    unit: str


class ParameterGroup(NamedTuple):
    """A parameter group by its number, the PGN, with its name in a DBC."""

    number: int
    name: str
    cycle_s: float
    parameters: tuple[GroupParameter, ...]


_CORNERS = ("FRONT_LEFT", "FRONT_RIGHT", "REAR_LEFT", "REAR_RIGHT")
GROUPS = tuple(
    ParameterGroup(
        number,
        name,
        0.1,
        tuple(
            GroupParameter(f"{label}_{corner}", 2 * index, 0.1, offset, unit)
            for index, corner in enumerate(_CORNERS)
        ),
    )
    for number, name, label, offset, unit in (
        (65112, "ASC4", "BELLOW_PRESSURE", 0.0, "kPa"),
        (65113, "ASC3", "RELATIVE_LEVEL", -3200.0, "mm"),
    )
)
"""Groups of the air suspension control that J1939-71 gives a position or a pressure to. Other
sensors send groups of Proprietary B, whose layout only the manufacturer knows."""

LARGEST_VALUE = 0xFAFF
"""Largest raw value of two bytes that is a value: above it are errors and "not available"."""


class GroupMessage(NamedTuple):
    """A known group that a device sends, with the id of its last frame."""

    group: ParameterGroup
    arbitration_id: int
    address: int

    @property
    def message_name(self) -> str:
        """Name of the message in a DBC."""
        return f"{self.group.name}_FROM_{self.address}"

    @property
    def node_name(self) -> str:
        """Name of the sender in a DBC."""
        return f"ADDRESS_{self.address}"


def group_number(arbitration_id: int) -> int:
    """PGN of a 29-bit id, without the destination address that some groups have in it."""
    pdu_format = arbitration_id >> 16 & 0xFF
    number = arbitration_id >> 8 & 0x3FFFF
    return number & 0x3FF00 if pdu_format < _DESTINATION_BELOW else number


def address_claims(frames: Sequence[Frame]) -> tuple[AddressClaim, ...]:
    """Addresses and their owners: the last claim of each NAME, and the lower NAME of an address.

    A device that gets no address claims the address 254, which is left out.
    """
    addresses: dict[int, int] = {}
    for frame in frames:
        is_claim = frame.is_extended and group_number(frame.arbitration_id) == _CLAIM
        if is_claim and len(frame.data) == 8:
            addresses[int.from_bytes(frame.data, "little")] = frame.arbitration_id & 0xFF
    owners: dict[int, int] = {}
    for name, address in addresses.items():
        if address != _NO_ADDRESS:
            owners[address] = min(name, owners.get(address, name))
    return tuple(sorted(AddressClaim(address, name) for address, name in owners.items()))


def group_messages(frames: Sequence[Frame]) -> tuple[GroupMessage, ...]:
    """Known groups among frames, one for each sender."""
    known = {group.number: group for group in GROUPS}
    messages: dict[tuple[int, int], GroupMessage] = {}
    for frame in frames:
        number = group_number(frame.arbitration_id) if frame.is_extended else -1
        if number in known and len(frame.data) == 8:
            address = frame.arbitration_id & 0xFF
            messages[number, address] = GroupMessage(known[number], frame.arbitration_id, address)
    return tuple(messages[key] for key in sorted(messages))
