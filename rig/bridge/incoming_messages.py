"""Incoming messages, compiled from the DBC and the channels that they carry.

The order of the checks that their frames pass is that of `rig.bridge.frame_checks`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import NamedTuple

from can_dbc.codec import Decoder, compile_decoder, si_range, si_round, si_step
from can_dbc.database import Message, alive_counter
from can_dbc.frame import Frame
from can_dbc.protection import (
    AliveCounter,
    FrameStatus,
    SequenceState,
    compile_checker,
    compile_counter_checker,
)
from can_dbc.units import Dimension
from rig.bridge.sample_times import Follower, compile_follower, compile_follower_of_times
from rig.channels.channel import Channel, Role, ValidSignal

Values = tuple[float, ...]
"""Values of a frame in SI, in the order of the message's signals that are read."""

Reading = tuple[SequenceState, FrameStatus, Values | None]
"""State of the message's counter after a frame, the frame's status, and its values: none in a
refused frame or another page, `NO_VALUES` where a signal holds no value."""

NO_VALUES: Values = ()

_LARGEST_TIME_S = 1e10
"""Of a sender's clock; Unix time is below it for three hundred years."""

SHORTEST_ROUND = 8
"""Cycles that a sender's time has to take at least until it begins again: of fewer it is not known
which one a frame is of, and one that is sent again and again looks new."""

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


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message of the bench.

    Attributes:
        message: Its definition.
        read: Reads its frames.
        deliveries: Values that go to channels.
        alarms: Values that are alarms.
        device: Index of the device that sends it; None if none is configured.
        struts: Struts whose reference heights it carries, a bit each.
        first_strut: The bit of the first of them; 0 if there is none.
        follow: Follows the clock of its sender; None if neither counter nor time signal states it.
        stamp: Index of the value that is the sender's time; -1 if its counter states it.
        is_awaited: Whether an estimate rests on its values, so that late ones are used in the past.
    """

    message: Message
    read: Reader
    deliveries: tuple[Delivery, ...]
    alarms: tuple[AlarmDelivery, ...] = ()
    device: int | None = None
    struts: int = 0
    first_strut: int = 0
    follow: Follower | None = None
    stamp: int = -1
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
    # One for all channels of a message; frames of alarms alone are not followed.
    counter, time = (channels[0].counter, channels[0].time) if channels else ("", "")
    # A load cell may be recorded and also be a further sensor: one value, two channels.
    signals = list(
        dict.fromkeys(
            [
                *((channel.signal, channel.quantity.dimension) for channel in channels),
                *((alarm.signal, Dimension.NUMBER) for alarm in alarms),
                *((item.signal, Dimension.NUMBER) for item in valid),
                *([(counter, Dimension.NUMBER)] if counter else []),
                *([(time, Dimension.TIME)] if time else []),
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
    struts = [channel.strut for channel in channels if channel.role is Role.HEIGHT]
    read = _compile_reader(message, decode)
    if counter:
        index = signals.index((counter, Dimension.NUMBER))
        read = _with_counter(read, index, alive_counter(message, counter))
    stamp = signals.index((time, Dimension.TIME)) if time else -1
    for check in (
        _check_of_values(message, signals),
        _check_of_validity(message, valid, signals),
        _check_of_time(stamp),
    ):
        if check is not None:
            read = _with_check(read, check)
    return Incoming(
        message,
        read,
        tuple(deliveries),
        tuple(
            AlarmDelivery(signals.index((item.signal, Dimension.NUMBER)), item.device, item.alarm)
            for item in alarms
        ),
        device,
        sum({1 << strut for strut in struts}),
        1 << struts[0] if struts else 0,
        compile_follower_of(channels[0], message) if channels else None,
        stamp,
        any(_bears_estimate(channel) for channel in channels),
    )


class ClockSource(Enum):
    """What states when a message's values were sampled."""

    TIME_SIGNAL = "time signal"
    COUNTER = "counter and cycle time"
    ARRIVAL = "arrival"


def clock_source(channel: Channel, message: Message) -> ClockSource:
    """What states when the values of a channel's message were sampled."""
    if channel.time:
        return ClockSource.TIME_SIGNAL
    if message.cycle_time_ns and (channel.counter or message.protection is not None):
        return ClockSource.COUNTER
    return ClockSource.ARRIVAL


def compile_follower_of(channel: Channel, message: Message) -> Follower | None:
    """What follows the clock of a message's sender; None where arrivals are all there is."""
    source = clock_source(channel, message)
    if source is ClockSource.TIME_SIGNAL:
        round_s = si_round(message, channel.time, Dimension.TIME)
        return compile_follower_of_times(
            channel.interval_ns, round(round_s * 1e9) if isfinite(round_s) else 0
        )
    if source is ClockSource.COUNTER and message.cycle_time_ns:
        return compile_follower(message.cycle_time_ns)
    return None


def _bears_estimate(channel: Channel) -> bool:
    return channel.role is not Role.BENCH


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
    message: Message, valid: Sequence[ValidSignal], signals: Sequence[tuple[str, Dimension]]
) -> _Check | None:
    """Check that the sensors say that they measure; None where none says so."""
    expected: list[tuple[int, float, float]] = []
    for item in valid:
        # What a file writes as 0.3 may differ in its last bit from three steps of 0.1, and 0.1
        # differs from what a float of 32 bits holds.
        margin = 0.25 * si_step(message, item.signal, Dimension.NUMBER) or 1e-6 * abs(item.value)
        index = signals.index((item.signal, Dimension.NUMBER))
        expected.append((index, item.value - margin, item.value + margin))
    if not expected:
        return None
    return lambda values: all(low <= values[index] <= high for index, low, high in expected)


def _check_of_time(stamp: int) -> _Check | None:
    """Check that a sender's time, the value of an index, is one; None without a time signal."""
    return None if stamp < 0 else lambda values: abs(values[stamp]) < _LARGEST_TIME_S


def _with_check(read: Reader, are_values: _Check) -> Reader:
    """A reader that refuses frames without values; most messages cannot hold such."""

    def read_values(sequence: SequenceState, frame: Frame) -> Reading:
        sequence, status, values = read(sequence, frame)
        if values is None or are_values(values):
            return sequence, status, values
        return sequence, status, NO_VALUES

    return read_values


def _with_counter(read: Reader, index: int, alive: AliveCounter) -> Reader:
    """A reader that also checks a counter, one of the values."""
    check = compile_counter_checker(alive)

    def read_with_counter(sequence: SequenceState, frame: Frame) -> Reading:
        sequence, status, values = read(sequence, frame)
        if values is None:
            return sequence, status, None
        sequence, status = check(sequence, int(values[index]), frame.t_ns)
        return sequence, status, values if status.is_accepted else None

    return read_with_counter


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
