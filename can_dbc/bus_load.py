"""How long a frame occupies the bus, with the most stuff bits it can have.

Reference: ISO 11898-1; for classic CAN, Davis et al., "Controller Area Network (CAN) schedulability
analysis: Refuted, revisited and revised", Real-Time Systems 35 (2007).
"""

from can_dbc.database import Message

_FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def frame_time_s(message: Message, bitrate: int, data_bitrate: int | None) -> float:
    """Longest time that one frame of a message takes, interframe space included, in s.

    Bit rates are in bit/s; that of a CAN FD frame's payload may differ, None for no switch.
    """
    if message.is_fd:
        return _fd_frame_time_s(message, bitrate, data_bitrate or bitrate)
    payload = 8 * message.length_bytes
    # Start bit to CRC is subject to stuffing: one bit after every four in the worst case.
    stuffed, fixed = (54, 67) if message.is_extended else (34, 47)
    return (payload + fixed + (stuffed + payload - 1) // 4) / bitrate


def _fd_frame_time_s(message: Message, bitrate: int, data_bitrate: int) -> float:
    length = next(size for size in _FD_LENGTHS if size >= message.length_bytes)
    arbitration = 36 if message.is_extended else 17
    ending = 13  # delimiters, acknowledgement, end of frame, interframe space
    stuffable = 5 + 8 * length
    crc, fixed_stuff = (17, 6) if length <= 16 else (21, 7)
    payload = stuffable + stuffable // 4 + 4 + crc + fixed_stuff
    return (arbitration + arbitration // 4 + ending) / bitrate + payload / data_bitrate
