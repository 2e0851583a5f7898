"""A little dyno: a strut on a prescribed motion, with one force that the model lacks.

Its formulas are written here on their own, and what has an internal state takes small steps.
"""

import math

import numpy as np

from dart_model.spec import parse_model
from rig.recordings.recording import Recording
from tests.diagnosis.integrator import measured

STIFFNESS, DAMPING, FREE, GRAVITY = 8000.0, 900.0, 0.32, 9.81
MIDDLE = 0.3

LINES = tuple((0.011 / (1.0 + 0.7 * k), 0.31 + 0.83 * k, 1.3 * k * k) for k in range(7))
"""Amplitude (m), frequency (Hz) and phase (rad) of the lines of a broad motion."""


def model(
    mass=3.0, stiffness=STIFFNESS, damping=DAMPING, free=FREE, gravity=GRAVITY, strut="strut",
    effects="[]",
):  # fmt: skip
    """Nominal model; exact and without effects by default."""
    text = f"""
name: little_dyno
gravity_m_per_s2: {gravity!r}
skeleton:
  bodies:
    - {{name: rod, mass_kg: {mass!r}, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: {strut}
    between: [world, rod]
    free_length_m: {free!r}
    stiffness_n_per_m: {stiffness!r}
    damping_n_s_per_m: {damping!r}
    effects: {effects}
"""
    return parse_model(text, "little_dyno")


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


def resting(t):
    """Strokes of rising speed; after each the strut rests at its lower end for 1.6 s."""
    stroke, number = 0.045, 0
    duration = 1.4
    while t > duration + 1.6:
        t -= duration + 1.6
        number += 1
        duration = max(0.3, 0.72 * duration)
    if t >= duration:
        return MIDDLE - 0.5 * stroke, 0.0
    omega = 2.0 * math.pi / duration
    lift = 0.5 * (1.0 - math.cos(omega * t))
    return (
        MIDDLE + stroke * (lift * lift - 0.5),
        stroke * lift * omega * math.sin(omega * t),
    )


class Nothing:
    """No effect; the others change what they need."""

    size = 0

    def force(self, t, z, v, state, warm):
        return 0.0

    def rate(self, t, z, v, state):
        return ()


def run(
    effect, seed=1, duration_s=12.0, rate_hz=500, motion=broad, height_noise_m=2e-6,
    force_noise_n=1.0, fine=20, name=None, state=None, warm=None, resolution_m=1e-7,
):  # fmt: skip
    """Recording of the dyno with an effect: heights and forces noisy and rounded.

    Args:
        effect: What the strut does beside its spring and damper.
        seed: Of the noise.
        duration_s: Length of the recording.
        rate_hz: Samples a second.
        motion: Height and velocity of a time.
        height_noise_m: Standard deviation.
        force_noise_n: Standard deviation.
        fine: Steps of the internal state between samples.
        name: Of the recording.
        state: Internal state at the start.
        warm: Temperature (°C) of a time; not measured if absent.
        resolution_m: Of the height.
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
    noisy_m = measured(np.array(heights), height_noise_m, resolution_m, seed)
    noisy_n = measured(np.array(forces), force_noise_n, 0.1, seed + 1000)
    return Recording(
        name or f"dyno{seed}",
        times,
        noisy_m[:, np.newaxis],
        {},
        noisy_n[:, np.newaxis],
        np.array([warm(t) for t in times.tolist()]) if warm else None,
    )
