"""Names the fault of a damper that differs from its master, with its size.

Every known fault is simulated in the master, step by step; its changes are compared with the
differences between the damper's mean strokes and the master's. Good dampers differ too: by their
measurement, and by the scatter of manufacturing in gas force, friction, damping below and above the
knee, and the knee's speed. A fault is named if it explains far more than both.

The comparison is that of Gaussian likelihoods: differences are normal about what a fault of some
size makes of them, with a covariance of measurement, scatter and the model's own coarseness; the
best size of each fault is found, and what it lowers the chi-squared by is held against
`_NAMED` (Wilks, Ann. Math. Stat. 9, 1938).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve  # pyright: ignore[reportUnknownVariableType]

from can_dbc.errors import InputError
from rig.dyno.characterise import Characteristics
from rig.dyno.comparison import pair_steps
from rig.dyno.figures import DynoStep
from rig.dyno.master import (
    Cycle,
    DampingCurve,
    Master,
    cycle_of,
    refuse_unsuitable,
    with_compliance,
    with_play,
)
from rig.dyno.stroke_force import FINE, Figure, MeanStroke
from rig.dyno.strokes import Array

_NAMED = 32.0
"""Fall of chi-squared from which on a fault is named. Of differences that are normal one in a
million reaches 25 by chance; the model describes dampers but roughly. With this value and the
shares below none of 420 good dampers was named (`python -m tests.dyno.population`, seeds
4 and 5), with a first choice of them seven of 720 were (seeds 2 to 4)."""

_BINS = 24
"""Parts of a stroke whose samples' means are held against the master."""

_OWN_SHARE = 0.004
"""Model error at each angle, over the largest force of a step."""

_DAMPING_SHARE = 0.02
"""Model error at each angle, over the damping there."""

_EXPLAINED = 0.5
"""Share of the difference that faults have to explain to be named."""

_MODEL_SHARE = 0.1
"""Relative uncertainty of a fault's changes by the simulation in the master."""

_SIZE_SHARE = 0.15
"""Relative uncertainty of a size by the simulation in the master."""

_MOST_FAULTS = 2
_SIZES = 401
"""Sizes of a fault that are tried."""

_FALL = 3.84
"""Rise of chi-squared at the ends of a 95 % interval of one size."""


class Fault(NamedTuple):
    """A fault that can be simulated, in sizes from the least to the most that there can be.

    Attributes:
        sizes: Sizes that are tried, rising, shape (K,).
        changes: What each changes of the stacked forces, shape (K, N).
    """

    name: str
    quantity: str
    unit: str
    sizes: Array
    changes: Array
    least: float = -np.inf
    most: float = np.inf


_PHRASES = {
    "relative loss": ("{name} {size} lost", "{name} {size} too high"),
    "increase": ("{name} {size} higher", "{name} {size} lower"),
    "compliance of the oil": ("{name}, which gives way by {size}", ""),
    "width": ("{name} of {size}", ""),
    "relative reduction of the opening speed": ("{name}, at a speed {size} lower", ""),
    "relative change at all speeds": ("{name}: {size} higher", "{name}: {size} lower"),
}
"""Words for a positive and a negative size of each quantity."""


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


class NamedFault(NamedTuple):
    """A fault with its size, a 95 % interval, and the decrease of chi-squared that it explains."""

    name: str
    quantity: str
    unit: str
    size: Figure
    evidence: float

    def words(self) -> str:
        """The same in a line, such as “gas pressure 52 % lost (95 %: 40 to 65 %)”."""
        size, unit = self.size, self.unit or "%"
        more, less = _PHRASES[self.quantity]
        is_less = size.value < 0.0
        scale = (-1.0 if is_less else 1.0) * (1.0 if self.unit else 100.0)
        low, value, high = sorted(scale * end for end in (size.low, size.value, size.high))
        bound = "at least " if math.isinf(high) else "at most " if math.isinf(low) else ""
        words = (less if is_less else more).format(
            name=self.name, size=f"{bound}{_two_digits(value)}\u00a0{unit}"
        )
        interval = f" (95\u00a0%: {_two_digits(low)} to {_two_digits(high)}\u00a0{unit})"
        return words if bound else words + interval


