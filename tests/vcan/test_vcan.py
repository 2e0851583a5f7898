"""The bridge on the kernel's CAN stack, against programs that nobody here wrote."""

import subprocess
from pathlib import Path

import cantools
import numpy as np
import pytest
import yaml

from can_dbc.frame import Frame
from rig.bench.config import load_bench_config
from rig.config import load_setup
from rig.core.types import Mode
from rig.io.bus import Bus, BusConfig
from rig.io.run_log import RunFolder, parse_frame, read_run
from rig.replay import replay
from rig.runs import with_bench
from tests.vcan.conftest import BENCH_IDS, RATE_HZ, in_process, run_for, running

pytestmark = pytest.mark.vcan

S = 1_000_000_000
SETTLED_S = 5.0
"""The model starts at rest while the bench moves."""


def is_calm(found: RunFolder) -> bool:
    """Whether the emulated kernel kept the rate, without which errors of the force say nothing."""
    return int(found.steps["overruns"].to_numpy().sum()) < 0.05 * found.steps.num_rows


def skip_unless_calm(found: RunFolder) -> None:
    if not is_calm(found):
        overruns = int(found.steps["overruns"].to_numpy().sum())
        pytest.skip(f"this machine is too busy to emulate 100 Hz: {overruns} ticks missed")


def force_error_n(found: RunFolder, dbc: Path) -> float:
    """RMS of the estimated force less the load cell's, sample by sample."""
    cell = cantools.database.load_file(dbc).get_message_by_name("BENCH_AUXILIARY")
    measured = [
        (frame.t_ns, cell.decode(frame.data)["LOAD_CELL_FORCE"])
        for frame, direction in found.frames()
        if direction == "R" and frame.arbitration_id == cell.frame_id
    ]
    t_ns, force_n = (np.array(column) for column in zip(*measured, strict=True))
    steps = found.steps
    estimate_n = np.interp(t_ns, steps["t_ns"].to_numpy(), steps["strut.force_n"].to_numpy())
    late = t_ns > t_ns[0] + SETTLED_S * S
    return float(np.sqrt(np.mean((estimate_n - force_n)[late] ** 2)))


def dumped(path: Path) -> list[Frame]:
    """Frames of a record by candump, which writes time to the µs."""
    return [parse_frame(line, 0)[0] for line in path.read_text().splitlines()]


def contents(frames: list[Frame]) -> list[tuple[int, bytes]]:
    return [(frame.arbitration_id, frame.data) for frame in frames]


def test_only_configured_ids_are_heard(second_vcan):
    bus = Bus(BusConfig("socketcan", second_vcan, 500_000), {(0x100, False)})
    try:
        for text in ("101#01", "100#0203", "00000100#04", "100##10203"):
            subprocess.run(["cansend", second_vcan, text], check=False)
        heard = bus.receive()
    finally:
        bus.close()
    assert contents(heard) == [(0x100, b"\x02\x03")]


@pytest.fixture(scope="module")
def recorded(bench, files, tmp_path_factory):
    """A minute of bridge and bench as two processes: the run, and candump's record."""
    folder = tmp_path_factory.mktemp("minute")
    record = folder / "candump.log"
    with (
        record.open("wb") as out,
        running(["candump", "-L", "-r", "4000000", bench], stdout=out),
        in_process(run_for, files.bridge(bench), folder / "run", 60.0) as process,
    ):
        process.join(300.0)
    assert process.exitcode == 0
    return folder / "run", record


def test_the_force_is_as_good_as_in_lockstep(recorded, files, tmp_path):
    run, _ = recorded
    skip_unless_calm(read_run(run))
    ready = load_setup(files.bridge("vcan0"), duration_s=30.0)
    on_virtual = ready.config.bus.model_copy(update={"interface": "virtual", "channel": "lockstep"})
    lockstep = ready.model_copy(
        update={"config": ready.config.model_copy(update={"bus": on_virtual})}
    )
    with_bench(
        lockstep,
        load_bench_config(files.bench),
        tmp_path / "lockstep",
        lockstep=True,
        stop=lambda: False,
        progress=lambda _t_ns, _mode: None,
    )
    expected_n = force_error_n(read_run(tmp_path / "lockstep"), files.dbc)
    live_n = force_error_n(read_run(run), files.dbc)
    print(f"force error: {live_n:.2f} N on vcan, {expected_n:.2f} N in lockstep")
    assert live_n <= 1.2 * expected_n + 0.5


