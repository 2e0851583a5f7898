"""What differs between states of a damper, by how much, and what does not.

Steps of one speed and amplitude are held against each other, figure by figure, and the figures of
the whole damper. A difference is one if it is not by chance at a level of 5 % over all figures of
the comparison together (Holm's procedure). Over a dose the change is a weighted straight line.

References:
    Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statistics 6 (1979).
    ISO/IEC Guide 98-3 (2008), for the combination of uncertainties.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr  # pyright: ignore[reportUnknownVariableType]

from can_dbc.errors import InputError
from rig.dyno.characterise import Characteristics
from rig.dyno.figures import DynoStep
from rig.dyno.stroke_force import Figure, student_factor

_ALIKE = 0.1
"""Relative difference of speed and amplitude up to which steps are held against each other."""

_LEVEL = 0.05
_STDS = 1.96
"""Standard deviations of half an interval."""

_FEWEST_DOSES = 3
_MISFIT = 3.0
"""Times that the points' distances from a line may be what their intervals say, on average of the
squares, before it is called bent."""


class Difference(NamedTuple):
    """One figure in two states.

    Attributes:
        name: The figure, with the speed of its step.
        unit: Its unit.
        before: In the first state.
        after: In the second state.
        change: Second less first.
        differs: Whether that is more than chance.
    """

    name: str
    unit: str
    before: Figure
    after: Figure
    change: Figure
    differs: bool

    def as_dict(self) -> dict[str, object]:
        """For a file."""
        return {
            "figure": self.name,
            "unit": self.unit,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "change": self.change.as_dict(),
            "differs": self.differs,
        }


class Trend(NamedTuple):
    """One figure over a dose.

    Attributes:
        name: The figure.
        unit: Its unit.
        slope: Its change per unit of the dose.
        at_zero: Where the line meets a dose of zero.
        differs: Whether the slope is more than chance.
        is_straight: Whether a straight line is all that the points show.
    """

    name: str
    unit: str
    slope: Figure
    at_zero: float
    differs: bool
    is_straight: bool

    def as_dict(self) -> dict[str, object]:
        """For a file."""
        return {
            "figure": self.name,
            "unit": self.unit,
            "slope": self.slope.as_dict(),
            "at_zero": self.at_zero,
            "differs": self.differs,
            "is_straight": self.is_straight,
        }


def compare_dampers(before: Characteristics, after: Characteristics) -> list[Difference]:
    """Differences of two states, those that are more than chance first.

    Raises:
        InputError: They have no figure in common.
    """
    pairs = _common_figures([before, after])
    changes = [_difference(second, first) for _, (first, second) in pairs.values()]
    differs = _holm_procedure([_p_value(change) for change in changes])
    found = [
        Difference(name, unit, first, second, change, differ)
        for (name, (unit, (first, second))), change, differ in zip(
            pairs.items(), changes, differs, strict=True
        )
    ]
    return sorted(found, key=lambda item: not item.differs)


def trends_over_dose(items: Sequence[Characteristics], doses: Sequence[float]) -> list[Trend]:
    """Figures over a dosed cause, those that follow it first.

    Args:
        items: A state at each dose.
        doses: The doses.

    Raises:
        InputError: There are fewer than three doses, all of one size, or no figure in common.
    """
    if not all(map(math.isfinite, doses)):
        raise InputError(f"--dose: {', '.join(map(str, doses))}: expected finite numbers")
    if len(items) != len(doses) or len(set(doses)) < _FEWEST_DOSES:
        raise InputError(
            f"--dose: {len(doses)} for {len(items)} records, expected one each and at least three "
            "different ones"
        )
    fits = {
        name: (unit, _fit_line(np.array(doses), figures))
        for name, (unit, figures) in _common_figures(items).items()
    }
    differs = _holm_procedure([_p_value(slope) for _, (slope, _, _) in fits.values()])
    found = [
        Trend(name, unit, slope, at_zero, differ, straight)
        for (name, (unit, (slope, at_zero, straight))), differ in zip(
            fits.items(), differs, strict=True
        )
    ]
    return sorted(found, key=lambda item: not item.differs)


def pair_steps(
    reference: Characteristics, item: Characteristics
) -> list[tuple[DynoStep, DynoStep]]:
    """Steps of one speed and amplitude: of the reference, and of the other record."""
    found: list[tuple[DynoStep, DynoStep]] = []
    taken: set[int] = set()
    for wanted in reference.steps:
        place = _find_nearest(wanted, item.steps, taken)
        if place is not None:
            taken.add(place)
            found.append((wanted, item.steps[place]))
    return found


def steps_without_partner(items: Sequence[Characteristics]) -> list[str]:
    """Steps that have no partner of their speed and amplitude in every other record, in words."""
    found: list[str] = []
    for item in items:
        for other in items:
            taken: set[int] = set()
            for wanted in item.steps if other is not item else ():
                place = _find_nearest(wanted, other.steps, taken)
                if place is not None:
                    taken.add(place)
                    continue
                found.append(
                    f"{item.name}, ±{1e3 * wanted.amplitude_m:.3g} mm at "
                    f"{wanted.peak_speed_m_per_s:.3g} m/s: no such step in {other.name}"
                )
    return found


def _fit_line(doses: "np.ndarray", figures: Sequence[Figure]) -> tuple[Figure, float, bool]:
    """Slope, value at zero and whether a line is enough, by weighted least squares."""
    values = np.array([figure.value for figure in figures])
    stds = np.array([_standard_deviation(figure) for figure in figures])
    design = np.column_stack([np.ones_like(doses), doses]) / stds[:, None]
    weights = np.linalg.lstsq(design, values / stds, rcond=None)[0]
    left = values / stds - design @ weights
    freedom = len(doses) - 2
    misfit = float(left @ left) / freedom
    covariance = np.linalg.inv(design.T @ design) * max(misfit, 1.0)
    half = (student_factor(freedom) if misfit > 1.0 else _STDS) * float(np.sqrt(covariance[1, 1]))
    at_zero, slope = (float(value) for value in weights)
    figure = Figure(slope, slope - half, slope + half, f"line through {len(doses)} doses")
    return figure, at_zero, misfit < _MISFIT


def _common_figures(items: Sequence[Characteristics]) -> dict[str, tuple[str, list[Figure]]]:
    """Figures that all states have: by name their unit, and one a state."""
    first, *others = [_figures_by_name(item, items[0]) for item in items]
    found = {
        name: (unit, [figure, *(other[name][1] for other in others)])
        for name, (unit, figure) in first.items()
        if all(name in other for other in others)
    }
    if not found:
        names = ", ".join(item.name for item in items)
        raise InputError(f"{names}: no step of one speed and amplitude in common")
    return found


def _figures_by_name(
    item: Characteristics, reference: Characteristics
) -> Mapping[str, tuple[str, Figure]]:
    """Figures by name; steps are called by their speed in the first record."""
    damper = item.damper
    found: dict[str, tuple[str, Figure | None]] = {
        "gas force": ("N", damper.gas_force),
        "gas spring rate": ("N/m", damper.gas_rate),
        "friction": ("N", damper.friction),
        "rebound over compression": ("", damper.asymmetry),
        **{f"knee, {side}": ("m/s", figure) for side, figure in damper.knee.items()},
    }
    taken: set[int] = set()
    for wanted in reference.steps:
        place = _find_nearest(wanted, item.steps, taken)
        if place is None:
            continue
        taken.add(place)
        step, at = item.steps[place], f"at {wanted.peak_speed_m_per_s:.3g} m/s"
        found |= {
            f"compression force {at}": ("N", step.compression.force_at_peak_velocity),
            f"rebound force {at}": ("N", step.rebound.force_at_peak_velocity),
            f"energy per cycle {at}": ("J", step.energy_per_cycle),
            f"spring rate {at}": ("N/m", step.spring_rate),
            f"hysteresis at the turning points {at}": ("N", step.hysteresis_at_zero),
        }
    return {name: (unit, figure) for name, (unit, figure) in found.items() if figure is not None}


def _find_nearest(wanted: DynoStep, steps: Sequence[DynoStep], taken: set[int]) -> int | None:
    """Place of the step that is most like another, if one is."""

    def apart(step: DynoStep) -> float:
        pairs = (
            (step.peak_speed_m_per_s, wanted.peak_speed_m_per_s),
            (step.amplitude_m, wanted.amplitude_m),
        )
        return max(abs(own / other - 1.0) for own, other in pairs)

    free = [place for place in range(len(steps)) if place not in taken]
    best = min(free, key=lambda place: apart(steps[place]), default=None)
    return best if best is not None and apart(steps[best]) <= _ALIKE else None


def _standard_deviation(figure: Figure) -> float:
    return max(0.5 * (figure.high - figure.low) / _STDS, 1e-12)


def _difference(second: Figure, first: Figure) -> Figure:
    value = second.value - first.value
    half = _STDS * math.hypot(_standard_deviation(second), _standard_deviation(first))
    return Figure(value, value - half, value + half, second.method)


def _p_value(figure: Figure) -> float:
    """Probability of a value as far from zero by chance."""
    return 2.0 * float(ndtr(-abs(figure.value) / _standard_deviation(figure)))  # pyright: ignore[reportUnknownArgumentType]


def _holm_procedure(chances: Sequence[float]) -> list[bool]:
    """Which are more than chance, all of them together at one level."""
    order = sorted(range(len(chances)), key=lambda place: chances[place])
    found = [False] * len(chances)
    for rank, place in enumerate(order):
        if chances[place] > _LEVEL / (len(chances) - rank):
            break
        found[place] = True
    return found
