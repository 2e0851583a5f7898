"""Drift of a load cell's zero, from the rests of a record and the cycles of its steps.

The force at rest at one height is that of the gas, and what friction holds. Where it changes over a
test, the zero drifted, the gas warmed, or friction holds another way. A zero that drifts changes
the mean force of the cycles of a step as well; friction that holds another way does not. Both
together determine a polynomial over time by weighted least squares, which is the drift, counted
from its begin. Where cycles and rests contradict each other, there is none. Damping that fades
changes the mean of a cycle, too, where one direction is stronger: that is in the weights.

Reference: Seber and Lee, Linear Regression Analysis (2003), 3.10, for generalised least squares.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rig.dyno.figures import AtRest, ForceRecord
from rig.dyno.stroke_force import Figure
from rig.dyno.strokes import Array, Block

_SAME_HEIGHT_M = 5e-4
"""By which rests of one height may differ: of a gas spring of 2 N/mm that is 1 N."""

_LEAST_SHARE, _MOST_SHARE = 0.5, 1.5
"""Shares of the rests' change that the cycles have to show."""

_FADE = 0.003
"""Share of a step's largest force by which its mean may change as it warms up: half of the fade of
2 % in a step, of a damper whose rebound is twice its compression."""

_SLOW_M_PER_S = 5e-3
"""Speed up to which there is no damping to fade."""

_MOST_DEGREES, _FITS = 4, 3.0
"""Highest degree of the polynomial, and mean square of the misfits, in their standard deviations,
below which a lower degree is enough."""

_CERTAIN = 4.0
"""Standard deviations from which on a drift is one."""


class ZeroDrift(NamedTuple):
    """Change of the force of a load cell over time that is not the strut's.

    Attributes:
        line: The change, in N, over time in s; zero at its begin.
        begin_s: First time at which it is known; constant before.
        end_s: Last time; constant afterwards.
        largest: Change from its begin to where it is largest.
        is_known: Whether it may be removed.
        source: What shows it, as a phrase.
    """

    line: np.polynomial.Polynomial
    begin_s: float
    end_s: float
    largest: Figure
    is_known: bool
    source: str

    def at(self, t_s: Array) -> Array:
        """Drift at times."""
        inside_s = np.clip(t_s, self.begin_s, self.end_s)
        return np.asarray(self.line(inside_s), np.float64)


class _Cycles(NamedTuple):
    """Mean forces of the first and of the last cycle of a step: times, difference, deviation."""

    first_s: float
    last_s: float
    change_n: float
    std_n: float


def estimate_drift(
    record: ForceRecord, blocks: Sequence[Block], rests: Sequence[AtRest]
) -> ZeroDrift | None:
    """The drift of a record; None where neither rests nor cycles show one."""
    mine = _alike(rests)
    cycles = [it for block in blocks if (it := _cycles_of(record, block)) is not None]
    at_rest = _fit(mine, []) if len(mine) > 1 else None
    if at_rest is not None and not _is_seen(at_rest):
        at_rest = None
    if at_rest is None:
        moving = _fit([], cycles)
        # Rests that do not change contradict a drift that only cycles show.
        has_rests = len(mine) > 1
        is_drift = moving is not None and not has_rests and _is_seen(moving)
        return moving._replace(source="the cycles of the steps") if moving and is_drift else None
    if not _confirm(cycles, at_rest):
        return at_rest._replace(is_known=False)
    both = _fit(mine, cycles)
    return None if both is None else both._replace(source="rests and cycles")


def _alike(rests: Sequence[AtRest]) -> list[AtRest]:
    """The rests of the height at which most of them are."""
    alike = [
        [rest for rest in rests if abs(rest.height_m - other.height_m) <= _SAME_HEIGHT_M]
        for other in rests
    ]
    return max(alike, key=len) if alike else []


