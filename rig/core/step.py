"""One tick: advance the model, compare it with the bench, correct it, publish."""

from msgspec.structs import replace

from dart_model.plant import DartPlant, Loaded
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

_SENSELESS = 1e12
"""No bench has heights, velocities or forces of this size: the model has diverged."""

# Looking up a member of an enum costs as much as the observer.
_RUNNING, _WAITING, _SAFE = Mode.RUNNING, Mode.WAITING, Mode.SAFE


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
        # Made once: `enumerate` would make an object for each strut at every tick.
        self._indices = tuple(range(len(gains)))
        self._supervision = supervision

    @property
    def struts(self) -> int:
        """Number of struts, each with an observer."""
        return len(self._gains)

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        nothing = (None,) * len(self._gains)
        return RigState(t_ns, Mode.WAITING, (), nothing, None, _AMBIENT_C, ())

    def step(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Advance by one tick.

        Args:
            state: State after the last tick.
            step_input: What came since then.

        Returns:
            State after this tick, and what it publishes.
        """
        mode, model = state.mode, state.model
        if mode is _RUNNING and model is not None:
            return self._observe(state, model, step_input)
        if mode is _SAFE and step_input.acknowledged:
            mode = next_mode(mode, Event.ACKNOWLEDGED)
            state = replace(state, mode=mode, first=(None,) * len(self._gains))
        if mode is _WAITING:
            return self._try_to_start(state, step_input)
        if model is None or mode is _SAFE:
            state = replace(state, t_ns=step_input.t_ns)
            return state, self._safe_output(state)
        return self._observe(state, model, step_input)

    def _try_to_start(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Start the model at rest at the first measured heights, once every strut has one."""
        t_ns = step_input.t_ns
        first = tuple(
            [new or old for new, old in zip(step_input.heights, state.first, strict=True)]
        )
        temperature_c = _latest(step_input.temperature_c, state.temperature_c)
        state = replace(state, t_ns=t_ns, first=first, temperature_c=temperature_c)
        measurements = [item for item in first if item is not None]
        if len(measurements) < len(first) or not self._fresh(measurements, t_ns):
            return state, StepOutput(state.mode, ())
        observers = tuple([ObserverState(0.0, 0.0, 0.0, item.t_ns) for item in measurements])
        plant_state = self._plant.initial([item.height_m for item in measurements])
        plant_state = replace(plant_state, t_s=t_ns * 1e-9)
        applied_n = _latest(step_input.applied_force_n, 0.0)
        loaded = self._plant.load(plant_state, (0.0,) * len(first), applied_n, temperature_c)
        mode = next_mode(state.mode, Event.FRESH)
        return self._published(state, t_ns, mode, observers, loaded)

    def _fresh(self, measurements: list[Measurement], t_ns: int) -> bool:
        oldest_ns = min(item.t_ns for item in measurements)
        return age_event(self._supervision, t_ns - oldest_ns) is Event.FRESH

    def _observe(
        self, state: RigState, loaded: Loaded, step_input: StepInput
    ) -> tuple[RigState, StepOutput]:
        """Advance the model to the tick and correct it with what was measured."""
        plant, t_ns, applied_n = self._plant, step_input.t_ns, step_input.applied_force_n
        if applied_n is None:
            applied_n = loaded.applied_force_n
        temperature_c = step_input.temperature_c
        if temperature_c is None:
            temperature_c = loaded.temperature_c
        plant_state = plant.step(loaded, (t_ns - state.t_ns) * 1e-9, applied_n)
        # Tuples that grow: for the few struts that there are, less work than lists made tuples.
        observers: tuple[ObserverState, ...] = ()
        virtual: tuple[float, ...] = ()
        oldest_ns = t_ns
        for index in self._indices:
            observer, measured = state.observers[index], step_input.heights[index]
            if measured is not None:
                height_m, velocity_m_per_s = plant_state.struts[index]
                measured_ns = measured.t_ns
                # The model's height when the measurement was true, to first order.
                model_m = height_m - velocity_m_per_s * (t_ns - measured_ns) * 1e-9
                observer = update(
                    self._gains[index], observer, measured.height_m - model_m, measured_ns
                )
            observers += (observer,)
            virtual += (observer.virtual_force_n,)
            if observer.measured_ns < oldest_ns:
                oldest_ns = observer.measured_ns
        loaded = plant.load(plant_state, virtual, applied_n, temperature_c)
        mode, age_ns = state.mode, t_ns - oldest_ns
        if mode is not _RUNNING or age_ns > self._supervision.stale_after_ns:
            mode = next_mode(mode, age_event(self._supervision, age_ns))
        return self._published(state, t_ns, mode, observers, loaded)

    def _published(
        self,
        before: RigState,
        t_ns: int,
        mode: Mode,
        observers: tuple[ObserverState, ...],
        loaded: Loaded,
    ) -> tuple[RigState, StepOutput]:
        """State and output at the end of a tick."""
        valid, total = mode is _RUNNING, loaded.applied_force_n
        motions, forces = loaded.state.struts, loaded.forces_n
        accelerations = loaded.accelerations_m_per_s2
        struts: tuple[StrutOutput, ...] = ()
        for index in self._indices:
            observer = observers[index]
            height_m, velocity_m_per_s = motions[index]
            virtual_n = observer.virtual_force_n
            force_n = forces[index] + virtual_n
            total += force_n + height_m + velocity_m_per_s
            strut = StrutOutput(
                force_n,
                virtual_n,
                valid,
                height_m,
                velocity_m_per_s,
                accelerations[index],
                observer.innovation_m,
            )
            struts += (strut,)
        # A model that has diverged says nothing of use, and would not come back by itself. DART
        # hides it: what is not finite has an acceleration of zero there.
        if mode is _SAFE or not -_SENSELESS < total < _SENSELESS:
            state = replace(before, t_ns=t_ns, mode=Mode.SAFE)
            return state, self._safe_output(state)
        last_valid = struts if valid else before.last_valid
        temperature_c = loaded.temperature_c
        state = RigState(t_ns, mode, observers, before.first, loaded, temperature_c, last_valid)
        return state, StepOutput(mode, struts)

    def _safe_output(self, state: RigState) -> StepOutput:
        """The defined output of the safe state: the model stands still where it was left."""
        if state.model is None:
            return StepOutput(state.mode, ())
        forces = [0.0] * len(self._gains)
        if self._supervision.safe_holds_last and state.last_valid:
            forces = [strut.force_n for strut in state.last_valid]
        struts = tuple(
            [
                StrutOutput(force, 0.0, False, height_m, 0.0, 0.0, 0.0)
                for force, (height_m, _) in zip(forces, state.model.state.struts, strict=True)
            ]
        )
        return StepOutput(state.mode, struts)


def _latest(new: float | None, old: float) -> float:
    return old if new is None else new
