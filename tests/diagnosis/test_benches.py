"""The benches of these tests move as DART does where the model is complete, or has their effect."""

from itertools import pairwise

import numpy as np
import pytest

from dart_model.plant import DartPlant
from dart_model.spec import MODELS, EffectSpec, load_model
from rig.recordings.read import read_recording
from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.mechanisms import (
    ArmWithStop,
    QuarterCar,
    QuarterCarWithFriction,
    SprungGuide,
    TrailingArm,
)
from tests.diagnosis.similar import Scale, cut, mirrored, shifted
from tests.diagnosis.test_metamorphic import Asymmetry, DynoStop, Friction, Stop

SHORT_S = 3.0
CLOSE_M = 1e-6


def with_effect(model, name, strut="strut", **parameters):
    return model.with_effects(strut, [EffectSpec(name=name, parameters=parameters)])


def dart_heights(model, t_s, load_n, start_m, step_s=1e-3):
    """DART alone from rest, with the load between samples as it is."""
    plant = DartPlant(model)
    state = plant.init(start_m)
    rows = [[height for height, _ in state.struts]]
    for before, after in pairwise(t_s):
        count = max(1, round((after - before) / step_s))
        times = np.linspace(before, after, count + 1).tolist()
        for now, then in pairwise(times):
            loaded = plant.load(state, (0.0,) * len(start_m), (load_n(now),), 20.0)
            state = plant.step(loaded, then - now, (load_n(then),))
        rows.append([height for height, _ in state.struts])
    return np.array(rows)


def assert_moves_alike(model, t_s, heights_m, load_n, step_s=1e-3):
    heights_m = heights_m.reshape(len(t_s), -1)
    assert np.ptp(heights_m, axis=0).min() > 0.003
    dart_m = dart_heights(model, t_s, load_n, heights_m[0].tolist(), step_s)
    np.testing.assert_allclose(dart_m, heights_m, rtol=0.0, atol=CLOSE_M)


def test_the_little_bench():
    t_s, heights_m = bench.heights(bench.Nothing(), duration_s=SHORT_S)
    assert_moves_alike(bench.model(), t_s, heights_m, bench.load_n)


def test_the_little_bench_with_a_stop():
    t_s, heights_m = bench.heights(Stop(), duration_s=SHORT_S)
    assert heights_m.min() < 0.33
    model = with_effect(
        bench.model(),
        "bump_stop",
        contact_height_m=0.335,
        stiffness_n_per_m=2e4,
        damping_n_s_per_m=40.0,
    )
    assert_moves_alike(model, t_s, heights_m, bench.load_n, step_s=5e-5)


def test_the_little_bench_with_friction():
    t_s, heights_m = bench.heights(Friction(), duration_s=SHORT_S)
    model = with_effect(
        bench.model(), "coulomb_friction", coulomb_force_n=6.0, rounding_velocity_m_per_s=3e-3
    )
    assert_moves_alike(model, t_s, heights_m, bench.load_n, step_s=2e-4)


def test_the_mirrored_bench():
    record = bench.run(Asymmetry(), noise_m=0.0, duration_s=SHORT_S, gravity=0.0)
    other = mirrored(record, 0.45)
    model = with_effect(
        bench.model(gravity=0.0, free=0.5),
        "asymmetric_damping",
        compression_n_s_per_m=0.0,
        rebound_n_s_per_m=60.0,
    )
    _, true_m = bench.heights(Asymmetry(), duration_s=SHORT_S, gravity=0.0)
    assert_moves_alike(model, other.t_s, 0.9 - true_m, lambda t: -bench.load_n(t))
    np.testing.assert_allclose(other.heights_m[:, 0], 0.9 - true_m, rtol=0.0, atol=1.1e-6)
    np.testing.assert_array_equal(other.applied_force_n, -record.applied_force_n)


@pytest.mark.parametrize("scale", [Scale(3.0, 0.05, 2.0), Scale(0.3, 100.0, 0.5)])
def test_the_scaled_bench(scale):
    record = bench.run(bench.Nothing(), noise_m=0.0, duration_s=SHORT_S)
    other = scale.recording(record)
    _, true_m = bench.heights(bench.Nothing(), duration_s=SHORT_S)

    def load_n(t):
        return scale.force * bench.load_n(t / scale.time)

    assert_moves_alike(scale.model(bench), other.t_s, true_m * scale.length, load_n, 5e-4)
    np.testing.assert_allclose(
        other.applied_force_n, [load_n(t) for t in other.t_s.tolist()], rtol=1e-12
    )


