"""Benches whose base is moved as measured: a quarter car on a road, by the simulated bench."""

from dataclasses import replace

import numpy as np
import pytest

from dart_model.spec import MODELS, load_model
from rig.channels.measured_quantities import APPLIED_FORCE, MOTION
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.problem.build import build_without_delays
from rig.diagnosis.problem.problem import first_starts, nominal, nominal_model
from rig.diagnosis.search.fit import fit
from rig.plan.config import CONFIGS
from rig.recordings.csv_file import read_csv
from rig.recordings.recording import RecordedInput, Recording, RecordingError
from rig.recordings.recording_checks import check_fits
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import UndeclaredEffect
from rig.simulated_bench.trajectory import simulate

NOISE_M = 1e-5


def recording(seed, *effects, duration_s=10.0, acceleration=False):
    """Heights and the road at 250 Hz, each with noise."""
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    (moved,) = bench.prescribed_motion
    components = tuple(it.model_copy(update={"seed": seed}) for it in moved.components)
    update = {"undeclared_effects": effects, "seed": seed}
    update["prescribed_motion"] = (moved.model_copy(update={"components": components}),)
    course = simulate(bench.model_copy(update=update), round(duration_s * 1e9), 4_000_000)
    rng = np.random.default_rng(seed)
    measured = course.height_m + NOISE_M * rng.standard_normal(course.height_m.shape)
    own = None
    if acceleration:
        own = np.gradient(course.velocity_m_per_s[:, 0], 4e-3) + 0.02 * rng.standard_normal(
            len(measured)
        )
    road = RecordedInput(MOTION, measured[:, 0], own)
    return Recording(f"run{seed}", course.t_ns * 1e-9, measured[:, 1:], {"road": road})


def rough(mass=1.0, stiffness=1.0, damping=1.0):
    """The model with another wheel, and another suspension."""
    spec = load_model(MODELS / "quarter_car_road.yaml")
    platform, wheel, body = spec.skeleton.bodies
    wheel = wheel.model_copy(update={"mass_kg": wheel.mass_kg * mass})
    tyre, suspension = spec.struts
    suspension = suspension.model_copy(
        update={
            "stiffness_n_per_m": suspension.stiffness_n_per_m * stiffness,
            "damping_n_s_per_m": suspension.damping_n_s_per_m * damping,
        }
    )
    skeleton = spec.skeleton.model_copy(update={"bodies": (platform, wheel, body)})
    return spec.model_copy(update={"skeleton": skeleton, "struts": (tyre, suspension)})


@pytest.mark.slow
def test_a_right_model_lacks_nothing_and_leaves_the_noise():
    found = diagnose(rough(), [recording(1)], [recording(2)]).diagnosis
    assert found.verdict == "nothing_missing"
    held_out = found.held_out.height_rmse_m
    assert held_out.after == pytest.approx(NOISE_M, rel=0.25)
    assert held_out.after < 1.1 * found.noise_floor.height_rmse_m
    assert any("The mass of body is taken as the model has it" in note for note in found.notes)


