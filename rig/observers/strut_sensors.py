"""What a sensor of a strut measures: on the model, and of the model's error.

A further kind of sensor is a quantity in `rig.channels.measured_quantities.STRUT_QUANTITIES` and an
entry here.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.channels.channel import Channel
from rig.channels.measured_quantities import FORCE, HEIGHT, VELOCITY, Quantity

Array = NDArray[np.float64]


class Instant(NamedTuple):
    """The model at a time.

    Attributes:
        struts: Height (m) and velocity (m/s) of each strut.
        forces_n: Force of each strut's law; empty where no sensor requires it.
        inputs: Input vector, as of `dart_model.protocol.LoadedModel`.
    """

    t_ns: int
    struts: Sequence[tuple[float, float]]
    forces_n: Sequence[float]
    inputs: Sequence[float] = ()


class StrutErrors(NamedTuple):
    """Errors of the model of one strut, bench less model, as rows of what a filter estimates.

    Attributes:
        height: Of the height (m), shape (N,).
        velocity: Of its rate (m/s).
        force: Of the strut's force (N): what the model's law lacks where the model is.
    """

    height: Array
    velocity: Array
    force: Array


@dataclass(frozen=True)
class StrutSensor:
    """How a kind of sensor sees the model.

    Attributes:
        reading: The model at a time and the index of a strut -> what the sensor reads there, SI.
        error: Errors of a strut -> that of the reading.
    """

    reading: Callable[[Instant, int], float]
    error: Callable[[StrutErrors], Array]


STRUT_SENSORS: Mapping[Quantity, StrutSensor] = MappingProxyType(
    {
        HEIGHT: StrutSensor(
            lambda instant, strut: instant.struts[strut][0], lambda errors: errors.height
        ),
        VELOCITY: StrutSensor(
            lambda instant, strut: instant.struts[strut][1], lambda errors: errors.velocity
        ),
        FORCE: StrutSensor(
            lambda instant, strut: instant.forces_n[strut], lambda errors: errors.force
        ),
    }
)


def model_reading(t_ns: int, channel: Channel, instants: Sequence[Instant]) -> float:
    """What a sensor of the model would have read at a time.

    A height is that of `model_height_m`, anything else linear between two ticks. `instants` has the
    newest tick first.
    """
    now, strut = instants[0], channel.strut
    if channel.quantity is HEIGHT:
        return model_height_m(t_ns, strut, instants)
    before = after = now
    for before in instants[1:]:
        if before.t_ns <= t_ns:
            break
        after = before
    read = STRUT_SENSORS[channel.quantity].reading
    earlier, later = read(before, strut), read(after, strut)
    if after.t_ns == before.t_ns:
        return later
    share = min(max((t_ns - before.t_ns) / (after.t_ns - before.t_ns), 0.0), 1.0)
    return earlier + share * (later - earlier)


def model_height_m(measured_ns: int, strut: int, instants: Sequence[Instant]) -> float:
    """Height of the model at the time of a measurement.

    Between two ticks it is the cubic through heights and velocities at both: with a force that is
    constant from tick to tick, the model's height is a parabola. (To first order, the virtual force
    of the tick before would seem to be an error of the model, and make fast loops unstable.) Before
    the oldest tick it is first order. `instants` has the newest tick first.
    """
    return _position_m(measured_ns, instants, lambda instant: instant.struts[strut])


def model_motion_m(measured_ns: int, column: int, instants: Sequence[Instant]) -> float:
    """Position of a body that is moved, at a column of the inputs: as `model_height_m`."""
    return _position_m(measured_ns, instants, lambda instant: instant.inputs[column : column + 2])


_Motion = Callable[[Instant], Sequence[float]]
"""Instant -> position (m) and velocity (m/s)."""


def _position_m(t_ns: int, instants: Sequence[Instant], motion: _Motion) -> float:
    after = instants[0]
    for before in instants[1:]:
        if before.t_ns <= t_ns:
            return _between(t_ns, before, after, motion)
        after = before
    position_m, velocity_m_per_s = motion(after)
    return position_m - velocity_m_per_s * (after.t_ns - t_ns) * 1e-9


def _between(t_ns: int, before: Instant, after: Instant, motion: _Motion) -> float:
    """The cubic through positions and velocities at two ticks (Hermite)."""
    (low_m, low_rate), (high_m, high_rate) = motion(before), motion(after)
    step_ns = after.t_ns - before.t_ns
    share = (t_ns - before.t_ns) / step_ns
    rest = 1.0 - share
    line_m = rest * rest * (1.0 + 2.0 * share) * low_m + share * share * (1.0 + 2.0 * rest) * high_m
    return line_m + share * rest * step_ns * 1e-9 * (rest * low_rate - share * high_rate)
