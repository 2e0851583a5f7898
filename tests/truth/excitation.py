"""Loads and strokes as functions of continuous time, and forces that depend on time alone."""

import numpy as np
from scipy.interpolate import CubicSpline

from tests.truth.plant import Bench, Excitation, Samples, Stroke

RAMP_S = 0.5


def load_n(excitation: Excitation, bench: Bench, t_s: Samples) -> Samples:
    """Commanded load at any times; before time zero it is the bias.

    Args:
        excitation: The load.
        bench: For the shaping by dynamic stiffness.
        t_s: (n,) times.

    Returns:
        (n,) load in N.
    """
    wave = {"multisine": _multisine, "sweep": _sweep, "noise": _noise}[excitation.shape]
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.clip(t_s / RAMP_S, 0.0, 1.0))
    dynamic = excitation.amplitude_n * ramp * wave(excitation, bench, t_s)
    return excitation.bias_n + np.where(t_s > 0.0, dynamic, 0.0)


def _shaping(excitation: Excitation, bench: Bench, frequency_hz: Samples) -> Samples:
    ratio = frequency_hz / bench.natural_hz
    dynamic_stiffness = np.abs(1.0 - ratio**2 + 2j * bench.damping_ratio * ratio)
    return np.clip(dynamic_stiffness, 0.05, 20.0) ** excitation.tilt


def _multisine(excitation: Excitation, bench: Bench, t_s: Samples) -> Samples:
    rng = np.random.default_rng([excitation.seed, 1])
    lines = int(rng.integers(7, 16))
    edges = np.geomspace(excitation.low_hz, excitation.high_hz, lines + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    phases = rng.uniform(0.0, 2.0 * np.pi, lines)
    amplitudes = _shaping(excitation, bench, frequencies)
    amplitudes *= np.sqrt(2.0 / np.sum(amplitudes**2))
    total = np.zeros_like(t_s)
    for amplitude, frequency, phase in zip(amplitudes, frequencies, phases, strict=True):
        total += amplitude * np.sin(2.0 * np.pi * frequency * t_s + phase)
    return total


def _sweep(excitation: Excitation, bench: Bench, t_s: Samples) -> Samples:
    low, high = excitation.low_hz, excitation.high_hz
    if np.random.default_rng([excitation.seed, 2]).random() < 0.5:
        low, high = high, low
    growth = np.log(high / low) / excitation.duration_s
    frequency = low * np.exp(growth * t_s)
    phase = 2.0 * np.pi * low * np.expm1(growth * t_s) / growth
    amplitude = _shaping(excitation, bench, frequency)
    scale = np.sqrt(2.0) / np.sqrt(np.mean(_shaping(excitation, bench, _log_band(excitation)) ** 2))
    return scale * amplitude * np.sin(phase)


def _log_band(excitation: Excitation) -> Samples:
    return np.geomspace(excitation.low_hz, excitation.high_hz, 200)


def _noise(excitation: Excitation, bench: Bench, t_s: Samples) -> Samples:
    rate = 25.0 * excitation.high_hz
    count = int((excitation.duration_s + 4.0) * rate)
    white = np.random.default_rng([excitation.seed, 3]).standard_normal(count)
    spectrum = np.fft.rfft(white)
    frequencies = np.fft.rfftfreq(count, 1.0 / rate)
    roll_off = 1.0 / np.sqrt(1.0 + (frequencies / excitation.high_hz) ** 12)
    roll_on = 1.0 - np.exp(-((frequencies / excitation.low_hz) ** 4))
    spectrum *= roll_off * roll_on * _shaping(excitation, bench, frequencies)
    values = np.fft.irfft(spectrum, count)
    spline = CubicSpline(np.arange(count) / rate - 2.0, values / np.std(values))
    return np.asarray(spline(np.clip(t_s, -2.0, excitation.duration_s + 1.9)))


def stroke_path(stroke: Stroke, t_s: Samples) -> Samples:
    """(3, n) height, velocity and acceleration of an prescribed motion at any times."""
    rng = np.random.default_rng([stroke.seed, 7])
    lines = int(rng.integers(7, 16))
    edges = np.geomspace(stroke.low_hz, stroke.high_hz, lines + 1)
    frequencies = rng.uniform(edges[:-1], edges[1:])
    phases = rng.uniform(0.0, 2.0 * np.pi, lines)
    amplitudes = frequencies**-stroke.tilt

    def wave(at_s: Samples) -> Samples:
        total = np.zeros((3, at_s.size))
        for amplitude, frequency, phase in zip(amplitudes, frequencies, phases, strict=True):
            omega = 2.0 * np.pi * frequency
            angle = omega * at_s + phase
            height = amplitude * np.sin(angle)
            total[0] += height
            total[1] += amplitude * omega * np.cos(angle)
            total[2] -= omega**2 * height
        return total

    reach = np.ptp(wave(np.arange(0.0, stroke.duration_s, 0.002))[0])
    path = stroke.stroke_m / reach * wave(t_s)
    path[0] += stroke.middle_m
    return path


def tone_n(truth: dict[str, float], t_s: Samples) -> Samples:
    """A sine of force, locked to the run's clock; some have a first overtone."""
    phase = 2.0 * np.pi * truth["frequency_hz"] * t_s + truth["phase_rad"]
    overtone = np.sin(2.0 * phase + truth.get("overtone_rad", 0.0))
    return truth["force_n"] * (np.sin(phase) + truth.get("overtone", 0.0) * overtone)


def wander_n(truth: dict[str, float], t_s: Samples) -> Samples:
    """A random force that follows nothing: band-limited noise."""
    rng = np.random.default_rng([int(truth["draw"]), 4])
    rate = 4.0 * truth["bandwidth_hz"]
    knots = np.arange(-1.0, t_s[-1] + 2.0, 1.0 / rate)
    spline = CubicSpline(knots, rng.standard_normal(knots.size))
    return truth["force_n"] * np.asarray(spline(t_s))


def chaos_n(truth: dict[str, float], t_s: Samples) -> Samples:
    """The first coordinate of Lorenz's attractor as a force."""
    step = 0.004
    point = np.array([1.0, 1.0, 20.0]) + np.random.default_rng(int(truth["draw"])).random(3)
    count = int(t_s[-1] * truth["speed_per_s"] / step) + 2002
    track = np.empty(count)
    for i in range(count):
        k1 = _lorenz(point)
        k2 = _lorenz(point + 0.5 * step * k1)
        point = point + step * k2
        track[i] = point[0]
    spline = CubicSpline(np.arange(count - 2000) * step / truth["speed_per_s"], track[2000:])
    return truth["force_n"] / 8.0 * np.asarray(spline(t_s))


def _lorenz(point: Samples) -> Samples:
    x, y, z = point
    return np.array([10.0 * (y - x), x * (28.0 - z) - y, x * y - 8.0 / 3.0 * z])


def telegraph(truth: dict[str, float], t_s: Samples) -> Samples:
    """A signal that switches between 0 and 1 at random times."""
    rng = np.random.default_rng([int(truth["draw"]), 5])
    pauses = rng.exponential(truth["mean_time_s"], 400) + 0.3
    return (np.searchsorted(np.cumsum(pauses), t_s) % 2).astype(np.float64)


def pumping(truth: dict[str, float], t_s: Samples) -> Samples:
    """A signal between -1 and 1 that swings by itself."""
    return np.cos(2.0 * np.pi * truth["frequency_hz"] * t_s)
