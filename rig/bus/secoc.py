"""Authentication of frames after AUTOSAR SecOC, on CAN FD.

Behind the payload stand the low bits of a freshness value and the high bits of a CMAC (AES-128)
over data id, payload and whole freshness value. The freshness value is the sender's Unix time in
units of 0.1 ms, and more than the last one in any case: it needs no memory across restarts, and a
repeated frame is refused. So is one that is too old by the receiver's own clock, however slowly it
became so: whoever holds frames back by more and more makes the sender's clock look slow. A refused
frame reaches no decoder.

References: AUTOSAR, "Specification of Secure Onboard Communication" (profile 1, 24Bit-CMAC-8Bit-FV,
is the default); RFC 4493, "The AES-CMAC Algorithm".
"""

import hmac
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, cast

from msgspec.structs import replace
from pydantic import BaseModel, ConfigDict, Field

from can_dbc.errors import InputError, missing_package
from can_dbc.frame import Frame
from can_dbc.yaml_file import Finite, read_text

FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
"""Lengths that a CAN FD frame can have, in bytes."""

_FRESHNESS_UNIT_NS = 100_000
_FRESHNESS_BYTES = 8
_KEY_BYTES = 16
_MOST_CANDIDATES = 64
"""Freshness values that are tried about one clock: each costs a CMAC, and is a chance to forge."""

_LARGEST_KEY_FILE = 1000


class AuthenticationError(InputError):
    """A key cannot be used, or the package that computes the CMAC is not installed."""


@dataclass(frozen=True)
class Authentication:
    """How frames are authenticated.

    No log and no error contains the key, 16 bytes. The tolerance is how far the clocks of two
    senders may be apart at first, and `max_age_ns` how far a frame's may ever be from one's own.
    """

    key: bytes = field(repr=False)
    freshness_bytes: int
    mac_bytes: int
    tolerance_ns: int
    max_age_ns: int = 1_000_000_000

    @property
    def trailer_bytes(self) -> int:
        """Bytes added to a frame."""
        return self.freshness_bytes + self.mac_bytes


