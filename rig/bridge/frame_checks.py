"""The checks that a frame passes before its values are used, in their order.

1. addressed: it is a frame of a message that the bridge reads (`FrameChecks.receive`). What is not
   may be a heartbeat, an emergency or an address claim of a device, or a second sender.
2. sent by its device: its sender is the configured device; one of another sender is none of the
   message's frames, and is not counted. Where none is configured, a J1939 group is that of the
   address whose frames passed first; a frame from another one is a second sender's.
3. protected: its length, CRC and counter are right (`can_dbc.protection`).
4. timed: it does not contradict its sender's clock (`rig.bridge.sample_times`). Whether a late one
   had waited is known at the end of the tick.
5. holding values: its signals do (`Incoming.read`).
6. healthy sender: its device is not at fault (`_healthy_sender`).
7. plausible: no limit refuses what it measures (`_plausible`).

Whether a frame is authentic is decided before, on the bus (`rig.bus.secoc`). No measurement of a
refused frame is used; alarms in it count. It is counted where it was refused (`rig.bridge.counts`).
Whether the newest measurement has become too old is decided later (`rig.bridge.measurement_age`).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from can_dbc.addressing import Directory
from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, FrameStatus, SequenceState
from rig.bridge.counts import Counts
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
from rig.bridge.incoming_messages import Incoming, Values
from rig.bridge.sample_times import EARLY, IN_TIME, LATE, FrameTime, SenderClock
from rig.bridge.supervision_limits import (
    RANGES_OF_MEASUREMENTS,
    Action,
    Excess,
    Limit,
    Plausibility,
    explain_measurement,
    judge_measurement,
    range_of_measurement,
)
from rig.channels.channel import Channel

# Looking up a member of an enum costs as much as the CRC of a frame.
_OK, _FIRST = FrameStatus.OK, FrameStatus.FIRST

SECOND_SENDER_FRAMES = 12
"""Frames out of sequence in close succession that only a second sender explains: a restarted sender
is accepted after three, and frames that overtake others are single."""

_SUCCESSION_CYCLES = 3
"""Cycle times within which one frame is in close succession to the other."""


_SILENCE_NS = 250_000_000
"""After so long without a frame of a J1939 sender another address may be its new one: one that
claims an address has to wait as long before it sends (SAE J1939-81, 4.2)."""


class Source(NamedTuple):
    """Address of a message's sender, and the time of its last frame."""

    address: int
    t_ns: int


class Strays(NamedTuple):
    """Frames of a message that contradicted its counter, in close succession; time of the last."""

    frames: int = 0
    t_ns: int = 0


class Standing(Struct, frozen=True, gc=False):
    """A limit that the last frame of a message was beyond, by the message's index: HOLD or SAFE."""

    message: int
    action: int
    excess: Excess


class CheckMemory(Struct, frozen=True, gc=False):
    """What the checks remember between two ticks; most ticks leave it as it is.

    A limit on a measurement is passed until a frame of its message is within it: `standing`.
    `sources` are the senders of messages that are identified by their J1939 group alone.
    """

    strays: tuple[Strays, ...]
    measured: tuple[Plausibility | None, ...]
    healths: tuple[DeviceHealth, ...]
    counts: Counts
    standing: tuple[Standing, ...] = ()
    sources: tuple[Source | None, ...] = ()


Passed = tuple[Incoming, Values, int, FrameTime]
"""A frame that passed: its message, its values, when it was due, and what is known of that."""


