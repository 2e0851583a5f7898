"""The checks of a frame, each by itself: what passes, what is refused and what is counted.

A frame says itself what its reader makes of it: status, frames lost before it, and its value.
"""

import dataclasses

import pytest
from msgspec.structs import replace

from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, FrameStatus
from rig.bridge.counts import Counts
from rig.bridge.devices import Device, initial_health
from rig.bridge.frame_checks import SECOND_SENDER_FRAMES, FrameChecks, Reception, Strays
from rig.bridge.incoming_messages import AlarmDelivery, Delivery, Incoming
from rig.bridge.sample_times import EARLY, IN_TIME, LATE
from rig.bridge.supervision_limits import Action, Excess, Limit, LimitedValue, Plausibility
from rig.channels.channel import Channel, Role
from rig.channels.measured_quantities import HEIGHT

MS = 1_000_000
MESSAGE = load_database(DEFAULT_DATABASE).message("BENCH_MEASUREMENT")
STATUSES = list(FrameStatus)
NONE = 0xFF
"""Byte of a frame of another page: there is no value to read."""

EMPTY = 0xFE
"""Byte of a frame whose signal holds no value."""

FIRST_ID, OWN_ID = 0x100, 0x110


def message(index=0, cycle_ns=MS):
    return dataclasses.replace(MESSAGE, arbitration_id=FIRST_ID + index, cycle_time_ns=cycle_ns)


def read(sequence, frame):
    status, lost, *values = frame.data
    number = () if EMPTY in values else tuple(value / 100 for value in values)
    return (
        replace(sequence, lost=lost, t_ns=frame.t_ns),
        STATUSES[status],
        None if NONE in values else number,
    )


def incoming(index=0, cycle_ns=MS, **parts):
    return Incoming(message(index, cycle_ns), read, **{"deliveries": ()} | parts)


def frame(*values, t_ns=0, index=0, status=FrameStatus.OK, lost=0):
    """A frame with values in hundredths."""
    data = bytes([STATUSES.index(status), lost, *(values or (50,))])
    return Frame(t_ns, FIRST_ID + index, data)


def channels(count):
    """Heights of as many struts; a channel has the index of its strut."""
    return [Channel(index, Role.HEIGHT, HEIGHT, "", "", index, MS) for index in range(count)]


class Bench:
    """Checks that frames pass tick by tick."""

    def __init__(self, *items, devices=(), limits=(), own=((OWN_ID, False),)):
        self.checks = FrameChecks(items, frozenset(own), devices, channels(len(limits)), limits)
        self.sequences, self.memory = self.checks.init(0)
        self.clocks = [None] * len(items)
        self.action, self.excess = 0, None

    def receive(self, *frames):
        reception = Reception(self.sequences, self.clocks, self.memory)
        passed = self.checks.receive(reception, frames)
        self.sequences, self.clocks = reception.sequences, reception.clocks
        self.memory = reception.memory
        self.action, self.excess = reception.action, reception.excess
        return [(item.message.arbitration_id - FIRST_ID, *rest) for item, *rest in passed]

    @property
    def counts(self):
        """What has been counted, without zeros."""
        return {key: value for key, value in self.memory.counts._asdict().items() if value}


def test_before_the_first_tick_nothing_is_known():
    devices = (Device("A", 1, 0x81, 0), Device("B", 2, 0x82, 0, alarms=2))
    checks = FrameChecks([incoming(), incoming(1)], frozenset(), devices, channels(3), [[], [], []])
    sequences, memory = checks.init(7)
    assert sequences == (INITIAL, INITIAL)
    assert memory.strays == (Strays(0, 0),) * 2
    assert memory.measured == (None, None, None)
    assert memory.healths == tuple(initial_health(device, 7) for device in devices)
    assert memory.counts == Counts()


