"""A little bench: one body on a spring and a damper, and one force that the model lacks.

Its formulas are written here on their own, and its integrator takes small steps.
"""

import math

import numpy as np

from dart_model.spec import parse_model
from rig.identify.records import Record

MASS, STIFFNESS, DAMPING, FREE, GRAVITY = 12.0, 2500.0, 70.0, 0.4, 9.81

MODEL = f"""
name: little
gravity_m_per_s2: {GRAVITY}
skeleton:
  bodies:
    - {{name: body, mass_kg: {MASS}, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: strut
    between: [world, body]
    free_length_m: {FREE}
    stiffness_n_per_m: {STIFFNESS}
    damping_n_s_per_m: {DAMPING}
"""

LINES = tuple(
    (14.0 / (0.4 + 0.25 * k), 2.0 * math.pi * (0.33 + 0.81 * k), 0.9 * k * k) for k in range(9)
)


def model():
    return parse_model(MODEL, "little")


def load_n(t):
    total = 0.0
    for amplitude, omega, phase in LINES:
        total += amplitude * math.sin(omega * t + phase)
    return total


def sine_n(t):
    return 80.0 * math.sin(2.0 * math.pi * 1.7 * t)


class Nothing:
    """No effect; the others change what they need."""

    mass = MASS
    size = 0
    gain = 1.0
    delay = 0.0

    def force(self, t, z, v, state):
        return 0.0

    def rate(self, t, z, v, a, state):
        return ()


def run(
    effect, seed=1, duration_s=12.0, rate_hz=250, noise_m=1e-5, load=load_n, fine=8, start=None
):
    """Record of the bench with an effect, heights noisy and quantised to 2 µm."""
    h = 1.0 / (rate_hz * fine)
    z = FREE - MASS * GRAVITY / STIFFNESS if start is None else start
    v, state = 0.0, [0.0] * effect.size
    heights = []

    def derivative(t, z, v, state):
        push = effect.gain * load(t - effect.delay) - effect.mass * GRAVITY
        push += -STIFFNESS * (z - FREE) - DAMPING * v + effect.force(t, z, v, state)
        a = push / effect.mass
        return v, a, effect.rate(t, z, v, a, state)

    def moved(z, v, state, slope, reach):
        dz, dv, ds = slope
        return (
            z + reach * dz,
            v + reach * dv,
            [s + reach * d for s, d in zip(state, ds, strict=True)],
        )

    for k in range(round(duration_s * rate_hz) + 1):
        heights.append(z)
        for j in range(fine):
            t = (k * fine + j) * h
            first = derivative(t, z, v, state)
            second = derivative(t + 0.5 * h, *moved(z, v, state, first, 0.5 * h))
            third = derivative(t + 0.5 * h, *moved(z, v, state, second, 0.5 * h))
            fourth = derivative(t + h, *moved(z, v, state, third, h))
            z, v, state = _combined(z, v, state, (first, second, third, fourth), h)
    rng = np.random.default_rng(seed)
    t_s = np.arange(len(heights)) / rate_hz
    noisy = np.array(heights) + rng.normal(0.0, noise_m, len(heights))
    return Record(
        f"run{seed}",
        t_s,
        (np.round(noisy / 2e-6) * 2e-6)[:, np.newaxis],
        np.array([load(t) for t in t_s]),
    )


def _combined(z, v, state, slopes, h):
    weights = (h / 6.0, h / 3.0, h / 3.0, h / 6.0)
    for weight, (dz, dv, ds) in zip(weights, slopes, strict=True):
        z, v = z + weight * dz, v + weight * dv
        state = [s + weight * d for s, d in zip(state, ds, strict=True)]
    return z, v, state
