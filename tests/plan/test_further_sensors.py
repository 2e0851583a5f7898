"""Further sensors of a strut from the bus to the log, and configurations that cannot be."""

import json

import numpy as np
import pytest
import yaml

from can_dbc.errors import InputError
from rig.bridge.values import Mode
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import check
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config

KALMAN = {"kind": "kalman", "filter": {"bandwidth_hz": 25.0, "noise_std_m": 2e-5}}
CELL = {
    "measures": "force",
    "message": "BENCH_AUXILIARY",
    "signal": "LOAD_CELL_FORCE",
    "noise_std_n": 0.5,
}
WIRE = {
    "measures": "height",
    "message": "BENCH_MEASUREMENT_2",
    "signal": "HEIGHT",
    "noise_std_m": 1e-5,
}


def configured(folder, further, observer=KALMAN):
    folder.mkdir(exist_ok=True)
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    config["signals"]["further"] = further
    config |= {"observers": {"strut": observer}, "duration_s": 2.0}
    (folder / "rig.yaml").write_text(json.dumps(config))
    return load_plan(folder / "rig.yaml")


def run(folder, further, *, losses=(0.0, 0.0, 0.0)):
    """A run in lockstep: steps by column, ending; `losses` of height, wire and cell."""
    ready = configured(folder, further)
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text()) | {"seed": 3}
    height, wire, cell = losses
    content["transmissions"] = [
        {
            "message": "BENCH_MEASUREMENT",
            "loss_probability": height,
            "height": {"signal": "HEIGHT", "strut": "strut", "noise_std_m": 2e-5},
            "applied_force": {"signal": "APPLIED_FORCE"},
        },
        {
            "message": "BENCH_MEASUREMENT_2",
            "loss_probability": wire,
            "height": {"signal": "HEIGHT", "strut": "strut", "noise_std_m": 1e-5},
            "applied_force": {"signal": "APPLIED_FORCE"},
        },
        {
            "message": "BENCH_AUXILIARY",
            "loss_probability": cell,
            "strut_force": {"signal": "LOAD_CELL_FORCE", "strut": "strut", "noise_std_n": 0.5},
        },
    ]
    (folder / "bench.yaml").write_text(yaml.safe_dump(content))
    bench = load_bench_config(folder / "bench.yaml")
    ended = with_bench(ready, bench, folder / "run", lockstep=True)
    steps = read_run(folder / "run").steps
    return {name: steps.column(name).to_numpy() for name in steps.column_names}, ended


def test_sensors_are_used_logged_and_replayed(tmp_path):
    steps, ended = run(tmp_path, {"strut": {"cell": CELL, "wire": WIRE}})
    alone, _ = run(tmp_path / "alone", {})
    cell = steps["strut.cell.measured_force_n"]
    assert 190 <= np.isfinite(cell).sum() <= 200  # one in 10 ms
    assert np.isfinite(steps["strut.wire.measured_height_m"]).sum() >= 1990
    assert not steps["strut.cell.left_out"][100:].any()
    assert ended.state.counts.left_out < 100
    # Held against the load cell itself, whose noise is 0.5 N.
    seen = np.isfinite(cell) & (np.arange(len(cell)) > 500)
    missed, before = (np.std((given["strut.force_n"] - cell)[seen]) for given in (steps, alone))
    assert missed < 0.7 * before
    assert steps["strut.force_std_n"][1000] < 0.6 * alone["strut.force_std_n"][1000]
    assert replay(tmp_path / "run").different == 0


def test_a_silent_sensor_is_counted_and_published(tmp_path):
    steps, ended = run(tmp_path, {"strut": {"cell": CELL}}, losses=(0.0, 0.0, 1.0))
    assert np.all(steps["mode"][100:] == Mode.RUNNING)
    assert steps["strut.cell.left_out"][100:].all()
    assert ended.state.counts.left_out > 1800


@pytest.mark.parametrize(
    ("further", "observer", "says"),
    [
        ({"strut": {"cell": CELL}}, {"kind": "pi"}, "signals.further.strut: expected observers"),
        ({"axle": {"cell": CELL}}, KALMAN, "signals.further.axle: no such strut"),
        ({"strut": {"cell": CELL | {"measures": "mass"}}}, KALMAN, "'mass': expected one of"),
        ({"strut": {"cell": CELL | {"noise_std_n": 0.0}}}, KALMAN, "noise_std_n"),
        ({"strut": {"cell": WIRE | {"noise_std_n": 1.0}}}, KALMAN, "noise_std_n"),
        ({"strut": {"a cell": CELL}}, KALMAN, "a cell"),
        ({"strut": {"cell": CELL | {"signal": "NOTHING"}}}, KALMAN, "NOTHING"),
        ({"strut": {"cell": CELL | {"delay_s": 0.5}}}, KALMAN, "cell.delay_s: 0.5: expected"),
        ({"strut": {"cell": CELL | {"noise_std_n": 1e-30}}}, KALMAN, "noise_std_n: 1e-30"),
        ({"strut": {"a": CELL, "b": dict(CELL)}}, KALMAN, "strut.b: BENCH_AUXILIARY.LOAD_CELL"),
        ({"strut": {"a": WIRE | {"message": "BENCH_MEASUREMENT"}}}, KALMAN, "is a height or"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(tmp_path, further, observer, says):
    with pytest.raises(InputError) as refused:
        configured(tmp_path, further, observer)
    text = str(refused.value)
    assert says in text
    assert "\n" not in text


def test_a_sensor_of_another_unit_is_refused(tmp_path):
    wrong = CELL | {"message": "BENCH_MEASUREMENT_2", "signal": "HEIGHT"}
    ready = configured(tmp_path, {"strut": {"cell": wrong}})
    with pytest.raises(Exception, match="HEIGHT"):
        check(ready)
