"""One filter for struts that move each other, and for several sensors: of the whole model's error.

Struts without an observer have the forces of their laws; their errors move as the laws say, and a
measured height of theirs shows where the bench is. With one strut and one height this is the filter
of `rig.observers.error_filter`.

The readings are used one after another in the order of their times of measurement: where one is
older than what was used already, the filter goes back to before it and takes the later ones once
more.

A strut's own height is the reference: it is always used, and without it no sensor that is left
out is used again. A further sensor is gated. A reading beyond the gate is not used; some in a row
leave the sensor out until as many are within again. A drift within the gate is not detected, and a
reference that jumps is a case for the limits.

The virtual force of an observed strut is its residual force, and a feedback that lets the errors of
all measured heights decay as if each were alone; that of a strut with a known law is this feedback.

References:
    Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001),
    5.4 (the normalised innovation) and 11 (gates).
    Simon, Optimal State Estimation (2006), 6.1 (scalar measurements one after another).
    Skogestad and Postlethwaite, "Multivariable Feedback Control" (2005), 3.4 (decoupling).
"""

import bisect
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from rig.channels.measured_quantities import HEIGHT
from rig.observers.error_filter import (
    CONTRADICTION,
    DAMPING,
    MOST_PER_INTERVAL,
    STEADY_VARIANCE,
    inputs_since,
    scale_fading,
    update_scale,
)
from rig.observers.joint_lag import JointLag
from rig.observers.joint_model import ErrorMotion, Inputs, JointModel
from rig.observers.protocol import REFERENCE_HEIGHT, Innovation
from rig.observers.sensor_health import GATE, SILENT, SensorHealth

Array = NDArray[np.float64]


class Reference(NamedTuple):
    """What the heights of a strut have shown.

    Attributes:
        t_ns: Time of the last one of its own that was used.
        measured_ns: The same of any height of this strut.
        innovation_m: The last one.
        scale: Variance of the sensor over the configured one, as the innovations show it.
        new_m: What was new in it, as large as it would be were the filter steady.
    """

    t_ns: int
    measured_ns: int
    innovation_m: float = 0.0
    scale: float = 1.0
    new_m: float = 0.0


class Point(Struct, frozen=True, gc=False):
    """What the filter knows at a time: the state's mean in SI, its covariance in units."""

    t_ns: int
    mean: Array
    covariance: Array


class Used(NamedTuple):
    """A reading that was used, of a strut, and what was known before it."""

    before: Point
    reading: Innovation
    strut: int


class JointStrut(Struct, frozen=True, gc=False):
    """What the filter says of one strut: a `rig.observers.protocol.ObserverState`."""

    innovation_m: float
    virtual_force_n: float
    residual_force_n: float
    force_std_n: float
    measured_ns: int
    left_out: tuple[int, ...] = ()
    is_disturbed: bool = False


class JointState(Struct, frozen=True, gc=False):
    """State of a joint filter.

    Attributes:
        point: What is known at the last reading.
        motion: How the error moves where the model is now.
        inputs: Virtual forces of the followed struts, as far back as `used`.
        used: What was used lately, the oldest first.
        references: Of each strut.
        health: Of each further sensor, by its channel.
        lag: Lag behind forces that change faster than the filter allows for.
        struts: What is said of each strut.
        covariance_n2: Of the errors of all struts' forces, shape (struts, struts).
    """

    filter: "JointFilter"
    point: Point
    motion: ErrorMotion
    inputs: Inputs
    used: tuple[Used, ...]
    references: tuple[Reference, ...]
    health: dict[int, SensorHealth]
    lag: JointLag
    struts: tuple[JointStrut, ...]
    covariance_n2: Array


