"""A case becomes two recordings."""

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import lfilter

from tests.truth import compiled
from tests.truth import excitation as loads
from tests.truth.integrator import MINIMUM_RATE_HZ, Drive, Motion, follow, integrate
from tests.truth.plant import (
    Bench,
    Case,
    Planted,
    Recording,
    RunPlan,
    Samples,
    Sensors,
    Stroke,
)

BAND_HZ = 25.0
FINE_LAWS = frozenset({"bristle"})


def steps_per_sample(effects: tuple[Planted, ...], sample_rate_hz: int) -> int:
    """Integration steps a sample: 20 kHz, and 60 kHz where a law is stiff."""
    stiff = any(effect.law in FINE_LAWS for effect in effects)
    return MINIMUM_RATE_HZ // sample_rate_hz * (3 if stiff else 1)


def _scalars(effects: tuple[Planted, ...], law: str) -> list[dict[str, float]]:
    return [effect.truth for effect in effects if effect.law == law]


def _gain(effects: tuple[Planted, ...]) -> float:
    return 1.0 + sum(truth["fraction"] for truth in _scalars(effects, "load_scale"))


def _lag_s(effects: tuple[Planted, ...]) -> float:
    return sum(truth["lag_s"] for truth in _scalars(effects, "late_load"))


def timed_force_n(effect: Planted, load_at, t_s: Samples) -> Samples:
    """Force of an effect that is a function of time alone; zero for the others."""
    if effect.law == "constant":
        return np.full_like(t_s, effect.truth["force_n"])
    if effect.law == "load_scale":
        return effect.truth["fraction"] * load_at(t_s)
    if effect.law == "late_load":
        return load_at(t_s - effect.truth["lag_s"]) - load_at(t_s)
    timed = {"tone": loads.tone_n, "wander": loads.wander_n, "chaos": loads.chaos_n}
    if effect.law in timed:
        return timed[effect.law](effect.truth, t_s)
    return np.zeros_like(t_s)


def _gate(effects: tuple[Planted, ...], t_s: Samples) -> Samples:
    for effect in effects:
        if effect.law == "gated_spring":
            swings = "frequency_hz" in effect.truth
            return (loads.pumping if swings else loads.telegraph)(effect.truth, t_s)
    return np.zeros_like(t_s)


def true_motion(
    bench: Bench,
    effects: tuple[Planted, ...],
    plan: RunPlan,
    sample_rate_hz: int,
    steps: int,
    resolution_n: float = 0.0,
) -> tuple[Samples, Motion]:
    """Integrate one run, with so many steps a sample.

    The load is what was commanded, or, with a resolution, what its sensor makes of that.

    Returns:
        (n,) sample times in s, and the motion with every effect's force.
    """
    samples = round(plan.excitation.duration_s * sample_rate_hz) + 1
    half_steps = np.arange(2 * steps * (samples - 1) + 1) / (2.0 * steps * sample_rate_hz)
    t_s = half_steps[:: 2 * steps]
    sampled = loads.load_n(plan.excitation, bench, t_s)
    error = _quantised(sampled, resolution_n) - sampled if resolution_n else np.zeros_like(t_s)

    def load_at(any_s: Samples) -> Samples:
        return loads.load_n(plan.excitation, bench, any_s) + np.interp(any_s, t_s, error)

    drive = _gain(effects) * load_at(half_steps - _lag_s(effects))
    for effect in effects:
        if effect.law not in {"load_scale", "late_load"}:
            drive = drive + timed_force_n(effect, load_at, half_steps)
    rest = (plan.excitation.bias_n - bench.weight_n) / bench.stiffness_n_per_m
    step_s = 1.0 / (steps * sample_rate_hz)
    motion = integrate(
        bench,
        effects,
        Drive(drive, _gate(effects, half_steps), step_s, steps),
        bench.free_length_m + rest + plan.start_offset_m,
        plan.ambient_c,
    )
    for column, effect in enumerate(effects):
        motion.force_n[:, column] += timed_force_n(effect, load_at, t_s)
    return t_s, motion


def true_path(
    bench: Bench, effects: tuple[Planted, ...], plan: RunPlan, sample_rate_hz: int, steps: int
) -> tuple[Samples, Motion]:
    """Follow one run of a dyno, with so many steps a sample.

    Returns:
        (n,) sample times in s, and the prescribed motion with every effect's force.
    """
    samples = round(plan.excitation.duration_s * sample_rate_hz) + 1
    half_steps = np.arange(2 * steps * (samples - 1) + 1) / (2.0 * steps * sample_rate_hz)
    nothing = np.zeros_like(half_steps)
    drive = Drive(nothing, nothing, 1.0 / (steps * sample_rate_hz), steps)
    path = loads.stroke_path(plan.excitation, half_steps)
    motion = follow(bench, effects, drive, path, plan.ambient_c)
    t_s = half_steps[:: 2 * steps]
    for column, effect in enumerate(effects):
        motion.force_n[:, column] += timed_force_n(effect, np.zeros_like, t_s)
    return t_s, motion


def strut_force_n(bench: Bench, motion: Motion) -> Samples:
    """(n,) force of spring, damper and effects together, positive where it pushes apart."""
    spring = -bench.stiffness_n_per_m * (motion.height_m - bench.free_length_m)
    return spring - bench.damping_n_s_per_m * motion.velocity_m_per_s + motion.force_n.sum(axis=1)


def _quantised(values: Samples, step: float) -> Samples:
    return np.round(values / step) * step


