"""Rows of runs as Parquet, partitioned by bench and date, and queries over them.

    STORE/runs/bench=B/date=D/PART.parquet      a row a run
    STORE/values/bench=B/date=D/PART.parquet    a row a parameter or figure of a run

A part is written whole or not at all, its values first: a run whose row is there is complete. Two
programs that write into one store (two shards) know nothing of each other, and need not. What was
written twice all the same is counted once by the views.
"""

import contextlib
import datetime
import hashlib
import importlib
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import pyarrow as pa
from pyarrow import dataset, fs, parquet

from can_dbc.atomic_file import replacing
from can_dbc.errors import InputError, missing_package
from rig.fleet.one_run import RunRow

_parquet = cast("Any", parquet)  # its stubs are incomplete
_duckdb: Any = None
with contextlib.suppress(ModuleNotFoundError):  # It only reads; the store is written without it.
    _duckdb = importlib.import_module("duckdb")

_TEXT, _REAL = pa.string(), pa.float64()
_RUN_TEXTS = (
    *("key", "identity", "source", "damper", "model", "model_sha256", "version", "written"),
    *("verdict", "error", "build"),
)
_RUN_NUMBERS = ("duration_s", "before", "after", "floor", "took_s")
_RUN = pa.schema(
    [
        *((name, _TEXT) for name in _RUN_TEXTS),
        ("samples", pa.int64()),
        *((name, _REAL) for name in _RUN_NUMBERS),
        ("part", _TEXT),
    ]
)
_VALUE_TEXTS = ("key", "damper", "kind", "strut", "effect", "family", "parameter")
_VALUE = pa.schema(
    [
        *((name, _TEXT) for name in _VALUE_TEXTS),
        *((name, _REAL) for name in ("value", "low", "high")),
        ("part", _TEXT),
    ]
)
_PARTITION = pa.schema([("bench", _TEXT), ("date", _TEXT)])
_VIEWS = """
CREATE VIEW runs AS SELECT * EXCLUDE (identity) FROM (
    SELECT * FROM every_run QUALIFY row_number() OVER (
        PARTITION BY source, model_sha256, version ORDER BY written DESC, part) = 1
) QUALIFY row_number() OVER (PARTITION BY key ORDER BY written, part) = 1;
CREATE VIEW "values" AS SELECT v.* FROM every_value AS v
    SEMI JOIN every_run ON v.key = every_run.key AND v.part = every_run.part
    SEMI JOIN runs ON v.key = runs.key
    QUALIFY dense_rank() OVER (PARTITION BY v.key ORDER BY v.part) = 1;
CREATE VIEW effects AS SELECT * FROM "values" WHERE kind <> 'figure';
"""
_ABANDONED_S = 3600.0
"""Age from which on a part without its runs was left by a program that was killed."""


def refuse_other(store: Path) -> None:
    """Refuse a folder that holds something other than a store.

    Raises:
        InputError: It does, or is a file.
    """
    if store.exists() and not store.is_dir():
        raise InputError(f"{store}: is a file, expected a folder")
    if store.is_dir() and any(store.iterdir()) and not (store / "values").is_dir():
        raise InputError(f"{store}: holds something else, expected a store or a new folder")


def append(store: Path, rows: Sequence[RunRow]) -> None:
    """Write rows, a part for each bench and day.

    Raises:
        InputError: The store cannot be written.
    """
    groups: dict[tuple[str, str], list[RunRow]] = {}
    for row in rows:
        groups.setdefault((row.bench, row.date), []).append(row)
    try:
        for (bench, date), group in groups.items():
            _write(store, f"bench={quote(bench, safe='')}/date={date}", group)
    except OSError as error:
        raise InputError(f"{store}: cannot be written ({error.strerror})") from error


def _write(store: Path, partition: str, rows: Sequence[RunRow]) -> None:
    content = "\0".join([partition, *(row.key for row in rows)])
    part = hashlib.sha256(content.encode("utf-8", "surrogateescape")).hexdigest()[:24]
    written = datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds")
    runs = [{**vars(row), "written": written, "part": part} for row in rows]
    values = [
        {**vars(value), "key": row.key, "damper": row.damper, "part": part}
        for row in rows
        for value in row.values
    ]
    for name, schema, content in (("values", _VALUE, values), ("runs", _RUN, runs)):
        path = store / name / partition / f"{part}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            _parquet.write_table(pa.Table.from_pylist(content, schema=schema), temporary)


