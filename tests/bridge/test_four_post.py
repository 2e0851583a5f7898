"""A car on four posts over virtual CAN: each suspension as if it stood alone."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from dart_model.spec import parse_model
from rig.closed_loop.strut_response import linearise_at
from rig.formats.run_arrays import open_run
from rig.plan.build import build_plant
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.bridge.test_full_car import ALONE
from tests.bridge.test_larger_systems import follow, wrong

DURATION_S, SETTLED_S, SHARE, NOISE_M = 8.0, 1.0, 0.7, 5e-6
CORNERS = ("fl", "fr", "rl", "rr")
SUSPENSIONS = [f"suspension_{corner}" for corner in CORNERS]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture(scope="module")
def car(tmp_path_factory):
    """The plan, a run whose suspensions are 30 % too weak in the model, and the bench's truth."""
    plan = load_plan(CONFIGS / "four_post.yaml", duration_s=DURATION_S)
    bench = load_bench_config(CONFIGS / "four_post_bench.yaml")
    model = wrong(plan.model, SHARE, SUSPENSIONS).spec
    folder = tmp_path_factory.mktemp("posts") / "run"
    with_bench(plan.with_model(model), bench, folder, lockstep=True)
    truth = simulate(bench, round(DURATION_S * 1e9), 500_000)
    columns = {strut.name: index for index, strut in enumerate(bench.struts)}
    return plan, open_run(folder), truth, columns


@pytest.fixture(scope="module")
def mobilities_per_kg(car):
    plan, _, truth, columns = car
    heights = [
        float(truth.height_m[0, columns[name]]) if name in SUSPENSIONS else np.nan
        for name in plan.strut_names
    ]
    responses = linearise_at(build_plant(plan), heights).responses()
    return dict(zip(plan.strut_names, [it.mobility_per_kg for it in responses], strict=True))


def errors(car, name):
    """Errors of a strut's published force, their stated deviations, and the force's deviation."""
    _, run, truth, columns = car
    counts = run.t_s > SETTLED_S
    true_n = np.interp(run.t_s, truth.t_ns * 1e-9, truth.strut_force_n[:, columns[name]])[counts]
    found_n = run.columns[f"{name}.force_n"][counts]
    return found_n - true_n, run.columns[f"{name}.force_std_n"][counts], float(np.std(true_n))


def error_alone(car, name, mass_kg):
    """RMS error of the same strut on a bench of its own that moves it as the car does."""
    plan, _, truth, columns = car
    strut = plan.model.struts[plan.strut_names.index(name)]
    text = ALONE.format(
        mass_kg=mass_kg,
        free_length_m=strut.free_length_m,
        stiffness=strut.stiffness_n_per_m,
        damping=strut.damping_n_s_per_m,
        effect="",
    )
    rate_hz = round(1e9 / plan.period_ns)
    t_s, true_s = np.arange(round(DURATION_S * rate_hz)) / rate_hz, truth.t_ns * 1e-9
    height = CubicSpline(true_s, truth.height_m[:, columns[name]])
    force_n = CubicSpline(true_s, truth.strut_force_n[:, columns[name]])(t_s)
    applied_n = mass_kg * (height(t_s, 2) + plan.model.gravity_m_per_s2) - force_n
    seen = height(t_s) + NOISE_M * np.random.default_rng(1).standard_normal(len(t_s))
    observer = plan.observers[plan.strut_names.index(name)]
    found = follow(
        wrong(parse_model(text, "alone"), SHARE), seen[:, None], applied_n, (observer,), rate_hz
    )
    return rms((found[:, 0] - force_n)[t_s > SETTLED_S])


@pytest.mark.slow
@pytest.mark.parametrize("name", SUSPENSIONS)
def test_each_damper_of_a_car_on_posts_is_estimated_as_if_it_stood_alone(
    car, mobilities_per_kg, name
):
    missed, std_n, deviation_n = errors(car, name)
    alone_n = error_alone(car, name, 1.0 / mobilities_per_kg[name])
    assert rms(missed) < 1.1 * alone_n
    assert rms(missed) < 0.06 * deviation_n
    assert np.mean(np.abs(missed) < 1.96 * std_n) > 0.9
    run = car[1]
    assert np.all(run.columns[f"{name}.valid"][run.t_s > SETTLED_S] > 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("corner", CORNERS)
def test_a_measured_tyre_follows_its_law_where_the_bench_is(car, corner):
    missed, _, deviation_n = errors(car, f"tyre_{corner}")
    assert rms(missed) < 0.01 * deviation_n
    _, run, truth, columns = car
    counts = run.t_s > SETTLED_S
    heights = truth.height_m[:, columns[f"tyre_{corner}"]]
    true_m = np.interp(run.t_s, truth.t_ns * 1e-9, heights)[counts]
    found_m = run.columns[f"tyre_{corner}.height_m"][counts]
    assert rms(found_m - true_m) < 0.01 * np.std(true_m)