def test_frames_pass_in_the_order_of_their_arrival_each_to_its_message():
    bench = Bench(incoming(), incoming(1))
    passed = bench.receive(frame(10, 20, t_ns=1), frame(30, t_ns=2, index=1), frame(40, t_ns=3))
    assert passed == [
        (0, (0.1, 0.2), 1, IN_TIME),
        (1, (0.3,), 2, IN_TIME),
        (0, (0.4,), 3, IN_TIME),
    ]
    assert [state.t_ns for state in bench.sequences] == [3, 2]
    assert bench.counts == {}


@pytest.mark.parametrize(
    ("status", "counted"),
    [
        (FrameStatus.OK, {}),
        (FrameStatus.FIRST, {"started": 1}),
        (FrameStatus.LOST, {"lost": 4}),
        *[
            (status, {"refused": 1, status.value: 1})
            for status in FrameStatus
            if status not in (FrameStatus.OK, FrameStatus.FIRST, FrameStatus.LOST)
        ],
    ],
)
def test_each_status_is_counted_as_what_it_is(status, counted):
    bench = Bench(incoming(), incoming(1))
    bench.receive(frame(NONE, index=1, status=status, lost=4))
    assert bench.counts == counted


def test_an_error_frame_is_nobodys_whatever_its_identifier():
    device = Device("A", 1, 0x81, MS)
    bench = Bench(incoming(), devices=[device])
    told = [frame(), Frame(0, OWN_ID, bytes(8)), Frame(0, 0x701, b"\x04")]
    assert bench.receive(*(replace(item, is_error=True) for item in told)) == []
    assert bench.counts == {}
    assert bench.memory.healths == (initial_health(device, 0),)


def test_a_second_sender_uses_the_very_identifier_of_an_own_message():
    bench = Bench(incoming())
    own = Frame(0, OWN_ID, bytes(8))
    bench.receive(own, replace(own, is_extended=True), replace(own, arbitration_id=OWN_ID + 1))
    assert bench.counts == {"second_sender": 1}
    bench.receive(own, own)
    assert bench.counts == {"second_sender": 3}


CYCLE = 10


def strays(bench, *times_ns, index=0):
    status = FrameStatus.OUT_OF_SEQUENCE
    return bench.receive(*(frame(NONE, t_ns=t, index=index, status=status) for t in times_ns))


LEVEL = dataclasses.replace(
    MESSAGE, arbitration_id=0x18FE5920, is_extended=True, is_j1939=True, cycle_time_ns=100 * MS
)


def level(t_ms, address):
    """A frame of a J1939 group, from an address."""
    return Frame(t_ms * MS, 0x18FE5900 | address, bytes([0, 0, 50]), is_extended=True)


@pytest.mark.parametrize("first", [0x20, 0x33])
def test_a_group_is_that_of_the_address_whose_frames_passed_first(first):
    """Whatever address the DBC has, and also where the frames of two alternate."""
    bench = Bench(Incoming(LEVEL, read, ()))
    for t_ms in range(0, 2000, 100):
        assert len(bench.receive(level(t_ms, first), level(t_ms + 50, 0x40))) == 1
    assert bench.counts == {"refused": 20, "second_sender": 20}


@pytest.mark.parametrize(("silent_ms", "passes"), [(300, False), (301, True), (5000, True)])
def test_an_address_that_falls_silent_is_followed_by_another(silent_ms, passes):
    """After three cycles, of which none is shorter than the 250 ms that a claim takes."""
    bench = Bench(Incoming(LEVEL, read, ()))
    assert len(bench.receive(level(1000, 0x20))) == 1
    assert len(bench.receive(level(1000 + silent_ms, 0x33))) == passes
    # And its group is that one's from then on.
    assert len(bench.receive(level(1001 + silent_ms, 0x20))) == (not passes)
    slow = Bench(Incoming(dataclasses.replace(LEVEL, cycle_time_ns=None), read, ()))
    slow.receive(level(0, 0x20))
    assert len(slow.receive(level(250, 0x33))) == 0
    assert len(slow.receive(level(251, 0x33))) == 1


