"""A little bench: one body on a spring and a damper, and one force that the model lacks.

Its formulas are written here on their own, and its integrator takes small steps.
"""

import math

import numpy as np

from dart_model.spec import parse_model
from rig.recordings.recording import Recording
from tests.diagnosis.driven import driven_by
from tests.diagnosis.integrator import integrated, measured

MASS, STIFFNESS, DAMPING, FREE, GRAVITY = 12.0, 2500.0, 70.0, 0.4, 9.81

LINES = tuple(
    (14.0 / (0.4 + 0.25 * k), 2.0 * math.pi * (0.33 + 0.81 * k), 0.9 * k * k) for k in range(9)
)
"""Amplitude (N), frequency (rad/s) and phase (rad) of the lines of the load."""


def model(
    mass=MASS, stiffness=STIFFNESS, damping=DAMPING, free=FREE, gravity=GRAVITY, strut="strut",
    effects="[]",
):  # fmt: skip
    """Nominal model; exact and without effects by default."""
    text = f"""
name: little
gravity_m_per_s2: {gravity!r}
skeleton:
  bodies:
    - {{name: body, mass_kg: {mass!r}, joint: {{type: prismatic, axis: [0, 0, 1], parent: world}}}}
struts:
  - name: {strut}
    between: [world, body]
    free_length_m: {free!r}
    stiffness_n_per_m: {stiffness!r}
    damping_n_s_per_m: {damping!r}
    effects: {effects}
"""
    return parse_model(text, "little")


def load_n(t):
    total = 0.0
    for amplitude, omega, phase in LINES:
        total += amplitude * math.sin(omega * t + phase)
    return total


class Nothing:
    """No effect; the others change what they need."""

    mass = MASS
    size = 0
    gain = 1.0
    delay = 0.0
    fine = 8

    def force(self, t, z, v, state):
        return 0.0

    def rate(self, t, z, v, a, state):
        return ()


def heights(effect, duration_s=12.0, rate_hz=250, load=load_n, start=None, gravity=GRAVITY):
    """Times and true heights of the bench with an effect, `effect.fine` steps a sample."""

    def derivative(t, x):
        z, v, *state = x
        push = effect.gain * load(t - effect.delay) - effect.mass * gravity
        push += -STIFFNESS * (z - FREE) - DAMPING * v + effect.force(t, z, v, state)
        a = push / effect.mass
        return [v, a, *effect.rate(t, z, v, a, state)]

    rest = FREE - MASS * gravity / STIFFNESS
    first = [rest if start is None else start, 0.0, *[0.0] * effect.size]
    samples = round(duration_s * rate_hz) + 1
    found = integrated(derivative, first, samples, 1.0 / rate_hz, effect.fine)
    return np.arange(samples) / rate_hz, found[:, 0]


def run(effect, seed=1, noise_m=1e-5, load=load_n, name=None, **kwargs):
    """Recording of the bench with an effect, heights noisy and rounded to 2 µm.

    Args:
        effect: What the bench does beside its spring and damper.
        seed: Of the noise.
        noise_m: Standard deviation.
        load: Applied force (N) of a time.
        name: Of the recording.
        kwargs: For `heights`.
    """
    t_s, true_m = heights(effect, load=load, **kwargs)
    noisy_m = measured(true_m, noise_m, 2e-6, seed)
    applied_n = np.array([load(t) for t in t_s.tolist()])
    return Recording(name or f"run{seed}", t_s, noisy_m[:, np.newaxis], driven_by(applied_n))
