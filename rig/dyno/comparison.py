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
from rig.dyno.conditions import RecordConditions, find_conditions, slowest
from rig.dyno.damper import FRICTION, GAS, GAS_RATE
from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.stroke_force import Figure, student_factor
from rig.dyno.temperature import FRICTION_PER_K, GAS_PER_K, TYPICAL_PER_K, apart_k, widen
from rig.dyno.tolerance import ToleranceBand, evaluate_band

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
    """One figure in two states, and whether the change, second less first, is significant."""

    figure: str
    unit: str
    before: Figure
    after: Figure
    change: Figure
    differs: bool


class Match(NamedTuple):
    """Two dampers at a point of a band: their forces, and the difference over the band's width."""

    velocity_m_per_s: float
    side: str
    left: Figure
    right: Figure
    share: Figure


class Trend(NamedTuple):
    """One figure over a dose: its line, and whether the slope per unit is significant.

    Attributes:
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

    The figures of the second one are brought to the temperature and the zero of the first one.

    Raises:
        InputError: They have no figure in common.
    """
    conditions = find_conditions(before, after)
    differences = [
        Difference(name, unit, first, second, _difference(second, first), differs=False)
        for name, (unit, (first, second)) in _common_figures([before, after], conditions).items()
    ]
    differs = _holm_procedure([item.change for item in differences])
    marked = [
        item._replace(differs=differ) for item, differ in zip(differences, differs, strict=True)
    ]
    return sorted(marked, key=lambda item: not item.differs)


def match_in_band(
    left: Characteristics, right: Characteristics, band: ToleranceBand
) -> list[Match]:
    """Differences of two dampers at the points of a band, as shares of its width, largest first.

    Points that one of them does not have are left out.
    """
    pairs = zip(evaluate_band(left.steps, band), evaluate_band(right.steps, band), strict=True)
    matches: list[Match] = []
    for one, other in pairs:
        if one.force is None or other.force is None:
            continue
        if not (one.force.is_bounded and other.force.is_bounded):
            continue
        change, width_n = _difference(other.force, one.force), one.high_n - one.low_n
        share = change.scaled(1.0 / width_n)._replace(
            method="difference over the width of the band"
        )
        matches.append(Match(one.velocity_m_per_s, one.side, one.force, other.force, share))
    return sorted(matches, key=lambda item: -abs(item.share.value))


def trends_over_dose(items: Sequence[Characteristics], doses: Sequence[float]) -> list[Trend]:
    """Trends of the figures over a dose, significant ones first.

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
    trends = [
        _fit_trend(name, unit, np.array(doses), figures)
        for name, (unit, figures) in _common_figures(items).items()
    ]
    differs = _holm_procedure([item.slope for item in trends])
    marked = [item._replace(differs=differ) for item, differ in zip(trends, differs, strict=True)]
    return sorted(marked, key=lambda item: not item.differs)


def pair_steps(
    reference: Characteristics, item: Characteristics
) -> list[tuple[DynoStep, DynoStep | None]]:
    """Steps of the reference, each with the other record's of its speed and amplitude, if any."""
    pairs: list[tuple[DynoStep, DynoStep | None]] = []
    free = list(item.steps)
    for step in reference.steps:
        apart = [_relative_difference(other, step) for other in free]
        nearest = min(apart, default=np.inf)
        partner = free.pop(apart.index(nearest)) if nearest <= _ALIKE else None
        pairs.append((step, partner))
    return pairs


def _relative_difference(step: DynoStep, reference: DynoStep) -> float:
    """Larger relative difference of the peak speeds and of the amplitudes."""
    return max(
        abs(step.peak_speed_m_per_s / reference.peak_speed_m_per_s - 1.0),
        abs(step.amplitude_m / reference.amplitude_m - 1.0),
    )


def list_not_comparable(items: Sequence[Characteristics]) -> list[str]:
    """What of several records is not compared, and why, in words."""
    reference = items[0]
    return [
        *(
            f"{item.name}, {_step_words(step)}: no such step in {other.name}"
            for item in items
            for other in items
            if other is not item
            for step, partner in pair_steps(item, other)
            if partner is None
        ),
        *(
            f"{item.name}, {side} at {step.peak_speed_m_per_s:.3g} m/s: its force was clipped"
            for item in items
            for step in item.steps
            for side, stroke in zip(SIDES, step.strokes, strict=True)
            if stroke.is_clipped
        ),
        *(text for item in items[1:] for text in _unlike_conditions(reference, item)),
    ]


def _step_words(step: DynoStep) -> str:
    return f"±{1e3 * step.amplitude_m:.3g} mm at {step.peak_speed_m_per_s:.3g} m/s"


