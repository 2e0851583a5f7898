"""Messages as the bridge needs them: compiled from the DBC, and tied to what their values mean."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from msgspec import Struct

from can_dbc.codec import Decoder, Encoder, compile_decoder, compile_encoder
from can_dbc.database import Message
from can_dbc.frame import Frame
from can_dbc.protection import SequenceState, Verdict, compile_checker, compile_protector
from can_dbc.units import Dimension
from rig.core.contract import Mode, StepOutput
from rig.core.quantities import HEIGHT, PLACES, Quantity


class Wanted(NamedTuple):
    """What one signal of an incoming message is for.

    Attributes:
        signal: Name of the signal.
        quantity: What it means.
        strut: Index of the strut of a height, else 0.
    """

    signal: str
    quantity: Quantity
    strut: int = 0


class HeightTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: the height of a strut.

    Attributes:
        value: Its place among the frame's values.
        strut: Index of the strut.
    """

    value: int
    strut: int


class OtherTarget(Struct, frozen=True, gc=False):
    """Where a value of a frame goes: another quantity.

    Attributes:
        value: Its place among the frame's values.
        place: Place of the quantity among `OTHERS`.
    """

    value: int
    place: int


Reader = Callable[[SequenceState, Frame], tuple[SequenceState, Verdict, tuple[float, ...] | None]]
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
    """

    message: Message
    read: Reader
    heights: tuple[HeightTarget, ...]
    others: tuple[OtherTarget, ...]


class Counts(NamedTuple):
    """What has been counted since the start.

    Attributes:
        lost: Frames missing in the counters' sequences.
        refused: Frames not accepted.
        stale: Ticks without a fresh measurement.
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
    """All that an outgoing message can speak of.

    Attributes:
        output: What the core said.
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
class Outgoing:
    """A message of the bridge.

    Attributes:
        message: Its definition.
        frame: What is to be told, and the time in ns -> the frame, and whether one of its values
            saturated.
        period_ns: Time between two frames.
        is_status: Whether it tells of what has happened since the last one of its kind.
    """

    message: Message
    frame: Callable[[Report, int], tuple[Frame, bool]]
    period_ns: int
    is_status: bool = False


def incoming(message: Message, wanted: Sequence[Wanted]) -> Incoming:
    """An incoming message, compiled.

    Args:
        message: Message of the bench.
        wanted: What its signals are for.

    Raises:
        DatabaseError: A signal is missing, or its unit does not fit what it is for.
    """
    names = [item.signal for item in wanted]
    decode = compile_decoder(message, names, [item.quantity.dimension for item in wanted])
    heights = [
        HeightTarget(value, item.strut)
        for value, item in enumerate(wanted)
        if item.quantity is HEIGHT
    ]
    others = [
        OtherTarget(value, PLACES[item.quantity])
        for value, item in enumerate(wanted)
        if item.quantity is not HEIGHT
    ]
    return Incoming(message, _reader(message, decode), tuple(heights), tuple(others))


def _reader(message: Message, decode: Decoder) -> Reader:
    length, ok = message.length_bytes, Verdict.OK

    def read_unprotected(
        sequence: SequenceState, frame: Frame
    ) -> tuple[SequenceState, Verdict, tuple[float, ...] | None]:
        values = decode(frame.data)
        # A multiplexed frame without these signals is no fault, a short one is.
        is_short = values is None and len(frame.data) != length
        return sequence, Verdict.WRONG_LENGTH if is_short else ok, values

    if message.protection is None:
        return read_unprotected
    check = compile_checker(message.protection)

    def read(
        sequence: SequenceState, frame: Frame
    ) -> tuple[SequenceState, Verdict, tuple[float, ...] | None]:
        data = frame.data
        sequence, verdict = check(sequence, data, frame.t_ns)
        return sequence, verdict, decode(data) if verdict is ok or verdict.accepted else None

    return read


_ESTIMATE = {
    "SPRING_DAMPER_FORCE": Dimension.FORCE,
    "VIRTUAL_FORCE": Dimension.FORCE,
    "VALID": Dimension.NUMBER,
}
_KINEMATICS = {
    "MODEL_HEIGHT": Dimension.LENGTH,
    "MODEL_VELOCITY": Dimension.VELOCITY,
    "MODEL_ACCELERATION": Dimension.ACCELERATION,
    "INNOVATION": Dimension.LENGTH,
}
_STATUS = {
    "STATE": Dimension.NUMBER,
    "ENCODING_SATURATED": Dimension.NUMBER,
    "OVERRUNS": Dimension.NUMBER,
    "LOST_FRAMES": Dimension.NUMBER,
    "REFUSED_FRAMES": Dimension.NUMBER,
    "STALE_FRAMES": Dimension.NUMBER,
    "MEASUREMENT_FAULT": Dimension.NUMBER,
    "LIMIT_FAULT": Dimension.NUMBER,
    "BUS_FAULT": Dimension.NUMBER,
    "LOG_FAULT": Dimension.NUMBER,
}

_LEVELS = ("P50", "P99", "P99_9", "MAX")
_TIMING_PAGES = (
    {f"LATENESS_{level}": Dimension.TIME for level in _LEVELS},
    {f"WORK_{level}": Dimension.TIME for level in _LEVELS},
    {"LONGEST_GAP": Dimension.TIME, "OVERRUNS": Dimension.NUMBER},
)
"""Signals of the pages of a multiplexed message, in the order in which they are sent."""


def estimate(message: Message, strut: int) -> Outgoing:
    """The message with a strut's estimated force.

    Raises:
        DatabaseError: One of its signals is missing or has the wrong unit.
    """

    def values(report: Report) -> Sequence[float]:
        output = report.output.struts[strut]
        return output.force_n, output.virtual_force_n, output.valid

    return _coded(message, _ESTIMATE, values)


def kinematics(message: Message, strut: int) -> Outgoing:
    """The message with the motion of the corrected model at a strut.

    Raises:
        DatabaseError: One of its signals is missing or has the wrong unit.
    """

    def values(report: Report) -> Sequence[float]:
        output = report.output.struts[strut]
        return (
            output.height_m,
            output.velocity_m_per_s,
            output.acceleration_m_per_s2,
            output.innovation_m,
        )

    return _coded(message, _KINEMATICS, values)


def status(message: Message) -> Outgoing:
    """The message with the bridge's state. Its counts stop at the ends of their ranges.

    Raises:
        DatabaseError: One of its signals is missing.
    """
    most = {name: message.signal(name).maximum for name in _STATUS}
    limits = [float("inf") if value is None else value for value in most.values()]

    def values(report: Report) -> Sequence[float]:
        counts, reported = report.counts, report.reported
        second_sender = counts.second_sender > reported.second_sender
        raw = (
            float(report.output.mode),
            float(counts.saturated > reported.saturated),
            float(counts.overruns),
            float(counts.lost),
            float(counts.refused),
            float(counts.stale),
            float(report.output.mode is not Mode.RUNNING),
            float(counts.limited > reported.limited),
            float(counts.bus_faulty > reported.bus_faulty or second_sender),
            float(report.conditions.log_fault),
        )
        return [min(value, limit) for value, limit in zip(raw, limits, strict=True)]

    return _coded(message, _STATUS, values, is_status=True)


def timing(message: Message) -> Outgoing:
    """The message with how well the rate was kept, page by page.

    A figure beyond its range is sent as the end of it.

    Raises:
        DatabaseError: One of its signals is missing or has the wrong unit.
    """
    encoders = [compile_encoder(message, list(page), list(page.values())) for page in _TIMING_PAGES]

    def values(report: Report) -> Sequence[float]:
        page, kept = report.number % len(encoders), report.conditions.timing
        pages = (kept.lateness_s, kept.work_s, (kept.longest_gap_s, float(report.counts.overruns)))
        return (page, *pages[page])

    def encode(paged: Sequence[float]) -> tuple[bytes, bool]:
        # The end of a range says "that much or more" and is no saturation to be told of.
        return encoders[int(paged[0])](paged[1:])[0], False

    return _outgoing(message, encode, values)


def _coded(
    message: Message,
    signals: dict[str, Dimension],
    values: Callable[[Report], Sequence[float]],
    *,
    is_status: bool = False,
) -> Outgoing:
    encode = compile_encoder(message, list(signals), list(signals.values()))
    return _outgoing(message, encode, values, is_status=is_status)


def _outgoing(
    message: Message,
    encode: Encoder,
    values: Callable[[Report], Sequence[float]],
    *,
    is_status: bool = False,
) -> Outgoing:
    protect = None if message.protection is None else compile_protector(message.protection)
    arbitration_id, is_extended, is_fd = message.arbitration_id, message.is_extended, message.is_fd

    def frame(report: Report, t_ns: int) -> tuple[Frame, bool]:
        payload, saturated = encode(values(report))
        if protect is not None:
            payload = protect(payload, report.number)
        return Frame(t_ns, arbitration_id, payload, is_extended, is_fd), saturated

    return Outgoing(message, frame, message.cycle_time_ns or 0, is_status)
