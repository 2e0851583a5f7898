"""The generator is right: theory, textbook signatures, and no code shared with what it judges."""

import ast
import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from scipy.interpolate import CubicHermiteSpline

from tests.truth import dyno, simulation
from tests.truth.cases import FAMILIES, FOREIGN_KINDS, NONLINEAR_FAMILIES, make_case
from tests.truth.excitation import load_n, stroke_path
from tests.truth.files import write_case
from tests.truth.integrator import Drive, Motion, follow, integrate
from tests.truth.plant import Bench, Case, Planted, Roughness, RunPlan, Stroke
from tests.truth.simulation import (
    BAND_HZ,
    floor_ratios,
    force_noise_floor_n,
    height_floor_m,
    record,
    simulate,
    strut_force_n,
    true_motion,
    true_path,
)

BENCH = Bench(10.0, 1000.0, 20.0, 0.5)
RATE_HZ = 1000


def shortened(plan: RunPlan, duration_s: float) -> RunPlan:
    return replace(plan, excitation=replace(plan.excitation, duration_s=duration_s))


def short_case(seed: int, kind: str, duration_s: float = 4.0) -> Case:
    case = make_case(seed, kind)
    return replace(
        case,
        train=shortened(case.train, duration_s),
        held_out=shortened(case.held_out, duration_s),
    )


class Rig(NamedTuple):
    """How a test runs a bench; by default the body starts where weight and spring balance."""

    bench: Bench = BENCH
    duration_s: float = 2.0
    steps: int = 20
    height_m: float | None = None


def driven(effects: tuple[Planted, ...], drive, rig: Rig) -> tuple[np.ndarray, Motion]:
    """Motion under any force that depends on time."""
    bench, steps = rig.bench, rig.steps
    samples = round(rig.duration_s * RATE_HZ) + 1
    half_steps = np.arange(2 * steps * (samples - 1) + 1) / (2 * steps * RATE_HZ)
    balance = bench.free_length_m - bench.weight_n / bench.stiffness_n_per_m
    prescribed = Drive(
        drive(half_steps).astype(float), np.zeros_like(half_steps), 1 / (steps * RATE_HZ), steps
    )
    start = balance if rig.height_m is None else rig.height_m
    return half_steps[:: 2 * steps], integrate(bench, effects, prescribed, start, 20.0)


def sine(force_n: float, frequency_hz: float):
    return lambda t_s: force_n * np.sin(2 * np.pi * frequency_hz * t_s)


