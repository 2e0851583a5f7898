"""Runs in other formats, as other programs read them, and back."""

import csv
import dataclasses
import importlib

import cantools
import numpy as np
import pyarrow.parquet
import pytest
from msgspec.structs import astuple

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from rig.formats.export import FORMATS, export_run, import_run
from rig.log.candump import parse_frame
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.run.loop import RunControl
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from tests.bridge.cores import FIRST


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A rotated run of half a second, with an extended, an FD and an error frame at its end."""
    folder = tmp_path_factory.mktemp("export") / "run"
    ready = load_plan(CONFIGS / "reference.yaml", duration_s=1.5)
    log = ready.config.log.model_copy(update={"rotate_s": 1.0})
    bus = dataclasses.replace(ready.config.bus, channel="export")
    config = ready.config.model_copy(update={"log": log, "bus": bus})
    with_bench(
        ready.with_config(config),
        load_bench_config(CONFIGS / "reference_bench.yaml"),
        folder,
        lockstep=True,
        control=RunControl(progress=lambda _t_ns, _mode: None),
    )
    last = read_run(folder).frame_files[-1]
    assert last.name == "frames.0001.log"
    with last.open("a") as file:
        file.write("(2.000000001) export 18FF0001#0102 R\n")
        file.write("(2.000000002) export 100##1" + "00" * 48 + " R\n")
        file.write("(2.000000003) export 20000004#0008000000000000 R\n")
    return folder


@pytest.mark.parametrize("kind", ["parquet", "mf4"])
def test_export_and_import_give_the_same_run(run, tmp_path, kind):
    export_run(run, kind, tmp_path / "out.mf4")
    import_run(tmp_path / "out.mf4", tmp_path / "back")
    before, after = read_run(run), read_run(tmp_path / "back")
    assert list(after.frames()) == list(before.frames())
    assert after.header == before.header
    assert after.steps.schema == before.steps.schema
    for name in before.steps.schema.names:
        assert after.steps[name].to_numpy().tobytes() == before.steps[name].to_numpy().tobytes()
    for name in ("model.yaml", "bus.dbc", "run.yaml"):
        assert (tmp_path / "back" / name).read_bytes() == (run / name).read_bytes()
    again = replay(tmp_path / "back")
    assert again.logged == 1500
    assert again.different == 0


def test_a_candump_log_reads_as_one_to_the_microsecond(run, tmp_path):
    export_run(run, "candump", tmp_path / "a.log")
    frames = [parse_frame(line, 0)[0] for line in (tmp_path / "a.log").read_text().splitlines()]
    original = [frame for frame, _ in read_run(run).frames()]
    assert [astuple(frame)[1:] for frame in frames] == [astuple(frame)[1:] for frame in original]
    assert all(0 <= b.t_ns - a.t_ns < 1000 for a, b in zip(frames, original, strict=True))
    assert (tmp_path / "a.log").read_text().splitlines()[0].split(" ")[0] == "(0.000000)"


def test_csv_holds_every_step_with_units_in_its_header(run, tmp_path):
    export_run(run, "csv", tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as file:
        rows = list(csv.DictReader(file))
    steps = read_run(run).steps
    assert len(rows) == steps.num_rows
    forces = [float(row["strut.force_n"] or "nan") for row in rows]
    assert np.array_equal(forces, steps["strut.force_n"].to_numpy(), equal_nan=True)
    assert np.isfinite(forces).sum() == len(rows) - FIRST + 1
    assert float(rows[-1]["t_s"]) == pytest.approx(1.499)


def test_parquet_is_a_plain_table_to_others(run, tmp_path):
    export_run(run, "parquet", tmp_path / "p")
    table = pyarrow.parquet.read_table(tmp_path / "p" / "frames.parquet")
    assert table.num_rows == len(list(read_run(run).frames()))
    assert set(table["arbitration_id"].to_pylist()) >= {0x100, 0x110, 0x200}


def test_asammdf_reads_the_mf4_as_a_bus_log(run, tmp_path):
    asammdf = importlib.import_module("asammdf")
    export_run(run, "mf4", tmp_path / "a.mf4")
    message = cantools.database.load_file(run / "bus.dbc").get_message_by_name("RIG_ESTIMATE")
    expected = [
        message.decode(frame.data)["SPRING_DAMPER_FORCE"]
        for frame, _ in read_run(run).frames()
        if frame.arbitration_id == message.frame_id
    ]
    with asammdf.MDF(tmp_path / "a.mf4") as mdf:
        with mdf.extract_bus_logging({"CAN": [(str(run / "bus.dbc"), 0)]}) as decoded:
            force = decoded.get("RIG_ESTIMATE.SPRING_DAMPER_FORCE")
            assert force.samples.tolist() == pytest.approx(expected, abs=1e-9)
        # The same signal stands decoded in the file itself, and the DBC is attached.
        force = mdf.get("decoded.RIG_ESTIMATE.SPRING_DAMPER_FORCE")
        assert force.samples.tolist() == pytest.approx(expected, abs=1e-9)
        assert np.isfinite(mdf.get("steps.strut.height_m").samples[-1])
        attached = {str(block.file_name) for block in mdf.attachments}
        assert {"bus.dbc", "run.yaml", "model.yaml"} <= attached


def test_a_run_of_nothing_can_be_exported(run, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in ("run.yaml", "model.yaml", "bus.dbc"):
        (empty / name).write_bytes((run / name).read_bytes())
    for name in ("frames.log", "steps.arrow"):
        (empty / name).write_bytes(b"")
    for kind in FORMATS:
        export_run(empty, kind, tmp_path / f"out_{kind}")
    import_run(tmp_path / "out_parquet", tmp_path / "back")
    assert list(read_run(tmp_path / "back").frames()) == list[tuple[Frame, str]]()


def test_wrong_inputs_are_one_line(run, tmp_path):
    (tmp_path / "there").write_text("x")
    (tmp_path / "folder").mkdir()
    for call, expected in (
        (lambda: export_run(run, "xls", tmp_path / "a"), "expected one of candump, csv"),
        (lambda: export_run(run, "csv", tmp_path / "there"), "expected a new file"),
        (
            lambda: export_run(tmp_path / "no", "csv", tmp_path / "a"),
            "no such folder",
        ),
        (lambda: import_run(tmp_path / "there", tmp_path / "b"), "is no MF4 file"),
        (lambda: import_run(tmp_path / "folder", tmp_path / "b"), "is no run in Parquet"),
        (lambda: import_run(tmp_path / "folder", run), "expected a new or an empty folder"),
    ):
        with pytest.raises(InputError, match=expected) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_a_file_that_would_leave_the_folder_is_refused(run, tmp_path):
    export_run(run, "parquet", tmp_path / "p")
    path = tmp_path / "p" / "steps.parquet"
    table = pyarrow.parquet.read_table(path)
    metadata = table.schema.metadata[b"rig.run"].replace(b'"model.yaml"', b'"../model.yaml"')
    pyarrow.parquet.write_table(table.replace_schema_metadata({b"rig.run": metadata}), path)
    with pytest.raises(InputError, match="expected a name inside"):
        import_run(tmp_path / "p", tmp_path / "back")
    assert not (tmp_path / "model.yaml").exists()