class MasterComparison(NamedTuple):
    """Comparison of a damper with its master.

    Attributes:
        named: Faults, the one that explains most first; empty of a good damper.
        is_good: Whether it differs by no more than good dampers do.
        explained: Share of the chi-squared beyond a good damper's that the faults explain; 1 of a
            good damper.
        not_compared: Steps of the master that the damper's record has not.
    """

    named: tuple[NamedFault, ...]
    is_good: bool
    explained: float
    not_compared: tuple[str, ...] = ()

    @property
    def passes(self) -> bool:
        """Whether it is proven to be as its master: in all of the master's steps."""
        return self.is_good and not self.not_compared

    def words(self) -> str:
        """The same in a sentence."""
        if self.is_good:
            where = " in the steps that were compared" if self.not_compared else ""
            text = f"as its master{where}, within what manufacturing scatters"
        elif not self.named:
            text = "not as its master, and no fault that is known explains it"
        else:
            faults = " and ".join(item.words() for item in self.named)
            text = f"{faults}; this explains {100 * self.explained:.0f} % of the difference"
        missing = f"; not compared: {', '.join(self.not_compared)}" if self.not_compared else ""
        return text + missing


class _StrokePair(NamedTuple):
    """The forces of a damper less the master's, part by part of a stroke.

    Attributes:
        good: The master's stroke.
        gather: Means over its parts as rows over `FINE`, shape (parts, 361).
        less_n: Differences, shape (parts,).
        noise_n: Standard deviation of each by the noise of its samples, shape (parts,).
    """

    good: MeanStroke
    gather: Array
    less_n: Array
    noise_n: Array


def _pair_strokes(own: MeanStroke, good: MeanStroke) -> _StrokePair:
    part = np.arange(len(FINE)) * _BINS // len(FINE)
    counts = np.bincount(part, weights=own.samples, minlength=_BINS)
    filled = np.flatnonzero(counts)
    rows = (part == filled[:, None]) * own.samples / counts[filled, None]
    means = np.bincount(part, weights=own.sums_n, minlength=_BINS)[filled] / counts[filled]
    less_n = means - rows @ (good.row(FINE) @ good.force_n)
    return _StrokePair(good, rows, less_n, good.noise_n / np.sqrt(counts[filled]))


def _bin_means(pairs: Sequence[_StrokePair], fine: Sequence[Array]) -> Array:
    """Curves over `FINE` of every stroke, shape (..., 361), as means over its parts."""
    parts = [curve @ pair.gather.T for curve, pair in zip(fine, pairs, strict=True)]
    return np.concatenate(parts, axis=-1)


