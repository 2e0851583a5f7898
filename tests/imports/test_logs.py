"""Bus logs of other programs become runs, as if the bridge had heard the frames live."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from msgspec.structs import replace

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.bus.log_files import read_log
from rig.formats.bus_log import import_log
from rig.formats.foreign_table import import_table
from rig.formats.mapping import load_mapping
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.plan import Plan
from rig.run.replay import replay
from rig.simulated_bench.bench import SimulatedBench
from rig.simulated_bench.config import load_bench_config

EPOCH_S = 1_700_000_000.0


@pytest.fixture(scope="module")
def ready() -> Plan:
    return load_plan(CONFIGS / "reference.yaml")


@pytest.fixture(scope="module")
def frames(ready: Plan) -> list[Frame]:
    bench = SimulatedBench(load_bench_config(CONFIGS / "reference_bench.yaml"), ready.database)
    return bench.update(500_000_000)[0]


def messages(frames: list[Frame]) -> Iterator[can.Message]:
    for frame in frames:
        yield can.Message(
            timestamp=EPOCH_S + frame.t_ns * 1e-9,
            arbitration_id=frame.arbitration_id,
            is_extended_id=frame.is_extended,
            data=frame.data,
            is_rx=True,
            channel=0,
        )


@pytest.mark.parametrize("ending", [".blf", ".asc", ".log", ".trc", ".mf4"])
def test_a_log_becomes_the_run_that_was_heard(
    tmp_path: Path, ready: Plan, frames: list[Frame], ending: str
) -> None:
    if ending == ".mf4":
        pytest.importorskip("asammdf", reason="MF4 logs want the package asammdf")
    path = tmp_path / f"bench{ending}"
    with can.Logger(path) as log:
        for message in messages(frames):
            log.on_message_received(message)
    report = import_log(path, ready, tmp_path / "run")
    assert report.samples == len(frames)
    assert report.columns == ("BENCH_MEASUREMENT", "BENCH_AUXILIARY")
    found = read_run(tmp_path / "run")
    received = [frame for frame, direction in found.frames() if direction == "R"]
    assert [frame.data for frame in received] == [frame.data for frame in frames]
    # ASC and TRC keep fewer digits than ns.
    late_ns = np.array([a.t_ns - b.t_ns for a, b in zip(received, frames, strict=True)])
    assert np.abs(late_ns - 500_000).max() <= 100_000
    heights = found.steps.column("strut.measured_height_m").to_numpy()
    assert np.isfinite(heights).sum() >= 499
    assert replay(tmp_path / "run").different == 0


def test_frames_of_others_are_left_out_and_counted(
    tmp_path: Path, ready: Plan, frames: list[Frame]
) -> None:
    foreign = [replace(frame, arbitration_id=0x7F0) for frame in frames[:50]]
    mixed = sorted([*frames, *foreign], key=lambda frame: frame.t_ns)
    path = tmp_path / "bench.blf"
    with can.Logger(path) as log:
        for message in messages(mixed):
            log.on_message_received(message)
    report = import_log(path, ready, tmp_path / "run")
    assert report.samples == len(frames)
    assert "50 frames of other ids" in "\n".join(report.assumptions)


def test_a_log_without_the_bench_is_refused(
    tmp_path: Path, ready: Plan, frames: list[Frame]
) -> None:
    path = tmp_path / "bench.blf"
    with can.Logger(path) as log:
        for message in messages([replace(frame, arbitration_id=0x7F0) for frame in frames]):
            log.on_message_received(message)
    with pytest.raises(InputError, match="none of its 552 frames is one of BENCH_MEASUREMENT"):
        import_log(path, ready, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_day_without_frames_is_refused(tmp_path: Path, ready: Plan, frames: list[Frame]) -> None:
    later = [replace(frame, t_ns=frame.t_ns + 86_400_000_000_000) for frame in frames]
    path = tmp_path / "bench.blf"
    with can.Logger(path) as log:
        for message in messages([*frames, *later]):
            log.on_message_received(message)
    with pytest.raises(InputError, match=r"86\d+ s without a frame of the bench"):
        import_log(path, ready, tmp_path / "run")


@pytest.mark.parametrize("ending", [".blf", ".asc", ".log", ".trc", ".mf4"])
@pytest.mark.parametrize(
    "content", [b"", b"LOGG" + bytes(200), b"(x) can0 1#Z\n", b"\xff\x00" * 99]
)
def test_a_damaged_log_is_refused_in_one_line(
    tmp_path: Path, ready: Plan, ending: str, content: bytes
) -> None:
    path = tmp_path / f"bench{ending}"
    path.write_bytes(content)
    read: list[object] = []
    with contextlib.suppress(InputError):
        read = list(read_log(path))
    assert read == []
    with pytest.raises(InputError) as caught:
        import_log(path, ready, tmp_path / "run")
    assert "\n" not in str(caught.value)
    assert path.name in str(caught.value)


def test_other_files_are_not_logs(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("x")
    with pytest.raises(InputError, match="endings"):
        list(read_log(path))
    with pytest.raises(InputError, match="no such file"):
        list(read_log(tmp_path / "none.blf"))


def test_channels_of_an_mf4_file_become_csv(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf", reason="MF4 files want the package asammdf")
    t_s = np.arange(200) * 0.01
    slow_s = np.arange(21) * 0.1
    path = tmp_path / "bench.mf4"
    with asammdf.MDF() as file:
        file.append(asammdf.Signal(10.0 * t_s, t_s + 3.0, unit="mm", name="Weg"))
        file.append(asammdf.Signal(2.0 * slow_s, slow_s + 3.0, unit="kN", name="Kraft"))
        file.save(path)
    mapping_path = tmp_path / "m.yaml"
    mapping_path.write_text(
        "height: {column: Weg, unit: mm}\nstrut_force: {column: Kraft, unit: kN}\n"
    )
    report = import_table(path, load_mapping(mapping_path), tmp_path / "out.csv")
    made = np.loadtxt(report.out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(made[:, 0], t_s, atol=1e-9)
    np.testing.assert_allclose(made[:, 1], 0.01 * t_s, atol=1e-9)
    np.testing.assert_allclose(made[:, 2], 2000.0 * t_s, atol=1e-6)
    assert "linear between" in "\n".join(report.assumptions)
    mapping_path.write_text(
        "height: {column: Weg, unit: cm}\nstrut_force: {column: Kraft, unit: kN}\n"
    )
    with pytest.raises(InputError, match="the file has 'mm'"):
        import_table(path, load_mapping(mapping_path), tmp_path / "out2.csv")
    # With a gain the reading has the file's unit, such as V.
    mapping_path.write_text(
        "height: {column: Weg, unit: m, gain: 0.002}\nstrut_force: {column: Kraft, unit: kN}\n"
    )
    report = import_table(path, load_mapping(mapping_path), tmp_path / "out2.csv")
    made = np.loadtxt(report.out, delimiter=",", skiprows=1)
    np.testing.assert_allclose(made[:, 1], 0.02 * t_s, atol=1e-9)
