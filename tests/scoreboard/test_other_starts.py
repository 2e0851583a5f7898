"""Measured benches get the same answer from other numbers in the model file."""

from pathlib import Path

import pytest

from dart_model.spec import ModelSpec
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import Diagnosis
from rig.formats.mapping import load_mapping
from rig.plan.config import CONFIGS
from rig.recordings.read import read_recording
from tests.diagnosis.answers import overlap
from tests.scoreboard.parts import Part, imported
from tests.scoreboard.starts import dyno_start, one_body
from tests.scoreboard.test_scoreboard import SHARED

DAMPER, STAGE = SHARED / "mr_damper" / "5mm3Hz1A.txt", SHARED / "emps"


def with_other_numbers(model: ModelSpec, mass: float, of_strut: float) -> ModelSpec:
    """A model with a mass, and a spring and a damper, that differ by these shares."""
    (body,), (strut,) = model.skeleton.bodies, model.struts
    strut = strut.model_copy(
        update={
            "stiffness_n_per_m": strut.stiffness_n_per_m * (1.0 + of_strut),
            "damping_n_s_per_m": strut.damping_n_s_per_m * (1.0 - of_strut),
        }
    )
    body = body.model_copy(update={"mass_kg": body.mass_kg * (1.0 + mass)})
    skeleton = model.skeleton.model_copy(update={"bodies": (body,)})
    return model.model_copy(update={"skeleton": skeleton, "struts": (strut,)})


def assert_alike(one: Diagnosis, other: Diagnosis) -> None:
    """The same verdict and laws, and intervals that have something in common."""
    assert other.verdict == one.verdict
    assert [e.family for e in other.effects] == [e.family for e in one.effects]
    for before, after in zip(one.effects, other.effects, strict=True):
        if before.name == after.name:
            for name, estimate in before.parameters.items():
                assert overlap(estimate, after.parameters[name]), name
    assert other.held_out.residual_force_rmse_n.after == pytest.approx(
        one.held_out.residual_force_rmse_n.after, rel=0.05
    )


@pytest.mark.long
@pytest.mark.skipif(not DAMPER.is_file(), reason=f"measured data are not there: {DAMPER}")
@pytest.mark.parametrize("share", [1e-4, 0.03, 0.2])
def test_a_measured_damper(share: float, tmp_path: Path) -> None:
    mapping, half = load_mapping(CONFIGS / "dyno_mapping.yaml"), sum(1 for _ in DAMPER.open()) // 2
    parts = Part("first half", 0, half), Part("second half", half, 2 * half)
    learnt, test = (
        read_recording(imported(DAMPER, mapping, part, tmp_path / f"{i}.csv"))
        for i, part in enumerate(parts)
    )
    model = dyno_start([learnt], "damper")
    one = diagnose(model, [learnt], [test]).diagnosis
    other = diagnose(with_other_numbers(model, 0.0, share), [learnt], [test]).diagnosis
    assert_alike(one, other)


@pytest.mark.long
@pytest.mark.skipif(not STAGE.is_dir(), reason=f"measured data are not there: {STAGE}")
@pytest.mark.parametrize(("mass", "of_strut"), [(1e-4, 1e-4), (0.01, 0.03), (-0.02, 0.2)])
def test_a_measured_stage(mass: float, of_strut: float) -> None:
    model = one_body("stage", (95.1, 203.5, 0.0), 0.5)
    strut = [model.struts[0].name]
    learnt, test = (read_recording(STAGE / f"{name}.csv", strut) for name in ("pulses", "train"))
    one = diagnose(model, [learnt], [test]).diagnosis
    other = diagnose(with_other_numbers(model, mass, of_strut), [learnt], [test]).diagnosis
    assert_alike(one, other)