class AuthenticationSettings(BaseModel):
    """Authentication of all frames after AUTOSAR SecOC, on CAN FD.

    Attributes:
        key_file: File with 32 hexadecimal digits, in the folder of the configuration.
        freshness_bits: Bits of the freshness value in a frame.
        mac_bits: Bits of the CMAC in a frame.
        clock_tolerance_s: Largest difference between the clocks of bench and bridge at the start. A
            bridge that has just been started refuses an old frame that is sent again if its age is
            larger than this.
        max_age_s: During the run, largest difference between the time of a frame and the bridge's
            clock, in either direction. It is larger than `clock_tolerance_s` because the clocks may
            drift apart; a smaller value counts as `clock_tolerance_s`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    key_file: Annotated[str, Field(min_length=1, max_length=255)]
    freshness_bits: Literal[8, 16, 24, 32] = 8
    mac_bits: Literal[24, 32, 40, 48, 56, 64, 96, 128] = 24
    clock_tolerance_s: Annotated[Finite, Field(ge=0.001, le=10.0)] = 0.1
    max_age_s: Annotated[Finite, Field(ge=0.001, le=60.0)] = 1.0

    def load(self, source: Path) -> Authentication:
        """Authentication with the key of a file in the folder of the configuration `source`.

        Raises:
            FileError: The file cannot be read.
            AuthenticationError: It contains no key, or a frame could have too many freshness
                values.
        """
        tolerance_ns = round(self.clock_tolerance_s * 1e9)
        most_ns = (_MOST_CANDIDATES << self.freshness_bits) * _FRESHNESS_UNIT_NS // 2
        if tolerance_ns > most_ns:
            raise AuthenticationError(
                f"{source}: authentication.clock_tolerance_s: {self.clock_tolerance_s:g}: expected "
                f"at most {most_ns * 1e-9:.2g} with {self.freshness_bits} bits of freshness, or "
                "more freshness_bits"
            )
        return Authentication(
            read_key(source.parent / self.key_file),
            self.freshness_bits // 8,
            self.mac_bits // 8,
            tolerance_ns,
            max(round(self.max_age_s * 1e9), tolerance_ns),
        )

    @property
    def trailer_bytes(self) -> int:
        """How much longer a frame becomes."""
        return (self.freshness_bits + self.mac_bits) // 8


def read_key(path: Path) -> bytes:
    """Key from a file of 32 hexadecimal digits.

    Raises:
        FileError: The file cannot be read.
        AuthenticationError: It contains no such key. The message does not show its content.
    """
    text = read_text(path, _LARGEST_KEY_FILE)
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != _KEY_BYTES:
        raise AuthenticationError(f"{path}: expected a key of {2 * _KEY_BYTES} hexadecimal digits")
    return key


def cmac(key: bytes) -> Callable[[bytes], bytes]:
    """AES-CMAC under a key: message -> 16 bytes.

    Raises:
        AuthenticationError: The package that computes it is not installed.
    """
    try:
        module = importlib.import_module("cryptography.hazmat.primitives.cmac")
        ciphers = importlib.import_module("cryptography.hazmat.primitives.ciphers")
    except ImportError as error:
        raise AuthenticationError(
            "authentication: " + missing_package("cryptography", "pip install -e '.[secoc]'")
        ) from error
    keyed = module.CMAC(ciphers.algorithms.AES(key))

    def compute(message: bytes) -> bytes:
        state = keyed.copy()
        state.update(message)
        return cast("bytes", state.finalize())

    return compute


class _Received(NamedTuple):
    """Freshness value of the last frame that was accepted under an id, and its time."""

    freshness: int
    t_ns: int


class Authenticator:
    """Secures the frames that one side of a bus sends, and accepts authentic and new ones alone.

    Times of frames are relative to `epoch_ns`, the Unix time of the run's start.

    Raises:
        AuthenticationError: The package that computes the CMAC is not installed.
    """

    def __init__(self, how: Authentication, epoch_ns: int) -> None:
        self.unauthentic = 0
        """Frames refused because no fresh value fits their CMAC."""
        self.replayed = 0
        """Frames refused because their freshness value is not newer than the last one, or too far
        from the own clock."""
        self._how = how
        self._epoch_ns = epoch_ns
        self._cmac = cmac(how.key)
        self._sent: dict[int, int] = {}
        self._received: dict[int, _Received] = {}

    def secure(self, frame: Frame) -> Frame:
        """The frame with freshness value and CMAC behind its payload."""
        identifier = frame.arbitration_id
        freshness = max(self._time(frame.t_ns), self._sent.get(identifier, -1) + 1)
        self._sent[identifier] = freshness
        trailer = self._low(freshness) + self._mac(frame, frame.data, freshness)
        return replace(frame, data=frame.data + trailer, is_fd=True, bitrate_switch=True)

    def authenticate(self, frames: Sequence[Frame]) -> list[Frame]:
        """The frames that are authentic and new, without their trailer; error frames pass."""
        accepted: list[Frame] = []
        for frame in frames:
            if frame.is_error:
                accepted.append(frame)
                continue
            payload = self._payload_if_authentic(frame)
            if payload is not None:
                accepted.append(replace(frame, data=payload))
        return accepted

    def _payload_if_authentic(self, frame: Frame) -> bytes | None:
        """Payload of a frame without its trailer; None if it is refused."""
        how = self._how
        end = len(frame.data) - how.trailer_bytes
        payload, trailer = frame.data[: max(end, 0)], frame.data[max(end, 0) :]
        low, received = trailer[: how.freshness_bytes], trailer[how.freshness_bytes :]
        last = self._received.get(frame.arbitration_id)
        for freshness in self._possible(last, frame.t_ns, low) if end >= 0 else ():
            if hmac.compare_digest(self._mac(frame, payload, freshness), received):
                if self._is_old(freshness, last, frame.t_ns):
                    self.replayed += 1
                    return None
                self._received[frame.arbitration_id] = _Received(freshness, frame.t_ns)
                return payload
        self.unauthentic += 1
        return None

    def _is_old(self, freshness: int, last: _Received | None, t_ns: int) -> bool:
        """Whether an authentic frame is no news, or by the own clock none of its time."""
        distance_ns = abs(freshness - self._time(t_ns)) * _FRESHNESS_UNIT_NS
        is_repeated = last is not None and freshness <= last.freshness
        return is_repeated or distance_ns > self._how.max_age_ns

    def _possible(self, last: _Received | None, t_ns: int, low: bytes) -> Iterator[int]:
        """Whole freshness values that a frame may have, the likeliest first.

        They lie about the sender's clock, which runs on from the last frame, and about the own one:
        alone before the first frame, and for a sender whose clock was set.
        """
        own = self._time(t_ns)
        if last is not None:
            sender = last.freshness + (t_ns - last.t_ns) // _FRESHNESS_UNIT_NS
            yield from self._about(sender, low)
            tolerance = self._how.tolerance_ns // _FRESHNESS_UNIT_NS
            yield from (
                freshness
                for freshness in self._about(own, low)
                if abs(freshness - sender) > tolerance
            )
        else:
            yield from self._about(own, low)

    def _about(self, expected: int, low: bytes) -> Iterator[int]:
        """Freshness values with these low bits about a time, the nearest first."""
        modulus = 1 << 8 * self._how.freshness_bytes
        tolerance = self._how.tolerance_ns // _FRESHNESS_UNIT_NS
        ahead = (int.from_bytes(low, "big") - expected + modulus // 2) % modulus - modulus // 2
        nearest = expected + ahead
        for distance in range(0, tolerance + modulus, modulus):
            for freshness in {nearest + distance, nearest - distance}:
                if freshness >= 0 and abs(freshness - expected) <= tolerance:
                    yield freshness

    def _time(self, t_ns: int) -> int:
        return max(self._epoch_ns + t_ns, 0) // _FRESHNESS_UNIT_NS

    def _low(self, freshness: int) -> bytes:
        count = self._how.freshness_bytes
        return freshness.to_bytes(_FRESHNESS_BYTES, "big")[_FRESHNESS_BYTES - count :]

    def _mac(self, frame: Frame, payload: bytes, freshness: int) -> bytes:
        data_id = frame.arbitration_id.to_bytes(2, "big")
        whole = data_id + payload + freshness.to_bytes(_FRESHNESS_BYTES, "big")
        return self._cmac(whole)[: self._how.mac_bytes]
