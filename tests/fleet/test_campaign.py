"""Runs on executors: nothing missing, nothing twice, one bad run stops nothing."""

import multiprocessing
import os
import signal
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import fsspec
import pytest

from can_dbc.errors import InputError
from rig.fleet import campaign as campaigns
from rig.fleet import store
from rig.fleet.campaign import load_fleet_model, run_campaign
from rig.fleet.executors import processes
from rig.fleet.one_run import RunRow, evaluate_run
from rig.fleet.overview import read_overview
from rig.fleet.sources import RunSource, find_sources, select_shard
from tests.fleet.population import Piece, write_fleet, write_model, write_run

PATTERN = "{bench}/{date}/{damper}"


def as_new(_damper, _week, _rng):
    return Piece()


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet")
    write_fleet(folder / "runs", 3, 4, as_new)
    write_model(folder)
    return folder


def given(folder):
    return load_fleet_model(folder / "model.yaml")


def threads():
    return ThreadPoolExecutor(1)


def rows(out, columns="source, bench, damper, date, verdict, error"):
    return store.query(out, f"SELECT {columns} FROM runs ORDER BY source")[1]


@pytest.mark.slow
def test_every_run_is_a_row_with_its_values(fleet, tmp_path):
    sources = find_sources([str(fleet / "runs")], PATTERN)
    end = run_campaign(sources, given(fleet), tmp_path / "store", threads, 4)
    assert (end.done, end.failed, end.skipped) == (12, 0, 0)
    found = rows(tmp_path / "store")
    assert len(found) == 12
    assert {(bench, damper) for _, bench, damper, *_ in found} == {
        ("bench_0", "A00"), ("bench_1", "A01"), ("bench_2", "A02"),
    }  # fmt: skip
    assert {date for *_, date, _, _ in found} == {
        "2026-01-05",
        "2026-01-12",
        "2026-01-19",
        "2026-01-26",
    }
    values = store.query(
        tmp_path / "store",
        "SELECT value, low, high FROM effects WHERE parameter = 'coulomb_force_n'",
    )[1]
    assert len(values) == 12
    for value, low, high in values:
        assert value == pytest.approx(20.0, rel=0.05)
        assert low < 20.0 < high


@pytest.mark.slow
def test_a_fleet_that_was_ended_is_gone_on_with(fleet, tmp_path):
    sources = find_sources([str(fleet / "runs")], PATTERN)
    stopped = 0

    def stop(now):
        nonlocal stopped
        stopped = now.done
        if now.done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign(sources, given(fleet), tmp_path, threads, 4, progress=stop)
    assert len(rows(tmp_path)) == stopped == 5
    end = run_campaign(sources, given(fleet), tmp_path, threads, 4)
    assert (end.done, end.skipped) == (7, 5)
    assert len(rows(tmp_path)) == 12
    assert run_campaign(sources, given(fleet), tmp_path, threads, 4).done == 0


@pytest.mark.slow
def test_shards_are_all_of_it_and_nothing_twice(fleet, tmp_path):
    sources = find_sources([str(fleet / "runs")], PATTERN)
    parts = [select_shard(sources, k, 3) for k in (1, 2, 3)]
    assert sorted(s.url for part in parts for s in part) == sorted(s.url for s in sources)
    for part in parts:
        run_campaign(part, given(fleet), tmp_path, threads, 4)
    assert len(rows(tmp_path)) == 12


def test_another_model_is_another_evaluation(fleet, tmp_path):
    sources = find_sources([str(fleet / "runs")], PATTERN)[:4]
    run_campaign(sources, given(fleet), tmp_path, threads, 4)
    file = tmp_path / "other.yaml"
    file.write_text((fleet / "model.yaml").read_text().replace("little_dyno", "other"))
    other = load_fleet_model(file)
    assert run_campaign(sources, other, tmp_path, threads, 4).done == len(sources)
    assert len(rows(tmp_path)) == 2 * len(sources)
    found = read_overview(tmp_path)
    assert (found.runs, found.others) == (len(sources), len(sources))
    assert found.model.startswith("other ")
    assert {len(series.points) for series in found.series} == {len(sources)}


