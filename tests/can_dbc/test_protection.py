"""What is accepted, what is refused, and what the refusal is called."""

from collections.abc import Callable, Iterable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from e2e.p01 import e2e_p01_protect
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.codec import compile_decoder
from can_dbc.database import Database, load_database
from can_dbc.protection import (
    INITIAL,
    RESYNC_FRAMES,
    FrameStatus,
    Protection,
    SequenceState,
    check_crc,
    check_crc_log,
    compile_checker,
    compile_protector,
    read_counter,
)
from can_dbc.units import Dimension

MS = 1_000_000


@pytest.fixture(scope="module")
def protection(rig: Database) -> Protection:
    found = rig.message("BENCH_MEASUREMENT").protection
    assert found is not None
    return found


@pytest.fixture(scope="module")
def first_profile(write_dbc: Callable[..., Path]) -> Protection:
    path = write_dbc(
        'BO_ 9 M: 6 BENCH\n SG_ CHECK : 7|8@0+ (1,0) [0|0] "" RIG\n'
        ' SG_ ALIVE : 11|4@0+ (1,0) [0|0] "" RIG\n',
        'BA_ "E2EProfile" BO_ 9 "P01";\nBA_ "E2EDataIds" BO_ 9 "1234";\n'
        'BA_ "E2ECrcSignal" BO_ 9 "CHECK";\nBA_ "E2ECounterSignal" BO_ 9 "ALIVE";\n'
        'BA_ "GenMsgCycleTime" BO_ 9 1;\n',
    )
    found = load_database(path).message("M").protection
    assert found is not None
    return found


def frame(counter: int, protection: Protection, fill: int = 0x5A) -> bytes:
    return compile_protector(protection)(bytes([fill]) * protection.length_bytes, counter)


def judge(
    frames: Iterable[tuple[float, int]], protection: Protection, state: SequenceState = INITIAL
) -> tuple[SequenceState, list[FrameStatus]]:
    """Check frames given as (time in ms, number)."""
    verdicts: list[FrameStatus] = []
    check = compile_checker(protection)
    for t_ms, number in frames:
        state, verdict = check(state, frame(number, protection), round(t_ms * MS))
        verdicts.append(verdict)
    return state, verdicts


def all_errors(bits: int, weight: int) -> np.ndarray:
    """All error patterns of some flipped bits, shape (number, bits / 8)."""
    places = np.array(list(combinations(range(bits), weight)))
    flips = np.zeros((len(places), bits), dtype=np.uint8)
    np.put_along_axis(flips, places, 1, axis=1)
    return np.packbits(flips, axis=1)


def test_no_error_of_up_to_three_bits_passes(rig: Database) -> None:
    errors = np.concatenate([all_errors(64, weight) for weight in (1, 2, 3)])
    assert len(errors) == 64 + 2016 + 41664
    rng = np.random.default_rng(3)
    for message in rig.messages.values():
        protection = message.protection
        assert protection is not None
        # CRC and ids are linear: whether an error passes depends on the counter, not the payload.
        for counter in range(16):
            sent = compile_protector(protection)(rng.bytes(8), counter)
            received = errors ^ np.frombuffer(sent, dtype=np.uint8)
            assert not check_crc_log(received, protection).any(), (message.name, counter)