class Reception:
    """What the frames of one tick change while they pass; written in place.

    `action` is the severest one that limits on measurements require, 0 if none; `excess` is the
    first measurement that requires it.
    """

    __slots__ = ("action", "clocks", "excess", "memory", "sequences")

    def __init__(
        self,
        sequences: Sequence[SequenceState],
        clocks: Sequence[SenderClock | None],
        memory: CheckMemory,
    ) -> None:
        self.sequences = list(sequences)
        self.clocks = list(clocks)
        self.memory = memory
        self.action = 0
        self.excess: Excess | None = None

    def count(self, **increments: int) -> None:
        """Add to counts, by the names of `Counts`."""
        self.memory = replace(self.memory, counts=self.memory.counts.plus(**increments))

    def count_refusal(self, cause: str) -> None:
        """Count a refused frame, and its cause: the name of one of `Counts`."""
        self.memory = replace(self.memory, counts=self.memory.counts.plus_refusal(cause))

    def require(self, action: int, excess: Excess) -> None:
        """Require an action, if it is severer than what is required already."""
        if action > self.action:
            self.action, self.excess = action, excess

    def require_standing(self) -> None:
        """Require what the last frames of messages were beyond; after all frames of a tick."""
        for item in self.memory.standing:
            self.require(item.action, item.excess)

    def set_standing(self, message: int, action: int, excess: Excess | None) -> None:
        """Replace what stands of a message's limits by what its newest frame requires."""
        standing = [item for item in self.memory.standing if item.message != message]
        if action >= Action.HOLD and excess is not None:
            standing.append(Standing(message, action, excess))
        self.memory = replace(self.memory, standing=tuple(standing))

    def set_source(self, message: int, frame: Frame) -> None:
        """Note the address that a message's frame came from."""
        source, sources = Source(frame.arbitration_id & 0xFF, frame.t_ns), self.memory.sources
        sources = (*sources[:message], source, *sources[message + 1 :])
        self.memory = replace(self.memory, sources=sources)

    def set_health(self, index: int, health: DeviceHealth) -> None:
        """Replace the health of a device."""
        healths = self.memory.healths
        if healths[index] is not health:
            healths = (*healths[:index], health, *healths[index + 1 :])
            self.memory = replace(self.memory, healths=healths)


FrameCheck = Callable[[Reception, Values, int], bool]
"""Whether it passes a frame by its values and the time in ns when it was due; what it refuses it
counts."""


