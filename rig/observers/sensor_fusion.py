"""Several sensors of one strut in one filter: another height, a velocity, a load cell.

Each reading is a line of the filter of the model's error: a height is the error x, a velocity its
rate, and a load cell the force that the model's law lacks, m (d/m - k x - c dx/dt), with a
standard deviation each. They are used one after another in the order of their times of
measurement: where a reading is older than what was used already, the filter goes back to before it
and takes the later ones once more.

The strut's own height is the reference: it is always used, and without it no sensor that is left
out is used again. A further sensor is gated. A reading beyond the gate is not used; some in a row
leave the sensor out until as many are within again. A drift within the gate is not detected, and a
reference that jumps is a case for the limits.

References:
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001),
    5.4 (the normalised innovation) and 11 (gates).
    Simon, Optimal State Estimation (2006), 6.1 (scalar measurements one after another).
"""

import bisect
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from rig.channels.channel import Channel
from rig.channels.measured_quantities import HEIGHT
from rig.observers.error_filter import (
    Array,
    ErrorFilter,
    ErrorState,
    correct,
    in_si,
    inputs_since,
    mean_at,
    predict_covariance,
    update_scale,
)
from rig.observers.protocol import REFERENCE_HEIGHT, Innovation, Start
from rig.observers.strut_sensors import STRUT_SENSORS

_GATE = 6.0
"""Of a reading, in its standard deviations: two in a thousand million are beyond it by chance."""

_BEYOND, _WITHIN = 5, 50
"""Readings in a row that leave a sensor out, and that let it in again: a single one may be a fault
of its frame, and one that comes and goes is not to be trusted."""

_SILENT = 5
"""Intervals without a reading after which a sensor counts as silent."""

_GRID = 16
"""Parts of the time between two heights to which the variances' times are rounded: at most a
thirtieth of what is unknown is added too early or too late, and never twice."""


class SensorHealth(NamedTuple):
    """Health of a further sensor: its last readings in a row beyond the gate, or within it."""

    t_ns: int
    beyond: int = 0
    within: int = 0
    is_out: bool = False

    def update(self, t_ns: int, *, is_within: bool, counts: bool) -> "SensorHealth":
        """Health after another reading; `counts`: it counts for a sensor that is out."""
        if self.is_out and not counts:
            return self._replace(t_ns=t_ns)
        beyond, within = (0, self.within + 1) if is_within else (self.beyond + 1, 0)
        is_out = within < _WITHIN if self.is_out else beyond >= _BEYOND
        return SensorHealth(t_ns, beyond, within, is_out)


class FusionMemory(Struct, frozen=True, gc=False):
    """Memory of several sensors.

    Attributes:
        used: Innovations used lately, the oldest first, with the state before each.
        inputs: Accelerations by the virtual force and their times, as far back as `used`.
        measured_ns: Time of the last reading of a height that was used.
        own_ns: Time of the last reading of the strut's own height.
        left_out: Channels of sensors that are left out, or silent.
    """

    used: tuple[tuple[ErrorState, Innovation], ...]
    inputs: tuple[tuple[int, float], ...]
    health: dict[int, SensorHealth]
    measured_ns: int
    own_ns: int
    left_out: tuple[int, ...] = ()


def initial_memory(start: Start) -> FusionMemory:
    """Memory before any reading of a further sensor."""
    health = {channel.index: SensorHealth(start.t_ns) for channel in start.sensors}
    return FusionMemory((), ((start.t_ns, 0.0),), health, start.t_ns, start.t_ns)


def restart_memory(memory: FusionMemory, start: Start) -> FusionMemory:
    """Memory at another start: a sensor that was left out has to prove itself as before."""
    health = {
        channel: SensorHealth(start.t_ns, is_out=item.is_out)
        for channel, item in memory.health.items()
    }
    left_out = tuple(channel for channel, item in health.items() if item.is_out)
    return replace(initial_memory(start), health=health, left_out=left_out)