@pytest.mark.parametrize("data", [bytes([0, 0, EMPTY]), bytes([0, 0, NONE])])
def test_an_address_whose_frames_hold_no_value_claims_no_group(data):
    """An ECU may send "not available" where a sensor measures."""
    bench = Bench(Incoming(LEVEL, read, ()))
    for t_ms in range(0, 2000, 100):
        other = replace(level(t_ms, 0x40), data=data)
        assert len(bench.receive(other, level(t_ms + 50, 0x20))) == 1
    assert bench.counts.get("second_sender", 0) == 19


def test_where_a_device_is_configured_its_name_decides():
    device = Device("A", 1, 0x81, 0, j1939_name=5, address=0x33)
    bench = Bench(Incoming(LEVEL, read, (), device=0), devices=[device])
    assert len(bench.receive(level(0, 0x20), level(1, 0x33), level(2, 0x20))) == 1
    assert bench.counts == {}


def second_senders(bench):
    return bench.counts.get("second_sender", 0)


def test_a_dozen_frames_out_of_sequence_in_close_succession_are_a_second_senders():
    # A restarted sender is accepted after three; frames that overtake others are single.
    assert SECOND_SENDER_FRAMES == 12
    bench = Bench(incoming(cycle_ns=CYCLE))
    for number in range(1, 16):
        strays(bench, 100 + 3 * CYCLE * number)
        assert second_senders(bench) == max(0, number - 11)
    assert bench.counts["out_of_sequence"] == bench.counts["refused"] == 15


def test_frames_that_are_more_than_three_cycles_apart_begin_anew():
    bench = Bench(incoming(cycle_ns=CYCLE))
    strays(bench, *(100 + 30 * number for number in range(11)))
    strays(bench, *(431 + 30 * number for number in range(11)))
    assert second_senders(bench) == 0
    assert bench.memory.strays == (Strays(11, 731),)
    strays(bench, 761)
    assert second_senders(bench) == 1


def test_frames_out_of_sequence_are_counted_for_each_message():
    bench = Bench(incoming(cycle_ns=CYCLE), incoming(1, CYCLE), incoming(2, CYCLE))
    for t_ns in range(40, 40 + 11 * 5, 5):
        strays(bench, t_ns, index=1)
        strays(bench, t_ns + 1, index=2)
        strays(bench, t_ns + 2, index=0)
    assert second_senders(bench) == 0
    assert bench.memory.strays == (Strays(11, 92), Strays(11, 90), Strays(11, 91))


def test_the_first_frame_out_of_sequence_follows_none():
    # However soon after the time zero it comes.
    bench = Bench(incoming(cycle_ns=CYCLE))
    strays(bench, 0)
    assert bench.memory.strays == (Strays(1, 0),)


def test_without_a_cycle_time_only_frames_of_one_time_follow_each_other():
    bench = Bench(incoming(cycle_ns=None))
    strays(bench, *[5] * 11, 6)
    assert second_senders(bench) == 0
    strays(bench, *[6] * 11)
    assert second_senders(bench) == 1


def test_other_refused_frames_are_no_second_senders():
    bench = Bench(incoming())
    for status in (FrameStatus.WRONG_CRC, FrameStatus.REPEATED, FrameStatus.MASQUERADE):
        bench.receive(*[frame(NONE, status=status)] * 20)
    assert second_senders(bench) == 0


class Clock:
    """A scripted follower of a sender's clock; it is told when a frame was due, and how."""

    def __init__(self):
        self.asked, self.told = [], {}

    def __call__(self, before, arrival_ns, cycles):
        self.asked.append((before and before.due_ns, arrival_ns, cycles))
        due_ns, timing = self.told.get(arrival_ns, (arrival_ns, IN_TIME))
        return FrameDue(due_ns, timing)


@dataclasses.dataclass(frozen=True)
class FrameDue:
    due_ns: int
    timing: object


