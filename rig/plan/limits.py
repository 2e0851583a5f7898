"""Limits of struts and channels: those of the configuration, and those that follow from the DBC.

A row of the configuration replaces what would follow for its value. From the DBC follow: a height,
an applied force or a further sensor outside its signal's range is refused; a model whose height
leaves that range by a tenth of its span stops, since no bench is there; an estimated force that its
signal cannot carry is invalid. The innovation needs none, since its band follows from the run
(`rig.bridge.innovation_band`), and for a rate a DBC has no range.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from can_dbc.codec import si_range, si_step
from can_dbc.database import Message
from can_dbc.errors import DatabaseError, InputError, expected_name
from can_dbc.units import Dimension
from rig.bridge.supervision_limits import Limit, LimitedValue, Limits
from rig.channels.channel import Channel, Role

_MARGIN = 0.1
"""Of a height's span, by which the model may leave it: the innovation is that large at most."""


def resolve_limits(
    configured: Sequence[Limit],
    struts: Sequence[str],
    channels: Sequence[Channel],
    forces: Mapping[int, tuple[Message, str]],
    source: Path,
    *,
    can_compare: bool,
    without_std: Collection[str] = (),
) -> Limits:
    """Limits of each strut and of each channel.

    Args:
        configured: The configuration's rows.
        struts: Names of the model's struts.
        channels: Channels of the bench.
        forces: Strut -> message and signal that publish its force.
        can_compare: Whether the bench has a load cell with which an estimate can be compared.
        without_std: Struts whose observers do not know the standard deviation of the force.
        source: File of the configuration, for messages.

    Raises:
        InputError: A row names a strut that the model does not have or a channel that is not
            measured, or needs a load cell that the bench does not have, or a standard deviation
            that the observer does not know.
    """
    others = [channel for channel in channels if channel.role is not Role.HEIGHT]
    for index, row in enumerate(configured):
        where = f"{source}: supervision.limits.{index}"
        if row.value is LimitedValue.FORCE_DIFFERENCE_N:
            _check_comparison(row, where, struts, can_compare)
        _check_name(row.strut, struts, f"{where}.strut", "no such strut")
        for strut in struts_without_std(row, struts, without_std):
            raise InputError(
                f"{where}.value: {row.value.value}: observers.{strut} does not know it, expected "
                "an observer that does, such as kind kalman"
            )
        names = [channel.name for channel in others]
        _check_name(row.channel, names, f"{where}.channel", "not measured")
        _check_overlap(row, where, struts, channels)
    height_of = {channel.strut: channel for channel in channels if channel.role is Role.HEIGHT}
    of_struts: list[tuple[Limit, ...]] = []
    for index, strut in enumerate(struts):
        own = [row for row in configured if row.channel is None and row.strut in (None, strut)]
        height, force = height_of.get(index), forces.get(index)
        defaults = [
            *(() if height is None else _of_height(height)),
            *(() if force is None else _of_force(*force)),
        ]
        of_struts.append(_with_defaults(own, defaults))
    of_channels = [
        tuple(row for row in of_struts[channel.strut] if row.value.is_measured)
        if channel.role is Role.HEIGHT
        else _with_defaults(
            [row for row in configured if row.channel == channel.name], _of_channel(channel)
        )
        for channel in channels
    ]
    return Limits(tuple(of_struts), tuple(of_channels))


def _check_name(name: str | None, known: Sequence[str], where: str, problem: str) -> None:
    if name is not None and name not in known:
        expected = expected_name(name, known) if known else "expected none"
        raise InputError(f"{where}: {name}: {problem}, {expected}")


def _check_overlap(
    row: Limit, where: str, struts: Sequence[str], channels: Sequence[Channel]
) -> None:
    """Refuse a limit on a measured value that no value of its signal is within."""
    if row.value not in (LimitedValue.MEASURED_HEIGHT_M, LimitedValue.MEASURED):
        return
    for channel in channels:
        if row.channel is None:
            is_meant = channel.role is Role.HEIGHT and row.strut in (None, struts[channel.strut])
        else:
            is_meant = channel.role is not Role.HEIGHT and row.channel == channel.name
        if not is_meant or channel.message is None:
            continue
        found = _range(channel.message, channel.signal, channel.quantity.dimension)
        if found is None:
            continue
        low, high = found
        if row.low is not None and row.low > high:
            name, bound = "low", row.low
        elif row.high is not None and row.high < low:
            name, bound = "high", row.high
        else:
            continue
        raise InputError(
            f"{where}.{name}: {bound:g}, expected a value that {channel.signal} can have, "
            f"{low:g} to {high:g} in SI"
        )


def _with_defaults(own: Sequence[Limit], defaults: Iterable[Limit]) -> tuple[Limit, ...]:
    taken = {row.value for row in own}
    return (*own, *(row for row in defaults if row.value not in taken))


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


def struts_without_std(
    row: Limit, struts: Sequence[str], without_std: Collection[str]
) -> list[str]:
    """Struts of a limit on the standard deviation whose observers do not know it."""
    if row.value is not LimitedValue.FORCE_STD_N:
        return []
    return [strut for strut in struts if strut in without_std and row.strut in (None, strut)]


def _of_height(channel: Channel) -> Iterator[Limit]:
    """Limits that follow from the signal of a height."""
    if channel.message is None:
        return
    found = _range(channel.message, channel.signal, Dimension.LENGTH)
    if found is None:
        return
    low_m, high_m = found
    yield from _of_range(channel, None, LimitedValue.MEASURED_HEIGHT_M)
    margin_m = _MARGIN * (high_m - low_m)
    yield Limit(
        value=LimitedValue.HEIGHT_M, low=low_m - margin_m, high=high_m + margin_m, action="safe"
    )


def _of_channel(channel: Channel) -> Iterator[Limit]:
    """The limit that follows from a signal that the estimate rests on."""
    if channel.role in (Role.SENSOR, Role.INPUT):
        yield from _of_range(channel, channel.name, LimitedValue.MEASURED)


def _of_range(channel: Channel, name: str | None, value: LimitedValue) -> Iterator[Limit]:
    """The limit of a measured value, where the DBC's range excludes what its bits can hold."""
    message, dimension = channel.message, channel.quantity.dimension
    if message is None or not _is_narrower_than_bits(message, channel.signal):
        return
    found = _range(message, channel.signal, dimension)
    if found is not None:
        half = 0.5 * si_step(message, channel.signal, dimension)
        low, high = found[0] - half, found[1] + half
        yield Limit(channel=name, value=value, low=low, high=high, action="refuse")


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
