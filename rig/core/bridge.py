"""Frames in, frames out: one tick of the bridge, without bus, clock or file.

A refused frame is counted and never used in part; values come from accepted frames alone.
"""

from collections.abc import Sequence
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, SequenceState, Verdict
from rig.core.messages import Conditions, Counts, Incoming, Outgoing, Quantity, Reader, Report
from rig.core.supervisor import (
    EVENTS_BEYOND,
    Action,
    Limit,
    Seen,
    beyond,
    judged,
    next_mode,
)
from rig.core.types import Core, Measurement, Mode, RigState, StepInput, StepOutput

_NO_CONDITIONS = Conditions()

# Looking up a member of an enum costs as much as the CRC of a frame.
_OK, _HOLD = Verdict.OK, Mode.HOLD

_OTHERS = (Quantity.APPLIED_FORCE, Quantity.TEMPERATURE, Quantity.LOAD_CELL_FORCE)
"""What comes beside heights, as the core is given it."""

_Heights = list[Measurement | None]
_Others = list[float | None]
"""What came of each strut, and of each of `_OTHERS`."""

_NO_OTHERS: _Others = [None] * len(_OTHERS)

RIVAL_FRAMES = 12
"""Frames out of sequence, one hardly after the other, that only a second sender explains: a sender
that starts anew is believed after three, and frames that overtake others come singly."""

_RIVAL_CYCLES = 3


class Strays(NamedTuple):
    """Frames of a message that contradicted its counter, one hardly after the other.

    Attributes:
        frames: How many in a row.
        t_ns: When the last one came.
    """

    frames: int = 0
    t_ns: int = 0


class Ledger(Struct, frozen=True, gc=False):
    """What is remembered of the unusual; most ticks leave it as it is.

    Attributes:
        counts: What has been counted.
        told: What the last status knew of it.
        seen: What plausibility remembers of each strut's measurements.
        strays: Of each incoming message, the frames that contradicted its counter.
    """

    counts: Counts
    told: Counts
    seen: tuple[Seen | None, ...]
    strays: tuple[Strays, ...]


class BridgeState(Struct, frozen=True, gc=False):
    """State of the bridge between two ticks.

    Attributes:
        rig: State of the core.
        sequences: Counter state of each incoming message.
        sendings: Of each outgoing message, how many frames were sent, and when the next is due, in
            ns.
        ledger: What is remembered beside.
    """

    rig: RigState
    sequences: tuple[SequenceState, ...]
    sendings: tuple[tuple[int, int], ...]
    ledger: Ledger

    @property
    def counts(self) -> Counts:
        """What has been counted."""
        return self.ledger.counts


class TickResult(Struct, frozen=True, gc=False):
    """What a tick did.

    Attributes:
        frames: Frames to send, stamped with the tick's time.
        step_input: What the core was given.
        output: What the core said.
    """

    frames: list[Frame]
    step_input: StepInput
    output: StepOutput


_Source = tuple[int, Reader, list[tuple[int, int]], list[tuple[int, int]]]
"""An incoming message as a tick wants it: its place among the incoming ones; what reads it; place
of a height among its values and the strut that it is of; place of another value and which one of
`_OTHERS` it is. A plain tuple is taken apart three times as fast as a named one."""


