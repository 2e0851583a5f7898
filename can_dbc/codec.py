"""Encoders and decoders, compiled from a DBC's messages.

Everything that does not depend on the payload (bit positions, scaling, unit conversion,
multiplexing) is worked out once. Values are SI, in the unit of the `Dimension` asked for.
"""

import math
import struct
from collections.abc import Callable, Sequence
from math import floor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from can_dbc.database import Message, Signal
from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension, si_conversion

Decoder = Callable[[bytes | bytearray], tuple[float, ...] | None]
"""Payload to SI values, or None if the payload has another length or lacks one of the signals."""

Encoder = Callable[[Sequence[float]], tuple[bytes, bool]]
"""SI values to a payload, and whether one of them was out of range and held at its limit."""

_FD_LENGTHS = frozenset({*range(9), 12, 16, 20, 24, 32, 48, 64})
_RAW_BITS_MAX = 64
_FLOAT_FORMATS = {32: "<f", 64: "<d"}
_J1939_BITS, _J1939_NO_VALUE = (8, 16, 24, 32), 0xFB
"""Parameters of whole bytes, and their highest byte from which on they hold no value but an error
or "not available" (SAE J1939-71, 5.1.3)."""


class _Field(NamedTuple):
    """Position and meaning of a signal's raw value; scale, offset and range are in SI."""

    name: str
    is_big_endian: bool  # whether `shift` counts in the payload read as a big-endian integer
    shift: int
    mask: int
    sign: int  # the sign bit, 0 if unsigned
    float_format: str  # empty for integers
    scale: float
    offset: float
    minimum: float | None
    maximum: float | None


class _Condition(NamedTuple):
    """A multiplexer and the raw values under which a signal is in the frame."""

    selector: _Field
    raw_values: frozenset[int]


def compile_decoder(
    message: Message, signal_names: Sequence[str], dimensions: Sequence[Dimension]
) -> Decoder:
    """Build the decoder of some signals of a message.

    Returns:
        A function from a payload to a tuple of SI values in the order of `signal_names`. It
        returns None if the payload is not `message.length_bytes` long, or if a multiplexed
        signal is not in this frame. It never raises for a payload.

    Raises:
        DatabaseError: A signal is unknown, its unit is missing, unknown or of another dimension,
            or its layout cannot be decoded.
    """
    fields = _fields(message, signal_names, dimensions)
    conditions = _all_conditions(message, signal_names)
    for condition in conditions:
        if not condition.raw_values:
            raise DatabaseError(
                f"{message.path}: message {message.name}: signals {list(signal_names)} are never "
                f"in one frame (multiplexer {condition.selector.name})"
            )
    length = message.length_bytes
    byte_orders = {field.is_big_endian for field in fields}
    plain = not conditions and not any(field.float_format for field in fields)
    count = len(fields)
    if plain and len(byte_orders) == 1 and count <= 2:
        return _integer_decoder(fields[0], fields[-1], count, length)
    return _general_decoder(fields, conditions, length)


def compile_encoder(
    message: Message, signal_names: Sequence[str], dimensions: Sequence[Dimension]
) -> Encoder:
    """Build the encoder of some signals of a message.

    A value beyond the DBC's range, or beyond what its bits can hold, is sent as the nearest
    value that is allowed. NaN is sent as the allowed value nearest to zero. Both are reported.
    Multiplexers of the signals are set as the signals need it; all other bits are zero.

    Returns:
        A function from SI values in the order of `signal_names` to the payload and whether a
        value was held at its limit. It raises `ValueError` for another number of values.

    Raises:
        DatabaseError: As for `compile_decoder`; besides, signals that are never in one frame,
            a multiplexer that is itself among the signals, or a range that holds no raw value.
    """
    fields = _fields(message, signal_names, dimensions)
    base = _base_payload(message, signal_names)
    slots = tuple(_slot(message, field) for field in fields)
    return _join_encoder(slots, base, message.length_bytes)


