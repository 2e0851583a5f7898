"""A model under its inputs that observers make follow its bench."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant, AnySensorReader, LoadedModel, ModelState
from dart_model.virtual_sensors import VirtualSensor
from rig.bridge.estimator import Estimate, FollowedError, find_divergence, is_sensible
from rig.bridge.innovation_band import InnovationBand, restart_band, update_band
from rig.bridge.measured_inputs import AnyInput, InputState, grace_ns
from rig.bridge.measurement_age import is_too_old
from rig.bridge.values import StepInput, StrutOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import TEMPERATURE
from rig.closed_loop.strut_response import laws_by_motion, linearise
from rig.observers.error_model import StrutResponse
from rig.observers.protocol import AnyObserver, Innovation, Start
from rig.observers.strut_observers import ObserversState, StrutObservers
from rig.observers.strut_sensors import Instant, model_height_m, model_motion_m, model_reading

Array = NDArray[np.float64]

_AT_ONCE = 4
"""Intervals that may not be over in less than half of their time."""


class FreeModelState(Struct, frozen=True, gc=False):
    """State of a model that follows its bench.

    Attributes:
        t_ns: Time of the last step.
        temperature_c: Last damper temperature.
        first: Of each strut the measurements that arrived before the model started, the oldest
            first.
        observers: State of the struts' observers; while the model waits that before it stopped.
        model: The model under its forces; None while it waits for measurements.
        past: The model at the ticks before the last, the newest first, as far back as a measurement
            may be old; empty where none is late.
        disturbed_ns: Of each strut the time of the last disturbance of its estimate: the start, a
            change of settings, or what its observer takes for one.
        inputs: State of each input of the model; None before its first sample.
        is_settled: Whether every strut's estimate has settled.
        longest_gaps_ns: Of each strut the longest time without a measurement.
        bands: Of each strut the band of its innovations.
        input_errors: Of each motion among the inputs the covariances of the laws' forces by the
            noise of its samples and by its lag, one after the other, over the mean squares of these
            as of `MeasuredInput.squares_m2`, N²/m², shape (2 * motions, struts * struts).
        innovations: Of each strut that of a height at the last step; empty after a start.
    """

    t_ns: int
    temperature_c: float
    first: tuple[tuple[Sample, ...], ...]
    observers: ObserversState = ObserversState()
    model: LoadedModel[ModelState] | None = None
    past: tuple[Instant, ...] = ()
    disturbed_ns: tuple[int, ...] = ()
    inputs: tuple[InputState | None, ...] = ()
    is_settled: bool = False
    longest_gaps_ns: tuple[int, ...] = ()
    bands: tuple[InnovationBand, ...] = ()
    input_errors: Array = np.zeros((0, 0))
    innovations: tuple[Innovation | None, ...] = ()


_Received = Sequence[Sample | None]
"""The newest samples of a step: of each strut's height, then temperature; last one that is not used
here, as of a load cell that is only logged. None where none arrived."""


SettlingTimes = Callable[[Sequence[AnyObserver]], Sequence[int | None]]
"""Observers -> settling time of each strut's estimate in ns; None if it never settles."""


