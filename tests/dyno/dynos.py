"""Dynos whose figures have closed forms, or one by a fine quadrature of the law itself."""

import math
from typing import NamedTuple

import numpy as np

GAS_N, RATE = 180.0, 3500.0


def linear(x_m, v):
    return GAS_N - RATE * x_m - 1400.0 * v


def digressive(x_m, v):
    side = np.where(v > 0.0, 1.6, 1.0)
    return GAS_N - RATE * x_m - side * 4000.0 * v / (1.0 + np.abs(v) / 0.15)


def friction(x_m, v):
    return GAS_N - RATE * x_m - 900.0 * v - 35.0 * np.sign(v)


def gas(x_m, v):
    """A gas spring of 0.12 m of column, polytropic, and a linear damper."""
    return GAS_N * (1.0 + x_m / 0.12) ** -1.3 - 1200.0 * v


LAWS = {law.__name__: law for law in (linear, digressive, friction, gas)}


class Dyno(NamedTuple):
    """A sine machine: frequency, amplitude, samples a cycle, cycles, noises and phase."""

    law: str
    frequency_hz: float
    amplitude_m: float
    samples: float
    cycles: float
    noise_n: float
    noise_m: float
    phase: float

    def record(self, rng, begin_s=0.0):
        """Times, measured heights and forces."""
        rate = self.samples * self.frequency_hz
        t = np.arange(int(self.cycles * self.samples)) / rate
        angle = 2.0 * math.pi * self.frequency_hz * t + self.phase
        x = self.amplitude_m * np.sin(angle)
        force = LAWS[self.law](x, self.speed * np.cos(angle))
        return (
            begin_s + t,
            0.3 + x + self.noise_m * rng.standard_normal(len(t)),
            force + self.noise_n * rng.standard_normal(len(t)),
        )

    @property
    def speed(self):
        return 2.0 * math.pi * self.frequency_hz * self.amplitude_m

    def truth(self):
        """True figures by their names."""
        law, a, v = LAWS[self.law], self.amplitude_m, self.speed
        angle = np.linspace(-0.5, 0.5, 40001) * math.pi
        u, w = np.sin(angle), np.cos(angle)
        down, up = law(-a * u, -v * w), law(a * u, v * w)
        energy = float(np.trapezoid((down - up) * a * w, angle))
        inner = np.linspace(-0.9, 0.9, 20001)
        root = np.sqrt(1.0 - inner**2)
        mean = 0.5 * (law(a * inner, v * root) + law(a * inner, -v * root))
        # Of all chords through the middle, weighted as the slope of least squares is.
        rate = -float(np.trapezoid(mean * inner, inner) / np.trapezoid(inner**2, inner)) / a
        window = np.linspace(-0.1, 0.1, 2001)
        beside = np.sqrt(1.0 - window**2)
        ends = np.array([-a, a])
        small = 1e-12
        return {
            "peak velocity": v,
            "force at peak velocity": (float(law(0.0, -v)), float(law(0.0, v))),
            "window": (
                float(np.mean(law(a * window, -v * beside))),
                float(np.mean(law(a * window, v * beside))),
            ),
            "peak": (float(down.max()), float(up.min())),
            "energy": energy,
            "equivalent damping": energy / (math.pi * v * a),
            "spring rate": rate,
            "mean force": float(0.5 * (law(0.0, -v) + law(0.0, v))),
            "half difference": float(0.5 * (law(0.0, -v) - law(0.0, v))),
            "hysteresis at the turning points": float(
                np.mean(law(ends, -small) - law(ends, small))
            ),
        }


def found(step):
    """The figures of a step by the same names."""
    sides = step.compression, step.rebound
    return {
        "peak velocity": step.rebound.peak_velocity_m_per_s,
        "force at peak velocity": tuple(side.force_at_peak_velocity_n for side in sides),
        "window": tuple(side.force_window_n for side in sides),
        "peak": tuple(side.peak_force_n for side in sides),
        "energy": step.energy_per_cycle_j,
        "equivalent damping": step.equivalent_damping_n_s_per_m,
        "spring rate": step.spring_rate_n_per_m,
        "mean force": step.mean_force_n,
        "half difference": step.half_difference_n,
        "hysteresis at the turning points": step.hysteresis_at_zero_n,
    }


def drawn(rng):
    """A dyno at random: 16 to 400 samples a cycle, noise of 0.2 to 3 % of the peak force."""
    law = str(rng.choice(list(LAWS)))
    frequency, amplitude = float(rng.uniform(0.3, 4.0)), float(rng.uniform(0.008, 0.03))
    speed = 2.0 * math.pi * frequency * amplitude
    peak = float(np.ptp(LAWS[law](np.zeros(2), np.array([-speed, speed])))) / 2.0
    return Dyno(
        law,
        frequency,
        amplitude,
        float(rng.choice([16.0, 16.3, 40.0, 100.0, 400.0])),
        float(rng.uniform(5.0, 15.0)),
        peak * float(rng.choice([0.002, 0.01, 0.03])),
        1e-3 * amplitude * float(rng.choice([0.1, 1.0])),
        float(rng.uniform(0.0, 2.0 * math.pi)),
    )
