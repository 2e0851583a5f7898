"""A DBC file as frozen messages and signals.

The DBC is read by cantools. What this package needs beyond the usual content stands in message
attributes: `E2EProfile` (`P01` or `P02`, empty for none), `E2EDataIds` (hex: 16 bytes for P02,
2 bytes for P01), `E2ECrcSignal`, `E2ECounterSignal` and `E2EMaxDeltaCounter`. The cycle time is
the usual `GenMsgCycleTime`, in ms.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import cast

from cantools.database.can import Message as CantoolsMessage
from cantools.database.can import Signal as CantoolsSignal

from can_dbc.dbc_statements import parse_statements
from can_dbc.errors import DatabaseError, expected_name
from can_dbc.protection import AliveCounter, Identity, Profile, Protection

__all__ = ["DEFAULT_DATABASE", "Database", "DatabaseError", "Message", "Signal", "load_database"]

DEFAULT_DATABASE = Path(__file__).with_name("rig.dbc")
"""The bus of the bench and the bridge."""

SIZE_MAX_BYTES = 16 * 1024 * 1024
"""Largest DBC file that is read."""

_STANDARD_ID_MAX = 0x7FF
_EXTENDED_ID_MAX = 0x1FFF_FFFF
_COUNTER_LARGEST = 2**32
_COUNTER_SMALLEST = 3  # of fewer values each step is as good as another
_MAX_DELTA_DEFAULT = 7  # half of the counter's round: less is a loss, more went backwards


@dataclass(frozen=True, slots=True)
class Signal:
    """One signal of a message, as the DBC has it.

    Attributes:
        start: Start bit in the DBC's numbering (of the lowest bit if little-endian, of the
            highest if big-endian).
        is_big_endian: Byte order (Motorola if true, Intel if not).
        scale: Physical value of one raw step, in `unit`.
        offset: Physical value of raw 0, in `unit`.
        minimum: Smallest physical value, in `unit`, or None if the DBC gives no range.
        maximum: Largest physical value, in `unit`, or None if the DBC gives no range.
        unit: Unit as written in the DBC, empty if none.
        comment: Comment in the DBC, empty if none.
        multiplexer: Name of the signal that selects this one, or None if it is always there.
        multiplexer_ids: Raw values of the multiplexer under which the signal is there.
    """

    name: str
    start: int
    length_bits: int
    is_big_endian: bool
    is_signed: bool
    is_float: bool
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None
    unit: str
    comment: str
    choices: Mapping[int, str]
    is_multiplexer: bool
    multiplexer: str | None
    multiplexer_ids: frozenset[int]


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a database.

    Attributes:
        is_j1939: Whether it is known by its J1939 parameter group.
        cycle_time_ns: Time between two frames, in ns, or None if the DBC gives none.
        sender: Node that sends it, or None if the DBC gives none.
    """

    path: Path
    name: str
    arbitration_id: int
    is_extended: bool
    is_fd: bool
    is_j1939: bool
    length_bytes: int
    cycle_time_ns: int | None
    sender: str | None
    signals: Mapping[str, Signal]
    protection: Protection | None

    @property
    def key(self) -> tuple[int, bool]:
        """What identifies its frames: arbitration id, and whether that is extended."""
        return self.arbitration_id, self.is_extended

    def signal(self, name: str) -> Signal:
        """Return the signal of a name.

        Raises:
            DatabaseError: There is none; the message lists names that come near.
        """
        try:
            return self.signals[name]
        except KeyError:
            hint = expected_name(name, self.signals)
            raise DatabaseError(
                f"{self.path}: message {self.name}: no signal {name!r}, {hint}"
            ) from None


