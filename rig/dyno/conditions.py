"""What differs between two records beside the damper: temperature and the zero of the load cell.

A figure of the second record is brought to the temperature of the first one by the change per
kelvin, where one of the records determines it; where none does, forces of more than two kelvins
apart are not comparable. What temperature does to gas, friction and a knee is in their intervals.

All forces of a record are shifted by the zero of its load cell, and by the gas force. The gas of a
monotube damper is a spring whose rate is proportional to its force, so that the rate tells one
shift from the other.

References:
    Dixon, The Shock Absorber Handbook (2007), 5 and 7.12, for gas and temperature.
"""

import math
from typing import NamedTuple

from rig.dyno.characterise import Characteristics
from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.stroke_force import Figure
from rig.dyno.temperature import FRICTION_PER_K, GAS_PER_K, TYPICAL_PER_K, apart_k

_STDS = 1.96
"""Standard deviations of half an interval."""

_NO_MATTER_K, _FAR_K = 0.3, 2.0
"""Differences of temperature that are not noticed, and beyond which an unknown change matters."""

_CERTAIN = 3.0
"""Standard deviations from which on a shift of all forces is one."""


class RecordConditions(NamedTuple):
    """What differs between a first and a second record.

    Attributes:
        share_per_k: Relative change of the damping per kelvin in both directions; None unknown.
        gas_n: Gas force of the first record; zero where it is not known.
        shift: Shift of all forces, second less first; None where a record lacks a slow step.
        cause: `gas`, `zero` of the load cell, or `open`; empty where there is no shift.
    """

    share_per_k: tuple[Figure | None, Figure | None]
    gas_n: float
    shift: Figure | None
    cause: str

    def force(self, figure: Figure, side: int, apart_k: float) -> Figure | None:
        """A force of the second record as it would be in the first one; None if that is unknown."""
        share = self.share_per_k[side]
        value, more = figure.value, 0.0
        if self.shift is not None:
            value -= self.shift.value
            more = self.shift.half
        damping_n = value - self.gas_n
        if abs(apart_k) < _NO_MATTER_K:
            return _with(figure, value, more)
        if share is None:
            if abs(apart_k) > _FAR_K:
                return None
            return _with(figure, value, more, damping_n * TYPICAL_PER_K * apart_k)
        warmed_n = damping_n / (1.0 + share.value * apart_k)
        return _with(figure, self.gas_n + warmed_n, more, damping_n * share.half * apart_k)

    def energy(self, figure: Figure, apart_k: float) -> Figure | None:
        """An energy of the second record as it would be in the first one; None if unknown."""
        down, up = self.share_per_k
        if abs(apart_k) < _NO_MATTER_K:
            return figure
        if down is None or up is None:
            if abs(apart_k) > _FAR_K:
                return None
            return _with(figure, figure.value, figure.value * TYPICAL_PER_K * apart_k)
        share = 0.5 * (down.value + up.value)
        # Each direction has its part in the energy, which is not known here.
        half = 0.5 * abs(down.value - up.value) + max(down.half, up.half)
        value = figure.value / (1.0 + share * apart_k)
        return _with(figure, value, figure.value * (half + 0.1 * FRICTION_PER_K) * apart_k)


def find_conditions(before: Characteristics, after: Characteristics) -> RecordConditions:
    """What differs between two records beside the damper."""
    shares = tuple(_share(before, after, side) for side in SIDES)
    first, second = before.damper.gas_force_n, after.damper.gas_force_n
    gas_n = 0.0 if first is None else first.value
    if first is None or second is None:
        return RecordConditions((shares[0], shares[1]), gas_n, None, "")
    half = math.hypot(first.half, second.half)
    shift = Figure.around(second.value - first.value, half, "gas force of the slowest steps")
    return RecordConditions((shares[0], shares[1]), gas_n, shift, _cause(before, after, shift))


def slowest(record: Characteristics) -> DynoStep:
    """The slowest step of a record."""
    return min(record.steps, key=lambda step: step.peak_speed_m_per_s)


def _share(before: Characteristics, after: Characteristics, side: str) -> Figure | None:
    """Relative change per kelvin of both records, by the inverse of their variances."""
    known = [
        share
        for record in (before, after)
        if (share := record.damper.share_per_kelvin_per_k[side]) is not None
    ]
    if not known:
        return None
    weights = [1.0 / max(share.half, 1e-9) ** 2 for share in known]
    value = sum(w * share.value for w, share in zip(weights, known, strict=True)) / sum(weights)
    half = sum(weights) ** -0.5
    return Figure.around(value, half, known[0].method)


def _cause(before: Characteristics, after: Characteristics, shift: Figure) -> str:
    """What shifts all forces, by the change of the spring rate."""
    gas = before.damper.gas_force_n
    first, second = before.damper.gas_rate_n_per_m, after.damper.gas_rate_n_per_m
    if abs(shift.value) < _CERTAIN / _STDS * shift.half:
        return ""
    if gas is None or first is None or second is None:
        return "open"
    apart = abs(apart_k(slowest(before), slowest(after)))
    by_gas = shift.value / gas.value
    shown = second.value / first.value - 1.0
    half = math.hypot(first.half / first.value, second.half / first.value)
    half = math.hypot(half, GAS_PER_K * apart, abs(by_gas) * gas.half / abs(gas.value))
    is_gas, is_zero = abs(shown - by_gas) <= half, abs(shown) <= half
    if is_gas == is_zero:
        return "open"
    return "gas" if is_gas else "zero"


def _with(figure: Figure, value: float, *more: float) -> Figure:
    """A figure with another value, and further half widths in its interval."""
    half = math.hypot(figure.half, *more)
    return Figure.around(value, half, figure.method)
