"""Messages as the bridge needs them: compiled from the DBC, and tied to what their values mean."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf, isfinite, isnan
from operator import attrgetter
from typing import NamedTuple

from msgspec import Struct

from can_dbc.codec import Decoder, compile_decoder, compile_encoder, si_range
from can_dbc.database import Message
from can_dbc.frame import Frame
from can_dbc.protection import FrameStatus, SequenceState, compile_checker, compile_protector
from can_dbc.units import Dimension
from rig.bridge.contract import Mode, StepOutput
from rig.plan.quantities import HEIGHT, PLACES, Quantity


class Wanted(NamedTuple):
    """What one signal of an incoming message is for.

    Attributes:
        signal: Name of the signal.
        quantity: What it means.
        strut: Index of the strut of a height, else 0.
        delay_ns: How much later a height or a reading comes than it is true.
        sensor: Place of the further sensor that it is a reading of; None for all else.
        alarm: Device that it is an alarm of, and which of its alarms; None for all else.
    """

    signal: str
    quantity: Quantity
    strut: int = 0
    delay_ns: int = 0
    sensor: int | None = None
    alarm: tuple[int, int] | None = None


class HeightTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: the height of a strut.

    Attributes:
        value: Its place among the frame's values.
        strut: Index of the strut.
        delay_ns: How much later the value comes than it is true.
    """

    value: int
    strut: int
    delay_ns: int = 0


class OtherTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: another quantity.

    Attributes:
        value: Its place among the frame's values.
        place: Place of the quantity among `OTHERS`.
    """

    value: int
    place: int


class SensorTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: a reading of a further sensor.

    Attributes:
        value: Its place among the frame's values.
        sensor: Place of the sensor.
        delay_ns: How much later the value comes than it is true.
    """

    value: int
    sensor: int
    delay_ns: int = 0


class AlarmTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: an alarm of a device.

    Attributes:
        value: Its place among the frame's values.
        device: Place of the device.
        alarm: Which of the device's alarms.
    """

    value: int
    device: int
    alarm: int


Reader = Callable[
    [SequenceState, Frame], tuple[SequenceState, FrameStatus, tuple[float, ...] | None]
]
"""What is remembered of a message's counter, and a frame of it -> the same after the frame, what
the frame is, and its values in SI; None where there are none to be used."""


@dataclass(frozen=True, slots=True)
class Incoming:
    """A message of the bench.

    Attributes:
        message: Its definition.
        read: What reads its frames.
        heights: Where heights among its values go.
        others: Where other values go.
        sensors: Where readings of further sensors go.
        alarms: Where alarms of devices go.
        device: Place of the device that sends it; None if nothing is known of one.
    """

    message: Message
    read: Reader
    heights: tuple[HeightTarget, ...]
    others: tuple[OtherTarget, ...]
    sensors: tuple[SensorTarget, ...] = ()
    alarms: tuple[AlarmTarget, ...] = ()
    device: int | None = None


class Counts(NamedTuple):
    """What has been counted since the start.

    Attributes:
        lost: Frames missing in the counters' sequences.
        refused: Frames not accepted.
        stale: Ticks in HOLD.
        overruns: Ticks that were missed.
        saturated: Frames sent with a value at the limit of its range.
        wrong_crc: Frames refused for their CRC.
        wrong_length: Frames refused for their length.
        repeated: Frames refused because their counter had come already.
        out_of_sequence: Frames refused because their counter went backwards or jumped.
        masquerade: Frames refused because they carry another message's CRC.
        implausible: Frames refused for a height that cannot be.
        started: Sequences of a counter that began, the first one of each message among them.
        second_sender: Frames of somebody else under an id of the bridge, and frames that
            persistently contradict the counter of the bench's.
        limited: Ticks beyond a limit.
        bus_faulty: Ticks with a fault of the bus.
        left_out: Ticks at which a further sensor was left out, one for each sensor.
        device_faulty: Ticks at which a device had something wrong with it, one for each device.
        from_faulty_device: Frames refused because something was wrong with their device.
        no_value: Frames refused because what should be a value is none: an error or "not available"
            of J1939, or a float that is not finite.
    """

    lost: int = 0
    refused: int = 0
    stale: int = 0
    overruns: int = 0
    saturated: int = 0
    wrong_crc: int = 0
    wrong_length: int = 0
    repeated: int = 0
    out_of_sequence: int = 0
    masquerade: int = 0
    implausible: int = 0
    started: int = 0
    second_sender: int = 0
    limited: int = 0
    bus_faulty: int = 0
    left_out: int = 0
    device_faulty: int = 0
    from_faulty_device: int = 0
    no_value: int = 0


Levels = tuple[float, float, float, float]
"""Median, 99th and 99.9th percentile, largest."""


class TimingFigures(NamedTuple):
    """How well the rate was kept so far.

    Attributes:
        lateness_s: Lateness of a tick.
        work_s: Time that its work took.
        longest_gap_s: Longest time between two ticks.
    """

    lateness_s: Levels = (0.0, 0.0, 0.0, 0.0)
    work_s: Levels = (0.0, 0.0, 0.0, 0.0)
    longest_gap_s: float = 0.0


NO_TIMING = TimingFigures()


class Conditions(NamedTuple):
    """What the loop knows and a tick is reported.

    Attributes:
        overruns: Ticks missed since the last one.
        acknowledged: Somebody acknowledged the safe state.
        bus_fault: The bus could not be read or written.
        log_fault: The log could not be written.
        timing: How well the rate was kept, for the bus; nothing else depends on it.
    """

    overruns: int = 0
    acknowledged: bool = False
    bus_fault: bool = False
    log_fault: bool = False
    timing: TimingFigures = NO_TIMING


class Report(Struct, frozen=True, gc=False):
    """All that an outgoing message can publish.

    Attributes:
        output: What the core published.
        counts: What has been counted.
        reported: What the last status that was sent knew of them.
        conditions: What the loop knows.
        number: How many frames of the message came before.
    """

    output: StepOutput
    counts: Counts
    reported: Counts
    conditions: Conditions
    number: int


@dataclass(frozen=True)
class Publication:
    """Something that the bridge can put on the bus.

    Attributes:
        key: Its key under `publish`, `status` or `timing` of a configuration.
        dimension: What a signal of it measures; it is converted to the signal's unit.
        value: What the tick reports, and the index of a strut -> the value in SI.
        signal: Name of its signal where a message is given and no signal.
        stops_at_range: A value beyond the signal's range is sent as the end of it, and no fault.
    """

    key: str
    dimension: Dimension
    value: Callable[[Report, int], float]
    signal: str
    stops_at_range: bool = False


def _of_strut(attribute: str) -> Callable[[Report, int], float]:
    get = attrgetter(attribute)
    return lambda report, strut: get(report.output.struts[strut])


ESTIMATE = (
    Publication("force", Dimension.FORCE, _of_strut("force_n"), "SPRING_DAMPER_FORCE"),
    Publication("virtual_force", Dimension.FORCE, _of_strut("virtual_force_n"), "VIRTUAL_FORCE"),
    Publication("valid", Dimension.NUMBER, _of_strut("valid"), "VALID"),
)
KINEMATICS = (
    Publication("height", Dimension.LENGTH, _of_strut("height_m"), "MODEL_HEIGHT"),
    Publication("velocity", Dimension.VELOCITY, _of_strut("velocity_m_per_s"), "MODEL_VELOCITY"),
    Publication(
        "acceleration",
        Dimension.ACCELERATION,
        _of_strut("acceleration_m_per_s2"),
        "MODEL_ACCELERATION",
    ),
    Publication("innovation", Dimension.LENGTH, _of_strut("innovation_m"), "INNOVATION"),
)


def _known(std_n: float) -> float:
    return inf if isnan(std_n) else std_n


UNCERTAINTY = (
    Publication(
        "force_std",
        Dimension.FORCE,
        lambda report, strut: _known(report.output.struts[strut].force_std_n),
        "FORCE_STD",
        stops_at_range=True,
    ),
)
STRUT = (*ESTIMATE, *KINEMATICS, *UNCERTAINTY)
"""What is published of a strut."""


def _status(key: str, value: Callable[[Report], float]) -> Publication:
    return Publication(
        key, Dimension.NUMBER, lambda report, _: value(report), key.upper(), stops_at_range=True
    )


def _is_bus_faulty(report: Report) -> bool:
    """Since the last status: a fault of the bus, or somebody else under the same ids."""
    counts, reported = report.counts, report.reported
    return counts.bus_faulty > reported.bus_faulty or counts.second_sender > reported.second_sender


def _is_measurement_faulty(report: Report) -> bool:
    """No estimate that rests on fresh heights or a sensor left out, now, or a device at fault."""
    output, counts, reported = report.output, report.counts, report.reported
    is_out = output.mode is not Mode.RUNNING or bool(output.left_out)
    return is_out or counts.device_faulty > reported.device_faulty


STATUS = (
    _status("state", lambda report: report.output.mode),
    _status("encoding_saturated", lambda r: r.counts.saturated > r.reported.saturated),
    _status("overruns", lambda report: report.counts.overruns),
    _status("lost_frames", lambda report: report.counts.lost),
    _status("refused_frames", lambda report: report.counts.refused),
    _status("stale_frames", lambda report: report.counts.stale),
    _status("measurement_fault", _is_measurement_faulty),
    _status("limit_fault", lambda report: report.counts.limited > report.reported.limited),
    _status("bus_fault", _is_bus_faulty),
    _status("log_fault", lambda report: report.conditions.log_fault),
)
"""What is published of the bridge. Faults of encoding, limits, devices and bus are those since the
last status, the others are of now."""


def _timing(key: str, value: Callable[[TimingFigures], float]) -> Publication:
    return Publication(
        key,
        Dimension.TIME,
        lambda report, _: value(report.conditions.timing),
        key.upper(),
        stops_at_range=True,
    )


TIMING = (
    _timing("lateness_p50", lambda kept: kept.lateness_s[0]),
    _timing("lateness_p99", lambda kept: kept.lateness_s[1]),
    _timing("lateness_p99_9", lambda kept: kept.lateness_s[2]),
    _timing("lateness_max", lambda kept: kept.lateness_s[3]),
    _timing("work_p50", lambda kept: kept.work_s[0]),
    _timing("work_p99", lambda kept: kept.work_s[1]),
    _timing("work_p99_9", lambda kept: kept.work_s[2]),
    _timing("work_max", lambda kept: kept.work_s[3]),
    _timing("longest_gap", lambda kept: kept.longest_gap_s),
    _status("overruns", lambda report: report.counts.overruns),
)
"""How well the rate is kept."""


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


class Published(NamedTuple):
    """What one signal of an outgoing message carries.

    Attributes:
        signal: Name of the signal.
        publication: What it carries.
        strut: Index of the strut it is of, else 0.
    """

    signal: str
    publication: "Publication"
    strut: int = 0


def incoming(message: Message, wanted: Sequence[Wanted], device: int | None = None) -> Incoming:
    """An incoming message, compiled.

    Args:
        message: Message of the bench.
        wanted: What its signals are for.
        device: Place of the device that sends it.

    Raises:
        DatabaseError: A signal is missing, or its unit does not fit what it is for.
    """
    # A load cell may be recorded and also be a further sensor: one value, two places.
    signals = list(dict.fromkeys((item.signal, item.quantity.dimension) for item in wanted))
    decode = compile_decoder(message, [name for name, _ in signals], [unit for _, unit in signals])
    placed = [(signals.index((item.signal, item.quantity.dimension)), item) for item in wanted]
    sensors = [
        SensorTarget(value, item.sensor, item.delay_ns)
        for value, item in placed
        if item.sensor is not None
    ]
    heights = [
        HeightTarget(value, item.strut, item.delay_ns)
        for value, item in placed
        if item.quantity is HEIGHT
    ]
    others = [
        OtherTarget(value, PLACES[item.quantity])
        for value, item in placed
        if item.quantity in PLACES
    ]
    alarms = tuple(AlarmTarget(value, *item.alarm) for value, item in placed if item.alarm)
    read = _reader(message, decode)
    are_values = _check_of_values(message, signals)
    if are_values is not None:
        read = _of_values(read, are_values)
    return Incoming(message, read, tuple(heights), tuple(others), tuple(sensors), alarms, device)


_Check = Callable[[tuple[float, ...]], bool]
"""Values in SI -> whether each of them is one."""


def _check_of_values(message: Message, signals: Sequence[tuple[str, Dimension]]) -> _Check | None:
    """What tells values from errors, "not available" and NaN; None where all is a value."""
    if message.is_j1939:
        ranges = [si_range(message, name, dimension) for name, dimension in signals]

        def within(values: tuple[float, ...]) -> bool:
            # A bound may differ from the value there in its last bits.
            return all(
                low - 1e-9 * abs(low) <= value <= high + 1e-9 * abs(high)
                for value, (low, high) in zip(values, ranges, strict=True)
            )

        return within
    if any(message.signal(name).is_float for name, _ in signals):
        return lambda values: all(map(isfinite, values))
    return None


def _of_values(read: Reader, are_values: _Check) -> Reader:
    """A reader that refuses what is no value; most messages cannot hold such."""

    def checked(
        sequence: SequenceState, frame: Frame
    ) -> tuple[SequenceState, FrameStatus, tuple[float, ...] | None]:
        sequence, verdict, values = read(sequence, frame)
        if values is None or are_values(values):
            return sequence, verdict, values
        return sequence, FrameStatus.NO_VALUE, None

    return checked


def _reader(message: Message, decode: Decoder) -> Reader:
    length, ok = message.length_bytes, FrameStatus.OK

    def read_unprotected(
        sequence: SequenceState, frame: Frame
    ) -> tuple[SequenceState, FrameStatus, tuple[float, ...] | None]:
        values = decode(frame.data)
        # A multiplexed frame without these signals is no fault, a short one is.
        is_short = values is None and len(frame.data) != length
        return sequence, FrameStatus.WRONG_LENGTH if is_short else ok, values

    if message.protection is None:
        return read_unprotected
    check = compile_checker(message.protection)

    def read(
        sequence: SequenceState, frame: Frame
    ) -> tuple[SequenceState, FrameStatus, tuple[float, ...] | None]:
        data = frame.data
        sequence, verdict = check(sequence, data, frame.t_ns)
        return sequence, verdict, decode(data) if verdict is ok or verdict.is_accepted else None

    return read


def outgoing(message: Message, published: Sequence[Published]) -> Outgoing:
    """An outgoing message, compiled. Signals that nothing is published under are zero.

    Multiplexed signals are sent page by page, one page a frame.

    Args:
        message: Message of the bridge.
        published: What its signals carry.

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


def _pages(message: Message, published: Sequence[Published]) -> list[list[Published]]:
    """What stands in one frame together, in the order of the multiplexer's values."""
    always: list[Published] = []
    by_values: dict[tuple[int, ...], list[Published]] = {}
    for item in published:
        signal = message.signal(item.signal)
        if signal.multiplexer is None:
            always.append(item)
        else:
            by_values.setdefault(tuple(sorted(signal.multiplexer_ids)), []).append(item)
    return [always + by_values[key] for key in sorted(by_values)] or [always]


def _page(message: Message, published: Sequence[Published]) -> _Payload:
    names = [item.signal for item in published]
    dimensions = [item.publication.dimension for item in published]
    encode = compile_encoder(message, names, dimensions)
    values = [(_value(message, item), item.strut) for item in published]

    def payload(report: Report) -> tuple[bytes, bool]:
        return encode([value(report, strut) for value, strut in values])

    return payload


def _value(message: Message, item: Published) -> Callable[[Report, int], float]:
    """A published value; a count stops at the end of its range, which is no saturation."""
    value = item.publication.value
    if not item.publication.stops_at_range:
        return value
    _, high = si_range(message, item.signal, item.publication.dimension)
    return lambda report, strut: min(value(report, strut), high)
