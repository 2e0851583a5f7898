"""One tick: advance the model, compare it with the bench, correct it, publish."""

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dart_model.effects import AMBIENT_C
from rig.bridge.contract import (
    CoreState,
    Deviation,
    Divergence,
    FusingObserver,
    Innovation,
    LoadedModel,
    Measurement,
    Measures,
    Mode,
    Observer,
    Plant,
    Reading,
    Sensor,
    Start,
    StepInput,
    StepOutput,
    StrutOutput,
    is_sensible,
)
from rig.bridge.supervisor import Event, Supervision, age_event, mode_at_age, next_mode
from rig.closed_loop.derivatives import slopes


class Instant(NamedTuple):
    """The model at a time.

    Attributes:
        t_ns: The time.
        struts: Height (m) and velocity (m/s) of each strut.
        forces_n: Force of each strut's law; empty where nobody asks for it.
    """

    t_ns: int
    struts: Sequence[tuple[float, float]]
    forces_n: Sequence[float]


class RigState(CoreState, frozen=True, gc=False, kw_only=True):
    """State of a bridge whose model runs by itself.

    Attributes:
        observers: State of each strut's observer; empty before the first measurements.
        first: Of each strut the measurements that came before the model started, the oldest first.
        model: The model under its forces; None before the first measurements.
        past: The model at the ticks before the last, the newest first, as far back as a measurement
            may be old; empty where none comes late.
    """

    observers: tuple[Any, ...] = ()
    first: tuple[tuple[Measurement, ...], ...]
    model: Any = None
    past: tuple[Instant, ...] = ()


_SECANT_M, _SECANT_M_PER_S = 2e-3, 0.1
"""Of the law's secants: a share of a usual stroke and speed, so that friction, which is infinitely
steep at rest, counts as what it is on the way."""

_SECANT_N = 1.0
"""Of the force, whose answer is linear."""


class Arrival(NamedTuple):
    """How the measurements of a strut come.

    Attributes:
        interval_ns: Time between two.
        delay_ns: How much later one comes than it is true.
    """

    interval_ns: int = 1_000_000
    delay_ns: int = 0


