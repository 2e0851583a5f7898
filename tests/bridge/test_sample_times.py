"""Sample times against senders whose clock, waits and pauses are known."""

from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from rig.bridge.sample_times import (
    FrameTime,
    SenderClock,
    compile_follower,
    compile_follower_of_times,
)

MS = 1_000_000


def follow(arrivals_ns: Iterable[int], cycle_ns: int = MS, lost: int = 0) -> list[SenderClock]:
    """Clock at each frame; behind the first one `lost` frames are missing."""
    follower, clock, found = compile_follower(cycle_ns), None, []
    for number, arrival_ns in enumerate(arrivals_ns):
        clock = follower(clock, int(arrival_ns), 1 + (lost if number == 1 else 0))
        found.append(clock)
    return found


def sampled_ns(frames: int, drift_ppm: float = 0.0, cycle_ns: int = MS) -> np.ndarray:
    return 5 * MS + np.round(np.arange(frames) * cycle_ns * (1 + 1e-6 * drift_ppm)).astype(np.int64)


def dues(clocks: Sequence[SenderClock]) -> np.ndarray:
    return np.array([clock.due_ns for clock in clocks])


@given(st.integers(-9_000, 9_000), st.sampled_from([MS, 2 * MS, 10 * MS]))
def test_a_sender_that_does_not_wait_is_due_when_it_arrives(drift_ppm, cycle_ns):
    arrivals_ns = np.arange(400) * (cycle_ns + cycle_ns * drift_ppm // 1_000_000)
    clocks = follow(arrivals_ns, cycle_ns)
    assert dues(clocks).tolist() == arrivals_ns.tolist()
    assert {clock.timing for clock in clocks} == {FrameTime.IN_TIME}


@given(st.lists(st.integers(0, 30 * MS), min_size=2, max_size=300))
def test_no_sample_is_newer_than_its_frame(steps_ns):
    arrivals_ns = np.cumsum(steps_ns)
    used = [clock for clock in follow(arrivals_ns) if clock.timing is FrameTime.IN_TIME]
    assert all(clock.due_ns <= clock.arrival_ns for clock in used)


@pytest.mark.parametrize("drift_ppm", [-200.0, 0.0, 80.0, 5000.0])
@pytest.mark.parametrize("wait_ms", [0.05, 0.12, 0.4])
def test_waits_at_random(drift_ppm, wait_ms):
    rng = np.random.default_rng(4)
    true_ns = sampled_ns(2000, drift_ppm)
    arrivals_ns = true_ns + rng.uniform(0.0, wait_ms * MS, 2000).astype(np.int64)
    clocks = follow(np.maximum.accumulate(arrivals_ns))
    assert {clock.timing for clock in clocks[200:]} == {FrameTime.IN_TIME}
    errors_ns = dues(clocks)[200:] - true_ns[200:]
    # The least of 64 waits is a 65th of their range in the mean, and its slope as uncertain.
    assert np.sqrt(np.mean(errors_ns**2)) < wait_ms * MS / 16
    assert np.sqrt(np.mean(errors_ns**2)) < 0.3 * np.std(arrivals_ns - true_ns)


@pytest.mark.parametrize("held", [2, 5, 12])
def test_frames_that_are_held_back_keep_their_times(held):
    true_ns = sampled_ns(3000, 60.0)
    arrivals_ns = true_ns.copy()
    for begin in range(500, 3000, 250):
        arrivals_ns[begin : begin + held] = true_ns[begin + held]
    clocks = follow(arrivals_ns)
    late = [item.timing is FrameTime.LATE for item in clocks]
    # The first of each batch alone: the next ones show that it had waited.
    assert sum(late) == (10 if held > 1 else 0)
    assert {item.timing for item in clocks} == {FrameTime.IN_TIME, FrameTime.LATE}
    assert np.abs(dues(clocks) - true_ns)[200:].max() <= 1000


def test_a_queue_at_the_start_states_no_times():
    arrivals_ns = np.concatenate([np.full(200, 5 * MS), 6 * MS + np.arange(100) * MS])
    timings = [clock.timing for clock in follow(arrivals_ns)]
    assert FrameTime.IN_TIME not in timings[1:201]
    assert set(timings[201:]) == {FrameTime.IN_TIME}


def test_a_gap_beyond_the_counters_round():
    # 20 frames held back: the counter went round, and 15 of them look lost.
    true_ns = sampled_ns(600)
    arrivals_ns = true_ns.copy()
    arrivals_ns[400:420] = true_ns[420]
    follower, clock, timings = compile_follower(MS), None, []
    for number, arrival_ns in enumerate(arrivals_ns):
        clock = follower(clock, int(arrival_ns), 16 if number == 400 else 1)
        timings.append(clock.timing)
    assert FrameTime.IN_TIME not in timings[400:422]
    assert set(timings[422:]) == {FrameTime.IN_TIME}
    assert clock.due_ns == arrivals_ns[-1]


def test_a_first_frame_that_waited():
    arrivals_ns = sampled_ns(100)
    arrivals_ns[0] += MS * 2 // 3
    clocks = follow(arrivals_ns)
    assert [clock.timing for clock in clocks[1:3]] == [FrameTime.EARLY] * 2
    assert {clock.timing for clock in clocks[3:]} == {FrameTime.IN_TIME}
    assert dues(clocks)[3:].tolist() == arrivals_ns[3:].tolist()


def test_a_sender_that_pauses_is_followed_again():
    arrivals_ns = sampled_ns(600)
    arrivals_ns[300:] += 3 * MS
    clocks = follow(arrivals_ns)
    timings = [clock.timing for clock in clocks]
    assert set(timings[300:307]) == {FrameTime.LATE}
    assert set(timings[307:]) == {FrameTime.IN_TIME}
    assert dues(clocks)[307:].tolist() == arrivals_ns[307:].tolist()


def test_a_sender_that_waits_between_frames_has_no_clock():
    rng = np.random.default_rng(5)
    arrivals_ns = np.cumsum(MS + rng.exponential(0.08 * MS, 3000).astype(np.int64))
    clocks = follow(arrivals_ns)
    is_arrival = dues(clocks)[1000:] == arrivals_ns[1000:]
    assert is_arrival.mean() > 0.8
    assert sum(clock.timing is not FrameTime.IN_TIME for clock in clocks[1000:]) < 20


def test_a_frame_of_another_sender_leaves_the_clock_as_it_is():
    follower, clock = compile_follower(MS), None
    for number in range(100):
        clock = follower(clock, number * MS, 1)
    # One with a right CRC by chance, a third of a cycle later, and the two that it has refused.
    clock = follower(clock, 99 * MS + MS // 3, 3)
    assert clock.timing is FrameTime.EARLY
    clock = follower(clock, 103 * MS, 1)
    assert (clock.timing, clock.due_ns) == (FrameTime.IN_TIME, 103 * MS)


def test_lost_frames_are_no_wait():
    true_ns = sampled_ns(300)
    kept = np.concatenate([true_ns[:1], true_ns[6:]])
    assert dues(follow(kept, lost=5)).tolist() == kept.tolist()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_quick_and_slow_senders_alike(seed):
    """Times scale with the cycle: 500 Hz with waits of 0.12 ms as 1 kHz with those of 0.06 ms."""
    waits = np.random.default_rng(seed).integers(0, 60_000, 300)
    slow = follow(sampled_ns(300, cycle_ns=2 * MS) + 2 * waits, 2 * MS)
    quick = follow(sampled_ns(300) + waits)
    assert np.abs((dues(slow) - 5 * MS) - 2 * (dues(quick) - 5 * MS)).max() <= 300


BLOCK = 64
"""Cycles after which the line goes through the lowest arrival again."""


def timings_of(clocks: Sequence[SenderClock]) -> list[str]:
    return [clock.timing.value for clock in clocks]


def after_steady(*late_ns: int, frames: int = 300, gaps: Sequence[int] = ()) -> list[SenderClock]:
    """Clocks at frames by how late they come, behind some that came in time.

    `gaps` are the cycles before each of them, one where none is given.
    """
    follower, clock, found = compile_follower(MS), None, []
    for number in range(frames):
        clock = follower(clock, number * MS, 1)
    cycles = frames - 1
    for number, late in enumerate(late_ns):
        step = gaps[number] if number < len(gaps) else 1
        cycles += step
        clock = follower(clock, cycles * MS + late, step)
        found.append(replace(clock, due_ns=clock.due_ns - cycles * MS))
    return found


def test_the_line_begins_at_the_first_frame_and_rises_by_a_cycle_and_a_hundredth():
    follower = compile_follower(MS)
    first = follower(None, 7 * MS, 1)
    assert (first.arrival_ns, first.due_ns, first.timing) == (7 * MS, 7 * MS, FrameTime.IN_TIME)
    assert first.line.is_believed
    for cycles in (1, 2, 5):
        late = follower(first, 7 * MS + cycles * MS + 200_000, cycles)
        assert late.due_ns == 7 * MS + cycles * 1_010_000
        early = follower(first, 7 * MS + cycles * MS, cycles)
        assert early.due_ns == 7 * MS + cycles * MS


@pytest.mark.parametrize(
    ("step_ns", "known_ns"),
    [
        (1_003_000, 1_003_000),
        (1_012_000, 1_012_000),
        (990_000, 990_000),
        (1_000_000.5, 1_000_001),
        (800_000, 875_000),
    ],
)
def test_the_step_is_known_after_two_blocks(step_ns, known_ns):
    """Rounded up, and within an eighth of the cycle."""
    clocks = follow(np.floor(np.arange(200) * step_ns))
    steps = [clock.line.step_ns for clock in clocks]
    assert steps[: 2 * BLOCK] == [1_010_000] * 2 * BLOCK
    assert steps[2 * BLOCK :] == [known_ns] * (200 - 2 * BLOCK)


def test_a_sender_much_slower_than_its_cycle_is_followed_up_to_an_eighth_of_it():
    assert follow(np.arange(129) * 1_150_000)[-1].line.step_ns == 1_125_000


def test_the_step_is_that_of_the_last_four_blocks():
    # Half a nanosecond less than the line rises: the last frame of each block is its lowest.
    steps_ns = [*[1_000_000, 999_999] * (3 * BLOCK), *[999_744] * (6 * BLOCK)]
    clocks = follow(np.concatenate([[0], np.cumsum(steps_ns)]))
    known_ns = [clock.line.step_ns for clock in clocks[6 * BLOCK :: BLOCK]]
    assert known_ns == [1_000_000, 999_936, 999_872, 999_808, 999_744, 999_744, 999_744]


@pytest.mark.parametrize("seed", range(50))
def test_behind_blocks_with_one_frame_that_did_not_wait_every_time_is_exact(seed):
    """Of a hundred such sequences one is taken for a sender that waits between frames."""
    rng = np.random.default_rng(seed)
    drift_ns = int(rng.integers(-300, 300))
    frames = 14 * BLOCK
    true_ns = np.arange(frames) * (MS + drift_ns)
    waits_ns = rng.integers(40_000, 120_000, frames)
    # It may stand anywhere in its block, which ends with the frame of number 64, 128, ...
    waits_ns[1 + BLOCK * np.arange(14) + rng.integers(0, BLOCK - 1, 14)] = 0
    waits_ns[0] = 0
    found = follow(true_ns + waits_ns)
    assert dues(found)[10 * BLOCK :].tolist() == true_ns[10 * BLOCK :].tolist()
    assert all(clock.line.is_clock and clock.line.is_believed for clock in found[10 * BLOCK :])


@pytest.mark.parametrize(
    ("late_ns", "timing", "due_ns"),
    [
        (0, "in_time", 0),
        (1, "in_time", 0),
        (MS // 4, "in_time", 0),
        (MS // 4 + 1, "in_time", 0),
        (MS, "in_time", 0),
        (MS + 1, "late", 0),
        (5 * MS, "late", 0),
        (-1, "in_time", -1),
        (-MS // 4, "in_time", -MS // 4),
        (-MS // 4 - 1, "early", 0),
    ],
)
def test_one_frame_off_the_line(late_ns, timing, due_ns):
    """Late by up to a cycle it may be used; early by a quarter it contradicts the clock."""
    (clock,) = after_steady(late_ns)
    assert timings_of([clock]) == [timing]
    if timing != "early":
        assert clock.due_ns == due_ns
    # The line is lower by what the frame was early, and else where it was.
    behind = after_steady(late_ns, max(late_ns, 0))[1]
    assert behind.due_ns == min(due_ns, 0)


@pytest.mark.parametrize(("gap", "timing"), [(8, "late"), (9, "early")])
def test_up_to_eight_cycles_the_counter_alone_tells_how_many_they_were(gap, timing):
    (clock,) = after_steady(2 * MS, gaps=(gap,))
    assert clock.timing.value == timing


def test_a_frame_on_the_line_behind_a_long_silence_is_in_time():
    (clock,) = after_steady(MS // 4, gaps=(1000,))
    assert (clock.timing, clock.due_ns) == (FrameTime.IN_TIME, 0)


def test_behind_a_silence_three_frames_show_where_the_line_is():
    # The counter went round: the number of cycles is wrong by some part of a cycle or more.
    clocks = after_steady(*[400_000] * 4, gaps=(50,))
    assert timings_of(clocks) == ["early", "early", "in_time", "in_time"]
    assert [clock.due_ns for clock in clocks[2:]] == [400_000] * 2
    # On the line by chance, the frames behind it are no less a guess.
    clocks = after_steady(400_000, 0, 0, 0, gaps=(50,))
    assert timings_of(clocks) == ["early", "early", "early", "in_time"]


def test_behind_a_long_gap_after_the_first_frame_three_frames_show_where_the_line_is():
    # A hundredth in each of 40 cycles is more than a quarter of one.
    follower = compile_follower(MS)
    clocks = [follower(None, 0, 1)]
    for number, cycles in ((40, 40), (41, 1), (42, 1), (43, 1)):
        clocks.append(follower(clocks[-1], number * MS, cycles))
    assert timings_of(clocks) == ["in_time", "early", "early", "in_time", "in_time"]


@pytest.mark.parametrize("on_line_ns", [0, MS // 4, -MS // 4])
@pytest.mark.parametrize("gap", [1, 20])
def test_a_frame_on_the_line_shows_that_the_one_before_it_had_waited(on_line_ns, gap):
    clocks = after_steady(3 * MS, on_line_ns, gaps=(1, gap))
    assert timings_of(clocks) == ["late", "in_time"]
    assert [clock.line.is_believed for clock in clocks] == [False, True]


def test_once_the_line_is_known_again_no_number_of_cycles_is_a_guess():
    clocks = after_steady(*[400_000] * 4, 400_000 + 2 * MS, gaps=(50,))
    assert timings_of(clocks)[2:] == ["in_time", "in_time", "late"]


def test_an_early_frame_that_none_is_like_leaves_the_line_through_the_end_of_a_block():
    clocks = after_steady(-300_000, *[0] * 2 * BLOCK)
    assert not any(clock.due_ns for clock in clocks[1:])
    assert {clock.line.step_ns for clock in clocks} == {MS}


@pytest.mark.parametrize(("late_ns", "frames"), [(300_000, 8), (3 * MS, 8), (-300_000, 3)])
def test_frames_that_are_off_by_the_same_time_move_the_line(late_ns, frames):
    clocks = after_steady(*[late_ns] * (frames + 1))
    before, moved = clocks[: frames - 1], clocks[frames - 1 :]
    assert [clock.due_ns for clock in moved] == [late_ns] * 2
    assert timings_of(moved) == ["in_time"] * 2
    assert not any(clock.line.is_believed for clock in before)
    assert all(clock.line.is_believed for clock in moved)
    # One fewer, and the line is where it was.
    assert [clock.due_ns for clock in after_steady(*[late_ns] * (frames - 1), 0)][-1] == 0


def test_the_end_of_a_block_makes_no_late_frame_believed():
    # The fifth of them ends the block.
    clocks = after_steady(*[3 * MS] * 8, frames=5 * BLOCK - 4)
    assert [clock.line.ends_at for clock in clocks[3:5]] == [5 * BLOCK, 6 * BLOCK]
    assert [clock.line.is_believed for clock in clocks] == [False] * 7 + [True]


@pytest.mark.parametrize("late_ns", [300_000, 3 * MS])
def test_frames_that_are_late_by_different_times_had_waited(late_ns):
    """Different by an eighth of a cycle, or one in between was on the line."""
    scattered = [late_ns, late_ns + 125_000] * 10
    for late in (scattered, [*[late_ns] * 7, 0, *[late_ns] * 7]):
        clocks = after_steady(*late, 0)
        assert clocks[-1].due_ns == 0
        assert not any(clock.due_ns for clock in clocks)
    alike = [late_ns, late_ns + 124_999] * 4
    assert after_steady(*alike)[-1].due_ns == late_ns + 124_999


def test_early_frames_alike_are_counted_from_the_last_that_differed():
    clocks = after_steady(-300_000, -450_000, -450_000)
    assert timings_of(clocks) == ["early"] * 3
    clocks = after_steady(-300_000, -450_000, -450_000, -450_000)
    assert timings_of(clocks) == ["early"] * 3 + ["in_time"]
    assert clocks[-1].due_ns == -450_000


def test_frames_that_catch_up_had_waited():
    """Each a little less late than the one before, until one is in time."""
    waited = [5 * MS - 600_000 * number for number in range(9)]
    clocks = after_steady(*waited)
    assert timings_of(clocks) == ["late"] + ["in_time"] * 8
    assert [clock.due_ns for clock in clocks] == [0] * 9


@pytest.mark.parametrize(("sooner_ns", "timing"), [(249_999, "late"), (250_000, "in_time")])
def test_a_late_frame_is_clear_where_it_came_a_quarter_sooner_behind_the_last(sooner_ns, timing):
    clocks = after_steady(3 * MS, 3 * MS - sooner_ns)
    assert timings_of(clocks) == ["late", timing]


def pausing(pauses: int, begin: int = 200) -> list[SenderClock]:
    """Clocks of a sender that pauses for three cycles, every 20 frames, and then no more."""
    lengths = [begin, *[20] * (pauses - 1), 600]
    lates = np.repeat(np.arange(pauses + 1) * 3 * MS, lengths)
    return follow(np.arange(sum(lengths)) * MS + lates)[begin:]


def test_a_sender_that_pauses_again_and_again_has_no_clock_until_it_has_gone_steadily():
    assert all(clock.line.is_clock for clock in pausing(2))
    clocks = pausing(3)
    moves = [20 * number + 7 for number in (0, 1, 2)]  # with the eighth frame behind each pause
    lost = [number for number, clock in enumerate(clocks) if not clock.line.is_clock]
    # From the third pause on, and for three blocks that are as expected.
    assert lost == list(range(moves[2], moves[2] + 3 * BLOCK))
    arrivals = [clocks[number].arrival_ns for number in lost]
    assert [clocks[number].due_ns for number in lost] == arrivals
    assert {clocks[number].timing for number in lost} == {FrameTime.IN_TIME}
    assert all(clock.line.is_believed for clock in clocks[moves[2] + 3 * BLOCK :])


def test_at_the_beginning_a_sender_is_doubted_no_more_and_no_less():
    assert all(clock.line.is_clock for clock in pausing(2, begin=20))
    clocks = pausing(3, begin=20)
    assert [clock.line.is_clock for clock in clocks].index(False) == 47


def test_behind_a_move_of_the_line_the_next_but_one_block_is_judged():
    numbers = np.arange(308 + 6 * BLOCK)
    lates = np.where(numbers < 300, 0, 3 * MS)  # it moves with the eighth of them
    block = (numbers - 308) // BLOCK
    lates[(numbers >= 308) & (block % 2 == 1)] += 20_000
    lates[(numbers >= 308) & ((numbers - 307) % BLOCK == 0)] += 100_000
    clocks = follow(numbers * MS + lates)
    assert [clock.line.is_clock for clock in clocks].index(False) == 307 + 4 * BLOCK


def test_the_frame_that_a_block_ends_with_is_the_first_of_the_next():
    numbers = np.arange(20 * BLOCK)
    waits_ns = np.where(numbers % (2 * BLOCK), 50_000, 0)
    clocks = follow(numbers * MS + waits_ns)
    assert dues(clocks)[10 * BLOCK :].tolist() == (numbers * MS)[10 * BLOCK :].tolist()


def test_a_sender_that_slows_down_behind_its_first_block_has_a_step_near_its_cycle():
    # The frame that ends the block is the lowest of this block and of the next one.
    steps_ns = [MS] * BLOCK + [1_012_000] * (3 * BLOCK)
    clocks = follow(np.concatenate([[0], np.cumsum(steps_ns)]))
    assert all(7 * MS <= 8 * clock.line.step_ns <= 9 * MS for clock in clocks)


def wandering(blocks: int, offset_ns: int, wait_ns: int, steady: int = 24) -> list[SenderClock]:
    """Clocks of a sender of which every second block is late as a whole, and then none.

    All frames but one of a block wait besides, the last one the longest.
    """
    numbers = np.arange((8 + blocks + steady) * BLOCK + 1)
    block = (numbers - 1) // BLOCK
    is_off = (block >= 8) & (block < 8 + blocks) & (block % 2 == 0)
    waits = np.where((numbers - 1) % BLOCK == 30, 0, wait_ns)
    waits[numbers % BLOCK == 0] = 120_000
    return follow(numbers * MS + offset_ns * is_off + waits)


@pytest.mark.parametrize(
    ("offset_ns", "wait_ns", "is_clock"),
    [
        (14_000, 0, True),
        (15_625, 0, True),  # a 64th of a cycle
        (17_000, 0, False),
        (20_000, 100_000, True),
        # A mean wait is 100 us, and the offset besides in a block that has it: two fifths of that.
        (64_000, 100_000, True),
        (69_000, 100_000, False),
    ],
)
def test_blocks_that_scatter_as_much_as_their_frames_state_no_time(offset_ns, wait_ns, is_clock):
    clocks = wandering(16, offset_ns, wait_ns)
    assert all(clock.line.is_clock for clock in clocks[: 8 * BLOCK])
    assert all(clock.line.is_clock for clock in clocks[8 * BLOCK : 24 * BLOCK]) == is_clock


@pytest.mark.parametrize("early_ns", [20_000, 40_000, 60_000])
def test_however_the_step_changes_no_frame_is_due_after_its_arrival(early_ns):
    # The step rises when the frame that was early is the oldest that it is measured from.
    numbers = np.arange(20 * BLOCK)
    clocks = follow(numbers * MS - np.where(numbers == 8 * BLOCK + 20, early_ns, 0))
    assert max(clock.line.step_ns for clock in clocks[4 * BLOCK :]) > MS
    assert all(clock.due_ns <= clock.arrival_ns for clock in clocks)


@pytest.mark.parametrize(("blocks", "steady"), [(1, 0), (2, 0), (4, 4), (6, 6), (40, 6)])
def test_a_clock_is_lost_in_three_blocks_and_back_after_as_many_steady_ones_six_at_most(
    blocks, steady
):
    clocks = wandering(blocks, 20_000, 0)
    lost = [number for number, clock in enumerate(clocks) if not clock.line.is_clock]
    first = (8 + 3) * BLOCK
    assert lost == list(range(first, (8 + blocks + steady) * BLOCK if steady else first))
    for number in lost:
        assert clocks[number].due_ns == clocks[number].arrival_ns
        assert clocks[number].timing is FrameTime.IN_TIME


def follow_stamps(arrivals_ns, stamps_ns, cycle_ns=MS, round_ns=0):
    follower, clock, found = compile_follower_of_times(cycle_ns, round_ns), None, []
    for arrival_ns, stamp_ns in zip(arrivals_ns, stamps_ns, strict=True):
        clock = follower(clock, int(arrival_ns), int(stamp_ns))
        found.append(clock)
    return found


@pytest.mark.parametrize("drift_ppm", [-200.0, 0.0, 80.0])
@pytest.mark.parametrize("round_ns", [0, 1 << 16, 1 << 26])
def test_a_sender_that_states_its_time_may_sample_when_it_likes(drift_ppm, round_ns):
    """Its interval is anything, its clock has an offset and drifts, its frames wait."""
    rng = np.random.default_rng(6)
    true_ns = 7 * MS + np.cumsum(rng.integers(MS // 2, 3 * MS, 3000))
    unit = MS // 1000 if round_ns == 1 << 16 else 1
    stamps_ns = 123_456_789 + np.round((true_ns - true_ns[0]) * (1 - 1e-6 * drift_ppm))
    stamps_ns = stamps_ns.astype(np.int64)
    if round_ns:
        stamps_ns %= round_ns * unit
    arrivals_ns = true_ns + rng.uniform(0.0, 0.4 * MS, 3000).astype(np.int64)
    for begin in range(500, 3000, 250):
        arrivals_ns[begin : begin + 8] = arrivals_ns[begin + 8]
    clocks = follow_stamps(arrivals_ns, stamps_ns, round_ns=round_ns * unit)
    used = [
        (clock.due_ns, true)
        for clock, true in zip(clocks[300:], true_ns[300:], strict=True)
        if clock.timing is FrameTime.IN_TIME
    ]
    assert len(used) > 2600
    errors_ns = np.array([due - true for due, true in used])
    assert np.sqrt(np.mean(errors_ns**2)) < 0.4 * MS / 16


@given(st.integers(-9_000, 9_000), st.integers(0, 2**40))
def test_stamps_a_cycle_apart_are_a_counter(drift_ppm, first_ns):
    arrivals_ns = np.arange(400) * (MS + MS * drift_ppm // 1_000_000)
    by_counter = follow(arrivals_ns)
    by_stamp = follow_stamps(arrivals_ns, first_ns + np.arange(400) * MS)
    assert dues(by_stamp).tolist() == dues(by_counter).tolist()
    assert [it.timing for it in by_stamp] == [it.timing for it in by_counter]


def test_a_sender_of_times_that_starts_again_is_followed_again():
    arrivals_ns = sampled_ns(600)
    stamps_ns = np.concatenate([np.arange(300), np.arange(300)]) * MS
    for round_ns in (0, 2**32 * 1000):
        clocks = follow_stamps(arrivals_ns, stamps_ns, round_ns=round_ns)
        timings = [clock.timing for clock in clocks]
        assert FrameTime.IN_TIME not in timings[300:307]
        assert set(timings[308:]) == {FrameTime.IN_TIME}
        assert dues(clocks)[308:].tolist() == arrivals_ns[308:].tolist()