def test_candumps_record_is_our_log(recorded, files):
    run, record = recorded
    found = read_run(run)
    logged = list(found.frames())
    ours = contents([frame for frame, direction in logged if direction == "T"])
    theirs = contents(dumped(record))
    sent = [item for item in theirs if item[0] in {number for number, _ in ours}]
    assert ours == sent
    received = contents([frame for frame, direction in logged if direction == "R"])
    bench = [item for item in theirs if item[0] in {int(text, 16) for text in BENCH_IDS}]
    start = bench.index(received[0])
    assert received == bench[start : start + len(received)]
    # And cantools reads in candump's record what the bridge computed.
    message = cantools.database.load_file(files.dbc).get_message_by_name("RIG_ESTIMATE")
    decoded = [
        message.decode(data)["SPRING_DAMPER_FORCE"] for i, data in sent if i == message.frame_id
    ]
    steps = found.steps.filter(~np.isnan(found.steps["strut.force_n"].to_numpy()))
    computed = steps["strut.force_n"].to_numpy()
    assert abs(np.array(decoded) - computed[: len(decoded)]).max() <= 0.0026


def test_a_replay_is_the_same_bit_for_bit(recorded):
    run, _ = recorded
    again = replay(run)
    assert again.different == 0
    ending = yaml.safe_load((run / "run.yaml").read_text())["ending"]
    print(f"overruns {ending['counts']['overruns']}, timing {ending['timing']}")
    assert again.logged == ending["ticks"]
    skip_unless_calm(read_run(run))
    assert ending["counts"]["refused"] == ending["counts"]["lost"] == 0
    assert ending["ticks"] + ending["counts"]["overruns"] == 60 * RATE_HZ


def test_canplayers_bench_gives_the_same_estimate(recorded, bridge, files, second_vcan, tmp_path):
    run, record = recorded
    part = tmp_path / "bench.log"
    lines = record.read_text().splitlines()
    bench = [line for line in lines if line.split(" ")[2].split("#")[0] in BENCH_IDS]
    first = parse_frame(bench[0], 0)[0].t_ns
    part.write_text(
        "\n".join(line for line in bench if parse_frame(line, 0)[0].t_ns < first + 10 * S) + "\n"
    )
    with running(["canplayer", "-I", part, f"{second_vcan}=vcan0"]):
        ended = bridge(second_vcan, 8.0)
    found = read_run(ended.folder)
    measured = found.steps["strut.measured_height_m"].to_numpy()
    force_n = found.steps["strut.force_n"].to_numpy()
    logged = read_run(run).steps
    original, original_n = (
        logged[name].to_numpy() for name in ("strut.measured_height_m", "strut.force_n")
    )
    here, there = ~np.isnan(measured), ~np.isnan(original)
    measured, force_n, original, original_n = (
        measured[here],
        force_n[here],
        original[there],
        original_n[there],
    )
    message = cantools.database.load_file(files.dbc).get_message_by_name("BENCH_MEASUREMENT")
    played = [frame for frame in dumped(part) if frame.arbitration_id == message.frame_id]
    known = {round(message.decode(frame.data)["HEIGHT"], 9) for frame in played}
    assert {round(height, 9) for height in measured.tolist()} <= known
    assert len(measured) > 0
    assert ended.state.counts.refused == 0
    assert replay(ended.folder).different == 0
    skip_unless_calm(found)
    skip_unless_calm(read_run(run))
    settled = slice(int(SETTLED_S * RATE_HZ), None)
    by_height = dict(zip(original.tolist(), original_n.tolist(), strict=True))
    difference = [
        n - by_height[z]
        for z, n in zip(measured[settled].tolist(), force_n[settled].tolist(), strict=True)
    ]
    print(f"median difference to the first run: {np.median(np.abs(difference)):.2f} N")
    assert np.median(np.abs(difference)) < 5.0


