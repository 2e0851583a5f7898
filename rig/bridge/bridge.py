"""Frames in, frames out: one tick of the bridge, without bus, clock or file.

A refused frame is counted and never used in part; values come from accepted frames alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from can_dbc.addressing import Directory, Filter
from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, FrameStatus, SequenceState
from rig.bridge.contract import (
    NO_OTHERS,
    Core,
    CoreState,
    Measurement,
    Mode,
    Reading,
    StepInput,
    StepOutput,
)
from rig.bridge.devices import (
    CLAIM,
    CLAIM_MASK,
    Device,
    Health,
    after_alarm,
    after_claim,
    after_data,
    after_frame,
    is_from,
    trouble,
    troubles,
    well,
)
from rig.bridge.messages import Conditions, Counts, Incoming, Outgoing, Report
from rig.bridge.supervisor import (
    EVENTS_BEYOND,
    Action,
    Limit,
    Seen,
    beyond,
    judged,
    next_mode,
)

_NO_CONDITIONS = Conditions()
_ALL_STANDARD = 0x7FF

RIVAL_FRAMES = 12
"""Frames out of sequence, one hardly after the other, that only a second sender explains: a sender
that starts anew is believed after three, and frames that overtake others come singly."""

_RIVAL_CYCLES = 3
"""Cycle times within which one follows the other."""


class Strays(NamedTuple):
    """Frames of a message that contradicted its counter, one hardly after the other.

    Attributes:
        frames: How many in a row.
        t_ns: When the last one came.
    """

    frames: int = 0
    t_ns: int = 0


class Sending(Struct, frozen=True, gc=False):
    """Where an outgoing message stands.

    Attributes:
        number: Frames sent so far.
        due_ns: When the next one is due.
    """

    number: int
    due_ns: int


class Ledger(Struct, frozen=True, gc=False):
    """What is remembered of the unusual; most ticks leave it as it is.

    Attributes:
        counts: What has been counted.
        reported: What the last status knew of it.
        seen: What plausibility remembers of each strut's measurements.
        strays: Of each incoming message, the frames that contradicted its counter.
    """

    counts: Counts
    reported: Counts
    seen: tuple[Seen | None, ...]
    strays: tuple[Strays, ...]


class BridgeState(Struct, frozen=True, gc=False):
    """State of the bridge between two ticks.

    Attributes:
        core: State of the core.
        sequences: Counter state of each incoming message.
        sendings: Where each outgoing message stands.
        ledger: What is remembered beside.
        healths: What is known of each device.
    """

    core: CoreState
    sequences: tuple[SequenceState, ...]
    sendings: tuple[Sending, ...]
    ledger: Ledger
    healths: tuple[Health, ...] = ()

    @property
    def counts(self) -> Counts:
        """What has been counted."""
        return self.ledger.counts


class TickResult(Struct, frozen=True, gc=False):
    """What a tick did.

    Attributes:
        frames: Frames to send, stamped with the tick's time.
        step_input: What the core was given.
        output: What the core published.
        counts: What has been counted since the start.
        troubles: Devices with something wrong, by their places, and what it is.
    """

    frames: list[Frame]
    step_input: StepInput
    output: StepOutput
    counts: Counts
    troubles: tuple[tuple[int, str], ...] = ()


class _Received(Struct, frozen=True, gc=False):
    """What the frames of a tick are to the core.

    Attributes:
        core: The core after all measurements that newer ones followed.
        heights: What is left of heights.
        others: What is left of other quantities.
        readings: What is left of readings of further sensors.
        sequences: Counter state of each incoming message.
        ledger: What is remembered beside.
        action: The severest action that the limits on measurements ask for, 0 if none.
        healths: What is known of each device.
    """

    core: CoreState
    heights: list[Measurement | None]
    others: list[float | None]
    readings: list[Reading]
    sequences: list[SequenceState]
    ledger: Ledger
    action: int
    healths: tuple[Health, ...]


class Bridge:
    """The whole of a tick.

    Args:
        core: The arithmetic.
        incoming: Messages of the bench.
        outgoing: Messages of the bridge.
        limits: What is done beyond which values.
        devices: Devices that say how they are.
    """

    def __init__(
        self,
        core: Core,
        incoming: Sequence[Incoming],
        outgoing: Sequence[Outgoing],
        limits: Sequence[Limit] = (),
        devices: Sequence[Device] = (),
    ) -> None:
        self.core = core
        self.devices = tuple(devices)
        self._device_at = {key: place for place, item in enumerate(devices) for key in item.ids}
        self.incoming = tuple(incoming)
        self._measured_limits = tuple(item for item in limits if item.watched.is_measured)
        self._limits = tuple(item for item in limits if not item.watched.is_measured)
        self._outgoing = tuple(outgoing)
        self._no_heights: list[Measurement | None] = [None] * core.struts
        self.directory = Directory(item.message for item in incoming)
        """Which incoming message a frame is of."""
        self._own = frozenset(item.message.key for item in outgoing)
        of_messages = Directory(item.message for item in (*incoming, *outgoing)).filters
        of_devices = (Filter(key, _ALL_STANDARD, is_extended=False) for key in self._device_at)
        by_name = any(device.j1939_name is not None for device in devices)
        claims = (Filter(CLAIM, CLAIM_MASK, is_extended=True),) if by_name else ()
        self.filters = (*of_messages, *of_devices, *claims)
        """What lets in the frames that the bridge subscribes to, its own among them."""

    def changed(self, core: Core, limits: Sequence[Limit]) -> "Bridge":
        """The same with another core and other limits; it goes on from the state of this one."""
        return Bridge(core, self.incoming, self._outgoing, limits, self.devices)

    def init(self, t_ns: int) -> BridgeState:
        """State before the first tick."""
        messages = len(self.incoming)
        nothing = Ledger(Counts(), Counts(), (None,) * self.core.struts, (Strays(),) * messages)
        sendings = (Sending(0, t_ns),) * len(self._outgoing)
        healths = tuple(well(device, t_ns) for device in self.devices)
        return BridgeState(self.core.init(t_ns), (INITIAL,) * messages, sendings, nothing, healths)

    def tick(
        self,
        state: BridgeState,
        t_ns: int,
        frames: Sequence[Frame],
        conditions: Conditions = _NO_CONDITIONS,
    ) -> tuple[BridgeState, TickResult]:
        """One tick.

        Args:
            state: State after the last tick.
            t_ns: Time of this one.
            frames: Frames that have arrived since then; those of other ids are passed over.
            conditions: What the loop knows.

        Returns:
            State after the tick, and what it did.
        """
        received = self._received(state, t_ns, frames)
        step_input = StepInput(
            t_ns,
            tuple(received.heights),
            tuple(received.others),
            conditions.acknowledged,
            tuple(received.readings),
        )
        core, output = self.core.step(received.core, step_input)
        action = received.action
        if self._limits or action:
            core, output, action = self._limited(state.core, core, output, action)
        wrong = troubles(self.devices, received.healths, t_ns) if self.devices else ()
        if wrong and any(self.devices[place].is_vital for place, _ in wrong):
            core, output, _ = self._limited(state.core, core, output, Action.HOLD)
        ledger = _noted(received.ledger, output, action, conditions, len(wrong))
        sendings, sent, ledger = self._sent(state.sendings, t_ns, output, ledger, conditions)
        sequences = tuple(received.sequences)
        after = BridgeState(core, sequences, sendings, ledger, received.healths)
        return after, TickResult(sent, step_input, output, ledger.counts, wrong)

    def _received(self, state: BridgeState, t_ns: int, frames: Sequence[Frame]) -> _Received:
        """Refuse or read every frame.

        A late tick finds several measurements of one strut. Each is used at its own time, or the
        model would run away under a force that was constant over the whole gap.
        """
        core, ledger, sequences, action = state.core, state.ledger, list(state.sequences), 0
        healths = state.healths
        heights, others = self._no_heights.copy(), list(NO_OTHERS)
        readings: list[Reading] = []
        for frame in frames:
            place = self.directory.index_of(frame.arbitration_id, frame.is_extended)
            if place is None or frame.is_error:
                healths = self._told(healths, frame)
                ledger = self._foreign(ledger, frame)
                continue
            incoming = self.incoming[place]
            sequences[place], verdict, values = incoming.read(sequences[place], frame)
            if verdict is not FrameStatus.OK:
                ledger = self._judged(ledger, place, frame.t_ns, verdict, sequences[place])
            if incoming.device is not None:
                healths, ledger, values = self._from_device(healths, ledger, frame, place, values)
            if values is None:
                continue
            if self._measured_limits:
                ledger, asked = self._plausible(ledger, incoming, frame.t_ns, values)
                action = max(action, asked)
                if asked >= Action.REFUSE:
                    continue
            if incoming.heights and heights[incoming.heights[0].strut] is not None:
                core, readings = self._caught_up(core, heights, others, readings)
                heights, others = self._no_heights.copy(), list(NO_OTHERS)
            arrived_ns = min(frame.t_ns, t_ns)
            _put(heights, others, readings, incoming, arrived_ns, values)
        return _Received(core, heights, others, readings, sequences, ledger, action, healths)

    def _caught_up(
        self,
        core: CoreState,
        heights: list[Measurement | None],
        others: list[float | None],
        readings: list[Reading],
    ) -> tuple[CoreState, list[Reading]]:
        """The core at the time of measurements that newer ones follow, and what is later still."""
        t_ns = max([core.t_ns, *[item.t_ns + item.delay_ns for item in heights if item]])
        due = tuple(reading for reading in readings if reading.t_ns <= t_ns)
        given = StepInput(t_ns, tuple(heights), tuple(others), readings=due)
        return self.core.step(core, given)[0], [item for item in readings if item.t_ns > t_ns]

    def _told(self, healths: tuple[Health, ...], frame: Frame) -> tuple[Health, ...]:
        """What is known of the devices after a frame of no incoming message."""
        if not healths or frame.is_error:
            return healths
        if frame.is_extended and frame.arbitration_id & CLAIM_MASK == CLAIM & CLAIM_MASK:
            pairs = zip(self.devices, healths, strict=True)
            return tuple([after_claim(device, health, frame) for device, health in pairs])
        place = None if frame.is_extended else self._device_at.get(frame.arbitration_id)
        if place is None:
            return healths
        health = after_frame(self.devices[place], healths[place], frame)
        return (*healths[:place], health, *healths[place + 1 :])

    def _foreign(self, ledger: Ledger, frame: Frame) -> Ledger:
        """After a frame of no incoming message: error frames, or somebody under our ids."""
        if frame.is_error or (frame.arbitration_id, frame.is_extended) not in self._own:
            return ledger
        counts = ledger.counts
        return replace(ledger, counts=counts._replace(second_sender=counts.second_sender + 1))

    def _judged(
        self, ledger: Ledger, place: int, t_ns: int, verdict: FrameStatus, sequence: SequenceState
    ) -> Ledger:
        """After a frame that did not simply follow the one before."""
        counts = _counted(ledger.counts, verdict, sequence)
        if verdict is not FrameStatus.OUT_OF_SEQUENCE:
            return replace(ledger, counts=counts)
        strays, rival = self._stray(ledger.strays, place, t_ns)
        counts = counts._replace(second_sender=counts.second_sender + rival)
        return replace(ledger, counts=counts, strays=strays)

    def _stray(
        self, strays: tuple[Strays, ...], place: int, t_ns: int
    ) -> tuple[tuple[Strays, ...], bool]:
        """Strays after another one, and whether only a second sender explains them."""
        cycle_ns = self.incoming[place].message.cycle_time_ns or 0
        before = strays[place]
        follows = t_ns - before.t_ns <= _RIVAL_CYCLES * cycle_ns
        stray = Strays(before.frames + 1 if follows else 1, t_ns)
        return (*strays[:place], stray, *strays[place + 1 :]), stray.frames >= RIVAL_FRAMES

    def _from_device(
        self,
        healths: tuple[Health, ...],
        ledger: Ledger,
        frame: Frame,
        place: int,
        values: tuple[float, ...] | None,
    ) -> tuple[tuple[Health, ...], Ledger, tuple[float, ...] | None]:
        """After a device's frame: its values, or None if something is wrong with the device."""
        incoming = self.incoming[place]
        device = incoming.device
        if device is None or values is None:
            return healths, ledger, values
        if not is_from(self.devices[device], healths[device], frame):
            return healths, ledger, None  # another device sends the same group
        health = after_data(self.devices[device], healths[device])
        healths = _alarmed((*healths[:device], health, *healths[device + 1 :]), incoming, values)
        if trouble(self.devices[device], healths[device], frame.t_ns) is None:
            return healths, ledger, values
        counts = ledger.counts
        refused, more = counts.refused + 1, counts.from_faulty_device + 1
        counts = counts._replace(refused=refused, from_faulty_device=more)
        return healths, replace(ledger, counts=counts), None

    def _plausible(
        self, ledger: Ledger, incoming: Incoming, arrived_ns: int, values: tuple[float, ...]
    ) -> tuple[Ledger, int]:
        """The severest action that an accepted frame's measurements ask for.

        A frame is used whole or not at all: from `Action.REFUSE` on it is to be dropped.
        """
        seen, action = list(ledger.seen), 0
        for target in incoming.heights:
            measured = Measurement(values[target.value], arrived_ns)
            remembered, asked = judged(self._measured_limits, seen[target.strut], measured)
            seen[target.strut], action = remembered, max(action, asked)
        if action < Action.REFUSE:
            return replace(ledger, seen=tuple(seen)), action
        counts = ledger.counts
        refused, implausible = counts.refused + 1, counts.implausible + 1
        counts = counts._replace(refused=refused, implausible=implausible)
        return replace(ledger, counts=counts), action

    def _limited(
        self, before: CoreState, core: CoreState, output: StepOutput, action: int
    ) -> tuple[CoreState, StepOutput, int]:
        """State, output and action of a tick, with the limits on its estimates seen to."""
        if output.mode in (Mode.RUNNING, Mode.HOLD):
            action = max([action, *[beyond(self._limits, strut) for strut in output.struts]])
        event = EVENTS_BEYOND.get(Action(action)) if action else None
        if event is None:
            return core, output, action
        mode = next_mode(core.mode, event)
        if mode is Mode.SAFE and core.mode is not Mode.SAFE:
            core = replace(core, mode=mode, last_valid=before.last_valid)
            core, output = self.core.step(core, StepInput(core.t_ns, tuple(self._no_heights)))
        elif mode is Mode.HOLD:
            core = replace(core, mode=mode, last_valid=before.last_valid)
            struts = tuple([replace(strut, valid=False) for strut in output.struts])
            output = StepOutput(mode, struts, output.left_out)
        return core, output, action

    def _sent(
        self,
        sendings: tuple[Sending, ...],
        t_ns: int,
        output: StepOutput,
        ledger: Ledger,
        conditions: Conditions,
    ) -> tuple[tuple[Sending, ...], list[Frame], Ledger]:
        """Where the outgoing messages stand, frames to send, and what is remembered."""
        frames: list[Frame] = []
        if not output.struts:  # nothing is sent before the first valid measurement
            return sendings, frames, ledger
        after = list(sendings)
        for place, item in enumerate(self._outgoing):
            sending = sendings[place]
            if t_ns < sending.due_ns:
                continue
            report = Report(output, ledger.counts, ledger.reported, conditions, sending.number)
            frame, saturated = item.frame(report, t_ns)
            frames.append(frame)
            due_ns = _next_due_ns(sending.due_ns, t_ns, item.period_ns)
            after[place] = Sending(sending.number + 1, due_ns)
            if item.is_status or saturated:
                ledger = _reported(ledger, item, conditions, saturated=saturated)
        return tuple(after), frames, ledger


