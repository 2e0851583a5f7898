"""Frames in, frames out: one tick of the bridge, without bus, clock or file."""

from collections.abc import Sequence
from functools import partial

from msgspec import Struct
from msgspec.structs import replace

from can_dbc.addressing import Directory, Filter
from can_dbc.frame import Frame
from can_dbc.protection import SequenceState
from rig.bridge.arming import Arming
from rig.bridge.counts import Conditions, Counts, Report, count_tick
from rig.bridge.devices import CLAIM, CLAIM_MASK, Device, faults
from rig.bridge.frame_checks import CheckMemory, FrameChecks, Reception
from rig.bridge.incoming_messages import Incoming
from rig.bridge.late_samples import Past, PastStep, arrival_ns, remember, steps_of, use_late_samples
from rig.bridge.mode_supervisor import NO_REPORTS, Reports, SupervisedState, Supervision, Supervisor
from rig.bridge.operation import NOT_OPERATED, Operation, OperationState
from rig.bridge.outgoing_messages import Outgoing
from rig.bridge.sample_times import SenderClock
from rig.bridge.supervision_limits import Limits
from rig.bridge.values import Mode, Request, StepInput, StepOutput, StrutOutput
from rig.bridge.virtual_sensors import SensedState, VirtualSensors
from rig.channels.channel import Channel, Sample
from rig.observers.protocol import AnyObserver

_NO_CONDITIONS = Conditions()
_ALL_STANDARD = 0x7FF

_NO_MODEL = (Mode.WAITING, Mode.SAFE)
"""Modes in which no step has to be taken again: there is no model, or it stands still."""

_FADING = 1.0 - 1.0 / 200.0
"""Of the share of missed ticks, at each tick."""

_MOST_AT_ONCE = 20
"""Missed ticks of one pause that count: ages judge a single one, however long it is."""

_LEAST_SHARE = 1e-3
"""Share of missed ticks below which it is none."""


class Sending(Struct, frozen=True, gc=False):
    """State of an outgoing message.

    Attributes:
        number: Frames sent so far.
        due_ns: Time at which the next one is due.
    """

    number: int
    due_ns: int


class BridgeState(Struct, frozen=True, gc=False):
    """State of the bridge between two ticks.

    Attributes:
        supervised: State of estimator and supervisor.
        sequences: Counter state of each incoming message.
        memory: Memory of the frame checks.
        sendings: State of each outgoing message.
        reported: Counts at the last status that was sent.
        missed_share: Share of missed ticks, over the last few hundred.
        clocks: Clock of each incoming message's sender; None before its first frame.
        past: Steps that late samples may belong to.
        operation: State of arming and ramps.
        sensed: What the virtual sensors remember; None where no model moves.
    """

    supervised: SupervisedState
    sequences: tuple[SequenceState, ...]
    memory: CheckMemory
    sendings: tuple[Sending, ...]
    reported: Counts
    missed_share: float = 0.0
    clocks: tuple[SenderClock | None, ...] = ()
    past: Past = ()
    operation: OperationState = NOT_OPERATED
    sensed: SensedState | None = None

    @property
    def counts(self) -> Counts:
        """Counts since the start."""
        return self.memory.counts

    @property
    def mode(self) -> Mode:
        """State of the bridge."""
        return self.supervised.mode


class TickResult(Struct, frozen=True, gc=False):
    """What a tick did.

    Attributes:
        frames: Frames to send, stamped with the tick's time.
        step_input: What the last step of the tick was given.
        output: What the tick published.
        counts: Counts since the start.
        device_faults: Indices of the devices that are at fault, and their faults.
    """

    frames: list[Frame]
    step_input: StepInput
    output: StepOutput
    counts: Counts
    device_faults: tuple[tuple[int, str], ...] = ()


