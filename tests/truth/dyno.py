"""Draws dynos: a spring and a damper whose height is prescribed, and a load cell."""

import numpy as np

from tests.truth.excitation import stroke_path
from tests.truth.plant import Bench, Planted, RunPlan, Samples, Sensors, Stroke
from tests.truth.planting import START_C, Nominal, Rng
from tests.truth.simulation import strut_force_n, true_path

FAMILIES = (
    "preload",
    "stiffness",
    "damping",
    "nonlinear_stiffness",
    "stop",
    "backlash",
    "friction",
    "nonlinear_damping",
    "hysteresis",
    "fade",
    "periodic_force",
)
"""What shows where the motion is prescribed: no masses, and nothing that acts on a load."""

HEIGHT_LOW_M = 0.05
FORCE_LIMIT_N = 2e4
SPEED_LIMIT_M_PER_S = 2.0
PLANNING_RATE_HZ = 500
PLANNING_STEPS = 10


def draw_bench(rng: Rng) -> Bench:
    """Spring and damper as on a damper dyno; the mass only stands in the model file."""
    return Bench(
        mass_kg=round(float(rng.uniform(1.0, 3.0)), 3),
        stiffness_n_per_m=round(float(np.exp(rng.uniform(np.log(500.0), np.log(8000.0)))), 2),
        damping_n_s_per_m=round(float(np.exp(rng.uniform(np.log(50.0), np.log(800.0)))), 3),
        free_length_m=round(float(rng.uniform(0.2, 0.6)), 4),
    )


def draw_run(rng: Rng, bench: Bench, *, centred: bool) -> RunPlan:
    """A broad motion, for a gap about the free length, else mostly in compression."""
    stroke_m = float(rng.uniform(0.03, 0.12))
    shift = rng.uniform(-0.1, 0.1) if centred else rng.uniform(-0.6, 0.2)
    stroke = Stroke(
        stroke_m=stroke_m,
        middle_m=bench.free_length_m + float(shift) * stroke_m,
        low_hz=float(rng.uniform(0.2, 0.5)),
        high_hz=float(rng.uniform(3.0, 8.0)),
        tilt=float(rng.uniform(0.5, 1.2)),
        duration_s=float(rng.integers(10, 21)),
        seed=int(rng.integers(1_000_000)),
    )
    return RunPlan(stroke, 0.0, START_C, int(rng.integers(1_000_000)))


def draw_held_out(rng: Rng, train: RunPlan) -> RunPlan:
    """Other lines in the same band, somewhat less stroke."""
    stroke = train.excitation
    shorter = stroke.stroke_m * float(rng.uniform(0.7, 0.95))
    other = Stroke(
        stroke_m=shorter,
        middle_m=stroke.middle_m,
        low_hz=stroke.low_hz,
        high_hz=stroke.high_hz,
        tilt=stroke.tilt,
        duration_s=float(rng.integers(10, 21)),
        seed=int(rng.integers(1_000_000)),
    )
    ambient = START_C + float(rng.uniform(0.0, 5.0))
    return RunPlan(other, 0.0, ambient, int(rng.integers(1_000_000)))


def draw_sensors(rng: Rng, *, has_temperature: bool) -> Sensors:
    """Height to some microns, force to a tenth of a newton up to one."""
    return Sensors(
        sample_rate_hz=1000 if rng.random() < 0.5 else 500,
        height_noise_m=float(10.0 ** rng.uniform(-6.0, -5.0)),
        force_noise_n=float(10.0 ** rng.uniform(-1.0, 0.0)),
        has_temperature=has_temperature,
    )


def linear_force_n(bench: Bench, path: Samples) -> Samples:
    """(n,) force of spring and damper alone, along (3, n) height, velocity, acceleration."""
    spring = -bench.stiffness_n_per_m * (path[0] - bench.free_length_m)
    return spring - bench.damping_n_s_per_m * path[1]


def nominal_of(bench: Bench, plan: RunPlan) -> Nominal:
    """The run without effects; the swing of the strut's force stands for a load."""
    stroke = plan.excitation
    path = stroke_path(stroke, np.arange(0.0, stroke.duration_s, 1.0 / PLANNING_RATE_HZ))
    load_rms_n = float(np.std(linear_force_n(bench, path)))
    return Nominal(bench, stroke, path[0] - bench.free_length_m, path[1], path[2], load_rms_n)


def is_fit(bench: Bench, effects: tuple[Planted, ...], plan: RunPlan) -> bool:
    """Whether one could run it: no strut that is shorter than nothing, no force that breaks it."""
    _, motion = true_path(bench, effects, plan, PLANNING_RATE_HZ, PLANNING_STEPS)
    force = strut_force_n(bench, motion)
    return bool(
        np.all(np.isfinite(force))
        and np.abs(force).max() < FORCE_LIMIT_N
        and motion.height_m.min() > HEIGHT_LOW_M
        and np.abs(motion.velocity_m_per_s).max() < SPEED_LIMIT_M_PER_S
    )
