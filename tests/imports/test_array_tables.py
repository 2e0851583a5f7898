"""Worksheets and TDMS files become CSV; cut and hostile ones end in one line."""

import io
import random
import zipfile

import nptdms
import numpy as np
import openpyxl
import pytest

from can_dbc.errors import InputError
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from tests.faults.test_fuzz_files import mangled
from tests.imports.test_tables import rows

T_MS = np.arange(50) * 2.0
TRAVEL_MM = 10.0 * np.sin(0.1 * np.arange(50))
FORCE_LBF = 20.0 * np.cos(0.1 * np.arange(50))
COLUMNS = {"Time": T_MS, "Travel": TRAVEL_MM, "Load": FORCE_LBF}


def xlsx(columns):
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(list(columns))
    for row in zip(*columns.values(), strict=True):
        sheet.append([float(value) for value in row])
    made = io.BytesIO()
    book.save(made)
    return made.getvalue()


def tdms(columns):
    made = io.BytesIO()
    with nptdms.TdmsWriter(made) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("dyno", name, values) for name, values in columns.items()]
        )
    return made.getvalue()


MAKERS = {"xlsx": xlsx, "tdms": tdms}
PLACES = {"xlsx": "{}", "tdms": "dyno/{}"}


def mapping(folder, place="{}", load="Load"):
    names = {name: place.format(name) for name in ("Time", "Travel")}
    path = folder / "mapping.yaml"
    path.write_text(
        f"time: {{column: {names['Time']}, unit: ms}}\n"
        f"height: {{column: {names['Travel']}, unit: mm, zero: {{reads: 0, at_m: 0.3}}}}\n"
        f"strut_force: {{column: {place.format(load)}, unit: lbf, reversed: true}}\n"
    )
    return load_mapping(path)


@pytest.mark.parametrize("kind", MAKERS)
def test_each_kind_becomes_the_same_csv(tmp_path, kind):
    source = tmp_path / f"dyno.{kind}"
    source.write_bytes(MAKERS[kind](COLUMNS))
    report = import_table(source, mapping(tmp_path, PLACES[kind]), tmp_path / "out.csv")
    assert report.samples == 50
    found = rows(tmp_path / "out.csv")
    assert [float(row["t_s"]) for row in found] == pytest.approx(1e-3 * T_MS)
    heights = [float(row["height_m"]) for row in found]
    assert heights == pytest.approx((0.3 + 1e-3 * TRAVEL_MM).tolist())
    forces = [float(row["strut_force_n"]) for row in found]
    assert forces == pytest.approx((-4.4482216152605 * FORCE_LBF).tolist(), abs=1e-6)


def test_a_channel_is_found_by_its_name_alone_where_that_is_the_only_one(tmp_path):
    (tmp_path / "a.tdms").write_bytes(tdms(COLUMNS))
    assert import_table(tmp_path / "a.tdms", mapping(tmp_path), tmp_path / "a.csv").samples == 50


@pytest.mark.parametrize("kind", MAKERS)
def test_a_missing_column_is_named_with_those_there_are(tmp_path, kind):
    source = tmp_path / f"dyno.{kind}"
    source.write_bytes(MAKERS[kind](COLUMNS))
    with pytest.raises(InputError, match=r"strut_force\.column = .*Force' is not there.*Travel"):
        import_table(source, mapping(tmp_path, PLACES[kind], "Force"), tmp_path / "out.csv")


def test_a_file_that_was_cut_is_not_read_in_part(tmp_path):
    (tmp_path / "cut.tdms").write_bytes(tdms(COLUMNS)[:-100])
    with pytest.raises(InputError, match="less data than expected"):
        import_table(tmp_path / "cut.tdms", mapping(tmp_path), tmp_path / "out.csv")


def test_columns_of_other_lengths_and_texts_are_refused(tmp_path):
    (tmp_path / "a.tdms").write_bytes(tdms(COLUMNS | {"Load": FORCE_LBF[:30]}))
    with pytest.raises(InputError, match="has 30 values, expected 50, as many as times"):
        import_table(tmp_path / "a.tdms", mapping(tmp_path), tmp_path / "a.csv")
    book = openpyxl.Workbook()
    for row in (("Time", "Travel", "Load"), (0.0, 1.0, "n/a"), (1.0, 2.0, 3.0)):
        book.active.append(row)
    book.save(tmp_path / "a.xlsx")
    with pytest.raises(InputError, match="row 1 under the names: strut_force is missing"):
        import_table(tmp_path / "a.xlsx", mapping(tmp_path), tmp_path / "b.csv")


def test_a_worksheet_that_unpacks_to_more_than_memory_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("rig.formats.named_columns._MAX_BYTES", 100_000)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", bytes(1_000_000))
    (tmp_path / "bomb.xlsx").write_bytes(made.getvalue())
    with pytest.raises(InputError, match="more than 100000 bytes within"):
        import_table(tmp_path / "bomb.xlsx", mapping(tmp_path), tmp_path / "a.csv")


def mutated(folder, kind, files):
    """Read mutated files; each is read, or refused in one line."""
    rng, good = random.Random(f"{kind} tables"), MAKERS[kind](COLUMNS)
    meaning, read = mapping(folder, PLACES[kind]), 0
    source, out = folder / f"m.{kind}", folder / "m.csv"
    for _ in range(files):
        source.write_bytes(mangled(rng, good))
        try:
            import_table(source, meaning, out)
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017 - one of two good ends
        else:
            read += 1
            out.unlink()
    return read


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", MAKERS)
def test_mutated_files_are_read_or_refused(tmp_path, kind):
    mutated(tmp_path, kind, 200)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", MAKERS)
def test_ten_thousand_mutated_files_are_read_or_refused(tmp_path, kind):
    mutated(tmp_path, kind, 10_000)