class Bridge:
    """The whole of a tick; the indices of the bench's channels are their positions."""

    def __init__(
        self,
        supervisor: Supervisor,
        channels: Sequence[Channel],
        incoming: Sequence[Incoming],
        outgoing: Sequence[Outgoing],
        devices: Sequence[Device],
        limits: Limits,
        sensors: VirtualSensors | None = None,
    ) -> None:
        self.supervisor = supervisor
        """What owns the mode."""
        settings = supervisor.settings
        arming = Arming(settings.arming, channels, settings.safe_after_ns)
        self._operation = Operation(arming, settings.fade_in_s, settings.slew_n_per_s)
        self._channels = tuple(channels)
        self._immediate = self._operation.switches | supervisor.compared
        self._outgoing = tuple(outgoing)
        self._devices = tuple(devices)
        self._sensors = sensors
        own = frozenset(item.message.key for item in outgoing)
        struts = supervisor.estimator.struts
        self._checks = FrameChecks(incoming, own, devices, channels, limits.channels)
        self._nothing = (StrutOutput(0.0, 0.0, False, 0.0, 0.0, 0.0, 0.0),) * struts
        self._awaited = tuple(
            index for index, item in enumerate(incoming) if item.is_awaited and item.follow
        )
        self.filters = _filters(incoming, outgoing, devices)
        """What admits the frames that the bridge subscribes to, its own among them."""

    @property
    def observers(self) -> Sequence[AnyObserver]:
        """Observers of the struts."""
        return self.supervisor.estimator.observers

    @property
    def incoming(self) -> tuple[Incoming, ...]:
        """Messages of the bench."""
        return self._checks.incoming

    @property
    def directory(self) -> Directory:
        """Index of the incoming message that a frame is of."""
        return self._checks.directory

    def with_settings(
        self, observers: Sequence[AnyObserver], supervision: Supervision, limits: Limits
    ) -> "Bridge":
        """The same with other observers and limits; it continues from a state of this one."""
        return Bridge(
            self.supervisor.with_settings(observers, supervision, limits.struts),
            self._channels,
            self.incoming,
            self._outgoing,
            self._devices,
            limits,
            self._sensors,
        )

    def init(self, t_ns: int) -> BridgeState:
        """State before the first tick."""
        sendings = (Sending(0, t_ns),) * len(self._outgoing)
        sequences, memory = self._checks.init(t_ns)
        supervised = self.supervisor.init(t_ns)
        clocks = (None,) * len(self.incoming)
        operation = OperationState(t_ns)
        return BridgeState(
            supervised,
            sequences,
            memory,
            sendings,
            memory.counts,
            clocks=clocks,
            operation=operation,
        )

    def take_over(self, state: BridgeState, before: "Bridge", t_ns: int) -> BridgeState:
        """State of a bridge that ran before; with other observers it has to settle again.

        Another way of arming begins unarmed, and limits that count as passed stay so.
        """
        supervised = self.supervisor.take_over(state.supervised, before.supervisor, t_ns)
        operation = state.operation
        if self.supervisor.settings.arming != before.supervisor.settings.arming:
            operation = replace(operation, arming=replace(operation.arming, is_armed=False))
        memory = self._checks.take_over(state.memory)
        state = replace(state, supervised=supervised, operation=operation, memory=memory)
        if self.observers == before.observers:
            return state
        estimator = self.supervisor.estimator.unsettle(supervised.estimator, t_ns)
        return replace(state, supervised=replace(supervised, estimator=estimator), past=())

    def end(
        self, state: BridgeState, t_ns: int, conditions: Conditions = _NO_CONDITIONS
    ) -> tuple[BridgeState, list[Frame]]:
        """State and frames at the end of a run: every message once, with the safe output."""
        due = tuple(Sending(item.number, t_ns) for item in state.sendings)
        output = self.supervisor.end(state.supervised)
        safe_n = self.supervisor.safe_forces_n(state.supervised)
        operation, output = self._operation.publish(state.operation, t_ns, output, safe_n)
        state = replace(state, sendings=due, operation=operation)
        sent = self._send(state, t_ns, output, state.counts, conditions)
        return replace(state, sendings=sent[0]), sent[1]

    def is_at_rest(self, state: BridgeState) -> bool:
        """Whether the published force has arrived at the safe output; at the end of a run."""
        safe_n = self.supervisor.safe_forces_n(state.supervised)
        return self._operation.is_at_rest(state.operation, safe_n)

    def stop_ramp(self, state: BridgeState) -> BridgeState:
        """State whose next output is the safe one, wherever a ramp has come."""
        return replace(state, operation=replace(state.operation, published_n=()))

    def tick(
        self,
        state: BridgeState,
        t_ns: int,
        frames: Sequence[Frame],
        conditions: Conditions = _NO_CONDITIONS,
    ) -> tuple[BridgeState, TickResult]:
        """State after a tick, and what it did; frames of other ids are passed over."""
        reception = Reception(state.sequences, state.clocks, state.memory)
        supervised, past, samples = self._receive(state, reception, t_ns, frames)
        step_input = StepInput(t_ns, samples, conditions.request)
        memory, reports = reception.memory, NO_REPORTS
        if memory.standing:
            reception.require_standing()
        wrong: tuple[tuple[int, str], ...] = ()
        if self._devices:
            wrong = faults(self._devices, memory.healths, t_ns)
        share = state.missed_share
        if wrong or reception.action or share or conditions.overruns or conditions.log_fault:
            share = _share_of_overruns(share, conditions.overruns)
            reports = self._reports(state, t_ns, reception, conditions, share, wrong)
        operation, is_operated = state.operation, self._operation.is_used
        if is_operated:
            if step_input.request is Request.ACKNOWLEDGE and not self.is_at_rest(state):
                step_input = replace(step_input, request=None)
            operation = self._operation.update(operation, step_input, supervised.mode)
            reports = self._with_permission(reports, operation, t_ns)
        supervised, output, action = self.supervisor.step(supervised, step_input, reports)
        sensed = None
        if self._sensors is not None:
            sensed, output = self._read_sensors(state.sensed, supervised, output, t_ns)
        if is_operated:
            safe_n = self.supervisor.safe_forces_n(supervised)
            operation, output = self._operation.publish(operation, t_ns, output, safe_n)
        counts = count_tick(memory.counts, output, action, conditions, len(wrong))
        sent = self._send(state, t_ns, output, counts, conditions)
        sendings, sent_frames, counts, reported = sent
        if counts is not memory.counts:
            memory = replace(memory, counts=counts)
        after = BridgeState(
            supervised,
            tuple(reception.sequences),
            memory,
            sendings,
            reported,
            share,
            tuple(reception.clocks),
            () if supervised.mode in _NO_MODEL else past,
            operation,
            sensed,
        )
        return after, TickResult(sent_frames, step_input, output, counts, wrong)

    def _read_sensors(
        self,
        sensed: SensedState | None,
        supervised: SupervisedState,
        output: StepOutput,
        t_ns: int,
    ) -> tuple[SensedState | None, StepOutput]:
        """What the virtual sensors remember, and the output with what they show."""
        if self._sensors is None or supervised.mode in _NO_MODEL or not output.struts:
            return None, output
        estimator, state = self.supervisor.estimator, supervised.estimator
        if self._sensors.reads_model and estimator.model_of(state) is None:
            return None, output
        sensed, shown = self._sensors.read(sensed, t_ns, estimator, state, output.struts)
        return sensed, replace(output, sensors=shown)

    def _reports(
        self,
        state: BridgeState,
        t_ns: int,
        reception: Reception,
        conditions: Conditions,
        missed_share: float,
        wrong: Sequence[tuple[int, str]],
    ) -> Reports:
        """What the supervisor is given of a tick that is not as it should be."""
        vital = [index for index, _ in wrong if self._devices[index].is_vital]
        settings = self.supervisor.settings
        reports = Reports(
            reception.action,
            reception.excess,
            t_ns - state.supervised.t_ns if conditions.overruns else 0,
            missed_share if missed_share > settings.overload_share else 0.0,
            vital[0] if vital else -1,
            conditions.log_fault and settings.log_fault == "safe",
        )
        return NO_REPORTS if reports == NO_REPORTS else reports

    def _with_permission(self, reports: Reports, operation: OperationState, t_ns: int) -> Reports:
        """Reports with whether an estimate may be valid."""
        is_withheld = self._operation.is_withheld(operation, t_ns)
        interlock = self._operation.find_open_interlock(operation, t_ns)
        if not is_withheld and interlock is None:
            return reports
        return replace(reports, is_withheld=is_withheld, open_interlock=interlock)

    def _receive(
        self, state: BridgeState, reception: Reception, t_ns: int, frames: Sequence[Frame]
    ) -> tuple[SupervisedState, Past, tuple[Sample, ...]]:
        """Pass every frame through the checks; returns the samples of the tick's last step.

        Before it come the steps that late samples belong to, and those that a late tick missed.
        """
        before, past = state.supervised, state.past
        last_ns = before.t_ns
        samples: list[Sample] = []
        measured, awaited, is_in_order = 0, 0, True
        for incoming, values, frame_ns, _ in self._checks.receive(reception, frames):
            due_ns = min(frame_ns, t_ns)
            if incoming.is_awaited:
                if due_ns <= last_ns:
                    if past and due_ns <= past[0].since_ns:
                        reception.count_refusal("untimed")
                        continue
                    is_in_order = False
                elif measured & incoming.first_strut:
                    is_in_order = False
                awaited += 1
                measured |= incoming.struts
            for value, channel, delay_ns in incoming.deliveries:
                samples.append(Sample(channel, values[value], due_ns - delay_ns))
        step = PastStep(last_ns, t_ns, before.estimator, tuple(samples))
        if is_in_order and awaited == len(self._awaited):
            return before, (step,), step.samples
        awaited_ns = self._find_oldest_clock_ns(reception, last_ns)
        if is_in_order:
            return before, remember(past, step, awaited_ns), step.samples
        reports = NO_REPORTS
        if self._operation.is_used:
            reports = self._with_permission(reports, state.operation, last_ns)
        return self._receive_in_order(before, past, step, awaited_ns, reports)

    def _find_oldest_clock_ns(self, reception: Reception, t_ns: int) -> int:
        """Time up to which no sample can come any more: each message has sent a newer one."""
        clocks = [clock for index in self._awaited if (clock := reception.clocks[index])]
        times_ns = [min(clock.due_ns, clock.arrival_ns) for clock in clocks]
        return min(times_ns) if len(times_ns) == len(self._awaited) > 0 else t_ns

    def _receive_in_order(
        self,
        supervised: SupervisedState,
        past: Past,
        step: PastStep,
        awaited_ns: int,
        reports: Reports,
    ) -> tuple[SupervisedState, Past, tuple[Sample, ...]]:
        """State before the last step of a tick with samples that belong to earlier ones.

        `reports` are those of the steps that a late tick missed.
        """
        due_ns = partial(arrival_ns, self._channels)
        samples = sorted(step.samples, key=due_ns)
        late = [item for item in samples if due_ns(item) <= step.since_ns] if past else []
        if late:
            estimator = self.supervisor.estimator
            after, past = use_late_samples(estimator, self._channels, past, late)
            supervised = replace(supervised, estimator=after)
            samples = [*self._find_immediate(late), *samples[len(late) :]]
        step = PastStep(step.since_ns, step.t_ns, supervised.estimator, tuple(samples))
        last_valid = supervised.last_valid
        *missed, last = steps_of(self._channels, samples, step.t_ns, step.since_ns)
        for step_input in missed:
            # Nothing of this step is published.
            supervised, _, _ = self.supervisor.step(supervised, step_input, reports)
            supervised = replace(supervised, last_valid=last_valid)
        earlier = [item for step_input in missed for item in step_input.samples]
        now = (*self._find_immediate(earlier), *last.samples)
        return supervised, remember(past, step, awaited_ns), now

    def _find_immediate(self, samples: Sequence[Sample]) -> list[Sample]:
        """Samples that count from now on although they belong to earlier steps.

        A switch has no past, and a load cell is compared with the estimate at its time.
        """
        return [item for item in samples if item.channel in self._immediate]

    def _send(
        self,
        state: BridgeState,
        t_ns: int,
        output: StepOutput,
        counts: Counts,
        conditions: Conditions,
    ) -> tuple[tuple[Sending, ...], list[Frame], Counts, Counts]:
        """State of the outgoing messages, frames to send, counts, and counts as reported."""
        frames: list[Frame] = []
        sendings, reported = state.sendings, state.reported
        if not sendings:
            return sendings, frames, counts, reported
        if not output.struts:
            output = replace(output, struts=self._nothing)
        after = list(sendings)
        for index, item in enumerate(self._outgoing):
            sending = sendings[index]
            if t_ns < sending.due_ns:
                continue
            report = Report(output, counts, reported, conditions, sending.number)
            frame, saturated = item.frame(report, t_ns)
            frames.append(frame)
            due_ns = _next_due_ns(sending.due_ns, t_ns, item.period_ns)
            after[index] = Sending(sending.number + 1, due_ns)
            # A frame reports what was counted before it; one that cannot be sent reports nothing.
            if item.is_status and not conditions.bus_fault:
                reported = counts
            if saturated:
                counts = counts._replace(saturated=counts.saturated + 1)
        return tuple(after), frames, counts, reported


def _share_of_overruns(share: float, missed: int) -> float:
    """Share of missed ticks after some that were missed and one that was not, fading."""
    share = _FADING * (1.0 - (1.0 - share) * _FADING ** min(missed, _MOST_AT_ONCE))
    return share if share > _LEAST_SHARE else 0.0


def _filters(
    incoming: Sequence[Incoming], outgoing: Sequence[Outgoing], devices: Sequence[Device]
) -> tuple[Filter, ...]:
    """Filters of all messages, of the devices' own frames, and of address claims."""
    of_messages = Directory(item.message for item in (*incoming, *outgoing)).filters
    of_devices = (
        Filter(key, _ALL_STANDARD, is_extended=False) for device in devices for key in device.ids
    )
    by_name = any(device.j1939_name is not None for device in devices)
    claims = (Filter(CLAIM, CLAIM_MASK, is_extended=True),) if by_name else ()
    return (*of_messages, *of_devices, *claims)


def _next_due_ns(due_ns: int, t_ns: int, period_ns: int) -> int:
    """On the message's own grid; what was missed is not sent later."""
    if not period_ns:
        return t_ns
    return due_ns + ((t_ns - due_ns) // period_ns + 1) * period_ns
