"""A little dyno: a strut on an imposed motion, with one force that the model lacks.

Its formulas are written here on their own, and what has memory takes small steps.
"""

import math

import numpy as np

from dart_model.spec import parse_model
from rig.identify.records import Record

STIFFNESS, DAMPING, FREE, GRAVITY = 8000.0, 900.0, 0.32, 9.81
MIDDLE = 0.3

MODEL = f"""
name: little_dyno
gravity_m_per_s2: {GRAVITY}
skeleton:
  bodies:
    - {{name: rod, mass_kg: 3.0, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: strut
    between: [world, rod]
    free_length_m: {FREE}
    stiffness_n_per_m: {STIFFNESS}
    damping_n_s_per_m: {DAMPING}
"""

LINES = tuple((0.011 / (1.0 + 0.7 * k), 0.31 + 0.83 * k, 1.3 * k * k) for k in range(7))
"""Amplitude (m), frequency (Hz) and phase (rad) of the lines of a broad motion."""


def model():
    return parse_model(MODEL, "little_dyno")


def broad(t):
    """Height and velocity of many lines."""
    z, v = MIDDLE, 0.0
    for amplitude, frequency, phase in LINES:
        omega = 2.0 * math.pi * frequency
        z += amplitude * math.sin(omega * t + phase)
        v += amplitude * omega * math.cos(omega * t + phase)
    return z, v


def later(t):
    """The same a while later, at a little less stroke."""
    z, v = broad(t + 31.0)
    return MIDDLE + 0.85 * (z - MIDDLE), 0.85 * v


def one_line(t):
    """A sine."""
    omega = 2.0 * math.pi * 2.0
    return MIDDLE + 0.012 * math.sin(omega * t), 0.012 * omega * math.cos(omega * t)


class Nothing:
    """No effect; the others change what they need."""

    size = 0

    def force(self, t, z, v, state, warm):
        return 0.0

    def rate(self, t, z, v, state):
        return ()


def run(
    effect, seed=1, duration_s=12.0, rate_hz=500, motion=broad, height_noise_m=2e-6,
    force_noise_n=1.0, fine=20, name=None, state=None, warm=None,
):  # fmt: skip
    """Record of the dyno with an effect: heights and forces noisy and rounded, as a bus has them.

    Args:
        effect: What the strut does beside its spring and damper.
        seed: Of the noise.
        duration_s: Length of the run.
        rate_hz: Samples a second.
        motion: Height and velocity of a time.
        height_noise_m: Standard deviation.
        force_noise_n: Standard deviation.
        fine: Steps of the memory between samples.
        name: Of the record.
        state: Memory at the start.
        warm: Temperature (°C) of a time; not measured if absent.
    """
    h = 1.0 / (rate_hz * fine)
    state = list(state) if state else [0.0] * effect.size
    heights, forces = [], []
    times = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    for k, t in enumerate(times.tolist()):
        z, v = motion(t)
        celsius = warm(t) if warm else 20.0
        extra = effect.force(t, z, v, state, celsius)
        heights.append(z)
        forces.append(-STIFFNESS * (z - FREE) - DAMPING * v + extra)
        if not effect.size:
            continue
        for j in range(fine):
            now = (k * fine + j) * h
            mid = [
                s + 0.5 * h * d
                for s, d in zip(state, effect.rate(now, *motion(now), state), strict=True)
            ]
            then = now + 0.5 * h
            slope = effect.rate(then, *motion(then), mid)
            state = [s + h * d for s, d in zip(state, slope, strict=True)]
    rng = np.random.default_rng(seed)
    noisy_m = np.array(heights) + rng.normal(0.0, height_noise_m, len(heights))
    noisy_n = np.array(forces) + rng.normal(0.0, force_noise_n, len(forces))
    return Record(
        name or f"dyno{seed}",
        times,
        (np.round(noisy_m / 1e-7) * 1e-7)[:, np.newaxis],
        None,
        np.round(noisy_n / 0.1) * 0.1,
        np.array([warm(t) for t in times.tolist()]) if warm else None,
    )