def test_the_senders_clock_is_told_each_frame_that_its_counter_counts():
    clock = Clock()
    bench = Bench(incoming(follow=clock))
    bench.receive(frame(t_ns=100, status=FrameStatus.FIRST))
    bench.receive(frame(t_ns=110), frame(NONE, t_ns=120))
    bench.receive(frame(NONE, t_ns=130, status=FrameStatus.LOST, lost=2))
    bench.receive(frame(t_ns=140, status=FrameStatus.LOST, lost=3))
    for status in (FrameStatus.WRONG_CRC, FrameStatus.REPEATED, FrameStatus.WRONG_LENGTH):
        bench.receive(frame(NONE, t_ns=145, status=status))
    bench.receive(frame(t_ns=150))
    bench.receive(frame(t_ns=160, status=FrameStatus.FIRST))
    bench.receive(frame(t_ns=170))
    assert clock.asked == [
        (None, 100, 1),
        (100, 110, 1),
        (110, 120, 1),
        (120, 130, 3),
        (130, 140, 4),
        (140, 150, 1),
        (None, 160, 1),  # a sender that starts again has none before
        (160, 170, 1),
    ]


def test_each_message_has_its_senders_clock():
    clocks = [Clock(), Clock()]
    bench = Bench(*(incoming(index, follow=clock) for index, clock in enumerate(clocks)))
    bench.receive(frame(t_ns=1, index=1), frame(t_ns=2), frame(t_ns=3, index=1))
    assert [clock.asked for clock in clocks] == [[(None, 2, 1)], [(None, 1, 1), (1, 3, 1)]]


def test_a_frame_passes_with_the_time_when_it_was_due():
    clock = Clock()
    clock.told = {100: (93, IN_TIME)}
    bench = Bench(incoming(follow=clock))
    assert bench.receive(frame(t_ns=100), frame(t_ns=110)) == [
        (0, (0.5,), 93, IN_TIME),
        (0, (0.5,), 110, IN_TIME),
    ]


@pytest.mark.parametrize(
    ("timings", "kept"),
    [
        ([IN_TIME, IN_TIME], [0, 1]),
        ([LATE], []),
        ([LATE, IN_TIME], [0, 1]),
        ([LATE, LATE, IN_TIME], [0, 1, 2]),
        ([IN_TIME, LATE], [0]),
        ([LATE, EARLY, IN_TIME], [2]),
        ([LATE, IN_TIME, LATE], [0, 1]),
        ([EARLY, IN_TIME, EARLY], [1]),
        ([EARLY], []),
    ],
)
def test_a_late_frame_had_waited_if_the_one_behind_it_is_in_time(timings, kept):
    clock = Clock()
    clock.told = {10 + number: (5 + number, timing) for number, timing in enumerate(timings)}
    bench = Bench(incoming(follow=clock), incoming(1))
    # Frames of another message between them show nothing.
    frames = [
        item
        for number in range(len(timings))
        for item in (frame(number, t_ns=10 + number), frame(99, t_ns=10 + number, index=1))
    ]
    passed = bench.receive(*frames)
    found = [(values[0], due_ns) for index, values, due_ns, _ in passed if index == 0]
    assert found == [(number / 100, 5 + number) for number in kept]
    assert sum(index == 1 for index, *_ in passed) == len(timings)
    dropped = len(timings) - len(kept)
    assert bench.counts == ({"untimed": dropped, "refused": dropped} if dropped else {})


CELL = Device("CELL", 1, 0x81, 0, alarms=2)
OTHER = Device("OTHER", 2, 0x82, 0, alarms=1)
NAMED = Device("NAMED", 0, 0, 0, j1939_name=7, address=0x20)
ERROR = b"\x30\x81\x11" + bytes(5)


def states(bench):
    return [(item.state, item.error_code) for item in bench.memory.healths]


