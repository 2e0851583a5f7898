"""What every frame of a whole log is: the verdicts of `protection.check`, for all frames at once."""

import numpy as np
from numpy.typing import NDArray

from can_dbc.protection import (
    INITIAL,
    Protection,
    SequenceState,
    Verdict,
    check,
    check_crc_log,
)


def check_log(
    payloads: NDArray[np.uint8],
    lengths: NDArray[np.int64],
    t_ns: NDArray[np.int64],
    protection: Protection,
) -> NDArray[np.object_]:
    """Judge every frame of one message.

    Frames that follow each other in sequence and in time, nearly all of a good log, are judged at
    once; whatever is odd goes through `check`, frame by frame.

    Args:
        payloads: Payloads in the order of reception, shape (n, at least the message's length).
        lengths: Length of each payload in bytes, shape (n,).
        t_ns: Time of reception, in ns, shape (n,).
        protection: Protection of the message.

    Returns:
        The `Verdict` of each frame, shape (n,), the same as `check` gives frame by frame.
    """
    count = len(t_ns)
    verdicts = np.full(count, Verdict.OK, dtype=np.object_)
    follows = _follows(payloads, lengths, t_ns, protection)
    # Where a frame does not follow the one before it, and the end.
    breaks = [*np.flatnonzero(~follows).tolist(), count]
    state: SequenceState = INITIAL
    index = 0
    next_break = 0
    while index < count:
        payload = payloads[index, : int(lengths[index])].tobytes()
        state, verdict = check(state, payload, int(t_ns[index]), protection)
        verdicts[index] = verdict
        index += 1
        if verdict.accepted:
            while breaks[next_break] < index:
                next_break += 1
            if breaks[next_break] > index:
                index = breaks[next_break]
                last = index - 1
                state = SequenceState(int(payloads[last, 1]) & 0x0F, int(t_ns[last]))
    return verdicts


def _follows(
    payloads: NDArray[np.uint8],
    lengths: NDArray[np.int64],
    t_ns: NDArray[np.int64],
    protection: Protection,
) -> NDArray[np.bool_]:
    """Whether each frame is the next in sequence and in time of the one before it."""
    length, modulus = protection.length_bytes, protection.counter_modulus
    if payloads.shape[1] < length:
        return np.zeros(len(t_ns), dtype=np.bool_)
    right = lengths == length
    right &= check_crc_log(payloads[:, :length], protection)
    counters = (payloads[:, 1] & 0x0F).astype(np.int64)
    right &= counters < modulus
    follows = np.zeros(len(t_ns), dtype=np.bool_)
    follows[1:] = right[1:] & right[:-1]
    follows[1:] &= (counters[1:] - counters[:-1]) % modulus == 1
    follows[1:] &= t_ns[1:] - t_ns[:-1] < protection.silence_ns
    return follows
