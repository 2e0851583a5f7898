"""What recordings can determine: facts in closed form, bounds against what a diagnosis finds."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from dart_model.spec import dump_model
from rig.diagnosis.determinable import find_determinable, recording_facts
from rig.diagnosis.diagnose import diagnose
from rig.pages.determinable_tables import warnings
from rig.recordings.recording import Recording
from tests.cli.test_commands import rig
from tests.diagnosis import little_bench as bench
from tests.diagnosis.late_channels import bench_run

RATE_HZ = 500
NOISE_M = 1e-5


def recording(heights_m, noise_m=NOISE_M):
    noise = np.random.default_rng(5).normal(0.0, noise_m, len(heights_m))
    t_s = np.arange(len(heights_m)) / RATE_HZ
    return Recording("run", t_s, (heights_m + noise)[:, np.newaxis])


def sine(amplitude_m=0.02, frequency_hz=2.0, duration_s=20.0):
    t_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    return 0.4 + amplitude_m * np.sin(2.0 * math.pi * frequency_hz * t_s)


def test_facts_of_a_sine_are_those_of_its_formula():
    facts = recording_facts(recording(sine()), "strut", 0)
    assert facts.duration_s == pytest.approx(20.0, abs=0.01)
    assert facts.rate_hz == pytest.approx(RATE_HZ)
    assert (facts.low_m, facts.high_m) == pytest.approx((0.38, 0.42), abs=5e-5)
    # A speed that is exceeded in a twentieth of the time of one direction.
    fast = 0.02 * 4.0 * math.pi * math.cos(0.05 * math.pi / 2.0)
    assert facts.rebound_m_per_s == pytest.approx(fast, rel=0.01)
    assert facts.compression_m_per_s == pytest.approx(fast, rel=0.01)
    assert facts.rebound_share == pytest.approx(0.5, abs=0.01)
    low, high = facts.band_hz
    assert low <= 2.0 <= high
    assert high - low < 0.5
    assert facts.noise_m == pytest.approx(NOISE_M, rel=0.1)
    assert (facts.missing, facts.clipped) == (0.0, 0.0)


def test_a_height_that_is_cut_off_is_counted():
    # sin > 0.8 in 0.205 of the time.
    facts = recording_facts(recording(np.minimum(sine(), 0.416), noise_m=0.0), "strut", 0)
    assert facts.clipped == pytest.approx(math.acos(0.8) / math.pi, rel=0.05)


def test_missing_and_coarse_heights_are_counted():
    run = recording(sine())
    heights_m = np.round(run.heights_m / 1e-4) * 1e-4
    heights_m[::4] = np.nan
    facts = recording_facts(replace(run, heights_m=heights_m), "strut", 0)
    assert facts.missing == pytest.approx(0.25, abs=0.001)
    assert facts.resolution_m == pytest.approx(1e-4, rel=1e-6)


def test_one_direction_of_travel_is_warned_of():
    t_s = np.arange(5000) / RATE_HZ
    facts = recording_facts(recording(0.3 + 0.01 * t_s), "strut", 0)
    assert facts.rebound_share > 0.99
    assert facts.rebound_m_per_s == pytest.approx(0.01, rel=0.2)


@pytest.fixture(scope="module")
def found():
    return find_determinable(bench.model(), [bench.run(bench.Nothing(), noise_m=NOISE_M)])


def test_bounds_grow_with_the_noise_and_fall_with_the_root_of_the_length(found):
    noisy = bench.run(bench.Nothing(), noise_m=3.0 * NOISE_M)
    twice = [bench.run(bench.Nothing(), seed=seed) for seed in (1, 2)]
    for runs, factor in (([noisy], 3.0), (twice, math.sqrt(0.5))):
        other = find_determinable(bench.model(), runs)
        for one, another in zip(found.linear, other.linear, strict=True):
            assert another.std == pytest.approx(factor * one.std, rel=0.15), one.parameter
        before = {bound.family: bound for bound in found.families}
        for bound in other.families:
            expected = factor * before[bound.family].least_n
            assert bound.least_n == pytest.approx(expected, rel=0.2), bound.family


def test_rich_motion_determines_all_and_says_so(found):
    assert all(bound.is_determined for bound in (*found.linear, *found.families))
    assert {"friction", "stop", "nonlinear_damping"} <= {bound.family for bound in found.families}
    assert all(bound.apart_n >= bound.least_n for bound in found.families)
    assert not any("not determined" in text for text in warnings(found))


def test_one_frequency_leaves_linear_parameters_alike():
    still = bench.model()
    once = bench.run(
        bench.Nothing(), load=lambda t: 20.0 * math.sin(9.0 * t), duration_s=30.0, noise_m=1e-3
    )
    found = find_determinable(still, [once])
    text = " ".join(warnings(found))
    assert "hardly distinguished from" in text or "not determined" in text


@pytest.mark.parametrize("late_s", [-4e-3, 0.0, 4e-3])
def test_a_late_height_is_warned_of(late_s):
    run = bench_run(bench.Nothing, late_s)
    found = find_determinable(bench.model(), [run])
    (delay,) = found.delays
    assert delay.delay_s == pytest.approx(late_s, abs=5.0 * delay.std_s + 2e-5)
    assert delay.is_late == (late_s != 0.0)
    what = "late" if late_s > 0.0 else "early"
    assert any(f"ms {what}" in text for text in texts_of(found)) == (late_s != 0.0)


def texts_of(found):
    return [text.replace("\N{NO-BREAK SPACE}", " ") for text in warnings(found)]


class Friction(bench.Nothing):
    """Dry friction of a size."""

    fine = 20

    def __init__(self, size_n):
        self.size_n = size_n

    def force(self, t, z, v, state):
        return -self.size_n * math.tanh(v / 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("times", "is_named"), [(6.0, True), (0.2, False)])
def test_a_diagnosis_names_what_is_above_the_bound_alone(times, is_named):
    noise_m = 2e-4
    (known,) = (
        bound
        for bound in find_determinable(
            bench.model(), [bench.run(bench.Nothing(), noise_m=noise_m)]
        ).families
        if bound.family == "friction"
    )
    size_n = times * (known.apart_n if is_named else known.least_n)
    runs = [bench.run(Friction(size_n), seed=seed, noise_m=noise_m) for seed in (3, 4)]
    diagnosis = diagnose(bench.model(), runs[:1], runs[1:]).diagnosis
    named = [effect.family for effect in diagnosis.effects]
    assert ("friction" in named) is is_named


def test_the_command_states_it_and_refuses_what_it_cannot_read(monkeypatch, tmp_path, capsys):
    run = bench.run(bench.Nothing())
    rows = np.column_stack([run.t_s, run.heights_m, run.applied_force_n])
    path = tmp_path / "run.csv"
    np.savetxt(path, rows, delimiter=",", header="t_s,height_m,applied_force_n", comments="")
    model = tmp_path / "model.yaml"
    model.write_text(dump_model(bench.model()), "utf-8")
    assert rig(monkeypatch, "check", path, "--model", model, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["schema"] == 1
    assert {row["parameter"] for row in told["linear"]} >= {"mass_kg", "stiffness_n_per_m"}
    assert {row["family"] for row in told["families"]} >= {"friction"}
    assert rig(monkeypatch, "check", path, "--model", model) == 0
    assert "named from" in capsys.readouterr().out
    assert rig(monkeypatch, "check", path) == 2
    assert "is a recording" in capsys.readouterr().err
    assert rig(monkeypatch, "check", model, model) == 2
    assert "expected one configuration" in capsys.readouterr().err
    planned = tmp_path / "next.csv"
    assert rig(monkeypatch, "check", path, "--model", model, "--excitation", planned) == 0
    assert planned.read_text("utf-8").startswith("t_s,applied_force_n\n")
    assert rig(monkeypatch, "check", path, "--model", model, "--excitation", planned) == 2
    assert "exists already" in capsys.readouterr().err
    assert rig(monkeypatch, "check", model, "--excitation", planned) == 2
    assert "expected recordings and --model" in capsys.readouterr().err