def test_generator_shares_no_code_with_what_it_judges():
    for path in Path(__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert name.split(".")[0] not in {"rig", "dart_model", "can_dbc"}, path.name


@pytest.mark.slow
def test_linear_bench_matches_closed_form():
    t_s, motion = driven((), lambda t: 0.0 * t, Rig(height_m=BENCH.free_length_m))
    omega = np.sqrt(BENCH.stiffness_n_per_m / BENCH.mass_kg)
    zeta = BENCH.damping_ratio
    damped = omega * np.sqrt(1 - zeta**2)
    sag = BENCH.weight_n / BENCH.stiffness_n_per_m
    decay = np.exp(-zeta * omega * t_s)
    swing = np.cos(damped * t_s) + zeta * omega / damped * np.sin(damped * t_s)
    expected = BENCH.free_length_m - sag * (1 - decay * swing)
    np.testing.assert_allclose(motion.height_m, expected, atol=1e-11)


def test_smooth_laws_converge_with_fourth_order():
    cube = Planted("nonlinear_stiffness", "cube_spring", {"stiffness_n_per_m3": 2e4})
    mode = Planted(
        "unmodelled_mode",
        "hung_mass",
        {"mass_kg": 2.0, "frequency_hz": 5.0, "damping_ratio": 0.05},
    )
    bench = replace(BENCH, stiffness_n_per_m=2e5, damping_n_s_per_m=400.0)
    ends = [
        driven((cube, mode), sine(5e3, 20.0), Rig(bench, 0.2, steps))[1].height_m[-1]
        for steps in (1, 2, 4, 64)
    ]
    errors = np.abs(np.array(ends[:3]) - ends[3])
    np.testing.assert_allclose(np.log2(errors[:-1] / errors[1:]), 4.0, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        *((family, 5) for family in FAMILIES),
        *(("outside", seed) for seed in range(4)),
        *((kind, 0) for kind in FOREIGN_KINDS),
    ],
)
def test_forces_of_every_family_balance(kind, seed):
    """m z'' is the sum of all forces, and heights, velocities, accelerations belong together."""
    case = short_case(seed, kind)
    run = record(case, case.train)
    bench = case.bench
    forces = (
        -bench.stiffness_n_per_m * (run.true_height_m - bench.free_length_m)
        - bench.damping_n_s_per_m * run.true_velocity_m_per_s
        + load_n(case.train.excitation, bench, run.t_s)
        - bench.weight_n
        + run.effect_force_n.sum(axis=1)
    )
    assert np.ptp(run.effect_force_n) > 0.0 or kind == "preload"
    scale = np.std(forces) + 1.0
    error = bench.mass_kg * run.true_acceleration_m_per_s2 - forces
    assert np.max(np.abs(error)) < 1e-9 * scale
    step = 1.0 / case.sensors.sample_rate_hz
    travelled = (
        np.diff(run.true_height_m)
        - step * (run.true_velocity_m_per_s[1:] + run.true_velocity_m_per_s[:-1]) / 2
    )
    assert np.max(np.abs(travelled)) < 2e-6


