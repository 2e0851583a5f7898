"""Force over speed as numbers: at the peaks of the steps, and in both halves of a stroke.

A peak curve is made of the forces of several steps at their largest speeds. Within one step, the
force at a lower speed is passed twice in each stroke: while the strut speeds up and the valves
open, and while it slows down and they close. Gas and spring, which differ between these heights,
are removed where a slow step shows them.

Reference: Dixon, The Shock Absorber Handbook (2007), 10.4, for both curves.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from rig.dyno.damper import Damper, find_slowest, spring_curve
from rig.dyno.figures import SIDES, DynoStep, Side
from rig.dyno.request import FigureRequest
from rig.dyno.stroke_force import ANGLES, Figure

Part = Literal["peak", "opening", "closing"]

_SAME = 0.01
"""Relative distance of a step's speed from a point's up to which it is the point's."""

_STEEPEST = 2.0
"""Power of the speed with which the force of an orifice rises: no damper's rises faster."""

_INSIDE = 1.05
"""Ratio of a step's peak speed to a speed from which on both halves of its strokes pass it."""


class CurvePoint(NamedTuple):
    """A force at a speed.

    Attributes:
        step: Number of the step, from 1; None between two steps.
        part: `peak`, or the half of the stroke: `opening` speeds up, `closing` slows down.
        damping_n: The force without gas and spring; None where no slow step shows these.
        at_reference_n: The force at the reference temperature; None where none is requested, or the
            record does not determine the change per kelvin.
    """

    speed_m_per_s: float
    side: str
    part: Part
    step: int | None
    temperature_c: float | None
    force_n: Figure
    damping_n: Figure | None
    at_reference_n: Figure | None


def peak_force_at(steps: Sequence[DynoStep], side: str, speed: float) -> Figure | None:
    """Force of a direction at a peak speed, in m/s; None beyond the speeds of all steps.

    That of the step within 1 % of the speed; between two steps a force between theirs. A warm-up is
    no step.
    """
    used = [step for step in steps if step.kind != "warm_up"]
    ordered = sorted(used, key=lambda step: step.peak_speed_m_per_s)
    if not ordered:
        return None
    sides: list[Side] = [getattr(step, side) for step in ordered]
    speeds = [item.peak_velocity_m_per_s.value for item in sides]
    figures = [item.force_at_peak_velocity_n for item in sides]
    nearest = min(range(len(speeds)), key=lambda index: abs(speeds[index] / speed - 1.0))
    apart = abs(speeds[nearest] / speed - 1.0)
    if apart <= _SAME:
        figure = figures[nearest]
        more = _STEEPEST * apart * abs(figure.value)
        method = f"step at {speeds[nearest]:.4g} m/s"
        return Figure(figure.value, figure.low - more, figure.high + more, method)
    for (slow, below), (fast, above) in pairwise(zip(speeds, figures, strict=True)):
        if slow <= speed <= fast:
            share = (speed - slow) / (fast - slow)
            value = (1.0 - share) * below.value + share * above.value
            low, high = min(below.low, above.low), max(below.high, above.high)
            method = f"between steps at {slow:.3g} and {fast:.3g} m/s"
            return Figure(value, low, high, method)
    return None


def compute_curves(
    steps: Sequence[DynoStep], damper: Damper, request: FigureRequest
) -> tuple[CurvePoint, ...]:
    """Points of both curves at the requested speeds, as far as the steps reach."""
    slowest = find_slowest(steps)
    spring = None if slowest is None else spring_curve(slowest)
    points: list[CurvePoint] = []
    for index, side in enumerate(SIDES):
        for speed in request.speeds_m_per_s:
            for part, number, force_n, height_m in _forces(steps, index, speed):
                warm_c = None if number is None else steps[number - 1].temperature_c
                damping_n = None
                if spring is not None and damper.gas_force_n is not None and force_n.is_bounded:
                    value = force_n.value - float(spring(height_m))
                    half = float(np.hypot(force_n.half, damper.gas_force_n.half))
                    damping_n = Figure.around(value, half, f"{force_n.method}, without gas")
                at_reference_n = _at_reference(force_n, side, warm_c, damper, request.reference_c)
                points.append(
                    CurvePoint(
                        speed, side, part, number, warm_c, force_n, damping_n, at_reference_n
                    )
                )
    return tuple(points)


def _forces(
    steps: Sequence[DynoStep], index: int, speed: float
) -> list[tuple[Part, int | None, Figure, float]]:
    """Forces of a direction at a speed: part, number of the step, force, and height."""
    found: list[tuple[Part, int | None, Figure, float]] = []
    peak = peak_force_at(steps, SIDES[index], speed)
    peaks = [step.strokes[index] for step in steps]
    speeds = [float(np.abs(stroke.velocity_m_per_s).max()) for stroke in peaks]
    if peak is not None:
        near = [n for n, own in enumerate(speeds) if abs(own / speed - 1.0) <= _SAME]
        number = near[0] + 1 if near and peak.method.startswith("step") else None
        middle_m = peaks[near[0] if near else 0].middle_m
        found.append(("peak", number, peak, middle_m))
    faster = [n for n, own in enumerate(speeds) if own >= _INSIDE * speed]
    if not faster:
        return found
    number = min(faster, key=lambda n: speeds[n])
    stroke = peaks[number]
    if stroke.is_constant:
        return found
    over = np.abs(stroke.velocity_m_per_s) - speed
    top = int(np.argmax(over))
    opening = float(np.interp(0.0, over[: top + 1], ANGLES[: top + 1]))
    closing = float(np.interp(0.0, -over[top:], ANGLES[top:]))
    halves: tuple[tuple[Part, float], ...] = (("opening", opening), ("closing", closing))
    for part, angle in halves:
        force_n = stroke.figure(stroke.row(angle)[0], f"{part} half of step {number + 1}")
        height_m = stroke.middle_m + stroke.sign * stroke.amplitude_m * float(np.sin(angle))
        found.append((part, number + 1, force_n, height_m))
    return found


def _at_reference(
    force_n: Figure, side: str, warm_c: float | None, damper: Damper, reference_c: float | None
) -> Figure | None:
    """A force at another temperature, by the change per kelvin of its damping."""
    share, gas = damper.share_per_kelvin_per_k[side], damper.gas_force_n
    if reference_c is None or warm_c is None or share is None or gas is None:
        return None
    if not force_n.is_bounded:
        return None
    warmer_k = reference_c - warm_c
    damping_n = force_n.value - gas.value
    value = gas.value + damping_n * (1.0 + share.value * warmer_k)
    half = float(np.hypot(force_n.half, damping_n * share.half * warmer_k))
    return Figure.around(value, half, f"{force_n.method}, at {reference_c:g} °C")
