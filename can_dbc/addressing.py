"""Message of a frame, by its arbitration id.

A message of J1939 is identified by its parameter group: priority and source address of a frame may
differ from the DBC, and so may the destination where the group has one.

Reference: SAE J1939-21, "Data Link Layer", 5.1: the fields of an identifier.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from can_dbc.database import Message

_PDU_FORMAT = 16
_DESTINATION_BELOW = 240
"""PDU formats below this have a destination in the byte behind them."""

_WITH_DESTINATION, _BROADCAST = 0x03FF0000, 0x03FFFF00
"""Bits of an identifier that are its parameter group."""

_ALL_STANDARD, _ALL_EXTENDED = 0x7FF, 0x1FFFFFFF


def group_mask(arbitration_id: int) -> int:
    """Bits of a J1939 identifier that are its parameter group."""
    pdu_format = arbitration_id >> _PDU_FORMAT & 0xFF
    return _WITH_DESTINATION if pdu_format < _DESTINATION_BELOW else _BROADCAST


@dataclass(frozen=True)
class Filter:
    """Accepted identifiers: those with ``id & mask == arbitration_id & mask``."""

    arbitration_id: int
    mask: int
    is_extended: bool


class Directory:
    """Messages by the identifiers of their frames, as indices into `messages`.

    Where several messages share a group, they are identified by their whole identifiers.
    """

    def __init__(self, messages: Iterable[Message]) -> None:
        listed = list(messages)
        self._exact = {message.key: index for index, message in enumerate(listed)}
        groups = {
            index: (message.arbitration_id & group_mask(message.arbitration_id))
            for index, message in enumerate(listed)
            if message.is_j1939
        }
        often = Counter(groups.values())
        self._groups = {group: index for index, group in groups.items() if often[group] == 1}
        self.by_group = frozenset(self._groups.values())
        """Messages that are identified by their group: whoever sends it."""
        self.filters = tuple(
            _filter(message, index in self.by_group) for index, message in enumerate(listed)
        )
        """Filters that accept the frames of all messages."""

    def index_of(self, arbitration_id: int, is_extended: bool) -> int | None:
        """Index of a frame's message; None if it belongs to none."""
        index = self._exact.get((arbitration_id, is_extended))
        if index is None and is_extended and self._groups:
            return self._groups.get(arbitration_id & group_mask(arbitration_id))
        return index


def _filter(message: Message, is_group: bool) -> Filter:
    whole = _ALL_EXTENDED if message.is_extended else _ALL_STANDARD
    mask = group_mask(message.arbitration_id) if is_group else whole
    return Filter(message.arbitration_id, mask, message.is_extended)