SWITCHING = ("hysteresis", "backlash", "stop", "foreign-friction", "foreign-backlash")
"""Kinds with laws that switch."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seed"),
    [*(("friction", k) for k in range(4)), *((kind, 5) for kind in SWITCHING)],
)
def test_the_integrator_errs_less_than_the_sensors(kind, seed, monkeypatch):
    """Else the floor that a right model is held to would be the bench's own error.

    Smooth laws converge with the fourth order; an error of the first order halves with the step.
    """
    case = short_case(seed, kind)
    usual = record(case, case.train).true_height_m
    steps = simulation.steps_per_sample
    monkeypatch.setattr(
        simulation, "steps_per_sample", lambda effects, rate_hz: 2 * steps(effects, rate_hz)
    )
    error = usual - record(case, case.train).true_height_m
    assert np.sqrt(np.mean(error**2)) < 0.05 * case.sensors.height_noise_m


def test_dry_contact_sticks_below_breakaway_and_slides_above():
    dry = Planted(
        "friction",
        "stick",
        {"coulomb_n": 10.0, "breakaway_n": 15.0, "stribeck_m_per_s": 0.05, "hyperbolic": 0.0},
    )
    _, held = driven((dry,), sine(14.0, 1.0), Rig())
    np.testing.assert_array_equal(held.velocity_m_per_s, 0.0)
    t_s, slid = driven((dry,), sine(80.0, 1.0), Rig())
    sliding = np.abs(slid.velocity_m_per_s) > 0.3
    assert sliding.any()
    np.testing.assert_allclose(
        slid.force_n[sliding, 0], -10.0 * np.sign(slid.velocity_m_per_s[sliding]), rtol=1e-3
    )
    # A slow force stops it at each of its peaks until it has fallen by friction and break-away.
    t_s, slow = driven((dry,), sine(40.0, 0.3), Rig())
    stuck = (slow.velocity_m_per_s == 0.0) & (t_s > 1.0)
    assert 0.1 < stuck.mean() < 0.9
    assert np.all(np.abs(slow.force_n[stuck, 0]) <= 15.0)


def test_bristles_give_a_little_and_then_slide_with_coulomb_force():
    truth = {"coulomb_n": 10.0, "breakaway_n": 10.0, "stribeck_m_per_s": 0.05, "bristle_m": 5e-5}
    bristle = Planted("friction", "bristle", truth)
    _, held = driven((bristle,), sine(5.0, 1.0), Rig(steps=60))
    assert 1e-6 < np.ptp(held.height_m) < 1e-4
    _, slid = driven((bristle,), sine(80.0, 1.0), Rig(steps=60))
    sliding = np.abs(slid.velocity_m_per_s) > 0.2
    np.testing.assert_allclose(
        slid.force_n[sliding, 0], -10.0 * np.sign(slid.velocity_m_per_s[sliding]), rtol=0.02
    )


@pytest.mark.parametrize(
    ("law", "more"),
    [
        ("hertz_bumper", {"stiffness_n_per_m15": 2e5, "dissipation_s_per_m": 2.0}),
        ("linear_bumper", {"stiffness_n_per_m": 2e4, "damping_n_s_per_m": 400.0}),
        ("rubber_bumper", {"stiffness_n_per_m": 1e4, "length_m": 0.01}),
    ],
)
def test_stops_push_and_never_pull(law, more):
    stop = Planted("stop", law, {"low_m": 0.37, "high_m": 0.43} | more)
    _, motion = driven((stop,), sine(60.0, 1.6), Rig())
    force, z = motion.force_n[:, 0], motion.height_m
    free = (z > 0.37) & (z < 0.43)
    assert np.all(force[free] == 0.0)
    assert np.all(force[z < 0.37] >= 0.0)
    assert np.all(force[z > 0.43] <= 0.0)
    assert force.max() > 50.0
    assert force.min() < -50.0


def test_spring_is_slack_inside_the_gap():
    play = Planted("backlash", "free_play", {"half_gap_m": 0.01})
    _, motion = driven((play,), lambda t: 98.1 + sine(30.0, 1.5)(t), Rig(height_m=0.5))
    x = motion.height_m - BENCH.free_length_m
    spring = motion.force_n[:, 0] - BENCH.stiffness_n_per_m * x
    inside = np.abs(x) < 0.01
    assert inside.any()
    assert (~inside).any()
    np.testing.assert_allclose(spring[inside], 0.0, atol=1e-9)
    np.testing.assert_allclose(spring[~inside], (-1000.0 * (x - 0.01 * np.sign(x)))[~inside])


MEMORY_LAWS = {
    "yielding": {"exponent": 2.0, "softness": 0.6},
    "dahl": {"exponent": 1.5},
    "slip_elements": {"grading": 1.0},
}


@pytest.mark.parametrize("law", MEMORY_LAWS)
def test_hysteresis_takes_energy_and_is_bounded(law):
    truth = {"stiffness_n_per_m": 2000.0, "yield_n": 12.0} | MEMORY_LAWS[law]
    t_s, motion = driven((Planted("hysteresis", law, truth),), sine(60.0, 1.5), Rig(duration_s=6.0))
    cycle = t_s >= 6.0 - 2 / 1.5
    force = motion.force_n[:, 0]
    work = np.trapezoid(force[cycle], motion.height_m[cycle])
    assert work < -0.5
    assert np.max(np.abs(force)) <= 12.0 * (1 + 1e-9)
    assert np.max(np.abs(force)) > 11.0


def test_slip_elements_follow_masing_rules():
    """A loop's branch is the first loading curve at twice the scale."""
    truth = {"stiffness_n_per_m": 2000.0, "yield_n": 12.0, "grading": 1.0}
    stiff = replace(BENCH, stiffness_n_per_m=1e6, damping_n_s_per_m=2e3)
    slips = (Planted("hysteresis", "slip_elements", truth),)
    _, motion = driven(slips, lambda t: 8000.0 * np.sin(np.pi * t), Rig(stiff))
    x, force = motion.height_m - motion.height_m[0], motion.force_n[:, 0]
    top = int(np.argmax(x))
    for depth in (0.001, 0.003, 0.006):
        first = np.interp(depth, x[:top], force[:top])
        back = np.interp(-(x[top] - 2 * depth), -x[top : top + 900], force[top : top + 900])
        assert back - force[top] == pytest.approx(-2 * first, rel=0.01)