def _unlike_conditions(before: Characteristics, after: Characteristics) -> list[str]:
    """Figures that temperature or the zero of the load cell leave open."""
    conditions = find_conditions(before, after)
    texts: list[str] = []
    for first, second in pair_steps(before, after):
        warmer_k = apart_k(first, second)
        if second is None or conditions.energy(first.energy_per_cycle_j, warmer_k) is not None:
            continue
        texts.append(
            f"{after.name}, {_step_words(second)}: {warmer_k:+.1f} K from {before.name}, and "
            "neither record determines the change per kelvin"
        )
    shift = conditions.shift
    if shift is not None and conditions.cause in ("zero", "open"):
        known = (
            "with an unchanged spring rate: the zero of the load cell, or a preload"
            if conditions.cause == "zero"
            else "and the spring rate does not tell gas from the zero of the load cell"
        )
        texts.append(
            f"{after.name}, gas force: all forces are shifted by {shift.value:+.3g} N, {known}. "
            "The other figures are compared without this shift"
        )
    return texts


def _fit_trend(name: str, unit: str, doses: "np.ndarray", figures: Sequence[Figure]) -> Trend:
    """Trend of a figure by weighted least squares; whether it differs is not yet determined."""
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
    figure = Figure.around(slope, half, f"line through {len(doses)} doses")
    return Trend(name, unit, figure, at_zero, differs=False, is_straight=misfit < _MISFIT)


def _common_figures(
    items: Sequence[Characteristics], conditions: RecordConditions | None = None
) -> dict[str, tuple[str, list[Figure]]]:
    """Figures that all states have: by name the unit, and the figure of each state.

    With conditions, they are those of the first state in all of them.
    """
    reference, *rest = items
    first = _figures_by_name(reference, reference, None)
    others = [_figures_by_name(item, reference, conditions) for item in rest]
    common = {
        name: (unit, [figure, *(other[name][1] for other in others)])
        for name, (unit, figure) in first.items()
        if all(name in other for other in others)
    }
    if not common:
        names = ", ".join(item.name for item in items)
        raise InputError(
            f"{names}: no step of one speed and amplitude in common, expected "
            "records of the same test"
        )
    return common


def _figures_by_name(
    item: Characteristics, reference: Characteristics, conditions: RecordConditions | None
) -> Mapping[str, tuple[str, Figure]]:
    """Figures by name; steps are called by their speed in the first record."""
    figures: dict[str, tuple[str, Figure | None]] = _of_damper(item, reference, conditions)
    for sought, step in pair_steps(reference, item):
        if step is None:
            continue
        at = f"at {sought.peak_speed_m_per_s:.3g} m/s"
        down, up = (side.force_at_peak_velocity_n for side in (step.compression, step.rebound))
        energy: Figure | None = step.energy_per_cycle_j
        rate, hysteresis = step.spring_rate_n_per_m, step.hysteresis_at_zero_n
        if conditions is not None:
            warmer_k = apart_k(sought, step)
            down, up = (
                conditions.force(figure, side, warmer_k) for side, figure in enumerate((down, up))
            )
            energy = conditions.energy(energy, warmer_k)
            rate = widen(rate, GAS_PER_K, warmer_k)
            hysteresis = widen(hysteresis, FRICTION_PER_K, warmer_k)
        figures |= {
            f"compression force {at}": ("N", down),
            f"rebound force {at}": ("N", up),
            f"energy per cycle {at}": ("J", energy),
            f"spring rate {at}": ("N/m", rate),
        }
        if sought.kind == "quasi_static":
            # Of a fast step it contains damping, which its interval does not.
            figures[f"hysteresis at the turning points {at}"] = ("N", hysteresis)
    return {
        name: (unit, figure)
        for name, (unit, figure) in figures.items()
        if figure is not None and figure.is_bounded
    }


def _of_damper(
    item: Characteristics, reference: Characteristics, conditions: RecordConditions | None
) -> dict[str, tuple[str, Figure | None]]:
    """Figures over all steps by name."""
    own = item.damper.properties()
    if conditions is None:
        return {**own}
    warmer_k = apart_k(slowest(reference), slowest(item))
    per_k = {GAS: GAS_PER_K, GAS_RATE: GAS_PER_K, FRICTION: FRICTION_PER_K}
    figures: dict[str, tuple[str, Figure | None]] = {
        name: (unit, widen(figure, per_k.get(name, TYPICAL_PER_K), warmer_k))
        for name, (unit, figure) in own.items()
    }
    if conditions.cause in ("zero", "open"):
        figures.pop(GAS, None)
    return figures


def _standard_deviation(figure: Figure) -> float:
    return max(figure.half / _STDS, 1e-12)


def _difference(second: Figure, first: Figure) -> Figure:
    value = second.value - first.value
    half = _STDS * math.hypot(_standard_deviation(second), _standard_deviation(first))
    return Figure.around(value, half, second.method)


def _holm_procedure(figures: Sequence[Figure]) -> list[bool]:
    """Whether each differs from zero, at one level for all of them together."""
    # Probabilities of values as far from zero, if the true ones are zero.
    p_values = [
        2.0 * float(ndtr(-abs(figure.value) / _standard_deviation(figure)))  # pyright: ignore[reportUnknownArgumentType]
        for figure in figures
    ]
    order = sorted(range(len(p_values)), key=lambda index: p_values[index])
    significant = [False] * len(p_values)
    for rank, index in enumerate(order):
        if p_values[index] > _LEVEL / (len(p_values) - rank):
            break
        significant[index] = True
    return significant
