"""What a DBC says is kept, and what is wrong in it is said in one line."""

import hashlib
import random
from collections.abc import Callable
from pathlib import Path

import pytest

import can_dbc.database
from can_dbc.database import DEFAULT_DATABASE, Database, load_database
from can_dbc.errors import DatabaseError
from can_dbc.protection import Profile

GOOD = """BO_ 291 FAST: 8 BENCH
 SG_ CRC : 0|8@1+ (1,0) [0|255] "" RIG
 SG_ COUNTER : 8|4@1+ (1,0) [0|15] "" RIG
 SG_ TRAVEL : 16|16@1- (0.01,5) [-100|100] "mm" RIG
BO_ 2147484672 BIG: 64 RIG
 SG_ FORCE : 7|16@0- (0.5,0) [0|0] "lbf" BENCH
"""
FAST_P02 = """BA_ "E2EProfile" BO_ 291 "P02";
BA_ "E2EDataIds" BO_ 291 "000102030405060708090a0b0c0d0e0f";
"""


def test_messages_and_signals(write_dbc: Callable[..., Path]) -> None:
    path = write_dbc(GOOD, 'BA_ "GenMsgCycleTime" BO_ 291 5;')
    database = load_database(path)
    assert database.path == path
    assert database.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert list(database.messages) == ["FAST", "BIG"]
    fast, big = database.message("FAST"), database.message("BIG")
    assert (fast.arbitration_id, fast.is_extended, fast.is_fd) == (291, False, False)
    assert (fast.length_bytes, fast.cycle_time_ns, fast.sender) == (8, 5_000_000, "BENCH")
    assert fast.protection is None
    assert (big.arbitration_id, big.is_extended, big.is_fd) == (1024, True, True)
    assert (big.length_bytes, big.cycle_time_ns, big.sender) == (64, None, "RIG")
    travel, force = fast.signal("TRAVEL"), big.signal("FORCE")
    assert (travel.scale, travel.offset, travel.unit) == (0.01, 5.0, "mm")
    assert (travel.minimum, travel.maximum) == (-100.0, 100.0)
    assert not travel.is_big_endian
    assert force.is_big_endian
    assert force.minimum is None
    assert force.maximum is None


def test_a_database_cannot_be_changed(rig: Database) -> None:
    with pytest.raises(TypeError):
        rig.messages["OTHER"] = rig.message("RIG_STATUS")
    with pytest.raises(AttributeError):
        rig.message("RIG_STATUS").length_bytes = 7


def test_frame_format_attribute_makes_a_short_message_fd(write_dbc: Callable[..., Path]) -> None:
    database = load_database(write_dbc(GOOD, 'BA_ "VFrameFormat" BO_ 291 14;'))
    assert database.message("FAST").is_fd


def test_protection_from_attributes(write_dbc: Callable[..., Path]) -> None:
    extra = 'BA_ "GenMsgCycleTime" BO_ 291 5;\nBA_ "E2EMaxDeltaCounter" BO_ 291 3;\n'
    protection = load_database(write_dbc(GOOD, FAST_P02 + extra)).message("FAST").protection
    assert protection is not None
    assert protection.identity.profile is Profile.P02
    assert protection.identity.data_ids == bytes(range(16))
    assert protection.counter.max_delta == 3
    assert protection.counter.silence_ns == 16 * 5_000_000


def test_unknown_names_bring_near_ones(rig: Database) -> None:
    with pytest.raises(DatabaseError, match=r"no message 'RIG_ESTIMAT', did you mean RIG_ESTIMATE"):
        rig.message("RIG_ESTIMAT")
    with pytest.raises(DatabaseError, match=r"no signal 'height', did you mean HEIGHT"):
        rig.message("BENCH_MEASUREMENT").signal("height")
    with pytest.raises(DatabaseError, match=r"expected one of CRC, COUNTER, HEIGHT"):
        rig.message("BENCH_MEASUREMENT").signal("zzzzz")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252"])
def test_either_encoding(tmp_path: Path, write_dbc: Callable[..., Path], encoding: str) -> None:
    text = write_dbc(GOOD).read_text(encoding="utf-8").replace('"mm"', '"µm"')
    path = tmp_path / "encoded.dbc"
    path.write_bytes(text.encode(encoding))
    assert load_database(path).message("FAST").signal("TRAVEL").unit == "µm"