def test_relaxing_branch_forgets():
    branch = Planted(
        "hysteresis", "relaxing_branch", {"stiffness_n_per_m": 500.0, "relaxation_s": 0.2}
    )
    _, motion = driven((branch,), lambda t: 50.0 * (t > 0), Rig(duration_s=8.0))
    assert np.max(np.abs(motion.force_n)) > 5.0
    assert abs(motion.force_n[-1, 0]) < 1e-3


def test_hung_mass_carries_its_weight_and_momentum():
    truth = {"mass_kg": 2.0, "frequency_hz": 4.0, "damping_ratio": 0.05}
    hung = Planted("unmodelled_mode", "hung_mass", truth)
    _, motion = driven((hung,), sine(50.0, 3.0), Rig())
    assert motion.force_n[0, 0] == pytest.approx(-2.0 * 9.81)
    relative = np.gradient(motion.memory[:, 1], 1 / RATE_HZ)
    own = motion.acceleration_m_per_s2 + relative
    inner = slice(5, -5)
    np.testing.assert_allclose(
        motion.force_n[inner, 0], -2.0 * (9.81 + own[inner]), atol=0.02 * np.ptp(own)
    )


def test_rigid_mass_is_a_bench_with_that_mass():
    extra = Planted("inertia", "rigid_mass", {"mass_kg": 3.0})
    _, planted = driven((extra,), sine(50.0, 2.0), Rig(height_m=0.4))
    heavy = replace(BENCH, mass_kg=13.0)
    _, direct = driven((), sine(50.0, 2.0), Rig(heavy, height_m=0.4))
    np.testing.assert_allclose(planted.height_m, direct.height_m, rtol=0, atol=1e-12)


def test_late_load_is_an_exact_shift():
    case = short_case(3, "delay")
    run = record(case, case.train)
    lag = case.effects[0].truth["lag_s"]
    excitation = case.train.excitation
    expected = load_n(excitation, case.bench, run.t_s - lag)
    shifted = load_n(excitation, case.bench, run.t_s) + run.effect_force_n[:, 0]
    np.testing.assert_allclose(shifted, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("law", "truth"),
    [
        ("thin_oil", {"per_k": 0.02, "heat_capacity_j_per_k": 3.0, "cooling_s": 50.0}),
        ("time_fade", {"lost_fraction": 0.5, "time_s": 2.0, "stretch": 1.0}),
        ("work_fade", {"lost_fraction": 0.5, "energy_j": 20.0}),
    ],
)
def test_faded_damper_loses_force_during_the_run(law, truth):
    _, motion = driven((Planted("fade", law, truth),), sine(60.0, 1.5), Rig(duration_s=6.0))
    moving = np.abs(motion.velocity_m_per_s) > 0.05
    kept = 1.0 - motion.force_n[moving, 0] / (20.0 * motion.velocity_m_per_s[moving])
    assert kept[0] > 0.97
    # Between strokes a warm damper cools a little.
    assert np.all(np.diff(kept) < 1e-4)
    assert 0.1 < kept[-1] < 0.9


def test_fractional_force_leads_by_its_order():
    """D^a of a sine is a sine ahead by a quarter turn times a."""
    order = 0.5
    spring_pot = Planted("outside", "fractional", {"coefficient_n": 1.0, "order": order})
    stiff = replace(BENCH, stiffness_n_per_m=1e5, damping_n_s_per_m=2e3)
    t_s, motion = driven((spring_pot,), sine(2000.0, 2.0), Rig(stiff, 10.0))
    last = t_s >= 8.0
    turn = np.exp(-2j * np.pi * 2.0 * t_s[last])
    force = np.sum(-motion.force_n[last, 0] * turn)
    height = np.sum((motion.height_m[last] - motion.height_m[last].mean()) * turn)
    assert np.angle(force / height) == pytest.approx(order * np.pi / 2, abs=0.08)


