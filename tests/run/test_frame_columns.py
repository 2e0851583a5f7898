"""Columns of frames are what the lines say, one by one."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.log.candump import format_frame, parse_frame
from rig.log.received_frames import FrameColumns, read_frame_columns

EPOCH_NS = 1_700_000_000_123_456_789
LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    is_error = draw(st.booleans()) and draw(st.booleans())
    is_extended = draw(st.booleans()) and not is_error
    is_fd = draw(st.booleans()) and not is_error
    length = draw(st.sampled_from([n for n in LENGTHS if is_fd or n <= 8]))
    return Frame(
        draw(st.integers(-(10**9), 10**13)),
        draw(st.integers(0, 0x1FFFFFFF if is_extended or is_error else 0x7FF)),
        draw(st.binary(min_size=length, max_size=length)),
        is_extended,
        is_fd,
        is_fd and draw(st.booleans()),
        is_error,
    )


def rows(columns: FrameColumns) -> list[tuple[object, ...]]:
    return [
        (
            int(columns.t_ns[k]),
            int(columns.arbitration_id[k]),
            columns.payload[k, : columns.length[k]].tobytes(),
            bool(columns.is_extended[k]),
            bool(columns.is_error[k]),
        )
        for k in range(len(columns.t_ns))
    ]


def expected(found: list[Frame]) -> list[tuple[object, ...]]:
    return [(f.t_ns, f.arbitration_id, f.data, f.is_extended, f.is_error) for f in found]


@given(drawn=st.lists(st.tuples(frames(), st.sampled_from(["R", "T"])), max_size=40))
def test_columns_are_the_received_frames_in_their_order(drawn, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "frames.log"
    lines = [format_frame(frame, EPOCH_NS, "can0", direction) for frame, direction in drawn]
    path.write_text("".join(lines), "ascii")
    received = [frame for frame, direction in drawn if direction == "R"]
    assert rows(read_frame_columns([path], EPOCH_NS)) == expected(received)


@pytest.mark.parametrize(
    "line",
    [
        "(1.5) can0 100#0102 R",
        "(1.000000001) can0 100#0102",
        "(0000000001.000000001) vcan1 100#ab R",
        "(1.000000001) a-long-name-of-a-channel 00000100#  R",
    ],
)
def test_lines_of_other_programs_are_read_as_parse_frame_reads_them(line, tmp_path):
    path = tmp_path / "frames.log"
    path.write_text(line + "\n", "ascii")
    assert rows(read_frame_columns([path], 0)) == expected([parse_frame(line, 0)[0]])


@given(text=st.text("(01.)9 can#AF RT\n", max_size=60), data=st.data())
def test_any_text_is_read_as_lines_are_or_refused(text, data, tmp_path_factory):
    good = format_frame(Frame(5, 0x100, b"\x01\x02"), 0, "can0", "R") * 3
    place = data.draw(st.integers(0, len(good)))
    mixed = good[:place] + text + good[place:]
    path = tmp_path_factory.mktemp("log") / "frames.log"
    path.write_text(mixed, "ascii")
    lines = mixed.split("\n")[:-1]  # the last one is cut off, or empty
    try:
        parsed = [parse_frame(line, 0) for line in lines if not line.endswith("T")]
    except (ValueError, IndexError):
        with pytest.raises(InputError, match=r"frames\.log: line \d+: .*expected a line"):
            read_frame_columns([path], 0)
    else:
        found = [frame for frame, direction in parsed if direction == "R"]
        assert rows(read_frame_columns([path], 0)) == expected(found)


def test_a_line_that_is_no_frame_is_named(tmp_path):
    path = tmp_path / "frames.log"
    good = "(1.000000000) can0 100#0102 R\n"
    path.write_text(good * 3 + "rubbish\n" + good, "ascii")
    with pytest.raises(InputError, match=r"frames\.log: line 4: 'rubbish': expected a line such"):
        read_frame_columns([path], 0)


def test_a_last_line_without_an_end_is_left_out(tmp_path):
    path = tmp_path / "frames.log"
    good = "(1.000000000) can0 100#0102 R\n"
    path.write_text(good * 3 + good[:-4], "ascii")
    assert len(read_frame_columns([path], 0).t_ns) == 3


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"frames\.log: cannot be read: No such file"):
        read_frame_columns([tmp_path / "frames.log"], 0)


@pytest.mark.parametrize("stamp", ["9999999999.000000000", "99000000000.000000000", "-5.000000000"])
def test_a_time_that_cannot_be_is_refused(tmp_path, stamp):
    path = tmp_path / "frames.log"
    good = "(1.000000000) can0 100#0102 R\n"
    path.write_text(f"{good}({stamp}) can0 100#0102 R\n", "ascii")
    with pytest.raises(InputError, match=r"frames\.log: line 2: "):
        read_frame_columns([path], 0)
