"""A message of the bench as it is compiled: what of it is read, where to, and what is no value."""

import dataclasses
import math
import struct

import numpy as np
import pytest

from can_dbc.database import alive_counter, load_database
from can_dbc.errors import DatabaseError
from can_dbc.frame import Frame
from can_dbc.protection import INITIAL, FrameStatus, compile_protector
from rig.bridge.frame_checks import FrameChecks, Reception
from rig.bridge.incoming_messages import (
    NO_VALUES,
    Alarm,
    AlarmDelivery,
    ClockSource,
    Delivery,
    clock_source,
    compile_incoming,
)
from rig.channels.channel import Channel, Role, ValidSignal
from rig.channels.measured_quantities import (
    APPLIED_FORCE,
    FORCE,
    HEIGHT,
    LOAD_CELL_FORCE,
    TEMPERATURE,
)

MS = 1_000_000
DBC = """VERSION ""
NS_ :
BS_:
BU_: BENCH RIG
BO_ 256 PROTECTED: 8 BENCH
 SG_ CRC : 0|8@1+ (1,0) [0|0] "" RIG
 SG_ COUNTER : 8|4@1+ (1,0) [0|0] "" RIG
 SG_ HEIGHT : 16|8@1+ (0.01,0) [0|0] "m" RIG
 SG_ OTHER_HEIGHT : 24|8@1+ (0.01,0) [0|0] "m" RIG
 SG_ FORCE : 32|8@1+ (1,0) [0|0] "N" RIG
 SG_ STATE : 40|4@1+ (1,0) [0|0] "" RIG
 SG_ QUALITY : 44|4@1+ (1,0) [0|0] "" RIG
 SG_ OIL : 48|8@1+ (1,0) [0|0] "degC" RIG
BO_ 257 PLAIN: 8 BENCH
 SG_ HEIGHT : 0|32@1- (1,0) [0|0] "m" RIG
 SG_ OTHER_HEIGHT : 32|32@1- (1,0) [0|0] "m" RIG
BO_ 258 MIXED: 8 BENCH
 SG_ HEIGHT : 0|32@1- (1,0) [0|0] "m" RIG
 SG_ FORCE : 32|8@1+ (1,0) [0|0] "N" RIG
BO_ 259 COUNTED: 8 BENCH
 SG_ HEIGHT : 0|16@1+ (0.01,0) [0|0] "m" RIG
 SG_ COUNT : 16|4@1+ (1,0) [0|11] "" RIG
 SG_ STAMP : 24|16@1+ (50,0) [0|0] "us" RIG
 SG_ STATE : 40|4@1+ (1,0) [0|0] "" RIG
 SG_ SHIFTED : 44|4@1+ (1,1) [0|0] "" RIG
 SG_ BIT : 48|1@1+ (1,0) [0|0] "" RIG
 SG_ SIGNED_STAMP : 56|8@1- (1,0) [0|0] "ms" RIG
BO_ 260 STAMPED: 6 BENCH
 SG_ HEIGHT : 0|16@1+ (0.01,0) [0|0] "m" RIG
 SG_ STAMP : 16|32@1- (1,0) [0|0] "s" RIG
BO_ 261 PAGES: 2 BENCH
 SG_ PAGE M : 0|8@1+ (1,0) [0|0] "" RIG
 SG_ HEIGHT m0 : 8|4@1+ (0.1,0) [0|0] "m" RIG
 SG_ COUNT m0 : 12|4@1+ (1,0) [0|0] "" RIG
BO_ 2566834432 GROUP: 8 BENCH
 SG_ HEIGHT : 0|16@1+ (0.1,-3200) [-3200|3225.5] "mm" RIG
 SG_ OTHER_HEIGHT : 16|16@1+ (0.1,-3200) [-3200|3225.5] "mm" RIG
 SG_ FORCE : 32|16@1+ (0.1,100) [100|200] "N" RIG
BO_ 2566834688 ENDS: 8 BENCH
 SG_ UP_FROM_ZERO : 0|16@1+ (1,0) [0|64255] "N" RIG
 SG_ UP_TO_ZERO : 16|16@1+ (1,-64255) [-64255|0] "N" RIG
 SG_ BELOW_ZERO : 32|16@1+ (1,-64300) [-64300|-45] "N" RIG
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;
BA_DEF_ BO_ "E2EProfile" STRING ;
BA_DEF_ BO_ "E2EDataIds" STRING ;
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "E2EProfile" "";
BA_DEF_DEF_ "E2EDataIds" "";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
BA_ "GenMsgCycleTime" BO_ 256 5;
BA_ "GenMsgCycleTime" BO_ 257 5;
BA_ "GenMsgCycleTime" BO_ 259 10;
BA_ "GenMsgCycleTime" BO_ 261 10;
BA_ "E2EProfile" BO_ 256 "P02";
BA_ "E2EDataIds" BO_ 256 "059C063CED1481CCF00933E7181EBE6A";
BA_ "VFrameFormat" BO_ 2566834432 3;
BA_ "VFrameFormat" BO_ 2566834688 3;
SIG_VALTYPE_ 257 HEIGHT : 1;
SIG_VALTYPE_ 257 OTHER_HEIGHT : 1;
SIG_VALTYPE_ 258 HEIGHT : 1;
SIG_VALTYPE_ 260 STAMP : 1;
"""


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    path = tmp_path_factory.mktemp("incoming") / "bench.dbc"
    path.write_text(DBC)
    return load_database(path)


