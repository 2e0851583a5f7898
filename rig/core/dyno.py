"""One tick at a dyno: the motion is imposed, and the load cell measures what it takes.

The model does not run by itself: DART is driven along the measured motion, and the virtual force
is what the load cell shows beyond the model's own law. The motion between and at measurements is
followed by a filter with fading memory, which has no lag for a constant acceleration.

Reference: Morrison, "Introduction to Sequential Smoothing and Prediction" (1969), chapter 13: the
fading-memory polynomial filter of second degree.
"""

import math

from msgspec import Struct
from msgspec.structs import replace

from dart_model.plant import DartPlant
from rig.core.supervisor import Event, Supervision, age_event, next_mode
from rig.core.types import Measurement, Mode, RigState, StepInput, StepOutput, StrutOutput

_AMBIENT_C = 20.0
_LONGEST_MEMORY_STEP_S = 0.5e-3
_MOST_MEMORY_STEPS = 1000
_SENSELESS = 1e12


class Tracked(Struct, frozen=True, gc=False):
    """The motion as far as it is known.

    Attributes:
        height_m: Height at the last measurement.
        velocity_m_per_s: Its rate.
        acceleration_m_per_s2: Its second derivative.
        innovation_m: Last measured less predicted height.
        measured_ns: Time of the last measurement.
    """

    height_m: float
    velocity_m_per_s: float
    acceleration_m_per_s2: float
    innovation_m: float
    measured_ns: int


class DynoState(RigState, frozen=True, gc=False):
    """State between two ticks at a dyno.

    Attributes:
        tracked: The motion; None before the first measurement.
        memory: Memory of the model's effects.
        cell_n: Last force of the load cell; None before the first one.
        cell_ns: When it came.
    """

    tracked: Tracked | None = None
    memory: tuple[float, ...] = ()
    cell_n: float | None = None
    cell_ns: int = 0


def followed(tracked: Tracked, measured: Measurement, settling_s: float) -> Tracked:
    """The motion after a new measurement.

    Args:
        tracked: The motion before it.
        measured: The measurement.
        settling_s: Time constant with which older measurements fade.
    """
    age_s = (measured.t_ns - tracked.measured_ns) * 1e-9
    if age_s <= 0.0:
        return tracked
    height_m, velocity, acceleration = predicted(tracked, measured.t_ns)
    innovation_m = measured.height_m - height_m
    kept = math.exp(-age_s / settling_s)
    fresh = 1.0 - kept
    return Tracked(
        height_m + (1.0 - kept**3) * innovation_m,
        velocity + 1.5 * fresh * fresh * (1.0 + kept) * innovation_m / age_s,
        acceleration + fresh**3 * innovation_m / (age_s * age_s),
        innovation_m,
        measured.t_ns,
    )


def predicted(tracked: Tracked, t_ns: int) -> tuple[float, float, float]:
    """Height (m), velocity (m/s) and acceleration (m/s²) at a time after the last measurement."""
    h = (t_ns - tracked.measured_ns) * 1e-9
    acceleration = tracked.acceleration_m_per_s2
    velocity = tracked.velocity_m_per_s + h * acceleration
    return (
        tracked.height_m + h * (tracked.velocity_m_per_s + 0.5 * h * acceleration),
        velocity,
        acceleration,
    )


