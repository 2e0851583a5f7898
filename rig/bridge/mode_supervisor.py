"""The state machine that owns the mode: the only place where it changes.

What may change it is an event: the age of the measurements, a model that diverged, a limit, a
device, the user. A tick may show several; they are applied one after the other: age, divergence,
limits, devices. What is published follows from the mode.
"""

from collections.abc import Sequence
from enum import IntEnum, auto
from typing import Annotated, Literal

from msgspec import Struct
from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.yaml_file import Positive
from rig.bridge.estimator import AnyEstimator, Estimate
from rig.bridge.measurement_age import is_too_old
from rig.bridge.supervision_limits import Action, Limit, worst_action
from rig.bridge.values import Divergence, Mode, StepInput, StepOutput, StrutOutput


class Event(IntEnum):
    """What a tick shows."""

    BEYOND_SAFE = auto()
    DIVERGED = auto()
    TIMEOUT = auto()
    BEYOND_HOLD = auto()
    DEVICE_FAULT = auto()
    STALE = auto()
    ACKNOWLEDGED = auto()
    FRESH = auto()


TRANSITIONS: dict[tuple[Mode, Event], Mode] = {
    (Mode.WAITING, Event.FRESH): Mode.RUNNING,
    (Mode.RUNNING, Event.STALE): Mode.HOLD,
    (Mode.RUNNING, Event.TIMEOUT): Mode.SAFE,
    (Mode.RUNNING, Event.DIVERGED): Mode.SAFE,
    (Mode.RUNNING, Event.BEYOND_HOLD): Mode.HOLD,
    (Mode.RUNNING, Event.BEYOND_SAFE): Mode.SAFE,
    (Mode.RUNNING, Event.DEVICE_FAULT): Mode.HOLD,
    (Mode.HOLD, Event.FRESH): Mode.RUNNING,
    (Mode.HOLD, Event.TIMEOUT): Mode.SAFE,
    (Mode.HOLD, Event.DIVERGED): Mode.SAFE,
    (Mode.HOLD, Event.BEYOND_SAFE): Mode.SAFE,
    (Mode.SAFE, Event.ACKNOWLEDGED): Mode.WAITING,
}
"""Mode and event -> next mode; a pair that is not listed changes nothing."""


def next_mode(mode: Mode, event: Event) -> Mode:
    """Mode after an event."""
    return TRANSITIONS.get((mode, event), mode)


