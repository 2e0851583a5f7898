"""Runs of a dyno that would mislead are refused in one line; several runs; measured data."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dart_model.spec import MODELS, load_model
from rig.config import CONFIGS
from rig.identify.diagnose import diagnose
from rig.identify.imposed import dart_forces
from rig.identify.imposed_fit import run_of
from rig.identify.records import Record, RecordError
from rig.imports import import_table, load_mapping
from rig.scoreboard import dyno_start
from tests.identify import little_dyno as dyno
from tests.identify.little_dyno import Nothing
from tests.identify.test_imposed import Friction, Stiffness, Yielding

# Measured data lie beside the checkout, never in it.
MR_DAMPER = Path(__file__).resolve().parents[3] / "shared" / "data" / "mr_damper"


@pytest.fixture(scope="module")
def record() -> Record:
    return dyno.run(Stiffness())


def refused(record: Record, *others: Record) -> str:
    with pytest.raises(RecordError) as caught:
        diagnose(dyno.model(), [record], others)
    said = str(caught.value)
    assert "\n" not in said
    assert record.name in said
    return said


def test_runs_of_both_kinds_are_refused(record: Record) -> None:
    driven = replace(record, name="driven", applied_force_n=np.sin(9.0 * record.t_s))
    assert "expected runs of one kind" in refused(record, driven)


def test_a_cell_with_the_other_sign_is_refused(record: Record) -> None:
    assert record.strut_force_n is not None
    said = refused(replace(record, strut_force_n=-record.strut_force_n))
    assert "turn its sign" in said


def test_heights_in_millimetres_are_refused(record: Record) -> None:
    said = refused(replace(record, heights_m=record.heights_m * 1e3 - 300.0 + 0.3))
    assert "are the units m and N" in said


def test_a_run_that_hardly_moves_is_refused(record: Record) -> None:
    rng = np.random.default_rng(3)
    still = 0.3 + 1e-5 * rng.standard_normal(record.heights_m.shape)
    assert "widen the stroke" in refused(replace(record, heights_m=still))


def test_a_dead_cell_is_refused(record: Record) -> None:
    rng = np.random.default_rng(3)
    dead = 0.01 * rng.standard_normal(len(record.t_s))
    said = refused(replace(record, strut_force_n=dead))
    assert "strut_force_n" in said


def test_a_clipped_cell_is_refused(record: Record) -> None:
    assert record.strut_force_n is not None
    most = 0.7 * float(record.strut_force_n.max())
    clipped = np.minimum(record.strut_force_n, most)
    assert "not clipped" in refused(replace(record, strut_force_n=clipped))


def test_a_model_with_two_struts_is_refused(record: Record) -> None:
    with pytest.raises(RecordError, match="expected one on a straight guide"):
        diagnose(load_model(MODELS / "quarter_car.yaml"), [record])


def test_a_run_that_is_too_long_is_refused(record: Record) -> None:
    stretched = replace(record, t_s=record.t_s * 60.0)
    assert "cut it" in refused(stretched)


def test_missing_heights_and_uneven_times_change_little() -> None:
    whole = dyno.run(Stiffness())
    assert whole.strut_force_n is not None
    rng = np.random.default_rng(5)
    keep = np.sort(rng.choice(len(whole.t_s), int(0.85 * len(whole.t_s)), replace=False))
    heights = whole.heights_m[keep].copy()
    heights[rng.random(len(keep)) < 0.05] = np.nan
    gaps = Record("gaps", whole.t_s[keep], heights, None, whole.strut_force_n[keep])
    found = diagnose(dyno.model(), [gaps], [whole]).diagnosis
    assert [effect.name for effect in found.effects] == ["linear_stiffness"]
    estimate = found.effects[0].parameters["stiffness_n_per_m"]
    assert estimate.value == pytest.approx(900.0, rel=0.01)


def test_a_run_that_begins_within_a_loop_is_no_other_effect() -> None:
    train = dyno.run(Yielding(), state=[0.9])
    test = dyno.run(Yielding(), seed=2, state=[-0.8], motion=dyno.later)
    found = diagnose(dyno.model(), [train], [test]).diagnosis
    assert [effect.name for effect in found.effects] == ["bouc_wen"]
    force = found.held_out.strut_force_rmse_n
    assert force is not None
    assert force.after < 1.3 * found.noise_floor.residual_force_rmse_n


def test_two_runs_are_learnt_from_together_and_the_end_of_the_last_is_kept_back() -> None:
    runs = [dyno.run(Friction(), duration_s=6.0), dyno.run(Friction(), seed=2, motion=dyno.later)]
    result = diagnose(dyno.model(), runs)
    assert result.diagnosis.effects[0].family == "friction"
    assert result.diagnosis.held_out.source == "end of the run"
    assert [item.run for item in result.fitted] == ["dyno1", "dyno2"]


def test_the_force_of_the_catalogue_is_that_of_dart() -> None:
    record = dyno.run(Yielding(), duration_s=6.0)
    corrected = diagnose(dyno.model(), [record]).corrected
    run = run_of(record, corrected)
    apart = dart_forces(corrected, run) - run.given_n
    assert np.sqrt(np.mean(apart**2)) < 1e-6 * np.std(run.force_n)


def test_nothing_is_said_of_a_height_that_is_imposed() -> None:
    found = diagnose(dyno.model(), [dyno.run(Nothing())]).diagnosis
    assert np.isnan(found.held_out.height_rmse_m.before)
    assert np.isnan(found.held_out.runs[0].height_rmse_m.after)
    assert found.held_out.strut_force_rmse_n is not None
    assert {"inertia", "input_gain", "delay", "unmodelled_mode"} <= {
        rejected.family for rejected in found.rejected
    }


def measured(name: str, folder: Path, part: slice = slice(None)) -> Record:
    mapping = load_mapping(CONFIGS / "dyno_mapping.yaml")
    report = import_table(MR_DAMPER / f"{name}.txt", mapping, folder / f"{name}.csv")
    t_s, height_m, force_n = np.loadtxt(report.out, delimiter=",", skiprows=1)[part].T
    return Record(name, t_s - t_s[0], height_m[:, np.newaxis], None, force_n)


@pytest.mark.skipif(not MR_DAMPER.is_dir(), reason="no measured data beside the checkout")
def test_the_measured_damper_has_memory(tmp_path: Path) -> None:
    whole = measured("5mm3Hz1A", tmp_path)
    assert whole.strut_force_n is not None
    half = len(whole.t_s) // 2
    first, second = (
        replace(
            whole,
            name=name,
            t_s=whole.t_s[part],
            heights_m=whole.heights_m[part],
            strut_force_n=whole.strut_force_n[part],
        )
        for name, part in (("first", slice(0, half)), ("second", slice(half, None)))
    )
    found = diagnose(dyno_start([first], "mr_damper"), [first], [second]).diagnosis
    assert found.effects[0].family == "hysteresis"
    assert found.verdict == "partly_explained"
    force = found.held_out.strut_force_rmse_n
    assert force is not None
    assert second.strut_force_n is not None
    assert force.before > 0.25 * np.std(second.strut_force_n)
    assert force.after < 0.06 * np.std(second.strut_force_n)