class FrameChecks:
    """The checks of a bridge; its `own` messages are identified as by `Message.key`.

    `limits` are those on what each of the `channels` measures.
    """

    def __init__(
        self,
        incoming: Sequence[Incoming],
        own: frozenset[tuple[int, bool]],
        devices: Sequence[Device],
        channels: Sequence[Channel],
        limits: Sequence[Sequence[Limit]],
    ) -> None:
        self.incoming = tuple(incoming)
        self.directory = Directory(item.message for item in incoming)
        """Index of the incoming message that a frame is of."""
        self._own = own
        self._devices = tuple(devices)
        self._device_of_id = {key: index for index, item in enumerate(devices) for key in item.ids}
        self._channels, self._limits = tuple(channels), tuple(limits)
        self._checks = [self._check_of(index, item) for index, item in enumerate(incoming)]
        self._index_of = self.directory.index_of
        with_device = {index for index, item in enumerate(incoming) if item.device is not None}
        self._by_group = self.directory.by_group - with_device
        self._of_one_sender = self._by_group | with_device

    def init(self, t_ns: int) -> tuple[tuple[SequenceState, ...], CheckMemory]:
        """Counter states and memory before the first tick."""
        messages = len(self.incoming)
        memory = CheckMemory(
            (Strays(),) * messages,
            (None,) * len(self._limits),
            tuple(initial_health(device, t_ns) for device in self._devices),
            Counts(),
            sources=(None,) * messages,
        )
        return (INITIAL,) * messages, memory

    def take_over(self, memory: CheckMemory) -> CheckMemory:
        """Memory of checks that had other limits: what stands, where there is still a limit."""
        standing = tuple(
            item for item in memory.standing if self._limited_of(self.incoming[item.message])
        )
        return replace(memory, standing=standing)

    def receive(self, reception: Reception, frames: Sequence[Frame]) -> list[Passed]:
        """What passed of some frames: those that no check refused."""
        passed: list[Passed] = []
        is_timed = True
        index_of, sequences, clocks = self._index_of, reception.sequences, reception.clocks
        for frame in frames:
            index = index_of(frame.arbitration_id, frame.is_extended)
            if index is None or frame.is_error:
                self._receive_other(reception, frame)
                continue
            incoming = self.incoming[index]
            if index in self._of_one_sender and not self._is_from_sender(reception, index, frame):
                continue
            sequences[index], status, values = incoming.read(sequences[index], frame)
            if status is not _OK:
                self._record_status(reception, index, frame.t_ns, status)
            due_ns, timing = frame.t_ns, IN_TIME
            follow, stamp = incoming.follow, incoming.stamp
            is_accepted = status is _OK or status.is_accepted
            # A frame that states no time, on another page or without values, is not followed.
            if follow is not None and is_accepted and (values or stamp < 0):
                before = None if status is _FIRST else clocks[index]
                since = 1 + sequences[index].lost
                if values and stamp >= 0:
                    since = round(values[stamp] * 1e9)
                clock = clocks[index] = follow(before, due_ns, since)
                due_ns, timing = clock.due_ns, clock.timing
                if timing is not IN_TIME:
                    is_timed = False
            if values is None:
                continue
            # One that contradicts its sender's clock leaves nothing behind.
            if timing is EARLY or self._pass(reception, index, values, due_ns, frame):
                passed.append((incoming, values, due_ns, timing))
        return passed if is_timed else _drop_unclear(reception, passed)

    def _pass(
        self, reception: Reception, index: int, values: Values, due_ns: int, frame: Frame
    ) -> bool:
        """Whether a frame of a message holds values, and no check refuses it."""
        if not values:
            reception.count_refusal("no_value")
            return False
        check = self._checks[index]
        if check is not None and not check(reception, values, due_ns):
            return False
        if index in self._by_group:
            reception.set_source(index, frame)
        return True

    def _is_from_sender(self, reception: Reception, index: int, frame: Frame) -> bool:
        """Whether a frame is from the one sender of its message.

        That is its device, or the address whose frames of its group passed first.
        """
        device = self.incoming[index].device
        if device is not None:
            return is_from(self._devices[device], reception.memory.healths[device], frame)
        address, source = frame.arbitration_id & 0xFF, reception.memory.sources[index]
        if source is not None and source.address != address:
            cycle_ns = self.incoming[index].message.cycle_time_ns or 0
            if frame.t_ns - source.t_ns <= max(_SILENCE_NS, _SUCCESSION_CYCLES * cycle_ns):
                reception.count_refusal("second_sender")
                return False
        return True

    def _receive_other(self, reception: Reception, frame: Frame) -> None:
        """Receive a frame of no incoming message: of a device, or of a second sender."""
        if frame.is_error:
            return
        if self._devices:
            self._update_healths(reception, frame)
        if (frame.arbitration_id, frame.is_extended) in self._own:
            reception.count(second_sender=1)

    def _update_healths(self, reception: Reception, frame: Frame) -> None:
        """Update the devices' health by a heartbeat, an emergency or an address claim."""
        healths = reception.memory.healths
        if frame.is_extended and frame.arbitration_id & CLAIM_MASK == CLAIM & CLAIM_MASK:
            for index, device in enumerate(self._devices):
                reception.set_health(index, update_by_claim(device, healths[index], frame))
            return
        index = None if frame.is_extended else self._device_of_id.get(frame.arbitration_id)
        if index is not None:
            health = update_by_frame(self._devices[index], healths[index], frame)
            reception.set_health(index, health)

    def _record_status(
        self, reception: Reception, index: int, t_ns: int, status: FrameStatus
    ) -> None:
        """Count a frame that did not simply follow the one before."""
        if status is FrameStatus.FIRST:
            reception.count(started=1)
        elif status.is_accepted:
            reception.count(lost=reception.sequences[index].lost)
        else:
            reception.count_refusal(status.value)
        if status is FrameStatus.OUT_OF_SEQUENCE:
            self._count_stray(reception, index, t_ns)

    def _count_stray(self, reception: Reception, index: int, t_ns: int) -> None:
        """Count a frame that contradicts its message's counter, and a second sender if need be."""
        cycle_ns = self.incoming[index].message.cycle_time_ns or 0
        strays = reception.memory.strays
        before = strays[index]
        follows = t_ns - before.t_ns <= _SUCCESSION_CYCLES * cycle_ns
        stray = Strays(before.frames + 1 if follows else 1, t_ns)
        strays = (*strays[:index], stray, *strays[index + 1 :])
        reception.memory = replace(reception.memory, strays=strays)
        if stray.frames >= SECOND_SENDER_FRAMES:
            reception.count(second_sender=1)

    def _check_of(self, message: int, incoming: Incoming) -> FrameCheck | None:
        """The checks that a message needs after its protection, as one; None if it needs none."""
        healthy = plausible = None
        if incoming.device is not None:
            index, device = incoming.device, self._devices[incoming.device]
            healthy = _healthy_sender(incoming, index, device)
        limited = self._limited_of(incoming)
        if limited:
            plausible = _plausible(message, incoming, limited)
        if healthy is None or plausible is None:
            return healthy or plausible
        return _both(healthy, plausible)

    def _limited_of(self, incoming: Incoming) -> Sequence["_Limited"]:
        """The values of a message that have limits."""
        return [
            _Limited(
                delivery.value,
                delivery.channel,
                self._channels[delivery.channel].strut,
                self._limits[delivery.channel],
            )
            for delivery in incoming.deliveries
            if self._limits[delivery.channel]
        ]