def test_a_device_is_known_by_its_heartbeat_and_by_its_emergency():
    bench = Bench(incoming(), devices=[CELL, OTHER])
    bench.receive(Frame(5, 0x702, b"\x04"), Frame(6, 0x81, ERROR))
    assert states(bench) == [(5, 0x8130), (4, 0)]
    assert [item.since_ns for item in bench.memory.healths] == [0, 5]
    unchanged = bench.memory
    bench.receive(
        Frame(7, 0x701, b"\x04", is_extended=True), Frame(7, 0x703, b"\x04"), Frame(7, 0x83, ERROR)
    )
    assert bench.memory is unchanged


def claim(arbitration_id, name=7, is_extended=True):
    return Frame(1, arbitration_id, name.to_bytes(8, "little"), is_extended=is_extended)


def test_an_address_claim_is_known_by_its_group_whatever_its_priority():
    twin = NAMED._replace(name="TWIN", j1939_name=8, address=0x21)
    bench = Bench(incoming(), devices=[NAMED, CELL, twin])
    bench.receive(claim(0x18EEFF31), claim(0x0CEEFF32, name=8))
    assert [item.address for item in bench.memory.healths] == [0x31, 0xFE, 0x32]
    unchanged = bench.memory
    # Another group, another destination, another data page, or a standard frame: no claim.
    for arbitration_id in (0x18EDFF40, 0x18EE0040, 0x19EEFF40):
        bench.receive(claim(arbitration_id))
    bench.receive(claim(0x18EEFF40, is_extended=False))
    assert bench.memory is unchanged
    # One claims the address of the other.
    bench.receive(claim(0x18EEFF32))
    assert [item.address for item in bench.memory.healths] == [0x32, 0xFE, 0xFE]


def test_a_frame_of_another_sender_is_none_of_the_messages_frames():
    bench = Bench(incoming(device=0), devices=[NAMED])
    there = replace(frame(), arbitration_id=FIRST_ID)
    assert bench.receive(there) == []  # its low byte is no address of the device
    assert bench.counts == {}
    at_zero = NAMED._replace(address=FIRST_ID & 0xFF)
    bench = Bench(incoming(device=0), devices=[at_zero])
    assert len(bench.receive(there)) == 1


def test_frames_of_a_device_at_fault_are_refused_until_it_is_well():
    bench = Bench(incoming(device=1), incoming(1, device=0), devices=[OTHER, CELL])
    both = frame(t_ns=1), frame(t_ns=1, index=1)
    bench.receive(Frame(0, 0x81, ERROR))
    assert [index for index, *_ in bench.receive(*both)] == [1]
    assert bench.counts == {"from_faulty_device": 1, "refused": 1}
    bench.receive(Frame(0, 0x81, bytes(8)))
    assert [index for index, *_ in bench.receive(*both)] == [0, 1]


def test_a_frame_is_refused_by_when_it_was_due_not_by_when_it_came():
    clock = Clock()
    clock.told = {15: (10, IN_TIME)}
    watched = CELL._replace(heartbeat_ns=10)
    bench = Bench(incoming(device=0, follow=clock), devices=[watched])
    assert len(bench.receive(frame(t_ns=15))) == 1
    assert bench.receive(frame(t_ns=16)) == []


def test_data_of_a_device_that_restarted_make_it_operational():
    bench = Bench(incoming(device=0), devices=[CELL])
    bench.receive(Frame(0, 0x701, b"\x00"))
    assert states(bench) == [(0, 0)]
    assert len(bench.receive(frame(t_ns=1))) == 1
    assert states(bench) == [(5, 0)]


