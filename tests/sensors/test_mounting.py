"""Zero, direction and tare of sensors, measured at rest and written into the configuration."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from rig.channels.channel import MeasuredSignal, Zero
from rig.cli.main import app
from rig.log.reader import read_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.recordings.run_folder import read_channel
from rig.sensors.mounting import Readings, describe_arrivals, find_tare, find_zero, summarise
from rig.simulated_bench.config import load_bench_config
from tests.run.test_runs import lockstep

NOISE_M, LENGTHS_M = 20e-6, (0.36, 0.30)
SENT = "HEIGHT : 12|24@1- (2E-007,0) [-1.6|1.6]"


def resting(length_m):
    """A dyno that moves by nanometres."""
    bench = load_bench_config(CONFIGS / "dyno_bench.yaml")
    (motion,) = bench.prescribed_motion
    (component,) = motion.components
    still = motion.model_copy(
        update={
            "mean_height_m": length_m,
            "components": (component.model_copy(update={"rms_m": 1e-9}),),
        }
    )
    fast, slow = bench.transmissions
    height = fast.height.model_copy(update={"noise_std_m": NOISE_M})
    fast = fast.model_copy(update={"height": height})
    return bench.model_copy(update={"prescribed_motion": (still,), "transmissions": (fast, slow)})


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs at rest, by the length of the strut."""
    folder = tmp_path_factory.mktemp("rest")
    return {
        length_m: lockstep(folder / f"{length_m}", "dyno", 1.0, resting(length_m))
        for length_m in LENGTHS_M
    }


def config(folder, height=SENT, unit="m"):
    text = DEFAULT_DATABASE.read_text()
    assert text.count(f'{SENT} "m"') == 1
    (folder / "my.dbc").write_text(text.replace(f'{SENT} "m"', f'{height} "{unit}"'))
    text = (CONFIGS / "dyno.yaml").read_text().replace("dyno_model.yaml", str(MODEL))
    path = folder / "my.yaml"
    path.write_text(f"dbc: my.dbc   # of the sensor\n{text}")
    return path


MODEL = CONFIGS / "dyno_model.yaml"


def zero(*arguments):
    return CliRunner().invoke(app, ["zero", *map(str, arguments)])


def test_two_lengths_give_zero_direction_and_scale(tmp_path, runs):
    path = config(tmp_path, "HEIGHT : 12|24@1- (-2E-004,450) [-2000|2000]", "mm")
    for length_m in LENGTHS_M:
        found = zero(path, "--length-m", length_m, "--run", runs[length_m], "--json")
        assert found.exit_code == 0, found.output
    read = json.loads(found.output)
    assert read["samples"] > 900
    assert read["std"] == pytest.approx(NOISE_M, rel=0.1)
    assert read["scale"] == pytest.approx(-1.0, abs=1e-4)
    entry = yaml.safe_load(path.read_text())["signals"]["height"]
    # 450 mm less the length, of which a mean of a thousand errs by a micrometre.
    assert entry["zero"]["at_m"] == 0.30
    assert entry["zero"]["reads"] == pytest.approx(0.150, abs=4e-6)
    assert entry["reversed"] is True
    assert "# of the sensor" in path.read_text()
    assert load_plan(path).config.signals.height["strut"].zero == Zero(**entry["zero"])


def test_the_first_length_says_that_the_direction_is_not_known(tmp_path, runs):
    path = config(tmp_path)
    found = zero(path, "--length-m", 0.36, "--run", runs[0.36])
    assert "does not show the direction" in found.output
    assert "reversed" not in yaml.safe_load(path.read_text())["signals"]["height"]
    again = zero(path, "--length-m", 0.30, "--run", runs[0.30])
    assert "Scale by the two lengths: 1.0000" in " ".join(again.output.split())
    assert "Next: `rig check" in again.output
    assert yaml.safe_load(path.read_text())["signals"]["height"]["reversed"] is False


def test_a_wrong_scale_is_refused_and_nothing_is_written(tmp_path, runs):
    path = config(tmp_path, "HEIGHT : 12|24@1- (2E-006,0) [-16|16]")
    assert zero(path, "--length-m", 0.36, "--run", runs[0.36]).exit_code == 0
    before = path.read_text()
    again = zero(path, "--length-m", 0.30, "--run", runs[0.30])
    assert isinstance(again.exception, InputError)
    assert "changed by -600 mm from a length of 360 mm to 300 mm, expected 60 mm" in str(
        again.exception
    )
    assert path.read_text() == before
    assert zero(path, "--length-m", 0.30, "--run", runs[0.30], "--remounted").exit_code == 0


def test_a_tare_is_what_the_cell_reads(tmp_path, runs):
    path = config(tmp_path)
    assert zero(path, "--tare", "load_cell_force", "--run", runs[0.30]).exit_code == 0
    entry = yaml.safe_load(path.read_text())["signals"]["load_cell_force"]
    # The bench's spring at its free length.
    assert entry["tare_n"] == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("is_reversed", [False, True])