class Supervision(BaseModel):
    """Ages of the measurement, the output of the safe state, and the table of limits.

    Attributes:
        stale_after_s: Age of a height from which the estimate is marked invalid.
        safe_after_s: Age from which the safe state is entered.
        safe_output: Force that the safe state publishes: `zero`, or the `last` valid one.
        limits: What is done beyond which values, row by row.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stale_after_s: Positive = 0.01
    safe_after_s: Positive = 0.5
    safe_output: Literal["zero", "last"] = "zero"
    limits: Annotated[tuple[Limit, ...], Field(max_length=100)] = ()

    @model_validator(mode="after")
    def _in_order(self) -> "Supervision":
        if self.safe_after_s < self.stale_after_s:
            raise ValueError(
                f"safe_after_s {self.safe_after_s}: expected at least stale_after_s "
                f"({self.stale_after_s})"
            )
        return self

    @property
    def stale_after_ns(self) -> int:
        """Age from which the estimate is marked invalid, in ns."""
        return round(self.stale_after_s * 1e9)

    @property
    def safe_after_ns(self) -> int:
        """Age from which the safe state is entered, in ns."""
        return round(self.safe_after_s * 1e9)


class SupervisedState(Struct, frozen=True, gc=False):
    """State of an estimator and of its supervisor between two steps; a run can restart from any.

    Attributes:
        t_ns: Time of the last step.
        mode: State of the bridge.
        estimator: State of the estimator.
        last_valid: What was last published as valid; empty before.
        stopped_m: Heights at which the struts of a stopped model stand, in the safe state.
        diverged: The last divergence of the model, if there ever was one.
    """

    t_ns: int
    mode: Mode
    estimator: object
    last_valid: tuple[StrutOutput, ...] = ()
    stopped_m: Sequence[float] = ()
    diverged: Divergence | None = None


class Reports(Struct, frozen=True, gc=False):
    """What the frame checks and the devices report to the supervisor at a tick.

    Attributes:
        action: Severest action that the limits on measurements require, 0 if none.
        is_device_faulty: Whether a device that the estimate rests on is at fault.
    """

    action: int = 0
    is_device_faulty: bool = False


NO_REPORTS = Reports()
_EVENT_OF_ACTION = {Action.HOLD: Event.BEYOND_HOLD, Action.SAFE: Event.BEYOND_SAFE}
"""Action -> event; the others change no mode."""


class Supervisor:
    """Steps an estimator and decides what is published of it."""

    def __init__(self, estimator: AnyEstimator, settings: Supervision) -> None:
        self.estimator = estimator
        self._settings = settings
        self._stale_after_ns = settings.stale_after_ns
        self._safe_after_ns = settings.safe_after_ns
        self._limits = tuple(limit for limit in settings.limits if not limit.value.is_measured)

    def init(self, t_ns: int) -> SupervisedState:
        """State before the first step."""
        return SupervisedState(t_ns, Mode.WAITING, self.estimator.init(t_ns))

    def step(
        self, state: SupervisedState, step_input: StepInput, reports: Reports = NO_REPORTS
    ) -> tuple[SupervisedState, StepOutput, int]:
        """State after a step, what it publishes, and the severest action that a limit requires."""
        t_ns, mode, before = step_input.t_ns, state.mode, state.estimator
        if mode is Mode.SAFE:
            if not step_input.acknowledged:
                state = replace(state, t_ns=t_ns)
                return state, self._safe_output(state), reports.action
            mode = next_mode(mode, Event.ACKNOWLEDGED)
            before = self.estimator.restart(before, state.t_ns)
        after, estimate = self.estimator.step(before, step_input)
        if estimate is None:
            state = SupervisedState(t_ns, mode, after, state.last_valid, (), state.diverged)
            return state, StepOutput(mode, ()), reports.action
        measured_ns = estimate.measured_ns
        if mode is not Mode.RUNNING or is_too_old(measured_ns, t_ns, self._stale_after_ns):
            mode = next_mode(mode, self._age_event(measured_ns, t_ns))
        if estimate.diverged >= 0:
            mode = next_mode(mode, Event.DIVERGED)
            state = replace(state, diverged=Divergence(estimate.diverged, t_ns))
        action = reports.action
        if mode is Mode.SAFE:
            # The model stops where it was before a motion that no measurement supports.
            return *self._stop(state, t_ns, self.estimator.discard(before, after)), action
        if self._limits or reports is not NO_REPORTS:
            mode, action = self._mode_by_reports(mode, estimate, reports)
        if mode is Mode.RUNNING:
            struts = estimate.struts
            state = SupervisedState(t_ns, mode, after, struts, (), state.diverged)
            return state, StepOutput(mode, struts, estimate.left_out), action
        if mode is Mode.SAFE:
            return *self._stop(state, t_ns, after), action
        return *self._hold(state, t_ns, after, estimate), action

    def _mode_by_reports(
        self, mode: Mode, estimate: Estimate, reports: Reports
    ) -> tuple[Mode, int]:
        """Mode after limits and devices, and the severest action that a limit requires."""
        actions = [worst_action(self._limits, strut) for strut in estimate.struts]
        action = max([reports.action, *actions])
        if action in _EVENT_OF_ACTION:
            mode = next_mode(mode, _EVENT_OF_ACTION[Action(action)])
        if reports.is_device_faulty:
            mode = next_mode(mode, Event.DEVICE_FAULT)
        return mode, action

    def _age_event(self, measured_ns: int, t_ns: int) -> Event:
        """What the age of the oldest measurement means."""
        if not is_too_old(measured_ns, t_ns, self._stale_after_ns):
            return Event.FRESH
        is_timeout = is_too_old(measured_ns, t_ns, self._safe_after_ns)
        return Event.TIMEOUT if is_timeout else Event.STALE

    def _hold(
        self, state: SupervisedState, t_ns: int, estimator: object, estimate: Estimate
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output while the model moves and its estimate is not valid."""
        struts = tuple([replace(strut, valid=False) for strut in estimate.struts])
        after = SupervisedState(t_ns, Mode.HOLD, estimator, state.last_valid, (), state.diverged)
        return after, StepOutput(Mode.HOLD, struts, estimate.left_out)

    def _stop(
        self, state: SupervisedState, t_ns: int, estimator: object
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output at the entry of the safe state."""
        heights_m = self.estimator.heights_m(estimator)
        state = SupervisedState(
            t_ns, Mode.SAFE, estimator, state.last_valid, heights_m, state.diverged
        )
        return state, self._safe_output(state)

    def _safe_output(self, state: SupervisedState) -> StepOutput:
        """The defined output of the safe state: the model stands still."""
        forces = [0.0] * len(state.stopped_m)
        if self._settings.safe_output == "last" and state.last_valid and forces:
            forces = [strut.force_n for strut in state.last_valid]
        struts = tuple(
            StrutOutput(force_n, 0.0, False, height_m, 0.0, 0.0, 0.0)
            for force_n, height_m in zip(forces, state.stopped_m, strict=True)
        )
        return StepOutput(state.mode, struts)