def si_range(message: Message, signal_name: str, dimension: Dimension) -> tuple[float, float]:
    """Smallest and largest SI value that a signal carries, by the DBC's range and its bits.

    Raises:
        DatabaseError: As for `compile_decoder`.
    """
    (field,) = _fields(message, [signal_name], [dimension])
    if field.float_format:
        low = -math.inf if field.minimum is None else field.minimum
        return low, math.inf if field.maximum is None else field.maximum
    ends = [raw * field.scale + field.offset for raw in _raw_limits(message, field)]
    return min(ends), max(ends)


def si_step(message: Message, signal_name: str, dimension: Dimension) -> float:
    """Step of an integer signal in SI; of a float, whose resolution is unknown, zero.

    Raises:
        DatabaseError: As for `compile_decoder`.
    """
    (field,) = _fields(message, [signal_name], [dimension])
    return 0.0 if field.float_format else abs(field.scale)


def si_round(message: Message, signal_name: str, dimension: Dimension) -> float:
    """Span in SI after which a signal that counts on begins again; infinite for a float.

    Raises:
        DatabaseError: As for `compile_decoder`.
    """
    low, high = si_range(message, signal_name, dimension)
    return high - low + si_step(message, signal_name, dimension)


def decode_log(
    message: Message,
    signal_names: Sequence[str],
    dimensions: Sequence[Dimension],
    data: NDArray[np.uint8],
) -> dict[str, NDArray[np.float64]]:
    """Decode all frames of a log at once, payloads of shape (n, `message.length_bytes`).

    Returns:
        SI values by signal name, each of shape (n,), the same to the last bit as the decoder's;
        NaN where a multiplexed signal is not in the frame.

    Raises:
        DatabaseError: As for `compile_decoder`.
        ValueError: `data` has another shape.
    """
    fields = _fields(message, signal_names, dimensions)
    if data.ndim != 2 or data.shape[1] != message.length_bytes:
        raise ValueError(
            f"payloads of {message.name}: shape {data.shape}, expected (n, {message.length_bytes})"
        )
    decoded: dict[str, NDArray[np.float64]] = {}
    for field in fields:
        values = _values_of_log(field, data)
        for condition in _conditions(message, message.signal(field.name)):
            allowed = np.array(sorted(condition.raw_values), dtype=np.uint64)
            present = np.isin(_raw_of_log(condition.selector, data), allowed)
            values = np.where(present, values, np.nan)
        decoded[field.name] = values
    return decoded


def _fields(
    message: Message, signal_names: Sequence[str], dimensions: Sequence[Dimension]
) -> tuple[_Field, ...]:
    if message.length_bytes not in _FD_LENGTHS:
        raise DatabaseError(
            f"{message.path}: message {message.name}: {message.length_bytes} bytes, "
            "expected 0 to 8, 12, 16, 20, 24, 32, 48 or 64"
        )
    if not signal_names or len(set(signal_names)) != len(signal_names):
        raise DatabaseError(
            f"{message.path}: message {message.name}: signals {list(signal_names)}, "
            "expected at least one and none twice"
        )
    return tuple(
        _field(message, message.signal(name), dimension)
        for name, dimension in zip(signal_names, dimensions, strict=True)
    )


def _field(message: Message, signal: Signal, dimension: Dimension) -> _Field:
    where = f"{message.path}: message {message.name}: signal {signal.name}"
    if signal.length_bits > _RAW_BITS_MAX:
        raise DatabaseError(f"{where}: {signal.length_bits} bits, expected at most 64")
    if signal.is_float and signal.length_bits not in _FLOAT_FORMATS:
        raise DatabaseError(f"{where}: float of {signal.length_bits} bits, expected 32 or 64")
    try:
        unit = si_conversion(signal.unit, dimension)
    except DatabaseError as error:
        raise DatabaseError(f"{where}: {error}") from None
    raw = _raw_field(message, signal)
    field = raw._replace(
        float_format=_FLOAT_FORMATS[signal.length_bits] if signal.is_float else "",
        sign=1 << signal.length_bits - 1 if signal.is_signed and not signal.is_float else 0,
        scale=signal.scale * unit.factor,
        offset=signal.offset * unit.factor + unit.offset,
        minimum=None if signal.minimum is None else signal.minimum * unit.factor + unit.offset,
        maximum=None if signal.maximum is None else signal.maximum * unit.factor + unit.offset,
    )
    largest = abs(field.scale) * 2.0**64 + abs(field.offset)
    if field.scale == 0.0 or not math.isfinite(largest):
        raise DatabaseError(
            f"{where}: scale {signal.scale}, offset {signal.offset}, expected a scale other than 0"
            " and numbers of ordinary size"
        )
    return field


