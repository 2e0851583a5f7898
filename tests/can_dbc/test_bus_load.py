"""How long frames occupy the bus: published worst cases, and bits counted by hand."""

from collections.abc import Callable
from pathlib import Path

import pytest

from can_dbc.bus_load import frame_time_s
from can_dbc.database import Message, load_database

BITRATE, DATA_BITRATE = 500_000, 2_000_000


@pytest.fixture
def message(write_dbc: Callable[..., Path]) -> Callable[..., Message]:
    def made(length: int, frame_format: int, arbitration_id: int = 0x100) -> Message:
        text = f'BO_ {arbitration_id} M: {length} BENCH\n SG_ S : 0|8@1+ (1,0) [0|0] "" RIG\n'
        path = write_dbc(text, f'BA_ "VFrameFormat" BO_ {arbitration_id} {frame_format};\n')
        return load_database(path).message("M")

    return made


@pytest.mark.parametrize("length", [1, 4, 8])
def test_classic_frames_take_what_davis_et_al_give(message, length: int) -> None:
    """Equations 2 and 3 of the paper: 55 + 10 s bits with 11-bit, 80 + 10 s with 29-bit ids."""
    standard = frame_time_s(message(length, 0), BITRATE, None)
    extended = frame_time_s(message(length, 1, 0x80000100), BITRATE, None)
    assert standard == pytest.approx((55 + 10 * length) / BITRATE, rel=1e-12)
    assert extended == pytest.approx((80 + 10 * length) / BITRATE, rel=1e-12)


@pytest.mark.parametrize(("length", "crc_bits", "stuff_count_bits"), [(8, 17, 4), (64, 21, 4)])
def test_fd_frames_bit_by_bit(message, length: int, crc_bits: int, stuff_count_bits: int) -> None:
    slow_bits = 1 + 11 + 1 + 1 + 1 + 1 + 1  # start, identifier, RRS, IDE, FDF, res, BRS
    slow_bits += slow_bits // 4  # stuff bits
    slow_bits += 1 + 1 + 1 + 7 + 3  # delimiter, acknowledgement and its delimiter, end, interframe
    fast_bits = 1 + 4 + 8 * length  # ESI, DLC, payload
    fast_bits += fast_bits // 4
    fast_bits += stuff_count_bits + crc_bits + -(-(stuff_count_bits + crc_bits) // 4)
    expected_s = slow_bits / BITRATE + fast_bits / DATA_BITRATE
    found_s = frame_time_s(message(length, 14), BITRATE, DATA_BITRATE)
    assert found_s == pytest.approx(expected_s, rel=1e-12)


@pytest.mark.parametrize(
    ("length", "sent"), [(9, 12), (13, 16), (17, 20), (21, 24), (25, 32), (33, 48), (49, 64)]
)
def test_an_fd_payload_is_padded_to_the_next_length_that_a_dlc_has(message, length, sent) -> None:
    padded, whole = message(length, 14), message(sent, 14)
    assert frame_time_s(padded, BITRATE, None) == frame_time_s(whole, BITRATE, None)
    assert frame_time_s(message(sent - 1, 14), BITRATE, None) == frame_time_s(whole, BITRATE, None)
    bits = (frame_time_s(message(length - 1, 14), BITRATE, None)) * BITRATE
    assert frame_time_s(whole, BITRATE, None) * BITRATE >= bits + 8 * (sent - length)
