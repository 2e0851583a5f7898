"""The store: whole parts, no row twice, and what other tools read of it."""

import math
import os
import sys

import duckdb
import pandas as pd
import pyarrow.dataset as pad
import pytest

from can_dbc.errors import InputError
from rig.cli.main import main
from rig.fleet import store
from rig.fleet.one_run import RunRow, RunValue
from rig.fleet.overview import read_overview


def row(number, *, bench="b", date="2026-01-05", error="", values=1):
    own = tuple(
        RunValue(
            "model", "strut", "coulomb_friction", "friction", f"p{k}", 1.0 * k, k - 1.0, k + 1.0
        )
        for k in range(values)
    )
    return RunRow(
        f"key{number}", f"id{number}", f"runs/{number}", bench, "A1", date, "m", "hash", "0.2.0",
        verdict="" if error else "explained", error=error, samples=10, values=() if error else own,
    )  # fmt: skip


def test_rows_and_values_are_partitioned_by_bench_and_date(tmp_path):
    store.append(tmp_path, [row(1), row(2, bench="c/d e"), row(3, date="2026-01-06", values=3)])
    folders = {str(p.parent.relative_to(tmp_path)) for p in tmp_path.rglob("*.parquet")}
    assert "runs/bench=b/date=2026-01-05" in folders
    assert "runs/bench=c%2Fd%20e/date=2026-01-05" in folders
    names, rows = store.query(tmp_path, "SELECT key, bench, date FROM runs ORDER BY key")
    assert names == ["key", "bench", "date"]
    assert rows[1] == ("key2", "c/d e", "2026-01-05")
    assert store.query(tmp_path, 'SELECT count(*) FROM "values"')[1] == [(5,)]


def test_what_was_written_twice_counts_once(tmp_path):
    """Two programs that both computed a run, in parts of different content."""
    store.append(tmp_path, [row(1), row(2)])
    store.append(tmp_path, [row(2), row(3)])
    store.append(tmp_path, [row(1), row(2)])
    assert store.query(tmp_path, "SELECT count(*) FROM runs")[1] == [(3,)]
    assert store.query(tmp_path, "SELECT count(*) FROM effects")[1] == [(3,)]


def test_a_run_that_failed_is_forgotten_when_it_succeeds(tmp_path):
    store.append(tmp_path, [row(1, error="unreadable")])
    assert store.query(tmp_path, "SELECT error FROM runs")[1] == [("unreadable",)]
    again = row(1)
    store.append(tmp_path, [RunRow(**{**vars(again), "key": "other"})])
    assert store.query(tmp_path, "SELECT key, error FROM runs")[1] == [("other", "")]
    assert {identity for _, identity, error in store.read_runs(tmp_path) if not error} == {"id1"}


def test_a_success_of_another_model_hides_no_failure(tmp_path):
    store.append(tmp_path, [row(1)])
    failed = vars(row(1, error="unreadable")) | {"key": "k", "model_sha256": "other"}
    store.append(tmp_path, [RunRow(**failed)])
    found = store.query(tmp_path, "SELECT error FROM runs ORDER BY error")[1]
    assert found == [("",), ("unreadable",)]


def test_a_copy_under_another_bench_counts_once_with_its_values(tmp_path):
    store.append(tmp_path, [row(1, bench="b")])
    again = row(1, bench="c")
    copy = RunRow(**{**vars(again), "source": "elsewhere"})
    store.append(tmp_path, [copy])
    assert store.query(tmp_path, "SELECT count(*) FROM runs")[1] == [(1,)]
    assert store.query(tmp_path, "SELECT count(*) FROM effects")[1] == [(1,)]


def test_a_store_in_a_folder_of_any_name(tmp_path):
    folder = tmp_path / "a [b] 'c'"
    store.append(folder, [row(1)])
    assert store.query(folder, "SELECT count(*) FROM runs")[1] == [(1,)]


def test_values_without_their_runs_are_not_seen_and_swept(tmp_path):
    """A writer that was killed between the two: values come first."""
    store.append(tmp_path, [row(1)])
    store.append(tmp_path, [row(2, date="2026-02-02")])
    (path,) = (tmp_path / "runs" / "bench=b" / "date=2026-02-02").glob("*.parquet")
    path.unlink()
    assert store.query(tmp_path, "SELECT count(*) FROM effects")[1] == [(1,)]
    store.sweep(tmp_path)
    assert len(list((tmp_path / "values").rglob("*.parquet"))) == 2  # it may be being written
    for orphan in (tmp_path / "values" / "bench=b" / "date=2026-02-02").glob("*.parquet"):
        os.utime(orphan, (0, 0))
    store.sweep(tmp_path)
    assert len(list((tmp_path / "values").rglob("*.parquet"))) == 1


def test_other_tools_read_it(tmp_path):
    store.append(tmp_path, [row(k) for k in range(5)])
    frame = pd.read_parquet(tmp_path / "runs")
    assert sorted(frame["key"]) == [f"key{k}" for k in range(5)]
    there = pad.dataset(tmp_path / "values", partitioning="hive").to_table()
    assert there.num_rows == 5
    found = duckdb.sql(f"SELECT count(*) FROM '{tmp_path}/runs/*/*/*.parquet'").fetchall()
    assert found == [(5,)]


