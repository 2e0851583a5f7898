"""Test days of a damper on a sine machine, with what goes wrong on them, and their true figures.

A day is a list of steps with rests between them. The machine begins a step from rest at mid-stroke
with a quarter of a cycle, and ends it with one; it may build up and reduce the amplitude over a
cycle. The damper has a gas column, dry friction that builds up over a short travel, and valves with
a knee, whose damping falls with temperature. The load cell may lag, drift, clip and spike.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

MIDDLE_M = 0.35


@dataclass(frozen=True)
class Damper:
    """Parameters of a damper; `_up` is rebound, the others compression."""

    gas_n: float = 200.0
    column_m: float = 0.12
    friction_n: float = 20.0
    below: float = 3000.0
    above: float = 700.0
    knee: float = 0.12
    below_up: float = 5000.0
    above_up: float = 1200.0
    knee_up: float = 0.12
    bleed: float = 0.0
    per_kelvin: float = 0.0
    """Relative change of the damping per kelvin."""

    def gas(self, x_m):
        """Gas force at a height above mid-stroke."""
        return self.gas_n * (1.0 + x_m / self.column_m) ** -1.3

    def rate(self):
        """Fall of the gas force per height at mid-stroke."""
        return 1.3 * self.gas_n / self.column_m

    def valves(self, v, warm_k):
        """Force of the valves at a velocity, at a temperature above that of the start."""
        speed = np.abs(v)
        down = v < 0.0
        below, above, knee = (
            np.where(down, *both)
            for both in (
                (self.below, self.below_up),
                (self.above, self.above_up),
                (self.knee, self.knee_up),
            )
        )
        force = below * np.minimum(speed, knee) + above * np.maximum(speed - knee, 0.0)
        force = force * (1.0 + self.per_kelvin * warm_k) - self.bleed * np.minimum(speed, knee)
        return -np.sign(v) * force

    def force(self, x_m, v, warm_k):
        """Its force at a motion."""
        return self.gas(x_m) + self.valves(v, warm_k) - self.friction_n * np.tanh(v / 2e-4)


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
    lag_s: float = 0.0
    drift_n: float = 0.0
    clips_n: float = math.inf
    spikes: int = 0
    ramp: bool = False
    warms_k: float = 0.0
    first_rest_s: float = 1.0
    begins: tuple[float, ...] = field(default=(), compare=False)

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
        """Temperature above that of the start: it rises with time, towards an end."""
        return self.warms_k * (1.0 - np.exp(-3.0 * t_s / self.length_s))

    def record(self, seed):
        """Times, measured heights, forces and temperatures."""
        rng = np.random.default_rng(seed)
        t_s = np.arange(int(self.length_s * self.rate_hz)) / self.rate_hz
        x, _ = self.motion(t_s)
        late = t_s - self.lag_s
        force = self.damper.force(*self.motion(late), self.warm_k(late))
        force = force + self.drift_n * t_s / self.length_s
        force = np.clip(force, -self.clips_n, self.clips_n)
        force = force + self.noise_n * rng.standard_normal(len(t_s))
        for at in rng.integers(0, len(t_s), self.spikes):
            force[at] += 5000.0 * rng.choice([-1.0, 1.0])
        height = MIDDLE_M + x + self.noise_m * rng.standard_normal(len(t_s))
        warm = 22.0 + self.warm_k(t_s) + 0.05 * rng.standard_normal(len(t_s))
        return t_s, height, force, warm

    def truth(self, index):
        """True figures of a step, at its mean temperature."""
        step, begin = self.steps[index], self.starts_s()[index]
        warm = float(np.mean(self.warm_k(np.linspace(begin, begin + step.length_s, 1001))))
        v, at = step.speed_m_per_s, np.zeros(1)
        down, up = (float(self.damper.force(at, np.full(1, s * v), warm)[0]) for s in (-1.0, 1.0))
        return {"compression": down, "rebound": up}


SPEEDS = (0.003, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0, 1.3)


def usual(**changes):
    """A day of six steps with rests of half a second."""
    steps = tuple(
        Step(0.025, speed, 2 if speed < 0.01 else 8) for speed in (0.003, 0.05, 0.1, 0.2, 0.4, 0.8)
    )
    return replace(Day(Damper(), steps), **changes)


def drawn(rng):
    """A day at random."""
    scattered = {
        name: getattr(Damper(), name) * float(rng.uniform(0.6, 1.6))
        for name in ("gas_n", "friction_n", "below", "above", "knee", "below_up", "above_up")
    }
    damper = replace(
        Damper(),
        **scattered,
        knee_up=0.12 * float(rng.uniform(0.6, 1.6)),
        bleed=float(rng.choice([0.0, 200.0])),
        per_kelvin=float(rng.choice([0.0, -0.003])),
    )
    count = int(rng.integers(1, 9))
    speeds = sorted(rng.choice(SPEEDS, count, replace=False))
    amplitude = float(rng.choice([0.0125, 0.025, 0.05]))
    steps = tuple(
        Step(
            amplitude,
            float(speed),
            int(rng.integers(2, 4)) if speed < 0.01 else int(rng.integers(4, 13)),
            float(rng.choice([0.0, 0.2, 0.35, 0.5, 1.0, 2.0])),
        )
        for speed in speeds
    )
    fastest_hz = max(step.omega for step in steps) / (2.0 * math.pi)
    rates = [rate for rate in (200.0, 500.0, 1000.0, 2000.0, 5000.0) if rate > 20.0 * fastest_hz]
    peak_n = max(
        abs(float(damper.force(np.zeros(1), np.full(1, sign * speeds[-1]), 0.0)[0]))
        for sign in (-1.0, 1.0)
    )
    fault = str(rng.choice(["none", "none", "lag", "drift", "clipping", "spikes"]))
    return Day(
        damper,
        steps,
        rate_hz=float(rng.choice(rates)),
        noise_n=peak_n * float(rng.choice([0.001, 0.003, 0.01])),
        lag_s=float(rng.uniform(1e-3, 1e-2)) if fault == "lag" else 0.0,
        drift_n=peak_n * float(rng.uniform(0.05, 0.2)) if fault == "drift" else 0.0,
        clips_n=peak_n * float(rng.uniform(0.5, 0.9)) if fault == "clipping" else math.inf,
        spikes=int(rng.integers(1, 6)) if fault == "spikes" else 0,
        ramp=bool(rng.integers(0, 2)),
        warms_k=float(rng.choice([0.0, 15.0])),
    ), fault
