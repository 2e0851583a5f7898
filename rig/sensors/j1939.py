"""J1939 devices that send levels and pressures: who they are, and what their groups hold.

References: SAE J1939-21 (identifiers), J1939-81 (address claim and NAME), J1939-71 (parameters).
"""

from collections.abc import Sequence
from typing import NamedTuple

from can_dbc.frame import Frame

_CLAIM = 0xEE00
_NO_ADDRESS = 0xFE
_DESTINATION_BELOW = 240


class Claim(NamedTuple):
    """A device that claims an address.

    Attributes:
        address: Source address.
        name: Its NAME, 64 bits.
    """

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
        """Identity number: its serial number as the maker counts."""
        return self.name & 0x1FFFFF


class Parameter(NamedTuple):
    """A value in a parameter group, two bytes, low one first.

    Attributes:
        name: What a signal of it is called.
        byte: Its first byte, from 0 on.
        scale: Value of one raw step.
        offset: Value of raw 0.
        unit: Unit.
    """

    name: str
    byte: int
    scale: float
    offset: float
    unit: str


class Group(NamedTuple):
    """A parameter group.

    Attributes:
        number: PGN.
        name: What a message of it is called.
        cycle_s: Time between two.
        parameters: What it holds.
    """

    number: int
    name: str
    cycle_s: float
    parameters: tuple[Parameter, ...]


_CORNERS = ("FRONT_LEFT", "FRONT_RIGHT", "REAR_LEFT", "REAR_RIGHT")
GROUPS = (
    Group(
        65112,
        "ASC4",
        0.1,
        tuple(
            Parameter(f"BELLOW_PRESSURE_{corner}", 2 * place, 0.1, 0.0, "kPa")
            for place, corner in enumerate(_CORNERS)
        ),
    ),
    Group(
        65113,
        "ASC3",
        0.1,
        tuple(
            Parameter(f"RELATIVE_LEVEL_{corner}", 2 * place, 0.1, -3200.0, "mm")
            for place, corner in enumerate(_CORNERS)
        ),
    ),
)
"""Groups of the air suspension control that J1939-71 gives a position or a pressure to. Sensors of
their own makers send others (Proprietary B), whose layout only the maker knows."""

LARGEST_VALUE = 0xFAFF
"""Largest raw value of two bytes that is a value: above it are errors and "not available"."""


class Spoken(NamedTuple):
    """A known group that was heard.

    Attributes:
        group: The group.
        arbitration_id: Id of the last frame.
        address: Address of who sent it.
    """

    group: Group
    arbitration_id: int
    address: int


def group_number(arbitration_id: int) -> int:
    """PGN of a 29-bit id; of a group with a destination, without it."""
    pdu_format = arbitration_id >> 16 & 0xFF
    number = arbitration_id >> 8 & 0x3FFFF
    return number & 0x3FF00 if pdu_format < _DESTINATION_BELOW else number


def claims(frames: Sequence[Frame]) -> tuple[Claim, ...]:
    """Devices that claimed an address, the last claim of each NAME; of an address the lower NAME.

    A device that could not get one claims the address 254, and has none.
    """
    found: dict[int, int] = {}
    for frame in frames:
        is_claim = frame.is_extended and group_number(frame.arbitration_id) == _CLAIM
        if is_claim and len(frame.data) == 8:
            found[int.from_bytes(frame.data, "little")] = frame.arbitration_id & 0xFF
    owners: dict[int, int] = {}
    for name, address in found.items():
        if address != _NO_ADDRESS:
            owners[address] = min(name, owners.get(address, name))
    return tuple(sorted(Claim(address, name) for address, name in owners.items()))


def spoken(frames: Sequence[Frame]) -> tuple[Spoken, ...]:
    """Known groups that were heard, one for each sender."""
    known = {group.number: group for group in GROUPS}
    found: dict[tuple[int, int], Spoken] = {}
    for frame in frames:
        number = group_number(frame.arbitration_id) if frame.is_extended else -1
        if number in known and len(frame.data) == 8:
            address = frame.arbitration_id & 0xFF
            found[number, address] = Spoken(known[number], frame.arbitration_id, address)
    return tuple(found[key] for key in sorted(found))
