"""The figures of a damper over all steps: peak curve, gas, friction, knee, temperature."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.stroke_force import ANGLES, Figure, MeanStroke, student_factor
from rig.dyno.strokes import Array

_ALIKE_SPEED = 0.05
"""Relative difference of speed and amplitude up to which steps are repetitions of each other."""

_LEAST_WARMING_K = 2.0
"""Least span of temperatures for a change per kelvin: sensors agree within one kelvin."""

_WARM_UP = 2.0
"""Ratio of the first step's cycles to those of the others, from which it is a warm-up."""

_DRAWS = 300
"""Random curves for the interval of a knee, which determine its ends to a tenth."""

_STRAIGHT = 1.25
"""Ratio of the slopes below and above, under which there is no knee."""

_KNEE_POINTS = 60
_LOWEST_OF_KNEE, _HIGHEST_OF_KNEE = 0.05, 0.9
"""Shares of the peak speed between which a knee is searched."""

_FEWEST_STROKES = 6
"""Fewest strokes for a change per kelvin."""


class Damper(NamedTuple):
    """Figures over all steps; None where the test does not determine them.

    Attributes:
        gas_force_n: At mid-stroke of the slowest step.
        gas_rate_n_per_m: Its rise per compression there.
        friction_n: Half the difference of both directions there.
        knee_m_per_s: By direction the speed at which the curve bends.
        asymmetry: Rebound over compression at peak velocity of the fastest step, without gas.
        force_per_kelvin_n_per_k: By direction the change of force per kelvin.
        notes: Why a figure is missing, and what was assumed.
    """

    gas_force_n: Figure | None
    gas_rate_n_per_m: Figure | None
    friction_n: Figure | None
    knee_m_per_s: dict[str, Figure | None]
    asymmetry: Figure | None
    force_per_kelvin_n_per_k: dict[str, Figure | None]
    notes: tuple[str, ...]

    def properties(self) -> dict[str, tuple[str, Figure]]:
        """Unit and figure of each property of the damper that the test determines, by name."""
        named = {
            "gas force": ("N", self.gas_force_n),
            "gas spring rate": ("N/m", self.gas_rate_n_per_m),
            "friction": ("N", self.friction_n),
            **{f"knee, {side}": ("m/s", figure) for side, figure in self.knee_m_per_s.items()},
            "rebound over compression": ("", self.asymmetry),
        }
        return {name: (unit, it) for name, (unit, it) in named.items() if it is not None}


def summarise_damper(steps: Sequence[DynoStep]) -> Damper:
    """Figures of a damper from its steps, in time; one at least."""
    notes: list[str] = []
    slow = [step for step in steps if step.kind == "quasi_static"]
    gas_force = gas_rate = friction = None
    if slow:
        slowest = min(slow, key=lambda step: step.peak_speed_m_per_s)
        speed = 1e3 * slowest.peak_speed_m_per_s
        gas_force, gas_rate, friction = (
            figure._replace(method=f"{figure.method}, at {speed:.2g} mm/s")
            for figure in (
                slowest.mean_force_n,
                slowest.spring_rate_n_per_m,
                slowest.half_difference_n,
            )
        )
        notes.append(
            f"friction and gas force are forces at {speed:.2g} mm/s: what bleeds there is in them, "
            "and their intervals are of the measurement alone"
        )
    else:
        notes.append(
            "no step of 5 mm/s or less: friction, gas force and its rate cannot be determined, and "
            "asymmetry is that of whole forces"
        )
    fastest = max(steps, key=lambda step: step.peak_speed_m_per_s)
    knee = {name: _knee(stroke) for name, stroke in zip(SIDES, fastest.strokes, strict=True)}
    if any(stroke.is_constant for stroke in fastest.strokes):
        notes.append("no knee: the fastest step has a single speed")
    elif not any(knee.values()):
        notes.append("no knee: the curve of the fastest step is straight within its noise")
    per_kelvin = {name: _per_kelvin(steps, index) for index, name in enumerate(knee)}
    if not any(per_kelvin.values()):
        notes.append(f"no change per kelvin: no speed was run over {_LEAST_WARMING_K:g} K or more")
    return Damper(
        gas_force,
        gas_rate,
        friction,
        knee,
        _asymmetry(fastest, gas_force),
        per_kelvin,
        tuple(notes),
    )


def mark_warm_up(steps: Sequence[DynoStep]) -> tuple[DynoStep, ...]:
    """The steps, in time, of which the first one is a warm-up if it is longer than the others."""
    first, *others = steps
    cycles = [step.cycles for step in others]
    is_longer = len(cycles) >= 2 and first.cycles >= _WARM_UP * float(np.median(cycles))
    if first.kind == "velocity_step" and is_longer:
        first = first._replace(kind="warm_up")
    return (first, *others)