class Bridge:
    """The whole of a tick.

    Args:
        core: The arithmetic.
        incoming: Messages of the bench.
        outgoing: Messages of the bridge.
        limits: What is done beyond which values.
    """

    def __init__(
        self,
        core: Core,
        incoming: Sequence[Incoming],
        outgoing: Sequence[Outgoing],
        limits: Sequence[Limit] = (),
    ) -> None:
        self._core = core
        self._struts = core.struts
        self._measured_limits = tuple(item for item in limits if item.watched.is_measured)
        self._limits = tuple(item for item in limits if not item.watched.is_measured)
        self._incoming = tuple(incoming)
        # Numbered once: to count along costs as much as to make two small objects.
        self._outgoing = tuple(enumerate(outgoing))
        self._no_heights: _Heights = [None] * core.struts
        # By whether the id is extended, then by the id: half the time that a pair takes as a key.
        self._sources: tuple[dict[int, _Source], dict[int, _Source]] = ({}, {})
        for index, item in enumerate(incoming):
            message = item.message
            self._sources[message.is_extended][message.arbitration_id] = _source(index, item)
        self._own = frozenset(
            (item.message.arbitration_id, item.message.is_extended) for item in outgoing
        )

    @property
    def heard(self) -> frozenset[tuple[int, bool]]:
        """The (arbitration id, is extended) that the bridge listens to, its own among them."""
        messages = [item.message for item in self._incoming]
        return self._own.union((item.arbitration_id, item.is_extended) for item in messages)

    @property
    def core(self) -> Core:
        """The arithmetic."""
        return self._core

    @property
    def incoming(self) -> tuple[Incoming, ...]:
        """Messages of the bench."""
        return self._incoming

    @property
    def struts(self) -> int:
        """Number of struts."""
        return self._struts

    def init(self, t_ns: int) -> BridgeState:
        """State before the first tick."""
        sequences = (INITIAL,) * len(self._incoming)
        nothing = Ledger(
            Counts(), Counts(), (None,) * self._struts, (Strays(),) * len(self._incoming)
        )
        sendings = ((0, t_ns),) * len(self._outgoing)
        return BridgeState(self._core.init(t_ns), sequences, sendings, nothing)

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
        rig, heights, others, sequences, ledger, action = self._received(state, t_ns, frames)
        applied_n, temperature_c, load_cell_n = others
        acknowledged = conditions.acknowledged
        step_input = StepInput(
            t_ns, tuple(heights), applied_n, temperature_c, acknowledged, load_cell_n
        )
        rig, output = self._core.step(rig, step_input)
        if self._limits or action:
            rig, output, action = self._limited(state.rig, rig, output, action)
        if action or output.mode is _HOLD or conditions.overruns or conditions.bus_fault:
            ledger = _noted(ledger, output, action, conditions)
        sendings = list(state.sendings)
        sent: list[Frame] = []
        if output.struts:  # nothing is sent before the first valid measurement
            for index, item in self._outgoing:
                number, due_ns = sendings[index]
                if t_ns < due_ns:
                    continue
                report = Report(output, ledger.counts, ledger.told, conditions, number)
                frame, saturated = item.frame(report, t_ns)
                sent.append(frame)
                sendings[index] = (number + 1, _next_due_ns(due_ns, t_ns, item.period_ns))
                if item.is_status or saturated:
                    ledger = _told(ledger, item, conditions, saturated=saturated)
        state = BridgeState(rig, tuple(sequences), tuple(sendings), ledger)
        return state, TickResult(sent, step_input, output)

    def _received(
        self, state: BridgeState, t_ns: int, frames: Sequence[Frame]
    ) -> tuple[RigState, _Heights, _Others, list[SequenceState], Ledger, int]:
        """What the frames of a tick are to the core.

        A late tick finds several measurements of one strut. Each is used at its own time, or the
        model would run away under a force that was held for the whole gap.

        Returns:
            The core after all measurements that newer ones followed; what is left of heights and
            others; the counters' states, the ledger, and the gravest action that the limits on
            measurements ask for.
        """
        rig, ledger, sequences, action = state.rig, state.ledger, list(state.sequences), 0
        heights, others = self._no_heights.copy(), _NO_OTHERS.copy()
        for frame in frames:
            source = self._sources[frame.is_extended].get(frame.arbitration_id)
            if source is None or frame.is_error:
                ledger = self._foreign(ledger, frame)
                continue
            place, read, of_struts, of_others = source
            sequences[place], verdict, values = read(sequences[place], frame)
            if verdict is not _OK:
                ledger = self._judged(ledger, place, frame.t_ns, verdict, sequences[place])
            if values is None:
                continue
            if self._measured_limits:
                ledger, asked = self._plausible(ledger, of_struts, frame.t_ns, values)
                action = max(action, asked)
                if asked >= Action.REFUSE:
                    continue
            if of_struts and heights[of_struts[0][1]] is not None:
                rig = self._caught_up(rig, heights, others)
                heights, others = self._no_heights.copy(), _NO_OTHERS.copy()
            for number, strut in of_struts:
                arrived_ns = frame.t_ns if frame.t_ns < t_ns else t_ns
                heights[strut] = Measurement(values[number], arrived_ns)
            for number, other in of_others:
                others[other] = values[number]
        return rig, heights, others, sequences, ledger, action

    def _caught_up(self, rig: RigState, heights: _Heights, others: _Others) -> RigState:
        """The core at the time of measurements that newer ones follow."""
        t_ns = max([rig.t_ns, *[item.t_ns for item in heights if item]])
        applied_n, temperature_c, load_cell_n = others
        step_input = StepInput(
            t_ns, tuple(heights), applied_n, temperature_c, load_cell_force_n=load_cell_n
        )
        return self._core.step(rig, step_input)[0]

    def _foreign(self, ledger: Ledger, frame: Frame) -> Ledger:
        """After a frame of no incoming message: error frames, or somebody under our ids."""
        if frame.is_error or (frame.arbitration_id, frame.is_extended) not in self._own:
            return ledger
        counts = ledger.counts
        return replace(ledger, counts=counts._replace(second_sender=counts.second_sender + 1))

    def _judged(
        self, ledger: Ledger, index: int, t_ns: int, verdict: Verdict, sequence: SequenceState
    ) -> Ledger:
        """After a frame that did not simply follow the one before."""
        counts = _counted(ledger.counts, verdict, sequence)
        if verdict is not Verdict.OUT_OF_SEQUENCE:
            return replace(ledger, counts=counts)
        strays, rival = self._stray(ledger.strays, index, t_ns)
        counts = counts._replace(second_sender=counts.second_sender + rival)
        return replace(ledger, counts=counts, strays=strays)

    def _stray(
        self, strays: tuple[Strays, ...], index: int, t_ns: int
    ) -> tuple[tuple[Strays, ...], bool]:
        """Strays after another one, and whether only a second sender explains them."""
        cycle_ns = self._incoming[index].message.cycle_time_ns or 0
        before = strays[index]
        follows = t_ns - before.t_ns <= _RIVAL_CYCLES * cycle_ns
        stray = Strays(before.frames + 1 if follows else 1, t_ns)
        return (*strays[:index], stray, *strays[index + 1 :]), stray.frames >= RIVAL_FRAMES

    def _plausible(
        self,
        ledger: Ledger,
        of_struts: list[tuple[int, int]],
        arrived_ns: int,
        values: tuple[float, ...],
    ) -> tuple[Ledger, int]:
        """The gravest action that an accepted frame's measurements ask for.

        A frame is used whole or not at all: from `Action.REFUSE` on it is to be dropped.
        """
        seen, action = list(ledger.seen), 0
        for number, strut in of_struts:
            measured = Measurement(values[number], arrived_ns)
            seen[strut], asked = judged(self._measured_limits, seen[strut], measured)
            action = max(action, asked)
        if action < Action.REFUSE:
            return replace(ledger, seen=tuple(seen)), action
        counts = ledger.counts
        refused, implausible = counts.refused + 1, counts.implausible + 1
        counts = counts._replace(refused=refused, implausible=implausible)
        return replace(ledger, counts=counts), action

    def _limited(
        self, before: RigState, rig: RigState, output: StepOutput, action: int
    ) -> tuple[RigState, StepOutput, int]:
        """State, output and action of a tick, with the limits on its estimates seen to."""
        if output.mode in (Mode.RUNNING, Mode.HOLD):
            action = max([action, *[beyond(self._limits, strut) for strut in output.struts]])
        event = EVENTS_BEYOND.get(Action(action)) if action else None
        if event is None:
            return rig, output, action
        mode = next_mode(rig.mode, event)
        if mode is Mode.SAFE and rig.mode is not Mode.SAFE:
            rig = replace(rig, mode=mode, last_valid=before.last_valid)
            rig, output = self._core.step(rig, StepInput(rig.t_ns, (None,) * self._struts))
        elif mode is Mode.HOLD:
            rig = replace(rig, mode=mode, last_valid=before.last_valid)
            struts = tuple([replace(strut, valid=False) for strut in output.struts])
            output = StepOutput(mode, struts)
        return rig, output, action


