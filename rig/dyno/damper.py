"""The figures of a damper over all steps: peak curve, gas, friction, knee, temperature."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.knee import Knee, find_knee
from rig.dyno.stroke_force import ANGLES, Figure
from rig.dyno.temperature import (
    LEAST_WARMING_K,
    TYPICAL_PER_K,
    apart_k,
    change_per_kelvin,
    widen,
)

_SLOW_M_PER_S = 0.06
"""Speed of a step up to which the damping from no speed on may be a straight line."""

_WARM_UP = 2.0
"""Ratio of the first step's cycles to those of the others, from which it is a warm-up."""

_SPRING_DEGREE, _INNER = 4, 0.95
"""Of the polynomial in the height that is the spring, and share of the stroke that it is fitted to:
at the turning points friction reverses. With a degree of 3 the bend of a gas column of twice the
stroke is taken for damping (3 N of 220 N), with 4 nothing is (0.1 N), with 6 noise is (12 N)."""

GAS, GAS_RATE, FRICTION = "gas force", "gas spring rate", "friction"
"""Names of properties of a damper."""


class Damper(NamedTuple):
    """Figures over all steps; None where the test does not determine them.

    Attributes:
        gas_force_n: At mid-stroke, as the slowest step has it without its damping.
        gas_rate_n_per_m: Its rise per compression there.
        friction_n: Half the difference of both directions there, without damping.
        knee_m_per_s: By direction the speed at which the curve bends.
        slopes_n_s_per_m: By direction with a knee the slopes below and above it.
        asymmetry: Rebound over compression at peak velocity of the fastest step, without gas.
        force_per_kelvin_n_per_k: By direction the change of force per kelvin.
        share_per_kelvin_per_k: By direction the same over the force without gas.
        notes: Why a figure is missing, and what was assumed.
    """

    gas_force_n: Figure | None
    gas_rate_n_per_m: Figure | None
    friction_n: Figure | None
    knee_m_per_s: dict[str, Figure | None]
    slopes_n_s_per_m: dict[str, tuple[Figure, Figure]]
    asymmetry: Figure | None
    force_per_kelvin_n_per_k: dict[str, Figure | None]
    share_per_kelvin_per_k: dict[str, Figure | None]
    notes: tuple[str, ...]

    @property
    def bent_sides(self) -> frozenset[str]:
        """Directions that have a knee."""
        return frozenset(side for side, knee in self.knee_m_per_s.items() if knee is not None)

    def properties(self) -> dict[str, tuple[str, Figure]]:
        """Unit and figure of each property of the damper that the test determines, by name."""
        named = {
            GAS: ("N", self.gas_force_n),
            GAS_RATE: ("N/m", self.gas_rate_n_per_m),
            FRICTION: ("N", self.friction_n),
            **{f"knee, {side}": ("m/s", figure) for side, figure in self.knee_m_per_s.items()},
            "rebound over compression": ("", self.asymmetry),
        }
        return {name: (unit, it) for name, (unit, it) in named.items() if it is not None}


def summarise_damper(steps: Sequence[DynoStep]) -> Damper:
    """Figures of a damper from its steps, in time; one at least."""
    notes: list[str] = []
    slowest = find_slowest(steps)
    fastest = max(steps, key=lambda step: step.peak_speed_m_per_s)
    usual = [step for step in steps if step.kind != "warm_up"] or steps
    spring = None if slowest is None else spring_curve(slowest)
    strokes = {name: [step.strokes[index] for step in usual] for index, name in enumerate(SIDES)}
    knee = {name: find_knee(mine, spring) for name, mine in strokes.items()}
    clipped = [name for name, mine in strokes.items() if any(it.is_clipped for it in mine)]
    if clipped:
        notes.append(
            f"the force was clipped in {' and '.join(clipped)}: knee and slopes are of what was "
            "not, and figures that depend on the rest are bounds or missing"
        )
    if not any(knee.values()):
        is_single = len(usual) == 1 and any(stroke.is_constant for stroke in usual[0].strokes)
        why = "the test has a single speed" if is_single else "force over speed has no bend in it"
        notes.append(f"no knee: {why}")
    gas_force = gas_rate = friction = None
    if slowest is None:
        notes.append(
            "no step of 5 mm/s or less: friction, gas force and its rate cannot be determined, and "
            "asymmetry is that of whole forces"
        )
    else:
        slopes = _slopes_at_no_speed(slowest, usual, knee)
        gas_force, gas_rate, friction = _at_no_speed(slowest, slopes)
        if slopes is None:
            speed = 1e3 * slowest.peak_speed_m_per_s
            notes.append(
                f"friction and gas force are those at {speed:.2g} mm/s, with what bleeds there: it "
                "is not known, as no other step is slow"
            )
    warming = {name: change_per_kelvin(steps, index) for index, name in enumerate(SIDES)}
    if not any(warming.values()):
        notes.append(f"no change per kelvin: no speed was run over {LEAST_WARMING_K:g} K or more")
    return Damper(
        gas_force,
        gas_rate,
        friction,
        {name: None if it is None else it.speed_m_per_s for name, it in knee.items()},
        {name: (it.below_n_s_per_m, it.above_n_s_per_m) for name, it in knee.items() if it},
        _asymmetry(fastest, gas_force),
        {name: None if it is None else it.slope for name, it in warming.items()},
        {
            name: None if it is None or gas_force is None else it.share(gas_force)
            for name, it in warming.items()
        },
        tuple(notes),
    )


