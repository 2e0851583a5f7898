"""Forces smoothed over a whole run, against what the simulated bench had."""

import csv
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from rig.bridge.values import Mode
from rig.cli.main import main
from rig.formats import smoothed
from rig.formats.smoothed import compare_published, read_with_smoothed_forces
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan, plan_of_run
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.bridge.cores import MS
from tests.bridge.full_car import FullCar

NOISE_M, DURATION_S, RATE_HZ = 20e-6, 6.0, 1000
KALMAN = {"kind": "kalman", "filter": {"bandwidth_hz": 16.0, "noise_std_m": 2e-5}}


def bench_run(folder: Path, case: str, changed=None, **sent):
    """A run with noisy heights, and the forces of the bench at its ticks, (N, struts)."""
    content = yaml.safe_load((CONFIGS / f"{case}_bench.yaml").read_text())
    for transmission in content["transmissions"]:
        if "height" in transmission:
            transmission["height"]["noise_std_m"] = NOISE_M
            transmission.update(sent)
    (folder / "bench.yaml").write_text(yaml.safe_dump(content))
    config = yaml.safe_load((CONFIGS / f"{case}.yaml").read_text()) | (changed or {})
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    ready = load_plan(folder / "rig.yaml", duration_s=DURATION_S)
    bench = load_bench_config(folder / "bench.yaml")
    with_bench(ready, bench, folder / "run", lockstep=True)
    period_ns = ready.config.period_ns
    return simulate(bench, int(DURATION_S * 1e9) + period_ns, period_ns).strut_force_n


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    folder = tmp_path_factory.mktemp("smoothed")
    return folder / "run", bench_run(folder, "reference")


def column(steps, name):
    return np.asarray(steps.column(name).to_numpy(), float)


def errors(run: Path, truth_n, name: str, index: int = 0):
    """RMS error online and smoothed after half a second, and share of the intervals that hold.

    The deviation that is stated is that of the error, within a factor.
    """
    steps = read_with_smoothed_forces(run, lambda _what, _share: None).steps
    tick = np.rint(column(steps, "t_ns") * 1e-9 * RATE_HZ).astype(int)
    online, found, std = (
        column(steps, f"{name}.{key}")
        for key in ("force_n", "smoothed_force_n", "smoothed_force_std_n")
    )
    missed = found - truth_n[tick, index]
    running = column(steps, "mode") == Mode.RUNNING
    assert np.array_equal(np.isfinite(found), running)
    later = np.flatnonzero(running)[500:]
    assert np.all(std[later] > 0.0)
    held = np.mean(np.abs(missed[later]) < 1.96 * std[later])
    online_n = np.sqrt(np.mean((online - truth_n[tick, index])[later] ** 2))
    smoothed_n = np.sqrt(np.mean(missed[later] ** 2))
    assert 0.7 * smoothed_n < np.sqrt(np.mean(std[later] ** 2)) < 2.5 * smoothed_n
    return online_n, smoothed_n, held


def test_a_smoothed_force_is_far_nearer_than_the_one_of_the_run(reference):
    run, truth_n = reference
    online_n, smoothed_n, held = errors(run, truth_n, "strut")
    assert smoothed_n < 0.25 * online_n
    assert smoothed_n < 0.002 * np.max(np.abs(truth_n))
    assert held > 0.9


@pytest.mark.slow
def test_struts_that_move_each_other_are_smoothed_together(tmp_path):
    """In a quarter car each virtual force moves both heights."""
    truth_n = bench_run(tmp_path, "quarter_car")
    for index, name in enumerate(("tyre", "suspension")):
        online_n, smoothed_n, held = errors(tmp_path / "run", truth_n, name, index)
        assert smoothed_n < 0.5 * online_n
        assert held > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("observer", [{"kind": "pi"}, KALMAN])
def test_lost_heights_cost_what_the_deviation_says(tmp_path, observer):
    """A fifth of the frames is lost: gaps of many ticks, in some of which the bridge holds."""
    changed = {"observers": {"strut": observer}, "supervision": {"stale_after_s": 0.004}}
    truth_n = bench_run(tmp_path, "reference", changed, loss_probability=0.2)
    modes = column(read_run(tmp_path / "run").steps, "mode")
    assert np.any(modes[500:] == Mode.HOLD)
    steps = read_with_smoothed_forces(tmp_path / "run", lambda _what, _share: None).steps
    found, std = (column(steps, f"strut.smoothed_force_{key}") for key in ("n", "std_n"))
    known = np.flatnonzero(np.isfinite(found))[500:]
    tick = np.rint(column(steps, "t_ns") * 1e-9 * RATE_HZ).astype(int)
    missed = found[known] - truth_n[tick[known], 0]
    assert np.mean(np.abs(missed) < 1.96 * std[known]) > 0.9


@pytest.mark.slow
def test_an_old_height_is_taken_at_its_own_time(tmp_path):
    """The model's force is that of its time, with an applied force that is not late."""
    height = {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT", "delay_s": 0.005}
    applied = {"message": "BENCH_MEASUREMENT_2", "signal": "APPLIED_FORCE"}
    changed = {
        "observers": {"strut": KALMAN},
        "signals": {"height": {"strut": height}, "applied_force": applied},
        "supervision": {"stale_after_s": 0.02},
    }
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text())
    content["transmissions"] = [
        {
            "message": "BENCH_MEASUREMENT",
            "latency_ns": 5_000_000,
            "height": {"signal": "HEIGHT", "strut": "strut", "noise_std_m": NOISE_M},
        },
        {"message": "BENCH_MEASUREMENT_2", "applied_force": {"signal": "APPLIED_FORCE"}},
    ]
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(content))
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text()) | changed
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(config))
    ready = load_plan(tmp_path / "rig.yaml", duration_s=DURATION_S)
    bench = load_bench_config(tmp_path / "bench.yaml")
    with_bench(ready, bench, tmp_path / "run", lockstep=True)
    truth_n = simulate(bench, int(DURATION_S * 1e9) + MS, MS).strut_force_n
    online_n, smoothed_n, held = errors(tmp_path / "run", truth_n, "strut")
    assert smoothed_n < 0.3 * online_n
    assert held > 0.9