@pytest.fixture(scope="module")
def protected(database):
    return database.message("PROTECTED")


def channel(index, role, quantity, signal, strut=-1, **parts):
    return Channel(index, role, quantity, "", "", strut, MS, signal=signal, **parts)


def height(index, strut, signal="HEIGHT", **parts):
    return channel(index, Role.HEIGHT, HEIGHT, signal, strut, **parts)


CELL = channel(8, Role.SENSOR, FORCE, "FORCE", 1, delay_ns=9)
RECORDED = channel(9, Role.BENCH, LOAD_CELL_FORCE, "FORCE")
OIL = channel(6, Role.BENCH, TEMPERATURE, "OIL")


def payload(message, *values, number=0):
    """A protected frame with the bytes of its signals."""
    return compile_protector(message.protection)(bytes([0, 0, *values]), number)


def test_a_value_that_two_channels_have_is_read_once(protected):
    made = compile_incoming(protected, [RECORDED, height(4, 2, delay_ns=7), CELL])
    assert made.message is protected
    assert made.deliveries == (Delivery(0, 9, 0), Delivery(1, 4, 7), Delivery(0, 8, 9))
    told = Frame(0, 256, payload(protected, 40, 0, 25, 0, 0, 0))
    assert made.read(INITIAL, told)[1:] == (FrameStatus.FIRST, (25.0, pytest.approx(0.4)))


def test_alarms_and_what_says_that_a_sensor_measures_are_read_with_the_values(protected):
    valid = ValidSignal(signal="QUALITY", value=2.0)
    alarms = [Alarm("QUALITY", 3, 1), Alarm("STATE", 0, 5)]
    made = compile_incoming(protected, [height(0, 0, valid=valid)], alarms, device=3)
    assert made.alarms == (AlarmDelivery(1, 3, 1), AlarmDelivery(2, 0, 5))
    assert made.device == 3
    told = Frame(0, 256, payload(protected, 40, 0, 0, 0x27, 0, 0))
    assert made.read(INITIAL, told)[2] == (pytest.approx(0.4), 2.0, 7.0)


def test_alarms_alone_are_read_without_a_clock(protected):
    made = compile_incoming(protected, [], [Alarm("STATE", 0, 0)])
    assert (made.deliveries, made.struts, made.first_strut) == ((), 0, 0)
    assert made.alarms == (AlarmDelivery(0, 0, 0),)
    assert made.device is made.follow is None
    assert not made.is_awaited