def other(message: str) -> str:
    return GOOD + message


OVERLAP = other(
    'BO_ 5 O: 8 RIG\n SG_ A : 0|9@1+ (1,0) [0|0] "" R\n SG_ B : 8|8@1+ (1,0) [0|0] "" R'
)
TOO_LONG = other('BO_ 5 O: 2 RIG\n SG_ A : 8|9@1+ (1,0) [0|0] "" R')
HIDDEN = other('BO_ 5 O: 2 RIG\n SG_ A m1 : 0|40@1+ (1,0) [0|0] "" R')
HUGE = other("BO_ 5 O: 4000000000 RIG")
FAR = other('BO_ 5 O: 8 RIG\n SG_ A : 0|4000000000@1+ (1,0) [0|0] "" R')
SAME_ID = other('BO_ 291 O: 8 RIG\n SG_ A : 0|8@1+ (1,0) [0|0] "" R')
SAME_NAME = other('BO_ 292 FAST: 8 RIG\n SG_ A : 0|8@1+ (1,0) [0|0] "" R')
WIDE_ID = other('BO_ 5000 O: 8 RIG\n SG_ A : 0|8@1+ (1,0) [0|0] "" R')
INFINITE = other('BO_ 5 O: 8 RIG\n SG_ A : 0|8@1+ (1e999,0) [0|0] "" R')
SECOND = other(
    'BO_ 5 O: 8 RIG\n SG_ CRC : 0|8@1+ (1,0) [0|0] "" R\n SG_ COUNTER : 8|4@1+ (1,0) [0|0] "" R'
)


@pytest.mark.parametrize(
    ("messages", "statements", "words"),
    [
        (HUGE, "", ["4000000000 bytes"]),
        (FAR, "", ["does not fit"]),
        ("BO_ what", "", ["not a usable DBC"]),
        (
            GOOD.split("BO_ 2147484672", maxsplit=1)[0] + "BO_ 291 O: 8 RIG",
            "",
            ["FAST and O", "0x123"],
        ),
        (GOOD, "SG_MUL_VAL_ 291 TRAVEL CRC 0-4294967295;", ["SG_MUL_VAL_"]),
        (
            GOOD,
            "SG_MUL_VAL_ 291 COUNTER CRC 0-9999;\nSG_MUL_VAL_ 291 TRAVEL COUNTER 0-9999;",
            ["SG_MUL_VAL_", "100000000 frame layouts"],
        ),
        (GOOD, "SIG_VALTYPE_ 291 TRAVEL of : 1;", ["not a usable DBC", "SIG_VALTYPE_"]),
    ],
)
def test_a_wrong_file_is_refused_in_one_line(
    write_dbc: Callable[..., Path], messages: str, statements: str, words: list[str]
) -> None:
    path = write_dbc(messages, statements)
    with pytest.raises(DatabaseError) as caught:
        load_database(path)
    for word in [str(path), *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("messages", "statements", "name", "words"),
    [
        (OVERLAP, "", "O", ["overlapping"]),
        (TOO_LONG, "", "O", ["does not fit"]),
        (HIDDEN, "", "O", ["signal A", "does not fit"]),
        (SAME_ID, "", "O", ["FAST and O", "0x123"]),
        (SAME_ID, "", "FAST", ["FAST and O", "0x123"]),
        (SAME_NAME, "", "FAST", ["twice"]),
        (WIDE_ID, "", "O", ["message O"]),
        (INFINITE, "", "O", ["signal A", "scale", "finite"]),
        (GOOD, 'BA_ "E2EProfile" BO_ 291 "P99";', "FAST", ["'P99'", "P01, P02"]),
        (GOOD, 'BA_ "E2EProfile" BO_ 291 "P02";', "FAST", ["E2EDataIds", "16 bytes in hex"]),
        (
            GOOD,
            'BA_ "E2EProfile" BO_ 291 "P01";\nBA_ "E2EDataIds" BO_ 291 "12345";',
            "FAST",
            ["E2EDataIds '12345'", "2 bytes in hex"],
        ),
        (
            GOOD,
            FAST_P02 + 'BA_ "E2ECrcSignal" BO_ 291 "CHECK";',
            "FAST",
            ["E2ECrcSignal 'CHECK'", "no such signal"],
        ),
        (
            GOOD,
            FAST_P02 + 'BA_ "E2ECounterSignal" BO_ 291 "TRAVEL";',
            "FAST",
            ["E2ECounterSignal 'TRAVEL'", "4 bits from bit 8"],
        ),
        (GOOD, FAST_P02 + 'BA_ "E2EMaxDeltaCounter" BO_ 291 16;', "FAST", ["16", "1 to 15"]),
        (
            SECOND,
            FAST_P02 + FAST_P02.replace("291", "5"),
            "O",
            ["FAST and O", "same E2EDataIds"],
        ),
    ],
)
def test_a_wrong_message_is_refused_in_one_line_and_the_others_are_read(
    write_dbc: Callable[..., Path], messages: str, statements: str, name: str, words: list[str]
) -> None:
    path = write_dbc(messages, statements)
    database = load_database(path)
    with pytest.raises(DatabaseError) as caught:
        database.message(name)
    for word in [f"{path}: message {name}: ", *words]:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)
    assert database.message("BIG").signal("FORCE").unit == "lbf"


