"""A planned excitation moves the bench as planned, and shows what one sine leaves open."""

import math

import numpy as np
import pytest

from dart_model.spec import MODELS, load_model
from rig.diagnosis.determinable import find_determinable
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.excitation import plan_excitation
from rig.recordings.recording import RecordingError
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.test_metamorphic import Friction


def one_sine(effect, seed=1):
    """A recording of one frequency and one amplitude."""
    return bench.run(effect, seed=seed, load=lambda t: 25.0 * math.sin(9.0 * t), duration_s=12.0)


def excited(effect, planned, seed):
    """A recording of the bench under a planned force."""

    def load_n(t):
        return float(np.interp(t, planned.t_s, planned.values))

    duration_s = float(planned.t_s[-1])
    return bench.run(effect, seed=seed, load=load_n, duration_s=duration_s)


def test_a_bench_without_effects_moves_as_planned():
    planned = plan_excitation(bench.model(), [one_sine(bench.Nothing())])
    run = excited(bench.Nothing(), planned, seed=2)
    expected_m = np.interp(run.t_s, planned.t_s, planned.heights_m)
    settled = run.t_s > 2.0
    error_m = np.abs(run.heights_m[settled, 0] - expected_m[settled]).max()
    assert error_m < 0.01 * np.ptp(planned.heights_m)


def test_the_stroke_stays_within_that_of_the_recordings():
    run = one_sine(bench.Nothing())
    planned = plan_excitation(bench.model(), [run])
    assert run.heights_m.min() < planned.heights_m.min() < planned.heights_m.max()
    assert planned.heights_m.max() < run.heights_m.max()


def test_what_one_sine_leaves_open_is_determined():
    run, model = one_sine(bench.Nothing()), bench.model()
    before = find_determinable(model, [run])
    after = find_determinable(model, [excited(bench.Nothing(), plan_excitation(model, [run]), 2)])
    assert any(it.alike or not it.is_determined for it in before.linear)
    assert all(it.is_determined for it in after.linear)
    forces = [{it.family: it.apart_n for it in found.families} for found in (before, after)]
    assert all(forces[1][name] < forces[0][name] for name in ("friction", "nonlinear_damping"))


@pytest.mark.slow
def test_the_planned_run_names_what_one_sine_does_not():
    rough = bench.model(damping=0.7 * bench.DAMPING, stiffness=1.1 * bench.STIFFNESS)
    first = one_sine(Friction())
    planned = plan_excitation(rough, [first])
    runs = [excited(Friction(), planned, seed) for seed in (2, 3)]
    found = diagnose(rough, [first, runs[0]], runs[1:]).diagnosis
    assert (found.verdict, [it.family for it in found.effects][:1]) == ("explained", ["friction"])


def test_a_dyno_gets_a_motion_that_is_no_faster_than_before():
    run = dyno.run(dyno.Nothing())
    planned = plan_excitation(dyno.model(), [run])
    assert planned.column == "height_m"
    top = np.abs(np.gradient(planned.values, planned.t_s)).max()
    assert top <= 1.01 * np.abs(np.gradient(run.heights_m[:, 0], run.t_s)).max()


def test_a_model_of_several_struts_is_refused():
    with pytest.raises(RecordingError, match="2 struts, expected one"):
        plan_excitation(load_model(MODELS / "quarter_car.yaml"), [])