def test_pieces_give_what_the_whole_gives(reference, monkeypatch):
    run, truth_n = reference
    _, whole_n, _ = errors(run, truth_n, "strut")
    monkeypatch.setattr(smoothed, "_LONGEST_S", 1.7)
    _, pieces_n, held = errors(run, truth_n, "strut")
    assert pieces_n == pytest.approx(whole_n, rel=0.15)
    assert held > 0.9


def test_every_tick_of_every_stretch_is_in_one_piece():
    tick_s = np.arange(200_000) / 1000.0
    pieces = smoothed._split_long(tick_s, slice(1000, 150_000))
    used = np.concatenate([np.arange(inner.start, inner.stop) for _, inner in pieces])
    assert np.array_equal(used, np.arange(1000, 150_000))
    for piece, inner in pieces:
        assert piece.start == max(1000, inner.start - 1000)
        assert min(inner.stop + 995, 150_000) <= piece.stop <= min(inner.stop + 1000, 150_000)


def test_a_stretch_ends_where_ticks_were_missed():
    tick_s = np.concatenate([np.arange(1000), 1005 + np.arange(1000)]) / 1000.0
    found = smoothed._split_at_gaps(tick_s, slice(100, 1900), 1.5e-3)
    assert found == [slice(100, 1000), slice(1000, 1900)]


def test_heights_that_are_faster_than_the_ticks_are_refused(tmp_path):
    """The log has the last virtual force of a tick, and not those in between."""
    bench_run(tmp_path, "reference", {"rate_hz": 200, "observers": {"strut": KALMAN}})
    with pytest.raises(InputError, match=r"height strut: .* at most one height a tick"):
        read_with_smoothed_forces(tmp_path / "run", lambda _what, _share: None)


@pytest.mark.parametrize("kept_bytes", [0, 100])
def test_a_run_that_was_killed_before_its_first_steps_is_one_line(
    reference, tmp_path, monkeypatch, capsys, kept_bytes
):
    cut = tmp_path / "cut"
    shutil.copytree(reference[0], cut)
    steps = cut / "steps.arrow"
    steps.write_bytes(steps.read_bytes()[:kept_bytes])
    out = ("--format", "csv", "--smoothed", "--out", tmp_path / "out.csv")
    assert rig(monkeypatch, "export", cut, *out) == 2
    assert "no steps of strut strut" in capsys.readouterr().err


def rig(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def test_the_command_writes_the_smoothed_forces_beside_the_others(reference, tmp_path, monkeypatch):
    run, _ = reference
    out = tmp_path / "run.csv"
    assert rig(monkeypatch, "export", run, "--format", "csv", "--smoothed", "--out", out) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == DURATION_S * RATE_HZ
    last = rows[-1]
    assert float(last["strut.smoothed_force_n"]) == pytest.approx(
        float(last["strut.force_n"]), abs=10.0 * float(last["strut.smoothed_force_std_n"])
    )


@pytest.mark.parametrize("kind", ["parquet", "mf4", "candump"])
def test_what_is_read_back_stays_as_it_was(reference, tmp_path, monkeypatch, capsys, kind):
    run, _ = reference
    arguments = ("export", run, "--format", kind, "--smoothed", "--out", tmp_path / "out")
    assert rig(monkeypatch, *arguments) == 2
    assert "expected --format csv" in capsys.readouterr().err


def test_what_cannot_be_smoothed_is_refused(reference, tmp_path, monkeypatch, capsys):
    run, _ = reference
    ready = load_plan(CONFIGS / "dyno.yaml", duration_s=0.2)
    bench = load_bench_config(CONFIGS / "dyno_bench.yaml")
    with_bench(ready, bench, tmp_path / "dyno", lockstep=True)
    out = ("--format", "csv", "--smoothed", "--out", tmp_path / "out.csv")
    assert rig(monkeypatch, "export", tmp_path / "dyno", *out) == 2
    assert "prescribed_motion" in capsys.readouterr().err
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=0.1)
    bench = load_bench_config(CONFIGS / "reference_bench.yaml")
    with_bench(ready, bench, tmp_path / "short", lockstep=True)
    assert rig(monkeypatch, "export", tmp_path / "short", *out) == 2
    assert "nowhere RUNNING with 200 heights" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
    pitching = FullCar().model(tmp_path)
    found, ready = read_run(run), plan_of_run(run)
    with pytest.raises(InputError, match="straight guides"):
        smoothed.smooth_forces(found, replace(ready, model=pitching), lambda _what, _share: None)


def test_the_estimate_is_compared_with_the_smoothed_force_while_it_is_valid(reference):
    folder, _ = reference
    run = read_with_smoothed_forces(folder, lambda _what, _share: None)
    valid = column(run.steps, "strut.valid") == 1.0
    apart_n = column(run.steps, "strut.force_n") - column(run.steps, "strut.smoothed_force_n")
    apart_n = apart_n[valid & np.isfinite(apart_n)]
    assert len(apart_n) > 1000
    expected_n = pytest.approx(np.sqrt(np.mean(apart_n**2)))
    assert compare_published(run) == {"strut": expected_n}
