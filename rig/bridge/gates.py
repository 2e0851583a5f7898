"""The gates that a frame passes before its values are used, in their order.

1. addressed: it is a frame of a message that the bridge reads (`Gates.receive`). What is not may be
   a heartbeat, an emergency or an address claim of a device, or a second sender.
2. protected: its length, CRC and counter are right, and its signals hold values (`_protected`).
3. sent by its device: its sender is the configured device (`_sent_by_device`).
4. healthy sender: that device is not at fault (`_healthy_sender`).
5. plausible: no limit refuses its heights (`_plausible`).

Whether a frame is authentic is decided before, on the bus (`rig.bus.secoc`). A frame that a gate
refuses is counted there and used in no part.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from msgspec import Struct

from can_dbc.addressing import Directory
from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, SequenceState, Verdict
from rig.bridge.devices import (
    CLAIM,
    CLAIM_MASK,
    Device,
    DeviceHealth,
    fault,
    initial_health,
    is_from,
    update_by_alarm,
    update_by_claim,
    update_by_data,
    update_by_frame,
)
from rig.bridge.incoming import Incoming, Values
from rig.bridge.limits import Action, Limit, Plausibility, judge_height
from rig.bridge.report import Counts

SECOND_SENDER_FRAMES = 12
"""Frames out of sequence in close succession that only a second sender explains: a restarted sender
is accepted after three, and frames that overtake others are single."""

_SUCCESSION_CYCLES = 3
"""Cycle times within which one frame is in close succession to the other."""


class Strays(NamedTuple):
    """Frames of a message that contradicted its counter, in close succession.

    Attributes:
        frames: Their number.
        t_ns: Time of the last one.
    """

    frames: int = 0
    t_ns: int = 0


class GateState(Struct, frozen=True, gc=False):
    """What the gates remember between two ticks.

    Attributes:
        sequences: Counter state of each incoming message.
        strays: Frames of each incoming message that contradicted its counter.
        heights: Memory of each strut's measured heights.
        healths: Health of each device.
        counts: Counts since the start.
    """

    sequences: tuple[SequenceState, ...]
    strays: tuple[Strays, ...]
    heights: tuple[Plausibility | None, ...]
    healths: tuple[DeviceHealth, ...]
    counts: Counts


class Reception:
    """The gates' state while the frames of one tick pass; written in place.

    Args:
        state: State at the beginning of the tick.

    Attributes:
        action: Severest action that limits on measurements require, 0 if none.
    """

    __slots__ = ("action", "counts", "healths", "heights", "sequences", "strays")

    def __init__(self, state: GateState) -> None:
        self.sequences = list(state.sequences)
        self.strays, self.heights, self.healths = state.strays, state.heights, state.healths
        self.counts = state.counts
        self.action = 0

    def refuse(self, cause: str) -> None:
        """Count a refused frame, and its cause: the name of one of `Counts`."""
        counts = self.counts
        self.counts = counts._replace(
            **{"refused": counts.refused + 1, cause: getattr(counts, cause) + 1}
        )

    def set_health(self, index: int, health: DeviceHealth) -> None:
        """Replace the health of a device."""
        self.healths = (*self.healths[:index], health, *self.healths[index + 1 :])

    def state(self) -> GateState:
        """State at the end of the tick."""
        return GateState(
            tuple(self.sequences), self.strays, self.heights, self.healths, self.counts
        )


Gate = Callable[[Reception, Frame, Values], Values | None]
"""Passes a frame's values on, or refuses the frame: None."""