def test_a_number_that_is_missing_stays_missing(tmp_path):
    store.append(tmp_path, [row(1)])
    ((before,),) = store.query(tmp_path, "SELECT before FROM runs")[1]
    assert math.isnan(before)


@pytest.mark.parametrize(
    "sql", ["", "SELEC 1", "SELECT nothing FROM runs", "SELECT * FROM nowhere"]
)
def test_a_query_that_is_wrong_is_one_line(tmp_path, sql):
    store.append(tmp_path, [row(1)])
    with pytest.raises(InputError) as caught:
        store.query(tmp_path, sql)
    assert "\n" not in str(caught.value)


def test_what_is_no_store_is_said(tmp_path):
    with pytest.raises(InputError, match="no runs in it"):
        store.query(tmp_path, "SELECT 1")
    (tmp_path / "runs" / "bench=b").mkdir(parents=True)
    (tmp_path / "runs" / "bench=b" / "x.parquet").write_bytes(b"nothing of the kind")
    with pytest.raises(InputError):
        store.query(tmp_path, "SELECT * FROM runs")
    with pytest.raises(InputError):
        store.read_runs(tmp_path)


PART = "store/runs/bench=b/date=2026-01-05/own.parquet"
ONE_SELECT = "expected one SELECT statement"
NO_FILES = "file system operations are disabled"


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("sql", "reason"),
    [
        ("COPY runs TO 'out.csv'", ONE_SELECT),
        (f"COPY (SELECT 1) TO '{PART}'", ONE_SELECT),
        ("WITH a AS (COPY (SELECT 1) TO 'out.csv') SELECT * FROM a", NO_FILES),
        (f"WITH a AS (COPY (SELECT 1) TO '{PART}') SELECT * FROM a", NO_FILES),
        ("EXPORT DATABASE 'out'", ONE_SELECT),
        ("ATTACH 'out.db'", ONE_SELECT),
        ("INSTALL httpfs", ONE_SELECT),
        ("LOAD httpfs", ONE_SELECT),
        ("CREATE TABLE a AS SELECT 1", ONE_SELECT),
        ("SET enable_external_access = true", ONE_SELECT),
        ("PRAGMA version", ONE_SELECT),
        ("CALL enable_logging(storage := 'file', storage_path := 'out')", ONE_SELECT),
        ("FROM enable_logging(storage := 'file', storage_path := 'out')", "locked"),
        ("SELECT 1; SELECT 2", ONE_SELECT),
        (f"SELECT 1; COPY (SELECT 1) TO '{PART}'", ONE_SELECT),
        ("", ONE_SELECT),
        ("SELECT * FROM read_csv('/etc/passwd')", NO_FILES),
        ("SELECT * FROM read_text('/etc/passwd')", NO_FILES),
        ("SELECT * FROM '/etc/passwd.csv'", "passwd"),
        ("SELECT * FROM glob('/etc/*')", NO_FILES),
        ("SELECT * FROM sql", "sql does not exist"),  # a variable of rig itself
    ],
)
def test_a_query_reads_the_store_and_nothing_else(tmp_path, monkeypatch, capsys, sql, reason):
    store.append(tmp_path / "store", [row(1)])
    before = contents(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["rig", "fleet", "query", "store", sql])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert ended.value.code == 2
    assert said.out == ""
    assert said.err.startswith("rig: store: ")
    assert reason in said.err
    assert len(said.err.splitlines()) == 1
    assert contents(tmp_path) == before
    assert {path.name for path in tmp_path.iterdir()} == {"store"}


@pytest.mark.parametrize(
    "sql",
    [
        "SELECT key, bench, date FROM runs",
        "-- the runs\nSELECT key, bench, date FROM runs;",
        "WITH own AS (SELECT * FROM runs) SELECT key, bench, date FROM own",
        "FROM (SELECT key, bench, date FROM runs)",
    ],
)
def test_a_query_is_any_one_select(tmp_path, sql):
    store.append(tmp_path, [row(1)])
    assert store.query(tmp_path, sql) == (["key", "bench", "date"], [("key1", "b", "2026-01-05")])


def test_a_store_below_a_folder_that_is_called_like_a_partition(tmp_path):
    folder = tmp_path / "bench=other" / "store"
    store.append(folder, [row(1)])
    assert store.query(folder, "SELECT bench FROM effects")[1] == [("b",)]


def test_a_damaged_part_is_one_line_in_a_report_too(tmp_path):
    store.append(tmp_path, [row(1)])
    store.append(tmp_path, [row(2, bench="c")])
    for path in (tmp_path / "runs" / "bench=c").rglob("*.parquet"):
        path.write_bytes(b"nothing of the kind")
    for read in (read_overview, lambda folder: store.query(folder, "SELECT * FROM runs")):
        with pytest.raises(InputError) as caught:
            read(tmp_path)
        assert "\n" not in str(caught.value)
