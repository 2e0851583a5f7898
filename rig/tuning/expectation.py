"""What an observer has to expect of a strut: noise of its height, spectrum of its residual force.

From a run: the error that the model would have had without virtual force is the innovation plus the
virtual force's double integral over the effective mass; its second derivative is the residual force
over that mass, smoothed as in a diagnosis, which also finds the sensor's noise.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from can_dbc.errors import InputError
from rig.bridge.values import Mode
from rig.channels.measured_quantities import APPLIED_FORCE
from rig.closed_loop.poles import OperatingPoint
from rig.closed_loop.strut_response import USUAL_SPEED_M_PER_S
from rig.diagnosis.numerics.smoother import estimate_noise, smooth
from rig.recordings.stretches import find_stretches

Array = NDArray[np.float64]

_LONGEST_S = 60.0
"""Of a run: enough for a spectrum, and short enough for a double integral in doubles."""

_SHORTEST_S = 1.0
"""Of a run: a spectrum down to some hertz."""

FEWEST = 200
"""Measurements: a standard deviation within a tenth."""

_AT_END, _FAST, _APART = 0.01, 0.95, 5
"""Share of a run that is beyond an end of its travel, share that is slower than its fast motion,
and samples between which a speed is taken."""

_LINES = 120
"""Frequencies into which a spectrum is gathered."""

_SINGULAR = 1e-9
"""Share of the largest singular value of the mobilities below which struts are not independent."""


class FollowedStretch(NamedTuple):
    """A stretch of a run, as the observer of one strut saw it.

    Attributes:
        t_s: Times at which the measured heights were true, shape (N,).
        free_error_m: Error of the model had there been no virtual force, but for a straight line,
            shape (N,).
        tick_s: Times of the ticks, shape (M,).
        law_force_n: Force of the model's law at them, shape (M,).
        height_m: Model heights at them, shape (M,).
        velocity_m_per_s: Model velocities at them, shape (M,).
        applied_n: First force that drove the model at them, shape (M,); zero where none is known.
    """

    t_s: Array
    free_error_m: Array
    tick_s: Array
    law_force_n: Array
    height_m: Array
    velocity_m_per_s: Array
    applied_n: Array


class Expectation(NamedTuple):
    """Noise and residual force that an observer has to expect.

    Attributes:
        noise_std_m: Standard deviation of the measured height.
        frequency_hz: Frequencies of the residual force, shape (N,).
        power_n2: Its mean square at them, shape (N,).
        source: Their source, as a phrase.
        by_late_force_n: RMS of the part that is proportional to the rate of the applied force: a
            force that reaches the model late leaves it, whatever the model is.
    """

    noise_std_m: float
    frequency_hz: Array
    power_n2: Array
    source: str
    by_late_force_n: float = 0.0


def longest_stretch(
    steps: pa.Table, folder: Path, strut: str, mobilities_per_kg: Mapping[str, float]
) -> FollowedStretch:
    """The longest stretch of a run in which the observer followed its bench.

    The steps are an Arrow table; the folder names the run in an error. The mobilities are the
    acceleration of the strut's height per newton in each strut.

    Raises:
        InputError: It has no such strut, or is too short.
    """
    if f"{strut}.law_force_n" not in steps.schema.names:
        raise InputError(f"{folder}: no strut {strut}, expected a run of this configuration")

    def column(name: str) -> Array:
        return np.asarray(steps.column(name).to_numpy(), dtype=np.float64)

    running = find_stretches(column("mode") == Mode.RUNNING)
    stretch = max(running, key=lambda item: item.stop - item.start, default=slice(0, 0))
    tick_s = column("t_ns")[stretch] * 1e-9
    stretch = slice(stretch.start, stretch.start + int(np.sum(tick_s <= tick_s[:1] + _LONGEST_S)))
    tick_s = column("t_ns")[stretch] * 1e-9
    by_virtual_forces = np.zeros(len(tick_s))
    for name, per_kg in mobilities_per_kg.items():
        by_virtual_forces += per_kg * column(f"{name}.virtual_force_n")[stretch]
    measured_s = column(f"{strut}.measured_t_ns")[stretch] * 1e-9
    innovation_m = column(f"{strut}.innovation_m")[stretch]
    fresh = np.isfinite(measured_s) & (measured_s >= tick_s[:1])
    if np.sum(fresh) < FEWEST or tick_s[-1] - tick_s[0] < _SHORTEST_S:
        raise InputError(
            f"{folder}: {np.sum(fresh)} heights in {np.ptp(tick_s) if len(tick_s) else 0.0:.2g} s "
            f"of RUNNING without a break, expected {FEWEST} in {_SHORTEST_S:g} s"
        )
    t_s = measured_s[fresh]
    free_m = free_error(tick_s, -by_virtual_forces, t_s, innovation_m[fresh])
    law = ("law_force_n", "height_m", "velocity_m_per_s")
    law_n, height_m, velocity = (column(f"{strut}.{name}")[stretch] for name in law)
    forces = [name for name in steps.schema.names if name.startswith(APPLIED_FORCE.column)]
    applied_n = np.nan_to_num(column(forces[0])[stretch]) if forces else np.zeros(len(tick_s))
    return FollowedStretch(t_s, free_m, tick_s, law_n, height_m, velocity, applied_n)


def operating_points(steps: pa.Table, struts: Sequence[str]) -> list[OperatingPoint]:
    """Motions of a run: at its mid-stroke and at both ends of its travel, slow and fast.

    Ends and speed leave out the outermost hundredth, and twentieth, of the run. Empty where a
    height was not measured.
    """
    heights: list[Array] = []
    fast = USUAL_SPEED_M_PER_S
    for strut in struts:
        values = np.asarray(steps.column(f"{strut}.measured_height_m").to_numpy(), np.float64)
        fresh = np.isfinite(values)
        if np.sum(fresh) < FEWEST:
            return []
        t_s = np.asarray(steps.column("t_ns").to_numpy(), np.float64)[fresh] * 1e-9
        heights.append(np.quantile(values[fresh], [_AT_END, 0.5, 1.0 - _AT_END]))
        # Over some samples, so that the sensor's noise is no speed.
        rate = (values[fresh][_APART:] - values[fresh][:-_APART]) / (t_s[_APART:] - t_s[:-_APART])
        fast = max(fast, float(np.quantile(np.abs(rate), _FAST)))
    low, middle, high = ([float(of[i]) for of in heights] for i in range(3))
    slow = USUAL_SPEED_M_PER_S
    return [
        OperatingPoint(at, speed)
        for at, speed in ((middle, fast), (low, slow), (low, fast), (high, slow), (high, fast))
    ]


def free_error(tick_s: Array, by_force: Array, t_s: Array, innovation_m: Array) -> Array:
    """Error of the model had there been no virtual force, but for a straight line, shape (N,).

    Args:
        tick_s: Times of the ticks, shape (M,).
        by_force: Acceleration of the error by the virtual force from each tick on, shape (M,).
        t_s: Times at which the measured heights were true, shape (N,).
        innovation_m: Innovations at them, shape (N,).
    """
    free_m = innovation_m - _integrate_twice(tick_s, by_force, t_s)
    line = np.polynomial.Polynomial.fit(t_s, free_m, 1)
    return free_m - line(t_s)


def residual_force(stretch: FollowedStretch, mobility_per_kg: float) -> tuple[float, Array]:
    """Noise of a stretch's heights, and its residual force smoothed over all of it, shape (N,)."""
    noise = estimate_noise(stretch.t_s, stretch.free_error_m)
    smoothed = smooth(stretch.t_s, stretch.free_error_m, noise)
    return float(np.sqrt(noise.variance)), smoothed.states[:, 2] / mobility_per_kg