def test_what_only_describes_is_passed_over(write_dbc: Callable[..., Path]) -> None:
    values = 'VAL_ 291 NOWHERE 0 "off" ;\nVAL_ 291 COUNTER 0 "first" ;'
    database = load_database(write_dbc(GOOD, values))
    assert dict(database.passed_over) == {"VAL_ 291 NOWHERE": "no such signal"}
    assert database.message("FAST").signal("COUNTER").choices == {0: "first"}
    # A comment that cannot be read takes comments and names with it; cycle and units stay.
    text = 'CM_ SG_ 291 "of which signal?";\nBA_ "GenMsgCycleTime" BO_ 291 5;'
    database = load_database(write_dbc(GOOD, text))
    assert list(database.passed_over) == ["value names, comments and attributes"]
    assert database.message("FAST").cycle_time_ns == 5_000_000


def test_files_that_are_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path, kind in ((tmp_path, "is a folder"), (tmp_path / "missing.dbc", "no such file")):
        with pytest.raises(DatabaseError, match=f"{kind}, expected a DBC file"):
            load_database(path)
    with pytest.raises(DatabaseError, match="expected a DBC"):
        load_database(Path("a\0b\n"))
    binary = tmp_path / "binary.dbc"
    binary.write_bytes(b"\x81\x8d\xff\x00")
    with pytest.raises(DatabaseError, match=r"binary\.dbc: not text"):
        load_database(binary)
    monkeypatch.setattr(can_dbc.database, "SIZE_MAX_BYTES", 100)
    with pytest.raises(DatabaseError, match="larger than 100 bytes"):
        load_database(DEFAULT_DATABASE)


def mutate(content: bytes, rng: random.Random) -> bytes:
    mutated = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(mutated))
        kind = rng.randrange(5)
        if kind == 0:
            mutated[place] ^= 1 << rng.randrange(8)
        elif kind == 1:
            mutated[place] = rng.choice(b'0123456789|@+-:;"()[], \nmM')
        elif kind == 2:
            del mutated[place : place + rng.randint(1, 40)]
        elif kind == 3:
            mutated[place:place] = mutated[place : place + rng.randint(1, 40)]
        else:
            mutated[place:place] = str(rng.choice([9, 64, 4096, 2**31, 2**64])).encode()
    return bytes(mutated)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_mutated_files_load_or_are_refused(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    text = DEFAULT_DATABASE.read_text(encoding="utf-8")
    # Half of the mutations in a file with its comments taken out: these are most of the text.
    terse = "".join(line for line in text.splitlines(True) if not line.startswith("CM_"))
    path = tmp_path / "mutated.dbc"
    lines: list[str] = []
    for number in range(100):
        path.write_bytes(mutate((text if number % 2 else terse).encode(), rng))
        try:
            load_database(path)
        except DatabaseError as error:
            lines.append(str(error))
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in lines)
    assert 20 <= len(lines) < 100
