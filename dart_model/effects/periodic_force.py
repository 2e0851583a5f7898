"""A force that was not commanded: unbalance or motor ripple."""

import math

from dart_model.effects.law import Effect, Motion, Parameter, Start
from dart_model.effects.ranges import within

_LEAST_PERIODS = 5.0
"""Least number of periods in the longest recording: fewer look like a drift, or like what a formula
of a damper errs by, as the size of the motion changes."""


def _sine(t_s: float, amplitude_n: float, frequency_hz: float, phase_rad: float) -> float:
    return amplitude_n * math.sin(2.0 * math.pi * frequency_hz * t_s + phase_rad)


def _starts(motion: Motion) -> list[Start]:
    return [(1.0, frequency_hz, phase_rad) for frequency_hz, phase_rad in motion.tones]


PERIODIC_FORCE = Effect(
    name="periodic_force",
    family="periodic_force",
    words="a periodic force",
    parameters=(
        Parameter("amplitude_n", "N", 0.0, 1e12, "amplitude"),
        Parameter("frequency_hz", "Hz", 1e-9, 1e9, "frequency"),
        Parameter("phase_rad", "rad", -100.0, 100.0, "phase of the sine at time zero"),
    ),
    force=_sine,
    excitation=(
        "many periods of this force, and an applied force that does not contain its frequency"
    ),
    reference="Rao, Mechanical Vibrations (2017), 3.7, rotating unbalance",
    starts=_starts,
    bounds=within(frequency_hz=lambda m: (_LEAST_PERIODS / m.duration_s, 0.5 / m.step_s)),
    shown=("amplitude_n", "frequency_hz"),
)