class FreeModelEstimator:
    """An estimator whose model moves under its inputs.

    Args:
        channels: Channels of the bench; their indices are their positions.
        inputs: Inputs of the model, in the order of its input vector.
        stale_after_ns: Age up to which a measurement can start the model.
        settling_times: Settling times of the closed loop with some observers.
        settling_s: What replaces them, if not None.

    Raises:
        ValueError: There is not one observer per strut.
    """

    def __init__(
        self,
        plant: AnyPlant,
        observers: Sequence[AnyObserver],
        channels: Sequence[Channel],
        inputs: Sequence[AnyInput],
        stale_after_ns: int,
        settling_times: SettlingTimes,
        settling_s: float | None = None,
    ) -> None:
        if len(observers) != plant.struts:
            raise ValueError(
                f"{len(observers)} observers for {plant.struts} struts, expected one each"
            )
        self._plant = plant
        self.observers = tuple(observers)
        self._observers = StrutObservers(observers)
        self._channels = tuple(channels)
        self._stale_after_ns = stale_after_ns
        self._settling_times = settling_times
        self._settling_ns: Sequence[int | None] = (
            tuple(settling_times(observers))
            if settling_s is None
            else (round(settling_s * 1e9),) * plant.struts
        )
        struts = plant.struts
        self._temperature, unused = struts, struts + 1
        slots = {TEMPERATURE: self._temperature}
        self._slots = [
            channel.strut if channel.role is Role.HEIGHT else slots.get(channel.quantity, unused)
            for channel in channels
        ]
        self._nothing: list[Sample | None] = [None] * (unused + 1)
        self._is_sensor = [channel.role is Role.SENSOR for channel in channels]
        self._heights = {
            channel.strut: channel for channel in channels if channel.role is Role.HEIGHT
        }
        self._sensing = [(0.0, 0)] * plant.struts
        for strut, channel in self._heights.items():
            self._sensing[strut] = channel.step, channel.interval_ns
        sensors = [channel for channel in channels if channel.role is Role.SENSOR]
        self._sensors = tuple(
            tuple(channel for channel in sensors if channel.strut == strut)
            for strut in range(plant.struts)
        )
        latest = max([item.delay_ns for item in (*self._heights.values(), *sensors)], default=0)
        # A reading lies between two ticks: both are kept for it.
        self._oldest_ns = latest + 1 if sensors else latest
        self._untimed = frozenset(
            strut for strut, channel in self._heights.items() if not channel.has_cycle
        )
        self._inputs = tuple(inputs)
        self._input_of = [-1] * len(channels)
        for index, item in enumerate(inputs):
            for channel in item.channels:
                self._input_of[channel.index] = index
        ends = itertools.accumulate([len(item.values(None, 0)) for item in inputs], initial=0)
        # Of each motion its place among the inputs, and its column in their vector.
        self._columns = [
            (index, column)
            for index, (item, column) in enumerate(zip(inputs, ends, strict=False))
            if item.gains is not None
        ]
        self._graces_ns = [grace_ns(item, stale_after_ns) for item in inputs]
        self._silences_ns = [grace + stale_after_ns for grace in self._graces_ns]

    @property
    def struts(self) -> int:
        return len(self.observers)

    def with_settings(
        self, observers: Sequence[AnyObserver], stale_after_ns: int, settling_s: float | None
    ) -> "FreeModelEstimator":
        return FreeModelEstimator(
            self._plant,
            observers,
            self._channels,
            self._inputs,
            stale_after_ns,
            self._settling_times,
            settling_s,
        )

    def init(self, t_ns: int) -> FreeModelState:
        no_inputs = (None,) * len(self._inputs)
        return FreeModelState(t_ns, AMBIENT_C, ((),) * self.struts, inputs=no_inputs)

    def unsettle(self, state: FreeModelState, t_ns: int) -> FreeModelState:
        return replace(state, disturbed_ns=(t_ns,) * self.struts, is_settled=False)

    def restart(self, state: FreeModelState, t_ns: int) -> FreeModelState:
        """State that waits for measurements again; the temperature is kept."""
        return FreeModelState(
            t_ns,
            state.temperature_c,
            ((),) * self.struts,
            observers=state.observers,
            inputs=state.inputs,
            bands=tuple(map(restart_band, state.bands)),
        )

    def discard(self, before: FreeModelState, after: FreeModelState) -> FreeModelState:
        return replace(before, t_ns=after.t_ns)

    def heights_m(self, state: FreeModelState) -> Sequence[float]:
        if state.model is None:
            return ()
        return [height_m for height_m, _ in state.model.state.struts]

    def read_model(self, sensors: Mapping[str, VirtualSensor]) -> AnySensorReader:
        return self._plant.virtual_sensors(sensors)

    def model_of(self, state: FreeModelState) -> LoadedModel[ModelState] | None:
        return state.model

    def step(
        self, state: FreeModelState, step_input: StepInput
    ) -> tuple[FreeModelState, Estimate | None]:
        """Advance the model to a time and correct it with what was measured."""
        received = self._sort(step_input.samples)
        if state.model is None:
            return self._start_if_possible(state, step_input, received)
        inputs, was_silent = self._update_inputs(state, step_input.samples)
        if was_silent:
            # The observers took what was missing of the input for a force of the strut.
            state = self.restart(state, step_input.t_ns)
            return self._start_if_possible(state, step_input, received)
        return self._observe(state, state.model, step_input, received, inputs)

    def _update_inputs(
        self, state: FreeModelState, samples: Sequence[Sample]
    ) -> tuple[tuple[InputState | None, ...], bool]:
        """States of the inputs after samples, and whether one comes after heights without it."""
        states, was_silent = list(state.inputs), False
        for sample in samples:
            index = self._input_of[sample.channel]
            if index < 0:
                continue
            before = states[index]
            if before is not None:
                end_ns = before.t_ns + self._silences_ns[index]
                if sample.t_ns > end_ns and self._has_heights_since(end_ns, state):
                    was_silent = True
            states[index] = self._inputs[index].update(before, sample)
        return tuple(states), was_silent

    def _input_vector(self, states: Sequence[InputState | None], t_ns: int) -> tuple[float, ...]:
        """What drives the model at a time."""
        inputs = self._inputs
        vector = inputs[0].values(states[0], t_ns)
        for index in range(1, len(inputs)):
            vector += inputs[index].values(states[index], t_ns)
        return vector

    def _sort(self, samples: Sequence[Sample]) -> list[Sample | None]:
        """The newest samples, by what they are used for."""
        received, slots = self._nothing.copy(), self._slots
        for sample in samples:
            received[slots[sample.channel]] = sample
        return received

    def collect(self, state: FreeModelState, step_input: StepInput) -> tuple[FreeModelState, bool]:
        """State with the newest measurements of those that a start requires."""
        return self._collect(state, step_input, self._sort(step_input.samples))

    def _collect(
        self, state: FreeModelState, step_input: StepInput, received: _Received
    ) -> tuple[FreeModelState, bool]:
        required = [observer.measurements_to_start for observer in self.observers]
        first = tuple(
            (*old, new)[-count:] if new is not None and count else old
            for new, old, count in zip(received, state.first, required, strict=False)
        )
        warm = received[self._temperature]
        temperature_c = state.temperature_c if warm is None else warm.value
        state = FreeModelState(
            step_input.t_ns,
            temperature_c,
            first,
            state.observers,
            inputs=self._update_inputs(state, step_input.samples)[0],
            bands=state.bands,
        )
        return state, self._can_start(state, required)

    def _start_if_possible(
        self, state: FreeModelState, step_input: StepInput, received: _Received
    ) -> tuple[FreeModelState, Estimate | None]:
        state, can_start = self._collect(state, step_input, received)
        return self._start(state) if can_start else (state, None)

    def _start(self, state: FreeModelState) -> tuple[FreeModelState, Estimate]:
        """Start the model at the measured heights and at their velocities."""
        t_ns, first = state.t_ns, state.first
        motions = [start_of_motion(samples, t_ns) for samples in first]
        heights, velocities = zip(*motions, strict=True)
        inputs = self._input_vector(state.inputs, t_ns)
        model = self._plant.init(heights, velocities, t_ns * 1e-9, inputs)
        no_forces = (0.0,) * len(first)
        loaded = self._plant.load(model, no_forces, inputs, state.temperature_c)
        still = self._at_rest(inputs)
        moves = linearise(self._plant, model, still)
        starts = [
            self._start_of_strut(strut, first[strut], t_ns, response)
            for strut, response in enumerate(moves.responses())
        ]
        longest_gaps_ns = tuple(
            observer.longest_gap_ns(start.interval_ns) + start.delay_ns
            for observer, start in zip(self.observers, starts, strict=True)
        )
        started = replace(
            state,
            observers=self._observers.init(starts, moves, state.observers),
            model=loaded,
            longest_gaps_ns=longest_gaps_ns,
            bands=state.bands or (InnovationBand(),) * len(first),
            input_errors=self._input_errors(model, still),
        )
        started = self.unsettle(started, t_ns)
        return self._estimate(started, loaded, no_forces, self._newest_ns(state))

    def _at_rest(self, inputs: Sequence[float]) -> tuple[float, ...]:
        """Inputs whose motions stand still where they are."""
        still = list(inputs)
        for _, column in self._columns:
            still[column + 1 : column + 3] = 0.0, 0.0
        return tuple(still)

    def _input_errors(self, model: ModelState, inputs: Sequence[float]) -> Array:
        """Covariances of the laws' forces by errors of the motions, as of `FreeModelState`."""
        rows: list[Array] = []
        for index, column in self._columns:
            item = self._inputs[index]
            gains = item.gains
            if gains is not None:
                slopes = laws_by_motion(self._plant, model, inputs, column)
                noise, lag = gains.ahead(1e-9 * item.channels[0].delay_ns)
                late = slopes @ lag
                rows += [(slopes @ noise @ slopes.T).ravel(), np.outer(late, late).ravel()]
        return np.array(rows)

    def force_covariance_n2(self, state: FreeModelState) -> Array:
        joint = state.observers.joint
        stds_n = [strut.force_std_n for strut in state.observers.struts]
        known = np.diag(np.square(stds_n)) if joint is None else joint.covariance_n2.copy()
        # The joint filter does not know what an observer of another kind adds.
        unknown = [strut for strut, std_n in enumerate(stds_n) if math.isnan(std_n)]
        if unknown:
            known[unknown] = known[:, unknown] = np.nan
        if self._columns:
            squares_m2: list[float] = []
            for item, followed in zip(self._inputs, state.inputs, strict=True):
                squares_m2 += item.squares_m2(followed)
            known += (np.array(squares_m2) @ state.input_errors).reshape(known.shape)
        return known

    def innovations(self, state: FreeModelState) -> Sequence[Innovation | None]:
        loaded = state.model
        if loaded is None or not self._columns:
            return state.innovations
        found = list(state.innovations or (None,) * self.struts)
        now = Instant(state.t_ns, loaded.state.struts, (), loaded.inputs)
        instants = now, *state.past
        for index, column in self._columns:
            newest = self._inputs[index].newest(state.inputs[index])
            innovation = None
            if newest is not None:
                value = newest.value - model_motion_m(newest.t_ns, column, instants)
                innovation = Innovation(value, newest.t_ns)
            found.append(innovation)
        return found

    def motion_errors(self, state: FreeModelState) -> list[FollowedError]:
        errors: list[FollowedError] = []
        for index, _ in self._columns:
            item = self._inputs[index]
            gains, channel = item.gains, item.channels[0]
            if gains is not None:
                sample_m2, lag_m2 = item.squares_m2(state.inputs[index])
                delay_s, interval_s = 1e-9 * channel.delay_ns, 1e-9 * channel.interval_ns
                noise, lag = gains.ahead(delay_s)
                errors.append(
                    FollowedError(
                        sample_m2,
                        sample_m2 * noise.diagonal(),
                        lag_m2 * lag**2,
                        interval_s,
                        delay_s,
                    )
                )
        return errors

    def _start_of_strut(
        self, strut: int, samples: Sequence[Sample], t_ns: int, response: StrutResponse
    ) -> Start:
        """What the observer of a strut is given that starts after some measurements."""
        interval_ns, delay_ns = self._sample_timing(strut)
        if strut in self._untimed:
            interval_ns = max(interval_ns, _gaps_ns(samples)[len(samples) // 2 - 1])
        measured_ns = samples[-1].t_ns if samples else t_ns
        mobility, stiffness, damping = response
        sensors = self._sensors[strut]
        return Start(measured_ns, mobility, interval_ns, delay_ns, stiffness, damping, sensors)

    def _sample_timing(self, strut: int) -> tuple[int, int]:
        """Interval and delay of a strut's heights in ns; zero where none is measured."""
        channel = self._heights.get(strut)
        return (0, 0) if channel is None else (channel.interval_ns, channel.delay_ns)

    def _can_start(self, state: FreeModelState, required: Sequence[int]) -> bool:
        """Whether every strut has enough measurements, fresh and without a gap.

        A velocity is computed from several: they must belong together.
        """
        for item, known in zip(self._inputs, state.inputs, strict=True):
            if not item.is_ready(known):
                return False
        for strut, samples in enumerate(state.first):
            if len(samples) != required[strut]:
                return False
            if not _belong_together(samples, self._sample_timing(strut)[0]):
                return False
        return not is_too_old(self._newest_ns(state), state.t_ns, self._stale_after_ns)

    def _newest_ns(self, state: FreeModelState) -> int:
        """Time of the oldest of the newest measurements before the model starts."""
        # Without an observer no measurement is awaited.
        newest_ns = min((it[-1].t_ns for it in state.first if it), default=state.t_ns)
        return min(newest_ns, self._newest_input_ns(state.inputs, newest_ns))

    def _newest_input_ns(self, inputs: Sequence[InputState | None], newest_ns: int) -> int:
        """Time up to which the inputs are known well enough, if that is before `newest_ns`."""
        for index, known in enumerate(inputs):
            if known is not None:
                known_ns = known.t_ns + self._graces_ns[index]
                newest_ns = min(newest_ns, known_ns)
        return newest_ns

    def _observe(
        self,
        state: FreeModelState,
        loaded: LoadedModel[ModelState],
        step_input: StepInput,
        received: _Received,
        known_inputs: tuple[InputState | None, ...],
    ) -> tuple[FreeModelState, Estimate | None]:
        """Advance the model to the tick and correct it with what was measured.

        After too long a gap in a height or an input, and after a height that contradicts
        the innovations before, the model starts again from the measurements behind it instead.
        """
        t_ns, before_ns, is_settled = step_input.t_ns, state.t_ns, state.is_settled
        inputs, warm = self._input_vector(known_inputs, t_ns), received[self._temperature]
        temperature_c = loaded.temperature_c if warm is None else warm.value
        model = self._plant.step(loaded, (t_ns - before_ns) * 1e-9, inputs)
        instants: tuple[Instant, ...] = ()
        further: Sequence[tuple[Innovation, ...]] = ()
        if self._oldest_ns:
            readings = [it for it in step_input.samples if self._is_sensor[it.channel]]
            forces_n: Sequence[float] = ()
            if readings:
                no_forces = (0.0,) * self.struts
                forces_n = self._plant.load(model, no_forces, inputs, temperature_c).forces_n
            instants = self._recent_instants(
                state, loaded, Instant(t_ns, model.struts, forces_n, inputs)
            )
            further = self._compare(readings, instants)
        innovations: list[Innovation | None] = []
        bands: list[InnovationBand] = []
        for strut, observer in enumerate(self.observers):
            measured, before, band = (
                received[strut],
                state.observers.struts[strut],
                state.bands[strut],
            )
            innovation = None
            # A height that no observer uses is logged alone: what its model errs by stays.
            if measured is not None and observer.requires_height:
                measured_ns = measured.t_ns
                if measured_ns - before.measured_ns > state.longest_gaps_ns[strut]:
                    return self._start_if_possible(self.restart(state, t_ns), step_input, received)
                height_m, model_m = measured.value, model.struts[strut][0]
                if measured_ns != t_ns:
                    before_tick = Instant(before_ns, loaded.state.struts, ())
                    ticks = instants or (Instant(t_ns, model.struts, ()), before_tick)
                    model_m = model_height_m(measured_ns, strut, ticks)
                innovation_m = height_m - model_m
                innovation = Innovation(innovation_m, measured_ns)
                sensing, was_left = self._sensing[strut], band.is_left
                band = update_band(band, height_m, innovation_m, measured_ns, sensing, is_settled)
                if band.is_left and not was_left:
                    return self._begin_again(state, step_input, strut, band)
            bands.append(band)
            innovations.append(innovation)
        known = state.observers
        slopes = self._plant.slopes(model, inputs, temperature_c)
        if slopes is not None:
            known = self._observers.with_slopes(known, slopes)
        observers = self._observers.step(known, t_ns, innovations, further)
        virtual_n: list[float] = []
        oldest_ns = t_ns
        for observed in observers.struts:
            virtual_n.append(observed.virtual_force_n)
            oldest_ns = min(oldest_ns, observed.measured_ns)
        loaded = self._plant.load(model, virtual_n, inputs, temperature_c)
        oldest_ns = self._newest_input_ns(known_inputs, oldest_ns)
        after = FreeModelState(
            t_ns,
            temperature_c,
            (),
            observers,
            loaded,
            instants[1:] if instants else state.past,
            state.disturbed_ns,
            known_inputs,
            is_settled,
            state.longest_gaps_ns,
            tuple(bands),
            state.input_errors,
            tuple(innovations),
        )
        return self._estimate(after, loaded, virtual_n, oldest_ns)

    def _begin_again(
        self, state: FreeModelState, step_input: StepInput, strut: int, band: InnovationBand
    ) -> tuple[FreeModelState, None]:
        """State that waits for the heights behind one that left its strut's band.

        What the observers know of the motion does not hold for them: they would follow the jump
        with a force, and their variances do not know of it.
        """
        bands = (*state.bands[:strut], band, *state.bands[strut + 1 :])
        state = self.restart(replace(state, bands=bands), step_input.t_ns)
        received = self._sort(step_input.samples)
        received[: self.struts] = [None] * self.struts
        return self._collect(state, step_input, received)[0], None

    def _has_heights_since(self, t_ns: int, state: FreeModelState) -> bool:
        """Whether the model runs, and heights of every strut have come since a time."""
        return (
            state.model is not None
            and min([observer.measured_ns for observer in state.observers.struts]) > t_ns
        )

    def _recent_instants(
        self, state: FreeModelState, before: LoadedModel[ModelState], now: Instant
    ) -> tuple[Instant, ...]:
        """The model now and before, as far back as a measurement may be old."""
        oldest_ns = now.t_ns - self._oldest_ns
        kept = [now]
        last = Instant(state.t_ns, before.state.struts, before.forces_n, before.inputs)
        for instant in (last, *state.past):
            if kept[-1].t_ns <= oldest_ns:
                break
            kept.append(instant)
        return tuple(kept)

    def _compare(
        self, readings: Sequence[Sample], instants: Sequence[Instant]
    ) -> Sequence[tuple[Innovation, ...]]:
        """Innovations of further sensors, by strut; empty where none were read."""
        if not readings:
            return ()
        innovations: list[tuple[Innovation, ...]] = [()] * self.struts
        for sample in readings:
            channel = self._channels[sample.channel]
            value = sample.value - model_reading(sample.t_ns, channel, instants)
            innovation = Innovation(value, sample.t_ns, sample.channel)
            innovations[channel.strut] += (innovation,)
        return innovations

    def _estimate(
        self,
        state: FreeModelState,
        loaded: LoadedModel[ModelState],
        virtual_n: Sequence[float],
        measured_ns: int,
    ) -> tuple[FreeModelState, Estimate]:
        """State and estimate at the end of a step, after which the model is `loaded`.

        `virtual_n` is the virtual force of each strut.
        """
        struts: list[StrutOutput] = []
        left_out: tuple[int, ...] = ()
        size = sum(loaded.inputs)
        is_calm = state.is_settled
        t_ns, longest_gaps_ns, bands = state.t_ns, state.longest_gaps_ns, state.bands
        stds_n = [observer.force_std_n for observer in state.observers.struts]
        if self._columns:
            stds_n = np.sqrt(self.force_covariance_n2(state).diagonal()).tolist()
        for strut, observer in enumerate(state.observers.struts):
            if (
                observer.is_disturbed
                or bands[strut].is_left
                or t_ns - observer.measured_ns > longest_gaps_ns[strut]
            ):
                is_calm = False
            height_m, velocity_m_per_s = loaded.state.struts[strut]
            law_force_n = loaded.forces_n[strut]
            force_n = law_force_n + observer.residual_force_n
            output = StrutOutput(
                force_n,
                virtual_n[strut],
                True,
                height_m,
                velocity_m_per_s,
                loaded.accelerations_m_per_s2[strut],
                observer.innovation_m,
                stds_n[strut],
                law_force_n,
            )
            struts.append(output)
            size += force_n + height_m + velocity_m_per_s
            if self._sensors[strut]:
                left_out += observer.left_out
        # A model that has diverged is of no use, and would not come back by itself. DART hides it:
        # what is not finite has an acceleration of zero there.
        diverged = -1 if is_sensible(size) else find_divergence(struts)
        if not is_calm:
            state = self._settle(state)
        estimate = Estimate(tuple(struts), measured_ns, state.is_settled, diverged, left_out)
        return state, estimate

    def _settle(self, state: FreeModelState) -> FreeModelState:
        """State with the times of the last disturbances, and whether every strut has settled."""
        is_settled, t_ns, disturbed_ns = True, state.t_ns, list(state.disturbed_ns)
        for strut, settling_ns in enumerate(self._settling_ns):
            observer = state.observers.struts[strut]
            if (
                observer.is_disturbed
                or state.bands[strut].is_left
                or t_ns - observer.measured_ns > state.longest_gaps_ns[strut]
            ):
                disturbed_ns[strut] = t_ns
                is_settled = False
            elif settling_ns is None or t_ns - disturbed_ns[strut] < settling_ns:
                is_settled = False
        return replace(state, disturbed_ns=tuple(disturbed_ns), is_settled=is_settled)


def _belong_together(samples: Sequence[Sample], interval_ns: int) -> bool:
    """Whether measurements follow each other as they should.

    None is missing, and none has waited with others in a queue, so that their times are one. How
    long it takes is no matter: the DBC may not know the cycle time.
    """
    if len(samples) < 2:
        return True
    gaps_ns = _gaps_ns(samples)
    if gaps_ns[-1] > 3 * max(interval_ns, gaps_ns[len(gaps_ns) // 2]):
        return False
    # One that is late and one that is early are nothing unusual, some that came at once are.
    step = min(_AT_ONCE, len(gaps_ns))
    spans_ns = [
        later.t_ns - item.t_ns for item, later in zip(samples, samples[step:], strict=False)
    ]
    return 2 * min(spans_ns) >= step * interval_ns


def _gaps_ns(samples: Sequence[Sample]) -> list[int]:
    """Times between measurements, the shortest first."""
    return sorted(after.t_ns - before.t_ns for before, after in itertools.pairwise(samples))


def start_of_motion(samples: Sequence[Sample], t_ns: int) -> tuple[float, float]:
    """Height (m) and velocity (m/s) at a time, from the measurements before it.

    With one the model starts at rest there; with three or more, on a parabola through them; with
    none the height is NaN, and the strut starts where the others put it.
    """
    if not samples:
        return math.nan, 0.0
    if len(samples) == 1:
        return samples[0].value, 0.0
    since_s = [(item.t_ns - t_ns) * 1e-9 for item in samples]
    longest_s = max(map(abs, since_s))
    share = np.array(since_s) / longest_s
    heights = np.array([item.value for item in samples])
    powers = np.column_stack([np.ones_like(share), share, share * share])
    height, slope, _ = np.linalg.lstsq(powers, heights, rcond=None)[0]
    return float(height), float(slope) / longest_s
