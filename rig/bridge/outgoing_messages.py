"""Outgoing messages, compiled from the DBC and what their signals publish."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

from can_dbc.codec import compile_encoder, si_range
from can_dbc.database import Message
from can_dbc.frame import Frame
from can_dbc.protection import compile_protector
from rig.bridge.counts import Report
from rig.bridge.published_quantities import STATUS, Publication


@dataclass(frozen=True)
class Outgoing:
    """A message of the bridge.

    Attributes:
        message: Its definition.
        frame: What a tick reports, and the time in ns -> the frame, and whether one of its values
            saturated.
        period_ns: Time between two frames; 0: one at every tick.
        is_status: Whether it reports what has happened since the last one of its kind.
    """

    message: Message
    frame: Callable[[Report, int], tuple[Frame, bool]]
    period_ns: int
    is_status: bool = False


class PublishedSignal(NamedTuple):
    """What one signal of an outgoing message carries; `strut` is 0 where it is of none."""

    signal: str
    publication: Publication
    strut: int = 0


def compile_outgoing(message: Message, published: Sequence[PublishedSignal]) -> Outgoing:
    """Compile an outgoing message. Signals that publish nothing are zero.

    Multiplexed signals are sent page by page, one page a frame.

    Raises:
        DatabaseError: A signal is missing, or its unit does not fit what is published under it.
    """
    pages = [_page(message, page) for page in _pages(message, published)]
    payload = pages[0] if len(pages) == 1 else _in_turn(pages)
    protect = None if message.protection is None else compile_protector(message.protection)
    (arbitration_id, is_extended), is_fd = message.key, message.is_fd

    def frame(report: Report, t_ns: int) -> tuple[Frame, bool]:
        data, saturated = payload(report)
        if protect is not None:
            data = protect(data, report.number)
        return Frame(t_ns, arbitration_id, data, is_extended, is_fd), saturated

    is_status = any(item.publication in STATUS for item in published)
    return Outgoing(message, frame, message.cycle_time_ns or 0, is_status)


_Payload = Callable[[Report], tuple[bytes, bool]]
"""What a tick reports -> a payload, and whether one of its values saturated."""


def _in_turn(pages: Sequence[_Payload]) -> _Payload:
    return lambda report: pages[report.number % len(pages)](report)


def _pages(message: Message, published: Sequence[PublishedSignal]) -> list[list[PublishedSignal]]:
    """What stands in one frame together, in the order of the multiplexer's values."""
    always: list[PublishedSignal] = []
    by_values: dict[tuple[int, ...], list[PublishedSignal]] = {}
    for item in published:
        signal = message.signal(item.signal)
        if signal.multiplexer is None:
            always.append(item)
        else:
            by_values.setdefault(tuple(sorted(signal.multiplexer_ids)), []).append(item)
    return [always + by_values[key] for key in sorted(by_values)] or [always]


def _page(message: Message, published: Sequence[PublishedSignal]) -> _Payload:
    names = [item.signal for item in published]
    dimensions = [item.publication.dimension for item in published]
    encode = compile_encoder(message, names, dimensions)
    attributes = [item.publication.attribute for item in published]
    if len(published) > 1 and all(attributes) and len({item.strut for item in published}) == 1:
        # An estimate is sent at every tick: its values are looked up in one call.
        get, strut = attrgetter(*attributes), published[0].strut
        return lambda report: encode(get(report.output.struts[strut]))
    values = [(_value(message, item), item.strut) for item in published]

    def payload(report: Report) -> tuple[bytes, bool]:
        return encode([value(report, strut) for value, strut in values])

    return payload


def _value(message: Message, item: PublishedSignal) -> Callable[[Report, int], float]:
    """A published value; a count stops at the end of its range, or begins again behind it."""
    value, publication = item.publication.value, item.publication
    if not (publication.stops_at_range or publication.wraps_at_range):
        return value
    low, high = si_range(message, item.signal, publication.dimension)
    if publication.wraps_at_range:
        first, count = round(low), round(high) - round(low) + 1
        return lambda report, strut: first + value(report, strut) % count
    return lambda report, strut: min(value(report, strut), high)
