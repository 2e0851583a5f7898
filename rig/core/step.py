"""One tick: advance the model, compare it with the bench, correct it, publish."""

from math import isfinite

from dart_model.plant import DartPlant, Loaded, PlantState
from rig.core.observer import ObserverGains, update
from rig.core.supervisor import Event, Supervision, age_event, next_mode
from rig.core.types import (
    Measurement,
    Mode,
    ObserverState,
    RigState,
    StepInput,
    StepOutput,
    StrutOutput,
)

_AMBIENT_C = 20.0


class RigCore:
    """The bridge's arithmetic, without bus, clock or file.

    At a tick the model is first advanced to the tick's time under the forces of the last one, so
    that the applied force may be linear between its two samples; then the new measurement, if there
    is one, is compared with it. Nothing waits for the next tick.

    Args:
        plant: The model.
        gains: One observer for each of the model's struts, in their order.
        supervision: Ages and safe output.
    """

    def __init__(
        self, plant: DartPlant, gains: tuple[ObserverGains, ...], supervision: Supervision
    ) -> None:
        if len(gains) != len(plant.spec.struts):
            raise ValueError(
                f"{len(gains)} observers for {len(plant.spec.struts)} struts, expected one each"
            )
        self._plant = plant
        self._gains = gains
        self._supervision = supervision

    @property
    def struts(self) -> int:
        """Number of struts, each with an observer."""
        return len(self._gains)

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        count = len(self._gains)
        return RigState(
            t_ns, Mode.WAITING, (), (None,) * count, None, _AMBIENT_C, (0.0,) * count
        )

    def step(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Advance by one tick.

        Args:
            state: State after the last tick.
            step_input: What came since then.

        Returns:
            State after this tick, and what it publishes.
        """
        if state.mode is Mode.SAFE and step_input.acknowledged:
            mode = next_mode(state.mode, Event.ACKNOWLEDGED)
            state = state._replace(mode=mode, first=(None,) * len(self._gains))
        if state.mode is Mode.WAITING:
            return self._try_to_start(state, step_input)
        if state.model is None or state.mode is Mode.SAFE:
            state = state._replace(t_ns=step_input.t_ns)
            return state, self._safe_output(state)
        return self._observe(state, state.model, step_input)

    def _try_to_start(
        self, state: RigState, step_input: StepInput
    ) -> tuple[RigState, StepOutput]:
        """Start the model at rest at the first measured heights, once every strut has one."""
        first = tuple(
            [new or old for new, old in zip(step_input.heights, state.first, strict=True)]
        )
        temperature_c = _latest(step_input.temperature_c, state.temperature_c)
        state = state._replace(t_ns=step_input.t_ns, first=first, temperature_c=temperature_c)
        measurements = [item for item in first if item is not None]
        if len(measurements) < len(first) or not self._fresh(measurements, step_input.t_ns):
            return state, StepOutput(state.mode, ())
        observers = tuple([ObserverState(0.0, 0.0, 0.0, item.t_ns) for item in measurements])
        plant_state = self._plant.initial([item.height_m for item in measurements])
        plant_state = plant_state._replace(t_s=step_input.t_ns * 1e-9)
        applied_n = _latest(step_input.applied_force_n, 0.0)
        return self._publish(
            step_input.t_ns,
            next_mode(state.mode, Event.FRESH),
            observers,
            plant_state,
            applied_n,
            temperature_c,
            state,
        )

    def _fresh(self, measurements: list[Measurement], t_ns: int) -> bool:
        oldest_ns = min(item.t_ns for item in measurements)
        return age_event(self._supervision, t_ns - oldest_ns) is Event.FRESH

    def _observe(
        self, state: RigState, loaded: Loaded, step_input: StepInput
    ) -> tuple[RigState, StepOutput]:
        """Advance the model to the tick and correct it with what was measured."""
        t_ns = step_input.t_ns
        applied_n = _latest(step_input.applied_force_n, loaded.applied_force_n)
        temperature_c = _latest(step_input.temperature_c, state.temperature_c)
        plant_state = self._plant.step(loaded, (t_ns - state.t_ns) * 1e-9, applied_n)
        observers = state.observers
        if any(step_input.heights):
            motions = self._plant.motions(plant_state, applied_n, temperature_c)
            observers = tuple(
                [
                    observer
                    if new is None
                    else update(
                        gains,
                        observer,
                        # The model's height when the measurement was true, to first order.
                        new.height_m
                        - motion.height_m
                        + motion.velocity_m_per_s * (t_ns - new.t_ns) * 1e-9,
                        new.t_ns,
                    )
                    for gains, observer, new, motion in zip(
                        self._gains, state.observers, step_input.heights, motions, strict=True
                    )
                ]
            )
        oldest_ns = min([observer.measured_ns for observer in observers])
        mode = next_mode(state.mode, age_event(self._supervision, t_ns - oldest_ns))
        return self._publish(
            t_ns, mode, observers, plant_state, applied_n, temperature_c, state
        )

    def _publish(
        self,
        t_ns: int,
        mode: Mode,
        observers: tuple[ObserverState, ...],
        plant_state: PlantState,
        applied_n: float,
        temperature_c: float,
        before: RigState,
    ) -> tuple[RigState, StepOutput]:
        plant = self._plant
        virtual = [observer.virtual_force_n for observer in observers]
        loaded = plant.load(plant_state, virtual, applied_n, temperature_c)
        motions = plant.motions(plant_state, applied_n, temperature_c)
        accelerations = plant.accelerations(loaded)
        valid = mode is Mode.RUNNING
        struts = tuple(
            [
                StrutOutput(
                    motion.force_n + observer.virtual_force_n,
                    observer.virtual_force_n,
                    valid,
                    motion.height_m,
                    motion.velocity_m_per_s,
                    acceleration,
                    observer.innovation_m,
                )
                for motion, observer, acceleration in zip(
                    motions, observers, accelerations, strict=True
                )
            ]
        )
        published = tuple([strut.force_n for strut in struts]) if valid else before.published_n
        # A model that has diverged says nothing of use, and would not come back by itself.
        if mode is Mode.SAFE or not all([isfinite(item) for item in accelerations]):
            state = before._replace(t_ns=t_ns, mode=Mode.SAFE, observers=observers)
            return state, self._safe_output(state)
        state = RigState(t_ns, mode, observers, before.first, loaded, temperature_c, published)
        return state, StepOutput(mode, struts)

    def _safe_output(self, state: RigState) -> StepOutput:
        """The defined output of the safe state: the model stands still where it was left."""
        if state.model is None:
            return StepOutput(state.mode, ())
        holds_last = self._supervision.safe_holds_last
        motions = self._plant.motions(
            state.model.state, state.model.applied_force_n, state.temperature_c
        )
        struts = tuple(
            [
                StrutOutput(force if holds_last else 0.0, 0.0, False, motion.height_m, 0.0, 0.0, 0.0)
                for force, motion in zip(state.published_n, motions, strict=True)
            ]
        )
        return StepOutput(state.mode, struts)


def _latest(new: float | None, old: float) -> float:
    return old if new is None else new