class DynoCore:
    """The arithmetic of a dyno, without bus, clock or file.

    Args:
        plant: The model, with one strut and one coordinate.
        settling_s: Time constant with which older measurements of the motion fade.
        supervision: Ages and safe output.

    Raises:
        InputError: The model has more than one strut or coordinate.
    """

    def __init__(self, plant: DartPlant, settling_s: float, supervision: Supervision) -> None:
        strut = plant.spec.struts[0]
        at_rest = (0.0,) * plant.memory_size
        plant.driven(strut.free_length_m, 0.0, 0.0, at_rest, 0.0, _AMBIENT_C)
        self._plant = plant
        self._settling_s = settling_s
        self._supervision = supervision

    @property
    def struts(self) -> int:
        """Number of struts."""
        return 1

    def init(self, t_ns: int) -> RigState:
        """State before the first tick."""
        return DynoState(t_ns, Mode.WAITING, (), (None,), None, _AMBIENT_C, ())

    def step(self, state: RigState, step_input: StepInput) -> tuple[RigState, StepOutput]:
        """Advance by one tick.

        Args:
            state: State after the last tick, which `init` or `step` gave.
            step_input: What came since then.

        Returns:
            State after this tick, and what it publishes.
        """
        if not isinstance(state, DynoState):
            raise TypeError(f"{type(state).__name__}, expected a state of this core")
        if state.mode is Mode.SAFE and step_input.acknowledged:
            mode = next_mode(state.mode, Event.ACKNOWLEDGED)
            state = replace(state, mode=mode, tracked=None, cell_n=None)
        if state.mode is Mode.SAFE:
            state = replace(state, t_ns=step_input.t_ns)
            return state, self._safe_output(state)
        received = self._received(state, step_input)
        tracked, cell_n, t_ns = received.tracked, received.cell_n, step_input.t_ns
        if tracked is not None and cell_n is not None:
            age_ns = t_ns - min(tracked.measured_ns, received.cell_ns)
            mode = next_mode(received.mode, age_event(self._supervision, age_ns))
            if mode is not Mode.WAITING:
                return self._driven(received, tracked, cell_n, mode, t_ns)
        return replace(received, t_ns=t_ns), StepOutput(received.mode, ())

    def _received(self, state: DynoState, step_input: StepInput) -> DynoState:
        """State with what came; the model begins with its effects' memory at zero."""
        tracked, (measured,) = state.tracked, step_input.heights
        if measured is not None:
            begun = Tracked(measured.height_m, 0.0, 0.0, 0.0, measured.t_ns)
            tracked = followed(tracked, measured, self._settling_s) if tracked else begun
        cell_n, cell_ns = state.cell_n, state.cell_ns
        if step_input.load_cell_force_n is not None:
            cell_n, cell_ns = step_input.load_cell_force_n, step_input.t_ns
        warm = step_input.temperature_c
        return replace(
            state,
            tracked=tracked,
            memory=state.memory if state.tracked else (0.0,) * self._plant.memory_size,
            cell_n=cell_n,
            cell_ns=cell_ns,
            temperature_c=state.temperature_c if warm is None else warm,
        )

    def _driven(
        self, state: DynoState, tracked: Tracked, cell_n: float, mode: Mode, t_ns: int
    ) -> tuple[RigState, StepOutput]:
        """Drive the model to the tick, and compare it with the load cell."""
        memory = self._remembered(state, tracked, state.t_ns, t_ns)
        height_m, velocity, acceleration = predicted(tracked, t_ns)
        model = self._plant.driven(
            height_m, velocity, acceleration, memory, t_ns * 1e-9, state.temperature_c
        )
        valid = mode is Mode.RUNNING
        strut = StrutOutput(
            cell_n,
            cell_n - model.force_n,
            valid,
            height_m,
            velocity,
            acceleration,
            tracked.innovation_m,
        )
        total = cell_n + model.force_n + height_m + velocity
        if mode is Mode.SAFE or not abs(total) < _SENSELESS:
            state = replace(state, t_ns=t_ns, mode=Mode.SAFE)
            return state, self._safe_output(state)
        last_valid = (strut,) if valid else state.last_valid
        state = replace(state, t_ns=t_ns, mode=mode, memory=memory, last_valid=last_valid)
        return state, StepOutput(mode, (strut,))

    def _remembered(
        self, state: DynoState, tracked: Tracked, from_ns: int, t_ns: int
    ) -> tuple[float, ...]:
        """Memory of the effects, led along the motion from the last tick to this one."""
        memory, span_ns = state.memory, t_ns - from_ns
        if not memory or span_ns <= 0:
            return memory
        steps = min(_MOST_MEMORY_STEPS, math.ceil(span_ns * 1e-9 / _LONGEST_MEMORY_STEP_S))
        h = span_ns * 1e-9 / steps
        for step in range(steps):
            at_ns = from_ns + (2 * step * span_ns) // (2 * steps)
            mid_ns = from_ns + ((2 * step + 1) * span_ns) // (2 * steps)
            rates = self._rates(state, tracked, memory, at_ns)
            half = tuple([m + 0.5 * h * r for m, r in zip(memory, rates, strict=True)])
            rates = self._rates(state, tracked, half, mid_ns)
            memory = tuple([m + h * r for m, r in zip(memory, rates, strict=True)])
        return memory

    def _rates(
        self, state: DynoState, tracked: Tracked, memory: tuple[float, ...], t_ns: int
    ) -> list[float]:
        height_m, velocity, acceleration = predicted(tracked, t_ns)
        return self._plant.driven(
            height_m, velocity, acceleration, memory, t_ns * 1e-9, state.temperature_c
        ).memory_rates

    def _safe_output(self, state: DynoState) -> StepOutput:
        """The defined output of the safe state."""
        if state.tracked is None:
            return StepOutput(state.mode, ())
        force_n = 0.0
        if self._supervision.safe_holds_last and state.last_valid:
            force_n = state.last_valid[0].force_n
        strut = StrutOutput(force_n, 0.0, False, state.tracked.height_m, 0.0, 0.0, 0.0)
        return StepOutput(state.mode, (strut,))