def fuse_samples(
    follower: ErrorFilter,
    error: ErrorState,
    memory: FusionMemory,
    t_ns: int,
    innovation: Innovation | None,
    further: Sequence[Innovation],
) -> tuple[ErrorState, FusionMemory]:
    """Filter and memory after a tick; `error` has all inputs up to now.

    `innovation` is that of a new height of the strut, None where none arrived; `further` are those
    of new samples of the further sensors.
    """
    sensors = {channel.index: channel for channel in error.start.sensors}
    new = [*further]
    if innovation is not None:
        new.append(innovation)
    inputs = _join_inputs(memory.inputs, error.inputs)
    used, health, measured_ns = list(memory.used), dict(memory.health), memory.measured_ns
    own_ns = memory.own_ns
    for item in sorted(new, key=lambda entry: entry.t_ns):
        at = bisect.bisect_right(used, item.t_ns, key=lambda entry: entry[1].t_ns)
        before = used[at][0] if at < len(used) else error
        before = replace(before, inputs=inputs)
        if item.t_ns < before.t_ns:  # older than all of the memory
            continue
        sensor = None if item.channel == REFERENCE_HEIGHT else sensors[item.channel]
        after, is_within = _update(follower, before, item, sensor)
        if sensor is None:
            own_ns = max(own_ns, item.t_ns)
        else:
            # Without the reference the gate grows wide, and does not show that a sensor is right.
            has_reference = item.t_ns - own_ns <= _SILENT * error.start.interval_ns
            state = health[item.channel].update(
                item.t_ns, is_within=is_within, counts=has_reference
            )
            health[item.channel] = state
            if state.is_out or not is_within:
                continue
        if sensor is None or sensor.quantity is HEIGHT:
            measured_ns = max(measured_ns, item.t_ns)
        later = [entry for _, entry in used[at:]]
        used[at:] = [(before, item)]
        for entry in later:
            used.append((replace(after, inputs=inputs), entry))
            after, _ = _update(follower, used[-1][0], entry, sensors.get(entry.channel))
        error = after
    oldest_ns = t_ns - max(channel.delay_ns for channel in (error.start, *error.start.sensors))
    while used and used[0][1].t_ns < oldest_ns:
        used.pop(0)
    from_ns = used[0][0].t_ns if used else error.t_ns
    left_out = _list_exclusions(health, sensors, t_ns)
    inputs = inputs_since(inputs, from_ns)
    after_tick = FusionMemory(tuple(used), inputs, health, measured_ns, own_ns, left_out)
    return replace(error, inputs=inputs_since(inputs, error.t_ns)), after_tick


def _list_exclusions(
    health: Mapping[int, SensorHealth], sensors: Mapping[int, Channel], t_ns: int
) -> tuple[int, ...]:
    """Sensors that are not to be trusted, or silent."""
    return tuple(
        channel
        for channel, state in health.items()
        if state.is_out
        or t_ns - state.t_ns > sensors[channel].delay_ns + _SILENT * sensors[channel].interval_ns
    )


def _join_inputs(
    known: tuple[tuple[int, float], ...], latest: tuple[tuple[int, float], ...]
) -> tuple[tuple[int, float], ...]:
    """All inputs: the latest, and those remembered from before them."""
    return (*(item for item in known if item[0] < latest[0][0]), *latest)


def _update(
    follower: ErrorFilter, state: ErrorState, innovation: Innovation, sensor: Channel | None
) -> tuple[ErrorState, bool]:
    """State at a reading, and whether the reading is within its gate."""
    constants = state.constants
    if innovation.t_ns - state.t_ns > constants.forgotten_ns:
        if sensor is not None and sensor.quantity is not HEIGHT:
            return state, False
        restarted = follower.restart(state, innovation)
        if sensor is None or restarted.covariance is None:
            return restarted, True
        of_sensor = np.diag([(sensor.noise_std / follower.noise_std_m) ** 2 - 1.0, 0, 0, 0, 0])
        return replace(restarted, covariance=restarted.covariance + of_sensor), True
    mean = mean_at(state, innovation.t_ns)
    omega, sigma = follower.omega, follower.noise_std_m
    row, unit = _row(state.start, sensor, sigma)
    expected = float(row @ np.array(mean[:3]))
    new = (innovation.value - expected) / unit
    powers = sigma * omega ** np.arange(3)
    line = np.concatenate([row * powers / unit, np.zeros(2)])
    number = _grid_index(state.start, innovation.t_ns) - _grid_index(state.start, state.t_ns)
    covariance = constants.steady.covariance if state.covariance is None else state.covariance
    if number:
        covariance = predict_covariance(covariance, follower.pace(state.start), number / _GRID)
    seen: Array = covariance @ line
    variance = float(line @ seen) + 1.0
    scale = state.scale
    is_within = abs(new) <= _GATE * math.sqrt(variance * max(scale, 1.0))
    if sensor is None:
        scale = update_scale(constants, scale, new * new / variance)
    gain = seen / variance
    covariance = covariance - np.outer(gain, seen)
    return ErrorState(
        innovation.t_ns,
        correct(mean, in_si(gain, omega), new * sigma),
        0.5 * (covariance + covariance.T),
        scale,
        inputs_since(state.inputs, innovation.t_ns),
        state.start,
        constants,
        state.slopes,
    ), is_within


def _grid_index(start: Start, t_ns: int) -> int:
    """Index of a time on the grid of the variances."""
    return round((t_ns - start.t_ns) * _GRID / start.interval_ns)


def _row(start: Start, sensor: Channel | None, noise_std_m: float) -> tuple[Array, float]:
    """A sensor's reading per error, rate and residual acceleration in SI, and its deviation."""
    if sensor is None:
        return np.array([1.0, 0.0, 0.0]), noise_std_m
    return np.array(STRUT_SENSORS[sensor.quantity].row(start)), sensor.noise_std