@pytest.mark.parametrize("motion", [dyno.broad, dyno.later, dyno.resting])
def test_the_dynos_velocity_is_that_of_its_height(motion):
    step_s = 1e-5
    for t in np.arange(0.01, 11.0, 0.0237).tolist():
        ahead, behind = motion(t + step_s)[0], motion(t - step_s)[0]
        assert (ahead - behind) / (2.0 * step_s) == pytest.approx(motion(t)[1], abs=1e-4)


def test_the_little_dyno():
    record = dyno.run(
        DynoStop(), height_noise_m=0.0, force_noise_n=0.0, resolution_m=1e-12, duration_s=4.0
    )
    model = with_effect(
        dyno.model(),
        "bump_stop",
        contact_height_m=0.286,
        stiffness_n_per_m=1.5e5,
        damping_n_s_per_m=200.0,
    )
    plant = DartPlant(model)
    for t, (force_n,) in zip(record.t_s.tolist(), record.strut_forces_n.tolist(), strict=True):
        z, v = dyno.broad(t)
        state = plant.init([z], [v])
        (dart_n,) = plant.load(state, (0.0,), (0.0,), 20.0).forces_n
        assert dart_n == pytest.approx(force_n, abs=0.051)


@pytest.mark.slow
@pytest.mark.parametrize("later", [False, True])
def test_the_trailing_arm(later, tmp_path):
    arm = TrailingArm()
    load_n = arm.later_n if later else arm.load_n
    t_s, heights_m = arm.heights(SHORT_S, load_n=load_n)
    assert_moves_alike(arm.model(tmp_path), t_s, heights_m, load_n, step_s=5e-4)


@pytest.mark.slow
def test_the_trailing_arm_with_a_stop(tmp_path):
    arm = ArmWithStop()
    t_s, heights_m = arm.heights(1.6)
    assert heights_m.min() < arm.contact_m - 1e-3
    model = with_effect(
        arm.model(tmp_path),
        "bump_stop",
        contact_height_m=arm.contact_m,
        stiffness_n_per_m=arm.stop_n_per_m,
        damping_n_s_per_m=arm.stop_n_s_per_m,
    )
    assert_moves_alike(model, t_s, heights_m, arm.load_n, step_s=1e-4)


def test_the_quarter_car():
    car = QuarterCar()
    t_s, heights_m = car.heights(SHORT_S)
    assert_moves_alike(load_model(MODELS / "quarter_car.yaml"), t_s, heights_m, car.load_n)


def test_the_quarter_car_with_friction():
    car = QuarterCarWithFriction()
    t_s, heights_m = car.heights(SHORT_S)
    model = with_effect(
        load_model(MODELS / "quarter_car.yaml"),
        "coulomb_friction",
        "suspension",
        coulomb_force_n=car.friction_n,
        rounding_velocity_m_per_s=5e-3,
    )
    assert_moves_alike(model, t_s, heights_m, car.load_n, step_s=2e-4)


def test_the_quarter_cars_file(tmp_path):
    car = QuarterCar()
    record = read_recording(
        car.csv(tmp_path / "car.csv", duration_s=SHORT_S), ("tyre", "suspension")
    )
    t_s, heights_m = car.heights(SHORT_S)
    np.testing.assert_array_equal(record.t_s, t_s)
    np.testing.assert_allclose(record.heights_m, heights_m, rtol=0.0, atol=7e-5)


@pytest.mark.parametrize("suffix", ["skel", "urdf"])
def test_the_sprung_guide(suffix, tmp_path):
    guide = SprungGuide(suffix)
    t_s, heights_m = guide.heights(SHORT_S)
    assert_moves_alike(guide.model(tmp_path), t_s, heights_m, guide.load_n)


def test_parts_and_later_times():
    record = bench.run(bench.Nothing(), duration_s=2.0)
    first, second = cut(record)
    assert len(first.t_s) + len(second.t_s) == len(record.t_s)
    np.testing.assert_array_equal(
        np.concatenate([first.heights_m, second.heights_m]), record.heights_m
    )
    later = shifted(record, 1e4)
    np.testing.assert_allclose(np.diff(later.t_s), np.diff(record.t_s), atol=1e-11)
    np.testing.assert_array_equal(later.heights_m, record.heights_m)
