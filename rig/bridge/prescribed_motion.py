"""One tick at a dyno: the motion is prescribed, and the load cell measures the force it takes.

The model does not run by itself: its strut is moved along the measured motion, and the virtual
force is what the load cell shows beyond the model's own law. The motion between and at measurements
is followed by a filter with fading memory, which has no lag for a constant acceleration.

Reference: Morrison, "Introduction to Sequential Smoothing and Prediction" (1969), chapter 13: the
fading-memory polynomial filter of second degree.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol

from msgspec import Struct
from msgspec.structs import replace

from dart_model.effects import AMBIENT_C
from rig.bridge.contract import (
    CoreState,
    Divergence,
    Measurement,
    Mode,
    StepInput,
    StepOutput,
    StrutOutput,
    is_sensible,
)
from rig.bridge.supervisor import Event, Supervision, age_event, next_mode


class PrescribedModel(Protocol):
    """A strut of a model that is moved from outside. Its states are frozen."""

    def init(self, t_s: float) -> Any:
        """State at the beginning."""
        ...

    def step(
        self,
        state: Any,
        t_s: float,
        motion: Callable[[float], tuple[float, float]],
        temperature_c: float,
    ) -> Any:
        """State at `t_s`, after a motion: time in s -> height (m) and velocity (m/s)."""
        ...

    def force_n(
        self, state: Any, height_m: float, velocity_m_per_s: float, temperature_c: float
    ) -> float:
        """What a load cell would show."""
        ...


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


class PrescribedCoreState(CoreState, frozen=True, gc=False, kw_only=True):
    """State between two ticks at a dyno.

    Attributes:
        tracked: The motion; None before the first measurement.
        model: State of the model; None before the first measurement.
        cell_n: Last force of the load cell; None before the first one.
        cell_ns: When it came.
    """

    tracked: Tracked | None = None
    model: Any = None
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


def _motion(tracked: Tracked, t_s: float) -> tuple[float, float]:
    """Height and velocity at a time of the run."""
    height_m, velocity_m_per_s, _ = predicted(tracked, round(t_s * 1e9))
    return height_m, velocity_m_per_s


class PrescribedCore:
    """The bridge's arithmetic where the motion is given and the force is measured.

    Args:
        model: The strut.
        settling_s: Time constant with which older measurements of the motion fade.
        supervision: Ages and safe output.
    """

    def __init__(self, model: PrescribedModel, settling_s: float, supervision: Supervision) -> None:
        self._model = model
        self._settling_s = settling_s
        self._supervision = supervision

    @property
    def struts(self) -> int:
        """Number of struts."""
        return 1

    def changed(self, observers: Sequence[object], supervision: Supervision) -> "PrescribedCore":
        """The same with another supervision; it has no use for an observer."""
        del observers
        return PrescribedCore(self._model, self._settling_s, supervision)

    def init(self, t_ns: int) -> PrescribedCoreState:
        """State before the first tick."""
        return PrescribedCoreState(t_ns, Mode.WAITING, AMBIENT_C)

    def step(
        self, state: PrescribedCoreState, step_input: StepInput
    ) -> tuple[PrescribedCoreState, StepOutput]:
        """Advance by one tick.

        Args:
            state: State after the last tick, which `init` or `step` gave.
            step_input: What came since then.

        Returns:
            State after this tick, and what it publishes.
        """
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
                return self._moved(received, tracked, cell_n, mode, t_ns)
        return replace(received, t_ns=t_ns), StepOutput(received.mode, ())

    def _received(self, state: PrescribedCoreState, step_input: StepInput) -> PrescribedCoreState:
        """State with what came; the model begins at the first measurement."""
        tracked, model, (measured,) = state.tracked, state.model, step_input.heights
        if measured is not None and tracked is None:
            tracked = Tracked(measured.height_m, 0.0, 0.0, 0.0, measured.t_ns)
            model = self._model.init(state.t_ns * 1e-9)
        elif measured is not None and tracked is not None:
            tracked = followed(tracked, measured, self._settling_s)
        cell_n, cell_ns = state.cell_n, state.cell_ns
        if step_input.load_cell_force_n is not None:
            cell_n, cell_ns = step_input.load_cell_force_n, step_input.t_ns
        warm = step_input.temperature_c
        return replace(
            state,
            tracked=tracked,
            model=model,
            cell_n=cell_n,
            cell_ns=cell_ns,
            temperature_c=state.temperature_c if warm is None else warm,
        )

    def _moved(
        self, state: PrescribedCoreState, tracked: Tracked, cell_n: float, mode: Mode, t_ns: int
    ) -> tuple[PrescribedCoreState, StepOutput]:
        """Move the model to the tick, and compare it with the load cell."""
        temperature_c = state.temperature_c
        model = self._model.step(state.model, t_ns * 1e-9, partial(_motion, tracked), temperature_c)
        height_m, velocity, acceleration = predicted(tracked, t_ns)
        model_n = self._model.force_n(model, height_m, velocity, temperature_c)
        valid = mode is Mode.RUNNING
        strut = StrutOutput(
            cell_n, cell_n - model_n, valid, height_m, velocity, acceleration, tracked.innovation_m
        )
        diverged = not is_sensible(cell_n + model_n + height_m + velocity)
        if diverged:
            state = replace(state, diverged=Divergence(0, t_ns))
        if diverged or mode is Mode.SAFE:
            state = replace(state, t_ns=t_ns, mode=Mode.SAFE)
            return state, self._safe_output(state)
        last_valid = (strut,) if valid else state.last_valid
        state = replace(state, t_ns=t_ns, mode=mode, model=model, last_valid=last_valid)
        return state, StepOutput(mode, (strut,))

    def _safe_output(self, state: PrescribedCoreState) -> StepOutput:
        """The defined output of the safe state."""
        if state.tracked is None:
            return StepOutput(state.mode, ())
        force_n = 0.0
        if self._supervision.safe_holds_last and state.last_valid:
            force_n = state.last_valid[0].force_n
        strut = StrutOutput(force_n, 0.0, False, state.tracked.height_m, 0.0, 0.0, 0.0)
        return StepOutput(state.mode, (strut,))
