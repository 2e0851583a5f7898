"""Data files of MTS controllers, written to the manual's description of them."""

import random

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from rig.cli.main import app
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from rig.formats.mts import mts_mapping, read_mts
from tests.faults.test_fuzz_files import mangled
from tests.imports.test_tables import rows

T_S = np.arange(40) * 0.005
TRAVEL_IN = np.sin(0.2 * np.arange(40))
LOAD_LBF = 30.0 * np.cos(0.2 * np.arange(40))


def content(delimiter="\t", decimal=".", blocks=2, names=("Running Time", "Axial Displacement")):
    code = {"\t": 2, ",": 1}[delimiter]
    lines = [f"MTS793|MPT|ENU|1|{code}|{decimal}|/|:|1|0|0|A", ""]
    for block in range(blocks):
        lines += [
            delimiter.join(["Data Acquisition", "", "Time:", "4", "Sec", "3/29/2016 1:54:32 PM"]),
            delimiter.join([*names, "Axial Load"]),
            delimiter.join(["Sec", "in", "lbf"]),
        ]
        for k in range(block * 20, block * 20 + 20):
            numbers = (f"{value:.9g}" for value in (T_S[k], TRAVEL_IN[k], LOAD_LBF[k]))
            lines.append(delimiter.join(number.replace(".", decimal) for number in numbers))
        lines.append("")
    return "\n".join(lines)


def written(folder, text, name="specimen.dat"):
    (folder / name).write_text(text, "latin-1")
    return folder / name


@pytest.mark.parametrize(("delimiter", "decimal"), [("\t", "."), ("\t", ","), (",", ".")])
@pytest.mark.parametrize(("rebound", "sign"), [("positive", -1.0), ("negative", 1.0)])
def test_blocks_become_one_csv_in_si(tmp_path, delimiter, decimal, rebound, sign):
    source = written(tmp_path, content(delimiter, decimal))
    report = import_table(source, mts_mapping(source, rebound), tmp_path / "out.csv")
    assert report.samples == 40
    found = rows(tmp_path / "out.csv")
    assert [float(row["t_s"]) for row in found] == pytest.approx(T_S.tolist())
    heights = [float(row["height_m"]) for row in found]
    assert heights == pytest.approx((0.0254 * TRAVEL_IN).tolist(), abs=1e-9)
    forces = [float(row["strut_force_n"]) for row in found]
    assert forces == pytest.approx((sign * 4.4482216152605 * LOAD_LBF).tolist(), abs=1e-5)


def test_the_command_and_a_mapping(tmp_path):
    source = written(tmp_path, content())
    runner = CliRunner()
    given = [str(source), "--rebound", "positive", "--out", str(tmp_path / "a.csv")]
    ended = runner.invoke(app, ["import", *given])
    assert ended.exit_code == 0, ended.output
    assert "sign reversed" in " ".join(ended.output.split())
    (tmp_path / "mapping.yaml").write_text(
        "time: {column: Running Time, unit: s}\n"
        "height: {column: Axial Displacement, unit: in, zero: {reads: 0, at_m: 0.3}}\n"
        "strut_force: {column: Axial Load, unit: lbf}\n"
    )
    import_table(source, load_mapping(tmp_path / "mapping.yaml"), tmp_path / "b.csv")
    assert float(rows(tmp_path / "b.csv")[0]["height_m"]) == pytest.approx(0.3)
    for wrong in (["--rebound", "up"], ["--rebound", "positive", "--config", "x.yaml"]):
        refused = runner.invoke(app, ["import", str(source), *wrong, "--out", "c.csv"])
        assert isinstance(refused.exception, InputError)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1"),
        ("MTS793|MPT|ENU|1|0|.|/|:|1|0|0|A\n", "export it that way"),
        ("MTS793|MPT|ENU|1|1|,|/|:|1|0|0|A\n", "both delimiter and decimal"),
        ("MTS793|MPT|ENU|1|2|.|\n", "holds no row"),
        ("MTS793|MPT|ENU|1|2|.|\n1\t2\n", "expected 0: a line of names before them"),
        ("MTS793|MPT|ENU|1|2|.|\na\tb\n1\t2\n", "a line of names and one of units"),
        ("MTS793|MPT|ENU|1|2|.|\na\tb\ns\tmm\n1\t2\t3\n", "3 numbers, expected 2"),
        ("MTS793|MPT|ENU|1|2|.|\na\ta\ns\tmm\n1\t2\n", "occurs twice"),
        (
            "MTS793|MPT|ENU|1|2|.|\na\tb\ns\tmm\n1\t2\nc\td\ns\tmm\n3\t4\n",
            "expected the same columns in all",
        ),
    ],
)
def test_a_wrong_file_is_one_line(tmp_path, text, says):
    with pytest.raises(InputError) as refused:
        read_mts(written(tmp_path, text))
    assert says in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("Axial Load", "Axial Stress"), "expected a time, a displacement and a force"),
        (("Axial Load", "Load Displacement"), "height may be"),
        (("\tlbf", "\tV"), "Axial Load"),
    ],
)
def test_what_a_file_does_not_say_is_asked_for(tmp_path, change, says):
    with pytest.raises(InputError) as refused:
        mts_mapping(written(tmp_path, content().replace(*change)), "positive")
    assert says in str(refused.value)


def test_a_folder_is_imported_and_one_bad_file_stops_no_other(tmp_path):
    source, out = tmp_path / "dyno", tmp_path / "csv"
    source.mkdir()
    for name, text in (("a.dat", content()), ("b.dat", content()[:40]), ("c.dat", content())):
        written(source, text, name)
    runner = CliRunner()
    given = ["import", str(source), "--rebound", "positive", "--out", str(out)]
    ended = runner.invoke(app, given)
    assert ended.exit_code == 2
    assert "refused" in ended.output
    assert sorted(path.name for path in out.iterdir()) == ["a.csv", "c.csv"]
    again = runner.invoke(app, given)
    assert isinstance(again.exception, InputError)
    assert "is not empty" in str(again.exception)
    written(source, content(), "a.txt")
    twice = runner.invoke(app, [*given[:-1], str(tmp_path / "other")])
    assert "two files are called a" in str(twice.exception)


def mutated(folder, files):
    rng, good = random.Random("mts"), content().encode("latin-1")
    source, out, read = folder / "m.dat", folder / "m.csv", 0
    for _ in range(files):
        source.write_bytes(b"MTS793|" + mangled(rng, good)[7:])
        try:
            import_table(source, mts_mapping(source, "positive"), out)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017 - one of two good ends
        else:
            read += 1
            out.unlink()
    return read


def test_mutated_files_are_read_or_refused(tmp_path):
    assert 0 < mutated(tmp_path, 300) < 300


@pytest.mark.long
def test_ten_thousand_mutated_files_are_read_or_refused(tmp_path):
    mutated(tmp_path, 10_000)