def name_faults(tested: Characteristics, master: Master, scatter: float) -> MasterComparison:
    """The comparison of a damper with its master, a good item in the same test.

    `scatter` is the relative standard deviation that manufacturing leaves of each property.

    Raises:
        InputError: No step of item has a partner in the other.
    """
    refuse_unsuitable(tested)
    steps = pair_steps(master.characteristics, tested)
    compared = [theirs for theirs, mine in steps if mine is not None]
    if not compared:
        raise InputError(
            f"{tested.name}, {master.characteristics.name}: no step of equal speed and amplitude "
            "in common, expected the same test as the master's"
        )
    pairs = [
        _pair_strokes(own, good)
        for theirs, mine in steps
        if mine is not None
        for own, good in zip(mine.strokes, theirs.strokes, strict=True)
    ]
    faults = [
        fault._replace(changes=_bin_means(pairs, np.split(fault.changes, len(pairs), axis=1)))
        for fault in simulate_faults(master, compared)
    ]
    covariance = _covariance(pairs, master, scatter)
    residual_n = np.concatenate([pair.less_n for pair in pairs])
    count = len(residual_n)
    before = _misfit(residual_n, covariance)
    beyond = max(before - count, 1.0)
    kept: list[NamedFault] = []
    for _ in range(_MOST_FAULTS):
        names = [item.name for item in kept]
        fits = [
            _fit_size(item, residual_n, covariance, before)
            for item in faults
            if item.name not in names
        ]
        best, explained_n = max(fits, key=lambda fit: fit[0].evidence)
        if best.evidence < _NAMED:
            break
        kept.append(best)
        # The uncertainty of a simulated fault grows with its size.
        residual_n = residual_n - explained_n
        covariance = covariance + np.diag((_MODEL_SHARE * explained_n) ** 2)
        before = _misfit(residual_n, covariance)
    remains = max(before - count, 0.0)
    is_good = not kept and remains <= (_WORST_MISFIT - 1.0) * count
    lacking = tuple(
        f"±{1e3 * step.amplitude_m:.3g} mm at {step.peak_speed_m_per_s:.3g} m/s"
        for step, partner in steps
        if partner is None
    )
    if kept and remains > (1.0 - _EXPLAINED) * beyond:
        kept = []  # the nearest fault does not explain enough
    explained = 1.0 if is_good else max(1.0 - remains / beyond, 0.0)
    return MasterComparison(tuple(kept), is_good, explained, lacking)


_WORST_MISFIT = 1.5
"""Chi-squared per force up to which a damper without an identified fault is accepted; the good ones
of the study have 0.6 to 1.2."""


def _fit_size(
    fault: Fault, residual_n: Array, covariance: Array, before: float
) -> tuple[NamedFault, Array]:
    """A fault at its best size, and its share of the differences; `before`: misfit without it."""
    nodes: Array = np.arange(len(fault.sizes), dtype=np.float64)
    tried: Array = np.linspace(0.0, float(nodes[-1]), _SIZES)
    sizes: Array = np.interp(tried, nodes, fault.sizes).astype(np.float64)
    columns: list[Array] = [
        np.interp(sizes, fault.sizes, fault.changes[:, index]).astype(np.float64)
        for index in range(fault.changes.shape[1])
    ]
    changes: Array = np.array(columns).T
    apart = residual_n - changes
    factor = cho_factor(covariance, lower=True)
    solved = cho_solve(factor, apart.T).T
    chi: Array = np.einsum("ij,ij->i", apart, solved)
    best = int(np.argmin(chi))
    within = sizes[chi <= float(chi[best]) + _FALL]
    value = float(sizes[best])
    step = float(sizes[min(best + 1, len(sizes) - 1)] - sizes[max(best - 1, 0)])
    more = _SIZE_SHARE * abs(value)
    low = value - float(np.hypot(value - float(within[0]) + step, more))
    high = value + float(np.hypot(float(within[-1]) - value + step, more))
    # A size at the end of those that were tried is that at least, or at most.
    low = -np.inf if within[0] == sizes[0] and sizes[0] != 0.0 else low
    high = np.inf if within[-1] == sizes[-1] else high
    size = Figure(
        value,
        float(max(low, fault.least)),
        float(min(high, fault.most)),
        "profile of the likelihood, and what the run in the master is known by",
    )
    evidence = before - float(chi[best])
    return NamedFault(fault.name, fault.quantity, fault.unit, size, evidence), changes[best]


def _misfit(residual_n: Array, covariance: Array) -> float:
    factor = cho_factor(covariance, lower=True)
    return float(residual_n @ cho_solve(factor, residual_n))


