"""Incoming messages, compiled from the DBC and the channels that they carry.

The order of the checks that their frames pass is that of `rig.bridge.frame_checks`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

from can_dbc.codec import Decoder, compile_decoder, si_range, si_step
from can_dbc.database import Message
from can_dbc.frame import Frame
from can_dbc.protection import FrameStatus, SequenceState, compile_checker
from can_dbc.units import Dimension
from rig.bridge.sample_times import Follower, compile_follower
from rig.channels.channel import Channel, Role, ValidSignal
from rig.channels.measured_quantities import APPLIED_FORCE

Values = tuple[float, ...]
"""Values of a frame in SI, in the order of the message's signals that are read."""

Reading = tuple[SequenceState, FrameStatus, Values | None]
"""State of the message's counter after a frame, the frame's status, and its values: none in a
refused frame or another page, `NO_VALUES` where a signal holds no value."""

NO_VALUES: Values = ()

Reader = Callable[[SequenceState, Frame], Reading]
"""State of a message's counter, and a frame of the message -> its reading."""


class Delivery(NamedTuple):
    """A value of a frame that goes to a channel.

    Attributes:
        value: Index of the value among the frame's.
        channel: Index of the channel.
        delay_ns: Time from the measurement to the arrival of its frame.
    """

    value: int
    channel: int
    delay_ns: int


class Alarm(NamedTuple):
    """A signal whose raw value is other than zero while its device is at fault.

    Attributes:
        signal: Name of the signal.
        device: Index of the device.
        alarm: Index of the alarm among the device's.
    """

    signal: str
    device: int
    alarm: int


class AlarmDelivery(NamedTuple):
    """A value of a frame that is an alarm.

    Attributes:
        value: Index of the value among the frame's.
        device: Index of the device.
        alarm: Index of the alarm among the device's.
    """

    value: int
    device: int
    alarm: int


class HeightDelivery(NamedTuple):
    """A value of a frame that is the reference height of a strut.

    Attributes:
        value: Index of the value among the frame's.
        strut: Index of the strut.
    """

    value: int
    strut: int


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message of the bench.

    Attributes:
        message: Its definition.
        read: Reads its frames.
        deliveries: Values that go to channels.
        heights: Values that are reference heights.
        alarms: Values that are alarms.
        device: Index of the device that sends it; None if none is configured.
        struts: Struts whose reference heights it carries, a bit each.
        first_strut: The bit of the first of them; 0 if there is none.
        follow: Follows the clock of its sender; None if its counter states no time.
        is_awaited: Whether an estimate rests on its values, so that late ones are used in the past.
    """

    message: Message
    read: Reader
    deliveries: tuple[Delivery, ...]
    heights: tuple[HeightDelivery, ...] = ()
    alarms: tuple[AlarmDelivery, ...] = ()
    device: int | None = None
    struts: int = 0
    first_strut: int = 0
    follow: Follower | None = None
    is_awaited: bool = False


def compile_incoming(
    message: Message,
    channels: Sequence[Channel],
    alarms: Sequence[Alarm] = (),
    device: int | None = None,
) -> Incoming:
    """Compile an incoming message.

    Raises:
        DatabaseError: A signal is missing, or its unit does not fit its quantity.
    """
    valid = [channel.valid for channel in channels if channel.valid is not None]
    # A load cell may be recorded and also be a further sensor: one value, two channels.
    signals = list(
        dict.fromkeys(
            [
                *((channel.signal, channel.quantity.dimension) for channel in channels),
                *((alarm.signal, Dimension.NUMBER) for alarm in alarms),
                *((item.signal, Dimension.NUMBER) for item in valid),
            ]
        )
    )
    decode = compile_decoder(message, [name for name, _ in signals], [unit for _, unit in signals])
    deliveries = [
        Delivery(
            signals.index((channel.signal, channel.quantity.dimension)),
            channel.index,
            channel.delay_ns,
        )
        for channel in channels
    ]
    heights = [
        HeightDelivery(delivery.value, channel.strut)
        for delivery, channel in zip(deliveries, channels, strict=True)
        if channel.role is Role.HEIGHT
    ]
    read = _compile_reader(message, decode)
    for check in (_check_of_values(message, signals), _check_of_validity(valid, signals)):
        if check is not None:
            read = _with_check(read, check)
    return Incoming(
        message,
        read,
        tuple(deliveries),
        tuple(heights),
        tuple(
            AlarmDelivery(signals.index((item.signal, Dimension.NUMBER)), item.device, item.alarm)
            for item in alarms
        ),
        device,
        sum({1 << height.strut for height in heights}),
        1 << heights[0].strut if heights else 0,
        compile_follower(cycle_ns) if channels and (cycle_ns := clock_cycle_ns(message)) else None,
        any(_bears_estimate(channel) for channel in channels),
    )


def clock_cycle_ns(message: Message) -> int:
    """Cycle time of a message whose counter states when its values were sampled, else 0."""
    return 0 if message.protection is None else message.cycle_time_ns or 0


def _bears_estimate(channel: Channel) -> bool:
    return channel.role is not Role.BENCH or channel.quantity is APPLIED_FORCE


_Check = Callable[[Values], bool]
"""Signals of a frame in SI -> whether each of them holds a value."""


def _check_of_values(message: Message, signals: Sequence[tuple[str, Dimension]]) -> _Check | None:
    """Check for errors, "not available" and NaN; None where a signal always holds a value."""
    if message.is_j1939:
        ranges = [_range_of_values(message, name, dimension) for name, dimension in signals]

        def within(values: Values) -> bool:
            return all(
                low <= value <= high for value, (low, high) in zip(values, ranges, strict=True)
            )

        return within
    if any(message.signal(name).is_float for name, _ in signals):
        return lambda values: all(map(isfinite, values))
    return None


def _range_of_values(message: Message, name: str, dimension: Dimension) -> tuple[float, float]:
    """Range of a signal in SI; a bound may differ from the value there in its last bits."""
    low, high = si_range(message, name, dimension)
    margin = 0.25 * si_step(message, name, dimension)
    return low - margin, high + margin


def _check_of_validity(
    valid: Sequence[ValidSignal], signals: Sequence[tuple[str, Dimension]]
) -> _Check | None:
    """Check that the sensors say that they measure; None where none says so."""
    expected = [(signals.index((item.signal, Dimension.NUMBER)), item.value) for item in valid]
    if not expected:
        return None
    return lambda values: all(values[index] == value for index, value in expected)


def _with_check(read: Reader, are_values: _Check) -> Reader:
    """A reader that refuses frames without values; most messages cannot hold such."""

    def read_values(sequence: SequenceState, frame: Frame) -> Reading:
        sequence, status, values = read(sequence, frame)
        if values is None or are_values(values):
            return sequence, status, values
        return sequence, status, NO_VALUES

    return read_values


def _compile_reader(message: Message, decode: Decoder) -> Reader:
    length, ok = message.length_bytes, FrameStatus.OK

    def read_plain(sequence: SequenceState, frame: Frame) -> Reading:
        values = decode(frame.data)
        # A multiplexed frame without these signals is no fault, a short one is.
        is_short = values is None and len(frame.data) != length
        return sequence, FrameStatus.WRONG_LENGTH if is_short else ok, values

    if message.protection is None:
        return read_plain
    check = compile_checker(message.protection)

    def read(sequence: SequenceState, frame: Frame) -> Reading:
        data = frame.data
        sequence, status = check(sequence, data, frame.t_ns)
        return sequence, status, decode(data) if status is ok or status.is_accepted else None

    return read