def _asymmetry(step: DynoStep, gas: Figure | None) -> Figure | None:
    """Ratio of the forces, by the delta method."""
    up, down = step.rebound.force_at_peak_velocity_n, step.compression.force_at_peak_velocity_n
    offset = 0.0 if gas is None else gas.value
    rebound, compression = -(up.value - offset), down.value - offset
    if compression <= 0.0 or rebound <= 0.0:
        return None
    ratio = rebound / compression
    own = 0.0 if gas is None else 0.5 * (gas.high - gas.low)
    parts = (
        0.5 * (up.high - up.low) / rebound,
        0.5 * (down.high - down.low) / compression,
        own * (1.0 / rebound + 1.0 / compression),
    )
    half = ratio * float(np.linalg.norm(parts))
    of = "whole force" if gas is None else "force less gas force"
    return Figure(ratio, ratio - half, ratio + half, f"{of} at peak velocity, fastest step")


def _knee(stroke: MeanStroke) -> Figure | None:
    """Speed where two straight lines through the curve meet; interval from random curves."""
    if stroke.is_constant:
        return None  # a single speed has no curve
    speed = np.abs(stroke.velocity_m_per_s)
    peak = float(speed.max())
    grid = np.linspace(0.03, 0.99, _KNEE_POINTS) * peak
    top = int(np.argmax(speed))
    if not 0 < top < len(speed) - 1:
        return None
    # Mean of both halves of the stroke, in which lag and spring cancel.
    rows = np.array(
        [
            0.5 * (_force_row_at(speed[: top + 1], v, 0) + _force_row_at(speed[top:], v, top))
            for v in grid
        ]
    )
    tried = np.linspace(_LOWEST_OF_KNEE, _HIGHEST_OF_KNEE, 2 * _KNEE_POINTS) * peak
    bases = [np.column_stack([np.ones_like(grid), grid, np.maximum(grid - v, 0.0)]) for v in tried]
    solvers = [np.linalg.pinv(base) for base in bases]

    def best_knee(force_n: Array) -> tuple[float, float]:
        curve = rows @ force_n
        squares = [
            float(np.sum((curve - base @ (solver @ curve)) ** 2))
            for base, solver in zip(bases, solvers, strict=True)
        ]
        best = int(np.argmin(squares))
        _, below, bend = solvers[best] @ curve
        above = below + bend
        steep, flat = max(abs(below), abs(above)), min(abs(below), abs(above))
        return float(tried[best]), steep / max(flat, 1e-12)

    value, ratio = best_knee(stroke.force_n)
    if ratio < _STRAIGHT:
        return None
    rng = np.random.default_rng(0)
    values, vectors = np.linalg.eigh(stroke.covariance)
    spread = vectors * np.sqrt(np.clip(values, 0.0, None))
    drawn = [
        best_knee(stroke.force_n + spread @ rng.standard_normal(len(values))) for _ in range(_DRAWS)
    ]
    if np.mean([item[1] < _STRAIGHT for item in drawn]) > 0.05:
        return None
    step = float(tried[1] - tried[0])
    low, high = np.percentile([item[0] for item in drawn], (2.5, 97.5))
    low, high = min(float(low), value) - step, max(float(high), value) + step
    return Figure(value, low, high, "two straight lines through force over speed, fastest step")


def _force_row_at(speed: Array, value: float, offset: int) -> Array:
    """Row over the angles that gives the force where a half stroke has a speed."""
    order = np.argsort(speed)
    position = float(np.interp(value, speed[order], order.astype(np.float64)))
    before = min(int(position), len(speed) - 2)
    row = np.zeros(len(ANGLES))
    row[offset + before] = 1.0 - (position - before)
    row[offset + before + 1] = position - before
    return row


def _per_kelvin(steps: Sequence[DynoStep], index: int) -> Figure | None:
    """Change of the force at peak velocity per kelvin over steps of one speed and amplitude."""
    if any(step.temperature_c is None for step in steps):
        return None
    groups: list[list[DynoStep]] = []
    for step in steps:
        alike = next((group for group in groups if _is_same_step(group[0], step)), None)
        if alike is None:
            groups.append([step])
        else:
            alike.append(step)
    slopes = [slope for group in groups if (slope := _slope(group, index)) is not None]
    return min(slopes, key=lambda slope: slope.high - slope.low, default=None)


def _is_same_step(a: DynoStep, b: DynoStep) -> bool:
    return all(
        abs(x - y) <= _ALIKE_SPEED * x
        for x, y in ((a.peak_speed_m_per_s, b.peak_speed_m_per_s), (a.amplitude_m, b.amplitude_m))
    )


def _slope(group: Sequence[DynoStep], index: int) -> Figure | None:
    """Least squares through the strokes of like steps."""
    temperatures = np.concatenate([step.warmth[index][0] for step in group])
    forces = np.concatenate([step.warmth[index][1] for step in group])
    if len(forces) < _FEWEST_STROKES or np.ptp(temperatures) < _LEAST_WARMING_K:
        return None
    about = temperatures - temperatures.mean()
    slope = float(about @ forces) / float(about @ about)
    residual = forces - forces.mean() - slope * about
    freedom = len(forces) - 2
    std = float(np.sqrt(residual @ residual / freedom / (about @ about)))
    half = student_factor(freedom) * std
    speed = group[0].peak_speed_m_per_s
    text = f"line through the strokes at {speed:.3g} m/s over {np.ptp(temperatures):.1f} K"
    return Figure(slope, slope - half, slope + half, text)