def _raw_field(message: Message, signal: Signal) -> _Field:
    """Position of a signal's bits, with a scaling of identity."""
    if signal.is_big_endian:
        # The DBC numbers bits upwards in a byte and bytes as they are sent; the start is the
        # highest bit, from where the value runs downwards.
        byte, bit = divmod(signal.start, 8)
        highest = 8 * (message.length_bytes - 1 - byte) + bit
        shift = highest - signal.length_bits + 1
    else:
        shift = signal.start
    return _Field(
        name=signal.name,
        is_big_endian=signal.is_big_endian,
        shift=shift,
        mask=(1 << signal.length_bits) - 1,
        sign=0,
        float_format="",
        scale=1.0,
        offset=0.0,
        minimum=None,
        maximum=None,
    )


def _conditions(message: Message, signal: Signal) -> tuple[_Condition, ...]:
    """Multiplexer values under which a signal is in a frame, along nested multiplexers."""
    conditions: list[_Condition] = []
    seen = {signal.name}
    while signal.multiplexer is not None:
        selector = message.signal(signal.multiplexer)
        if selector.name in seen or selector.length_bits > _RAW_BITS_MAX:
            raise DatabaseError(
                f"{message.path}: message {message.name}: signal {signal.name}: "
                f"multiplexer {selector.name} cannot select it"
            )
        seen.add(selector.name)
        conditions.append(_Condition(_raw_field(message, selector), signal.multiplexer_ids))
        signal = selector
    return tuple(conditions)


def _all_conditions(message: Message, signal_names: Sequence[str]) -> tuple[_Condition, ...]:
    conditions: dict[str, _Condition] = {}
    for name in signal_names:
        for condition in _conditions(message, message.signal(name)):
            selector = condition.selector
            known = conditions.get(selector.name, condition)
            conditions[selector.name] = known._replace(
                raw_values=known.raw_values & condition.raw_values
            )
    return tuple(conditions.values())


def _integer_decoder(first: _Field, last: _Field, count: int, length: int) -> Decoder:
    """Decoder of one or two integers that are in every frame: the case of the loop."""
    order = "big" if first.is_big_endian else "little"
    from_bytes = int.from_bytes
    _, _, shift_a, mask_a, sign_a, _, scale_a, offset_a, _, _ = first
    _, _, shift_b, mask_b, sign_b, _, scale_b, offset_b, _, _ = last

    def decode_one(data: bytes | bytearray) -> tuple[float, ...] | None:
        if len(data) != length:
            return None
        raw = from_bytes(data, order)
        return ((((raw >> shift_a) & mask_a ^ sign_a) - sign_a) * scale_a + offset_a,)

    def decode_two(data: bytes | bytearray) -> tuple[float, ...] | None:
        if len(data) != length:
            return None
        raw = from_bytes(data, order)
        return (
            (((raw >> shift_a) & mask_a ^ sign_a) - sign_a) * scale_a + offset_a,
            (((raw >> shift_b) & mask_b ^ sign_b) - sign_b) * scale_b + offset_b,
        )

    return decode_one if count == 1 else decode_two


def _general_decoder(
    fields: tuple[_Field, ...], conditions: tuple[_Condition, ...], length: int
) -> Decoder:
    def decode(data: bytes | bytearray) -> tuple[float, ...] | None:
        if len(data) != length:
            return None
        little = int.from_bytes(data, "little")
        big = int.from_bytes(data, "big")
        for selector, raw_values in conditions:
            raw = (big if selector.is_big_endian else little) >> selector.shift & selector.mask
            if raw not in raw_values:
                return None
        return tuple(
            [
                _value(field, (big if field.is_big_endian else little) >> field.shift & field.mask)
                for field in fields
            ]
        )

    return decode


