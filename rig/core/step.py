"""One tick: advance the model, compare it with the bench, correct it, publish."""

from collections.abc import Sequence
from typing import Any

from msgspec.structs import replace

from rig.core.contract import (
    AMBIENT_C,
    CoreState,
    Divergence,
    LoadedModel,
    Measurement,
    Mode,
    Observer,
    Plant,
    StepInput,
    StepOutput,
    StrutOutput,
    is_sensible,
)
from rig.core.supervisor import Event, Supervision, age_event, mode_at_age, next_mode


class RigState(CoreState, frozen=True, gc=False, kw_only=True):
    """State of a bridge whose model runs by itself.

    Attributes:
        observers: State of each strut's observer; empty before the first measurements.
        first: Measurements that came before every strut had one.
        model: The model under its forces; None before the first measurements.
    """

    observers: tuple[Any, ...] = ()
    first: tuple[Measurement | None, ...]
    model: Any = None


class RigCore:
    """The bridge's arithmetic where the force is given and the model runs by itself.

    At a tick the model is first advanced to the tick's time under the forces of the last one, so
    that the applied force may be linear between its two samples; then the new measurement, if there
    is one, is compared with it. Nothing waits for the next tick.

    Args:
        plant: The model.
        observers: One for each of the model's struts, in their order.
        supervision: Ages and safe output.

    Raises:
        ValueError: There are more or fewer observers than struts.
    """

    def __init__(
        self, plant: Plant, observers: Sequence[Observer], supervision: Supervision
    ) -> None:
        if len(observers) != plant.struts:
            raise ValueError(
                f"{len(observers)} observers for {plant.struts} struts, expected one each"
            )
        self._plant = plant
        self._observers = tuple(observers)
        self._supervision = supervision

    @property
    def struts(self) -> int:
        """Number of struts, each with an observer."""
        return len(self._observers)

    def changed(self, observers: Sequence[Observer], supervision: Supervision) -> "RigCore":
        """The same model with other observers and supervision."""
        return RigCore(self._plant, observers, supervision)

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        return RigState(t_ns, Mode.WAITING, AMBIENT_C, first=(None,) * self.struts)

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
            state = replace(state, mode=mode, first=(None,) * self.struts)
        if state.mode is Mode.WAITING:
            return self._try_to_start(state, step_input)
        if state.model is None or state.mode is Mode.SAFE:
            state = replace(state, t_ns=step_input.t_ns)
            return state, self._safe_output(state)
        return self._observe(state, state.model, step_input)

    def _try_to_start(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Start the model at rest at the first measured heights, once every strut has one."""
        t_ns = step_input.t_ns
        first = tuple(new or old for new, old in zip(step_input.heights, state.first, strict=True))
        temperature_c = _latest(step_input.temperature_c, state.temperature_c)
        state = replace(state, t_ns=t_ns, first=first, temperature_c=temperature_c)
        measurements = [item for item in first if item is not None]
        if len(measurements) < len(first) or not self._fresh(measurements, t_ns):
            return state, StepOutput(state.mode, ())
        observers = tuple(
            observer.init(item)
            for observer, item in zip(self._observers, measurements, strict=True)
        )
        model = self._plant.init([item.height_m for item in measurements], t_s=t_ns * 1e-9)
        applied_n = _latest(step_input.applied_force_n, 0.0)
        loaded = self._plant.load(model, (0.0,) * len(first), applied_n, temperature_c)
        mode = next_mode(state.mode, Event.FRESH)
        return self._published(state, t_ns, mode, observers, loaded)

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
        for index, observer in enumerate(self._observers):
            height_m, velocity_m_per_s = model.struts[index]
            observed = observer.step(
                state.observers[index], t_ns, height_m, velocity_m_per_s, step_input.heights[index]
            )
            observers.append(observed)
            virtual_n.append(observed.virtual_force_n)
            oldest_ns = min(oldest_ns, observed.measured_ns)
        loaded = self._plant.load(model, virtual_n, applied_n, temperature_c)
        mode = mode_at_age(self._supervision, state.mode, t_ns - oldest_ns)
        return self._published(state, t_ns, mode, tuple(observers), loaded)

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
            force_n = loaded.forces_n[index] + observer.virtual_force_n
            strut = StrutOutput(
                force_n,
                observer.virtual_force_n,
                valid,
                height_m,
                velocity_m_per_s,
                loaded.accelerations_m_per_s2[index],
                observer.innovation_m,
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
        )
        return state, StepOutput(mode, published)

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


def _first_diverged(struts: Sequence[StrutOutput]) -> int:
    """Index of the first strut whose numbers no bench has; the first one if it is none of them."""
    for index, strut in enumerate(struts):
        if not is_sensible(strut.force_n + strut.height_m + strut.velocity_m_per_s):
            return index
    return 0


def _latest(new: float | None, old: float) -> float:
    return old if new is None else new
