"""A frame that is called in sequence is one that `check` calls OK after an accepted one."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.bulk_check import in_sequence
from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.protection import INITIAL, FrameStatus, compile_checker, compile_protector

MESSAGE = load_database(DEFAULT_DATABASE).message("BENCH_MEASUREMENT")


@settings(max_examples=200)
@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from([1, 1, 1, 1, 0, 2, 15, 5]),
            st.sampled_from([1, 1, 1, 0, 3, 40, -2]),
            st.sampled_from(["", "", "", "", "flip", "short"]),
        ),
        max_size=40,
    )
)
def test_the_frequent_case_is_judged_as_frame_by_frame(steps):
    protection = MESSAGE.protection
    assert protection is not None
    length = protection.length_bytes
    count = len(steps)
    payloads = np.zeros((count, length + 2), dtype=np.uint8)
    lengths = np.full(count, length)
    t_ns = np.zeros(count, dtype=np.int64)
    verdicts: list[FrameStatus] = []
    state, counter, now_ns = INITIAL, 0, 10**9
    for index, (step, cycles, fault) in enumerate(steps):
        counter += step
        now_ns += cycles * 1_000_000
        data = bytearray(compile_protector(protection)(bytes(length), counter))
        data[-1] ^= 0x04 if fault == "flip" else 0
        data = data[: length - (fault == "short")]
        payloads[index, : len(data)] = np.frombuffer(data, dtype=np.uint8)
        lengths[index], t_ns[index] = len(data), now_ns
        state, verdict = compile_checker(protection)(state, data, now_ns)
        verdicts.append(verdict)
    follows = in_sequence(payloads, lengths, t_ns, protection)
    assert not follows[:1].any()
    for index in range(1, count):
        if verdicts[index - 1].is_accepted:
            next_one = steps[index][0] == 1 and verdicts[index] is FrameStatus.OK
            assert not follows[index] or verdicts[index] is FrameStatus.OK
            assert follows[index] or not next_one or t_ns[index] - t_ns[index - 1] > 0
        if steps[index][0] == 1 and steps[index][2] == steps[index - 1][2] == "":
            assert follows[index] == (t_ns[index] - t_ns[index - 1] < protection.silence_ns)


def test_no_frame_follows_where_all_are_too_short():
    protection = MESSAGE.protection
    assert protection is not None
    short = np.zeros((5, 3), dtype=np.uint8)
    assert not in_sequence(short, np.full(5, 3), np.arange(5), protection).any()
    nothing = np.zeros((0, 8), dtype=np.uint8)
    assert len(in_sequence(nothing, np.zeros(0, np.int64), np.zeros(0, np.int64), protection)) == 0
