"""The state machine that owns the mode: the only place where it changes.

What may change it is an event: the age of the measurements, a model that diverged, a limit, a
device, the user. A tick may show several; they are applied one after the other: age, overload,
divergence, limits, devices, log, interlock. What is published follows from the mode.
"""

from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from math import nan
from typing import Annotated, Literal

from msgspec import Struct
from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.yaml_file import Finite, NotNegative, PositiveSeconds, Seconds
from rig.bridge.arming import ArmingKind, OpenInterlock
from rig.bridge.estimator import AnyEstimator, Estimate
from rig.bridge.force_history import NO_HISTORY, ForceComparison, ForceHistory
from rig.bridge.measurement_age import is_too_old
from rig.bridge.supervision_limits import (
    COMPARED,
    OF_SETTLED,
    RANGED,
    Action,
    Delay,
    Excess,
    Limit,
    LimitsByStrut,
    excess_of,
    find_excess,
    find_violations,
    inherit_delays,
    range_of_estimate,
    update_delays,
    values_of_estimate,
    values_with_history,
    worst_action,
)
from rig.bridge.values import Divergence, Mode, Request, StepInput, StepOutput, StrutOutput
from rig.channels.channel import Channel
from rig.observers.protocol import AnyObserver


class Event(Enum):
    """What a tick shows, in the order in which it is applied."""

    TICKS_MISSING = "ticks_missing"
    ACKNOWLEDGED = "acknowledged"
    FRESH = "fresh"
    STALE = "stale"
    TIMEOUT = "timeout"
    OVERLOADED = "overloaded"
    DIVERGED = "diverged"
    SETTLED = "settled"
    UNSETTLED = "unsettled"
    WITHHELD = "withheld"
    BEYOND_HOLD = "beyond_hold"
    BEYOND_SAFE = "beyond_safe"
    DEVICE_FAULT = "device_fault"
    LOG_LOST = "log_lost"
    INTERLOCK_OPEN = "interlock_open"


_LOSSES = {
    Event.STALE: Mode.HOLD,
    Event.TIMEOUT: Mode.SAFE,
    Event.TICKS_MISSING: Mode.SAFE,
    Event.OVERLOADED: Mode.HOLD,
    Event.DIVERGED: Mode.SAFE,
    Event.BEYOND_HOLD: Mode.HOLD,
    Event.BEYOND_SAFE: Mode.SAFE,
    Event.DEVICE_FAULT: Mode.HOLD,
    Event.LOG_LOST: Mode.SAFE,
    Event.INTERLOCK_OPEN: Mode.SAFE,
}
"""Event -> next mode, wherever the model follows the bench."""

CAUSE_NUMBERS = {event: number for number, event in enumerate(_LOSSES, start=1)}
"""What an estimate is lost to -> its number on the bus."""

TRANSITIONS: dict[tuple[Mode, Event], Mode] = {
    (Mode.WAITING, Event.FRESH): Mode.SETTLING,
    (Mode.SETTLING, Event.SETTLED): Mode.RUNNING,
    (Mode.SETTLING, Event.WITHHELD): Mode.READY,
    (Mode.READY, Event.SETTLED): Mode.RUNNING,
    (Mode.READY, Event.UNSETTLED): Mode.SETTLING,
    (Mode.RUNNING, Event.WITHHELD): Mode.READY,
    (Mode.RUNNING, Event.UNSETTLED): Mode.SETTLING,
    (Mode.HOLD, Event.FRESH): Mode.SETTLING,
    (Mode.SAFE, Event.ACKNOWLEDGED): Mode.WAITING,
    **{
        (mode, event): after
        for event, after in _LOSSES.items()
        for mode in (Mode.SETTLING, Mode.READY, Mode.RUNNING, Mode.HOLD)
        if after is not mode
    },
}
"""Mode and event -> next mode; a pair that is not listed changes nothing."""


def next_mode(mode: Mode, event: Event) -> Mode:
    """Mode after an event."""
    return TRANSITIONS.get((mode, event), mode)