@dataclass(frozen=True, slots=True)
class Database:
    """The messages of one DBC file.

    Attributes:
        sha256: Of the file's bytes, in hex.
        messages: Messages that can be used, by name.
        passed_over: Why another message, or another part of the file, cannot be used.
    """

    path: Path
    sha256: str
    messages: Mapping[str, Message]
    passed_over: Mapping[str, str]

    def message(self, name: str) -> Message:
        """Return the message of a name.

        Raises:
            DatabaseError: There is none, or it cannot be used; the error says why, or lists names
                that come near.
        """
        try:
            return self.messages[name]
        except KeyError:
            why = self.passed_over.get(f"message {name}")
            if why is not None:
                raise DatabaseError(f"{self.path}: message {name}: {why}") from None
            hint = expected_name(name, self.messages)
            raise DatabaseError(f"{self.path}: no message {name!r}, {hint}") from None


def load_database(path: Path) -> Database:
    """Read a DBC file of at most 16 MiB, in UTF-8 or Windows-1252.

    Units are kept as written; a codec converts them. A message that cannot be used, such as one
    whose signals overlap or do not fit, that shares its name, id or data id with another, or has
    a protection that cannot work, is passed over: the file's others can be used.

    Raises:
        DatabaseError: The file cannot be read, is no DBC, or has no message that can be used.
    """
    content = _read(path)
    parsed, passed_over = parse_statements(path, _decode(path, content))
    messages: list[Message] = []
    for message in parsed:
        try:
            messages.append(_message(path, message))
        except DatabaseError as error:
            passed_over[f"message {message.name}"] = _reason(path, message.name, error)
    passed_over |= _duplicates(messages)
    usable = [item for item in messages if f"message {item.name}" not in passed_over]
    if not usable and passed_over:
        what, why = next(iter(passed_over.items()))
        raise DatabaseError(f"{path}: {what}: {why}")
    return Database(
        path=path,
        sha256=hashlib.sha256(content).hexdigest(),
        messages=MappingProxyType({m.name: m for m in _with_foreign_identities(usable)}),
        passed_over=MappingProxyType(passed_over),
    )


def _reason(path: Path, message: str, error: DatabaseError) -> str:
    """An error's text without file and message."""
    return str(error).removeprefix(f"{path}: message {message}: ")


def _read(path: Path) -> bytes:
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except (OSError, ValueError):  # a name that no file can have
        is_file = is_folder = False
    if not is_file:
        kind = "is a folder" if is_folder else "no such file"
        raise DatabaseError(f"{ascii(str(path))[1:-1]}: {kind}, expected a DBC file")
    try:
        with path.open("rb") as file:
            content = file.read(SIZE_MAX_BYTES + 1)
    except OSError as error:
        raise DatabaseError(f"{path}: cannot be read: {error.strerror}") from None
    if len(content) > SIZE_MAX_BYTES:
        raise DatabaseError(f"{path}: larger than {SIZE_MAX_BYTES} bytes, expected a DBC file")
    return content


def _decode(path: Path, content: bytes) -> str:
    # The format names no encoding. Editors write Windows-1252, newer tools UTF-8; text of the
    # first with a sign beyond ASCII is hardly ever valid in the second.
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise DatabaseError(f"{path}: not text, expected a DBC file")


def _message(path: Path, message: CantoolsMessage) -> Message:
    where = f"{path}: message {message.name}"
    is_extended = bool(message.is_extended_frame)
    id_max = _EXTENDED_ID_MAX if is_extended else _STANDARD_ID_MAX
    if not 0 <= message.frame_id <= id_max:
        raise DatabaseError(f"{where}: id {message.frame_id:#x}, expected at most {id_max:#x}")
    signals = {signal.name: _signal(where, signal) for signal in message.signals}
    if len(signals) != len(message.signals):
        raise DatabaseError(f"{where}: a signal name is given twice")
    for signal in signals.values():
        _check_fit(where, signal, message.length)
    cycle_time_ns = _cycle_time_ns(where, message)
    return Message(
        path=path,
        name=message.name,
        arbitration_id=message.frame_id,
        is_extended=is_extended,
        is_fd=bool(message.is_fd) or message.length > 8,
        is_j1939=is_extended and message.protocol == "j1939",
        length_bytes=message.length,
        cycle_time_ns=cycle_time_ns,
        sender=message.senders[0] if message.senders else None,
        signals=MappingProxyType(signals),
        protection=_protection(where, message, signals, cycle_time_ns),
    )


