"""Codecs against cantools: one frame, a whole log, and what does not fit."""

import math
from collections.abc import Callable
from pathlib import Path

import cantools.database
import numpy as np
import pytest
from cantools.database.can import Database as CantoolsDatabase
from cantools.database.can import Message as CantoolsMessage
from cantools.database.can import Signal as CantoolsSignal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from can_dbc.codec import compile_decoder, compile_encoder, decode_log, si_range
from can_dbc.database import Database, Message, load_database
from can_dbc.errors import DatabaseError
from can_dbc.units import Dimension

LENGTHS = [1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64]
SCALES = [1, 2, 0.5, 0.1, 2e-6, -0.25, 1e3]
OFFSETS = [0, 0, -40, 12.5]


def start_bit(network_bit: int, byte_order: str) -> int:
    """Start bit of a signal whose first bit is the given one, counted as the order counts."""
    if byte_order == "little_endian":
        return network_bit
    return 8 * (network_bit // 8) + 7 - network_bit % 8


@st.composite
def random_signals(draw: st.DrawFn, name: str, first_byte: int, last_byte: int, **mux: object):
    """Signals of one byte order that share the bytes from first to last without overlap."""
    byte_order = draw(st.sampled_from(["little_endian", "big_endian"]))
    signals: list[CantoolsSignal] = []
    bit, end = 8 * first_byte, 8 * last_byte
    while bit < end and len(signals) < 4:
        bit += draw(st.integers(0, min(5, end - bit - 1)))
        room = end - bit
        is_float = room >= 32 and draw(st.integers(0, 4)) == 0
        if is_float:
            length = 64 if room >= 64 and draw(st.booleans()) else 32
        else:
            length = draw(st.integers(1, min(room, 64)))
        conversion = BaseConversion.factory(
            scale=draw(st.sampled_from(SCALES)),
            offset=draw(st.sampled_from(OFFSETS)),
            is_float=is_float,
        )
        signals.append(
            CantoolsSignal(
                name=f"{name}_{len(signals)}",
                start=start_bit(bit, byte_order),
                length=length,
                byte_order=byte_order,
                is_signed=is_float or draw(st.booleans()),
                conversion=conversion,
                **mux,
            )
        )
        bit += length
    return signals


@st.composite
def random_messages(draw: st.DrawFn) -> CantoolsMessage:
    length = draw(st.sampled_from(LENGTHS))
    is_extended = draw(st.booleans())
    signals: list[CantoolsSignal] = []
    first = 0
    if length >= 3 and draw(st.booleans()):
        selector = CantoolsSignal("SELECTOR", 0, 8, is_multiplexer=True)
        signals.append(selector)
        first = draw(st.integers(2, length))
        for raw in (0, 3, 255):
            mux = {"multiplexer_ids": [raw], "multiplexer_signal": "SELECTOR"}
            signals += draw(random_signals(f"PAGE{raw}", 1, first, **mux))
    part = 0
    while first < length:
        last = draw(st.integers(first + 1, length))
        signals += draw(random_signals(f"PART{part}", first, last))
        first, part = last, part + 1
    return CantoolsMessage(
        frame_id=draw(st.integers(0, 0x1FFFFFFF if is_extended else 0x7FF)),
        name="RANDOM",
        length=length,
        signals=signals,
        is_extended_frame=is_extended,
        is_fd=length > 8,
        senders=[],
    )


def reload(message: CantoolsMessage, folder: Path) -> tuple[Message, CantoolsMessage]:
    """Write the message as a DBC; return it as this package and as cantools read it."""
    path = folder / "random.dbc"
    text = CantoolsDatabase([message]).as_dbc_string()
    path.write_text(text, encoding="cp1252")
    return (
        load_database(path).message("RANDOM"),
        cantools.database.load_string(text, "dbc").get_message_by_name("RANDOM"),
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("codec")


@settings(max_examples=60, deadline=None)
@given(message=random_messages(), data=st.data())
def test_random_messages_decode_as_cantools_does(
    folder: Path, message: CantoolsMessage, data: st.DataObject
) -> None:
    ours, theirs = reload(message, folder)
    seed = data.draw(st.integers(0, 2**32 - 1))
    payloads = np.random.default_rng(seed).integers(0, 256, (12, ours.length_bytes), np.uint8)
    if "SELECTOR" in ours.signals:
        payloads[:9, 0] = [0, 3, 255] * 3
    names = list(ours.signals)
    log = decode_log(ours, names, [Dimension.NUMBER] * len(names), payloads) if names else {}
    for name in names:
        decode = compile_decoder(ours, [name], [Dimension.NUMBER])
        for row, payload in enumerate(payloads):
            try:
                expected = theirs.decode(bytes(payload), decode_choices=False)
            except cantools.database.DecodeError:
                continue  # a multiplexer value that selects nothing
            decoded = decode(bytes(payload))
            if name not in expected:
                assert decoded is None
                assert math.isnan(log[name][row])
                continue
            assert decoded is not None
            assert decoded[0] == pytest.approx(expected[name], rel=1e-12, abs=1e-12, nan_ok=True)
            assert np.float64(decoded[0]).tobytes() == log[name][row].tobytes() or math.isnan(
                decoded[0]
            )


@settings(max_examples=60, deadline=None)
@given(message=random_messages(), data=st.data())
def test_random_messages_encode_so_that_cantools_reads_them(
    folder: Path, message: CantoolsMessage, data: st.DataObject
) -> None:
    ours, theirs = reload(message, folder)
    page = data.draw(st.sampled_from(["PAGE0", "PAGE3", "PAGE255"]))
    chosen = [n for n in ours.signals if n.startswith((page, "PART"))]
    if not chosen:
        return
    dimensions = [Dimension.NUMBER] * len(chosen)
    values: list[float] = []
    for name in chosen:
        signal = ours.signal(name)
        if signal.is_float:
            raw = data.draw(st.floats(-(2.0**99), 2.0**99, width=32))
        else:
            low = -(1 << signal.length_bits - 1) if signal.is_signed else 0
            raw = data.draw(st.integers(low, low + (1 << signal.length_bits) - 1))
        values.append(raw * signal.scale + signal.offset)
    payload, saturated = compile_encoder(ours, chosen, dimensions)(values)
    assert len(payload) == ours.length_bytes
    widest = max(ours.signal(name).length_bits for name in chosen)
    assert not saturated or widest > 50
    if "SELECTOR" in ours.signals and not any(name.startswith(page) for name in chosen):
        payload[0] = 0
    expected = theirs.decode(bytes(payload), decode_choices=False, allow_truncated=False)
    for name, value in zip(chosen, values, strict=True):
        signal = ours.signal(name)
        step = 1e-6 * abs(value - signal.offset) if signal.is_float else abs(signal.scale) / 2
        assert abs(expected[name] - value) <= step * (1 + 1e-6) + 1e-12 * abs(value)


@settings(deadline=None)
@given(
    value=st.floats(allow_nan=True, allow_infinity=True),
    name=st.sampled_from(["HEIGHT", "APPLIED_FORCE"]),
)
def test_no_value_wraps(rig: Database, value: float, name: str) -> None:
    message = rig.message("BENCH_MEASUREMENT")
    signal = message.signal(name)
    dimension = Dimension.LENGTH if name == "HEIGHT" else Dimension.FORCE
    payload, saturated = compile_encoder(message, [name], [dimension])([value])
    (decoded,) = compile_decoder(message, [name], [dimension])(payload)
    half = 0.5 * signal.scale * (1 + 1e-9)
    if math.isnan(value):
        assert saturated
        assert decoded == 0.0
    else:
        assert abs(decoded - min(max(value, signal.minimum), signal.maximum)) <= half
        assert saturated == (not signal.minimum - half <= value <= signal.maximum + half)


SATURATION = """BO_ 1 M: 24 BENCH
 SG_ UNBOUNDED : 0|12@1- (0.5,10) [0|0] "N" RIG
 SG_ NARROW : 12|12@1+ (0.1,0) [0.3|0.7] "N" RIG
 SG_ FALLING : 31|16@0- (-2,0) [-100|50] "N" RIG
 SG_ POSITIVE : 40|16@1+ (1,0) [5|100] "N" RIG
 SG_ WIDE : 64|64@1+ (1,0) [0|0] "N" RIG
 SG_ SINGLE : 128|32@1- (1,0) [0|0] "N" RIG
 SG_ LIMITED : 160|32@1- (1,0) [-5|5] "N" RIG
"""
FLOATS = "SIG_VALTYPE_ 1 SINGLE : 1;\nSIG_VALTYPE_ 1 LIMITED : 1;"


@pytest.mark.parametrize(
    ("signal", "value", "sent", "saturated"),
    [
        ("UNBOUNDED", 1e9, 10 + 2047 * 0.5, True),
        ("UNBOUNDED", -1e9, 10 - 2048 * 0.5, True),
        ("UNBOUNDED", 10 + 2047 * 0.5, 10 + 2047 * 0.5, False),
        ("UNBOUNDED", math.nan, 0.0, True),
        ("NARROW", 0.7, 0.7, False),
        ("NARROW", 0.3, 0.3, False),
        ("NARROW", 0.76, 0.7, True),
        ("NARROW", -5.0, 0.3, True),
        ("FALLING", 50.0, 50.0, False),
        ("FALLING", 53.0, 50.0, True),
        ("FALLING", -math.inf, -100.0, True),
        ("POSITIVE", math.nan, 5.0, True),
        ("WIDE", 2.0**64, 2.0**64, True),
        ("WIDE", 2.0**63, 2.0**63, False),
        ("WIDE", -1.0, 0.0, True),
        ("SINGLE", 1e300, 3.4028234663852886e38, True),
        ("SINGLE", -math.inf, -3.4028234663852886e38, True),
        ("SINGLE", 1.5, 1.5, False),
        ("LIMITED", 7.0, 5.0, True),
        ("LIMITED", math.nan, 0.0, True),
    ],
)
def test_out_of_range_is_held_at_the_limit(
    write_dbc: Callable[..., Path], signal: str, value: float, sent: float, *, saturated: bool
) -> None:
    message = load_database(write_dbc(SATURATION, FLOATS)).message("M")
    payload, held = compile_encoder(message, [signal], [Dimension.FORCE])([value])
    assert compile_decoder(message, [signal], [Dimension.FORCE])(payload) == pytest.approx((sent,))
    assert held is saturated
    others = [name for name in message.signals if name not in {signal, "NARROW", "POSITIVE"}]
    for other in others:
        (untouched,) = compile_decoder(message, [other], [Dimension.FORCE])(payload)
        assert untouched == message.signal(other).offset


NESTED = """BO_ 2566834709 M: 8 BENCH
 SG_ OUTER M : 0|4@1+ (1,0) [0|15] "" RIG
 SG_ INNER m1M : 15|4@0+ (1,0) [0|15] "" RIG
 SG_ DEEP m2 : 23|16@0- (0.5,0) [0|0] "mm" RIG
 SG_ SHALLOW m3 : 16|16@1- (1,0) [0|0] "kN" RIG
 SG_ ALWAYS : 40|16@1- (0.1,0) [0|0] "degF" RIG
"""
NESTED_RANGES = """SG_MUL_VAL_ 2566834709 INNER OUTER 1-1, 4-6;
SG_MUL_VAL_ 2566834709 DEEP INNER 2-2, 9-9;
SG_MUL_VAL_ 2566834709 SHALLOW OUTER 3-3;
"""


def test_nested_multiplexers(write_dbc: Callable[..., Path]) -> None:
    path = write_dbc(NESTED, NESTED_RANGES)
    message = load_database(path).message("M")
    assert message.is_extended
    assert message.arbitration_id == 2566834709 & 0x1FFFFFFF
    theirs = cantools.database.load_file(path).get_message_by_name("M")
    decode = compile_decoder(message, ["DEEP", "ALWAYS"], [Dimension.LENGTH, Dimension.TEMPERATURE])
    present = 0
    for outer in range(16):
        for inner in range(16):
            payload = bytes([outer, inner << 4, 0x12, 0x34, 0, 0xD4, 0x00, 0])
            decoded = decode(payload)
            if outer in {1, 4, 5, 6} and inner in {2, 9}:
                expected = theirs.decode(payload)
                assert decoded == pytest.approx((expected["DEEP"] * 1e-3, (21.2 - 32) * 5 / 9))
                present += 1
            else:
                assert decoded is None
    assert present == 8


def test_encoder_sets_the_multiplexers_of_its_signals(write_dbc: Callable[..., Path]) -> None:
    path = write_dbc(NESTED, NESTED_RANGES)
    message = load_database(path).message("M")
    payload, saturated = compile_encoder(message, ["DEEP"], [Dimension.LENGTH])([-0.25])
    assert not saturated
    decoded = cantools.database.load_file(path).decode_message("M", bytes(payload))
    assert decoded["DEEP"] == pytest.approx(-250.0)
    with pytest.raises(DatabaseError, match="never in one frame"):
        compile_encoder(message, ["DEEP", "SHALLOW"], [Dimension.LENGTH, Dimension.FORCE])
    with pytest.raises(DatabaseError, match="multiplexer OUTER is set by"):
        compile_encoder(message, ["OUTER", "SHALLOW"], [Dimension.NUMBER, Dimension.FORCE])


@pytest.mark.parametrize("length", [0, 1, 7, 9, 64])
def test_wrong_length_decodes_to_nothing(rig: Database, length: int) -> None:
    message = rig.message("BENCH_MEASUREMENT")
    names = ["HEIGHT", "APPLIED_FORCE", "COUNTER"]
    dimensions = [Dimension.LENGTH, Dimension.FORCE, Dimension.NUMBER]
    for count in (1, 2, 3):
        decode = compile_decoder(message, names[:count], dimensions[:count])
        assert decode(bytes(length)) is None
    with pytest.raises(ValueError, match="shape"):
        decode_log(message, names, dimensions, np.zeros((5, length), np.uint8))


def test_log_of_the_bench_is_identical_to_the_frames(rig: Database) -> None:
    message = rig.message("BENCH_MEASUREMENT")
    names = ["HEIGHT", "APPLIED_FORCE"]
    dimensions = [Dimension.LENGTH, Dimension.FORCE]
    payloads = np.random.default_rng(1).integers(0, 256, (5000, 8), np.uint8)
    log = decode_log(message, names, dimensions, payloads)
    decode = compile_decoder(message, names, dimensions)
    frames = np.array([decode(bytes(payload)) for payload in payloads])
    assert frames[:, 0].tobytes() == log["HEIGHT"].tobytes()
    assert frames[:, 1].tobytes() == log["APPLIED_FORCE"].tobytes()
    assert decode_log(message, names, dimensions, payloads[:0])["HEIGHT"].shape == (0,)


USERS = """BO_ 7 M: 8 BENCH
 SG_ TRAVEL : 0|16@1- (0.01,0) [0|0] "mm" RIG
 SG_ LOAD : 16|16@1- (0.5,0) [0|0] "lbf" RIG
 SG_ BARE : 32|8@1- (1,0) [0|0] "" RIG
 SG_ FLAT : 40|8@1- (0,3) [0|0] "N" RIG
 SG_ EMPTY : 48|8@1+ (1,0) [300|400] "N" RIG
BO_ 8 ODD: 10 BENCH
 SG_ FORCE : 0|16@1- (1,0) [0|0] "N" RIG
"""


@pytest.mark.parametrize(
    ("message", "signal", "dimension", "words"),
    [
        ("M", "LOAD", Dimension.LENGTH, ["signal LOAD", "'lbf'", "length"]),
        ("M", "BARE", Dimension.FORCE, ["signal BARE", "give the unit in the DBC"]),
        ("M", "FLAT", Dimension.FORCE, ["signal FLAT", "scale 0"]),
        ("M", "EMPTY", Dimension.FORCE, ["signal EMPTY", "no raw value"]),
        ("M", "TRAVLE", Dimension.LENGTH, ["no signal 'TRAVLE'", "did you mean TRAVEL"]),
        ("ODD", "FORCE", Dimension.FORCE, ["message ODD", "10 bytes"]),
    ],
)
def test_what_cannot_work_is_named(
    write_dbc: Callable[..., Path],
    message: str,
    signal: str,
    dimension: Dimension,
    words: list[str],
) -> None:
    path = write_dbc(USERS)
    entry = load_database(path).message(message)
    with pytest.raises(DatabaseError) as caught:
        compile_encoder(entry, [signal], [dimension])
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_signals_given_twice_or_not_at_all_are_refused(rig: Database) -> None:
    message = rig.message("BENCH_MEASUREMENT")
    for names in ([], ["HEIGHT", "HEIGHT"]):
        with pytest.raises(DatabaseError, match="at least one and none twice"):
            compile_decoder(message, names, [Dimension.LENGTH] * len(names))


def test_encoder_wants_all_its_values(rig: Database) -> None:
    encode = compile_encoder(rig.message("BENCH_MEASUREMENT"), ["HEIGHT"], [Dimension.LENGTH])
    with pytest.raises(ValueError, match="expected 1"):
        encode([1.0, 2.0])


BESIDE_OFFSETS = """BO_ 1 M: 8 BENCH
 SG_ WARM : 0|8@1+ (0.5,-40) [-30|60] "degC" RIG
 SG_ FALLING : 8|16@1+ (-0.01,100) [-20|80] "N" RIG
 SG_ FLOAT : 32|32@1- (1,0) [-2|3] "N" RIG
"""


@pytest.mark.parametrize(
    ("signal", "dimension", "low", "high", "step"),
    [
        ("WARM", Dimension.TEMPERATURE, -30.0, 60.0, 0.5),
        ("FALLING", Dimension.FORCE, -20.0, 80.0, 0.01),
        ("FLOAT", Dimension.FORCE, -2.0, 3.0, 0.0),
    ],
)
def test_a_range_beside_an_offset_is_that_of_the_dbc(
    write_dbc: Callable[..., Path],
    signal: str,
    dimension: Dimension,
    low: float,
    high: float,
    step: float,
) -> None:
    message = load_database(write_dbc(BESIDE_OFFSETS, "SIG_VALTYPE_ 1 FLOAT : 1;")).message("M")
    assert si_range(message, signal, dimension) == pytest.approx((low, high), abs=1e-9)
    encode = compile_encoder(message, [signal], [dimension])
    decode = compile_decoder(message, [signal], [dimension])
    for value, sent, is_held in (
        (low, low, False),
        (high, high, False),
        (low - 0.4 * step, low, False),
        (high + 0.4 * step, high, False),
        (low - 10.0, low, True),
        (high + 10.0, high, True),
        (0.5 * (low + high), 0.5 * (low + high), False),
    ):
        payload, held = encode([value])
        assert decode(payload) == pytest.approx((sent,), abs=0.5 * step + 1e-6)
        assert held is is_held