def test_ten_times_down_and_up_are_survived_and_each_gap_is_shown(bench, bridge):
    cycle = f"ip link set {bench} down; sleep 0.4; ip link set {bench} up; sleep 2.6"
    script = f"sleep 2; for i in 1 2 3 4 5 6 7 8 9 10; do {cycle}; done; sleep 3"
    with running(["sh", "-c", script]) as cycles:
        ended = bridge(bench, 300.0, stop=lambda: cycles.poll() is not None)
    ending = yaml.safe_load((ended.folder / "run.yaml").read_text())["ending"]
    gaps = ending["bus"]["gaps"]
    lengths = [gap["to_s"] - gap["from_s"] for gap in gaps]
    print(f"gaps of {min(lengths):.2f} to {max(lengths):.2f} s")
    assert len(gaps) == 10
    assert all(0.1 < length < 30.0 for length in lengths)
    steps = read_run(ended.folder).steps
    assert replay(ended.folder).different == 0
    t_s, flags = steps["t_ns"].to_numpy() * 1e-9, steps["flags"].to_numpy()
    for gap in gaps:
        inside = (t_s > gap["from_s"]) & (t_s < gap["to_s"] - 0.02)
        assert (flags[inside] & 2).all()
        assert (steps["received"].to_numpy()[inside] == 0).all()
    skip_unless_calm(read_run(ended.folder))
    assert ended.state.rig.mode is Mode.RUNNING


def test_a_flood_of_foreign_and_of_broken_frames_changes_nothing(bench, bridge):
    with (
        running(["cangen", bench, "-g", "1", "-I", "r", "-L", "r", "-D", "r", "-i"]),
        running(["cangen", bench, "-g", "2", "-I", "100", "-L", "8", "-D", "r", "-i"]),
    ):
        ended = bridge(bench, 8.0)
    counts = ended.state.counts
    print(counts)
    assert counts.refused > 100
    found = read_run(ended.folder)
    heights = found.steps["strut.measured_height_m"].to_numpy()
    heights = heights[~np.isnan(heights)]
    assert len(heights) > 0
    assert heights.min() > 0.1
    assert heights.max() < 0.7
    assert replay(ended.folder).different == 0
    skip_unless_calm(found)
    assert ended.state.rig.mode is Mode.RUNNING
    assert len(heights) > 6 * RATE_HZ


def test_frames_that_a_gateway_corrupts_are_all_refused(bench, second_vcan, bridge):
    route = ["cangw", "-A", "-s", bench, "-d", second_vcan, "-e", "-f", "100:7FE"]
    subprocess.run(route, check=True)
    corrupt = " ".join([*route, "-m", "XOR:D:0.0.0000000000010000"])

    broken = []

    def break_it(t_ns, _mode):
        if t_ns >= 3 * S and not broken:
            broken.append(subprocess.Popen(["sh", "-c", f"cangw -F; {corrupt}"]))

    ended = bridge(second_vcan, 12.0, progress=break_it)
    assert broken[0].wait(30.0) == 0
    counts = ended.state.counts
    print(counts)
    found = read_run(ended.folder)
    late = found.steps["t_ns"].to_numpy() > 10 * S
    assert np.isnan(found.steps["strut.measured_height_m"].to_numpy()[late]).all()
    assert not (found.steps["strut.valid"].to_numpy()[late] == 1.0).any()
    assert counts.wrong_crc + counts.masquerade > 0
    skip_unless_calm(found)
    assert counts.wrong_crc + counts.masquerade > 1.5 * RATE_HZ
    assert ended.state.rig.mode is Mode.SAFE


def test_listening_only_sends_nothing(bench, bridge, tmp_path):
    record = tmp_path / "sent.log"
    # Everything but what the bench sends.
    with (
        record.open("wb") as out,
        running(["candump", "-L", f"{bench},100~7FF,200~7FF,j"], stdout=out),
    ):
        ended = bridge(bench, 3.0, listen_only=True)
    assert record.read_text() == ""
    assert {direction for _, direction in read_run(ended.folder).frames()} == {"R"}
    assert ended.state.rig.model is not None  # it had something to say