def test_a_refused_frame_leaves_no_trace(protection: Protection) -> None:
    state, _ = judge([(0, 0)], protection)
    for bit in range(64):
        damaged = bytearray(frame(1, protection))
        damaged[bit // 8] ^= 1 << bit % 8
        after, verdict = compile_checker(protection)(state, damaged, MS)
        assert after == state
        assert verdict in {FrameStatus.WRONG_CRC, FrameStatus.MASQUERADE}
        assert not verdict.is_accepted


@pytest.mark.parametrize("profile", ["protection", "first_profile"])
def test_log_agrees_with_frames(request: pytest.FixtureRequest, profile: str) -> None:
    protection: Protection = request.getfixturevalue(profile)
    rng = np.random.default_rng(5)
    protect = compile_protector(protection)
    frames = [protect(rng.bytes(protection.length_bytes), i) for i in range(300)]
    data = np.array([list(entry) for entry in frames], dtype=np.uint8)
    assert check_crc_log(data, protection).all()
    data ^= (rng.random(data.shape) < 0.1).astype(np.uint8)
    data[::3, 0] = rng.integers(0, 256, 100)
    expected = [check_crc(bytes(row), protection) for row in data]
    assert 0 < sum(expected) < 300
    assert check_crc_log(data, protection).tolist() == expected
    assert not check_crc_log(data[:, 1:], protection).any()


@given(payload=st.binary(min_size=8, max_size=8), counter=st.integers(0, 10**6))
def test_protected_frames_pass_and_keep_their_payload(
    rig: Database, payload: bytes, counter: int
) -> None:
    message = rig.message("BENCH_MEASUREMENT")
    assert message.protection is not None
    sent = compile_protector(message.protection)(payload, counter)
    assert check_crc(sent, message.protection)
    assert read_counter(sent) == counter % 16
    names, dimensions = ["HEIGHT", "APPLIED_FORCE"], [Dimension.LENGTH, Dimension.FORCE]
    decode = compile_decoder(message, names, dimensions)
    assert decode(sent) == decode(payload)


def test_another_messages_frame_is_a_masquerade(rig: Database) -> None:
    for message in rig.messages.values():
        for other in rig.messages.values():
            if other is message:
                continue
            for counter in range(16):
                sent = frame(counter, other.protection)
                _, verdict = compile_checker(message.protection)(INITIAL, sent, 0)
                assert verdict is FrameStatus.MASQUERADE


def test_wrong_length(protection: Protection) -> None:
    for length in (0, 1, 7, 9, 64):
        state, verdict = compile_checker(protection)(INITIAL, bytes(length), 0)
        assert (state, verdict) == (INITIAL, FrameStatus.WRONG_LENGTH)
        assert not check_crc(bytes(length), protection)
    with pytest.raises(ValueError, match="7 bytes, expected 8"):
        compile_protector(protection)(bytes(7), 0)


def test_frames_in_sequence(protection: Protection) -> None:
    _, verdicts = judge(((t, t) for t in range(40)), protection)
    assert verdicts == [FrameStatus.FIRST] + [FrameStatus.OK] * 39


def test_jitter_changes_nothing(protection: Protection) -> None:
    _, verdicts = judge(((t + 0.9 * (t % 2), t) for t in range(40)), protection)
    assert verdicts == [FrameStatus.FIRST] + [FrameStatus.OK] * 39
    _, verdicts = judge(((5.0, t) for t in range(40)), protection)
    assert verdicts == [FrameStatus.FIRST] + [FrameStatus.OK] * 39


@pytest.mark.parametrize("missing", range(1, 60))
def test_lost_frames_are_counted(protection: Protection, missing: int) -> None:
    state, _ = judge(((t, t) for t in range(5)), protection)
    late = 5 + missing
    state, verdicts = judge([(late + 0.3, late)], protection, state)
    if missing % 16 == 15:
        # The counter is that of the last frame: one that a gateway repeats looks the same.
        assert verdicts == [FrameStatus.REPEATED]
        late, missing = late + 1, missing + 1
        state, verdicts = judge([(late + 0.3, late)], protection, state)
    assert verdicts == [FrameStatus.LOST]
    assert state.lost == missing
    state, verdicts = judge([(late + 1, late + 1)], protection, state)
    assert (verdicts, state.lost) == ([FrameStatus.OK], 0)


def test_lost_frames_without_a_cycle_time(write_dbc: Callable[..., Path]) -> None:
    path = write_dbc(
        'BO_ 9 M: 8 BENCH\n SG_ CRC : 0|8@1+ (1,0) [0|0] "" RIG\n'
        ' SG_ COUNTER : 8|4@1+ (1,0) [0|0] "" RIG\n',
        'BA_ "E2EProfile" BO_ 9 "P02";\n'
        'BA_ "E2EDataIds" BO_ 9 "000102030405060708090a0b0c0d0e0f";\n',
    )
    protection = load_database(path).message("M").protection
    assert protection is not None
    state, _ = judge([(0, 0)], protection)
    for missing in range(1, 7):
        after, verdicts = judge([(1000, missing + 1)], protection, state)
        assert (verdicts, after.lost) == ([FrameStatus.LOST], missing)
    _, verdicts = judge([(1000, 8)], protection, state)
    assert verdicts == [FrameStatus.OUT_OF_SEQUENCE]


@pytest.mark.parametrize("every", [1, 7, 15, 16, 17, 40])
def test_a_frame_that_is_sent_again_and_again_is_never_accepted(
    protection: Protection, every: int
) -> None:
    state, _ = judge(((t, t) for t in range(5)), protection)
    state, verdicts = judge(((4 + every * k, 4) for k in range(1, 30)), protection, state)
    assert set(verdicts) == {FrameStatus.REPEATED}


def test_repeated_frames(protection: Protection) -> None:
    frames = [(t, t) for t in range(3)] + [(t, 2) for t in range(3, 60)] + [(60, 3), (61, 4)]
    state, verdicts = judge(frames, protection)
    assert verdicts == [
        FrameStatus.FIRST,
        *[FrameStatus.OK] * 2,
        *[FrameStatus.REPEATED] * 57,
        *[FrameStatus.OK] * 2,
    ]
    assert state.counter == 4


def test_two_frames_that_swap_places(protection: Protection) -> None:
    numbers = [0, 1, 3, 2, 4, 5]
    _, verdicts = judge(enumerate(numbers), protection)
    assert verdicts == [
        FrameStatus.FIRST,
        FrameStatus.OK,
        FrameStatus.LOST,
        FrameStatus.OUT_OF_SEQUENCE,
        FrameStatus.OK,
        FrameStatus.OK,
    ]


@pytest.mark.parametrize("back", range(2, 9))
def test_a_sender_that_starts_anew_is_believed_after_some_frames(
    protection: Protection, back: int
) -> None:
    state, _ = judge(((t, t + 16) for t in range(20)), protection)
    start = 19 + 16 - back
    frames = [(20 + i, start + i) for i in range(6)]
    _, verdicts = judge(frames, protection, state)
    refused = [FrameStatus.OUT_OF_SEQUENCE] * RESYNC_FRAMES
    if back > RESYNC_FRAMES:
        assert verdicts == [*refused, FrameStatus.FIRST, *[FrameStatus.OK] * 3]
    else:  # it catches up with the old sequence first
        assert verdicts[-3:] == [FrameStatus.OK] * 3


@given(
    st.lists(
        st.tuples(st.sampled_from(["send", "lose", "repeat", "corrupt"]), st.integers(0, 63)),
        max_size=80,
    )
)
def test_accepted_and_lost_frames_add_up(
    protection: Protection, events: list[tuple[str, int]]
) -> None:
    """Whatever is lost, repeated or damaged: what was sent is accepted once or counted as lost."""
    state, number, accepted, lost = INITIAL, 0, [], 0
    t_ns = 0
    events = [("send", 0), *events, ("send", 0)]
    for event, bit in events:
        t_ns += MS
        if event == "repeat":
            state, verdict = compile_checker(protection)(state, frame(number - 1, protection), t_ns)
        elif event == "lose":
            number += 1
            continue
        else:
            data = bytearray(frame(number, protection))
            number += 1
            if event == "corrupt":
                data[bit // 8] ^= 1 << bit % 8
            state, verdict = compile_checker(protection)(state, data, t_ns)
        if verdict.is_accepted:
            assert event != "corrupt"
            accepted.append(number - 1)
            lost += state.lost
    assert len(set(accepted)) == len(accepted)
    if not any(event == "repeat" for event, _ in events):
        assert lost + len(accepted) == number


def test_first_profile_counts_to_fourteen(first_profile: Protection) -> None:
    assert read_counter(frame(14, first_profile)) == 14
    assert read_counter(frame(15, first_profile)) == 0
    _, verdicts = judge(((t, t) for t in range(40)), first_profile)
    assert verdicts == [FrameStatus.FIRST] + [FrameStatus.OK] * 39
    damaged = bytearray(frame(3, first_profile))
    damaged[4] ^= 1
    assert compile_checker(first_profile)(INITIAL, damaged, 0)[1] is FrameStatus.WRONG_CRC


def test_a_counter_that_the_first_profile_does_not_have_is_refused(
    first_profile: Protection,
) -> None:
    forged = bytearray(frame(14, first_profile))
    forged[1] |= 0x0F
    e2e_p01_protect(forged, 0x1234, increment_counter=False)
    assert read_counter(forged) == 15
    state, verdict = compile_checker(first_profile)(INITIAL, forged, 0)
    assert verdict is FrameStatus.WRONG_CRC
    assert state == INITIAL
    assert not check_crc(bytes(forged), first_profile)
    assert not check_crc_log(np.frombuffer(forged, np.uint8)[None, :], first_profile)[0]
