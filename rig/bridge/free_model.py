"""A model under the applied force that observers make follow its bench."""

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from dart_model.effects import AMBIENT_C
from dart_model.protocol import AnyPlant, LoadedModel, ModelState
from rig.bridge.estimator import Estimate, find_divergence, is_sensible
from rig.bridge.measurement_age import is_too_old
from rig.bridge.values import StepInput, StrutOutput
from rig.channels.channel import Channel, Role, Sample
from rig.channels.measured_quantities import APPLIED_FORCE, TEMPERATURE
from rig.closed_loop.strut_response import strut_responses
from rig.observers.protocol import AnyObserver, Innovation, ObserverState, Start
from rig.observers.strut_sensors import Instant, model_height_m, model_reading

_APPLIED, _TEMPERATURE, _READING, _UNUSED = -1, -2, -3, -4
"""Routes of samples other than heights; a load cell of the bench is logged and not used here."""


class FreeModelState(Struct, frozen=True, gc=False):
    """State of a model that follows its bench.

    Attributes:
        t_ns: Time of the last step.
        temperature_c: Last damper temperature.
        first: Of each strut the measurements that arrived before the model started, the oldest
            first.
        observers: State of each strut's observer; empty while the model waits.
        model: The model under its forces; None while it waits for measurements.
        past: The model at the ticks before the last, the newest first, as far back as a measurement
            may be old; empty where none is late.
    """

    t_ns: int
    temperature_c: float
    first: tuple[tuple[Sample, ...], ...]
    observers: tuple[ObserverState, ...] = ()
    model: LoadedModel[ModelState] | None = None
    past: tuple[Instant, ...] = ()


class _Received(Struct, frozen=True, gc=False):
    """Samples of a step, by what they are used for; None where none arrived."""

    heights: Sequence[Sample | None]
    readings: Sequence[Sample]
    applied_n: float | None
    temperature_c: float | None