def test_a_copy_of_a_run_counts_once(fleet, tmp_path):
    first = fleet / "runs" / "bench_0" / "2026-01-05" / "A00.csv"
    for name in ("one", "two"):
        (tmp_path / "runs" / f"{name}.csv").parent.mkdir(exist_ok=True)
        (tmp_path / "runs" / f"{name}.csv").write_bytes(first.read_bytes())
    sources = find_sources([str(tmp_path / "runs")])
    run_campaign(sources, given(fleet), tmp_path / "store", threads, 4)
    assert len(rows(tmp_path / "store")) == 1
    assert run_campaign(sources, given(fleet), tmp_path / "store", threads, 4).done == 0


def test_bad_runs_are_rows_and_stop_nothing(fleet, tmp_path):
    """What is no table, what has no load cell, and what breaks the code in a way nobody foresaw."""
    runs = tmp_path / "runs"
    write_run(runs / "good.csv", Piece(), 1)
    (runs / "empty.csv").write_text("")
    (runs / "text.csv").write_text("t_s,height_m\n" + "a,b\n" * 300)
    (runs / "binary.csv").write_bytes(bytes(range(256)) * 20)
    (runs / "folder").mkdir()
    (runs / "folder" / "run.yaml").write_text("epoch_ns: not a number")
    end = run_campaign(find_sources([str(runs)]), given(fleet), tmp_path / "store", threads, 4)
    assert (end.done, end.failed) == (5, 4)
    found = rows(tmp_path / "store")
    assert sum(not error for *_, error in found) == 1
    assert all("\n" not in error for *_, error in found)
    assert (
        run_campaign(find_sources([str(runs)]), given(fleet), tmp_path / "store", threads, 4).done
        == 0
    )
    again = run_campaign(
        find_sources([str(runs)]), given(fleet), tmp_path / "store", threads, 4, again=True
    )
    assert again.done == 4