class JointFilter:
    """A joint filter of a model about a state."""

    def __init__(self, model: JointModel) -> None:
        self._model = model
        sensors = [channel for start in model.starts for channel in start.sensors]
        self._sensors = {channel.index: channel for channel in sensors}
        # A sensor whose samples come in between two ticks may be behind the others by an interval.
        latest_ns = max([model.delay_ns, *(channel.delay_ns for channel in sensors)])
        self._oldest_ns = latest_ns + model.interval_ns
        self._longest_ns = model.delay_ns + 2 * model.interval_ns + round(1e9 / model.fastest)
        self._fadings = {
            strut: scale_fading(model.starts[strut].interval_ns) for strut in model.followed
        }
        self.followed = struts = list(model.followed)
        """Indices of the struts whose heights are followed."""
        self._no_limits_n = np.full(len(struts), np.inf)
        intervals_ns = np.array([model.starts[strut].interval_ns for strut in struts])
        corners = np.minimum(model.fastest, MOST_PER_INTERVAL * 1e9 / intervals_ns)[:, None]
        feedback = (
            corners**2 * model.heights[struts] + 2.0 * DAMPING * corners * model.rates[struts]
        )
        self._required = model.forces_by_accelerations(struts) @ feedback + model.residuals[struts]

    def init(self, t_ns: int) -> JointState:
        """State at the model's start, at the first measured heights."""
        return self._begin(t_ns, self._model.prior())

    def steady_state(self, t_ns: int) -> JointState:
        """State after a long time without an error."""
        return self._begin(t_ns, self._model.steady)

    def restart(self, t_ns: int, before: JointState) -> JointState:
        """State at another start, with the lag there was and the health of the further sensors.

        A sensor that was left out has to prove itself as before.
        """
        return self._begin(t_ns, self._model.prior(), before)

    def _begin(self, t_ns: int, covariance: Array, before: JointState | None = None) -> JointState:
        model, known = self._model, {} if before is None else before.health
        point = Point(t_ns, np.zeros(model.size), covariance)
        inputs = ((t_ns, np.zeros(len(model.followed))),)
        references = tuple(Reference(start.t_ns, start.t_ns) for start in model.starts)
        health = {
            channel: SensorHealth(t_ns, is_out=channel in known and known[channel].is_out)
            for channel in self._sensors
        }
        lag = model.lag.init(t_ns, None if before is None else before.lag)
        no_forces_n2 = np.zeros((0, 0))
        state = JointState(
            self, point, model.motion, inputs, (), references, health, lag, (), no_forces_n2
        )
        return self._conclude(state, t_ns, self._no_limits_n)

    def step(
        self,
        state: JointState,
        t_ns: int,
        innovations: Sequence[Innovation | None],
        further: Sequence[Sequence[Innovation]],
        limits_n: Sequence[float],
    ) -> JointState:
        """State after a tick, with the innovations of new heights and further sensors by strut.

        `limits_n` are the largest magnitudes of the followed struts' virtual forces.
        """
        new = [
            (item, strut)
            for strut, item in enumerate(innovations)
            if item is not None and strut in self._model.followed
        ]
        new += [(item, strut) for strut, items in enumerate(further) for item in items]
        new.sort(key=lambda entry: entry[0].t_ns)
        point, used = state.point, list(state.used)
        references, health = list(state.references), dict(state.health)
        for item, strut in new:
            at = bisect.bisect_right(used, item.t_ns, key=lambda entry: entry.reading.t_ns)
            later = used[at:]
            before = later[0].before if later else point
            own, is_reference = references[strut], item.channel == REFERENCE_HEIGHT
            # Older than all of the memory, or used already.
            if item.t_ns < before.t_ns or (is_reference and item.t_ns == own.t_ns):
                continue
            if is_reference:
                after, references[strut] = self._use_height(state, before, item, strut, own)
            else:
                after, known = self._use_sensor(state, before, item, strut, own, health)
                health[item.channel] = known
                if after is None:
                    continue
                if self._sensors[item.channel].quantity is HEIGHT:
                    measured_ns = max(own.measured_ns, item.t_ns)
                    references[strut] = own._replace(measured_ns=measured_ns)
            used[at:] = [Used(before, item, strut)]
            for entry in later:
                used.append(entry._replace(before=after))
                after, _, _ = self._update(state, after, entry.reading, entry.strut)
            point = after
        lag, newest_ns = state.lag, max(references[strut].t_ns for strut in self._model.own)
        if 2 * (newest_ns - lag.t_ns) >= self._model.interval_ns:
            new_m = np.array([references[strut].new_m for strut in self.followed])
            lag = self._model.lag.update(lag, newest_ns, new_m)
        oldest_ns = t_ns - self._oldest_ns
        while used and used[0].reading.t_ns < oldest_ns:
            used.pop(0)
        moved = replace(
            state,
            point=point,
            inputs=inputs_since(state.inputs, used[0].before.t_ns if used else point.t_ns),
            used=tuple(used),
            references=tuple(references),
            health=health,
            lag=lag,
        )
        return self._conclude(moved, t_ns, np.asarray(limits_n))

    def _use_height(
        self, state: JointState, before: Point, item: Innovation, strut: int, known: Reference
    ) -> tuple[Point, Reference]:
        """What is known after a strut's own height."""
        model, interval_ns = self._model, self._model.starts[strut].interval_ns
        after, new, variance = self._update(state, before, item, strut)
        scale = known.scale
        is_behind_gap = 2 * (item.t_ns - known.t_ns) >= 3 * interval_ns
        if is_behind_gap and new * new > CONTRADICTION * scale * variance:
            # What is known of the residual forces has become worthless.
            before = replace(before, covariance=before.covariance + model.prior())
            after, _, _ = self._update(state, before, item, strut)
            return after, Reference(item.t_ns, item.t_ns, item.value, scale)
        noise_m = model.followed[strut].noise_std_m
        new_m = new * math.sqrt(model.innovations[strut] / variance) * noise_m
        scale = update_scale(scale, self._fadings[strut], new * new / variance)
        t_ns, measured_ns = max(known.t_ns, item.t_ns), max(known.measured_ns, item.t_ns)
        return after, Reference(t_ns, measured_ns, item.value, scale, new_m)

    def _use_sensor(
        self,
        state: JointState,
        before: Point,
        item: Innovation,
        strut: int,
        reference: Reference,
        health: Mapping[int, SensorHealth],
    ) -> tuple[Point | None, SensorHealth]:
        """What is known after a further sensor, None if it is not used, and the sensor's health."""
        after, new, variance = self._update(state, before, item, strut)
        is_within = abs(new) <= GATE * math.sqrt(variance * max(reference.scale, 1.0))
        # Without the reference the gate grows wide, and does not show that a sensor is right.
        interval_ns = self._model.starts[strut].interval_ns
        has_reference = item.t_ns - reference.t_ns <= SILENT * interval_ns
        known = health[item.channel].update(item.t_ns, is_within=is_within, counts=has_reference)
        return (after if is_within and not known.is_out else None), known

    def _update(
        self, state: JointState, before: Point, item: Innovation, strut: int
    ) -> tuple[Point, float, float]:
        """What is known after a reading; what is new in it, and the variance of that.

        Both in units of the sensor's noise.
        """
        model = self._model
        row, std, line = model.lines[item.channel, strut]
        mean = model.mean_at(before.mean, before.t_ns, item.t_ns, state.inputs, state.motion)
        new = (item.value - float(row @ mean)) / std
        number = model.grid_index(item.t_ns) - model.grid_index(before.t_ns)
        covariance = model.ahead(before.covariance, number)
        seen: Array = covariance @ line
        variance = float(line @ seen) + 1.0
        mean = mean + model.units * seen * (new / variance)
        covariance = covariance - seen[:, None] * (seen / variance)
        return Point(item.t_ns, mean, covariance), new, variance

    def _conclude(self, state: JointState, t_ns: int, limits_n: Array) -> JointState:
        """State with what it says of each strut at a time, and with the virtual forces from it."""
        model, point = self._model, state.point
        until_ns = min(t_ns, point.t_ns + self._longest_ns)
        mean = model.mean_at(point.mean, point.t_ns, until_ns, state.inputs, state.motion)
        residuals_n = model.laws_n(mean, state.motion) + model.residuals @ mean
        virtual_n = np.minimum(np.maximum(self._required @ mean, -limits_n), limits_n)
        number = model.grid_index(t_ns) - model.grid_index(point.t_ns)
        covariance = model.force_covariance(model.ahead(point.covariance, number))
        is_disturbed = np.diagonal(covariance) > STEADY_VARIANCE * model.usual_n2
        is_disturbed[self.followed] |= np.abs(virtual_n) >= limits_n
        scales = np.array([reference.scale for reference in state.references])
        roots = np.sqrt(scales)
        covariance *= roots[:, None]
        covariance *= roots
        own = model.own
        covariance[own, own] += model.lag.variances_n2(state.lag, scales[own])
        stds_n = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
        virtuals_n = np.zeros(len(residuals_n))
        virtuals_n[self.followed] = virtual_n
        left_out = self._left_out(state.health, t_ns)
        columns = (virtuals_n, residuals_n, stds_n, is_disturbed)
        every = zip(state.references, *(column.tolist() for column in columns), strict=True)
        struts = tuple(
            JointStrut(
                reference.innovation_m if strut in model.followed else math.nan,
                force_n,
                residual_n,
                std_n,
                # Where no height is used, none is awaited.
                reference.measured_ns if strut in model.followed else t_ns,
                tuple(channel for channel in left_out if self._sensors[channel].strut == strut),
                disturbed,
            )
            for strut, (reference, force_n, residual_n, std_n, disturbed) in enumerate(every)
        )
        inputs = self._with_input(state.inputs, point.t_ns, t_ns, virtual_n)
        return replace(state, inputs=inputs, struts=struts, covariance_n2=covariance)

    def _with_input(self, inputs: Inputs, known_ns: int, t_ns: int, force_n: Array) -> Inputs:
        if t_ns <= inputs[-1][0]:
            return (*inputs[:-1], (t_ns, force_n))
        # Without readings the inputs would grow in number; the prediction ends.
        if t_ns - known_ns <= self._longest_ns or np.any(force_n != inputs[-1][1]):
            return (*inputs, (t_ns, force_n))
        return inputs

    def _left_out(self, health: Mapping[int, SensorHealth], t_ns: int) -> tuple[int, ...]:
        """Sensors that are not to be trusted, or silent."""
        return tuple(
            channel
            for channel, state in health.items()
            if state.is_out
            or t_ns - state.t_ns
            > self._sensors[channel].delay_ns + SILENT * self._sensors[channel].interval_ns
        )

    def with_slopes(self, state: JointState, slopes: Sequence[tuple[float, float]]) -> JointState:
        """State whose error moves with stiffness (N/m) and damping (N·s/m) of each strut's law."""
        return replace(state, motion=self._model.with_slopes(state.motion, slopes))

    def numbers(self, state: JointState) -> list[float]:
        """What the next state depends on, all of it in m; covariance and times left out."""
        return self._model.numbers(state.point.mean, [force_n for _, force_n in state.inputs])

    def with_numbers(self, state: JointState, numbers: Sequence[float]) -> JointState:
        """The state with other numbers than its own, as `numbers` gives them."""
        mean, forces = self._model.of_numbers(numbers)
        since = [since_ns for since_ns, _ in state.inputs]
        struts = list(state.struts)
        for strut, force_n in zip(self.followed, forces[-1].tolist(), strict=True):
            struts[strut] = replace(struts[strut], virtual_force_n=force_n)
        return replace(
            state,
            point=replace(state.point, mean=mean),
            inputs=tuple(zip(since, forces, strict=True)),
            struts=tuple(struts),
        )
