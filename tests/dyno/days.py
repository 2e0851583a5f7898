"""Test days of a damper on a sine machine, and their true forces.

A day is a list of steps with rests between them. The machine begins a step from rest at mid-stroke
with a quarter of a cycle, and ends it with one; it may build up and reduce the amplitude over a
cycle. The dampers are those of `tests.dyno.population`.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tests.dyno.population import MIDDLE_M, Damper, forces


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
    """A day: its damper, steps, sampling rate and noises."""

    damper: Damper
    steps: tuple[Step, ...]
    rate_hz: float = 1000.0
    noise_n: float = 1.0
    noise_m: float = 5e-6
    ramp: bool = False
    first_rest_s: float = 1.0

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

    def record(self, seed):
        """Times, measured heights and forces."""
        rng = np.random.default_rng(seed)
        t_s = np.arange(int(self.length_s * self.rate_hz)) / self.rate_hz
        x, v = self.motion(t_s)
        force = forces(self.damper, x, v, 1.0 / self.rate_hz)
        force = force + self.noise_n * rng.standard_normal(len(t_s))
        height = MIDDLE_M + x + self.noise_m * rng.standard_normal(len(t_s))
        return t_s, height, force

    def truth(self, index):
        """True forces of a step at its peak speed, in compression and in rebound."""
        v = self.steps[index].speed_m_per_s * np.array([-1.0, 1.0])
        return forces(self.damper, np.zeros(2), v, 1.0 / self.rate_hz)


def usual(**changes):
    """A day of six steps with rests of half a second."""
    steps = tuple(
        Step(0.025, speed, 2 if speed < 0.01 else 8) for speed in (0.003, 0.05, 0.1, 0.2, 0.4, 0.8)
    )
    return replace(Day(Damper(), steps), **changes)
