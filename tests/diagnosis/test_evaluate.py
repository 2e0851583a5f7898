"""Models evaluated on runs: a right one at the noise floor, a wrong one as its diagnosis has it."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from can_dbc.errors import InputError
from dart_model.spec import dump_model
from rig.cli.main import app
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.evaluate import evaluate_model
from tests.diagnosis import little_bench, little_dyno

HEAVY = 1.1 * little_bench.MASS
FORCE_NOISE_N = 1.0


def test_a_right_model_is_at_the_noise_floor_and_a_wrong_one_is_not():
    run = little_bench.run(little_bench.Nothing(), seed=3)
    [right] = evaluate_model(little_bench.model(), [run])
    [wrong] = evaluate_model(little_bench.model(mass=HEAVY), [run])
    floor_m = right.floor.height_rmse_m
    assert right.figures.height_rmse_m.after < 1.2 * floor_m
    assert right.figures.height_rmse_m.before == right.figures.height_rmse_m.after
    assert wrong.figures.height_rmse_m.after > 20.0 * floor_m


def test_the_error_is_that_before_the_correction_in_a_diagnosis():
    runs = [little_bench.run(little_bench.Nothing(), seed=seed) for seed in (1, 2)]
    spec = little_bench.model(mass=HEAVY)
    found = diagnose(spec, runs[:1], runs[1:]).diagnosis
    [alone] = evaluate_model(spec, runs[1:])
    before = found.held_out.height_rmse_m.before
    assert alone.figures.height_rmse_m.after == pytest.approx(before, rel=1e-3)


def test_along_a_prescribed_motion_the_load_cell_is_met():
    run = little_dyno.run(little_dyno.Nothing(), force_noise_n=FORCE_NOISE_N)
    [right] = evaluate_model(little_dyno.model(), [run])
    assert np.isnan(right.figures.height_rmse_m.after)
    assert right.figures.strut_force_rmse_n.after < 1.3 * FORCE_NOISE_N


def test_models_side_by_side_on_the_terminal_and_as_json(tmp_path):
    run = little_bench.run(little_bench.Nothing(), duration_s=6.0)
    table = np.column_stack([run.t_s, run.heights_m[:, 0], run.applied_force_n])
    path = tmp_path / "run.csv"
    np.savetxt(path, table, "%.9g", ",", header="t_s,height_m,applied_force_n", comments="")
    options = []
    for name, mass in (("right", little_bench.MASS), ("wrong", HEAVY)):
        (tmp_path / f"{name}.yaml").write_text(dump_model(little_bench.model(mass=mass)))
        options += ["--model", str(tmp_path / f"{name}.yaml")]
    done = CliRunner().invoke(app, ["evaluate", str(path), *options])
    assert done.exit_code == 0, done.output
    assert "Free-run simulation of run.csv" in done.output
    done = CliRunner().invoke(app, ["evaluate", str(path), *options, "--json"])
    right, wrong = json.loads(done.output)["evaluations"]
    assert right["height_rmse_m"] < 1.3 * right["noise_floor"]["height_rmse_m"]
    assert wrong["height_rmse_m"] > 10.0 * right["height_rmse_m"]
    refused = CliRunner().invoke(app, ["evaluate", str(tmp_path / "gone.csv"), *options])
    assert isinstance(refused.exception, InputError)
