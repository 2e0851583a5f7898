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
from rig.bridge.values import Mode


@dataclass(frozen=True)
class Publication:
    """A quantity that the bridge can put on the bus.

    Attributes:
        key: Its key under `publish`, `status` or `timing` of a configuration.
        dimension: What a signal of it measures; it is converted to the signal's unit.
        value: What the tick reports, and the index of a strut -> the value in SI.
        signal: Name of its signal where the configuration names a message alone.
        stops_at_range: A value beyond the signal's range is sent as the end of it, and no fault.
        attribute: Attribute of `StrutOutput` that is published as it is; empty for all else.
    """

    key: str
    dimension: Dimension
    value: Callable[[Report, int], float]
    signal: str
    stops_at_range: bool = False
    attribute: str = ""


def _of_strut(key: str, dimension: Dimension, attribute: str, signal: str) -> Publication:
    """An attribute of a strut's output."""
    get = attrgetter(attribute)
    return Publication(
        key,
        dimension,
        lambda report, strut: get(report.output.struts[strut]),
        signal,
        attribute=attribute,
    )


FORCE = _of_strut("force", Dimension.FORCE, "force_n", "SPRING_DAMPER_FORCE")
VALID = _of_strut("valid", Dimension.NUMBER, "valid", "VALID")
ESTIMATE = (
    FORCE,
    _of_strut("virtual_force", Dimension.FORCE, "virtual_force_n", "VIRTUAL_FORCE"),
    VALID,
)
KINEMATICS = (
    _of_strut("height", Dimension.LENGTH, "height_m", "MODEL_HEIGHT"),
    _of_strut("velocity", Dimension.VELOCITY, "velocity_m_per_s", "MODEL_VELOCITY"),
    _of_strut(
        "acceleration", Dimension.ACCELERATION, "acceleration_m_per_s2", "MODEL_ACCELERATION"
    ),
    _of_strut("innovation", Dimension.LENGTH, "innovation_m", "INNOVATION"),
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
    """Whether there was a fault of the bus, or a second sender, since the last status."""
    counts, reported = report.counts, report.reported
    return counts.bus_faulty > reported.bus_faulty or counts.second_sender > reported.second_sender


def _is_measurement_faulty(report: Report) -> bool:
    """Whether the estimate is not fresh, a sensor is left out, or a device is at fault."""
    output, counts, reported = report.output, report.counts, report.reported
    is_out = output.mode not in (Mode.RUNNING, Mode.READY) or bool(output.left_out)
    return is_out or counts.device_faulty > reported.device_faulty


STATUS = (
    _status("state", lambda report: report.output.mode),
    _status("encoding_saturated", lambda r: r.counts.saturated > r.reported.saturated),
    _status("overruns", lambda report: report.counts.overruns),
    _status("lost_frames", lambda report: report.counts.lost),
    _status("refused_frames", lambda report: report.counts.refused),
    _status("stale_frames", lambda report: report.counts.stale),
    _status("first_cause", lambda report: report.output.first_cause),
    _status("measurement_fault", _is_measurement_faulty),
    _status("limit_fault", lambda report: report.counts.limited > report.reported.limited),
    _status("bus_fault", _is_bus_faulty),
    _status("log_fault", lambda report: report.conditions.log_fault),
)
"""What is published of the bridge. Faults of encoding, limits, devices and bus are those since the
last status, the others are of now."""

STATUS_MESSAGE = "RIG_STATUS"
"""Message that publishes it where a DBC has one of this name."""


def _timing(key: str, value: Callable[[TimingFigures], float]) -> Publication:
    return Publication(
        key,
        Dimension.TIME,
        lambda report, _: value(report.conditions.timing),
        key.upper(),
        stops_at_range=True,
    )


TIMING = (
    _timing("lateness_p50", lambda figures: figures.lateness_s[0]),
    _timing("lateness_p99", lambda figures: figures.lateness_s[1]),
    _timing("lateness_p99_9", lambda figures: figures.lateness_s[2]),
    _timing("lateness_max", lambda figures: figures.lateness_s[3]),
    _timing("work_p50", lambda figures: figures.work_s[0]),
    _timing("work_p99", lambda figures: figures.work_s[1]),
    _timing("work_p99_9", lambda figures: figures.work_s[2]),
    _timing("work_max", lambda figures: figures.work_s[3]),
    _timing("longest_gap", lambda figures: figures.longest_gap_s),
    _status("overruns", lambda report: report.counts.overruns),
)
"""What is published of the timing."""