class Supervision(BaseModel):
    """Ages of the measurement, arming, ramps, the output of the safe state, the limits.

    Attributes:
        stale_after_s: Age of a height (on a dyno also of the load cell's force) from which the
            estimate is invalid with the mode HOLD. For the applied force, the age is three cycles
            of its message, if these are longer. On a dyno, the estimate is invalid (SETTLING)
            already from an age of three sampling intervals (for a height, plus `delay_s`), if
            this is less than `stale_after_s`.
        safe_after_s: Age of a height, of the applied force or (on a dyno) of the load cell's force
            from which the bridge enters the safe state. If three cycles of the applied force are
            longer than `stale_after_s`, they extend this age for the applied force by the
            difference.
        settling_s: Time after a start, a gap, a change of gains or a saturated virtual force until
            an estimate is valid. By default, with `pi`, the time after which the error that a step
            of the residual force causes in the closed loop has decayed to a hundredth of the step;
            with `kalman`, 1.27 / `bandwidth_hz` after the variance of the filter is steady. On a
            dyno, `supervision.settling_s` has no effect: the time is nine times
            `prescribed_motion.settling_s`.
        overload_share: The estimate is invalid (HOLD) while more than this share of the last few
            hundred ticks was missed.
        arming: `automatic`: an estimate is valid as soon as it has settled. `manual`: in addition,
            an operator has to arm the bridge after each start of a run and each safe state.
        fade_in_s: Time in which the published force fades in, from the safe output to the
            estimate, before the estimate is valid.
        slew_n_per_s: Rate at which a published force that is no longer valid moves to the safe
            output. With `fade_in_s` alone, the safe output is published at once in HOLD and SAFE.
            With neither of the two keys, the estimate is published in HOLD (the last valid one
            while the model starts again), and the safe output at once in SAFE.
        watchdog: Whether a second process sends the safe output if the loop stands still for
            `safe_after_s` or its process dies; only on interfaces that several processes can share.
        log_fault: Reaction to a log that cannot be written: `continue`, or `safe` for the safe
            state.
        safe_output: Force that is published in the safe state: `zero`, or the `last` valid one.
        limits: List of limits. For a value without an entry, the range of its signal in the DBC is
            the limit: a height, an applied force or a further sensor beyond this range is refused,
            and a published force beyond it leads to HOLD. A model height that leaves the range of
            the measured height by a tenth of its span leads to SAFE.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    stale_after_s: PositiveSeconds = 0.01
    safe_after_s: PositiveSeconds = 0.5
    settling_s: Seconds | None = None
    overload_share: Annotated[Finite, Field(gt=0.0, le=1.0)] = 0.5
    arming: ArmingKind = "automatic"
    fade_in_s: Annotated[NotNegative, Field(le=60.0)] = 0.0
    slew_n_per_s: Annotated[Finite, Field(ge=1e-3, le=1e12)] | None = None
    watchdog: bool = True
    log_fault: Literal["continue", "safe"] = "continue"
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


class Cause(Struct, frozen=True, gc=False):
    """Why the mode changed.

    Attributes:
        event: What the tick showed.
        strut: Index of the strut that shows it; -1 if it is none.
        quantity: What was too large, with its unit; empty where nothing was.
        value: Its value.
        limit: The limit that it is beyond.
        device: Index of the device that is at fault; -1 if none is.
    """

    event: Event
    strut: int = -1
    quantity: str = ""
    value: float = nan
    limit: float = nan
    device: int = -1


class SupervisedState(Struct, frozen=True, gc=False):
    """State of an estimator and of its supervisor between two steps; a run can restart from any.

    Attributes:
        t_ns: Time of the last step.
        mode: State of the bridge.
        estimator: State of the estimator.
        last_valid: What was last published as valid; empty before.
        stopped_m: Heights at which the struts of a stopped model stand, in the safe state.
        diverged: The last divergence of the model, if there ever was one.
        measured_ns: Time of the measurements that the last estimate rests on.
        cause: Why the mode is what it is.
        first_cause: Why the estimate was last lost; None while the bridge is running.
        delays: State of the limits that are passed only after a time.
        history: Forces before, where a limit needs them.
    """

    t_ns: int
    mode: Mode
    estimator: object
    last_valid: tuple[StrutOutput, ...] = ()
    stopped_m: Sequence[float] = ()
    diverged: Divergence | None = None
    measured_ns: int = 0
    cause: Cause | None = None
    first_cause: Cause | None = None
    delays: tuple[Delay, ...] = ()
    history: ForceHistory = NO_HISTORY


class Reports(Struct, frozen=True, gc=False):
    """What the frame checks, the devices and the loop report to the supervisor at a tick.

    Attributes:
        action: Severest action that the limits on measurements require, 0 if none.
        excess: The measurement beyond them; None if there is none.
        gap_ns: Time without a tick before this one, if any was missed.
        missed_share: Share of missed ticks, if it is too large, else 0.
        faulty_device: Index of a device at fault that the estimate rests on; -1 if there is none.
        is_log_lost: Whether the log cannot be written, and the run requires it.
        is_withheld: Whether an estimate may not be valid yet, although it has settled.
        open_interlock: Why the interlock counts as open; None if it does not.
    """

    action: int = 0
    excess: Excess | None = None
    gap_ns: int = 0
    missed_share: float = 0.0
    faulty_device: int = -1
    is_log_lost: bool = False
    is_withheld: bool = False
    open_interlock: OpenInterlock | None = None


NO_REPORTS = Reports()
_EVENT_OF_ACTION = {Action.HOLD: Event.BEYOND_HOLD, Action.SAFE: Event.BEYOND_SAFE}
"""Action -> event; the others change no mode."""

_UNSUPPORTED = (Event.TIMEOUT, Event.DIVERGED)
"""Events that make a step's own motion worthless: the model stops where it was before."""

