"""Every quantity that the bridge can publish, each declared here and nowhere else.

Unit, scale and range of a published signal are those of the DBC: a value in SI is converted to
them. What a bench sends stands in `rig.channels.measured_quantities`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isnan
from operator import attrgetter

from can_dbc.units import Dimension
from rig.bridge.counts import Report, TimingFigures
from rig.bridge.mode_supervisor import CAUSE_NUMBERS
from rig.bridge.values import Mode


@dataclass(frozen=True)
class Publication:
    """A quantity that the bridge can put on the bus.

    Attributes:
        key: Its key under `publish`, `status` or `timing` of a configuration.
        dimension: What a signal of it measures; it is converted to the signal's unit.
        value: What the tick reports, and the index of a strut -> the value in SI.
        signal: Name of its signal where the configuration names a message alone.
        meaning: What a receiver reads in it, for the guide.
        stops_at_range: A value beyond the signal's range is sent as the end of it, and no fault.
        wraps_at_range: A value beyond it begins again at its lower end.
        attribute: Attribute of `StrutOutput` that is published as it is; empty for all else.
    """

    key: str
    dimension: Dimension
    value: Callable[[Report, int], float]
    signal: str
    meaning: str
    stops_at_range: bool = False
    wraps_at_range: bool = False
    attribute: str = ""


def _of_strut(
    key: str, dimension: Dimension, attribute: str, signal: str, meaning: str
) -> Publication:
    """An attribute of a strut's output."""
    get = attrgetter(attribute)
    return Publication(
        key,
        dimension,
        lambda report, strut: get(report.output.struts[strut]),
        signal,
        meaning,
        attribute=attribute,
    )


FORCE = _of_strut(
    "force",
    Dimension.FORCE,
    "force_n",
    "SPRING_DAMPER_FORCE",
    "force of the strut, positive when it pushes its ends apart: the estimate while `valid` is 1 "
    "(on a dyno the load cell's force)",
)
VALID = _of_strut(
    "valid", Dimension.NUMBER, "valid", "VALID", "1 while the estimate is valid, else 0"
)
ESTIMATE = (
    FORCE,
    _of_strut(
        "virtual_force",
        Dimension.FORCE,
        "virtual_force_n",
        "VIRTUAL_FORCE",
        "virtual force of the observer, positive when it pushes the ends apart; on a dyno the load "
        "cell's force less the model's",
    ),
    VALID,
)
KINEMATICS = (
    _of_strut("height", Dimension.LENGTH, "height_m", "MODEL_HEIGHT", "height of the model"),
    _of_strut(
        "velocity",
        Dimension.VELOCITY,
        "velocity_m_per_s",
        "MODEL_VELOCITY",
        "time derivative of the model's height, positive in rebound",
    ),
    _of_strut(
        "acceleration",
        Dimension.ACCELERATION,
        "acceleration_m_per_s2",
        "MODEL_ACCELERATION",
        "second derivative of the model's height",
    ),
    _of_strut(
        "innovation",
        Dimension.LENGTH,
        "innovation_m",
        "INNOVATION",
        "measured height less the model's, at the time of the last measurement",
    ),
)


def _std_or_infinite(std_n: float) -> float:
    """An unknown standard deviation as the end of its signal's range."""
    return inf if isnan(std_n) else std_n


UNCERTAINTY = (
    Publication(
        "force_std",
        Dimension.FORCE,
        lambda report, strut: _std_or_infinite(report.output.struts[strut].force_std_n),
        "FORCE_STD",
        "standard deviation of the estimated force; the upper end of the signal's range if the "
        "deviation is larger, or if the observer does not compute it",
        stops_at_range=True,
    ),
)
COUNTER = Publication(
    "counter",
    Dimension.NUMBER,
    lambda report, _: report.number,
    "COUNTER",
    "number of frames of this message that were sent before; after the upper end of the signal's "
    "range it starts again at the lower one. Only for a message without E2E protection (E2E has a "
    "counter)",
    wraps_at_range=True,
)
STRUT = (*ESTIMATE, *KINEMATICS, *UNCERTAINTY, COUNTER)
"""What is published of a strut."""


def _status(key: str, meaning: str, value: Callable[[Report], float]) -> Publication:
    return Publication(
        key,
        Dimension.NUMBER,
        lambda report, _: value(report),
        key.upper(),
        meaning,
        stops_at_range=True,
    )