def _put(
    heights: list[Measurement | None],
    others: list[float | None],
    readings: list[Reading],
    incoming: Incoming,
    arrived_ns: int,
    values: Sequence[float],
) -> None:
    """Put the values of a frame where they belong."""
    for target in incoming.heights:
        delay_ns = target.delay_ns
        height_m = values[target.value]
        heights[target.strut] = Measurement(height_m, arrived_ns - delay_ns, delay_ns)
    for target in incoming.others:
        others[target.place] = values[target.value]
    for target in incoming.sensors:
        value = values[target.value]
        readings.append(Reading(target.sensor, value, arrived_ns - target.delay_ns))


def _alarmed(
    healths: tuple[Health, ...], incoming: Incoming, values: Sequence[float]
) -> tuple[Health, ...]:
    """What is known of the devices after the alarms in a frame."""
    for target in incoming.alarms:
        place = target.device
        health = after_alarm(healths[place], target.alarm, int(values[target.value]))
        healths = (*healths[:place], health, *healths[place + 1 :])
    return healths


def _noted(
    ledger: Ledger, output: StepOutput, action: int, conditions: Conditions, faulty_devices: int
) -> Ledger:
    """After a tick; most are as they should be."""
    holds = output.mode is Mode.HOLD
    beside = conditions.overruns or conditions.bus_fault or output.left_out or faulty_devices
    if not (action or holds or beside):
        return ledger
    counts = ledger.counts
    counts = counts._replace(
        overruns=counts.overruns + conditions.overruns,
        stale=counts.stale + holds,
        limited=counts.limited + (action > 0),
        bus_faulty=counts.bus_faulty + conditions.bus_fault,
        left_out=counts.left_out + len(output.left_out),
        device_faulty=counts.device_faulty + faulty_devices,
    )
    return replace(ledger, counts=counts)


