"""Virtual sensors over CAN: on the bus, in the log, added to a run that had none, and checked."""

import shutil
import sys

import numpy as np
import pytest
import yaml

from can_dbc.codec import decode_log
from can_dbc.database import DEFAULT_DATABASE, load_database
from can_dbc.errors import InputError
from can_dbc.units import Dimension
from rig import open_run
from rig.cli.main import main
from rig.log.file_names import ADDED_FILE
from rig.log.reader import read_run
from rig.pages.run_report import write_run_report
from rig.plan.build import build_bridge
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.plan.preflight_checks import Severity, check
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate

SENSORS = {
    "seat": {"acceleration_of": "body", "axis": [0, 0, 1]},
    "hub": {"position_of": "wheel"},
    "load": {"force_of": "tyre"},
    "power": {"power_of": "suspension"},
    "heat": {"energy_of": "suspension"},
}

KALMAN = {"kind": "kalman", "filter": {"bandwidth_hz": 18, "noise_std_m": 5.0e-6}}
PI = {"kind": "pi", "proportional_n_per_m": 4.0e5, "integral_n_per_m_s": 4.0e4}

OWN_MESSAGE = """
BO_ 901 SIM_2: 8 RIG
 SG_ SeatAcc : 0|16@1- (0.01,0) [-320|320] "m/s^2" BENCH
 SG_ TyreLoad : 16|16@1- (1,0) [-30000|30000] "N" BENCH
"""


def rig(monkeypatch, *arguments):
    """Exit code of a command."""
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    try:
        main()
    except SystemExit as ended:
        return int(ended.code or 0)
    return 0


