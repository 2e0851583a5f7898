"""Which message a frame is of: by its identifier, or by its J1939 parameter group."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.addressing import Directory, group_mask
from can_dbc.database import load_database

HEAD = """VERSION ""
NS_ :
BS_:
BU_: ECU BRIDGE
"""
MESSAGE = """
BO_ {id} {name}: 8 ECU
 SG_ Height : 0|16@1+ (0.1,0) [0|6000] "mm" BRIDGE
"""
J1939 = """
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "StandardCAN";
"""
EXTENDED = 0x80000000
BROADCAST, DIRECTED = 0x18FEF1FE, 0x18EF20FE


def messages(tmp_path, ids, *, j1939=True):
    text = HEAD + "".join(
        MESSAGE.format(id=number | EXTENDED, name=f"M{place}") for place, number in enumerate(ids)
    )
    if j1939:
        text += J1939 + "".join(
            f'BA_ "VFrameFormat" BO_ {number | EXTENDED} 3;\n' for number in ids
        )
    path = tmp_path / "my.dbc"
    path.write_text(text)
    return list(load_database(path).messages.values())


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    return Directory(messages(tmp_path_factory.mktemp("dbc"), [BROADCAST, DIRECTED]))


@given(priority=st.integers(0, 7), source=st.integers(0, 255))
def test_a_broadcast_group_is_known_from_any_source(two, priority, source):
    assert two.index_of(priority << 26 | 0x00FEF100 | source, True) == 0


@given(priority=st.integers(0, 7), source=st.integers(0, 255), destination=st.integers(0, 255))
def test_a_directed_group_is_known_for_any_destination(two, priority, source, destination):
    assert two.index_of(priority << 26 | 0x00EF0000 | destination << 8 | source, True) == 1


@given(number=st.integers(0, 0x1FFFFFFF))
def test_a_frame_of_another_group_is_nobodys(two, number):
    same = any(
        number & group_mask(number) == own & group_mask(own) for own in (BROADCAST, DIRECTED)
    )
    assert (two.index_of(number, True) is not None) is same
    assert two.index_of(number & 0x7FF, False) is None


def test_without_j1939_the_whole_identifier_counts(tmp_path):
    plain = Directory(messages(tmp_path, [BROADCAST], j1939=False))
    assert plain.index_of(BROADCAST, True) == 0
    assert plain.index_of(BROADCAST + 1, True) is None


def test_a_group_of_several_messages_says_nothing(tmp_path):
    shared = Directory(messages(tmp_path, [BROADCAST, BROADCAST - 4]))
    assert [shared.index_of(number, True) for number in (BROADCAST, BROADCAST - 4)] == [0, 1]
    assert shared.index_of(BROADCAST - 1, True) is None
    assert {item.mask for item in shared.filters} == {0x1FFFFFFF}


@given(number=st.integers(0, 0x1FFFFFFF))
def test_filters_let_in_what_has_a_place(two, number):
    let_in = any(number & f.mask == f.arbitration_id & f.mask for f in two.filters)
    assert let_in is (two.index_of(number, True) is not None)


def test_the_byte_behind_a_format_is_a_destination_or_part_of_the_group(two):
    """SAE J1939-21: PDU formats from 240 on have a group extension there, others a destination."""
    assert two.index_of(BROADCAST ^ 0x0100, True) is None
    assert two.index_of(DIRECTED ^ 0x0100, True) == 1