_LOST = (Mode.HOLD, Mode.SAFE)

# Looking up a member of an enum costs as much as the CRC of a frame.
_RUNNING, _SAFE = Mode.RUNNING, Mode.SAFE


class Supervisor:
    """Steps an estimator and decides what is published of it, within the limits of each strut.

    Args:
        cell: Channel of the load cell that the estimate is compared with; None without one.
    """

    def __init__(
        self,
        estimator: AnyEstimator,
        settings: Supervision,
        limits: LimitsByStrut,
        cell: Channel | None = None,
    ) -> None:
        self.estimator = estimator
        self.settings = settings
        self._stale_after_ns = settings.stale_after_ns
        self._safe_after_ns = settings.safe_after_ns
        estimates = [[row for row in rows if not row.value.is_measured] for rows in limits]
        self._limits = [[row for row in rows if not row.has_memory] for rows in estimates]
        self.delayed = [
            (index, row) for index, rows in enumerate(estimates) for row in rows if row.has_memory
        ]
        """Limits with a delay, each with the index of its strut."""
        self._limits_before = [
            [row for row in rows if row.value not in OF_SETTLED] for rows in self._limits
        ]
        self._ranges = list(map(range_of_estimate, self._limits))
        self._is_limited = any(self._limits)
        limited = {row.value for rows in estimates for row in rows}
        self._is_judged_always = bool(limited.difference(RANGED) or self.delayed)
        self._comparison = None
        if limited.intersection(COMPARED):
            self._comparison = ForceComparison(cell, settings.stale_after_ns)
        self._cell = cell
        self.compared = frozenset({cell.index} if cell and self._comparison else ())
        """Index of the channel of the load cell, if an estimate is compared with it."""
        self._has_memory = bool(self.delayed) or self._comparison is not None

    def with_settings(
        self, observers: Sequence[AnyObserver], settings: Supervision, limits: LimitsByStrut
    ) -> "Supervisor":
        """The same with other observers and limits; a state of one is a state of the other."""
        estimator = self.estimator.with_settings(
            observers, settings.stale_after_ns, settings.settling_s
        )
        return Supervisor(estimator, settings, limits, self._cell)

    def take_over(self, state: SupervisedState, before: "Supervisor", t_ns: int) -> SupervisedState:
        """State of a supervisor that had other limits: what counts as passed stays so."""
        if self.delayed == before.delayed or not state.delays:
            return state
        known = list(zip(before.delayed, state.delays, strict=True))
        return replace(state, delays=inherit_delays(self.delayed, known, t_ns))

    def init(self, t_ns: int) -> SupervisedState:
        """State before the first step."""
        return SupervisedState(t_ns, Mode.WAITING, self.estimator.init(t_ns))

    def step(
        self, state: SupervisedState, step_input: StepInput, reports: Reports = NO_REPORTS
    ) -> tuple[SupervisedState, StepOutput, int]:
        """State after a step, what it publishes, and the severest action that a limit requires."""
        mode = state.mode
        if mode is _SAFE:
            return *self._stand(state, step_input, reports), reports.action
        t_ns, before = step_input.t_ns, state.estimator
        after, estimate = self.estimator.step(before, step_input)
        if estimate is None:
            return *self._wait(state, t_ns, after, reports), reports.action
        action, excess = reports.action, reports.excess
        struts, measured_ns = estimate.struts, estimate.measured_ns
        is_judged = self._is_judged_always
        if self._is_limited:
            for strut, (low_m, high_m, low_n, high_n) in zip(struts, self._ranges, strict=False):
                if not (low_m <= strut.height_m <= high_m and low_n <= strut.force_n <= high_n):
                    is_judged = True
        if is_judged:
            state, required, passed = self._judge(state, step_input, estimate)
            if required > action:
                action, excess = required, passed
        is_calm = (
            mode is _RUNNING
            and estimate.is_settled
            and estimate.diverged < 0
            and not action
            and reports is NO_REPORTS
            and not self._has_memory
            and t_ns - measured_ns <= self._stale_after_ns
        )
        if is_calm:
            state = SupervisedState(
                t_ns, mode, after, struts, (), state.diverged, measured_ns, state.cause
            )
            return state, StepOutput(mode, struts, estimate.left_out), action
        if estimate.diverged >= 0:
            state = replace(state, diverged=Divergence(estimate.diverged, t_ns))
        causes = self._causes(t_ns, estimate, (action, excess), reports)
        return *self._change(state, t_ns, after, estimate, causes), action

    def _judge(
        self, state: SupervisedState, step_input: StepInput, estimate: Estimate
    ) -> tuple[SupervisedState, int, Excess | None]:
        """State, the severest action that limits on the estimate require, and what requires it."""
        struts, t_ns, is_settled = estimate.struts, step_input.t_ns, estimate.is_settled
        if self._comparison is None:
            values = list(map(values_of_estimate, struts))
        else:
            history = self._comparison.update(state.history, t_ns, struts, step_input.samples)
            state = replace(state, history=history)
            values = values_with_history(struts, history)
        limits = self._limits if is_settled else self._limits_before
        action = max(map(worst_action, limits, values), default=0)
        excess = find_excess(limits, values, action) if action else None
        if self.delayed:
            delays = update_delays(self.delayed, state.delays, values, t_ns)
            state = replace(state, delays=delays)
            passed = find_violations(self.delayed, delays, is_settled=is_settled)
            for strut, row in passed:
                if row.severity > action:
                    action, excess = row.severity, excess_of(row, strut, values[strut][row.value])
        return state, action, excess

    def end(self, state: SupervisedState) -> StepOutput:
        """What is published when the run ends: the safe output, whatever the mode was."""
        stopped_m = state.stopped_m or self._standing_m(state, state.estimator)
        return self._safe_output(replace(state, mode=Mode.SAFE, stopped_m=stopped_m))

    def _change(
        self,
        state: SupervisedState,
        t_ns: int,
        after: object,
        estimate: Estimate,
        causes: Iterable[Cause],
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output after what a tick shows, one event after the other."""
        before, struts = state.estimator, estimate.struts
        state, cause = _apply(state, causes)
        if state.mode is Mode.SAFE:
            is_unsupported = cause is not None and cause.event in _UNSUPPORTED
            stopped = self.estimator.discard(before, after) if is_unsupported else after
            return self._stop(state, t_ns, stopped)
        is_running = state.mode is Mode.RUNNING
        struts = struts if is_running else _as_invalid(struts)
        state = replace(
            state,
            t_ns=t_ns,
            estimator=after,
            last_valid=struts if is_running else state.last_valid,
            measured_ns=estimate.measured_ns,
        )
        first_cause = _number_of(state.first_cause)
        return state, StepOutput(state.mode, struts, estimate.left_out, first_cause)

    def _causes(
        self,
        t_ns: int,
        estimate: Estimate,
        required: tuple[int, Excess | None],
        reports: Reports,
    ) -> Iterator[Cause]:
        """What a tick with an estimate shows, in order; limits require an action, for an excess."""
        action, excess = required
        yield from self._missing_ticks(reports)
        yield self._age(estimate.measured_ns, t_ns)
        if reports.missed_share:
            limit = self.settings.overload_share
            yield Cause(Event.OVERLOADED, -1, "missed_share", reports.missed_share, limit)
        if estimate.diverged >= 0:
            yield Cause(Event.DIVERGED, estimate.diverged)
        if estimate.is_settled:
            yield Cause(Event.WITHHELD if reports.is_withheld else Event.SETTLED)
        else:
            yield Cause(Event.UNSETTLED)
        if action >= Action.HOLD:
            yield _beyond(action, excess)
        yield from _surroundings(reports)

    def _missing_ticks(self, reports: Reports) -> Iterator[Cause]:
        """A gap between two ticks that left the bench alone for too long."""
        gap_s, limit_s = reports.gap_ns * 1e-9, self._safe_after_ns * 1e-9
        if reports.gap_ns > self._safe_after_ns:
            yield Cause(Event.TICKS_MISSING, -1, "gap_s", gap_s, limit_s)

    def _age(self, measured_ns: int, t_ns: int) -> Cause:
        """What the age of the oldest measurement means."""
        age_s = (t_ns - measured_ns) * 1e-9
        if is_too_old(measured_ns, t_ns, self._safe_after_ns):
            return Cause(Event.TIMEOUT, -1, "age_s", age_s, self.settings.safe_after_s)
        if is_too_old(measured_ns, t_ns, self._stale_after_ns):
            return Cause(Event.STALE, -1, "age_s", age_s, self.settings.stale_after_s)
        return Cause(Event.FRESH)

    def _wait(
        self, state: SupervisedState, t_ns: int, estimator: object, reports: Reports
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output without a model: before its start, and while it starts again."""
        if state.mode is not Mode.WAITING:
            # Fresh measurements are not enough yet, old ones are a reason to stop.
            age = self._age(state.measured_ns, t_ns)
            if age.event is Event.FRESH:
                age = Cause(Event.UNSETTLED)
            causes = [*self._missing_ticks(reports), age]
            if reports.action >= Action.HOLD:
                causes.append(_beyond(reports.action, reports.excess))
            causes += _surroundings(reports)
            state, _ = _apply(state, causes)
            if state.mode is Mode.SAFE:
                return self._stop(state, t_ns, estimator)
        after = replace(state, t_ns=t_ns, estimator=estimator)
        struts = () if state.mode is Mode.WAITING else _as_invalid(state.last_valid)
        return after, StepOutput(state.mode, struts, (), _number_of(state.first_cause))

    def _stand(
        self, state: SupervisedState, step_input: StepInput, reports: Reports
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output of the safe state, which an acknowledgement leaves.

        It does so only when what has led there is over: the model could start from fresh
        measurements, and neither a limit on them nor a device, log or interlock is in the way.
        """
        estimator, can_start = self.estimator.collect(state.estimator, step_input)
        state = replace(state, t_ns=step_input.t_ns, estimator=estimator)
        is_over = (
            can_start
            and reports.action < Action.HOLD
            and reports.faulty_device < 0
            and not reports.is_log_lost
            and reports.open_interlock is None
        )
        if not (step_input.request is Request.ACKNOWLEDGE and is_over):
            return state, self._safe_output(state)
        state, _ = _apply(replace(state, stopped_m=()), (Cause(Event.ACKNOWLEDGED),))
        return state, StepOutput(state.mode, (), (), _number_of(state.first_cause))

    def _stop(
        self, state: SupervisedState, t_ns: int, estimator: object
    ) -> tuple[SupervisedState, StepOutput]:
        """State and output at the entry of the safe state; measurements are collected again."""
        state = replace(
            state,
            t_ns=t_ns,
            estimator=self.estimator.restart(estimator, t_ns),
            stopped_m=self._standing_m(state, estimator),
        )
        return state, self._safe_output(state)

    def _standing_m(self, state: SupervisedState, estimator: object) -> Sequence[float]:
        """Heights at which the model stands, or last stood if it was to start again."""
        heights_m = self.estimator.heights_m(estimator)
        return heights_m or [strut.height_m for strut in state.last_valid]

    def _safe_output(self, state: SupervisedState) -> StepOutput:
        """The defined output of the safe state: the model stands still."""
        forces = self.safe_forces_n(state)
        struts = tuple(
            StrutOutput(force_n, 0.0, False, height_m, 0.0, 0.0, 0.0)
            for force_n, height_m in zip(forces, state.stopped_m, strict=False)
        )
        return StepOutput(state.mode, struts, (), _number_of(state.first_cause))

    def safe_forces_n(self, state: SupervisedState) -> Sequence[float]:
        """Force of each strut that the safe state publishes."""
        if self.settings.safe_output == "last" and state.last_valid:
            return [strut.force_n for strut in state.last_valid]
        return [0.0] * self.estimator.struts


def _apply(state: SupervisedState, causes: Iterable[Cause]) -> tuple[SupervisedState, Cause | None]:
    """State after what a tick shows, and what changed its mode last; None if nothing did.

    A cause that lasts leads to the mode that there was: that mode keeps its cause. Nothing leaves
    the safe state within the tick that enters it.
    """
    mode, last = state.mode, None
    for cause in causes:
        after = next_mode(mode, cause.event)
        if after is not mode:
            mode, last = after, cause
            if mode is Mode.SAFE:
                break
    if last is None or mode is state.mode:
        return state, last
    first = state.first_cause
    if mode is Mode.RUNNING:
        first = None
    elif mode in _LOST:
        first = first or last
    return replace(state, mode=mode, cause=last, first_cause=first), last


def _surroundings(reports: Reports) -> Iterator[Cause]:
    """What devices, log and interlock show."""
    if reports.faulty_device >= 0:
        yield Cause(Event.DEVICE_FAULT, device=reports.faulty_device)
    if reports.is_log_lost:
        yield Cause(Event.LOG_LOST)
    interlock = reports.open_interlock
    if interlock is not None:
        yield Cause(Event.INTERLOCK_OPEN, -1, interlock.quantity, interlock.value, interlock.limit)


def _beyond(action: int, excess: Excess | None) -> Cause:
    """The cause that a limit's action is; of HOLD or SAFE."""
    event = _EVENT_OF_ACTION[Action(action)]
    if excess is None:
        return Cause(event)
    return Cause(event, excess.strut, excess.quantity, excess.number, excess.bound)


def _number_of(cause: Cause | None) -> int:
    """Number of a cause on the bus; 0 for none."""
    return 0 if cause is None else CAUSE_NUMBERS[cause.event]


def _as_invalid(struts: Sequence[StrutOutput]) -> tuple[StrutOutput, ...]:
    return tuple([replace(strut, valid=False) for strut in struts])