def config(folder, sensors=SENSORS, **changes):
    given = yaml.safe_load((CONFIGS / "quarter_car_road.yaml").read_text())
    text = DEFAULT_DATABASE.read_text()
    at = text.index("\nBO_ ")
    (folder / "own.dbc").write_text(text[:at] + OWN_MESSAGE + text[at:])
    given |= {"dbc": "own.dbc", "virtual_sensors": sensors, **changes}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(given, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    folder = tmp_path_factory.mktemp("virtual")
    published = {
        "seat": {"message": "SIM_2", "signal": "SeatAcc"},
        "load": {"message": "SIM_2", "signal": "TyreLoad"},
    }
    plan = load_plan(config(folder, publish=published), duration_s=3.0)
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    return plan, with_bench(plan, bench, folder / "run", lockstep=True)


def test_the_log_has_a_column_of_each_that_belongs_to_the_others(ended):
    plan, of_run = ended
    run = open_run(of_run.folder)
    known = np.isfinite(run["seat.acceleration_m_per_s2"])
    assert known.mean() > 0.99
    masses = {body.name: body.mass_kg for body in plan.model.skeleton.bodies}
    force_n, stand_n = run["suspension.force_n"], run["load.force_n"]
    expected = force_n / masses["body"] - plan.model.gravity_m_per_s2
    np.testing.assert_allclose(run["seat.acceleration_m_per_s2"][known], expected[known], atol=1e-6)
    std = run["suspension.force_std_n"] / masses["body"]
    np.testing.assert_allclose(run["seat.acceleration_std_m_per_s2"][known], std[known])
    np.testing.assert_array_equal(stand_n[known], run["tyre.force_n"][known])
    road = run["motion_m:road"] + run["tyre.height_m"]
    assert np.nanstd(run["hub.position_m"][known] - road[known]) < 2e-4
    power_w = -force_n * run["suspension.velocity_m_per_s"]
    np.testing.assert_allclose(run["power.power_w"][known], power_w[known])
    sums = np.concatenate([[0.0], np.cumsum(0.5e-3 * (power_w[known][1:] + power_w[known][:-1]))])
    np.testing.assert_allclose(run["heat.energy_j"][known], sums, atol=1e-6)


def test_a_position_is_as_close_to_the_bench_as_its_deviation_says(ended):
    """The hub against the equations of the bench."""
    run = open_run(ended[1].folder)
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    truth = simulate(bench, round(3e9), 500_000)
    up_m = np.interp(run.t_s, truth.t_ns * 1e-9, truth.height_m[:, :2].sum(axis=1))
    counts = run.t_s > 1.5
    std_m = run["hub.position_std_m"][counts]
    missed = np.abs(run["hub.position_m"] - up_m)[counts]
    assert np.mean(missed < 1.96 * std_m) > 0.93
    assert np.sqrt(np.mean(std_m**2)) < 3.0 * np.sqrt(np.mean(missed**2))


@pytest.mark.parametrize(
    ("suspension", "tyre", "is_known"), [("pi", "pi", True), ("kalman", "none", False)]
)
def test_a_position_has_a_deviation_where_heights_determine_it(
    tmp_path, suspension, tyre, is_known
):
    """Whatever the observers are; the height of a tyre that none of them uses is not compared."""
    given = {"kalman": KALMAN, "pi": PI, "none": {"kind": "none"}}
    observers = {"tyre": {**given[tyre]}, "suspension": {**given[suspension]}}
    plan = load_plan(config(tmp_path, observers=observers), duration_s=0.5)
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    run = open_run(with_bench(plan, bench, tmp_path / "run", lockstep=True).folder)
    assert np.isfinite(run["hub.position_m"]).mean() > 0.9
    assert (
        np.isfinite(run["hub.position_std_m"]).mean() > 0.8
        if is_known
        else np.isnan(run["hub.position_std_m"]).all()
    )


def test_the_bus_has_what_the_log_has(ended):
    plan, of_run = ended
    run = read_run(of_run.folder)
    message = load_database(plan.database.path).message("SIM_2")
    end_ns = int(run.steps["t_ns"][-1].as_py())
    # The last one, behind the last tick, has the safe output.
    sent = [
        frame
        for frame, way in run.frames()
        if way == "T" and frame.arbitration_id == 901 and frame.t_ns <= end_ns
    ]
    data = np.array([list(frame.data) for frame in sent], np.uint8)
    names, kinds = ["SeatAcc", "TyreLoad"], [Dimension.ACCELERATION, Dimension.FORCE]
    decoded = decode_log(message, names, kinds, data)
    steps = {int(t): i for i, t in enumerate(run.steps["t_ns"].to_pylist())}
    at = [steps[frame.t_ns] for frame in sent]
    for name, column, step in (
        ("SeatAcc", "seat.acceleration_m_per_s2", 0.01), ("TyreLoad", "load.force_n", 1.0),
    ):  # fmt: skip
        logged = np.nan_to_num(run.steps[column].to_numpy()[at])
        assert np.max(np.abs(decoded[name] - logged)) <= 0.51 * step


@pytest.mark.slow
def test_a_replay_is_the_same_and_adds_what_the_run_did_not_have(
    ended, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "run"
    shutil.copytree(ended[1].folder, folder)
    assert replay(folder).different == 0
    assert rig(monkeypatch, "replay", folder, "--add", "rate: {velocity_of: body}") == 0
    run = open_run(folder)
    assert np.isfinite(run["rate.velocity_std_m_per_s"]).mean() > 0.9
    whole = run["suspension.velocity_m_per_s"] + run["tyre.velocity_m_per_s"]
    assert np.isfinite(run["rate.velocity_m_per_s"]).mean() > 0.99
    assert np.nanstd(run["rate.velocity_m_per_s"] - whole) < 1.0
    assert replay(folder).different == 0
    for text, message in (
        ("seat: {velocity_of: body}", "has a virtual sensor seat"),
        ("x: {speed: body}", "unknown key"),
        ("nowhere.yaml", "no such file"),
        ("x: {velocity_of: bode}", "did you mean body"),
    ):
        capsys.readouterr()
        assert rig(monkeypatch, "replay", folder, "--add", text) == 2
        assert message in capsys.readouterr().err
    (folder / ADDED_FILE).write_bytes(b"no stream")
    assert rig(monkeypatch, "replay", folder) == 2
    assert "delete it" in capsys.readouterr().err


def test_the_report_shows_them(ended, tmp_path):
    write_run_report(ended[1].folder, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "Virtual sensors" in text
    assert "seat: acceleration / (m/s²)" in text


def test_the_check_tells_which_are_corrected(tmp_path):
    found = {it.what: it for it in check(load_plan(config(tmp_path)))}
    assert all(found[f"virtual sensor {name}"].severity is Severity.OK for name in SENSORS)
    given = yaml.safe_load((CONFIGS / "quarter_car_road.yaml").read_text())
    del given["signals"]["height"]["tyre"]
    observers = given["observers"] | {"tyre": {"kind": "none"}}
    few = {"suspension": given["publish"]["suspension"]}
    path = config(tmp_path, signals=given["signals"], observers=observers, publish=few)
    found = {it.what: it for it in check(load_plan(path))}
    severities = {name: found[f"virtual sensor {name}"].severity for name in SENSORS}
    assert severities == {
        "hub": Severity.WARNING, "load": Severity.WARNING,
        # The only force on the body is that of the measured strut.
        "seat": Severity.OK, "power": Severity.OK, "heat": Severity.OK,
    }  # fmt: skip
    # Forces that PI finds have no deviation, and so has not what depends on them.
    pi = config(tmp_path, observers={"tyre": {**PI}, "suspension": {**PI}})
    found = {it.what: it.text for it in check(load_plan(pi))}
    without = {name for name in SENSORS if "kind kalman" in found[f"virtual sensor {name}"]}
    assert without == {"seat", "load", "power"}


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ({"tyre": {"force_of": "tyre"}}, "virtual_sensors.tyre: is the name of a strut or input"),
        ({"x": {"force_of": "tire"}}, "did you mean tyre"),
        ({"x": {"force_of": "tyre", "rate_of": "body"}}, "force_of and rate_of are given|rate_of"),
        ({"x": {"acceleration_of": "body", "axis": [0, 0, 0]}}, "a direction that is not zero"),
    ],
)
def test_wrong_sensors_are_refused_with_their_key(tmp_path, sensors, message):
    with pytest.raises(InputError, match=message):
        load_plan(config(tmp_path, sensors))


def test_what_the_model_does_not_have_is_refused_with_the_file(tmp_path):
    plan = load_plan(config(tmp_path, {"x": {"position_of": "bdy"}}))
    message = r"rig.yaml: virtual_sensors.x.position_of 'bdy': did you mean body"
    for refuse in (check, build_bridge):
        with pytest.raises(InputError, match=message):
            refuse(plan)


def test_a_dyno_has_those_of_its_strut_alone(tmp_path):
    path = tmp_path / "dyno.yaml"
    shutil.copy(CONFIGS / "dyno_model.yaml", tmp_path)
    given = yaml.safe_load((CONFIGS / "dyno.yaml").read_text())
    path.write_text(yaml.safe_dump(given | {"virtual_sensors": {"x": {"rate_of": "rod"}}}))
    with pytest.raises(InputError, match="with prescribed_motion no body moves"):
        load_plan(path)
