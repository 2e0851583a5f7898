"""Several sensors of one strut in one filter: another height, a velocity, a load cell.

Each reading is a line of the filter of the model's error: a height is the error x, a velocity its
rate, and a load cell the force that the model's law lacks, m (d/m - k x - c dx/dt), with a standard
deviation of its own. They are used one after another in the order of the times at which they were
true: where a reading is older than what was used already, the filter goes back to before it and
takes the later ones once more.

The strut's own height is the reference: it is always used, and without it no sensor that is left
out comes back. A further sensor is gated. A reading
beyond the gate is not used; some in a row leave the sensor out until as many are within again.
What drifts within the gate is not found, and a reference that jumps is a case for the limits.

References:
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001),
    5.4 (the normalised innovation) and 11 (gates).
    Simon, Optimal State Estimation (2006), 6.1 (scalar measurements one after another).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from rig.bridge.contract import Deviation, Innovation, Measures, Sensor, Start
from rig.observers.error_filter import (
    Array,
    ErrorFilter,
    ErrorState,
    corrected,
    in_si,
    moved,
    rescaled,
    since,
    spread,
)

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


class Health(NamedTuple):
    """What is known of a further sensor.

    Attributes:
        t_ns: Time of its last reading.
        beyond: Readings beyond the gate, the last ones in a row.
        within: Readings within it, the last ones in a row.
        is_out: Whether it is left out.
    """

    t_ns: int
    beyond: int = 0
    within: int = 0
    is_out: bool = False

    def after(self, t_ns: int, *, is_within: bool, counts: bool) -> "Health":
        """After another reading.

        Args:
            t_ns: Its time.
            is_within: Whether it is within the gate.
            counts: Whether it counts for a sensor that is out.
        """
        if self.is_out and not counts:
            return self._replace(t_ns=t_ns)
        beyond, within = (0, self.within + 1) if is_within else (self.beyond + 1, 0)
        is_out = within < _WITHIN if self.is_out else beyond >= _BEYOND
        return Health(t_ns, beyond, within, is_out)


class Several(Struct, frozen=True, gc=False):
    """What is remembered of several sensors.

    Attributes:
        used: What was used of late, the oldest first, with the state before each.
        inputs: Accelerations by the virtual force and their times, as far back as `used`.
        health: Of each further sensor, by its place.
        measured_ns: Time of the last reading of a height that was used.
        own_ns: Time of the last of the strut's own height.
        left_out: Places of sensors that are left out, or silent.
    """

    used: tuple[tuple[ErrorState, Deviation], ...]
    inputs: tuple[tuple[int, float], ...]
    health: dict[int, Health]
    measured_ns: int
    own_ns: int
    left_out: tuple[int, ...] = ()


_OWN = -1
"""Place of the strut's own height."""


def begun(start: Start) -> Several:
    """Before any reading of a further sensor."""
    health = {place: Health(start.t_ns) for place, _ in start.sensors}
    return Several((), ((start.t_ns, 0.0),), health, start.t_ns, start.t_ns)


def fused(
    follower: ErrorFilter,
    error: ErrorState,
    several: Several,
    t_ns: int,
    innovation: Innovation | None,
    deviations: Sequence[Deviation],
) -> tuple[ErrorState, Several]:
    """Filter and memory after a tick.

    Args:
        follower: The filter.
        error: Its state, with all inputs up to now.
        several: What is remembered.
        t_ns: Time of the tick.
        innovation: Of a new height of the strut; None where none came.
        deviations: Of new readings of the further sensors.
    """
    sensors = dict(error.start.sensors)
    new = [*deviations]
    if innovation is not None:
        new.append(Deviation(_OWN, innovation.value_m, innovation.t_ns))
    inputs = _joined(several.inputs, error.inputs)
    used, health, measured_ns = list(several.used), dict(several.health), several.measured_ns
    own_ns = several.own_ns
    for deviation in sorted(new, key=lambda item: item.t_ns):
        at = len(used)
        while at and used[at - 1][1].t_ns > deviation.t_ns:
            at -= 1
        before = used[at][0] if at < len(used) else error
        before = replace(before, inputs=inputs)
        if deviation.t_ns < before.t_ns:  # older than all that is remembered
            continue
        sensor = sensors.get(deviation.sensor)
        after, is_within = _updated(follower, before, deviation, sensor)
        if sensor is None:
            own_ns = max(own_ns, deviation.t_ns)
        else:
            # Without the reference the gate grows wide, and proves nothing to one that is out.
            has_reference = deviation.t_ns - own_ns <= _SILENT * error.start.interval_ns
            known = health[deviation.sensor].after(
                deviation.t_ns, is_within=is_within, counts=has_reference
            )
            health[deviation.sensor] = known
            if known.is_out or not is_within:
                continue
        if sensor is None or sensor.measures is Measures.HEIGHT:
            measured_ns = max(measured_ns, deviation.t_ns)
        later = [item for _, item in used[at:]]
        used[at:] = [(before, deviation)]
        for item in later:
            used.append((replace(after, inputs=inputs), item))
            after, _ = _updated(follower, used[-1][0], item, sensors.get(item.sensor))
        error = after
    oldest_ns = t_ns - _longest_delay_ns(error.start)
    while used and used[0][1].t_ns < oldest_ns:
        used.pop(0)
    from_ns = used[0][0].t_ns if used else error.t_ns
    left_out = tuple(
        place
        for place, known in health.items()
        if known.is_out or t_ns - known.t_ns > _silent_ns(sensors[place])
    )
    memory = Several(tuple(used), since(inputs, from_ns), health, measured_ns, own_ns, left_out)
    return replace(error, inputs=since(inputs, error.t_ns)), memory


