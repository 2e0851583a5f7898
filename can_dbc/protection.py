"""End-to-end protection of frames: alive counter, CRC and data id, after AUTOSAR E2E.

The CRC of one frame is computed by the `e2e` package. What a sequence of frames means (lost,
repeated, out of order, another message's frame under this id) is decided here, one frame at a
time, by a state that is passed in and returned.

Reference: AUTOSAR, "Specification of SW-C End-to-End Communication Protection Library",
profiles 1 (variant 1A) and 2.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from e2e.p01 import e2e_p01_check, e2e_p01_protect
from e2e.p02 import e2e_p02_check, e2e_p02_protect
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray


class Profile(Enum):
    """A layout of counter and CRC; the value is that of the DBC attribute `E2EProfile`.

    Both have the CRC in byte 0 and the counter in the low nibble of byte 1. P01 (variant 1A) has
    one 16-bit data id, polynomial 0x1D and counts 0 to 14; P02 has one 8-bit data id for each
    counter value, polynomial 0x2F and counts 0 to 15.
    """

    P01 = "P01"
    P02 = "P02"

    @property
    def counter_modulus(self) -> int:
        """Number of counter values."""
        return 15 if self is Profile.P01 else 16

    @property
    def data_id_bytes(self) -> int:
        """Length of the data id, or of the list of data ids, in bytes."""
        return 2 if self is Profile.P01 else 16


class Identity(Struct, frozen=True, gc=False):
    """What the CRC of a message covers besides its payload.

    Attributes:
        data_ids: P02: 16 ids, the one of counter value i at index i. P01: the id, high byte first.
    """

    profile: Profile
    data_ids: bytes


NEVER_NS = 2**63 - 1
"""A time that no run reaches, in ns."""


@dataclass(frozen=True, slots=True)
class AliveCounter:
    """An alive counter: one more with every frame of its message.

    Attributes:
        modulus: Number of its values, from 0 on.
        max_delta: Largest step that is read as lost frames.
        cycle_time_ns: Cycle time of the message; None where the DBC gives none.
    """

    modulus: int
    max_delta: int
    cycle_time_ns: int | None

    @property
    def silence_ns(self) -> int:
        """Silence after which the counter may have gone round, in ns."""
        return self.modulus * self.cycle_time_ns if self.cycle_time_ns else NEVER_NS


@dataclass(frozen=True, slots=True)
class Protection:
    """How the frames of one message are protected.

    Attributes:
        length_bytes: Payload length; a frame of any other length is refused.
        foreign: Identities of the database's other messages, for recognising their frames here.
    """

    identity: Identity
    length_bytes: int
    crc_signal: str
    counter_signal: str
    counter: AliveCounter
    foreign: tuple[Identity, ...]


class FrameStatus(Enum):
    """E2E status of a frame; only the first three may be used, the others are refused whole."""

    OK = "ok"
    FIRST = "first"
    LOST = "lost"
    WRONG_CRC = "wrong_crc"
    WRONG_LENGTH = "wrong_length"
    REPEATED = "repeated"
    OUT_OF_SEQUENCE = "out_of_sequence"
    MASQUERADE = "masquerade"

    @property
    def is_accepted(self) -> bool:
        """Whether the frame's values may be used."""
        return self in _ACCEPTED


_ACCEPTED = frozenset({FrameStatus.OK, FrameStatus.FIRST, FrameStatus.LOST})

# Looking up a member of an enum costs as much as the CRC of a frame.
_OK, _WRONG_LENGTH = FrameStatus.OK, FrameStatus.WRONG_LENGTH

RESYNC_FRAMES = 2
"""Frames in a row, after an out-of-sequence one, that make a restarted sequence believable."""


class SequenceState(Struct, frozen=True, gc=False):
    """State of the sequence check of one message.

    Attributes:
        counter: Counter of the last accepted frame, -1 before the first.
        t_ns: Time of the last frame with a right CRC, in ns.
        lost: Frames missing before the frame just accepted with verdict LOST, else 0.
        candidate: Counter of the last out-of-sequence frame, -1 if there is none pending.
        run: Frames that followed the candidate in sequence.
    """

    counter: int = -1
    t_ns: int = 0
    lost: int = 0
    candidate: int = -1
    run: int = 0


