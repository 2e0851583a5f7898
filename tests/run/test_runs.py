"""Whole runs in lockstep: the published case, the quarter car, and what a log is good for."""

import dataclasses
import os
import shutil
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
import yaml

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from rig.log.file_names import FRAMES_FILE, STEPS_FILE
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate

MS = 1_000_000
_CHANNELS = count()


def setup(name: str, duration_s: float) -> Plan:
    """A shipped configuration, on a channel that no other test has."""
    ready = load_plan(CONFIGS / f"{name}.yaml", duration_s=duration_s)
    channel = f"test-{os.getpid()}-{next(_CHANNELS)}"
    bus = dataclasses.replace(ready.config.bus, channel=channel)
    config = ready.config.model_copy(update={"bus": bus})
    return ready.with_config(config)


def lockstep(folder: Path, name: str, duration_s: float, bench: BenchConfig | None = None) -> Path:
    """A run in simulated time."""
    bench = bench or load_bench_config(CONFIGS / f"{name}_bench.yaml")
    ready = setup(name, duration_s)
    with_bench(ready, bench, folder, lockstep=True)
    return folder


def errors(folder: Path, name: str) -> dict[str, dict[str, float]]:
    """Errors of each strut after the first 0.5 s, against the bench's own truth."""
    bench = load_bench_config(CONFIGS / f"{name}_bench.yaml")
    steps = read_run(folder).steps
    t_ns = steps.column("t_ns").to_numpy()
    truth = simulate(bench, int(t_ns[-1]) + MS, MS)
    late = t_ns >= 500 * MS
    at = t_ns[late] // MS
    found: dict[str, dict[str, float]] = {}
    for index, strut in enumerate(bench.struts):
        force = steps.column(f"{strut.name}.force_n").to_numpy()[late]
        height = steps.column(f"{strut.name}.height_m").to_numpy()[late]
        true_n, true_m = truth.strut_force_n[at, index], truth.height_m[at, index]
        found[strut.name] = {
            "height_max_m": float(np.max(np.abs(height - true_m))),
            "force_rms": float(np.sqrt(np.mean((force - true_n) ** 2)) / np.max(np.abs(true_n))),
        }
    return found


@pytest.fixture(scope="module")
def reference_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lockstep(tmp_path_factory.mktemp("reference") / "run", "reference", 4.0)


@pytest.fixture(scope="module")
def quarter_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lockstep(tmp_path_factory.mktemp("quarter") / "run", "quarter_car", 4.0)