def _coloured(white: Samples, sensors: Sensors) -> Samples:
    """Noise of the same variance through a first-order low-pass."""
    if sensors.noise_time_s <= 0.0:
        return white
    kept = np.exp(-1.0 / (sensors.sample_rate_hz * sensors.noise_time_s))
    fresh = np.sqrt(1.0 - kept**2)
    begun = fresh * white
    begun[0] = white[0]
    return lfilter([1.0], [1.0, -kept], begun)


def _late(t_s: Samples, motion: Motion, late_s: float) -> Samples:
    """Heights as they were some time before."""
    if late_s == 0.0:
        return motion.height_m
    heights = CubicHermiteSpline(t_s, motion.height_m, motion.velocity_m_per_s)
    return heights(np.maximum(t_s - late_s, t_s[0]))


def _temperature_c(
    effects: tuple[Planted, ...], motion: Motion, plan: RunPlan, t_s: Samples
) -> Samples:
    start = 0
    for effect in effects:
        if effect.law == "thin_oil":
            return plan.ambient_c + motion.memory[:, start]
        start += compiled.MEMORY.get(effect.law, 0) + 1
    # A hall that warms up has nothing to do with the strut.
    return plan.ambient_c + 3.0 * (1.0 - np.exp(-t_s / 9.0)) + 0.5 * np.sin(0.7 * t_s)


def record(case: Case, plan: RunPlan) -> Recording:
    """Simulate and measure one run of a case."""
    bench, effects, sensors = case.bench, case.effects, case.sensors
    rate_hz = sensors.sample_rate_hz
    simulated = true_path if case.is_dyno else true_motion
    t_s, motion = simulated(bench, effects, plan, rate_hz, steps_per_sample(effects, rate_hz))
    rng = np.random.default_rng([plan.noise_seed, 6])
    noise = sensors.height_noise_m * _coloured(rng.standard_normal(t_s.size), sensors)
    temperature = load = cell = None
    if sensors.has_temperature:
        wobble = sensors.temperature_noise_k * rng.standard_normal(t_s.size)
        temperature = _temperature_c(effects, motion, plan, t_s) + wobble
    if isinstance(plan.excitation, Stroke):
        cell = strut_force_n(bench, motion)
        cell += sensors.force_noise_n * _coloured(rng.standard_normal(t_s.size), sensors)
        cell = _quantised(cell, sensors.load_step_n)
    else:
        load = loads.load_n(plan.excitation, bench, t_s) / (1.0 + case.roughness.input_gain)
        load = _quantised(load, sensors.load_step_n)
    return Recording(
        t_s,
        _quantised(_late(t_s, motion, sensors.late_s) + noise, sensors.height_step_m),
        load,
        cell,
        temperature,
        motion.height_m,
        motion.velocity_m_per_s,
        motion.acceleration_m_per_s2,
        motion.force_n,
    )


def simulate(case: Case) -> tuple[Recording, Recording]:
    """Both runs of a case: the one to diagnose, and the held-out one."""
    return record(case, case.train), record(case, case.held_out)


def height_floor_m(case: Case) -> float:
    """RMS height that a right model leaves on the held-out run of a case, which is no dyno.

    The height sensor's error, and what the resolution of the measured load moves: nothing on most
    benches, but a body that rattles in its play answers to it with another motion.
    """
    rate_hz = case.sensors.sample_rate_hz
    steps = steps_per_sample(case.effects, rate_hz)
    heights = [
        true_motion(case.bench, case.effects, case.held_out, rate_hz, steps, step_n)[1].height_m
        for step_n in (0.0, case.sensors.load_step_n)
    ]
    moved = float(np.sqrt(np.mean((heights[1] - heights[0]) ** 2)))
    return float(np.hypot(case.sensors.height_error_m, moved))


def force_noise_floor_n(case: Case) -> float:
    """RMS of the force that the sensors' noise alone feigns, between 0 and 25 Hz.

    White height noise of RMS s, sampled f_s times a second, has the one-sided spectral density
    2 s^2 / f_s. A smoother that knows m, C and K exactly reads a force by multiplying with the
    dynamic stiffness |K - m w^2 + j C w|; whatever it does, inside the band in which it wants to
    see forces this noise passes. 25 Hz is twice the highest frequency of any load and above any
    planted resonance or tone, so it is the least band in which all that is planted shows.

    On a dyno no mass moves between height and load cell, and the cell's own white noise comes in.
    """
    bench, sensors = case.bench, case.sensors
    mass_kg, cell_n = (0.0, sensors.force_error_n) if case.is_dyno else (bench.mass_kg, 0.0)
    frequency = np.linspace(0.0, BAND_HZ, 2001)
    omega = 2.0 * np.pi * frequency
    stiffness = np.abs(
        bench.stiffness_n_per_m - mass_kg * omega**2 + 1j * bench.damping_n_s_per_m * omega
    )
    squared = sensors.height_error_m**2 * np.trapezoid(stiffness**2, frequency)
    squared += cell_n**2 * BAND_HZ
    return float(np.sqrt(2.0 * squared / sensors.sample_rate_hz))


def effect_force_rms_n(recording: Recording) -> Samples:
    """(effects,) RMS of every planted force over a run."""
    return np.sqrt(np.mean(recording.effect_force_n**2, axis=0))


def floor_ratios(case: Case, recording: Recording) -> Samples:
    """(effects,) how far above the noise floor every planted force stands."""
    return effect_force_rms_n(recording) / force_noise_floor_n(case)