def test_a_force_that_acts_is_no_tare(tmp_path, runs, is_reversed):
    path = config(tmp_path)
    mark = f"load_cell_force: {{reversed: {str(is_reversed).lower()}, "
    path.write_text(path.read_text().replace("load_cell_force: {", mark))
    found = zero(path, "--tare", "load_cell_force", "--force-n", 40, "--run", runs[0.30])
    assert found.exit_code == 0, found.output
    plan = load_plan(path)
    (cell,) = (it for it in plan.config.signals.bench.values() if it.tare_n is not None)
    # The cell reads nothing at present, which is 40 N.
    assert cell.calibration.apply(0.0) == pytest.approx(40.0, abs=0.1)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "expected one of --length-m and --tare"),
        (("--length-m", 0.3, "--force-n", 40), "--force-n 40: expected --tare CHANNEL with it"),
        (("--length-m", 0.3, "--tare", "load_cell_force"), "expected one of"),
        (("--tare", "temperature"), "--tare temperature: is no force"),
        (("--tare", "strut"), "--tare strut: is no force, expected --length-m"),
        (("--tare", "cell"), "cell: is not measured, expected one of strut, load_cell_force, temp"),
        (("--length-m", 0.3, "--strut", "axle"), "--strut axle: no height is measured"),
        (("--length-m", 0.3, "--run", "nowhere"), "nowhere"),
    ],
)
def test_a_wrong_call_is_one_line(tmp_path, arguments, expected):
    found = zero(config(tmp_path), *arguments)
    assert isinstance(found.exception, InputError)
    assert expected in str(found.exception)


def test_a_moving_strut_has_no_zero():
    t_s = np.linspace(0.0, 2.0, 2001)
    with pytest.raises(InputError, match=r"moves over 3.* mm in 2 s, expected at most 1 mm"):
        find_zero(
            summarise(t_s, 0.1 + 1.8e-3 * np.sin(9.0 * t_s)),
            0.4,
            MeasuredSignal(message="M", signal="S"),
            is_remounted=False,
        )


def test_noise_and_drift_are_those_about_a_line():
    rng = np.random.default_rng(3)
    t_s = np.linspace(5.0, 9.0, 4001)
    found = summarise(t_s, 0.2 + 1e-4 * (t_s - 7.0) + rng.normal(0.0, 1e-5, t_s.shape))
    assert found.std == pytest.approx(1e-5, rel=0.05)
    assert found.drift == pytest.approx(4e-4, rel=0.01)
    assert found.mean == pytest.approx(0.2, abs=1e-6)
    assert (found.samples, found.duration_s) == (4001, 4.0)


@pytest.mark.parametrize("change_m", [0.0, 0.004, -0.004])
def test_lengths_that_are_near_leave_the_direction_as_it_was(change_m):
    before = MeasuredSignal(message="M", signal="S", zero=Zero(reads=0.2, at_m=0.4), reversed=True)
    readings = Readings(100, 1.0, 0.2 + 0.5 * change_m, 0.0, 0.0, 0.0, 0.0)
    found = find_zero(readings, 0.4 + change_m, before, is_remounted=False)
    assert "reversed" not in found.keys
    assert found.scale is None


@pytest.mark.slow
def test_what_arrived_instead_of_a_reading(tmp_path, runs):
    path = config(tmp_path)
    silent = zero(path, "--length-m", 0.36, "--listen-s", 0.2)  # a virtual bus without a bench
    assert "signals.height.strut: no frames arrived at all" in str(silent.exception)
    content = yaml.safe_load(path.read_text())
    content["signals"]["height"] = {"message": "BENCH_MEASUREMENT_2", "signal": "HEIGHT"}
    path.write_text(yaml.safe_dump(content))
    other = zero(path, "--length-m", 0.36, "--run", runs[0.36])
    assert "frames arrived, but none of BENCH_MEASUREMENT_2" in str(other.exception)


def test_frames_that_come_more_often_than_the_dbc_states_are_named(tmp_path, runs):
    (height,) = load_plan(config(tmp_path)).heights
    run = read_run(runs[0.30])
    valid_s, _ = read_channel(run, height)
    every_ms = height.message.cycle_time_ns / 1e6
    message = replace(height.message, cycle_time_ns=10 * height.message.cycle_time_ns)
    text = describe_arrivals(run, replace(height, message=message), valid_s)
    assert f"arrives every {every_ms:g} ms, and the DBC states a cycle of {10 * every_ms:g}" in text
    assert "gaps or bursts" in describe_arrivals(run, height, valid_s)
    assert "of which 3 hold a valid" in describe_arrivals(run, height, valid_s[:3])


def test_a_force_that_changes_is_no_tare():
    t_s, rng = np.arange(1000) * 3e-3, np.random.default_rng(3)
    before = MeasuredSignal(message="M", signal="F")
    noise_n = rng.normal(0.0, 1.1, len(t_s))
    at_rest = summarise(t_s, 2.5 + noise_n)
    assert find_tare(at_rest, 0.0, before, 0.5).keys == {"tare_n": pytest.approx(2.5, abs=0.2)}
    coarse = summarise(t_s, np.where(t_s > 1.5, 2.5, 2.0))
    assert find_tare(coarse, 0.0, before, 0.5).keys["tare_n"] == pytest.approx(2.25, abs=0.01)
    moving = summarise(t_s, 100.0 * np.sin(6.0 * t_s) + noise_n)
    with pytest.raises(InputError, match="bring the bench to rest"):
        find_tare(moving, 0.0, before, 0.5)
    drifting = summarise(t_s, 30.0 * t_s + noise_n)
    with pytest.raises(InputError, match="drift 89"):
        find_tare(drifting, 0.0, before, 0.5)
