"""The little benches with a channel that is late."""

import math
from dataclasses import replace

import numpy as np

from tests.diagnosis import little_bench as bench
from tests.diagnosis import little_dyno as dyno
from tests.diagnosis.integrator import measured

SINE_HZ = 2.0


def sine(t):
    """Height and velocity of a single frequency."""
    omega = 2.0 * math.pi * SINE_HZ
    return (
        dyno.MIDDLE + 0.02 * math.sin(omega * t),
        0.02 * omega * math.cos(omega * t),
    )


def dyno_run(effect, delay_s, seed=1, motion=dyno.broad, settled_s=0.0, **kwargs):
    """Recording of the dyno whose load cell is late; it ran for `settled_s` before."""

    def earlier(t):
        return motion(t - delay_s - settled_s)

    duration_s = kwargs.pop("duration_s", 12.0) + settled_s
    late = dyno.run(effect, seed=seed, motion=earlier, duration_s=duration_s, **kwargs)
    heights = np.array([motion(t - settled_s)[0] for t in late.t_s.tolist()])
    kept = late.t_s > settled_s - 1e-9
    return replace(
        late,
        t_s=late.t_s[kept] - late.t_s[kept][0],
        heights_m=measured(heights, 2e-6, 1e-7, seed)[kept, np.newaxis],
        strut_forces_n=late.strut_forces_n[kept],
    )


def bench_run(effect, delay_s, seed=1, **kwargs):
    """Recording of the driven bench whose height is late."""

    class Late(effect):
        delay = delay_s

    return bench.run(Late(), seed=seed, **kwargs)