def read_runs(store: Path) -> list[tuple[str, str, str]]:
    """Key, identity and error of every run of a store; none where there is no store yet.

    Raises:
        InputError: It cannot be read.
    """
    folder = store / "runs"
    if not folder.is_dir():
        return []
    try:
        there = dataset.dataset(folder, format="parquet", partitioning="hive")
        columns = ["key", "identity", "error"]
        rows = there.to_table(columns=columns).to_pylist() if there.files else []
    except (OSError, pa.ArrowException, ValueError) as error:
        raise InputError(f"{folder}: cannot be read ({error})") from error
    return [(row["key"], row["identity"], row["error"]) for row in rows]


def sweep(store: Path) -> None:
    """Remove what a killed program left: files without a name, values without their runs."""
    now = time.time()
    for name in ("values", "runs"):
        for path in [*(store / name).rglob("*.parquet"), *(store / name).rglob(".*")]:
            runs = store / "runs" / path.relative_to(store / name)
            is_left = path.name.startswith(".") or not runs.exists()
            if is_left and _age_s(path, now) > _ABANDONED_S:
                path.unlink(missing_ok=True)


def _age_s(path: Path, now: float) -> float:
    try:
        return now - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


@contextlib.contextmanager
def connect(store: Path) -> Generator[Any]:
    """A DuckDB connection with the views `runs`, `values` and `effects`, until the block ends.

    It can open no file, not even to read: what is in the store is handed to it.

    Raises:
        InputError: There is no store, DuckDB is not installed, or it refuses what it is asked for.
    """
    if not any((store / "runs").rglob("*.parquet")):
        raise InputError(f"{store}: no runs in it, expected what `rig fleet run` wrote")
    if _duckdb is None:
        raise InputError(missing_package("duckdb", "pip install -e '.[fleet]'"))
    # A SELECT can write as well (`WITH a AS (COPY ... TO ...)`), and a folder that DuckDB may read
    # (`allowed_directories`) is one that it may write.
    connection = _duckdb.connect(config={"enable_external_access": False})
    try:
        connection.register("every_run", _open_parts(store / "runs", _RUN))
        connection.register("every_value", _open_parts(store / "values", _VALUE))
        connection.execute(_VIEWS)
        connection.execute("SET lock_configuration = true")
        yield connection
    except (_duckdb.Error, pa.ArrowException, OSError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        hints = [line for line in lines[1:] if line.startswith(("Did you mean", "Candidate"))]
        raise InputError(
            f"{store}: {' '.join([lines[0], *hints])} (the views are runs, effects and values)"
        ) from error
    finally:
        connection.close()


def _open_parts(folder: Path, schema: pa.Schema) -> dataset.Dataset:
    """All parts in a folder of a store; bench and date are in their paths alone."""
    # Below a root of their own: a folder above the store may be called `bench=...` too.
    root = fs.SubTreeFileSystem(folder.absolute().as_posix(), fs.LocalFileSystem())
    parts = [path.relative_to(folder).as_posix() for path in folder.rglob("*.parquet")]
    return dataset.dataset(
        parts,
        schema=pa.schema([*schema, *_PARTITION]),
        format="parquet",
        filesystem=root,
        partitioning=dataset.partitioning(_PARTITION, flavor="hive"),
    )


def query(store: Path, sql: str) -> tuple[list[str], list[tuple[Any, ...]]]:
    """Names of columns, and rows, of a query over a store, which it cannot change.

    Raises:
        InputError: There is no store, or `sql` is not one SELECT that DuckDB accepts.
    """
    with connect(store) as connection:
        statements = connection.extract_statements(sql)
        if [item.type for item in statements] != [_duckdb.StatementType.SELECT]:
            raise InputError(f"{store}: {sql!r:.200}: expected one SELECT statement")
        answer = connection.execute(statements[0])
        return [item[0] for item in answer.description], answer.fetchall()