INITIAL = SequenceState()


def read_counter(data: bytes | bytearray) -> int:
    """Read the alive counter of a protected frame of at least two bytes."""
    return data[1] & 0x0F


def check_crc(data: bytes | bytearray, protection: Protection) -> bool:
    """Check CRC and data id of one frame; a frame of wrong length fails."""
    crc = _crc(protection.identity)
    return len(data) == protection.length_bytes and crc.check(data, crc.identity)


Checker = Callable[[SequenceState, bytes | bytearray, int], tuple[SequenceState, FrameStatus]]
"""State of the check (`INITIAL` at first), payload, time of reception in ns -> the state after the
frame, and the frame's status."""

CounterChecker = Callable[[SequenceState, int, int], tuple[SequenceState, FrameStatus]]
"""State of the check, the counter of a frame, time of reception in ns -> the state after the frame,
and the frame's status."""

Protector = Callable[[bytes | bytearray, int], bytes]
"""Payload, and number of the frame (any integer of at least 0; it is sent modulo the profile's
number of counter values) -> the payload to send. Raises `ValueError` for another length."""


def compile_protector(protection: Protection) -> Protector:
    """Build the function that writes counter and CRC into the frames of a message."""
    length, modulus = protection.length_bytes, protection.counter.modulus
    _, put_crc, identity = _crc(protection.identity)

    def protect(data: bytes | bytearray, number: int) -> bytes:
        if len(data) != length:
            raise ValueError(f"payload: {len(data)} bytes, expected {length}")
        frame = bytearray(data)
        # The package counts one further itself.
        frame[1] = frame[1] & 0xF0 | (number - 1) % modulus
        put_crc(frame, identity)
        return bytes(frame)

    return protect


def compile_checker(protection: Protection) -> Checker:
    """Build the check of the frames of a message, one by one.

    A counter that went up by 1 to `max_delta_counter` (more where more cycle times have passed
    since the last frame) is accepted, with the number of lost frames in the new state. After a
    silence as long as the counter's full round the counter alone does not determine how many were
    lost; then the time does. A counter that went backwards is refused. A restarted sender is
    accepted when `RESYNC_FRAMES` further frames came in sequence.

    A corrupted frame may by chance carry the CRC of another message; it is then called
    MASQUERADE and not WRONG_CRC. Both are refused.
    """
    length, alive = protection.length_bytes, protection.counter
    # The last one is for counter -1, before the first frame, which nothing follows.
    following = (*range(1, alive.modulus), 0, None)
    silence_ns, (crc_fits, _, identity) = alive.silence_ns, _crc(protection.identity)
    foreign = [_crc(other) for other in protection.foreign]

    def check(
        state: SequenceState, data: bytes | bytearray, t_ns: int
    ) -> tuple[SequenceState, FrameStatus]:
        if len(data) != length:
            return state, _WRONG_LENGTH
        if not crc_fits(data, identity):
            return state, _wrong_crc(data, foreign)
        counter = data[1] & 0x0F
        # The frequent case first: next in sequence and in time.
        if counter == following[state.counter] and t_ns - state.t_ns < silence_ns:
            return SequenceState(counter, t_ns), _OK
        return _check_sequence(state, counter, t_ns, alive)

    return check


def compile_counter_checker(alive: AliveCounter) -> CounterChecker:
    """Build the check of an alive counter that no CRC protects, as `compile_checker` has it."""

    def check(state: SequenceState, counter: int, t_ns: int) -> tuple[SequenceState, FrameStatus]:
        if not 0 <= counter < alive.modulus:
            return state, FrameStatus.OUT_OF_SEQUENCE
        return _check_sequence(state, counter, t_ns, alive)

    return check