def _slopes_at_no_speed(
    slowest: DynoStep, steps: Sequence[DynoStep], knee: Mapping[str, Knee | None]
) -> tuple[Figure, Figure] | None:
    """Damping of both directions where it begins, in N·s/m; None where the steps do not show it.

    It is the slope below the knee, or else that from the slowest step to one that is slow as well.
    """
    found: list[Figure] = []
    slow = min(
        (step for step in steps if step.kind == "velocity_step"),
        key=lambda step: step.peak_speed_m_per_s,
        default=None,
    )
    for index, side in enumerate(SIDES):
        bend = knee[side]
        if bend is not None:
            found.append(bend.below_n_s_per_m)
        elif slow is not None and slow.peak_speed_m_per_s <= _SLOW_M_PER_S:
            figures = [
                (it.compression, it.rebound)[index].force_at_peak_velocity_n
                for it in (slowest, slow)
            ]
            apart = slow.peak_speed_m_per_s - slowest.peak_speed_m_per_s
            value = abs(figures[1].value - figures[0].value) / apart
            half = sum(it.half for it in figures) / apart
            found.append(Figure.around(value, half, "slope to the next step"))
    if len(found) < len(SIDES) or not all(it.is_bounded for it in found):
        return None
    warmer_k = max(abs(apart_k(slowest, step)) for step in steps)
    down, up = (widen(it, TYPICAL_PER_K, warmer_k) for it in found)
    return down, up


def _at_no_speed(
    slowest: DynoStep, slopes: tuple[Figure, Figure] | None
) -> tuple[Figure | None, Figure | None, Figure | None]:
    """Gas force, its rate and friction of the slowest step, without what bleeds in it."""
    speed = slowest.peak_speed_m_per_s
    at = f", at {1e3 * speed:.2g} mm/s"
    gas, rate, friction = (
        figure._replace(method=f"{figure.method}{at}") if figure.is_bounded else None
        for figure in (
            slowest.mean_force_n,
            slowest.spring_rate_n_per_m,
            slowest.half_difference_n,
        )
    )
    if slopes is None or gas is None or friction is None:
        return gas, rate, friction
    down, up = slopes
    half = 0.5 * speed * (down.half + up.half)
    return (
        _less(gas, 0.5 * speed * (down.value - up.value), half),
        rate,
        _less(friction, 0.5 * speed * (down.value + up.value), half),
    )


def _less(figure: Figure, bleed_n: float, half_n: float) -> Figure:
    """A figure without the damping at its speed, which is known but for some half width."""
    value = figure.value - bleed_n
    half = float(np.hypot(figure.half, half_n))
    method = f"{figure.method}, less {bleed_n:.2g} N of damping there"
    return Figure.around(value, half, method)


def find_slowest(steps: Sequence[DynoStep]) -> DynoStep | None:
    """The slowest quasi-static step, if there is one."""
    slow = [step for step in steps if step.kind == "quasi_static"]
    return min(slow, key=lambda step: step.peak_speed_m_per_s, default=None)


def spring_curve(step: DynoStep) -> np.polynomial.Polynomial:
    """Force of gas and spring over height, from the mean of both strokes of a slow step.

    Friction cancels in it, and damping but for what it differs by in both directions, which is
    proportional to the speed there.
    """
    down, up = step.strokes
    inner = np.abs(np.sin(ANGLES)) <= _INNER
    # At one height one stroke is at an angle, and the other at its negative.
    mean_n = 0.5 * (down.force_n + up.force_n[::-1])[inner]
    share = np.sin(ANGLES)[inner]
    powers = share[:, None] ** np.arange(_SPRING_DEGREE + 1)
    speed = np.abs(down.velocity_m_per_s)[inner]
    weights = np.linalg.lstsq(np.column_stack([powers, speed]), mean_n, rcond=None)[0][:-1]
    # Compression goes downwards: the share of the stroke counts from the middle in its direction.
    ends_m = [down.middle_m - sign * down.sign * down.amplitude_m for sign in (1.0, -1.0)]
    return np.polynomial.Polynomial(weights, domain=ends_m, window=[-1.0, 1.0])


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
    if not (up.is_bounded and down.is_bounded):
        return None
    offset = 0.0 if gas is None else gas.value
    rebound, compression = -(up.value - offset), down.value - offset
    if compression <= 0.0 or rebound <= 0.0:
        return None
    ratio = rebound / compression
    own = 0.0 if gas is None else gas.half
    parts = (
        up.half / rebound,
        down.half / compression,
        own * (1.0 / rebound + 1.0 / compression),
    )
    half = ratio * float(np.linalg.norm(parts))
    of = "whole force" if gas is None else "force less gas force"
    return Figure.around(ratio, half, f"{of} at peak velocity, fastest step")