@pytest.mark.slow
def test_equal_seeds_give_equal_cases():
    first, second = short_case(11, "pair"), short_case(11, "pair")
    assert first == second
    for one, other in zip(simulate(first), simulate(second), strict=True):
        np.testing.assert_array_equal(one.height_m, other.height_m)
        np.testing.assert_array_equal(one.applied_force_n, other.applied_force_n)
    assert short_case(12, "pair") != first


def test_unknown_kind_is_refused():
    with pytest.raises(ValueError, match="kind 'wobble'"):
        make_case(0, "wobble")


def test_kinds_plant_what_they_say():
    assert make_case(1, "complete").effects == ()
    assert make_case(1, "outside").families == ("outside",)
    assert make_case(1, "friction_and_cubic").effects[1].law == "cube_spring"
    assert len(set(make_case(1, "triple").families)) == 3
    assert make_case(len(FAMILIES) + 1, "single").families == (FAMILIES[1],)


@pytest.mark.long
def test_cases_span_visibility_noise_and_rates():
    cases = [short_case(seed, "single") for seed in range(14)]
    ratios = [floor_ratios(c, record(c, c.train))[0] for c in cases]
    assert min(ratios) < 2.0
    assert max(ratios) > 50.0
    noises = [case.sensors.height_noise_m for case in cases]
    assert min(noises) < 3e-6
    assert max(noises) > 4e-5
    assert {case.train.excitation.shape for case in cases} == {"multisine", "sweep", "noise"}
    assert {case.sensors.sample_rate_hz for case in cases} == {500, 1000}


def test_floor_is_what_band_limited_inverse_dynamics_leave():
    """The formula against white noise, really filtered to the band and really differentiated."""
    case = make_case(2, "complete")
    bench, sensors = case.bench, case.sensors
    count, rate = 60_000, sensors.sample_rate_hz
    noise = sensors.height_error_m * np.random.default_rng(0).standard_normal(count)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    omega = 2 * np.pi * frequency
    stiffness = bench.stiffness_n_per_m - bench.mass_kg * omega**2
    stiffness = stiffness + 1j * bench.damping_n_s_per_m * omega
    force = np.fft.irfft(np.fft.rfft(noise) * stiffness * (frequency <= BAND_HZ), count)
    assert np.std(force) == pytest.approx(force_noise_floor_n(case), rel=0.05)


@pytest.mark.parametrize("kind", ["disturbed", "dyno_disturbed"])
def test_a_disturbed_bench_lacks_nothing_but_its_height_is_late_and_its_noise_coloured(kind):
    """Lag-1 correlation of first-order noise: exp(-dt / tau) (Box, Jenkins, 3.2)."""
    case = make_case(3, kind)
    sensors, recording = case.sensors, record(case, case.train)
    assert case.effects == ()
    assert case.families == ("delay",)
    before = CubicHermiteSpline(
        recording.t_s, recording.true_height_m, recording.true_velocity_m_per_s
    )(recording.t_s - sensors.late_s)
    noise = (recording.height_m - before)[10:]
    step_s = 1.0 / sensors.sample_rate_hz
    kept = np.exp(-step_s / sensors.noise_time_s)
    # The variance of an estimate from correlated samples is larger by (1 + kept) / (1 - kept).
    scatter = np.sqrt((1.0 + kept) / (1.0 - kept) / len(noise))
    assert np.std(noise) == pytest.approx(sensors.height_error_m, rel=4.0 * scatter)
    share = sensors.height_noise_m**2 / sensors.height_error_m**2
    lagged = float(np.mean(noise[1:] * noise[:-1]) / np.var(noise))
    assert lagged == pytest.approx(kept * share, abs=4.0 * scatter)