def expectations_from_run(
    steps: pa.Table, folder: Path, struts: Sequence[str], mobility_per_kg: Array
) -> list[Expectation]:
    """Expectation of each strut from the steps of a run of its bench, which the folder names.

    A residual force in one strut accelerates the heights of all that share a body with it: the
    forces are those that together explain the accelerations of all heights.

    Args:
        steps: Steps as an Arrow table.
        folder: Folder of the run.
        struts: Names of the struts.
        mobility_per_kg: Acceleration of each height per newton in each strut, (struts, struts).

    Raises:
        InputError: It has no such strut, or is too short.
    """
    stretches: list[FollowedStretch] = []
    noises: list[float] = []
    accelerations: list[Array] = []
    for strut, row in zip(struts, mobility_per_kg.tolist(), strict=True):
        stretches.append(longest_stretch(steps, folder, strut, dict(zip(struts, row, strict=True))))
        noise_std_m, acceleration = residual_force(stretches[-1], 1.0)
        noises.append(noise_std_m)
        accelerations.append(acceleration)
    inverse = np.linalg.pinv(mobility_per_kg, rcond=_SINGULAR)
    found: list[Expectation] = []
    for stretch, noise_std_m, row in zip(stretches, noises, inverse, strict=True):
        t_s = stretch.t_s
        force_n = np.zeros(len(t_s))
        for share, other, acceleration in zip(row.tolist(), stretches, accelerations, strict=True):
            if share:
                force_n += share * np.interp(t_s, other.t_s, acceleration)
        source = f"{folder}, its longest stretch in RUNNING, {np.ptp(stretch.tick_s):.3g} s"
        by_late_n = part_by_late_force(stretch, force_n)
        found.append(Expectation(noise_std_m, *spectrum(t_s, force_n), source, by_late_n))
    return found