@pytest.mark.slow
def test_a_measured_acceleration_is_used():
    runs = [recording(seed, acceleration=True) for seed in (1, 2)]
    found = diagnose(rough(), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "nothing_missing"
    assert found.held_out.height_rmse_m.after < 1.25 * NOISE_M


@pytest.mark.slow
def test_friction_is_found_beside_a_rough_model():
    friction = UndeclaredEffect(
        name="friction", strut="suspension", parameters={"coulomb_force_n": 60.0}
    )
    model = rough(mass=1.05, stiffness=0.9, damping=1.2)
    found = diagnose(model, [recording(1, friction)], [recording(2, friction)]).diagnosis
    assert found.verdict == "explained"
    assert [(item.family, item.strut) for item in found.effects] == [("friction", "suspension")]
    assert found.effects[0].parameters["coulomb_force_n"].value == pytest.approx(60.0, rel=0.02)
    linear = {(item.strut, item.parameter): item.total.value for item in found.linear}
    assert linear["suspension", "stiffness_n_per_m"] == pytest.approx(2e4, rel=2e-3)
    assert linear["suspension", "damping_n_s_per_m"] == pytest.approx(1500.0, rel=5e-3)
    assert linear["tyre", "mass_kg"] == pytest.approx(40.0, rel=5e-3)
    assert ("suspension", "mass_kg") not in linear


def test_inputs_of_a_csv_are_those_of_the_model(tmp_path):
    run = recording(3, duration_s=2.0, acceleration=True)
    road = run.inputs["road"]
    header = "t_s,height_m:tyre,height_m:suspension,motion_m:road,acceleration_m_per_s2:road"
    columns = (run.t_s, *run.heights_m.T, road.values, road.acceleration_m_per_s2)
    file = tmp_path / "road.csv"
    np.savetxt(file, np.column_stack(columns), "%.12g", ",", header=header, comments="")
    read = read_csv(file, ["tyre", "suspension"])
    assert read.inputs["road"].quantity is MOTION
    np.testing.assert_allclose(read.inputs["road"].values, road.values, rtol=1e-11)
    check_fits(read, rough())
    file.write_text(file.read_text().replace(":road", ":street"))
    other = read_csv(file, ["tyre", "suspension"])
    with pytest.raises(RecordingError, match="expected a column motion_m:road, because model"):
        check_fits(other, rough())
    with pytest.raises(RecordingError, match="expected a column applied_force_n, because model"):
        check_fits(other, load_model(MODELS / "quarter_car.yaml"))


def with_gain(run, strut, gain):
    """A recording whose height of a strut, by index, shows too much or too little."""
    heights_m = run.heights_m.copy()
    own = heights_m[:, strut]
    heights_m[:, strut] = own.mean() + gain * (own - own.mean())
    return replace(run, heights_m=heights_m)


def test_heights_are_read_with_a_gain_about_mid_stroke():
    """The residual of a right model is noise with the gain that was there."""
    run = with_gain(recording(1), 1, 1.03)
    learnt = build_without_delays(rough(), [run], 8, None)
    problem = replace(learnt, linear=(*learnt.linear, *learnt.height_gains))
    assert [p.channel for p in problem.height_gains] == ["height_m:tyre", "height_m:suspension"]
    first = nominal_model(problem, first_starts(problem, nominal(problem)))
    nothing_free = fit(problem, first, np.zeros(len(problem.linear), dtype=np.bool_))

    def mean_square(gain):
        linear = first.parts.linear.copy()
        linear[-1] = gain - 1.0
        # The zero of the sensor is not known: what its gain is about is a preload.
        free = np.array([p.kind == "preload" for p in problem.linear])
        return fit(problem, nothing_free.model.with_linear(linear), free).mean_square

    assert mean_square(1.03) < 1.3
    assert mean_square(1.0) > 30.0 * mean_square(1.03)


def test_no_gain_is_corrected_where_a_force_sets_the_scale():
    heights, t_s = recording(1).heights_m, recording(1).t_s
    drive = RecordedInput(APPLIED_FORCE, 50.0 * np.sin(7.0 * t_s))
    spec = load_model(MODELS / "quarter_car.yaml")
    run = Recording("driven", t_s, heights, {"applied_force": drive})
    assert build_without_delays(spec, [run], 8, None).height_gains == ()


@pytest.mark.slow
@pytest.mark.parametrize(("strut", "gain"), [(0, 0.975), (1, 1.02)])
def test_a_height_with_a_wrong_gain_is_found_beside_friction(strut, gain):
    friction = UndeclaredEffect(
        name="friction", strut="suspension", parameters={"coulomb_force_n": 60.0}
    )
    runs = [with_gain(recording(seed, friction), strut, gain) for seed in (1, 2)]
    found = diagnose(rough(mass=1.05, stiffness=0.9, damping=1.2), runs[:1], runs[1:]).diagnosis
    assert found.verdict == "explained"
    shown = {item.channel: item.total for item in found.channels if item.parameter == "gain"}
    total = shown[f"height_m:{('tyre', 'suspension')[strut]}"]
    assert total.value == pytest.approx(gain, abs=5e-4)
    assert total.low < gain < total.high
    families = {item.family for item in found.effects} - {"input_gain"}
    assert families == {"friction"}
    assert any("correct its scaling" in note for note in found.notes)