def _signal(where: str, signal: CantoolsSignal) -> Signal:
    return Signal(
        name=signal.name,
        start=signal.start,
        length_bits=signal.length,
        is_big_endian=signal.byte_order == "big_endian",
        is_signed=bool(signal.is_signed),
        is_float=bool(signal.is_float),
        scale=_number(where, signal.name, "scale", signal.scale),
        offset=_number(where, signal.name, "offset", signal.offset),
        minimum=_bound(where, signal.name, "minimum", signal.minimum),
        maximum=_bound(where, signal.name, "maximum", signal.maximum),
        unit=signal.unit or "",
        comment=signal.comment or "",
        choices=MappingProxyType(
            {int(raw): str(name) for raw, name in (signal.choices or {}).items()}
        ),
        is_multiplexer=bool(signal.is_multiplexer),
        multiplexer=signal.multiplexer_signal,
        multiplexer_ids=frozenset(signal.multiplexer_ids or ()),
    )


def _number(where: str, signal: str, what: str, value: float) -> float:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise DatabaseError(f"{where}: signal {signal}: {what} {number}, expected a finite number")
    return number


def _bound(where: str, signal: str, what: str, value: float | None) -> float | None:
    return None if value is None else _number(where, signal, what, value)


def _check_fit(where: str, signal: Signal, length_bytes: int) -> None:
    # cantools checks only signals that it reaches through their multiplexers.
    byte, bit = divmod(signal.start, 8)
    first = 8 * byte + 7 - bit if signal.is_big_endian else signal.start
    if first + signal.length_bits > 8 * length_bytes:
        raise DatabaseError(f"{where}: signal {signal.name}: does not fit in {length_bytes} bytes")


def _attribute(message: CantoolsMessage, name: str) -> str | int | float | None:
    specifics = message.dbc
    if specifics is None:
        return None
    attribute = specifics.attributes.get(name)
    if attribute is not None:
        return cast("str | int | float | None", attribute.value)
    definition = specifics.attribute_definitions.get(name)
    return None if definition is None else cast("str | None", definition.default_value)


def _cycle_time_ns(where: str, message: CantoolsMessage) -> int | None:
    value = _attribute(message, "GenMsgCycleTime")
    if value is None or value == "":
        return None
    try:
        cycle_ms = float(value)
        cycle_ns = round(cycle_ms * 1e6)
    except (ValueError, OverflowError):
        cycle_ns = -1
    if cycle_ns < 0:
        raise DatabaseError(f"{where}: GenMsgCycleTime {value!r}, expected ms, 0 or more")
    return cycle_ns or None


def _protection(
    where: str, message: CantoolsMessage, signals: Mapping[str, Signal], cycle_time_ns: int | None
) -> Protection | None:
    value = str(_attribute(message, "E2EProfile") or "").strip()
    if value.casefold() in {"", "none"}:
        return None
    names = {profile.value: profile for profile in Profile}
    if value not in names:
        supported = ", ".join(names)
        raise DatabaseError(f"{where}: E2EProfile {value!r}, supported are {supported}")
    profile = names[value]
    crc_signal = str(_attribute(message, "E2ECrcSignal") or "CRC")
    counter_signal = str(_attribute(message, "E2ECounterSignal") or "COUNTER")
    _check_position(where, signals, "E2ECrcSignal", crc_signal, (0, 8))
    _check_position(where, signals, "E2ECounterSignal", counter_signal, (8, 4))
    return Protection(
        identity=Identity(profile, _data_ids(where, message, profile)),
        length_bytes=message.length,
        crc_signal=crc_signal,
        counter_signal=counter_signal,
        counter=AliveCounter(
            profile.counter_modulus, _max_delta(where, message, profile), cycle_time_ns
        ),
        foreign=(),
    )