def _covariance(pairs: Sequence[_StrokePair], master: Master, scatter: float) -> Array:
    """Covariance of the differences between two good dampers."""
    whole = np.diag(np.concatenate([pair.noise_n for pair in pairs]) ** 2)
    properties = [_property_forces(pair.good, master) for pair in pairs]
    begin = 0
    for (stroke, rows, *_), forces in zip(pairs, properties, strict=True):
        here = slice(begin, begin + len(rows))
        begin += len(rows)
        damping = rows @ (forces["compression"] + forces["rebound"])
        largest = float(np.abs(stroke.force_n).max())
        extra = (_OWN_SHARE * largest) ** 2 + (_DAMPING_SHARE * damping) ** 2
        of_master = rows @ stroke.row(FINE)
        whole[here, here] += of_master @ stroke.covariance @ of_master.T + np.diag(extra)
    for name in properties[0]:
        column = _bin_means(pairs, [forces[name] for forces in properties])
        # The master is one of them too.
        whole += 2.0 * scatter**2 * np.outer(column, column)
    return whole


def _velocity(stroke: MeanStroke) -> Array:
    return stroke.row(FINE) @ stroke.velocity_m_per_s


def _property_forces(stroke: MeanStroke, master: Master) -> Mapping[str, Array]:
    """What each property that scatters makes of a stroke's force at `FINE`, whole."""
    height = stroke.middle_m + stroke.sign * stroke.amplitude_m * np.sin(FINE)
    velocity = _velocity(stroke)
    speed = np.abs(velocity)
    damping = master.damping(velocity)
    columns = {
        "gas": master.gas(height),
        "friction": np.full_like(FINE, -stroke.sign * master.friction_n),
    }
    for side, sign, curve in (
        ("compression", -1, master.compression),
        ("rebound", 1, master.rebound),
    ):
        is_it = stroke.sign == sign
        at_zero, upper = curve.upper_line()
        opens = max(at_zero, 0.0) / max(curve.lower_slope() - upper, 1.0)
        columns[side] = damping * is_it
        columns[f"{side} above"] = -sign * upper * np.maximum(speed - opens, 0.0) * is_it
        less = _opening_loss(curve, speed, np.array([_SMALL]))[0]
        columns[f"{side} knee"] = -sign * less / _SMALL * is_it
    return columns


_SMALL = 0.05
"""Share by which a knee is moved to see what its scatter makes."""


def _opening_loss(curve: DampingCurve, speed: Array, shares: Array) -> Array:
    """By how much a valve lowers the force that opens at a speed lower by shares, shape (K, N).

    Above the knee a curve is a line, and a knee at a lower speed is the same line lower down.
    """
    at_zero, upper = curve.upper_line()
    good, lines = curve.force(speed), at_zero * (1.0 - shares[:, None]) + upper * speed
    # A knee is no corner: that the curve is below its own line there is no fault.
    return np.minimum(good, lines) - np.minimum(good, at_zero + upper * speed)


def simulate_faults(master: Master, steps: Sequence[DynoStep]) -> list[Fault]:
    """All faults that are known, run in the master in steps of its record.

    Returns:
        Faults whose changes are those at `FINE` of all strokes of the steps, one after the other.
    """
    strokes = [stroke for step in steps for stroke in step.strokes]
    gas = np.concatenate([_property_forces(stroke, master)["gas"] for stroke in strokes])
    against = np.repeat([-float(stroke.sign) for stroke in strokes], len(FINE))
    lost = np.concatenate([[-4.0, -2.0], np.linspace(-1.0, 1.0, 41)])
    usual_n = max(master.friction_n, 5.0)
    more_n = np.concatenate(
        [np.linspace(-master.friction_n, 10.0 * usual_n, 61), usual_n * np.array([20.0, 60.0])]
    )
    gives = _compliances(master)
    plays = np.concatenate([[0.0], np.geomspace(2e-5, 8e-3, 32)])
    rates = 1e6 / np.maximum(gives, 1e-3 * gives[1])
    by_air = _changes_by_cycle(steps, lambda cycle: with_compliance(master, cycle, rates))
    by_play = _changes_by_cycle(steps, lambda cycle: with_play(master, cycle, plays))
    least_n = -master.friction_n
    return [
        Fault("gas pressure", "relative loss", "", lost, -lost[:, None] * gas, most=1.0),
        Fault("seal friction", "increase", "N", more_n, more_n[:, None] * against, least=least_n),
        Fault("air in the oil", "compliance of the oil", "mm/kN", gives, by_air, least=0.0),
        Fault("play", "width", "mm", 1e3 * plays, by_play, least=0.0),
        *[_early_opening(master, strokes, sides) for sides in _SIDES if _bend(master, sides)],
        *[_other_damping(master, strokes, sides) for sides in _SIDES],
    ]


