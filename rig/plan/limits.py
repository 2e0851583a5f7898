"""Limits of each strut: those of the configuration, and those that follow from the DBC.

A row of the configuration replaces what would follow for its value. From the DBC follow: a height
outside its signal's range is refused; a model whose height leaves that range by a tenth of its span
stops, since no bench is there; an estimated force that its signal cannot carry is invalid.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from can_dbc.codec import si_range, si_step
from can_dbc.database import Message
from can_dbc.errors import DatabaseError, InputError
from can_dbc.units import Dimension
from rig.bridge.supervision_limits import Limit, LimitedValue
from rig.channels.channel import Channel

_MARGIN = 0.1
"""Of a height's span, by which the model may leave it: the innovation is that large at most."""


def limits_by_strut(
    configured: Sequence[Limit],
    struts: Sequence[str],
    heights: Iterable[Channel],
    forces: Mapping[int, tuple[Message, str]],
    source: Path,
    *,
    can_compare: bool,
) -> tuple[tuple[Limit, ...], ...]:
    """Limits of each strut.

    Args:
        configured: The configuration's rows.
        struts: Names of the model's struts.
        heights: Channels of the measured heights.
        forces: Strut -> message and signal that publish its force.
        can_compare: Whether the bench has a load cell with which an estimate can be compared.
        source: File of the configuration, for messages.

    Raises:
        InputError: A row names a strut that the model does not have, or needs a load cell that the
            bench does not have.
    """
    for index, row in enumerate(configured):
        if row.value is LimitedValue.FORCE_DIFFERENCE_N:
            _check_comparison(row, f"{source}: supervision.limits.{index}", struts, can_compare)
        if row.strut is not None and row.strut not in struts:
            raise InputError(
                f"{source}: supervision.limits.{index}.strut: {row.strut}: no such strut, expected "
                f"{', '.join(struts)}"
            )
    channel_of = {channel.strut: channel for channel in heights}
    every: list[tuple[Limit, ...]] = []
    for index, strut in enumerate(struts):
        own = [row for row in configured if row.strut in (None, strut)]
        taken = {row.value for row in own}
        channel, force = channel_of.get(index), forces.get(index)
        defaults = [
            *(() if channel is None else _of_height(channel)),
            *(() if force is None else _of_force(*force)),
        ]
        every.append((*own, *(row for row in defaults if row.value not in taken)))
    return tuple(every)


def _check_comparison(row: Limit, where: str, struts: Sequence[str], can_compare: bool) -> None:
    """Refuse a limit on the difference from a load cell whose strut is not known, or of none."""
    if not can_compare:
        raise InputError(
            f"{where}.value: {row.value.value}: expected signals.load_cell_force and no "
            "prescribed_motion, because the estimate is compared with the load cell"
        )
    if row.strut is None and len(struts) > 1:
        raise InputError(
            f"{where}.strut: expected the strut that the load cell measures, one of "
            f"{', '.join(struts)}"
        )


def _of_height(channel: Channel) -> Iterator[Limit]:
    """Limits that follow from the signal of a height."""
    if channel.message is None:
        return
    found = _range(channel.message, channel.signal, Dimension.LENGTH)
    if found is None:
        return
    low_m, high_m = found
    if _is_narrower_than_bits(channel.message, channel.signal):
        half_m = 0.5 * si_step(channel.message, channel.signal, Dimension.LENGTH)
        yield Limit(
            value=LimitedValue.MEASURED_HEIGHT_M,
            low=low_m - half_m,
            high=high_m + half_m,
            action="refuse",
        )
    margin_m = _MARGIN * (high_m - low_m)
    yield Limit(
        value=LimitedValue.HEIGHT_M, low=low_m - margin_m, high=high_m + margin_m, action="safe"
    )


def _of_force(message: Message, signal: str) -> Iterator[Limit]:
    """The limit that follows from the signal that publishes a force."""
    found = _range(message, signal, Dimension.FORCE)
    if found is not None:
        low_n, high_n = found
        yield Limit(value=LimitedValue.FORCE_N, low=low_n, high=high_n, action="hold")


def _range(message: Message, signal: str, dimension: Dimension) -> tuple[float, float] | None:
    """Range of a signal in SI; None where it has none, or where the plan is refused for it."""
    try:
        low, high = si_range(message, signal, dimension)
    except DatabaseError:
        return None
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None


def _is_narrower_than_bits(message: Message, name: str) -> bool:
    """Whether the DBC's range excludes a value that the bits can hold."""
    signal = message.signal(name)
    if signal.minimum is None or signal.maximum is None:
        return False
    steps = abs((signal.maximum - signal.minimum) / signal.scale)
    return signal.is_float or round(steps) + 1 < 2**signal.length_bits