def _joined(
    known: tuple[tuple[int, float], ...], latest: tuple[tuple[int, float], ...]
) -> tuple[tuple[int, float], ...]:
    """All inputs: the latest, and those remembered from before them."""
    return (*(item for item in known if item[0] < latest[0][0]), *latest)


def _silent_ns(sensor: Sensor) -> int:
    return sensor.delay_ns + _SILENT * sensor.interval_ns


def _longest_delay_ns(start: Start) -> int:
    return max([start.delay_ns, *(sensor.delay_ns for _, sensor in start.sensors)])


def _updated(
    follower: ErrorFilter, state: ErrorState, deviation: Deviation, sensor: Sensor | None
) -> tuple[ErrorState, bool]:
    """State at a reading, and whether the reading is within its gate."""
    constants = state.constants
    if deviation.t_ns - state.t_ns > constants.forgotten_ns:
        if sensor is not None and sensor.measures is not Measures.HEIGHT:
            return state, False
        anew = follower.anew(state, Innovation(deviation.value, deviation.t_ns))
        if sensor is None or anew.covariance is None:
            return anew, True
        of_sensor = np.diag([(sensor.noise_std / follower.noise_std_m) ** 2 - 1.0, 0, 0, 0, 0])
        return replace(anew, covariance=anew.covariance + of_sensor), True
    mean = moved(state, deviation.t_ns)
    omega, sigma = follower.omega, follower.noise_std_m
    row, unit = _row(state.start, sensor, sigma)
    expected = float(row @ np.array(mean[:3]))
    new = (deviation.value - expected) / unit
    powers = sigma * omega ** np.arange(3)
    line = np.concatenate([row * powers / unit, np.zeros(2)])
    number = _place(state.start, deviation.t_ns) - _place(state.start, state.t_ns)
    covariance = constants.steady.covariance if state.covariance is None else state.covariance
    if number:
        covariance = spread(covariance, follower.pace(state.start), number / _GRID)
    seen: Array = covariance @ line
    variance = float(line @ seen) + 1.0
    scale = state.scale
    is_within = abs(new) <= _GATE * math.sqrt(variance * max(scale, 1.0))
    if sensor is None:
        scale = rescaled(constants, scale, new * new / variance)
    gain = seen / variance
    covariance = covariance - np.outer(gain, seen)
    return ErrorState(
        deviation.t_ns,
        corrected(mean, in_si(gain, omega), new * sigma),
        0.5 * (covariance + covariance.T),
        scale,
        since(state.inputs, deviation.t_ns),
        state.start,
        constants,
    ), is_within


def _place(start: Start, t_ns: int) -> int:
    """Place of a time on the grid of the variances."""
    return round((t_ns - start.t_ns) * _GRID / start.interval_ns)


def _row(start: Start, sensor: Sensor | None, noise_std_m: float) -> tuple[Array, float]:
    """A sensor's value per error, rate and residual acceleration in SI, and its deviation."""
    if sensor is None:
        return np.array([1.0, 0.0, 0.0]), noise_std_m
    match sensor.measures:
        case Measures.HEIGHT:
            row = [1.0, 0.0, 0.0]
        case Measures.VELOCITY:
            row = [0.0, 1.0, 0.0]
        case Measures.FORCE:
            mass_kg = 1.0 / start.mobility_per_kg
            row = [-start.stiffness_per_s2 * mass_kg, -start.damping_per_s * mass_kg, mass_kg]
    return np.array(row), sensor.noise_std