@pytest.fixture(scope="module")
def poor_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench whose frames are lost, late and uneven."""
    text = (CONFIGS / "reference_bench.yaml").read_text("utf-8")
    data = yaml.safe_load(text)
    data["transmissions"][0] |= {
        "loss_probability": 0.05,
        "jitter_ns": 900_000,
        "latency_ns": 300_000,
    }
    folder = tmp_path_factory.mktemp("poor")
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(data), "utf-8")
    return lockstep(folder / "run", "reference", 2.0, load_bench_config(path))


def test_the_published_case_is_met(reference_run):
    found = errors(reference_run, "reference")["strut"]
    assert found["height_max_m"] <= 2.5e-3
    assert found["force_rms"] <= 0.0114


def test_both_struts_of_the_quarter_car_are_estimated(quarter_run):
    found = errors(quarter_run, "quarter_car")
    assert set(found) == {"tyre", "suspension"}
    for strut in found.values():
        assert strut["force_rms"] <= 0.02


def test_how_well_the_rate_is_kept_is_told_on_the_bus(reference_run):
    message = cantools.database.load_file(DEFAULT_DATABASE).get_message_by_name("RIG_TIMING")
    pages: dict[int, dict[str, float]] = {}
    for frame, direction in read_run(reference_run).frames():
        if direction == "T" and frame.arbitration_id == message.frame_id:
            page = message.decode(frame.data, decode_choices=False)
            pages[page["PAGE"]] = page
    # Simulated time: every tick is in time and takes none, and they are a millisecond apart.
    assert pages[0]["LATENESS_P50"] == pages[0]["LATENESS_P99_9"] == pytest.approx(1e-6)
    assert pages[1]["WORK_P50"] == pytest.approx(1e-6)
    assert pages[1]["WORK_MAX"] == 0.0
    assert pages[2]["LONGEST_GAP"] == pytest.approx(1e-3)
    assert pages[2]["OVERRUNS"] == 0


def test_two_runs_are_identical_byte_by_byte(reference_run, tmp_path):
    again = lockstep(tmp_path / "run", "reference", 4.0)

    def content(folder: Path) -> tuple[bytes, bytes]:
        # The channel's name is the only thing that differs.
        lines = (folder / FRAMES_FILE).read_bytes().split(b"\n")
        frames = b"\n".join(b" ".join(line.split()[:1] + line.split()[2:]) for line in lines)
        return frames, (folder / STEPS_FILE).read_bytes()

    assert content(reference_run) == content(again)


@pytest.mark.parametrize("run", ["reference_run", "quarter_run", "poor_run"])
def test_a_replay_is_identical_bit_by_bit(run, request):
    folder = request.getfixturevalue(run)
    found = replay(folder)
    steps = read_run(folder).steps
    assert found.logged == len(steps) == len(found.steps)
    assert found.different == 0
    assert found.first_different_ns is None


def test_a_poor_bus_costs_frames_and_no_ticks(poor_run):
    steps = read_run(poor_run).steps
    assert steps.column("t_ns").to_pylist() == [k * MS for k in range(2000)]
    received = steps.column("received").to_numpy()
    assert (received == 0).any()
    assert (received >= 2).any()


def test_a_replay_with_other_gains_is_another_run(reference_run):
    ready = setup("reference", 4.0)
    weak = {
        name: replace(observer, proportional_n_per_m=1e4)
        for name, observer in ready.config.observers.items()
    }
    config = ready.config.model_copy(update={"observers": weak})
    found = replay(reference_run, plan=ready.with_config(config))
    assert found.different > 3000
    assert found.first_different_ns is not None


def cut(folder: Path, target: Path, frames_bytes: int, steps_bytes: int) -> Path:
    """A run as a kill might leave it."""
    shutil.copytree(folder, target)
    os.truncate(target / FRAMES_FILE, frames_bytes)
    os.truncate(target / STEPS_FILE, steps_bytes)
    return target


@pytest.mark.parametrize("seed", range(6))
def test_a_run_that_was_cut_off_replays_to_its_last_frame(poor_run, tmp_path, seed):
    rng = np.random.default_rng(seed)
    whole = replay(poor_run).steps
    frames_size = (poor_run / FRAMES_FILE).stat().st_size
    steps_size = (poor_run / STEPS_FILE).stat().st_size
    frames_bytes = int(rng.integers(frames_size // 10, frames_size))
    # Steps are flushed after their frames: they are never ahead of them by much.
    steps_bytes = int(rng.integers(0, steps_size * frames_bytes // frames_size))
    folder = cut(poor_run, tmp_path / "run", frames_bytes, steps_bytes)
    lines = (folder / FRAMES_FILE).read_bytes().rpartition(b"\n")[0].split(b"\n")
    last_line = next(line for line in reversed(lines) if line.endswith(b" R"))
    last_ns = round(float(last_line.split()[0].strip(b"()")) * 1e9)
    found = replay(folder)
    assert found.different == 0
    logged = read_run(folder).steps
    t_ns = found.steps.column("t_ns").to_numpy()
    assert len(t_ns) >= len(logged)
    assert abs(t_ns[-1] - last_ns) <= MS
    # What the cut left of the last tick's frames may be less than it had.
    sure = len(t_ns) - 2
    assert bits(found.steps, sure) == bits(whole, sure)


def bits(table: Any, count: int) -> list[bytes]:
    """Columns of the first steps, NaN for NaN."""
    return [column.to_numpy()[:count].tobytes() for column in table.columns]


def test_steps_that_are_ahead_of_the_frames_are_replayed_as_far_as_the_frames_go(
    reference_run, tmp_path
):
    frames_size = (reference_run / FRAMES_FILE).stat().st_size
    steps_size = (reference_run / STEPS_FILE).stat().st_size
    folder = cut(reference_run, tmp_path / "run", frames_size // 2, steps_size)
    found = replay(folder)
    assert found.logged == 4000
    assert found.different == 0
    assert len(found.steps) == pytest.approx(2000, abs=50)


def test_nothing_but_the_header_is_an_empty_replay(reference_run, tmp_path):
    found = replay(cut(reference_run, tmp_path / "run", 0, 0))
    assert len(found.steps) == found.logged == 0


@pytest.mark.parametrize("steps_bytes", [1, 3, 7, 8, 100, 700])
def test_steps_that_were_cut_before_the_first_are_all_computed_again(
    reference_run, tmp_path, steps_bytes
):
    size = (reference_run / FRAMES_FILE).stat().st_size
    found = replay(cut(reference_run, tmp_path / "run", size, steps_bytes))
    assert found.logged == 0
    assert bits(found.steps, 4000) == bits(read_run(reference_run).steps, 4000)


def test_a_file_that_holds_no_steps_is_refused(reference_run, tmp_path):
    folder = cut(reference_run, tmp_path / "run", 0, 0)
    (folder / STEPS_FILE).write_text("these are no steps", "utf-8")
    with pytest.raises(InputError, match=r"steps\.arrow: is no Arrow stream of steps"):
        replay(folder)
