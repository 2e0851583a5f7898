"""What drives the bench over time: the applied force and prescribed motions."""

import math
from typing import NamedTuple

import numpy as np

from rig.simulated_bench.compilation import Floats, Integers, jit_compile
from rig.simulated_bench.curves import Curves, curve_segment

SINE_COLUMNS = 3
"""amplitude_n, rate_rad_per_s, phase_rad."""
SWEEP_COLUMNS = 5
"""amplitude_n, start_hz, end_hz, duration_s, 1 if the spacing is logarithmic else 0."""


class DrivenForce(NamedTuple):
    """The applied force.

    Attributes:
        gain: Undeclared factor between the force applied and the force that acts.
        delay_s: Undeclared delay between them.
        sines: Shape (sines, 3), see `SINE_COLUMNS`.
        sweeps: Shape (sweeps, 5), see `SWEEP_COLUMNS`.
        file_first: First sample of each file, and one past the last, shape (files + 1,).
        file_t_s: Times of all files, shape (samples,).
        file_force_n: Forces of all files, shape (samples,).
    """

    gain: float
    delay_s: float
    sines: Floats
    sweeps: Floats
    file_first: Integers
    file_t_s: Floats
    file_force_n: Floats


class DrivenHeights(NamedTuple):
    """The motions prescribed on struts, one after another.

    Attributes:
        mean_height_m: Height about which each moves, shape (motions,).
        firsts: First sine, sweep and file of each motion, and one past the last, shape
            (3, motions + 1).
        sines: Shape (sines, 3), see `SINE_COLUMNS`, in m.
        sweeps: Shape (sweeps, 5), see `SWEEP_COLUMNS`, in m.
        files: Heights over time, as curves.
    """

    mean_height_m: Floats
    firsts: Integers
    sines: Floats
    sweeps: Floats
    files: Curves


class BenchDrive(NamedTuple):
    """What drives the bench."""

    force: DrivenForce
    prescribed: DrivenHeights


@jit_compile
def applied_force(drive: DrivenForce, t_s: float) -> float:
    """Applied force in N at a time, zero before time zero."""
    if t_s < 0.0:
        return 0.0
    force_n = 0.0
    for i in range(drive.sines.shape[0]):
        force_n += drive.sines[i, 0] * math.sin(drive.sines[i, 1] * t_s + drive.sines[i, 2])
    for i in range(drive.sweeps.shape[0]):
        force_n += _sweep(drive.sweeps[i], t_s)
    for i in range(drive.file_first.shape[0] - 1):
        force_n += _interpolate(drive, drive.file_first[i], drive.file_first[i + 1] - 1, t_s)
    return force_n


@jit_compile
def _sweep(sweep: Floats, t_s: float) -> float:
    if t_s > sweep[3]:
        return 0.0
    return float(sweep[0]) * math.sin(2.0 * math.pi * _sweep_turns(sweep, t_s)[0])


@jit_compile
def _sweep_turns(sweep: Floats, t_s: float) -> tuple[float, float]:
    """Turns since the start, and frequency in Hz."""
    _, start_hz, end_hz, duration_s, logarithmic = sweep
    if logarithmic > 0.0 and start_hz != end_hz:
        growth = math.log(end_hz / start_hz) / duration_s
        turns = start_hz * math.expm1(growth * t_s) / growth
        return turns, start_hz * math.exp(growth * t_s)
    rise = (end_hz - start_hz) * t_s / duration_s
    return (start_hz + 0.5 * rise) * t_s, start_hz + rise


@jit_compile
def _interpolate(drive: DrivenForce, first: int, last: int, t_s: float) -> float:
    t = drive.file_t_s
    force_n = drive.file_force_n
    if t_s < t[first] or t_s > t[last]:
        return 0.0
    low = first + int(np.searchsorted(t[first:last], t_s, side="right")) - 1
    share = (t_s - t[low]) / (t[low + 1] - t[low])
    return force_n[low] + share * (force_n[low + 1] - force_n[low])


@jit_compile
def acting_force(drive: DrivenForce, t_s: float) -> float:
    """Force in N that reaches the driven body, after undeclared gain and delay."""
    return drive.gain * applied_force(drive, t_s - drive.delay_s)


@jit_compile
def prescribed_motion(prescribed: DrivenHeights, motion: int, t_s: float) -> tuple[float, float]:
    """A prescribed height in m and its rate in m/s. Files and sweeps stay where they end."""
    height_m = prescribed.mean_height_m[motion]
    rate_m_per_s = 0.0
    firsts = prescribed.firsts
    for i in range(firsts[0, motion], firsts[0, motion + 1]):
        rate_rad_per_s = prescribed.sines[i, 1]
        phase = rate_rad_per_s * t_s + prescribed.sines[i, 2]
        height_m += prescribed.sines[i, 0] * math.sin(phase)
        rate_m_per_s += prescribed.sines[i, 0] * rate_rad_per_s * math.cos(phase)
    for i in range(firsts[1, motion], firsts[1, motion + 1]):
        amplitude_m = prescribed.sweeps[i, 0]
        end_s = prescribed.sweeps[i, 3]
        turns, frequency_hz = _sweep_turns(prescribed.sweeps[i], min(t_s, end_s))
        height_m += amplitude_m * math.sin(2.0 * math.pi * turns)
        if t_s < end_s:
            phase = 2.0 * math.pi * turns
            rate_m_per_s += amplitude_m * 2.0 * math.pi * frequency_hz * math.cos(phase)
    for i in range(firsts[2, motion], firsts[2, motion + 1]):
        segment = prescribed.files.segments[curve_segment(prescribed.files, i, t_s)]
        start, length, a, b, c, d = segment
        offset = min(max(t_s - start, 0.0), length)
        height_m += ((a * offset + b) * offset + c) * offset + d
        if offset == t_s - start:
            rate_m_per_s += (3.0 * a * offset + 2.0 * b) * offset + c
    return height_m, rate_m_per_s