def _source(place: int, item: Incoming) -> _Source:
    of_struts = [
        (number, target.strut)
        for number, target in enumerate(item.targets)
        if target.quantity is Quantity.HEIGHT
    ]
    of_others = [
        (number, _OTHERS.index(target.quantity))
        for number, target in enumerate(item.targets)
        if target.quantity is not Quantity.HEIGHT
    ]
    return place, item.read, of_struts, of_others


def _noted(ledger: Ledger, output: StepOutput, action: int, conditions: Conditions) -> Ledger:
    """After a tick that was not as it should be."""
    counts = ledger.counts
    counts = counts._replace(
        overruns=counts.overruns + conditions.overruns,
        stale=counts.stale + (output.mode is _HOLD),
        limited=counts.limited + (action > 0),
        bus_faulty=counts.bus_faulty + conditions.bus_fault,
    )
    return replace(ledger, counts=counts)


def _told(ledger: Ledger, item: Outgoing, conditions: Conditions, *, saturated: bool) -> Ledger:
    """After a status, or after a frame with a value at the end of its range."""
    counts = ledger.counts
    if not item.is_status:
        return replace(ledger, counts=counts._replace(saturated=counts.saturated + saturated))
    # A status that cannot be sent tells nobody.
    return ledger if conditions.bus_fault else replace(ledger, told=counts)


def _next_due_ns(due_ns: int, t_ns: int, period_ns: int) -> int:
    """On the message's own grid; what was missed is not made up for."""
    if due_ns == t_ns:
        return t_ns + period_ns
    late = (t_ns - due_ns) // period_ns if period_ns else 0
    return due_ns + (late + 1) * period_ns if period_ns else t_ns


_CAUSES = {
    Verdict.WRONG_CRC: "wrong_crc",
    Verdict.WRONG_LENGTH: "wrong_length",
    Verdict.REPEATED: "repeated",
    Verdict.OUT_OF_SEQUENCE: "out_of_sequence",
    Verdict.MASQUERADE: "masquerade",
}
"""Verdict of a refused frame -> what counts it."""


def _counted(counts: Counts, verdict: Verdict, sequence: SequenceState) -> Counts:
    if verdict is Verdict.FIRST:
        return counts._replace(started=counts.started + 1)
    if verdict.accepted:
        return counts._replace(lost=counts.lost + sequence.lost)
    cause = _CAUSES[verdict]
    return counts._replace(**{"refused": counts.refused + 1, cause: getattr(counts, cause) + 1})