def check_crc_log(data: NDArray[np.uint8], protection: Protection) -> NDArray[np.bool_]:
    """Check CRC and data id of all frames of a log at once, payloads of shape (n, length).

    Returns:
        Whether each frame passes, shape (n,); the same as `check_crc` frame by frame.
    """
    if data.ndim != 2 or data.shape[1] != protection.length_bytes:
        return np.zeros(len(data), dtype=np.bool_)
    ids = np.frombuffer(protection.identity.data_ids, dtype=np.uint8)
    if protection.identity.profile is Profile.P02:
        crc = _crc_over_columns(np.full(len(data), 0xFF, dtype=np.uint8), data[:, 1:], _TABLE_2F)
        crc = _TABLE_2F[crc ^ ids[data[:, 1] & 0x0F]] ^ np.uint8(0xFF)
    else:
        head = np.broadcast_to(ids[::-1], (len(data), 2))
        crc = _crc_over_columns(np.zeros(len(data), dtype=np.uint8), head, _TABLE_1D)
        crc = _crc_over_columns(crc, data[:, 1:], _TABLE_1D)
    # Profile 1 has no counter of 15, and refuses one whatever its CRC.
    return (crc == data[:, 0]) & (data[:, 1] & 0x0F < protection.counter.modulus)


class _Crc(NamedTuple):
    """CRC functions of a profile, and a message's identity in their form."""

    check: Callable[[bytes | bytearray, Any], bool]
    put: Callable[[bytearray, Any], object]
    identity: Any


def _crc(identity: Identity) -> _Crc:
    if identity.profile is Profile.P02:
        return _Crc(e2e_p02_check, e2e_p02_protect, identity.data_ids)
    return _Crc(_p01_check, e2e_p01_protect, int.from_bytes(identity.data_ids, "big"))


def _p01_check(data: bytes | bytearray, data_id: int) -> bool:
    # The package checks this profile only in a mutable buffer.
    return e2e_p01_check(bytearray(data), data_id)


def _wrong_crc(data: bytes | bytearray, foreign: Sequence[_Crc]) -> FrameStatus:
    if any(crc.check(data, crc.identity) for crc in foreign):
        return FrameStatus.MASQUERADE
    return FrameStatus.WRONG_CRC


def _check_sequence(
    state: SequenceState, counter: int, t_ns: int, alive: AliveCounter
) -> tuple[SequenceState, FrameStatus]:
    modulus = alive.modulus
    if state.counter < 0:
        return SequenceState(counter, t_ns), FrameStatus.FIRST
    delta = (counter - state.counter) % modulus
    cycles = _cycles_since(state.t_ns, t_ns, alive)
    silent = cycles >= modulus
    if delta == 0:
        # After a silence of a round it may be a new one, or a gateway's last one again and again.
        t_ns = state.t_ns if silent else t_ns
        return replace(state, t_ns=t_ns, lost=0), FrameStatus.REPEATED
    if not silent and delta > max(alive.max_delta, cycles + 1):
        return _resynchronise(state, counter, t_ns, modulus)
    lost = _lost_in_silence(delta, cycles, modulus) if silent else delta - 1
    return SequenceState(counter, t_ns, lost), FrameStatus.LOST if lost else _OK


def _resynchronise(
    state: SequenceState, counter: int, t_ns: int, modulus: int
) -> tuple[SequenceState, FrameStatus]:
    follows = state.candidate >= 0 and (counter - state.candidate) % modulus == 1
    run = state.run + 1 if follows else 0
    if run >= RESYNC_FRAMES:
        return SequenceState(counter, t_ns), FrameStatus.FIRST
    refused = SequenceState(state.counter, t_ns, candidate=counter, run=run)
    return refused, FrameStatus.OUT_OF_SEQUENCE


def _cycles_since(last_ns: int, t_ns: int, alive: AliveCounter) -> int:
    return (t_ns - last_ns) // alive.cycle_time_ns if alive.cycle_time_ns else 0


def _lost_in_silence(delta: int, cycles: int, modulus: int) -> int:
    """Frames missing: the number that fits the counter and comes nearest to the time."""
    rounds = max(0, (cycles - delta + modulus // 2) // modulus)
    sent = delta + rounds * modulus
    return max(sent - 1, 0)


def _crc_over_columns(
    crc: NDArray[np.uint8], data: NDArray[np.uint8], table: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    for column in range(data.shape[1]):
        crc = table[crc ^ data[:, column]]
    return crc


def _crc_table(polynomial: int) -> NDArray[np.uint8]:
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 0x80, table << 1 ^ polynomial, table << 1) & 0xFF
    return table.astype(np.uint8)


_TABLE_2F = _crc_table(0x2F)
_TABLE_1D = _crc_table(0x1D)
