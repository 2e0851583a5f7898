"""`rig tune` on runs of a simulated bench: noise, latency and gains against what is known."""

import json
import sys

import numpy as np
import pytest
import yaml

from can_dbc.database import DEFAULT_DATABASE
from can_dbc.errors import InputError
from dart_model.plant import DartPlant
from dart_model.spec import MODELS, dump_model, parse_model
from rig.cli.main import main
from rig.closed_loop.loop import SampleTiming
from rig.closed_loop.poles import OperatingPoint, least_damping
from rig.closed_loop.strut_response import linearise_at
from rig.formats.run_arrays import open_run
from rig.observers.error_filter import ErrorFilter
from rig.observers.kalman import KalmanObserver
from rig.plan.config import CONFIGS
from rig.plan.load import load_plan, plan_of_run
from rig.run.live import with_bench
from rig.run.replay import replay
from rig.simulated_bench.config import load_bench_config
from rig.simulated_bench.trajectory import simulate
from rig.tuning.expectation import FollowedStretch, expectation_from_noise, part_by_late_force
from rig.tuning.gains import LEAST_IN_MOTION, Aim, TuningProblem, tune_observer
from rig.tuning.tune import StatedExpectation, tune, write_config
from tests.bridge.test_larger_systems import wrong

STEP_M = 15e-6
NOISE_M = 20e-6
SINES = ((60.0, 8.0), (50.0, 19.3), (40.0, 37.7))


def bench(folder, latency_ns=0, sines=SINES, force_latency_ns=0, effects=()):
    """A run of 8 s, from a bench with a noisy height of coarse steps that comes late."""
    dbc = DEFAULT_DATABASE.read_text("utf-8")
    fine = "SG_ HEIGHT : 12|20@1- (2E-006,0) [-1.048576|1.048574]"
    (folder / "noisy.dbc").write_text(
        dbc.replace(fine, f"SG_ HEIGHT : 12|20@1- ({STEP_M},0) [-7|7]")
    )
    content = yaml.safe_load((CONFIGS / "reference_bench.yaml").read_text())
    height = {"signal": "HEIGHT", "strut": "strut", "noise_std_m": NOISE_M}
    content["transmissions"] = [
        {"message": "BENCH_MEASUREMENT", "latency_ns": latency_ns, "height": height},
        {
            "message": "BENCH_MEASUREMENT_2",
            "latency_ns": force_latency_ns,
            "applied_force": {"signal": "APPLIED_FORCE"},
        },
    ]
    content["applied_force"]["components"] = [
        {"kind": "sine", "amplitude_n": n, "angular_frequency_rad_per_s": w} for n, w in sines
    ]
    content["undeclared_effects"] = list(effects)
    (folder / "bench.yaml").write_text(yaml.safe_dump(content))
    config = yaml.safe_load((CONFIGS / "reference.yaml").read_text())
    del config["timing"]
    follower = {"bandwidth_hz": 16.0, "noise_std_m": 1e-5}
    config |= {
        "dbc": "noisy.dbc",
        "signals": {
            "height": {"message": "BENCH_MEASUREMENT", "signal": "HEIGHT"},
            "applied_force": {"message": "BENCH_MEASUREMENT_2", "signal": "APPLIED_FORCE"},
        },
        "observers": {"strut": {"kind": "kalman", "filter": follower}},
        "publish": {"force": {"message": "RIG_ESTIMATE", "signal": "SPRING_DAMPER_FORCE"}},
    }
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    ready = load_plan(folder / "rig.yaml", duration_s=8.0)
    made = load_bench_config(folder / "bench.yaml")
    with_bench(ready, made, folder / "run", lockstep=True)
    return folder


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    return bench(tmp_path_factory.mktemp("late"), latency_ns=2_300_000)


def tuned(folder, kind="kalman", source=None):
    ready = load_plan(folder / "rig.yaml")
    [found] = tune(ready, source or folder / "run", kind, Aim(), lambda _what, _share: None)
    return ready, found