def _value(field: _Field, raw: int) -> float:
    if field.float_format:
        size = struct.calcsize(field.float_format)
        number: float = struct.unpack(field.float_format, raw.to_bytes(size, "little"))[0]
        return number * field.scale + field.offset
    return ((raw ^ field.sign) - field.sign) * field.scale + field.offset


_ROUNDING, _MOST_ROUNDED = 1.5 * 2.0**52, 2.0**51
"""Adding the first and taking it away rounds a number below the second in size as `round` does
(half to even), in little more than half the time: between 2**52 and 2**53 floats are whole
numbers."""

_Holder = Callable[[float], tuple[int, bool]]
"""Number of steps -> the nearest raw value that is allowed, unsigned, and whether it is another."""


class _Slot(NamedTuple):
    """How a signal is put into a payload."""

    scale: float
    offset: float
    below: float  # a number of steps strictly between this and `above` is sent rounded
    above: float
    mask: int
    shift: int  # bits below the value in the joined payload
    hold: _Holder  # what is done with any other number of steps


def _slot(message: Message, field: _Field) -> _Slot:
    # Joined, the bytes of big-endian signals stand above those of little-endian ones.
    shift = field.shift + (8 * message.length_bytes if field.is_big_endian else 0)
    scale, offset, mask = field.scale, field.offset, field.mask
    if field.float_format:
        return _Slot(scale, offset, math.inf, -math.inf, mask, shift, _float_holder(field))
    low, high = _raw_limits(message, field)
    # Where `_ROUNDING` does not round all of them are held, which is exact.
    fits = low > -_MOST_ROUNDED and high < _MOST_ROUNDED
    below, above = (low - 0.5, high + 0.5) if fits else (math.inf, -math.inf)
    return _Slot(scale, offset, below, above, mask, shift, _integer_holder(field, low, high))


def _integer_holder(field: _Field, low: int, high: int) -> _Holder:
    mask = field.mask
    unknown = min(max(round(-field.offset / field.scale), low), high)

    def hold(steps: float) -> tuple[int, bool]:
        if math.isfinite(steps):
            nearest = round(steps)
            held = min(max(nearest, low), high)
            return held & mask, held != nearest
        return (unknown if math.isnan(steps) else low if steps < low else high) & mask, True

    return hold


def _raw_limits(message: Message, field: _Field) -> tuple[int, int]:
    """Smallest and largest raw value that the bits hold and the DBC's range allows."""
    lowest, highest = -field.sign, field.mask - field.sign
    bits = field.mask.bit_length()
    if message.is_j1939 and not field.sign and bits in _J1939_BITS:
        highest = (_J1939_NO_VALUE << bits - 8) - 1
    low, high = _range_in_steps(field, float(lowest), float(highest))
    # A limit that is a whole number of steps must survive its rounding in floating point.
    low_raw = max(lowest, math.ceil(low - 1e-9 * max(1.0, abs(low))))
    high_raw = min(highest, math.floor(high + 1e-9 * max(1.0, abs(high))))
    if low_raw > high_raw:
        raise DatabaseError(
            f"{message.path}: message {message.name}: signal {field.name}: "
            "no raw value lies within the signal's range"
        )
    return low_raw, high_raw


def _range_in_steps(field: _Field, lowest: float, highest: float) -> tuple[float, float]:
    """The DBC's range in raw steps, with the given limits where it leaves one open."""
    minimum, maximum = field.minimum, field.maximum
    bounds = (
        None if minimum is None else (minimum - field.offset) / field.scale,
        None if maximum is None else (maximum - field.offset) / field.scale,
    )
    low, high = bounds if field.scale > 0.0 else bounds[::-1]
    return lowest if low is None else low, highest if high is None else high


def _float_holder(field: _Field) -> _Holder:
    form = field.float_format
    largest = 3.4028234663852886e38 if form == "<f" else 1.7976931348623157e308
    low, high = _range_in_steps(field, -largest, largest)
    low, high = max(low, -largest), min(high, largest)
    unknown = min(max(-field.offset / field.scale, low), high)

    def hold(steps: float) -> tuple[int, bool]:
        held = unknown if math.isnan(steps) else min(max(steps, low), high)
        return int.from_bytes(struct.pack(form, held), "little"), held != steps

    return hold


