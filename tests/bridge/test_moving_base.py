"""A bench whose base is moved, over virtual CAN: against the same bench driven by a force."""

from pathlib import Path

import numpy as np
import pytest

from dart_model.spec import MODELS, dump_model, parse_model
from rig.formats.run_arrays import open_run
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan
from rig.run.live import with_bench
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.schema import BenchConfig
from rig.simulated_bench.trajectory import simulate

DURATION_S, SETTLED_S = 12.0, 1.0
STRUTS = ("tyre", "suspension")


def force_errors(plan, bench, folder):
    """RMS error of each strut's published force in N, and share of the 95 % intervals that hold."""
    with_bench(plan, bench, folder, lockstep=True)
    run = open_run(folder)
    truth = simulate(bench, round(DURATION_S * 1e9), 1_000_000)
    names = [strut.name for strut in bench.struts]
    errors, shares = [], []
    for strut in STRUTS:
        column = names.index(strut)
        true_n = np.interp(run.t_s, truth.t_ns * 1e-9, truth.strut_force_n[:, column])
        counts = run.t_s > SETTLED_S
        assert np.all(run.columns[f"{strut}.valid"][counts] > 0.0)
        error_n = (run.columns[f"{strut}.force_n"] - true_n)[counts]
        errors.append(float(np.sqrt(np.mean(error_n**2))))
        shares.append(
            float(np.mean(np.abs(error_n) < 1.96 * run.columns[f"{strut}.force_std_n"][counts]))
        )
    return np.array(errors), shares


def on_a_road():
    plan = load_plan(CONFIGS / "quarter_car_road.yaml", duration_s=DURATION_S)
    return plan, load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")


def driven_by_force(folder: Path):
    """The same quarter car on a platform that stands still, with a force on its body."""
    config = (CONFIGS / "quarter_car_road.yaml").read_text()
    road = "  inputs:\n    road: {message: BENCH_ROAD, signal: ROAD, settling_s: 0.001}\n"
    force = "  applied_force: {message: BENCH_MEASUREMENT, signal: APPLIED_FORCE}\n"
    assert road in config
    config = config.replace(road, force).replace("model: quarter_car_road", "model: still.yaml")
    (folder / "still_rig.yaml").write_text(config)
    text = (MODELS / "quarter_car_road.yaml").read_text()
    body = next(line for line in text.splitlines() if "name: platform" in line)
    text = text.replace(body + "\n", "").replace("[platform, wheel]", "[world, wheel]")
    text = text.replace("inputs:\n  road: {motion_of: platform, axis: [0, 0, 1]}\n", "")
    (folder / "still.yaml").write_text(dump_model(parse_model(text, "still")))
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml").model_dump(mode="python")
    bench["masses"], bench["struts"] = bench["masses"][1:], bench["struts"][1:]
    bench["struts"][0]["between"] = ("world", "wheel")
    bench["prescribed_motion"] = None
    multisine = {"kind": "multisine", "low_hz": 0.5, "high_hz": 12.0, "lines": 60, "seed": 1}
    bench["applied_force"] = {"body": "body", "components": [{**multisine, "rms_n": 1500.0}]}
    bench["transmissions"] = bench["transmissions"][:2]
    bench["transmissions"][0]["applied_force"] = {"signal": "APPLIED_FORCE"}
    return (
        load_plan(folder / "still_rig.yaml", duration_s=DURATION_S),
        BenchConfig.model_validate(bench),
    )


@pytest.mark.slow
def test_a_moving_base_costs_less_than_a_third_of_the_force_error(tmp_path):
    moved, shares = force_errors(*on_a_road(), tmp_path / "moved")
    still, _ = force_errors(*driven_by_force(tmp_path), tmp_path / "still")
    assert np.all(moved < 1.3 * still)
    assert min(shares) > 0.9