class FreeModelEstimator:
    """An estimator whose model moves under the applied force.

    Args:
        channels: Channels of the bench; their indices are their positions.
        stale_after_ns: Age up to which a measurement can start the model.

    Raises:
        ValueError: There is not one observer per strut.
    """

    def __init__(
        self,
        plant: AnyPlant,
        observers: Sequence[AnyObserver],
        channels: Sequence[Channel],
        stale_after_ns: int,
    ) -> None:
        if len(observers) != plant.struts:
            raise ValueError(
                f"{len(observers)} observers for {plant.struts} struts, expected one each"
            )
        self._plant = plant
        self._observers = tuple(observers)
        self._channels = tuple(channels)
        self._stale_after_ns = stale_after_ns
        self._routes = [_route(channel) for channel in channels]
        self._heights = {
            channel.strut: channel for channel in channels if channel.role is Role.HEIGHT
        }
        sensors = [channel for channel in channels if channel.role is Role.SENSOR]
        self._sensors = tuple(
            tuple(channel for channel in sensors if channel.strut == strut)
            for strut in range(plant.struts)
        )
        latest = max([item.delay_ns for item in (*self._heights.values(), *sensors)], default=0)
        # A reading lies between two ticks: both are kept for it.
        self._oldest_ns = latest + 1 if sensors else latest

    @property
    def struts(self) -> int:
        return len(self._observers)

    def with_settings(
        self, observers: Sequence[AnyObserver], stale_after_ns: int
    ) -> "FreeModelEstimator":
        return FreeModelEstimator(self._plant, observers, self._channels, stale_after_ns)

    def init(self, t_ns: int) -> FreeModelState:
        return FreeModelState(t_ns, AMBIENT_C, ((),) * self.struts)

    def restart(self, state: FreeModelState, t_ns: int) -> FreeModelState:
        """State that waits for measurements again; the temperature is kept."""
        return FreeModelState(t_ns, state.temperature_c, ((),) * self.struts)

    def discard(self, before: FreeModelState, after: FreeModelState) -> FreeModelState:
        return replace(before, t_ns=after.t_ns)

    def heights_m(self, state: FreeModelState) -> Sequence[float]:
        if state.model is None:
            return ()
        return [height_m for height_m, _ in state.model.state.struts]

    def step(
        self, state: FreeModelState, step_input: StepInput
    ) -> tuple[FreeModelState, Estimate | None]:
        """Advance the model to a time and correct it with what was measured."""
        received = self._sort(step_input.samples)
        if state.model is None:
            return self._try_to_start(state, step_input.t_ns, received)
        return self._observe(state, state.model, step_input.t_ns, received)

    def _sort(self, samples: Sequence[Sample]) -> _Received:
        """Samples by what they are used for; of a quantity of the bench the newest."""
        heights: list[Sample | None] = [None] * len(self._observers)
        readings: list[Sample] = []
        applied_n = temperature_c = None
        routes = self._routes
        for sample in samples:
            route = routes[sample.channel]
            if route >= 0:
                heights[route] = sample
            elif route == _APPLIED:
                applied_n = sample.value
            elif route == _TEMPERATURE:
                temperature_c = sample.value
            elif route == _READING:
                readings.append(sample)
        return _Received(heights, readings, applied_n, temperature_c)

    def _try_to_start(
        self, state: FreeModelState, t_ns: int, received: _Received
    ) -> tuple[FreeModelState, Estimate | None]:
        """Start the model at the measured heights, once every strut has enough of them."""
        required = [observer.measurements_to_start for observer in self._observers]
        first = tuple(
            (*old, new)[-count:] if new is not None and count else old
            for new, old, count in zip(received.heights, state.first, required, strict=True)
        )
        temperature_c = _latest(received.temperature_c, state.temperature_c)
        state = FreeModelState(t_ns, temperature_c, first)
        if not self._can_start(first, required, t_ns):
            return state, None
        starts = [start_of_motion(samples, t_ns) for samples in first]
        heights, velocities = [[item[i] for item in starts] for i in (0, 1)]
        model = self._plant.init(heights, velocities, t_s=t_ns * 1e-9)
        applied_n = _latest(received.applied_n, 0.0)
        loaded = self._plant.load(model, (0.0,) * len(first), applied_n, temperature_c)
        responses = strut_responses(self._plant, heights)
        observers: list[ObserverState] = []
        for strut, observer in enumerate(self._observers):
            measured_ns = first[strut][-1].t_ns if first[strut] else t_ns
            mobility_per_kg, stiffness_per_s2, damping_per_s = responses[strut]
            start = Start(
                measured_ns,
                mobility_per_kg,
                *self._sample_timing(strut),
                stiffness_per_s2,
                damping_per_s,
                self._sensors[strut],
            )
            observers.append(observer.init(start))
        newest_ns = min(samples[-1].t_ns for samples in first if samples)
        return self._estimate(t_ns, tuple(observers), loaded, newest_ns, ())

    def _sample_timing(self, strut: int) -> tuple[int, int]:
        """Interval and delay of a strut's heights in ns; zero where none is measured."""
        channel = self._heights.get(strut)
        return (0, 0) if channel is None else (channel.interval_ns, channel.delay_ns)

    def _can_start(
        self, first: Sequence[tuple[Sample, ...]], required: Sequence[int], t_ns: int
    ) -> bool:
        """Whether every strut has enough measurements, fresh and without a gap.

        A velocity is computed from several: they must belong together.
        """
        for strut, samples in enumerate(first):
            if len(samples) != required[strut]:
                return False
            if samples and samples[-1].t_ns - samples[0].t_ns > (
                2 * len(samples) * self._sample_timing(strut)[0]
            ):
                return False
        newest_ns = min(samples[-1].t_ns for samples in first if samples)
        return not is_too_old(newest_ns, t_ns, self._stale_after_ns)

    def _observe(
        self, state: FreeModelState, loaded: LoadedModel[ModelState], t_ns: int, received: _Received
    ) -> tuple[FreeModelState, Estimate]:
        """Advance the model to the tick and correct it with what was measured."""
        heights, readings = received.heights, received.readings
        applied_n, temperature_c = received.applied_n, received.temperature_c
        if applied_n is None:
            applied_n = loaded.applied_force_n
        if temperature_c is None:
            temperature_c = loaded.temperature_c
        model = self._plant.step(loaded, (t_ns - state.t_ns) * 1e-9, applied_n)
        instants: tuple[Instant, ...] = ()
        further: Sequence[tuple[Innovation, ...]] = ()
        if self._oldest_ns:
            forces_n: Sequence[float] = ()
            if readings:
                no_forces = (0.0,) * self.struts
                forces_n = self._plant.load(model, no_forces, applied_n, temperature_c).forces_n
            instants = self._recent_instants(state, loaded, Instant(t_ns, model.struts, forces_n))
            further = self._compare(readings, instants)
        observers: list[ObserverState] = []
        virtual_n: list[float] = []
        oldest_ns = t_ns
        for strut, observer in enumerate(self._observers):
            measured = heights[strut]
            innovation = None
            if measured is not None:
                measured_ns = measured.t_ns
                model_m = model_height_m(measured_ns, strut, t_ns, model.struts, instants)
                innovation = Innovation(measured.value - model_m, measured_ns)
            before = state.observers[strut]
            if further:
                observed = observer.step(before, t_ns, innovation, further[strut])
            else:
                observed = observer.step(before, t_ns, innovation)
            observers.append(observed)
            virtual_n.append(observed.virtual_force_n)
            oldest_ns = min(oldest_ns, observed.measured_ns)
        loaded = self._plant.load(model, virtual_n, applied_n, temperature_c)
        past = instants[1:] if instants else state.past
        return self._estimate(t_ns, tuple(observers), loaded, oldest_ns, past)

    def _recent_instants(
        self, state: FreeModelState, before: LoadedModel[ModelState], now: Instant
    ) -> tuple[Instant, ...]:
        """The model now and before, as far back as a measurement may be old."""
        oldest_ns = now.t_ns - self._oldest_ns
        kept = [now]
        for instant in (Instant(state.t_ns, before.state.struts, before.forces_n), *state.past):
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
        t_ns: int,
        observers: tuple[ObserverState, ...],
        loaded: LoadedModel[ModelState],
        measured_ns: int,
        past: tuple[Instant, ...],
    ) -> tuple[FreeModelState, Estimate]:
        """State and estimate at the end of a step."""
        struts: list[StrutOutput] = []
        left_out: tuple[int, ...] = ()
        size = loaded.applied_force_n
        for strut, observer in enumerate(observers):
            height_m, velocity_m_per_s = loaded.state.struts[strut]
            law_force_n = loaded.forces_n[strut]
            force_n = law_force_n + observer.residual_force_n
            output = StrutOutput(
                force_n,
                observer.virtual_force_n,
                True,
                height_m,
                velocity_m_per_s,
                loaded.accelerations_m_per_s2[strut],
                observer.innovation_m,
                observer.force_std_n,
                law_force_n,
            )
            struts.append(output)
            size += force_n + height_m + velocity_m_per_s
            if self._sensors[strut]:
                left_out += observer.left_out
        # A model that has diverged is of no use, and would not come back by itself. DART hides it:
        # what is not finite has an acceleration of zero there.
        diverged = -1 if is_sensible(size) else find_divergence(struts)
        state = FreeModelState(t_ns, loaded.temperature_c, (), observers, loaded, past)
        return state, Estimate(tuple(struts), measured_ns, diverged, left_out)


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


def _route(channel: Channel) -> int:
    """Route of a channel's samples: the index of the strut of a height, else one of the above."""
    if channel.role is Role.HEIGHT:
        return channel.strut
    if channel.role is Role.SENSOR:
        return _READING
    return {APPLIED_FORCE: _APPLIED, TEMPERATURE: _TEMPERATURE}.get(channel.quantity, _UNUSED)


def _latest(new: float | None, old: float) -> float:
    return old if new is None else new
