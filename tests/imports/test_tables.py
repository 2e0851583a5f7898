"""Foreign tables become the project's CSV: what is converted, what is assumed, what is refused."""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping

Written = Callable[[str, str], Path]


@pytest.fixture
def written(tmp_path: Path) -> Written:
    def write(name: str, text: str) -> Path:
        path = tmp_path / name
        path.write_text(text, "utf-8")
        return path

    return write


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


GERMAN = """Pruefstand 7
Probe: A

Zeit;Weg;Kraft;Temp
[ms];[mm];[kN];[degF]
0,0;-12,5;1,5;212
1,0;-12,25;1,25;212
2,0;;1,0;32
"""

GERMAN_MAPPING = """
table: {separator: ";", decimal: ",", skip_lines: 2, skip_after_names: 1}
time: {column: Zeit, unit: ms}
height: {column: Weg, unit: mm, reversed: true, zero: {reads: 0, at_m: 0.5}}
strut_force: {column: 3, unit: kN, tare_n: 20}
temperature: {column: Temp, unit: degF}
"""


def test_units_signs_offsets_and_gaps(written: Written, tmp_path: Path) -> None:
    mapping = load_mapping(written("m.yaml", GERMAN_MAPPING))
    report = import_table(written("a.txt", GERMAN), mapping, tmp_path / "out.csv")
    table = rows(report.out)
    assert list(table[0]) == ["t_s", "height_m", "strut_force_n", "temperature_c"]
    assert [float(row["t_s"]) for row in table] == [0.0, 0.001]
    assert float(table[0]["height_m"]) == pytest.approx(0.5125)
    assert [float(row["strut_force_n"]) for row in table] == [1480.0, 1230.0]
    assert [float(row["temperature_c"]) for row in table] == pytest.approx([100.0, 100.0])
    assert report.samples == 2
    assert report.rate_hz == pytest.approx(1000.0)


def test_every_assumption_is_said(written: Written, tmp_path: Path) -> None:
    mapping = load_mapping(written("m.yaml", GERMAN_MAPPING))
    said = "\n".join(
        import_table(written("a.txt", GERMAN), mapping, tmp_path / "out.csv").assumptions
    )
    for words in (
        "decimal sign ','",
        "sign reversed",
        "kN",
        "1 of 3 rows have no height",
        "prescribed",
        "ms",
    ):
        assert words in said


def test_sampling_rate_gain_and_rows_without_names(written: Written, tmp_path: Path) -> None:
    text = "".join(f"  {k}.0   {2 * k}\t{-k}\n" for k in range(100))
    mapping = load_mapping(
        written(
            "m.yaml",
            "table: {separator: whitespace, column_names: false, first_row: 10, rows: 20}\n"
            "time: {sampling_rate_hz: 50}\n"
            "height: {column: 1, unit: mm, gain: 10}\n"
            "applied_force: {column: 3, unit: lbf}\n",
        )
    )
    report = import_table(written("a.txt", text), mapping, tmp_path / "out.csv")
    table = rows(report.out)
    assert len(table) == 20
    assert [float(row["t_s"]) for row in table] == pytest.approx(np.arange(20) / 50)
    assert float(table[0]["height_m"]) == pytest.approx(0.1)
    assert float(table[0]["applied_force_n"]) == pytest.approx(-10 * 4.4482216152605)


@pytest.mark.parametrize(
    ("form", "stamps"),
    [
        ("iso", ["2024-03-31T01:59:59.999500+01:00", "2024-03-31T03:00:00.000500+02:00"]),
        ("'%d.%m.%Y %H:%M:%S.%f'", ["31.12.2023 23:59:59.999500", "01.01.2024 00:00:00.000500"]),
    ],
)
def test_dates_become_seconds_to_the_microsecond(
    written: Written, tmp_path: Path, form: str, stamps: list[str]
) -> None:
    mapping = load_mapping(
        written(
            "m.yaml",
            f"time: {{column: when, date_format: {form}}}\n"
            "height: {column: z, unit: m}\nstrut_force: {column: f, unit: N}\n",
        )
    )
    text = "when,z,f\n" + "".join(f"{stamp},0.5,1\n" for stamp in stamps)
    report = import_table(written("a.csv", text), mapping, tmp_path / "out.csv")
    assert [row["t_s"] for row in rows(report.out)] == ["0.000000000", "0.001000000"]