def alive_counter(message: Message, name: str) -> AliveCounter:
    """The alive counter that a signal of a message without protection is.

    Raises:
        DatabaseError: The signal is missing, or is no counter: a plain integer from 0 on.
    """
    signal = message.signal(name)
    last = 2**signal.length_bits - 1
    is_plain = (signal.scale, signal.offset, signal.minimum or 0.0) == (1.0, 0.0, 0.0)
    if signal.is_signed or signal.is_float or not is_plain or not 1 < last < _COUNTER_LARGEST:
        raise DatabaseError(
            f"{message.path}: message {message.name}: signal {name}: expected an unsigned integer "
            "of 2 to 32 bits from 0 on, with a scale of 1"
        )
    if signal.maximum:
        last = min(last, int(signal.maximum))
    if last < _COUNTER_SMALLEST:
        raise DatabaseError(
            f"{message.path}: message {message.name}: signal {name}: maximum {signal.maximum:g}, "
            f"expected at least {_COUNTER_SMALLEST}"
        )
    modulus = last + 1
    most = max(1, min(_MAX_DELTA_DEFAULT, modulus // 2 - 1))
    return AliveCounter(modulus, most, message.cycle_time_ns)


def _check_position(
    where: str, signals: Mapping[str, Signal], attribute: str, name: str, bits: tuple[int, int]
) -> None:
    signal = signals.get(name)
    if signal is None:
        raise DatabaseError(f"{where}: {attribute} {name!r}: the message has no such signal")
    first, length = bits
    start = first + length - 1 if signal.is_big_endian else first
    if (signal.start, signal.length_bits) != (start, length) or signal.multiplexer is not None:
        raise DatabaseError(
            f"{where}: {attribute} {name!r}: expected {length} bits from bit {first} on, "
            "as profiles P01 and P02 have it"
        )


def _data_ids(where: str, message: CantoolsMessage, profile: Profile) -> bytes:
    text = str(_attribute(message, "E2EDataIds") or "").strip()
    expected = f"expected {profile.data_id_bytes} bytes in hex for {profile.value}"
    try:
        data_ids = bytes.fromhex(text)
    except ValueError:
        raise DatabaseError(f"{where}: E2EDataIds {text[:80]!r}, {expected}") from None
    if len(data_ids) != profile.data_id_bytes:
        raise DatabaseError(f"{where}: E2EDataIds {text[:80]!r}, {expected}")
    return data_ids


def _max_delta(where: str, message: CantoolsMessage, profile: Profile) -> int:
    value = _attribute(message, "E2EMaxDeltaCounter")
    if value is None or value == "":
        return _MAX_DELTA_DEFAULT
    limit = profile.counter_modulus - 1
    if not isinstance(value, int) or not 1 <= value <= limit:
        raise DatabaseError(f"{where}: E2EMaxDeltaCounter {value!r}, expected 1 to {limit}")
    return value


def _duplicates(messages: Sequence[Message]) -> dict[str, str]:
    """Messages that share a name, an id or a data id with another, each with the reason."""
    found: dict[str, str] = {}
    names: dict[str, Message] = {}
    ids: dict[tuple[int, bool], Message] = {}
    identities: dict[Identity, Message] = {}
    for message in messages:
        if names.setdefault(message.name, message) is not message:
            found[f"message {message.name}"] = "is given twice"
        other = ids.setdefault(message.key, message)
        if other is not message:
            why = f"{other.name} and {message.name} have the same id {message.arbitration_id:#x}"
            found |= {f"message {item.name}": why for item in (other, message)}
        if message.protection is None:
            continue
        other = identities.setdefault(message.protection.identity, message)
        if other is not message:
            why = f"{other.name} and {message.name} have the same E2EDataIds"
            found |= {f"message {item.name}": why for item in (other, message)}
    return found


def _with_foreign_identities(messages: list[Message]) -> list[Message]:
    """Give every protection the identities of the others, to recognise their frames."""
    identities = [m.protection.identity for m in messages if m.protection is not None]
    return [
        message
        if message.protection is None
        else replace(
            message,
            protection=replace(
                message.protection,
                foreign=tuple(i for i in identities if i != message.protection.identity),
            ),
        )
        for message in messages
    ]