def part_by_late_force(stretch: FollowedStretch, force_n: Array) -> float:
    """RMS of the part of a residual force that is proportional to the applied force's rate."""
    applied_n = np.interp(stretch.t_s, stretch.tick_s, stretch.applied_n)
    rate = np.gradient(applied_n, stretch.t_s)
    power = float(rate @ rate)
    return abs(float(force_n @ rate)) / (power * len(rate)) ** 0.5 if power > 0.0 else 0.0


def expectation_from_noise(noise_std_m: float, rms_n: float, up_to_hz: float) -> Expectation:
    """Expectation of a residual force whose mean square is even up to a highest frequency."""
    frequency_hz = np.asarray(up_to_hz * (np.arange(20) + 0.5) / 20.0, dtype=np.float64)
    power_n2 = np.full(20, rms_n**2 / 20.0)
    source = f"{rms_n:g} N up to {up_to_hz:g} Hz, as stated"
    return Expectation(noise_std_m, frequency_hz, power_n2, source)


def _integrate_twice(tick_s: Array, acceleration: Array, t_s: Array) -> Array:
    """An acceleration that is constant from each tick to the next, integrated twice."""
    h = np.diff(tick_s)
    rate = np.concatenate([[0.0], np.cumsum(acceleration[:-1] * h)])
    moved = np.concatenate([[0.0], np.cumsum(rate[:-1] * h + 0.5 * acceleration[:-1] * h * h)])
    tick = np.clip(np.searchsorted(tick_s, t_s, side="right") - 1, 0, len(tick_s) - 1)
    since = t_s - tick_s[tick]
    return moved[tick] + rate[tick] * since + 0.5 * acceleration[tick] * since * since


def spectrum(t_s: Array, force_n: Array) -> tuple[Array, Array]:
    """Mean square over frequency, gathered into some lines; a Hann window keeps the ends apart.

    Times and forces have the shape (N,). Frequencies are in Hz, mean squares in N².
    """
    begin_s, end_s = float(t_s[0]), float(t_s[-1])
    even_s = np.linspace(begin_s, end_s, len(t_s))
    even_n = np.interp(even_s, t_s, force_n)
    window = np.hanning(len(even_n))
    transform = np.fft.rfft((even_n - np.average(even_n, weights=window)) * window)
    power = 2.0 * np.abs(transform) ** 2 / (len(even_n) * np.sum(window**2))
    frequency = np.fft.rfftfreq(len(even_n), (end_s - begin_s) / (len(t_s) - 1))
    edges = np.unique(np.geomspace(1, len(frequency), _LINES).astype(int))
    lines = [slice(a, b) for a, b in itertools.pairwise(edges)]
    powers = np.array([np.sum(power[line]) for line in lines])
    centres = np.array(
        [float(np.average(frequency[line], weights=power[line] + 1e-300)) for line in lines]
    )
    return centres, powers