def _is_bus_faulty(report: Report) -> bool:
    """Whether there was a fault of the bus, or a second sender, since the last status."""
    counts, reported = report.counts, report.reported
    return counts.bus_faulty > reported.bus_faulty or counts.second_sender > reported.second_sender


def _is_measurement_faulty(report: Report) -> bool:
    """Whether the estimate is not fresh, a sensor is left out, or a device is at fault."""
    output, counts, reported = report.output, report.counts, report.reported
    is_out = output.mode not in (Mode.RUNNING, Mode.READY) or bool(output.left_out)
    return is_out or counts.device_faulty > reported.device_faulty


_CAUSES = ", ".join(f"{number} `{event.value}`" for event, number in CAUSE_NUMBERS.items())

_OVERRUNS = _status(
    "overruns", "ticks that were missed since the start", lambda report: report.counts.overruns
)

STATUS = (
    _status("state", "number of the mode", lambda report: report.output.mode),
    _status(
        "encoding_saturated",
        "1 if a value under `publish` was limited to its signal's range since the last status; "
        "`force_std` and `counter` do not count",
        lambda r: r.counts.saturated > r.reported.saturated,
    ),
    _OVERRUNS,
    _status(
        "lost_frames",
        "frames that were lost since the start, by the counters of their messages",
        lambda report: report.counts.lost,
    ),
    _status(
        "refused_frames",
        "frames that were refused since the start",
        lambda report: report.counts.refused,
    ),
    _status(
        "stale_frames",
        "ticks in HOLD since the start (not frames, in spite of the name)",
        lambda report: report.counts.stale,
    ),
    _status(
        "first_cause",
        f"cause of the first HOLD or SAFE since the estimate was last valid: {_CAUSES}; 0 if there "
        "was none since then",
        lambda report: report.output.first_cause,
    ),
    _status(
        "measurement_fault",
        "1 if the mode is neither RUNNING nor READY, a further sensor is excluded, or a device was "
        "at fault since the last status",
        _is_measurement_faulty,
    ),
    _status(
        "limit_fault",
        "1 if a value was beyond a limit since the last status",
        lambda report: report.counts.limited > report.reported.limited,
    ),
    _status(
        "bus_fault",
        "1 if the bus failed, the CAN controller was error-passive or bus-off, a second sender was "
        "detected, or a frame was refused as not authentic, since the last status",
        _is_bus_faulty,
    ),
    _status(
        "log_fault",
        "1 while the run's log cannot be written in full",
        lambda report: report.conditions.log_fault,
    ),
)
"""What is published of the bridge. Faults of encoding, limits, devices and bus are those since the
last status, the others are of now."""

STATUS_MESSAGE = "RIG_STATUS"
"""Message that publishes it where a DBC has one of this name."""


def _timing(key: str, meaning: str, value: Callable[[TimingFigures], float]) -> Publication:
    return Publication(
        key,
        Dimension.TIME,
        lambda report, _: value(report.conditions.timing),
        key.upper(),
        f"{meaning} since the start",
        stops_at_range=True,
    )


_LATENESS, _WORK = "lateness of a tick", "computing time of a tick"

TIMING = (
    _timing("lateness_p50", f"{_LATENESS}, median", lambda it: it.lateness_s[0]),
    _timing("lateness_p99", f"{_LATENESS}, 99th percentile", lambda it: it.lateness_s[1]),
    _timing("lateness_p99_9", f"{_LATENESS}, 99.9th percentile", lambda it: it.lateness_s[2]),
    _timing("lateness_max", f"{_LATENESS}, maximum", lambda it: it.lateness_s[3]),
    _timing("work_p50", f"{_WORK}, median", lambda it: it.work_s[0]),
    _timing("work_p99", f"{_WORK}, 99th percentile", lambda it: it.work_s[1]),
    _timing("work_p99_9", f"{_WORK}, 99.9th percentile", lambda it: it.work_s[2]),
    _timing("work_max", f"{_WORK}, maximum", lambda it: it.work_s[3]),
    _timing(
        "longest_gap", "longest time between two successive ticks", lambda it: it.longest_gap_s
    ),
    _OVERRUNS,
)
"""What is published of the timing: figures of the run so far."""