@pytest.mark.slow
def test_noise_latency_and_gains_come_from_a_run(late):
    ready, found = tuned(late)
    # The sensor's noise and the rounding of its steps.
    assert found.expectation.noise_std_m == pytest.approx(
        np.hypot(NOISE_M, STEP_M / 12**0.5), rel=0.03
    )
    assert found.latency.delay_s == pytest.approx(2.3e-3, abs=5e-5)
    assert found.latency.low_s < found.delay_s < found.latency.high_s
    assert found.tuned.expected.damping_ratio > 0.1
    assert found.tuned.gain_margin > 1.09
    path = late / "tuned.yaml"
    write_config(ready, [found], path)
    made = load_plan(path).config
    assert made.observers["strut"].filter.bandwidth_hz == found.tuned.observer.filter.bandwidth_hz
    assert made.signals.height["strut"].delay_s == found.delay_s
    assert made.supervision.stale_after_s == pytest.approx(0.01 + found.delay_s)
    with pytest.raises(InputError, match="File exists"):
        write_config(ready, [found], path)
    with pytest.raises(InputError, match="expected a file in the folder of"):
        write_config(ready, [found], late / "run" / "tuned.yaml")


@pytest.mark.slow
def test_an_applied_force_that_arrives_late_is_reported(tmp_path, capsys, monkeypatch):
    folder = bench(tmp_path, force_latency_ns=4_000_000)
    _, found = tuned(folder)
    assert found.delay_s == 0.0
    assert found.latency.delay_s == pytest.approx(-4e-3, abs=4e-4)
    assert rig(monkeypatch, "tune", folder / "rig.yaml", "--run", folder / "run") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "The applied force is 3.9" in shown or "The applied force is 4" in shown


@pytest.mark.slow
def test_dry_friction_is_not_taken_for_a_delay_of_the_applied_force(tmp_path):
    """Its hysteresis depends on the displacement, as the rate of the force seems to."""
    parameters = {"coulomb_force_n": 12.0, "presliding_m": 2e-4}
    law = {"name": "friction", "strut": "strut", "parameters": parameters}
    _, found = tuned(bench(tmp_path, effects=[law]))
    assert found.latency.low_s < 0.0 < found.latency.high_s
    assert found.latency.std_s < 0.15e-3


@pytest.mark.slow
def test_another_model_is_tuned_with_the_frames_of_a_run(late):
    """A run with the old model is enough: its frames are followed again with the new one."""
    ready, before = tuned(late)
    strut = ready.model.struts[0].model_copy(update={"damping_n_s_per_m": 63.0})
    nearer = ready.with_model(ready.model.model_copy(update={"struts": (strut,)}))
    [after] = tune(nearer, late / "run", "kalman", Aim(), lambda _what, _share: None)
    own_n, other_n = (float(it.expectation.power_n2.sum()) ** 0.5 for it in (before, after))
    assert other_n < 0.8 * own_n
    assert after.expectation.noise_std_m == pytest.approx(before.expectation.noise_std_m, rel=0.02)


def test_a_tuned_loop_is_stable_beyond_the_knee_of_a_damper():
    """A slow observer that takes the damper's slope at rest for that in motion lets errors grow."""
    content = yaml.safe_load((MODELS / "reference.yaml").read_text())
    content["struts"][0] |= {"stiffness_n_per_m": 12_000.0, "damping_n_s_per_m": 800.0}
    digressive = {
        "lost_compression_n_s_per_m": 700.0,
        "compression_knee_m_per_s": 0.15,
        "added_rebound_n_s_per_m": 300.0,
        "lost_rebound_n_s_per_m": 1000.0,
        "rebound_knee_m_per_s": 0.2,
        "sharpness": 8.0,
    }
    content["struts"][0]["effects"] = [{"name": "valve_damping", "parameters": digressive}]
    plant = DartPlant(parse_model(yaml.safe_dump(content), "a test"))
    heights, fast = [0.5], OperatingPoint([0.5], 0.6)
    assumed = linearise_at(plant, heights)
    timing = SampleTiming(2_000_000)
    slow = KalmanObserver("kalman", ErrorFilter.within(5.0, 1e-5), 5000.0)

    def damping(observer, point):
        return least_damping(plant, (observer,), timing, assumed, [point])[0]

    assert damping(slow, OperatingPoint([0.5], 0.05)) > 0.1
    assert damping(slow, fast) < 0.0
    expectation = expectation_from_noise(1e-5, 5.0, 4.0)
    problem = TuningProblem(
        plant, (slow,), 0, assumed, heights, timing, expectation, 5000.0, [fast]
    )
    found = tune_observer(problem, "kalman", Aim())
    assert found.in_motion == pytest.approx(damping(found.observer, fast))
    assert found.in_motion > 0.9 * LEAST_IN_MOTION
    unaware = tune_observer(problem._replace(points=()), "kalman", Aim())
    assert damping(unaware.observer, fast) < 0.0