class Gates:
    """The gates of a bridge.

    Args:
        incoming: Messages that the bridge reads.
        own: Identifiers of the messages that it sends itself, as of `Message.key`.
        devices: Devices that it watches.
        limits: Limits, of which those on measurements are used.
        struts: Number of struts.
    """

    def __init__(
        self,
        incoming: Sequence[Incoming],
        own: frozenset[tuple[int, bool]],
        devices: Sequence[Device],
        limits: Sequence[Limit],
        struts: int,
    ) -> None:
        self.incoming = tuple(incoming)
        self.directory = Directory(item.message for item in incoming)
        """Index of the incoming message that a frame is of."""
        self._own = own
        self._devices = tuple(devices)
        self._device_of_id = {key: index for index, item in enumerate(devices) for key in item.ids}
        self._limits = tuple(limit for limit in limits if limit.value.is_measured)
        self._struts = struts
        self._gates = [self._gates_of(item) for item in incoming]
        self._index_of = self.directory.place

    def init(self, t_ns: int) -> GateState:
        """State before the first tick."""
        messages = len(self.incoming)
        return GateState(
            (INITIAL,) * messages,
            (Strays(),) * messages,
            (None,) * self._struts,
            tuple(initial_health(device, t_ns) for device in self._devices),
            Counts(),
        )

    def receive(self, reception: Reception, frame: Frame) -> tuple[Incoming, Values] | None:
        """Pass a frame through all gates.

        Returns:
            Its message and its values, or None if a gate refused it.
        """
        index = self._index_of(frame.arbitration_id, frame.is_extended)
        if index is None or frame.is_error:
            self._receive_other(reception, frame)
            return None
        incoming = self.incoming[index]
        sequence, verdict, values = incoming.read(reception.sequences[index], frame)
        reception.sequences[index] = sequence
        if verdict is not Verdict.OK:
            self._count(reception, index, frame.t_ns, verdict)
        for gate in self._gates[index]:
            if values is None:
                return None
            values = gate(reception, frame, values)
        return None if values is None else (incoming, values)

    def _receive_other(self, reception: Reception, frame: Frame) -> None:
        """Receive a frame of no incoming message: of a device, or of a second sender."""
        if frame.is_error:
            return
        if reception.healths:
            self._update_healths(reception, frame)
        if (frame.arbitration_id, frame.is_extended) in self._own:
            counts = reception.counts
            reception.counts = counts._replace(second_sender=counts.second_sender + 1)

    def _update_healths(self, reception: Reception, frame: Frame) -> None:
        """Update the devices' health by a heartbeat, an emergency or an address claim."""
        if frame.is_extended and frame.arbitration_id & CLAIM_MASK == CLAIM & CLAIM_MASK:
            pairs = zip(self._devices, reception.healths, strict=True)
            reception.healths = tuple(
                [update_by_claim(device, health, frame) for device, health in pairs]
            )
            return
        index = None if frame.is_extended else self._device_of_id.get(frame.arbitration_id)
        if index is not None:
            health = update_by_frame(self._devices[index], reception.healths[index], frame)
            reception.set_health(index, health)

    def _count(self, reception: Reception, index: int, t_ns: int, verdict: Verdict) -> None:
        """Count a frame that did not simply follow the one before."""
        if verdict is Verdict.FIRST:
            reception.counts = reception.counts._replace(started=reception.counts.started + 1)
        elif verdict.accepted:
            lost = reception.counts.lost + reception.sequences[index].lost
            reception.counts = reception.counts._replace(lost=lost)
        else:
            reception.refuse(verdict.value)
        if verdict is Verdict.OUT_OF_SEQUENCE:
            self._count_stray(reception, index, t_ns)

    def _count_stray(self, reception: Reception, index: int, t_ns: int) -> None:
        """Count a frame that contradicts its message's counter, and a second sender if need be."""
        cycle_ns = self.incoming[index].message.cycle_time_ns or 0
        before = reception.strays[index]
        follows = t_ns - before.t_ns <= _SUCCESSION_CYCLES * cycle_ns
        stray = Strays(before.frames + 1 if follows else 1, t_ns)
        reception.strays = (*reception.strays[:index], stray, *reception.strays[index + 1 :])
        if stray.frames >= SECOND_SENDER_FRAMES:
            counts = reception.counts
            reception.counts = counts._replace(second_sender=counts.second_sender + 1)

    def _gates_of(self, incoming: Incoming) -> tuple[Gate, ...]:
        """The gates that a message needs after its protection, in their order."""
        gates: list[Gate] = []
        if incoming.device is not None:
            index, device = incoming.device, self._devices[incoming.device]
            gates += [_sent_by_device(index, device), _healthy_sender(incoming, index, device)]
        if self._limits and incoming.heights:
            gates.append(_plausible(incoming, self._limits))
        return tuple(gates)


def _sent_by_device(index: int, device: Device) -> Gate:
    """A gate for frames of the device alone: another one may send the same group."""

    def gate(reception: Reception, frame: Frame, values: Values) -> Values | None:
        return values if is_from(device, reception.healths[index], frame) else None

    return gate


def _healthy_sender(incoming: Incoming, index: int, device: Device) -> Gate:
    """A gate for frames of a healthy device; alarms in the frame itself count."""

    def gate(reception: Reception, frame: Frame, values: Values) -> Values | None:
        reception.set_health(index, update_by_data(device, reception.healths[index]))
        for alarm in incoming.alarms:
            health = reception.healths[alarm.device]
            raw = int(values[alarm.value])
            reception.set_health(alarm.device, update_by_alarm(health, alarm.alarm, raw))
        if fault(device, reception.healths[index], frame.t_ns) is None:
            return values
        reception.refuse("from_faulty_device")
        return None

    return gate


def _plausible(incoming: Incoming, limits: Sequence[Limit]) -> Gate:
    """A gate for heights within the limits: a frame is used whole or not at all."""

    def gate(reception: Reception, frame: Frame, values: Values) -> Values | None:
        heights, action = list(reception.heights), 0
        for target in incoming.heights:
            memory = heights[target.strut]
            heights[target.strut], required = judge_height(
                limits, memory, values[target.value], frame.t_ns
            )
            action = max(action, required)
        reception.action = max(reception.action, action)
        if action < Action.REFUSE:
            reception.heights = tuple(heights)
            return values
        reception.refuse("implausible")
        return None

    return gate
