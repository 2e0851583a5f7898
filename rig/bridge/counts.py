"""What is counted of frames and ticks, and what an outgoing message can report.

A frame is counted by the check that refuses it (`rig.bridge.frame_checks`), under the value of its
`FrameStatus`; a tick at its end.
"""

from typing import NamedTuple

from msgspec import Struct

from rig.bridge.values import Mode, Request, StepOutput


class Counts(NamedTuple):
    """Counts since the start.

    Attributes:
        lost: Frames missing in the counters' sequences.
        refused: Frames not accepted.
        stale: Ticks in HOLD.
        overruns: Ticks that were missed.
        saturated: Frames sent with a value at the limit of its range.
        wrong_crc: Frames refused for their CRC (`FrameStatus.WRONG_CRC` in `can_dbc.protection`).
        wrong_length: Frames refused for their length.
        repeated: Frames refused because their counter had arrived already.
        out_of_sequence: Frames refused because their counter went backwards or jumped.
        masquerade: Frames refused because they carry another message's CRC.
        implausible: Frames refused for a height beyond a limit.
        started: Sequences of a counter that began, the first one of each message among them.
        second_sender: Frames of another sender under an id of the bridge or in a J1939 group of the
            bench, and frames that persistently contradict the counter of the bench's.
        limited: Ticks beyond a limit.
        bus_faulty: Ticks with a fault of the bus.
        left_out: Ticks at which a further sensor was left out, one for each sensor.
        device_faulty: Ticks at which a device was at fault, one for each device.
        from_faulty_device: Frames refused because their device was at fault.
        no_value: Frames refused because a signal holds no value: the sensor itself says so
            (`valid`), an error or "not available" of J1939, or a float that is not finite.
        untimed: Frames refused because it is not known when their values were sampled, or because
            that was too long ago.
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
    untimed: int = 0

    @property
    def refusals(self) -> dict[str, int]:
        """Cause -> number of refused frames; a cause that did not occur is left out."""
        return {name: count for name in _CAUSES_OF_REFUSAL if (count := getattr(self, name))}

    def plus(self, **increments: int) -> "Counts":
        """Counts with increments, by their names."""
        more = {name: getattr(self, name) + number for name, number in increments.items()}
        return self._replace(**more)

    def plus_refusal(self, cause: str) -> "Counts":
        """Counts with a refused frame; its cause is the name of a count, such as `wrong_crc`."""
        return self.plus(**{"refused": 1, cause: 1})


_CAUSES_OF_REFUSAL = (
    "wrong_crc",
    "wrong_length",
    "repeated",
    "out_of_sequence",
    "masquerade",
    "implausible",
    "second_sender",
    "from_faulty_device",
    "no_value",
    "untimed",
)

Levels = tuple[float, float, float, float]
"""Median, 99th and 99.9th percentile, largest."""


class TimingFigures(NamedTuple):
    """Timing figures of the run so far.

    Attributes:
        lateness_s: Lateness of a tick.
        work_s: Duration of its work.
        longest_gap_s: Longest time between two ticks.
    """

    lateness_s: Levels = (0.0, 0.0, 0.0, 0.0)
    work_s: Levels = (0.0, 0.0, 0.0, 0.0)
    longest_gap_s: float = 0.0


NO_TIMING = TimingFigures()


class Conditions(NamedTuple):
    """Conditions of a tick, as the loop knows them.

    Attributes:
        overruns: Ticks missed since the last one.
        request: What an operator requests; None for nothing.
        bus_fault: The bus could not be read or written.
        log_fault: The log could not be written.
        timing: Timing figures, for the bus; nothing else depends on them.
    """

    overruns: int = 0
    request: Request | None = None
    bus_fault: bool = False
    log_fault: bool = False
    timing: TimingFigures = NO_TIMING


# Looking up a member of an enum costs as much as the CRC of a frame.
_HOLD = Mode.HOLD


def count_tick(
    counts: Counts, output: StepOutput, action: int, conditions: Conditions, faulty_devices: int
) -> Counts:
    """Counts after a tick; most ticks are as they should be."""
    is_held = output.mode is _HOLD
    is_unusual = conditions.overruns or conditions.bus_fault or output.left_out or faulty_devices
    if not (action or is_held or is_unusual):
        return counts
    return counts.plus(
        overruns=conditions.overruns,
        stale=is_held,
        limited=action > 0,
        bus_faulty=conditions.bus_fault,
        left_out=len(output.left_out),
        device_faulty=faulty_devices,
    )


class Report(Struct, frozen=True, gc=False):
    """All that an outgoing message can publish.

    Attributes:
        output: What the tick published.
        counts: Counts since the start.
        reported: Counts at the last status that was sent.
        conditions: Conditions of the tick.
        number: Frames of the message sent before.
    """

    output: StepOutput
    counts: Counts
    reported: Counts
    conditions: Conditions
    number: int