def test_a_table_longer_than_a_piece_is_whole(written: Written, tmp_path: Path) -> None:
    count = 120_001
    text = "t,z,f\n" + "".join(f"{k},{k % 7},{k % 5}\n" for k in range(count))
    mapping = load_mapping(
        written(
            "m.yaml",
            "time: {column: t, unit: ms}\nheight: {column: z, unit: cm}\n"
            "strut_force: {column: f, unit: N}\n",
        )
    )
    report = import_table(written("a.csv", text), mapping, tmp_path / "out.csv")
    made = np.loadtxt(report.out, delimiter=",", skiprows=1)
    assert made.shape == (count, 3)
    k = np.arange(count)
    np.testing.assert_allclose(made, np.column_stack([k * 1e-3, k % 7 * 1e-2, k % 5]), atol=1e-12)


PLAIN = (
    "time: {column: t, unit: s}\nheight: {column: z, unit: m}\nstrut_force: {column: f, unit: N}\n"
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no line with column names"),
        ("t,z,f\n", "no rows of data"),
        ("t,z,g\n0,1,2\n", "strut_force.column = 'f' is not there, expected one of t, z, g"),
        ("t,z,f,f\n0,1,2,2\n", "strut_force.column = 'f' is twice"),
        ("t,z,f\n0,1,2\n1,x,2\n", "line 3: height = 'x', expected a number"),
        ("t,z,f\n0,1,2\n1,inf,2\n", "line 3: height = 'inf', expected a finite number"),
        ("t,z,f\n0,1,2\n1,1\n", "line 3: 2 cells, expected at least 3"),
        ("t,z,f\n0,1,2\n1,1,\n", "line 3: strut_force is missing"),
        ("t,z,f\n0,1,2\n,1,1\n", "line 3: time is missing"),
        ("t,z,f\n0,1,2\n0,1,2\n", "times that increase"),
        ("t,z,f\n0,1,2\n", "1 rows of data, expected at least 2"),
        ("t,z,f\n" + "1" * 200_000 + "\n", "longer than"),
    ],
)
def test_a_wrong_table_is_one_line(written: Written, tmp_path: Path, text: str, words: str) -> None:
    mapping = load_mapping(written("m.yaml", PLAIN))
    with pytest.raises(InputError) as caught:
        import_table(written("a.csv", text), mapping, tmp_path / "out.csv")
    message = str(caught.value)
    assert "\n" not in message
    assert "a.csv" in message
    assert words in message
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("height: {column: z, unit: m}\n", "expected applied_force or strut_force"),
        (PLAIN.replace("unit: m}", "unit: kg}"), "height.unit: unit 'kg' is of another dimension"),
        (PLAIN.replace("unit: m}", "unit: V}"), "height.unit"),
        (PLAIN.replace("unit: s}", "}"), "expected one of unit and date_format"),
        (PLAIN.replace("column: t, unit: s", "sampling_rate_hz: 0"), "time.sampling_rate_hz"),
        (PLAIN.replace("unit: m}", "unit: m, sign: 2}"), "height.sign"),
        (PLAIN.replace("unit: m}", "unit: m, gain: 0}"), "height"),
        (PLAIN + "heigth: 1\n", "heigth"),
        (PLAIN + "table: {separator: ',', decimal: ','}\n", "also the decimal sign"),
        (PLAIN + "table: {separator: ';;'}\n", "table.separator"),
    ],
)
def test_a_wrong_mapping_is_one_line(written: Written, text: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        load_mapping(written("mapping.yaml", text))
    message = str(caught.value)
    assert "\n" not in message
    assert "mapping.yaml" in message
    assert words in message


def test_nothing_is_overwritten(written: Written) -> None:
    mapping = load_mapping(written("m.yaml", PLAIN))
    out = written("out.csv", "mine")
    with pytest.raises(InputError, match="exists already"):
        import_table(written("a.csv", "t,z,f\n0,1,2\n1,1,2\n"), mapping, out)
    assert out.read_text() == "mine"


def test_a_missing_file_or_encoding_is_one_line(written: Written, tmp_path: Path) -> None:
    mapping = load_mapping(written("m.yaml", PLAIN))
    with pytest.raises(InputError, match="cannot be read"):
        import_table(tmp_path / "none.csv", mapping, tmp_path / "out.csv")
    (tmp_path / "b.csv").write_bytes(b"t,z,f\n0,\xff,1\n")
    with pytest.raises(InputError, match="is no text in UTF-8"):
        import_table(tmp_path / "b.csv", mapping, tmp_path / "out.csv")
    odd = load_mapping(written("o.yaml", PLAIN + "table: {encoding: klingon}\n"))
    with pytest.raises(InputError, match="encoding"):
        import_table(tmp_path / "b.csv", odd, tmp_path / "out.csv")