def _drop_unclear(reception: Reception, passed: Sequence[Passed]) -> list[Passed]:
    """The frames whose time is known: a late one had waited if the one behind it came less late."""
    kept: list[Passed] = []
    behind: dict[int, bool] = {}
    for item in reversed(passed):
        incoming, _, _, timing = item
        is_kept = timing is IN_TIME or (timing is LATE and behind.get(id(incoming), False))
        if is_kept:
            kept.append(item)
        else:
            reception.count_refusal("untimed")
        behind[id(incoming)] = is_kept
    return kept[::-1]


def _both(first: FrameCheck, second: FrameCheck) -> FrameCheck:
    """A check that passes what one and then another passes."""

    def check(reception: Reception, values: Values, due_ns: int) -> bool:
        return first(reception, values, due_ns) and second(reception, values, due_ns)

    return check


def _healthy_sender(incoming: Incoming, index: int, device: Device) -> FrameCheck:
    """A check for frames of a healthy device; alarms in the frame itself count."""

    def check(reception: Reception, values: Values, due_ns: int) -> bool:
        reception.set_health(index, update_by_data(device, reception.memory.healths[index]))
        for alarm in incoming.alarms:
            health = reception.memory.healths[alarm.device]
            raw = int(values[alarm.value])
            reception.set_health(alarm.device, update_by_alarm(health, alarm.alarm, raw))
        if fault(device, reception.memory.healths[index], due_ns) is None:
            return True
        reception.count_refusal("from_faulty_device")
        return False

    return check


class _Limited(NamedTuple):
    """A value of a frame that has limits: its index, channel and strut."""

    value: int
    channel: int
    strut: int
    limits: Sequence[Limit]


def _judge(
    limited: Sequence[_Limited],
    shortest_ns: int,
    before: Sequence[Plausibility | None],
    values: Values,
    due_ns: int,
) -> tuple[Sequence[Plausibility | None], int, Excess | None]:
    """Memory of the channels after a frame, the severest action that it requires, and why."""
    measured, action, excess = list(before), 0, None
    for index, channel, strut, limits in limited:
        value, memory = values[index], measured[channel]
        if memory is None:
            memory = Plausibility(value, due_ns, due_ns, shortest_ns)
        measured[channel], required = judge_measurement(limits, memory, value, due_ns)
        if required > action:
            action = required
            excess = explain_measurement(limits, memory, (strut, value), due_ns, required)
    return measured, action, excess


def _plausible(message: int, incoming: Incoming, limited: Sequence[_Limited]) -> FrameCheck:
    """A check for values within the limits: a frame is used whole or not at all."""
    shortest_ns = max(1, (incoming.message.cycle_time_ns or 0) // 2)

    def check(reception: Reception, values: Values, due_ns: int) -> bool:
        before = reception.memory.measured
        measured, action, excess = _judge(limited, shortest_ns, before, values, due_ns)
        if excess is not None:
            reception.require(action, excess)
        if action >= Action.HOLD or reception.memory.standing:
            reception.set_standing(message, action, excess)
        if action < Action.REFUSE:
            reception.memory = replace(reception.memory, measured=tuple(measured))
            return True
        reception.count_refusal("implausible")
        return False

    if not all(row.value in RANGES_OF_MEASUREMENTS for it in limited for row in it.limits):
        return check
    ranges = [(it.value, *range_of_measurement(it.limits)) for it in limited]

    def check_ranges(reception: Reception, values: Values, due_ns: int) -> bool:
        # Ranges need no memory, and their values are within them in most frames.
        if reception.memory.standing:
            return check(reception, values, due_ns)
        for index, low, high in ranges:
            if not low <= values[index] <= high:
                return check(reception, values, due_ns)
        return True

    return check_ranges