def test_alarms_in_a_frame_count_for_their_devices_and_refuse_it_if_its_own_is_among_them():
    alarms = (AlarmDelivery(1, 0, 1), AlarmDelivery(2, 1, 0))

    def hundredths(*raw):
        return frame(50, *(100 * number for number in raw))

    item = incoming(device=0, alarms=alarms)
    bench = Bench(item, devices=[CELL, OTHER])
    assert len(bench.receive(hundredths(0, 2))) == 1
    assert [health.alarms for health in bench.memory.healths] == [(0, 0), (2,)]
    assert bench.receive(hundredths(1, 0)) == []
    assert [health.alarms for health in bench.memory.healths] == [(0, 1), (0,)]
    assert bench.counts == {"from_faulty_device": 1, "refused": 1}
    assert len(bench.receive(hundredths(0, 0))) == 1


def row(action, low=0.2, high=0.6, value="measured_height_m"):
    return Limit(value=LimitedValue(value), low=low, high=high, action=action)


REMEMBERED = Limit(value=LimitedValue.UNCHANGED_S, high=1e9, action="warn")
"""Never passed; but what is measured is remembered for it."""


def heights(*struts, **parts):
    return incoming(
        deliveries=tuple(Delivery(i, strut, 0) for i, strut in enumerate(struts)), **parts
    )