@pytest.mark.slow
def test_a_right_model_leaves_the_sensors_error_and_what_the_loads_resolution_moves():
    case = make_case(2, "complete")

    def floor(load_step_n):
        sensors = replace(case.sensors, load_step_n=load_step_n)
        return height_floor_m(replace(case, sensors=sensors))

    error = case.sensors.height_error_m
    assert floor(1e-9) == pytest.approx(error, rel=1e-6)
    # A linear bench answers in proportion; the rounding errors of two steps are alike in size.
    moved = [np.sqrt(floor(step) ** 2 - error**2) for step in (0.1, 0.4)]
    assert moved[1] / moved[0] == pytest.approx(4.0, rel=0.3)


def test_files_hold_the_model_without_the_effect(tmp_path):
    case = short_case(8, "friction", 1.0)
    write_case(case, tmp_path)
    model = yaml.safe_load((tmp_path / "model.yaml").read_text(encoding="utf-8"))
    assert model["struts"][0]["effects"] == []
    assert model["struts"][0]["stiffness_n_per_m"] == case.bench.stiffness_n_per_m
    with (tmp_path / "train.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["t_s", "height_m", "applied_force_n"]
    assert len(rows) == case.sensors.sample_rate_hz + 2
    truth = json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))
    assert truth["families"] == ["friction"]
    assert truth["floor_ratios"][0] > 0.0


ROUGH = Roughness(mass=0.04, stiffness=-0.13, damping=0.3, preload_n=4.0, input_gain=0.02)


def test_rough_model_file_is_off_by_its_roughness(tmp_path):
    case = replace(short_case(8, "friction", 1.0), roughness=ROUGH)
    bench = case.bench
    write_case(case, tmp_path)
    model = yaml.safe_load((tmp_path / "model.yaml").read_text(encoding="utf-8"))
    strut, body = model["struts"][0], model["skeleton"]["bodies"][0]
    assert body["mass_kg"] == pytest.approx(1.04 * bench.mass_kg)
    assert strut["stiffness_n_per_m"] == pytest.approx(0.87 * bench.stiffness_n_per_m)
    assert strut["damping_n_s_per_m"] == pytest.approx(1.3 * bench.damping_n_s_per_m)
    # At the true free length the file's spring pulls as hard as what it lacks pushes.
    pull = strut["stiffness_n_per_m"] * (bench.free_length_m - strut["free_length_m"])
    assert pull == pytest.approx(4.0, abs=0.02)


def test_roughness_leaves_the_bench_as_it_is():
    case = short_case(8, "friction", 1.0)
    exact, rough = record(case, case.train), record(replace(case, roughness=ROUGH), case.train)
    np.testing.assert_array_equal(exact.height_m, rough.height_m)
    # The load's sensor reads too little of what acts.
    np.testing.assert_allclose(exact.applied_force_n, 1.02 * rough.applied_force_n, atol=0.02)
    assert case.roughness.is_exact
    assert case.nominal == case.bench


@pytest.mark.slow
def test_rough_kinds_draw_roughness_and_plant_nothing_linear():
    cases = [make_case(seed, "rough_complete") for seed in range(8)]
    gains = [case.roughness.input_gain for case in cases]
    assert 0 < np.count_nonzero(gains) < 8
    for case in cases:
        rough = case.roughness
        assert not rough.is_exact
        assert abs(rough.mass) <= 0.05
        assert abs(rough.stiffness) <= 0.2
        assert abs(rough.damping) <= 0.4
        assert abs(rough.preload_n) <= 0.05 * case.bench.weight_n
        assert abs(rough.input_gain) <= 0.02
    triple = make_case(1, "rough_triple")
    assert set(triple.families) <= set(NONLINEAR_FAMILIES)
    assert triple == make_case(1, "rough_triple")
    assert make_case(0, "rough_foreign-stop").effects[0].law == "rubber_bumper"
    with pytest.raises(ValueError, match="kind 'preload'"):
        make_case(0, "rough_preload")


