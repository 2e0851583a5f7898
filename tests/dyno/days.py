"""Test days of a damper on a sine machine, with what goes wrong on them, and their true forces.

A day is a list of steps with rests between them. The machine begins a step from rest at mid-stroke
with a quarter of a cycle, and ends it with one; it may build up and reduce the amplitude over a
cycle. The dampers are those of `tests.dyno.population`; their damping may change with temperature.
The load cell may lag, drift, be clipped before or behind its noise, and have spikes.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tests.dyno.population import MIDDLE_M, Damper, forces, law


@dataclass(frozen=True)
class Step:
    """Amplitude, peak speed and cycles of a step, and the rest after it."""

    amplitude_m: float
    speed_m_per_s: float
    cycles: int
    rest_s: float = 0.5

    @property
    def omega(self):
        return self.speed_m_per_s / self.amplitude_m

    @property
    def length_s(self):
        return 2.0 * math.pi * self.cycles / self.omega


@dataclass(frozen=True)
class Day:
    """A day: its damper, steps, sampling rate, noises, and faults of the measurement."""

    damper: Damper
    steps: tuple[Step, ...]
    rate_hz: float = 1000.0
    noise_n: float = 1.0
    noise_m: float = 5e-6
    ramp: bool = False
    first_rest_s: float = 1.0
    lag_s: float = 0.0
    drift_n: float = 0.0
    clips_n: float = math.inf
    clips_noise: bool = False
    spikes: int = 0
    zero_n: float = 0.0
    begins_k: float = 0.0
    warms_k: float = 0.0
    per_kelvin: float = 0.0

    def starts_s(self):
        """Time at which each step begins."""
        at, starts = self.first_rest_s, []
        for step in self.steps:
            starts.append(at)
            at += step.length_s + step.rest_s
        return starts

    @property
    def length_s(self):
        return self.starts_s()[-1] + self.steps[-1].length_s + self.steps[-1].rest_s

    def motion(self, t_s):
        """Height above mid-stroke and velocity at times."""
        x, v = np.zeros_like(t_s), np.zeros_like(t_s)
        for begin, step in zip(self.starts_s(), self.steps, strict=True):
            inside = (t_s >= begin) & (t_s < begin + step.length_s)
            tau = t_s[inside] - begin
            sine, cosine = np.sin(step.omega * tau), np.cos(step.omega * tau)
            grown, growth = np.ones_like(tau), np.zeros_like(tau)
            if self.ramp:
                whole = 2.0 * math.pi / step.omega
                for share, sign in ((tau / whole, 1.0), ((step.length_s - tau) / whole, -1.0)):
                    early = share < 1.0
                    grown[early] = 0.5 - 0.5 * np.cos(math.pi * share[early])
                    growth[early] = sign * 0.5 * math.pi / whole * np.sin(math.pi * share[early])
            x[inside] = step.amplitude_m * grown * sine
            v[inside] = step.amplitude_m * (grown * step.omega * cosine + growth * sine)
        return x, v

    def warm_k(self, t_s):
        """Temperature above 22 °C: that of the beginning, and what the test warms the damper by."""
        return self.begins_k + self.warms_k * (1.0 - np.exp(-3.0 * t_s / self.length_s))

    def force(self, x, v, warm_k):
        """True forces of a motion at a temperature above 22 °C."""
        cold = forces(self.damper, x, v, 1.0 / self.rate_hz)
        return cold + self.per_kelvin * warm_k * law(self.damper, v)

    def times(self):
        return np.arange(int(self.length_s * self.rate_hz)) / self.rate_hz

    def record(self, seed):
        """Times, measured heights and forces."""
        rng = np.random.default_rng(seed)
        t_s = self.times()
        x, _ = self.motion(t_s)
        late_s = t_s - self.lag_s
        force = self.force(*self.motion(late_s), self.warm_k(late_s))
        force = force + self.zero_n + self.drift_n * t_s / self.length_s
        noise = self.noise_n * rng.standard_normal(len(t_s))
        if self.clips_noise:
            force = np.clip(force + noise, -self.clips_n, self.clips_n)
        else:
            force = np.clip(force, -self.clips_n, self.clips_n) + noise
        height = MIDDLE_M + x + self.noise_m * rng.standard_normal(len(t_s))
        force[rng.integers(0, len(t_s), self.spikes)] += 5000.0
        return t_s, height, force

    def temperatures(self, seed):
        """Measured temperatures."""
        t_s = self.times()
        return (
            22.0 + self.warm_k(t_s) + 0.05 * np.random.default_rng(seed).standard_normal(len(t_s))
        )

    def truth(self, index):
        """True forces of a step at its peak speed, in compression and in rebound, at its mean
        temperature."""
        step, begin_s = self.steps[index], self.starts_s()[index]
        warm_k = float(np.mean(self.warm_k(begin_s + np.linspace(0.0, step.length_s, 1001))))
        return self.force(np.zeros(2), step.speed_m_per_s * np.array([-1.0, 1.0]), warm_k)


def usual(**changes):
    """A day of six steps with rests of half a second."""
    steps = tuple(
        Step(0.025, speed, 2 if speed < 0.01 else 8) for speed in (0.003, 0.05, 0.1, 0.2, 0.4, 0.8)
    )
    return replace(Day(Damper(), steps), **changes)