@pytest.mark.parametrize(
    ("action", "passes"), [("warn", True), ("refuse", False), ("hold", False), ("safe", False)]
)
def test_a_height_beyond_a_limit_is_dropped_with_its_frame_unless_it_is_warned_of(action, passes):
    bench = Bench(heights(0), limits=[[row(action), REMEMBERED]])
    assert len(bench.receive(frame(60, t_ns=5))) == 1
    assert (bench.action, bench.excess) == (0, None)
    assert bool(bench.receive(frame(61, t_ns=6))) == passes
    assert bench.counts == ({} if passes else {"implausible": 1, "refused": 1})
    assert bench.action == Action[action.upper()]
    assert bench.excess == Excess(0, LimitedValue.MEASURED_HEIGHT_M, 0.61, 0.6)
    seen = Plausibility(0.61 if passes else 0.6, *(6, 6) if passes else (5, 5), MS // 2)
    assert bench.memory.measured == (seen,)


def test_a_frame_with_one_implausible_height_leaves_no_trace_of_the_others():
    rows = [row("refuse"), REMEMBERED]
    bench = Bench(heights(2, 0), limits=[rows, [], rows])
    assert bench.receive(frame(40, 10)) == bench.receive(frame(10, 40)) == []
    assert bench.memory.measured == (None, None, None)
    assert len(bench.receive(frame(30, 40, t_ns=9))) == 1
    seen = [item and (item.value, item.t_ns) for item in bench.memory.measured]
    assert seen == [(0.4, 9), None, (0.3, 9)]


def test_a_frame_is_judged_by_the_heights_that_have_limits():
    bench = Bench(heights(0, 1), limits=[[], [row("refuse")]])
    assert len(bench.receive(frame(10, 40))) == 1
    assert bench.receive(frame(40, 10)) == []
    assert bench.counts == {"implausible": 1, "refused": 1}


def test_the_first_measurement_that_requires_the_severest_action_is_named():
    limits = [[row("warn")], [row("hold")], [row("hold")], [row("warn")]]
    bench = Bench(heights(0, 1, 2, 3), limits=limits)
    assert bench.receive(frame(10, 11, 12, 13)) == []
    assert bench.action == Action.HOLD
    assert bench.excess == Excess(1, LimitedValue.MEASURED_HEIGHT_M, 0.11, 0.2)
    # In frames behind it as well; each tick begins anew.
    bench.receive(frame(40, 40, 14, 40), frame(40, 15, 40, 40), frame(16, 40, 40, 40))
    assert bench.excess == Excess(2, LimitedValue.MEASURED_HEIGHT_M, 0.14, 0.2)
    bench.receive(frame(40, 40, 40, 40))
    assert (bench.action, bench.excess) == (0, None)


def test_ranges_alone_are_not_remembered_and_refuse_the_same():
    bench = Bench(heights(0, 1), limits=[[row("refuse")], [row("warn")]])
    assert len(bench.receive(frame(20, 60))) == 1
    assert bench.memory.measured == (None, None)
    assert bench.receive(frame(19, 40)) == bench.receive(frame(61, 40)) == []
    assert bench.excess == Excess(0, LimitedValue.MEASURED_HEIGHT_M, 0.61, 0.6)
    assert len(bench.receive(frame(40, 61))) == 1
    assert bench.excess == Excess(1, LimitedValue.MEASURED_HEIGHT_M, 0.61, 0.6)


@pytest.mark.parametrize(
    ("cycle_ns", "shortest_ns"), [(None, 1), (0, 1), (1, 1), (2, 1), (5, 2), (MS, MS // 2)]
)
def test_two_heights_are_half_a_cycle_apart_at_least(cycle_ns, shortest_ns):
    bench = Bench(heights(0, cycle_ns=cycle_ns), limits=[[row("refuse"), REMEMBERED]])
    bench.receive(frame(40, t_ns=3))
    assert bench.memory.measured == (Plausibility(0.4, 3, 3, shortest_ns),)


def test_the_rate_of_a_height_is_that_of_the_times_when_its_frames_were_due():
    clock = Clock()
    clock.told = {12 * MS: (10 * MS, IN_TIME)}
    rate = row("refuse", -1.0, 1.0, "measured_rate_m_per_s")
    bench = Bench(heights(0, follow=clock), limits=[[rate]])
    bench.receive(frame(40, t_ns=0))
    assert bench.receive(frame(42, t_ns=12 * MS)) == []
    assert bench.excess.number == pytest.approx(2.0)


def test_the_sender_of_a_height_is_judged_before_the_height():
    bench = Bench(heights(0, device=0), devices=[CELL], limits=[[row("safe")]])
    bench.receive(Frame(0, 0x81, ERROR))
    assert bench.receive(frame(10)) == []
    assert bench.counts == {"from_faulty_device": 1, "refused": 1}
    assert (bench.action, bench.memory.measured) == (0, (None,))


def test_what_was_lost_before_a_frame_without_values_is_counted():
    bench = Bench(incoming())
    bench.receive(frame(t_ns=100, status=FrameStatus.FIRST))
    assert bench.receive(frame(EMPTY, t_ns=130, status=FrameStatus.LOST, lost=2)) == []
    assert bench.counts == {"started": 1, "lost": 2, "refused": 1, "no_value": 1}


def test_a_frame_without_values_begins_a_senders_clock_and_carries_it_on():
    clock = Clock()
    bench = Bench(incoming(follow=clock))
    bench.receive(frame(EMPTY, t_ns=100, status=FrameStatus.FIRST))
    bench.receive(frame(EMPTY, t_ns=130, status=FrameStatus.LOST, lost=2), frame(t_ns=140))
    assert clock.asked == [(None, 100, 1), (100, 130, 3), (130, 140, 1)]


def test_a_frame_that_contradicts_its_senders_clock_leaves_nothing_behind():
    """Neither a limit on its height acts, nor does it become what the next one is held against."""
    limits = (row("safe", high=1.0), REMEMBERED)
    deliveries = (Delivery(0, 0, 0),)
    bench = Bench(
        incoming(
            follow=lambda _before, due_ns, _cycles: FrameDue(due_ns, EARLY), deliveries=deliveries
        ),
        limits=(limits,),
    )
    assert bench.receive(frame(200)) == []
    assert (bench.action, bench.counts) == (0, {"refused": 1, "untimed": 1})
    assert bench.memory.measured == (None,)


@pytest.mark.parametrize("status", [FrameStatus.WRONG_LENGTH, FrameStatus.WRONG_CRC])
def test_a_frame_of_another_sender_than_the_device_is_not_read(status):
    device = Device("A", 0, 0, MS, j1939_name=5, address=0x20)
    bench = Bench(incoming(device=0), devices=[device])
    assert bench.receive(frame(EMPTY, status=status)) == []
    assert bench.counts == {}