def test_prescribed_motion_keeps_to_its_stroke_and_its_derivatives():
    stroke = Stroke(0.08, 0.4, 0.3, 6.0, 0.8, 12.0, 5)
    t_s = np.arange(0.0, 12.0, 1e-4)
    height, velocity, acceleration = stroke_path(stroke, t_s)
    assert np.ptp(height) == pytest.approx(0.08, rel=1e-4)
    np.testing.assert_allclose(np.gradient(height, 1e-4)[1:-1], velocity[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(velocity, 1e-4)[1:-1], acceleration[1:-1], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("family", [f for f in FAMILIES if f in dyno.FAMILIES])
def test_dyno_gives_the_forces_of_a_free_bench_that_moves_likewise(family):
    """A law along the motion of a free bench has the force that it had on that bench."""
    case = short_case(5, family, 2.0)
    steps = 60 if family == "friction" else 20
    _, free = true_motion(case.bench, case.effects, case.train, 2 * steps * RATE_HZ, 1)
    path = np.stack([free.height_m, free.velocity_m_per_s, free.acceleration_m_per_s2])
    nothing = np.zeros(path.shape[1])
    drive = Drive(nothing, nothing, 1 / (steps * RATE_HZ), steps)
    along = follow(case.bench, case.effects, drive, path, case.train.ambient_c)
    moving = np.abs(along.velocity_m_per_s) > 1e-3
    expected = free.force_n[:: 2 * steps]
    scale = np.abs(expected).max()
    if case.effects[0].law in {"constant", "tone"}:
        expected = np.zeros_like(expected)
    np.testing.assert_allclose(along.force_n[moving], expected[moving], atol=1e-4 * scale)


@pytest.mark.slow
def test_dyno_measures_spring_damper_and_effects(tmp_path):
    case = make_case(3, "dyno_preload")
    run, _ = write_case(case, tmp_path)
    bench, force = case.bench, case.effects[0].truth["force_n"]
    spring = bench.stiffness_n_per_m * (run.true_height_m - bench.free_length_m)
    expected = force - spring - bench.damping_n_s_per_m * run.true_velocity_m_per_s
    error = run.strut_force_n - expected
    assert np.std(error) == pytest.approx(case.sensors.force_error_n, rel=0.05)
    assert abs(np.mean(error)) < 0.1 * case.sensors.force_error_n
    header = (tmp_path / "train.csv").read_text(encoding="utf-8").splitlines()[0]
    assert header.split(",")[:3] == ["t_s", "height_m", "strut_force_n"]
    assert "applied_force_n" not in header
    quiet, motion = true_path(bench, case.effects, case.train, 100, 10)
    assert strut_force_n(bench, motion).shape == quiet.shape


@pytest.mark.slow
def test_dyno_kinds_are_what_they_say():
    cases = [make_case(seed, "dyno_complete") for seed in range(8)]
    assert 0 < sum(case.roughness.is_exact for case in cases) < 8
    for case in cases:
        assert case.is_dyno
        assert (case.roughness.mass, case.roughness.input_gain) == (0.0, 0.0)
        assert 0.03 <= case.train.excitation.stroke_m <= 0.12
        assert 1e-6 <= case.sensors.height_noise_m <= 1e-5
        assert 0.1 <= case.sensors.force_noise_n <= 1.0
        assert case.held_out.excitation.seed != case.train.excitation.seed
    assert all(make_case(seed, "dyno_stiffness").roughness.is_exact for seed in range(4))
    pair = make_case(2, "dyno_pair")
    assert len(set(pair.families)) == 2
    assert set(pair.families) <= set(dyno.FAMILIES)
    with pytest.raises(ValueError, match="kind 'delay'"):
        make_case(0, "dyno_delay")


def test_planning_steps_are_fine_enough_to_trust():
    case = short_case(4, "hysteresis")
    _, coarse = true_motion(case.bench, case.effects, case.train, 250, 20)
    _, fine = true_motion(case.bench, case.effects, case.train, 250, 80)
    np.testing.assert_allclose(coarse.height_m, fine.height_m, atol=1e-6)