def test_what_nobody_foresaw_is_an_error_of_its_run(fleet, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("by nobody")

    monkeypatch.setattr("rig.fleet.one_run.diagnose", broken)
    (source, *_) = find_sources([str(fleet / "runs")], PATTERN)
    row = evaluate_run(source, given(fleet))
    assert row.error == "unexpected: ZeroDivisionError: by nobody"


def killed(source, model):
    """A worker that dies of one run, once or always."""
    mark = Path(model.folder)
    if "poison" in source.url or ("once" in source.url and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return RunRow(
        source.url, source.url, source.url, "b", "d", "2026-01-05", "m", "h", "v",
        verdict="explained",
    )  # fmt: skip


@pytest.mark.long
def test_a_worker_that_is_killed_takes_nothing_with_it(tmp_path, monkeypatch):
    """One run kills its worker always, one only the first time: the others are all there."""
    monkeypatch.setattr(campaigns, "evaluate_run", killed)
    # Workers import `killed` from here, and not from a package of the name `tests` elsewhere.
    monkeypatch.syspath_prepend(Path(__file__).parents[2])
    names = [f"run_{k}" for k in range(12)] + ["poison", "once"]
    sources = [RunSource(n, False, "b", "d", "2026-01-05", "2026-01-05", 1, "") for n in names]
    model = load_fleet_model(write_model(tmp_path))._replace(folder=str(tmp_path / "mark"))
    context = multiprocessing.get_context("spawn")

    def make():
        return ProcessPoolExecutor(2, mp_context=context)

    end = run_campaign(sources, model, tmp_path / "store", make, 6)
    assert end.done == 14
    found = {source: error for source, *_, error in rows(tmp_path / "store")}
    assert set(found) == set(names)
    assert found["poison"] == "killed its worker, alone as well"
    assert [name for name, error in found.items() if error] == ["poison"]


def test_runs_on_object_storage_are_read_through_fsspec(fleet, tmp_path):
    memory = fsspec.filesystem("memory")
    content = (fleet / "runs" / "bench_1" / "2026-01-05" / "A01.csv").read_bytes()
    memory.pipe("/lab/bench_9/2026-03-04/A77.csv", content)
    try:
        sources = find_sources(["memory://lab"], PATTERN)
        assert [(s.url, s.bench, s.damper, s.date) for s in sources] == [
            ("memory:///lab/bench_9/2026-03-04/A77.csv", "bench_9", "A77", "2026-03-04")
        ]
        end = run_campaign(sources, given(fleet), tmp_path, threads, 2)
        assert (end.done, end.failed) == (1, 0)
    finally:
        memory.rm("/lab", recursive=True)


@pytest.mark.parametrize(
    ("pattern", "line"),
    [
        ("{bench}/{bench}/{date}", "each once"),
        ("{rig}/{date}/{damper}", "expected {bench}, {damper}, {date}"),
        ("{bench}/{damper}", "does not fit"),
        ("{date}/{bench}/{damper}", "expected a day"),
    ],
)
def test_a_pattern_that_is_wrong_is_said(fleet, pattern, line):
    with pytest.raises(InputError, match=line.replace("{", r"\{")):
        find_sources([str(fleet / "runs")], pattern)


def test_places_without_runs_are_said(tmp_path):
    with pytest.raises(InputError, match="no runs"):
        find_sources([str(tmp_path)])
    with pytest.raises(InputError, match=r"no runs|cannot be read"):
        find_sources([str(tmp_path / "nowhere")])
    with pytest.raises(InputError, match="cannot be read"):
        find_sources(["nosuchprotocol://somewhere"])


def test_a_day_is_looked_for_in_the_path(tmp_path):
    for name in ("a_20260305.csv", "b-2026-13-45.csv", "2026-04-01/c.csv"):
        path = tmp_path / "bench" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
    days = {s.url.rsplit("/", 1)[1]: s.date for s in find_sources([str(tmp_path)])}
    assert days == {"a_20260305.csv": "2026-03-05", "b-2026-13-45.csv": "", "c.csv": "2026-04-01"}


def test_links_are_followed_and_odd_names_are_runs(fleet, tmp_path):
    runs = tmp_path / "runs"
    runs.mkdir()
    (runs / "linked").symlink_to(fleet / "runs" / "bench_0", target_is_directory=True)
    content = (fleet / "runs" / "bench_1" / "2026-01-05" / "A01.csv").read_bytes()
    (runs / os.fsdecode(b"d\xe4mpfer.CSV")).write_bytes(content)
    sources = find_sources([str(runs)])
    assert len(sources) == 5
    end = run_campaign(select_shard(sources, 1, 1), given(fleet), tmp_path / "store", threads, 2)
    assert (end.done, end.failed) == (5, 0)


def test_a_bench_whose_name_is_too_long_is_said(tmp_path):
    (tmp_path / ("b" * 61)).mkdir()
    (tmp_path / ("b" * 61) / "a.csv").write_text("")
    with pytest.raises(InputError, match="at most 60 bytes"):
        find_sources([str(tmp_path)])


def test_what_is_ready_is_written_though_nothing_follows(fleet, tmp_path, monkeypatch):
    """A killed writer loses no more than it held for so long."""
    monkeypatch.setattr(campaigns, "PART_S", 0.05)
    seen = []

    class Slow(ThreadPoolExecutor):
        def submit(self, call, source, model):
            if "2026-01-26" in source.url:
                return super().submit(lambda: (time.sleep(0.5), call(source, model))[1])
            return super().submit(call, source, model)

    sources = find_sources([str(fleet / "runs" / "bench_0")], None)

    def look(now):
        if now.done == len(sources):
            seen.append(len(store.read_runs(tmp_path)))

    run_campaign(sources, given(fleet), tmp_path, lambda: Slow(2), 8, progress=look)
    assert seen[0] >= len(sources) - 1


def test_no_worker_imports_a_module_of_the_working_directory(foreign_modules):
    with processes(1).make() as executor:
        assert executor.submit(len, "rig").result(timeout=60) == 3
    assert foreign_modules.imported == []
