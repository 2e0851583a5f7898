"""Differences between states of a damper, and the trend of each figure over a dose.

Steps of equal speed and amplitude are compared figure by figure, and the figures of the whole
damper. A difference counts if it is significant at a level of 5 % over all figures of the
comparison together (Holm's procedure). The trend over a dose is a weighted straight line.

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
"""Relative difference of speed and amplitude up to which steps are compared."""

_LEVEL = 0.05
"""Chance of one figure called different where none is (Holm 1979)."""

_STDS = 1.96
"""Standard deviations of half an interval."""

_FEWEST_DOSES = 3
"""Doses from which on a line can fail to fit: it passes through any two."""

_MISFIT = 3.0
"""Mean squared distance of the points from a line, in their standard deviations, above which it is
called bent."""


class Difference(NamedTuple):
    """One figure in two states.

    Attributes:
        figure: Name of the figure, with the speed of its step.
        unit: Its unit.
        before: In the first state.
        after: In the second state.
        change: Second less first.
        differs: Whether the change is significant.
    """

    figure: str
    unit: str
    before: Figure
    after: Figure
    change: Figure
    differs: bool


class Trend(NamedTuple):
    """One figure over a dose.

    Attributes:
        figure: Name of the figure.
        unit: Its unit.
        slope: Its change per unit of the dose.
        at_zero: Value of the line at a dose of zero.
        differs: Whether the slope is significant.
        is_straight: Whether a straight line explains the points.
    """

    figure: str
    unit: str
    slope: Figure
    at_zero: float
    differs: bool
    is_straight: bool


def compare_dampers(before: Characteristics, after: Characteristics) -> list[Difference]:
    """Differences of two states, significant ones first.

    Raises:
        InputError: They have no figure in common.
    """
    pairs = _common_figures([before, after])
    changes = [_difference(second, first) for _, (first, second) in pairs.values()]
    differs = _holm_procedure([_p_value(change) for change in changes])
    differences = [
        Difference(name, unit, first, second, change, differ)
        for (name, (unit, (first, second))), change, differ in zip(
            pairs.items(), changes, differs, strict=True
        )
    ]
    return sorted(differences, key=lambda item: not item.differs)


def trends_over_dose(items: Sequence[Characteristics], doses: Sequence[float]) -> list[Trend]:
    """Trends of the figures over a dose, significant ones first.

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
    trends = [
        Trend(name, unit, slope, at_zero, differ, straight)
        for (name, (unit, (slope, at_zero, straight))), differ in zip(
            fits.items(), differs, strict=True
        )
    ]
    return sorted(trends, key=lambda item: not item.differs)


def pair_steps(
    reference: Characteristics, item: Characteristics
) -> list[tuple[DynoStep, DynoStep]]:
    """Steps of one speed and amplitude: of the reference, and of the other record."""
    pairs: list[tuple[DynoStep, DynoStep]] = []
    taken: set[int] = set()
    for step in reference.steps:
        index = _find_nearest(step, item.steps, taken)
        if index is not None:
            taken.add(index)
            pairs.append((step, item.steps[index]))
    return pairs


def steps_without_partner(items: Sequence[Characteristics]) -> list[str]:
    """Steps that have no partner of their speed and amplitude in every other record, in words."""
    texts: list[str] = []
    for item in items:
        for other in items:
            taken: set[int] = set()
            for step in item.steps if other is not item else ():
                index = _find_nearest(step, other.steps, taken)
                if index is not None:
                    taken.add(index)
                    continue
                texts.append(
                    f"{item.name}, ±{1e3 * step.amplitude_m:.3g} mm at "
                    f"{step.peak_speed_m_per_s:.3g} m/s: no such step in {other.name}"
                )
    return texts


