"""Frames of a whole log that follow the one before: the frequent case, for all at once."""

import numpy as np
from numpy.typing import NDArray

from can_dbc.protection import Protection, check_crc_log


def in_sequence(
    payloads: NDArray[np.uint8],
    lengths: NDArray[np.int64],
    t_ns: NDArray[np.int64],
    protection: Protection,
) -> NDArray[np.bool_]:
    """Whether each frame is intact, and next in sequence and in time of an intact one.

    `protection.check` calls such a frame OK wherever it accepted the one before. Other
    frames need `check`.

    Args:
        payloads: Payloads of one message in the order of reception, shape (n, its length or more).
        lengths: Length of each payload in bytes, shape (n,).
        t_ns: Time of reception, in ns, shape (n,).
        protection: Protection of the message.

    Returns:
        Shape (n,); False for the first frame.
    """
    follows = np.zeros(len(t_ns), dtype=np.bool_)
    length, modulus = protection.length_bytes, protection.counter_modulus
    if len(t_ns) == 0 or payloads.shape[1] < length:
        return follows
    intact = lengths == length
    intact &= check_crc_log(payloads[:, :length], protection)
    counters = (payloads[:, 1] & 0x0F).astype(np.int64)
    follows[1:] = intact[1:] & intact[:-1]
    follows[1:] &= np.diff(counters) % modulus == 1
    follows[1:] &= np.diff(t_ns) < protection.silence_ns
    return follows