_SIDES = (("compression",), ("rebound",), ("compression", "rebound"))


def _bend(master: Master, sides: Sequence[str]) -> bool:
    """Whether the curves of some sides bend at a knee: what a valve that opens makes."""
    curves = [getattr(master, side) for side in sides]
    return all(curve.upper_line()[0] > _BEND * curve.force_n[-2] for curve in curves)


_BEND = 0.1
"""Force at no speed of the upper line, over the largest force, from which on a curve has a knee."""


def _early_opening(master: Master, strokes: Sequence[MeanStroke], sides: Sequence[str]) -> Fault:
    """A valve that blows off at a lower speed, and from there on has the slope it has above."""
    shares = np.linspace(0.0, 0.9, 31)
    rows: list[Array] = []
    for stroke in strokes:
        side = "compression" if stroke.sign < 0 else "rebound"
        less = _opening_loss(getattr(master, side), np.abs(_velocity(stroke)), shares)
        rows.append(-stroke.sign * less * (side in sides))
    name = f"early blow-off in {' and '.join(sides)}"
    changes = np.concatenate(rows, axis=1)
    quantity = "relative reduction of the opening speed"
    return Fault(name, quantity, "", shares, changes, least=0.0, most=1.0)


def _other_damping(master: Master, strokes: Sequence[MeanStroke], sides: Sequence[str]) -> Fault:
    """Damping changed by one factor at all speeds: a different valve or oil."""
    shares = np.concatenate([np.linspace(-1.0, 1.0, 41), [2.0, 4.0]])
    rows = [sum(_property_forces(stroke, master)[side] for side in sides) for stroke in strokes]
    name = f"changed damping in {' and '.join(sides)}"
    changes = shares[:, None] * np.concatenate(rows)
    return Fault(name, "relative change at all speeds", "", shares, changes, least=-1.0)


def _compliances(master: Master) -> Array:
    """How far the oil gives way, in mm/kN, up to half the amplitude at the largest force."""
    largest = max(float(master.compression.force_n[-2]), float(master.rebound.force_n[-2]))
    amplitude = max(step.amplitude_m for step in master.characteristics.steps)
    most = 0.5 * amplitude / largest * 1e6
    return np.concatenate([[0.0], np.geomspace(1e-3 * most, most, 24)])


def _changes_by_cycle(steps: Sequence[DynoStep], run: Callable[[Cycle], Array]) -> Array:
    """What a fault's sizes change of a cycle of each step, along its strokes; first size: none."""
    parts: list[Array] = []
    for step in steps:
        made = run(cycle_of(step))
        changes = made - made[0]
        parts += [_at_stroke_angles(stroke, changes) for stroke in step.strokes]
    return np.concatenate(parts, axis=1)


def _at_stroke_angles(stroke: MeanStroke, changes: Array) -> Array:
    """Changes over a cycle at the angles of a stroke; a cycle begins in the middle of rebound."""
    turn = FINE if stroke.sign > 0 else np.pi + FINE
    times = changes.shape[1]
    position = turn / (2.0 * np.pi) * times % times
    grid: Array = np.arange(times + 1, dtype=np.float64)
    closed = np.concatenate([changes, changes[:, :1]], axis=1)
    return np.array([np.interp(position, grid, row) for row in closed], dtype=np.float64)