def test_the_struts_of_a_message_are_those_of_its_reference_heights(protected):
    pair = compile_incoming(protected, [CELL, height(0, 2), height(1, 0, "OTHER_HEIGHT")])
    assert (pair.struts, pair.first_strut) == (0b101, 0b100)
    assert compile_incoming(protected, [CELL]).struts == 0


@pytest.mark.parametrize(
    ("read", "is_awaited"),
    [
        ([height(0, 0)], True),
        ([CELL], True),
        ([channel(0, Role.INPUT, APPLIED_FORCE, "FORCE")], True),
        ([RECORDED], False),
        ([OIL, RECORDED], False),
        ([OIL, CELL], True),
    ],
)
def test_an_estimate_rests_on_heights_further_sensors_and_the_applied_force(
    protected, read, is_awaited
):
    assert compile_incoming(protected, read).is_awaited == is_awaited


def test_a_counter_states_times_where_frames_have_a_cycle(database, protected):
    plain = database.message("PLAIN")
    aperiodic = dataclasses.replace(protected, cycle_time_ns=None)
    assert clock_source(height(0, 0), protected) is ClockSource.COUNTER
    for message in (aperiodic, plain):
        assert clock_source(height(0, 0), message) is ClockSource.ARRIVAL
        assert compile_incoming(message, [height(0, 0)]).follow is None
    follow = compile_incoming(protected, [height(0, 0)]).follow
    clock = None
    for number in range(3):
        clock = follow(clock, number * 5 * MS, 1)
    assert (clock.due_ns, clock.line.step_ns // MS) == (10 * MS, 5)


def counted(made, counts, cycle_ns=10 * MS):
    """Statuses of frames with some counts, a cycle apart, and which of them are used."""
    sequence, found = INITIAL, []
    for number, count in enumerate(counts):
        frame = Frame(number * cycle_ns, 259, bytes([50 + number, 0, count, 0, 0, 0, 0, 0]))
        sequence, status, values = made.read(sequence, frame)
        found.append((status, None if values is None else round(100.0 * values[0]) - 50))
    return found


def test_a_counter_without_a_crc_shows_frames_that_are_lost_or_repeated(database):
    message = database.message("COUNTED")
    made = compile_incoming(message, [height(0, 0, counter="COUNT")])
    statuses = FrameStatus
    # The DBC's range ends at 11.
    assert counted(made, [9, 10, 11, 0, 3, 3, 4, 2]) == [
        (statuses.FIRST, 0),
        (statuses.OK, 1),
        (statuses.OK, 2),
        (statuses.OK, 3),
        (statuses.LOST, 4),
        (statuses.REPEATED, None),
        (statuses.OK, 6),
        (statuses.OUT_OF_SEQUENCE, None),
    ]
    # A value that no counter of this range has is no step either way.
    assert counted(made, [11, 12, 0])[1:] == [(statuses.OUT_OF_SEQUENCE, None), (statuses.OK, 2)]
    # Without the key nothing is checked.
    assert all(
        status is statuses.OK
        for status, _ in counted(compile_incoming(message, [height(0, 0)]), [3, 3, 9])
    )


def test_as_many_frames_may_be_lost_as_a_silence_has_cycles(database):
    message = database.message("COUNTED")
    alive = alive_counter(message, "COUNT")
    assert (alive.modulus, alive.silence_ns) == (12, 120 * MS)
    aperiodic = dataclasses.replace(message, cycle_time_ns=None)
    assert alive_counter(aperiodic, "COUNT").silence_ns > 10**18
    frame = bytes([50, 0, 3, 0, 0, 0, 0, 0]), bytes([50, 0, 1, 0, 0, 0, 0, 0])
    for definition, silence_ns, expected in (
        (message, 80 * MS, FrameStatus.OUT_OF_SEQUENCE),
        (message, 90 * MS, FrameStatus.LOST),
        (message, 500 * MS, FrameStatus.LOST),
        (aperiodic, 10**15, FrameStatus.OUT_OF_SEQUENCE),
    ):
        made = compile_incoming(definition, [height(0, 0, counter="COUNT")])
        first, _, _ = made.read(INITIAL, Frame(MS, 259, frame[0]))
        # Ten steps on.
        assert made.read(first, Frame(MS + silence_ns, 259, frame[1]))[1] is expected


def test_a_counter_of_one_page_is_not_looked_for_on_another(database):
    made = compile_incoming(database.message("PAGES"), [height(0, 0, counter="COUNT")])
    sequence, status, values = made.read(INITIAL, Frame(0, 261, bytes([0, 0x35])))
    assert (status, values[0]) == (FrameStatus.FIRST, 0.5)
    other = made.read(sequence, Frame(10 * MS, 261, bytes([1, 0x35])))
    assert other == (sequence, FrameStatus.OK, None)
    short = made.read(sequence, Frame(10 * MS, 261, bytes([0])))
    assert short == (sequence, FrameStatus.WRONG_LENGTH, None)
    assert made.read(sequence, Frame(20 * MS, 261, bytes([0, 0x46])))[1] is FrameStatus.OK


def test_a_counter_without_a_crc_states_times(database):
    message = database.message("COUNTED")
    channel = height(0, 0, counter="COUNT")
    assert clock_source(channel, message) is ClockSource.COUNTER
    follow = compile_incoming(message, [channel]).follow
    assert follow(follow(None, 0, 1), 10 * MS, 1).due_ns == 10 * MS
    unknown = dataclasses.replace(message, cycle_time_ns=None)
    assert clock_source(channel, unknown) is ClockSource.ARRIVAL


@pytest.mark.parametrize("name", ["SHIFTED", "BIT", "HEIGHT"])
def test_a_signal_that_is_no_counter_is_one_line(database, name):
    with pytest.raises(DatabaseError, match=f"{name}: expected an unsigned integer"):
        alive_counter(database.message("COUNTED"), name)


def test_a_time_signal_is_read_in_seconds_and_goes_round(database):
    message = database.message("COUNTED")
    channel = height(0, 0, time="STAMP")
    assert clock_source(channel, message) is ClockSource.TIME_SIGNAL
    made = compile_incoming(message, [channel])
    # 65 536 steps of 50 us.
    round_ms = 65_536 * 50 // 1000
    clock = None
    for ms in (0, 10, round_ms - 4, round_ms + 6, 3 * round_ms + 26):
        raw = (ms * 20) % 65_536
        frame = Frame(ms * MS, 259, bytes([50, 0, 0, raw & 0xFF, raw >> 8, 0, 0, 0]))
        _, _, values = made.read(INITIAL, frame)
        stamp_ns = round(values[made.stamp] * 1e9)
        assert stamp_ns == raw * 50_000
        clock = made.follow(clock, ms * MS, stamp_ns)
    assert clock.cycles * channel.interval_ns + clock.phase_ns == (3 * round_ms + 26) * MS


def test_a_signed_time_goes_round_in_all_its_values(database):
    made = compile_incoming(database.message("COUNTED"), [height(0, 0, time="SIGNED_STAMP")])
    clock = None
    for ms in (120, 127, 128, 300, 383, 384):
        # 256 steps of 1 ms, from -128 on.
        frame = Frame(ms * MS, 259, bytes([50, 0, 0, 0, 0, 0, 0, ms % 256]))
        stamp_ns = round(made.read(INITIAL, frame)[2][made.stamp] * 1e9)
        assert -128 * MS <= stamp_ns < 128 * MS
        clock = made.follow(clock, ms * MS, stamp_ns)
        assert clock.cycles * MS + clock.phase_ns == (ms - 120) * MS


def test_a_time_that_is_a_float_never_goes_round(database):
    made = compile_incoming(database.message("STAMPED"), [height(0, 0, time="STAMP")])
    clock = None
    for s in (-2.0, 0.0, 4096.0, 65_536.0):
        frame = Frame(round((s + 3.0) * 1e9), 260, bytes([50, 0]) + struct.pack("<f", s))
        values = made.read(INITIAL, frame)[2]
        assert values[made.stamp] == s
        clock = made.follow(clock, frame.t_ns, round(s * 1e9))
        assert clock.cycles * MS + clock.phase_ns == round((s + 2.0) * 1e9)


def test_the_frames_of_one_that_states_its_time_follow_each_other_by_it(database):
    """Frames that are held back are due when they were sampled, at no constant interval."""
    message = database.message("COUNTED")
    channel = dataclasses.replace(height(0, 0, time="STAMP"), interval_ns=10 * MS)
    made = compile_incoming(message, [channel])
    checks = FrameChecks([made], frozenset(), (), [channel], ((),))
    sequences, memory = checks.init(0)
    reception = Reception(sequences, (None,), memory)
    rng = np.random.default_rng(3)
    sampled_ms = np.cumsum(rng.integers(6, 15, 300))
    frames = []
    for number, ms in enumerate(sampled_ms.tolist()):
        raw = ms * 20 % 65_536
        # Ten frames of every hundred wait for the last of them.
        arrival_ms = sampled_ms[number - number % 10 + 9] if number % 100 >= 90 else ms
        data = bytes([50, 0, 0, raw & 0xFF, raw >> 8, 0, 0, 0])
        frames.append(Frame(int(arrival_ms) * MS, 259, data))
    dues_ms = [due_ns / MS for _, _, due_ns, _ in checks.receive(reception, frames)]
    # Before two blocks have shown the sender's drift, it may be a hundredth of a wait.
    assert dues_ms == pytest.approx(sampled_ms.tolist(), abs=1.0)
    assert dues_ms[128:] == pytest.approx(sampled_ms[128:].tolist(), abs=0.001)
    assert not reception.memory.counts.refused


def test_a_frame_is_read_where_its_counter_lets_it_pass(protected):
    made = compile_incoming(protected, [height(0, 0)])
    frames = [(0, 0), (1, 1), (1, 2), (4, 4), (5, 5)]
    sequence, found = INITIAL, []
    for number, t_ms in frames:
        data = payload(protected, 40 + number, 0, 0, 0, 0, 0, number=number)
        sequence, status, values = made.read(sequence, Frame(t_ms * 5 * MS, 256, data))
        found.append((status.value, values and round(values[0], 9), sequence.lost))
    assert found == [
        ("first", 0.4, 0),
        ("ok", 0.41, 0),
        ("repeated", None, 0),
        ("lost", 0.44, 2),
        ("ok", 0.45, 0),
    ]
    data = payload(protected, 46, 0, 0, 0, 0, 0, number=6)
    for wrong, status in (
        (data[:-1], FrameStatus.WRONG_LENGTH),
        (bytes([data[0] ^ 1]) + data[1:], FrameStatus.WRONG_CRC),
    ):
        assert made.read(sequence, Frame(30 * MS, 256, wrong)) == (sequence, status, None)


def test_a_frame_counts_whose_sensors_all_say_that_they_measure(protected):
    read = [
        height(0, 0, valid=ValidSignal(signal="STATE", value=3.0)),
        height(1, 1, "OTHER_HEIGHT", valid=ValidSignal(signal="QUALITY")),
    ]
    made = compile_incoming(protected, read)
    for said, is_read in ((0x13, True), (0x03, False), (0x12, False), (0x31, False)):
        told = Frame(0, 256, payload(protected, 40, 50, 0, said, 0, 0))
        sequence, status, values = made.read(INITIAL, told)
        assert (status, bool(values)) == (FrameStatus.FIRST, is_read)
        assert sequence.counter == 0  # it counts all the same


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_one_float_that_is_no_number_makes_a_frame_without_values(database, number):
    plain = database.message("PLAIN")
    made = compile_incoming(plain, [height(0, 0), height(1, 1, "OTHER_HEIGHT")])
    for pair in ((0.5, number), (number, 0.5)):
        read = made.read(INITIAL, Frame(0, 257, struct.pack("<2f", *pair)))
        assert read == (INITIAL, FrameStatus.OK, NO_VALUES)
    read = made.read(INITIAL, Frame(0, 257, struct.pack("<2f", 0.5, 0.25)))
    assert read == (INITIAL, FrameStatus.OK, (0.5, 0.25))
    assert made.read(INITIAL, Frame(0, 257, bytes(7))) == (INITIAL, FrameStatus.WRONG_LENGTH, None)


def test_a_float_beside_an_integer_is_looked_at_as_well(database):
    cell = channel(1, Role.BENCH, LOAD_CELL_FORCE, "FORCE")
    made = compile_incoming(database.message("MIXED"), [height(0, 0), cell])
    for number, expected in ((0.5, (0.5, 7.0)), (math.nan, NO_VALUES)):
        data = struct.pack("<fB3x", number, 7)
        assert made.read(INITIAL, Frame(0, 258, data))[2] == expected


@pytest.mark.parametrize(
    ("raw", "is_value"), [(0, True), (0xFAFF, True), (0xFB00, False), (0xFE00, False)]
)
@pytest.mark.parametrize("place", [0, 1])
def test_a_parameter_of_j1939_holds_values_up_to_its_valid_range(database, place, raw, is_value):
    group = database.message("GROUP")
    assert group.is_j1939
    made = compile_incoming(group, [height(0, 0), height(1, 1, "OTHER_HEIGHT")])
    words = [32_000, 32_000, 0, 0]
    words[place] = raw
    _, status, values = made.read(INITIAL, Frame(0, 0x18FEF500, struct.pack("<4H", *words), True))
    expected = [0.0, 0.0]
    expected[place] = (0.1 * raw - 3200.0) / 1000.0
    if is_value:
        assert (status, values) == (FrameStatus.OK, pytest.approx(expected))
    else:
        assert (status, values) == (FrameStatus.OK, NO_VALUES)


@pytest.mark.parametrize(("raw", "is_value"), [(0, True), (1000, True), (1001, False)])
def test_a_parameter_of_j1939_holds_values_in_the_range_of_the_dbc(database, raw, is_value):
    made = compile_incoming(database.message("GROUP"), [CELL])
    data = struct.pack("<4H", 0xFFFF, 0xFFFF, raw, 0)
    _, _, values = made.read(INITIAL, Frame(0, 0x18FEF500, data, True))
    # What is not read may be anything.
    assert values == (pytest.approx((100.0 + 0.1 * raw,)) if is_value else NO_VALUES)


@pytest.mark.parametrize(
    ("name", "low_n", "high_n"),
    [
        ("UP_FROM_ZERO", 0.0, 64_255.0),
        ("UP_TO_ZERO", -64_255.0, 0.0),
        ("BELOW_ZERO", -64_300.0, -45.0),
    ],
)
def test_the_ends_of_a_range_are_values_whatever_their_sign(database, name, low_n, high_n):
    cell = channel(0, Role.BENCH, LOAD_CELL_FORCE, name)
    made = compile_incoming(database.message("ENDS"), [cell])
    for raw, expected in ((0, (low_n,)), (0xFAFF, (high_n,)), (0xFB00, NO_VALUES)):
        data = struct.pack("<4H", raw, raw, raw, raw)
        assert made.read(INITIAL, Frame(0, 0x18FEF600, data, True))[2] == expected


def test_every_value_of_a_parameter_of_j1939_is_within_its_range(database):
    """However the scale rounds: a bound is computed in another way than the value there."""
    made = compile_incoming(database.message("GROUP"), [height(0, 0)])
    for raw in (*range(0, 0xFB00, 97), 0xFAFE, 0xFAFF):
        data = struct.pack("<4H", raw, 0xFFFF, 0, 0)
        assert made.read(INITIAL, Frame(0, 0x18FEF500, data, True))[2]