def _join_encoder(slots: tuple[_Slot, ...], base: int, length: int) -> Encoder:
    count, bits = len(slots), 8 * length
    has_big_endian = any(slot.shift >= bits for slot in slots)
    # Plain tuples are taken apart three times as fast as named ones.
    numbered = [
        (i, x.scale, x.offset, x.below, x.above, x.mask, x.shift, x.hold)
        for i, x in enumerate(slots)
    ]

    def encode(values: Sequence[float]) -> tuple[bytes, bool]:
        if len(values) != count:
            raise ValueError(f"{len(values)} values, expected {count}")
        joined, saturated = base, False
        for index, scale, offset, below, above, mask, shift, hold in numbered:
            steps = (values[index] - offset) / scale
            if below < steps < above:
                joined |= (floor(steps + _ROUNDING - _ROUNDING) & mask) << shift
            else:
                raw, held = hold(steps)
                joined |= raw << shift
                saturated = saturated or held
        if has_big_endian:
            mirrored, joined = divmod(joined, 1 << bits)
            joined |= int.from_bytes(mirrored.to_bytes(length, "big"), "little")
        return joined.to_bytes(length, "little"), saturated

    return encode


def _base_payload(message: Message, signal_names: Sequence[str]) -> int:
    """Payload, as a little-endian integer, in which only the needed multiplexers are set."""
    where = f"{message.path}: message {message.name}"
    joined = 0
    for selector, raw_values in _all_conditions(message, signal_names):
        allowed = [raw for raw in raw_values if 0 <= raw <= selector.mask]
        if not allowed:
            raise DatabaseError(
                f"{where}: signals {list(signal_names)} are never in one frame "
                f"(multiplexer {selector.name})"
            )
        if selector.name in signal_names:
            raise DatabaseError(
                f"{where}: multiplexer {selector.name} is set by the signals that it selects, "
                "expected only these"
            )
        placed = min(allowed) << selector.shift
        order = "big" if selector.is_big_endian else "little"
        joined |= int.from_bytes(placed.to_bytes(message.length_bytes, order), "little")
    return joined


def _values_of_log(field: _Field, data: NDArray[np.uint8]) -> NDArray[np.float64]:
    raw = _raw_of_log(field, data)
    if field.float_format:
        narrow = field.float_format == "<f"
        numbers = raw.astype(np.uint32).view(np.float32) if narrow else raw.view(np.float64)
        # A signalling NaN in a payload is data, not a fault of this program.
        with np.errstate(invalid="ignore", over="ignore"):
            return numbers.astype(np.float64) * field.scale + field.offset
    if field.sign:
        sign = np.uint64(field.sign)
        values = ((raw ^ sign) - sign).view(np.int64).astype(np.float64)
    else:
        values = raw.astype(np.float64)
    values *= field.scale
    values += field.offset
    return values


def _raw_of_log(field: _Field, data: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Raw values of one field, unsigned, shape (n,)."""
    padded = _at_least_eight_bytes(data, at_front=field.is_big_endian)
    # Bytes count from the lowest one, whichever end is sent first.
    ordered = padded[:, ::-1] if field.is_big_endian else padded
    first = min(field.shift // 8, padded.shape[1] - 8)
    shift = field.shift - 8 * first
    window = np.ascontiguousarray(ordered[:, first : first + 8])
    raw = window.view("<u8")[:, 0] >> np.uint64(shift)
    if shift + field.mask.bit_length() > 64:
        raw |= ordered[:, first + 8].astype(np.uint64) << np.uint64(64 - shift)
    return raw & np.uint64(field.mask)


def _at_least_eight_bytes(data: NDArray[np.uint8], *, at_front: bool) -> NDArray[np.uint8]:
    """The payloads with zeros above their highest byte, so that eight can be read at once."""
    missing = 8 - data.shape[1]
    if missing <= 0:
        return data
    return np.pad(data, ((0, 0), (missing, 0) if at_front else (0, missing)))