def _cycles_of(record: ForceRecord, block: Block) -> _Cycles | None:
    """How the mean force of a block's cycles changes; None with less than two whole cycles."""
    begins = [stroke.first for stroke in block.strokes[::2]]
    if len(begins) < 3:
        return None
    spans = [slice(*pair) for pair in itertools.pairwise(begins)]
    means_n = np.array([float(record.force_n[span].mean()) for span in spans])
    times_s = np.array([float(record.t_s[span].mean()) for span in spans])
    about_s = times_s - times_s.mean()
    slope = float(about_s @ means_n) / float(about_s @ about_s)
    length_s = float(times_s[-1] - times_s[0])
    force_n = record.force_n[begins[0] : begins[-1]]
    a_cycle = len(force_n) / len(spans)
    # A cycle begins and ends between two samples, and its samples have noise.
    cut_n = float(np.ptp(force_n)) / a_cycle
    std_n = cut_n * length_s / float(about_s @ about_s) ** 0.5
    stroke = block.strokes[0]
    if abs(stroke.rise_m) / stroke.duration_s > _SLOW_M_PER_S * 2.0 / np.pi:
        std_n = float(np.hypot(std_n, _FADE * float(np.abs(force_n).max())))
    return _Cycles(float(times_s[0]), float(times_s[-1]), slope * length_s, max(std_n, 1e-12))


def _fit(rests: Sequence[AtRest], cycles: Sequence[_Cycles]) -> ZeroDrift | None:
    """The polynomial of least degree that describes them; None where they determine none."""
    rest_s = np.array([0.5 * (rest.begin_s + rest.end_s) for rest in rests])
    force_n = np.array([rest.force_n.value for rest in rests])
    rest_std_n = np.array([0.51 * it.force_n.half for it in rests])
    first_s, last_s, change_n, std_n = (
        np.array([it[i] for it in cycles]) for i in range(len(_Cycles._fields))
    )
    times_s = np.concatenate([rest_s, first_s, last_s])
    equations = len(rest_s) + len(change_n) - (len(rest_s) > 0)
    if not len(times_s) or equations < 1 or np.ptp(times_s) <= 0.0:
        return None
    begin_s, end_s = float(times_s.min()), float(times_s.max())
    share = [(at_s - begin_s) / (end_s - begin_s) for at_s in (rest_s, first_s, last_s)]
    weights = 1.0 / np.concatenate([np.maximum(rest_std_n, 1e-12), std_n])
    target = np.concatenate([force_n, change_n]) * weights
    degree = 0
    while True:
        degree += 1
        powers = np.arange(1, degree + 1)
        at_rest = share[0][:, None] ** powers
        at_cycles = share[2][:, None] ** powers - share[1][:, None] ** powers
        level = np.concatenate([np.ones(len(rest_s)), np.zeros(len(change_n))])
        design = np.column_stack([np.concatenate([at_rest, at_cycles]), level]) * weights[:, None]
        found = np.linalg.lstsq(design, target, rcond=None)[0]
        residual = target - design @ found
        freedom = equations - degree
        misfit = float(residual @ residual)
        if degree >= _MOST_DEGREES or freedom < 1 or misfit <= _FITS * freedom:
            break
    covariance = np.linalg.pinv(design.T @ design)[:degree, :degree]
    covariance = covariance * max(1.0, misfit / max(freedom, 1))
    line = np.polynomial.Polynomial(
        [0.0, *found[:degree]], domain=[begin_s, end_s], window=[0.0, 1.0]
    )
    shares = np.linspace(0.0, 1.0, 101)[:, None] ** powers
    drift_n = shares @ found[:degree]
    at = int(np.argmax(np.abs(drift_n)))
    value = float(drift_n[at])
    half = 1.96 * float(shares[at] @ covariance @ shares[at]) ** 0.5
    figure = Figure.around(value, half, f"polynomial of degree {degree} over time")
    return ZeroDrift(line, begin_s, end_s, figure, is_known=True, source="rests at one height")


def _is_seen(drift: ZeroDrift) -> bool:
    half = drift.largest.half
    return abs(drift.largest.value) > _CERTAIN / 1.96 * half


def _confirm(cycles: Sequence[_Cycles], drift: ZeroDrift) -> bool:
    """Whether the cycles change as the rests do, by weighted least squares."""
    if not cycles:
        return False
    # Also beyond the rests, if these are not all along the test.
    x = np.array([drift.line(it.last_s) - drift.line(it.first_s) for it in cycles])
    y = np.array([it.change_n for it in cycles])
    w = np.array([it.std_n for it in cycles]) ** -2.0
    power = float(w @ (x * x))
    if power <= 0.0:
        return False
    share, std = float(w @ (x * y)) / power, power**-0.5
    return share - std >= _LEAST_SHARE and share + std <= _MOST_SHARE