class RigCore:
    """The bridge's arithmetic where the force is given and the model runs by itself.

    At a tick the model is first advanced to the tick's time under the forces of the last one, so
    that the applied force may be linear between its two samples; then the new measurement, if there
    is one, is compared with it. Nothing waits for the next tick.

    Args:
        plant: The model.
        observers: One for each of the model's struts, in their order.
        supervision: Ages and safe output.
        arrivals: How each strut's measurements come; one a millisecond, at once, if absent.
        sensors: Sensors beside the heights.

    Raises:
        ValueError: There are more or fewer observers than struts.
    """

    def __init__(
        self,
        plant: Plant,
        observers: Sequence[Observer],
        supervision: Supervision,
        arrivals: Sequence[Arrival] | None = None,
        sensors: Sequence[Sensor] = (),
    ) -> None:
        if len(observers) != plant.struts:
            raise ValueError(
                f"{len(observers)} observers for {plant.struts} struts, expected one each"
            )
        self._plant = plant
        self._observers = tuple(observers)
        self._supervision = supervision
        self._arrivals = tuple(arrivals or [Arrival()] * len(observers))
        self._sensors = tuple(sensors)
        self._is_fusing = tuple(bool(self._at(strut)) for strut in range(plant.struts))
        latest = max([item.delay_ns for item in (*self._arrivals, *self._sensors)])
        # A reading lies between two ticks: both are kept for it.
        self._oldest_ns = latest + 1 if sensors else latest

    @property
    def struts(self) -> int:
        """Number of struts, each with an observer."""
        return len(self._observers)

    def changed(self, observers: Sequence[Observer], supervision: Supervision) -> "RigCore":
        """The same model with other observers and supervision."""
        return RigCore(self._plant, observers, supervision, self._arrivals, self._sensors)

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        return RigState(t_ns, Mode.WAITING, AMBIENT_C, first=((),) * self.struts)

    def step(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Advance by one tick.

        Args:
            state: State after the last tick.
            step_input: What came since then.

        Returns:
            State after this tick, and what it publishes.
        """
        if state.mode is Mode.RUNNING:
            return self._observe(state, state.model, step_input)
        if state.mode is Mode.SAFE and step_input.acknowledged:
            mode = next_mode(state.mode, Event.ACKNOWLEDGED)
            state = replace(state, mode=mode, first=((),) * self.struts)
        if state.mode is Mode.WAITING:
            return self._try_to_start(state, step_input)
        if state.model is None or state.mode is Mode.SAFE:
            state = replace(state, t_ns=step_input.t_ns)
            return state, self._safe_output(state)
        return self._observe(state, state.model, step_input)

    def _try_to_start(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Start the model at the measured heights, once every strut has enough of them."""
        t_ns = step_input.t_ns
        wanted = [observer.first_measurements for observer in self._observers]
        first = tuple(
            (*old, new)[-count:] if new is not None and count else old
            for new, old, count in zip(step_input.heights, state.first, wanted, strict=True)
        )
        temperature_c = _latest(step_input.temperature_c, state.temperature_c)
        state = replace(state, t_ns=t_ns, first=first, temperature_c=temperature_c)
        if not self._belong_together(first):
            return state, StepOutput(state.mode, ())
        is_enough = all(len(given) == count for given, count in zip(first, wanted, strict=True))
        newest = [given[-1] for given in first if given]
        if not is_enough or not self._fresh(newest, t_ns):
            return state, StepOutput(state.mode, ())
        started = [started_at(given, t_ns) for given in first]
        heights, velocities = [[item[i] for item in started] for i in (0, 1)]
        model = self._plant.init(heights, velocities, t_s=t_ns * 1e-9)
        applied_n = _latest(step_input.applied_force_n, 0.0)
        without = (0.0,) * len(first)
        loaded = self._plant.load(model, without, applied_n, temperature_c)
        answers = strut_answers(self._plant, heights)
        starts_ns = [given[-1].t_ns if given else t_ns for given in first]
        observers = tuple(
            observer.init(
                Start(starts_ns[i], answers[i][0], *arrival, *answers[i][1:], self._at(i))
            )
            for i, (observer, arrival) in enumerate(
                zip(self._observers, self._arrivals, strict=True)
            )
        )
        mode = next_mode(state.mode, Event.FRESH)
        return self._published(state, t_ns, mode, observers, loaded)

    def _at(self, strut: int) -> tuple[tuple[int, Sensor], ...]:
        """Further sensors of a strut, by their places."""
        return tuple(item for item in enumerate(self._sensors) if item[1].strut == strut)

    def _belong_together(self, first: Sequence[tuple[Measurement, ...]]) -> bool:
        """Whether no strut's measurements have a break: a velocity is taken from them."""
        return all(
            given[-1].t_ns - given[0].t_ns <= 2 * len(given) * arrival.interval_ns
            for given, arrival in zip(first, self._arrivals, strict=True)
            if given
        )

    def _fresh(self, measurements: list[Measurement], t_ns: int) -> bool:
        oldest_ns = min(item.t_ns for item in measurements)
        return age_event(self._supervision, t_ns - oldest_ns) is Event.FRESH

    def _observe(
        self, state: RigState, loaded: LoadedModel, step_input: StepInput
    ) -> tuple[RigState, StepOutput]:
        """Advance the model to the tick and correct it with what was measured."""
        t_ns = step_input.t_ns
        applied_n = _latest(step_input.applied_force_n, loaded.applied_force_n)
        temperature_c = _latest(step_input.temperature_c, loaded.temperature_c)
        model = self._plant.step(loaded, (t_ns - state.t_ns) * 1e-9, applied_n)
        observers: list[Any] = []
        virtual_n: list[float] = []
        oldest_ns = t_ns
        instants: tuple[Instant, ...] = ()
        deviations: list[tuple[Deviation, ...]] | None = None
        if self._oldest_ns:
            forces_n: Sequence[float] = ()
            if step_input.readings:
                nothing = (0.0,) * self.struts
                forces_n = self._plant.load(model, nothing, applied_n, temperature_c).forces_n
            instants = self._remembered(state, Instant(t_ns, model.struts, forces_n))
            deviations = self._deviations(step_input.readings, instants)
        for index, observer in enumerate(self._observers):
            measured = step_input.heights[index]
            innovation = None
            if measured is not None:
                model_m = _height_at(measured.t_ns, index, t_ns, model.struts, instants)
                innovation = Innovation(measured.height_m - model_m, measured.t_ns)
            before = state.observers[index]
            if self._is_fusing[index]:
                given = deviations[index] if deviations else ()
                observed = cast("FusingObserver", observer).fuse(before, t_ns, innovation, given)
            else:
                observed = observer.step(before, t_ns, innovation)
            observers.append(observed)
            virtual_n.append(observed.virtual_force_n)
            oldest_ns = min(oldest_ns, observed.measured_ns)
        loaded = self._plant.load(model, virtual_n, applied_n, temperature_c)
        mode = mode_at_age(self._supervision, state.mode, t_ns - oldest_ns)
        if instants:
            state = replace(state, past=instants[1:])
        return self._published(state, t_ns, mode, tuple(observers), loaded)

    def _remembered(self, state: RigState, now: Instant) -> tuple[Instant, ...]:
        """The model now and before, as far back as a measurement may be old."""
        oldest_ns = now.t_ns - self._oldest_ns
        before = state.model
        kept = [now]
        for instant in (Instant(state.t_ns, before.state.struts, before.forces_n), *state.past):
            if kept[-1].t_ns <= oldest_ns:
                break
            kept.append(instant)
        return tuple(kept)

    def _deviations(
        self, readings: Sequence[Reading], instants: Sequence[Instant]
    ) -> list[tuple[Deviation, ...]] | None:
        """Readings held against the model, by strut; None where there are none."""
        if not readings:
            return None
        found: list[tuple[Deviation, ...]] = [()] * self.struts
        for reading in readings:
            sensor = self._sensors[reading.sensor]
            value = reading.value - _model_at(reading.t_ns, sensor, instants)
            found[sensor.strut] += (Deviation(reading.sensor, value, reading.t_ns),)
        return found

    def _published(
        self,
        before: RigState,
        t_ns: int,
        mode: Mode,
        observers: tuple[Any, ...],
        loaded: LoadedModel,
    ) -> tuple[RigState, StepOutput]:
        """State and output at the end of a tick."""
        valid = mode is Mode.RUNNING
        struts: list[StrutOutput] = []
        size = loaded.applied_force_n
        for index, observer in enumerate(observers):
            height_m, velocity_m_per_s = loaded.state.struts[index]
            law_force_n = loaded.forces_n[index]
            force_n = law_force_n + observer.residual_force_n
            strut = StrutOutput(
                force_n,
                observer.virtual_force_n,
                valid,
                height_m,
                velocity_m_per_s,
                loaded.accelerations_m_per_s2[index],
                observer.innovation_m,
                observer.force_std_n,
                law_force_n,
            )
            struts.append(strut)
            size += force_n + height_m + velocity_m_per_s
        # A model that has diverged says nothing of use, and would not come back by itself. DART
        # hides it: what is not finite has an acceleration of zero there.
        if not is_sensible(size):
            before = replace(before, diverged=Divergence(_first_diverged(struts), t_ns))
        if mode is Mode.SAFE or not is_sensible(size):
            state = replace(before, t_ns=t_ns, mode=Mode.SAFE)
            return state, self._safe_output(state)
        published = tuple(struts)
        state = RigState(
            t_ns,
            mode,
            loaded.temperature_c,
            published if valid else before.last_valid,
            before.diverged,
            observers=observers,
            first=before.first,
            model=loaded,
            past=before.past,
        )
        left_out: tuple[int, ...] = ()
        if self._sensors:
            fusing = itertools.compress(observers, self._is_fusing)
            left_out = tuple(place for observer in fusing for place in observer.left_out)
        return state, StepOutput(mode, published, left_out)

    def _safe_output(self, state: RigState) -> StepOutput:
        """The defined output of the safe state: the model stands still where it was left."""
        if state.model is None:
            return StepOutput(state.mode, ())
        forces = [0.0] * self.struts
        if self._supervision.safe_holds_last and state.last_valid:
            forces = [strut.force_n for strut in state.last_valid]
        struts = tuple(
            StrutOutput(force_n, 0.0, False, height_m, 0.0, 0.0, 0.0)
            for force_n, (height_m, _) in zip(forces, state.model.state.struts, strict=True)
        )
        return StepOutput(state.mode, struts)


def started_at(measurements: Sequence[Measurement], t_ns: int) -> tuple[float, float]:
    """Height and velocity at a time, from the measurements before it.

    Args:
        measurements: One: the model starts at rest there. Three or more: a parabola through them.
            None: NaN, the strut starts where the others leave it.
        t_ns: The time.
    """
    if not measurements:
        return math.nan, 0.0
    if len(measurements) == 1:
        return measurements[0].height_m, 0.0
    since_s = [(item.t_ns - t_ns) * 1e-9 for item in measurements]
    longest_s = max(map(abs, since_s))
    share = np.array(since_s) / longest_s
    heights = np.array([item.height_m for item in measurements])
    powers = np.column_stack([np.ones_like(share), share, share * share])
    height, slope, _ = np.linalg.lstsq(powers, heights, rcond=None)[0]
    return float(height), float(slope) / longest_s


class Answer(NamedTuple):
    """How the acceleration of a strut's height answers to that strut alone.

    Attributes:
        mobility_per_kg: To a newton in the strut.
        stiffness_per_s2: To a metre of height, with the other sign.
        damping_per_s: To a metre per second, with the other sign.
    """

    mobility_per_kg: float
    stiffness_per_s2: float
    damping_per_s: float


def strut_answers(plant: Plant, heights_m: Sequence[float]) -> list[Answer]:
    """How a model answers at rest at some heights, by secants of its accelerations."""
    return [_strut_answer(plant, np.asarray(heights_m), index) for index in range(plant.struts)]


def _strut_answer(plant: Plant, heights_m: NDArray[np.float64], index: int) -> Answer:
    alone = np.eye(plant.struts)[index]

    def acceleration(u: NDArray[np.float64]) -> NDArray[np.float64]:
        force_n, height_m, velocity_m_per_s = u.tolist()
        heights, velocities = heights_m + height_m * alone, velocity_m_per_s * alone
        state = plant.init(heights.tolist(), velocities.tolist())
        loaded = plant.load(state, (force_n * alone).tolist(), 0.0, AMBIENT_C)
        return np.array([loaded.accelerations_m_per_s2[index]])

    ((mobility, stiffness, damping),) = slopes(
        acceleration, (_SECANT_N, _SECANT_M, _SECANT_M_PER_S)
    ).tolist()
    return Answer(mobility, -stiffness, -damping)


def _height_at(
    measured_ns: int,
    index: int,
    t_ns: int,
    struts: Sequence[tuple[float, float]],
    instants: Sequence[Instant],
) -> float:
    """Height of the model when a measurement was true, to first order from the tick behind it."""
    for earlier in instants:
        if earlier.t_ns < measured_ns:
            break
        t_ns, struts = earlier.t_ns, earlier.struts
    height_m, velocity_m_per_s = struts[index]
    return height_m - velocity_m_per_s * (t_ns - measured_ns) * 1e-9


def _model_at(t_ns: int, sensor: Sensor, instants: Sequence[Instant]) -> float:
    """What a sensor of the model would have read: velocity and force between two ticks."""
    now, strut = instants[0], sensor.strut
    if sensor.measures is Measures.HEIGHT:
        return _height_at(t_ns, strut, now.t_ns, now.struts, instants)
    before = after = now
    for before in instants[1:]:
        if before.t_ns <= t_ns:
            break
        after = before
    values = [
        at.forces_n[strut] if sensor.measures is Measures.FORCE else at.struts[strut][1]
        for at in (before, after)
    ]
    if after.t_ns == before.t_ns:
        return values[1]
    share = min(max((t_ns - before.t_ns) / (after.t_ns - before.t_ns), 0.0), 1.0)
    return values[0] + share * (values[1] - values[0])


def _first_diverged(struts: Sequence[StrutOutput]) -> int:
    """Index of the first strut whose numbers no bench has; the first one if it is none of them."""
    for index, strut in enumerate(struts):
        if not is_sensible(strut.force_n + strut.height_m + strut.velocity_m_per_s):
            return index
    return 0


def _latest(new: float | None, old: float) -> float:
    return old if new is None else new
