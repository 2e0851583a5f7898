"""A car on four posts over virtual CAN."""

import numpy as np
import pytest

from rig.formats.run_arrays import open_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from tests.bridge.test_larger_systems import wrong

DURATION_S, SETTLED_S = 8.0, 2.0
CORNERS = ("fl", "fr", "rl", "rr")


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_the_dampers_of_a_car_are_estimated_on_its_posts(tmp_path):
    """Tyres follow their laws; suspensions that are 30 % too weak in the model are observed."""
    plan = load_plan(CONFIGS / "four_post.yaml", duration_s=DURATION_S)
    bench = load_bench_config(CONFIGS / "four_post_bench.yaml")
    names = [f"suspension_{corner}" for corner in CORNERS]
    model = wrong(plan.model, 0.7, names).spec
    with_bench(plan.with_model(model), bench, tmp_path / "run", lockstep=True)
    run = open_run(tmp_path / "run")
    truth = simulate(bench, round(DURATION_S * 1e9), 1_000_000)
    counts = run.t_s > SETTLED_S
    for name in names:
        column = [strut.name for strut in bench.struts].index(name)
        true_n = np.interp(run.t_s, truth.t_ns * 1e-9, truth.strut_force_n[:, column])[counts]
        assert np.all(run.columns[f"{name}.valid"][counts] > 0.0)
        found_n = run.columns[f"{name}.force_n"][counts]
        assert rms(found_n - true_n) < 0.1 * np.std(true_n)
        # Measured and not observed: the tyre's height is logged, and corrects nothing.
        tyre = name.replace("suspension", "tyre")
        assert np.all(np.isfinite(run.columns[f"{tyre}.measured_height_m"][counts]))
        assert not run.columns[f"{tyre}.virtual_force_n"][counts].any()