def _reported(ledger: Ledger, item: Outgoing, conditions: Conditions, *, saturated: bool) -> Ledger:
    """After a status, or after a frame with a value at the end of its range."""
    counts = ledger.counts
    if saturated:
        ledger = replace(ledger, counts=counts._replace(saturated=counts.saturated + 1))
    # A frame reports what was counted before it; one that cannot be sent reports nothing.
    if item.is_status and not conditions.bus_fault:
        ledger = replace(ledger, reported=counts)
    return ledger


def _next_due_ns(due_ns: int, t_ns: int, period_ns: int) -> int:
    """On the message's own grid; what was missed is not made up for."""
    if not period_ns:
        return t_ns
    return due_ns + ((t_ns - due_ns) // period_ns + 1) * period_ns


_CAUSES = {
    FrameStatus.WRONG_CRC: "wrong_crc",
    FrameStatus.WRONG_LENGTH: "wrong_length",
    FrameStatus.REPEATED: "repeated",
    FrameStatus.OUT_OF_SEQUENCE: "out_of_sequence",
    FrameStatus.MASQUERADE: "masquerade",
    FrameStatus.NO_VALUE: "no_value",
}
"""FrameStatus of a refused frame -> what counts it."""


def _counted(counts: Counts, verdict: FrameStatus, sequence: SequenceState) -> Counts:
    if verdict is FrameStatus.FIRST:
        return counts._replace(started=counts.started + 1)
    if verdict.is_accepted:
        return counts._replace(lost=counts.lost + sequence.lost)
    cause = _CAUSES[verdict]
    return counts._replace(**{"refused": counts.refused + 1, cause: getattr(counts, cause) + 1})