def _fit_line(doses: "np.ndarray", figures: Sequence[Figure]) -> tuple[Figure, float, bool]:
    """Slope, value at zero, and whether a line explains the points, by weighted least squares."""
    values = np.array([figure.value for figure in figures])
    stds = np.array([_standard_deviation(figure) for figure in figures])
    design = np.column_stack([np.ones_like(doses), doses]) / stds[:, None]
    weights = np.linalg.lstsq(design, values / stds, rcond=None)[0]
    residual = values / stds - design @ weights
    freedom = len(doses) - 2
    misfit = float(residual @ residual) / freedom
    covariance = np.linalg.inv(design.T @ design) * max(misfit, 1.0)
    half = (student_factor(freedom) if misfit > 1.0 else _STDS) * float(np.sqrt(covariance[1, 1]))
    at_zero, slope = (float(value) for value in weights)
    figure = Figure(slope, slope - half, slope + half, f"line through {len(doses)} doses")
    return figure, at_zero, misfit < _MISFIT


def _common_figures(items: Sequence[Characteristics]) -> dict[str, tuple[str, list[Figure]]]:
    """Figures that all states have: by name the unit, and the figure of each state."""
    first, *others = [_figures_by_name(item, items[0]) for item in items]
    common = {
        name: (unit, [figure, *(other[name][1] for other in others)])
        for name, (unit, figure) in first.items()
        if all(name in other for other in others)
    }
    if not common:
        names = ", ".join(item.name for item in items)
        raise InputError(f"{names}: no step of one speed and amplitude in common")
    return common


def _figures_by_name(
    item: Characteristics, reference: Characteristics
) -> Mapping[str, tuple[str, Figure]]:
    """Figures by name; steps are called by their speed in the first record."""
    damper = item.damper
    figures: dict[str, tuple[str, Figure | None]] = {
        "gas force": ("N", damper.gas_force_n),
        "gas spring rate": ("N/m", damper.gas_rate_n_per_m),
        "friction": ("N", damper.friction_n),
        "rebound over compression": ("", damper.asymmetry),
        **{f"knee, {side}": ("m/s", figure) for side, figure in damper.knee_m_per_s.items()},
    }
    taken: set[int] = set()
    for sought in reference.steps:
        index = _find_nearest(sought, item.steps, taken)
        if index is None:
            continue
        taken.add(index)
        step, at = item.steps[index], f"at {sought.peak_speed_m_per_s:.3g} m/s"
        figures |= {
            f"compression force {at}": ("N", step.compression.force_at_peak_velocity_n),
            f"rebound force {at}": ("N", step.rebound.force_at_peak_velocity_n),
            f"energy per cycle {at}": ("J", step.energy_per_cycle_j),
            f"spring rate {at}": ("N/m", step.spring_rate_n_per_m),
            f"hysteresis at the turning points {at}": ("N", step.hysteresis_at_zero_n),
        }
    return {name: (unit, figure) for name, (unit, figure) in figures.items() if figure is not None}


def _find_nearest(sought: DynoStep, steps: Sequence[DynoStep], taken: set[int]) -> int | None:
    """Index of the step that is most like another, if any is alike."""

    def apart(step: DynoStep) -> float:
        pairs = (
            (step.peak_speed_m_per_s, sought.peak_speed_m_per_s),
            (step.amplitude_m, sought.amplitude_m),
        )
        return max(abs(own / other - 1.0) for own, other in pairs)

    free = [index for index in range(len(steps)) if index not in taken]
    best = min(free, key=lambda index: apart(steps[index]), default=None)
    return best if best is not None and apart(steps[best]) <= _ALIKE else None


def _standard_deviation(figure: Figure) -> float:
    return max(0.5 * (figure.high - figure.low) / _STDS, 1e-12)


def _difference(second: Figure, first: Figure) -> Figure:
    value = second.value - first.value
    half = _STDS * math.hypot(_standard_deviation(second), _standard_deviation(first))
    return Figure(value, value - half, value + half, second.method)


def _p_value(figure: Figure) -> float:
    """Probability of a value as far from zero, if the true value is zero."""
    return 2.0 * float(ndtr(-abs(figure.value) / _standard_deviation(figure)))  # pyright: ignore[reportUnknownArgumentType]


def _holm_procedure(p_values: Sequence[float]) -> list[bool]:
    """Whether each is significant, at one level for all of them together."""
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    significant = [False] * len(p_values)
    for rank, index in enumerate(order):
        if p_values[index] > _LEVEL / (len(p_values) - rank):
            break
        significant[index] = True
    return significant