def test_a_late_force_leaves_its_rate_in_the_residual_force():
    t_s, late_s = np.arange(0.0, 5.0, 1e-3), 2e-3
    applied_n = 100.0 * np.sin(8.0 * np.pi * t_s)
    other_n = 30.0 * np.sin(18.0 * np.pi * t_s)
    residual_n = applied_n - 100.0 * np.sin(8.0 * np.pi * (t_s - late_s)) + other_n
    nothing = np.zeros_like(t_s)
    stretch = FollowedStretch(t_s, nothing, t_s, nothing, nothing, nothing, applied_n)
    part_n = part_by_late_force(stretch, residual_n)
    assert part_n == pytest.approx(late_s * 100.0 * 8.0 * np.pi / 2**0.5, rel=0.02)
    assert part_by_late_force(stretch._replace(applied_n=nothing), residual_n) == 0.0


@pytest.mark.slow
def test_one_sine_does_not_tell_the_latency(tmp_path):
    folder = bench(tmp_path, latency_ns=5_000_000, sines=((100.0, 10.0),))
    _, found = tuned(folder)
    assert found.latency.std_s == float("inf")
    assert found.delay_s == 0.0


@pytest.mark.slow
def test_the_choice_is_the_least_of_its_neighbours(late):
    for kind in ("kalman", "pi"):
        _, found = tuned(late, kind, StatedExpectation(60.0, 5.0))
        assert found.expectation.noise_std_m == pytest.approx(STEP_M / 12**0.5)
        keeping = [item for _, item in found.sweep if item.damping_ratio > 0.1]
        least = min(item.force_n for item in keeping)
        # The gain margin may forbid the very least.
        assert found.tuned.expected.force_n < 1.3 * least
        assert found.tuned.gain_margin > 0.98 * found.tuned.required_margin
        # The expectation was stated: no run shows a latency.
        assert found.latency is None


@pytest.mark.slow
def test_less_noise_and_less_force_give_a_smaller_error(late):
    some, less, quieter = (
        tuned(late, source=StatedExpectation(*given))[1].tuned
        for given in ((60.0, 5.0, 2e-5), (20.0, 5.0, 2e-5), (60.0, 5.0, 2e-6))
    )
    assert less.expected.force_n < some.expected.force_n
    assert quieter.expected.force_n < some.expected.force_n
    assert quieter.observer.filter.bandwidth_hz > some.observer.filter.bandwidth_hz


@pytest.mark.slow
def test_an_observer_settles_in_time_although_noise_alone_would_make_it_slower(late):
    """A model that lacks little: the slower the filter, the smaller the error."""
    little = StatedExpectation(1.0, 0.3, 1e-4)
    ready = load_plan(late / "rig.yaml")
    [free], [usual], [fast] = (
        tune(ready, little, "kalman", Aim(settling_s=longest_s), lambda _what, _share: None)
        for longest_s in (60.0, None, 0.1)
    )
    assert free.tuned.expected.settling_s > 0.3
    # The error grows with the bandwidth: the limit is reached, but for the rounding of gains.
    assert 0.2 < usual.tuned.expected.settling_s < 0.2501
    assert 0.08 < fast.tuned.expected.settling_s < 0.1001
    assert free.tuned.expected.force_n < usual.tuned.expected.force_n


