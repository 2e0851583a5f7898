"""Models evaluated on runs: a right one at the noise floor, a wrong one as its diagnosis has it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from can_dbc.errors import InputError
from dart_model.spec import dump_model
from rig.cli.main import app
from rig.diagnosis.diagnose import diagnose, first_fits
from rig.diagnosis.evaluate import evaluate_model
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.problem import ComparedModels
from rig.recordings.gaps import are_timed, find_gaps
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from tests.diagnosis import little_bench, little_dyno
from tests.diagnosis.driven import driven_by
from tests.diagnosis.test_derivatives import model_with

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


def test_what_a_wrong_model_errs_by_is_no_noise_beside_a_better_one():
    """The tone at 30 Hz that the bench lacks is too fast for a smooth residual."""
    run = little_bench.run(little_bench.Nothing(), seed=3)
    problem = build_without_delays(little_bench.model(), [run], 32, None)
    right = first_fits(problem)[0].model
    wrong = model_with(problem, {(0, "periodic_force"): np.array([3.0, 30.0, 0.0])}, {})

    def floor_m(*models):
        return problem.evaluate(0, ComparedModels(*models), 0.0, blocks=False).floor.height_rmse_m

    assert floor_m(wrong, wrong, wrong) > 1.05 * floor_m(right, right, right)
    assert floor_m(right, right, wrong) < 1.01 * floor_m(right, right, right)


@pytest.mark.slow
def test_the_error_is_that_before_the_correction_in_a_diagnosis():
    runs = [little_bench.run(little_bench.Nothing(), seed=seed) for seed in (1, 2)]
    spec = little_bench.model(mass=HEAVY)
    result = diagnose(spec, runs[:1], runs[1:])
    found = result.diagnosis
    [series] = result.fitted
    linear_n = -spec.struts[0].damping_n_s_per_m * series.velocity_m_per_s
    assert np.allclose(series.damper_before_n, linear_n)
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


def test_gaps_of_the_applied_force_are_reported(tmp_path):
    run = little_bench.run(little_bench.Nothing(), duration_s=6.0)
    table = np.column_stack([run.t_s, run.heights_m[:, 0], run.applied_force_n])
    kept = np.ones(len(table), dtype=bool)
    kept[400:425] = kept[800] = False  # 25 of 250 a second, and one by itself
    header = "t_s,height_m,applied_force_n"
    for name, rows in (("whole", table), ("gap", table[kept])):
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.9g", ",", header=header, comments="")
    (tmp_path / "right.yaml").write_text(dump_model(little_bench.model()))
    arguments = [str(tmp_path / "whole.csv"), str(tmp_path / "gap.csv")]
    arguments += ["--model", str(tmp_path / "right.yaml")]
    printed = CliRunner().invoke(app, ["evaluate", *arguments]).output
    assert "gap.csv: what drives the bench is missing in 1 gap" in " ".join(printed.split())
    assert "up to 0.1 s). In 1 of them it changes too much" in " ".join(printed.split())
    assert "whole.csv: what drives" not in printed
    runs = [read_recording(Path(path)) for path in arguments[:2]]
    notes = diagnose(little_bench.model(), runs[:1], runs[1:]).diagnosis.notes
    assert runs[1].gaps is not None
    assert runs[1].gaps.report("gap.csv") in notes


@given(st.lists(st.integers(1, 6), min_size=20, max_size=60))
def test_gaps_are_where_two_samples_are_missing(steps):
    steps = [1] * (len(steps) + 3) + steps
    t_s = np.cumsum(steps) * 0.002
    gaps = find_gaps(t_s, np.sin(t_s))
    long = [step for step in steps[1:] if step >= 3]
    assert (gaps is None) == (not long)
    if gaps is not None:
        lengths = [end - begin for begin, end in gaps.intervals_s]
        assert np.allclose(lengths, np.multiply(long, 0.002))


@pytest.mark.parametrize("frequency_hz", [1.0, 5.0])
def test_a_gap_is_long_where_the_force_changes_by_more_than_a_third(frequency_hz):
    t_s = np.delete(np.arange(0.0, 20.0, 0.002), slice(3000, 3002))
    gaps = find_gaps(t_s, np.sin(2.0 * np.pi * frequency_hz * t_s))
    # RMS change over L of a sine is 2 sin(pi f L) of its RMS.
    longest_s = np.arcsin(0.15) / (np.pi * frequency_hz)
    assert gaps is not None
    # A whole number of samples, of lengths that grow by a tenth.
    assert 0.9 * longest_s - 0.002 <= gaps.longest_interpolated_s <= 1.001 * longest_s


def with_gap(run, *gaps_s):
    """The recording without the samples within some stretches of time."""
    kept = np.ones(len(run.t_s), dtype=bool)
    for begin_s, end_s in gaps_s:
        kept &= (run.t_s <= begin_s) | (run.t_s >= end_s)
    force_n = run.applied_force_n[kept]
    return replace(
        run,
        t_s=run.t_s[kept],
        heights_m=run.heights_m[kept],
        inputs=driven_by(force_n, find_gaps(run.t_s[kept], force_n)),
    )


@pytest.mark.slow
def test_a_right_model_is_at_the_noise_floor_beside_long_gaps():
    whole = little_bench.run(little_bench.Nothing(), seed=3)
    run = with_gap(whole, (3.0, 3.2), (3.5, 3.55), (8.0, 8.4))
    [right] = evaluate_model(little_bench.model(), [run])
    [heavy] = evaluate_model(little_bench.model(mass=HEAVY), [run])
    [heavy_on_whole] = evaluate_model(little_bench.model(mass=HEAVY), [whole])
    assert right.figures.height_rmse_m.after < 1.2 * right.floor.height_rmse_m
    ratio = heavy.figures.height_rmse_m.after / heavy_on_whole.figures.height_rmse_m.after
    assert ratio == pytest.approx(1.0, abs=0.25)
    [series] = right.series
    assert np.all(np.diff(series.t_s) > 0.0)
    assert not np.any((series.t_s > 3.0) & (series.t_s < 3.2) & np.isfinite(series.measured))


@pytest.mark.slow
def test_an_effect_is_found_beside_long_gaps():
    runs = [
        with_gap(little_bench.run(little_bench.Nothing(), seed=seed), (4.0, 4.3), (9.0, 9.1))
        for seed in (1, 2)
    ]
    found = diagnose(little_bench.model(mass=HEAVY), runs[:1], runs[1:]).diagnosis
    [mass] = [item for item in found.linear if item.parameter == "mass_kg"]
    assert mass.total.value == pytest.approx(little_bench.MASS, rel=2e-3)
    assert found.verdict == "explained"
    assert len(found.runs) == len(found.held_out.runs) == 1


def test_a_run_of_gaps_is_refused_with_what_they_are():
    whole = little_bench.run(little_bench.Nothing(), seed=3)
    begins_s = np.arange(0.3, whole.t_s[-1] - 0.1, 0.45)
    run = with_gap(whole, *((begin_s, begin_s + 0.1) for begin_s in begins_s))
    with pytest.raises(RecordingError, match=r"missing in \d+ gaps.* expected half"):
        evaluate_model(little_bench.model(), [run])


def test_of_a_burst_of_frames_the_last_one_is_timed():
    regular_ns = np.arange(0, 200, 2) * 1_000_000
    late_ns = np.concatenate([regular_ns[:50], 112_000_000 + np.arange(6) * 120_000])
    arrivals_ns = np.sort(np.concatenate([late_ns, regular_ns[57:]]))
    timed = are_timed(arrivals_ns)
    assert np.array_equal(np.flatnonzero(~timed), np.arange(50, 55))
    assert np.all(are_timed(regular_ns + np.random.default_rng(1).integers(0, 900_000, 100)))


def test_a_model_that_runs_away_leaves_the_others_evaluated(tmp_path):
    run = little_bench.run(little_bench.Nothing(), duration_s=6.0)
    table = np.column_stack([run.t_s, run.heights_m[:, 0], run.applied_force_n])
    path = tmp_path / "run.csv"
    np.savetxt(path, table, "%.9g", ",", header="t_s,height_m,applied_force_n", comments="")
    right = little_bench.model()
    (tmp_path / "right.yaml").write_text(dump_model(right))
    content = yaml.safe_load(dump_model(right))
    pushing = {"name": "linear_damping", "parameters": {"damping_n_s_per_m": -900.0}}
    content["struts"][0]["effects"] = [pushing]
    (tmp_path / "away.yaml").write_text(yaml.safe_dump(content))
    models = ["--model", str(tmp_path / "away.yaml"), "--model", str(tmp_path / "right.yaml")]
    found = CliRunner().invoke(app, ["evaluate", str(path), *models])
    assert "Free-run simulation of run.csv" in found.output
    assert isinstance(found.exception, InputError)
    assert "away.yaml: model" in str(found.exception)
    assert "runs away on run.csv" in str(found.exception)
