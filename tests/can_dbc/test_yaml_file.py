"""Numbers of a YAML file are what they look like, and cost what they are long."""

import os
import re

import pytest

from can_dbc.errors import FileError, expected_name
from can_dbc.yaml_file import parse_mapping, read_text


@pytest.mark.parametrize(
    "text", ["1:30", "-1:30:00", "1:30.5", "1" + ":59" * 50_000, "1" + ":59" * 50_000 + ".5"]
)
def test_a_number_in_base_60_stays_a_text(text):
    # Nothing is computed from its digits, so that it costs what any text of its length does.
    assert parse_mapping(f"a: {text}", "x.yaml") == {"a": text}
    assert parse_mapping(f"? {text}\n: a", "x.yaml") == {text: "a"}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("12_000", 12000),
        ("-0x1F", -31),
        ("0b101", 5),
        ("017", 15),
        ("9" * 40, int("9" * 40)),
        ("!!int 12", 12),
        ("1e5", 1e5),
        ("1_0.5", 10.5),
        ("-.inf", float("-inf")),
        ("!!float 2", 2.0),
        ("0.5" + "0" * 5000, 0.5),
    ],
)
def test_other_numbers_are_read(text, value):
    read = parse_mapping(f"a: {text}", "x.yaml")["a"]
    assert (type(read), read) == (type(value), value)


@pytest.mark.parametrize(
    "text",
    [
        "9" * 41,
        "-0x" + "F" * 5000,
        "0" + "7" * 5000,
        "0b" + "1" * 20_000,
        "!!int 1:30",
        "!!int '1" + ":59" * 50_000 + "'",
        "!!float 1:30",
        "!!int ''",
    ],
)
@pytest.mark.parametrize("line", ["b: {}", "{}: b"])
def test_a_number_that_is_too_long_or_in_base_60_is_one_line(text, line):
    with pytest.raises(FileError) as caught:
        parse_mapping("a: 1\n" + line.format(text), "x.yaml")
    message = str(caught.value)
    assert message.startswith("x.yaml: line 2 is no valid YAML: ")
    assert "expected" in message
    assert len(message) < 200


@pytest.mark.parametrize(
    ("name", "known", "expected"),
    [
        ("stif", ["damping", "stiffness"], "did you mean stiffness?"),
        ("HEIGHT", ["height", "weight", "force"], "did you mean height or weight?"),
        ("x", ["one"], "expected one"),
        ("x", ["one", "two"], "expected one of one, two"),
        (
            "x",
            [f"n{i}" for i in range(20)],
            f"expected one of {', '.join(f'n{i}' for i in range(12))}, ...",
        ),
    ],
)
def test_the_nearest_names_are_suggested(name, known, expected):
    assert expected_name(name, known) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bus:\n  a: 1\n   b: 2\n", "line 3 is no valid YAML: a second colon, or an indentation"),
        ("a:\n  b: 1\n c: 2\n", "line 3 is no valid YAML: expected the indentation of the lines"),
        ("\tbus: {}\n", "line 1 is no valid YAML: a tab, expected blanks"),
        ("a: [1,\n", "a bracket is open to the end of the file"),
    ],
)
def test_a_line_that_is_no_yaml_names_its_cure(text, expected):
    with pytest.raises(FileError, match=re.escape(expected)):
        parse_mapping(text, "my.yaml")


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match="is a pipe, expected a file"):
        read_text(tmp_path / "pipe")