def rig(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["rig", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


@pytest.mark.slow
def test_the_command(late, monkeypatch, capsys, tmp_path):
    asked = ("tune", late / "rig.yaml", "--residual-n", 60, "--up-to-hz", 5)
    assert rig(monkeypatch, *asked, "--plot", tmp_path / "plot.png") == 0
    said = capsys.readouterr().out
    assert "PI (Cuesta et al., 2021)" in said
    assert "{value: force_std_n" in said
    assert "configured" in said
    assert "Tuning hardly helps" not in said
    assert (tmp_path / "plot.png").stat().st_size > 10_000
    assert rig(monkeypatch, *asked, "--json") == 0
    [found] = json.loads(capsys.readouterr().out)
    assert found["observer"]["kind"] == "kalman"
    parts = found["expected_force_error_n"]
    assert parts["all"] == pytest.approx(np.hypot(parts["noise"], parts["lag"]))


@pytest.mark.slow
def test_a_second_tuning_hardly_helps_and_another_model_is_written(late, monkeypatch, capsys):
    text = (late / "rig.yaml").read_text()
    (late / "noted.yaml").write_text(f"# of this bench\n{text}")
    asked = ("--residual-n", 60, "--up-to-hz", 5)
    first = late / "first.yaml"
    assert rig(monkeypatch, "tune", late / "noted.yaml", *asked, "--out", first) == 0
    assert first.read_text().startswith("# of this bench\n")
    capsys.readouterr()
    second = late / "second.yaml"
    corrected = late / "corrected.yaml"
    corrected.write_text(
        (MODELS / "reference.yaml").read_text().replace("mass_kg: 10.0", "mass_kg: 11.0")
    )
    assert rig(monkeypatch, "tune", first, *asked, "--model", corrected, "--out", second) == 0
    assert "Tuning hardly helps" in capsys.readouterr().out
    plan = load_plan(second)
    assert plan.config.model == "corrected.yaml"
    assert plan.model.skeleton.bodies[0].mass_kg == 11.0


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ((), "expected --run RUN, or --residual-n and --up-to-hz"),
        (("--residual-n", 5), "expected --run RUN"),
        (("--residual-n", 0, "--up-to-hz", 5), "--residual-n 0: expected greater than"),
        (("--residual-n", 5, "--up-to-hz", 0), "--up-to-hz 0: expected greater than"),
        (("--run", "{run}", "--residual-n", 5), "--run: contains what is to be expected"),
        (("--run", "{run}", "--observer", "luenberger"), "expected one of pi, kalman"),
        (("--run", "{folder}"), "run.yaml"),
        (("--run", "{run}", "--out", "{folder}/rig.yaml"), "exists, expected a new file"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(late, monkeypatch, capsys, asked, says):
    given = [str(item).format(run=late / "run", folder=late) for item in asked]
    assert rig(monkeypatch, "tune", late / "rig.yaml", *given) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert says in said[0]


def test_a_tuned_run_is_replayed_bit_by_bit(late):
    assert replay(late / "run").different == 0
    assert plan_of_run(late / "run").config.observers["strut"].kind == "kalman"


@pytest.mark.slow
def test_an_observer_that_states_no_deviation_does_not_suit_such_a_limit(late, monkeypatch, capsys):
    text = (late / "rig.yaml").read_text()
    limit = "supervision: {limits: [{value: force_std_n, high: 100, action: hold}]}"
    assert "supervision" not in text
    path = late / "limited.yaml"
    path.write_text(text.replace("kind: pi", "kind: kalman") + limit + "\n")
    asked = ("tune", path, "--residual-n", 60, "--up-to-hz", 5, "--observer", "pi")
    assert rig(monkeypatch, *asked, "--out", late / "other.yaml") == 2
    assert "expected --observer kalman, or no such row" in capsys.readouterr().err
    assert not (late / "other.yaml").exists()


@pytest.mark.slow
def test_a_suspension_above_a_tyre_with_a_known_law_is_tuned(tmp_path):
    """What is expected of it is what a run with it then errs by; the tyre stays as it is."""
    text = (CONFIGS / "quarter_car_road.yaml").read_text()
    (tyre,) = [line for line in text.splitlines() if line.startswith("  tyre: {kind")]
    known = "  tyre: {kind: none, noise_std_m: 5.0e-6}"
    (tmp_path / "rig.yaml").write_text(text.replace(tyre, known))
    bench = load_bench_config(CONFIGS / "quarter_car_road_bench.yaml")
    model = tmp_path / "weak.yaml"
    spec = load_plan(tmp_path / "rig.yaml").model
    model.write_text(dump_model(wrong(spec, 0.7, ["suspension"]).spec))
    ready = load_plan(tmp_path / "rig.yaml", duration_s=8.0, model=str(model))
    with_bench(ready, bench, tmp_path / "run", lockstep=True)
    [found] = tune(ready, tmp_path / "run", "kalman", Aim(), lambda _what, _share: None)
    assert found.name == "suspension"
    write_config(ready, [found], tmp_path / "tuned.yaml", str(model))
    better = load_plan(tmp_path / "tuned.yaml", duration_s=8.0)
    assert better.config.observers["tyre"] == ready.config.observers["tyre"]
    with_bench(better, bench, tmp_path / "again", lockstep=True)
    truth = simulate(bench, 8_000_000_000, 1_000_000)
    column = [strut.name for strut in bench.struts].index("suspension")
    errors = {}
    for name in ("run", "again"):
        run = open_run(tmp_path / name)
        counts = run.t_s > 1.0
        true_n = np.interp(run.t_s, truth.t_ns * 1e-9, truth.strut_force_n[:, column])
        missed_n = (run["suspension.force_n"] - true_n)[counts]
        errors[name] = float(np.sqrt(np.mean(missed_n**2)))
    assert errors["again"] < 0.5 * errors["run"]
    assert errors["again"] == pytest.approx(found.tuned.expected.force_n, rel=0.35)
