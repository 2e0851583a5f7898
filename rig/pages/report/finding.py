"""The first screen of a diagnosis: what was found, what it means, and how certain that is."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from dart_model.effects import AMBIENT_C, FAMILY_WORDS, Effect, effect
from dart_model.effects.calling import force_over_arrays
from rig.diagnosis.outcome import (
    Diagnosis,
    FoundEffect,
    LinearCorrection,
    ModelErrors,
    RejectedEffect,
    Result,
)
from rig.diagnosis.search.criteria import CRITERIA
from rig.pages.number_formats import (
    capital,
    decimals_of,
    label,
    number,
    percent,
    quantity,
    three_digits,
    times,
    value_and_interval,
    with_unit,
)
from rig.pages.report.words import (
    LINEAR,
    describe_channel,
    is_prescribed,
    join_words,
    missing,
    wrong_channels,
)

_NOT_USED = "on data not used for fitting"
_NOTHING_GAINED = 0.75
"""Share of the residual force, and of the error that decides, above which a correction is none."""

_POINTS = 121
"""Points along the travel, and along the speeds, among which the largest force of a law is found:
each is within a hundredth of the next."""

_SHARES = (1.0, 0.5)
"""Of the way from mid-stroke (or from rest) to the end at which a law's force is stated."""

_OF_LINEAR_PART = frozenset({"input_gain", "delay"})
"""Rivals of linear corrections, not of laws."""

_DIRECTIONS = {
    "mass_kg": ("Mass", "larger", "smaller"),
    "stiffness_n_per_m": ("Spring", "stiffer", "softer"),
    "damping_n_s_per_m": ("Damping", "larger", "smaller"),
    "preload_n": ("Preload", "larger", "smaller"),
    "input_gain": ("Applied force", "larger", "smaller"),
    "free_length_m": ("Centre of the spring law", "higher", "lower"),
}


class Statement(NamedTuple):
    """A line about certainty: its tone, its sign, its text."""

    tone: str
    sign: str
    text: str


class FirstScreen(NamedTuple):
    """What the first screen states.

    Attributes:
        headline: What is missing, in few words.
        values: Each value with its interval.
        meaning: What the found laws amount to, in newtons; empty without a law that shows it.
        error: The error before and after the correction.
        certainty: Noise reached, rivals, load cell.
    """

    headline: str
    values: tuple[str, ...]
    meaning: tuple[str, ...]
    error: str
    certainty: tuple[Statement, ...]


def find(result: Result) -> FirstScreen:
    """The first screen of a result."""
    diagnosis = result.diagnosis
    return FirstScreen(
        _headline(diagnosis),
        _values(diagnosis),
        tuple(text for item in missing(diagnosis) if (text := _meaning(result, item))),
        _error(diagnosis),
        (remainder(diagnosis), _rivals(diagnosis), _load_cell(diagnosis)),
    )


def remainder(diagnosis: Diagnosis) -> Statement:
    """What is left after the correction: noise, or a part of the residual force."""
    figure, floor = _deciding(diagnosis)
    ratio = figure.after / floor if floor > 0.0 else math.inf
    is_at_floor = ratio <= CRITERIA.explained
    if diagnosis.verdict in ("explained", "nothing_missing") or (
        diagnosis.verdict == "ambiguous" and is_at_floor
    ):
        return Statement("good", "✓", f"Only noise is left: {times(ratio)} times the noise floor.")
    tone, sign = ("bad", "✕") if diagnosis.verdict == "not_explained" else ("part", "◐")
    if is_at_floor:
        text = "On at least one run the error is above the noise: something is still missing."
        return Statement(tone, sign, text)
    above = f"{times(ratio)} times the noise floor" if math.isfinite(ratio) else "floor not known"
    force = diagnosis.held_out.residual_force_rmse_n
    for what, errors in (("residual force", force), ("height error", figure)):
        if errors.after <= _NOTHING_GAINED * errors.before:
            share = percent(errors.after / errors.before, 1)
            text = f"{share} of the {what} is left ({above}): something is still missing."
            return Statement(tone, sign, text)
    text = f"No law reduces it ({above}): the given model is as good as any that was found."
    return Statement("idle", "–", text)


def _deciding(diagnosis: Diagnosis) -> tuple[ModelErrors, float]:
    """The error that decides, and its noise floor."""
    held_out, floor = diagnosis.held_out, diagnosis.noise_floor
    if is_prescribed(diagnosis):
        return held_out.residual_force_rmse_n, floor.residual_force_rmse_n
    return held_out.height_rmse_m, floor.height_rmse_m


def _headline(diagnosis: Diagnosis) -> str:
    names = [
        _bare(effect(item.name).words) + " (a candidate)" * item.is_candidate
        for item in missing(diagnosis)
    ]
    match diagnosis.verdict:
        case "nothing_missing":
            return "Nothing is missing"
        case "not_explained":
            left_n = diagnosis.held_out.residual_force_rmse_n.after
            size = f"{quantity(left_n, 'N')} RMS of " if math.isfinite(left_n) else "A "
            return f"{size}force that no law describes"
        case "ambiguous":
            rivals = [FAMILY_WORDS[item] for item in diagnosis.ambiguous_with]
            either = join_words(names, "and") or "linear corrections"
            if not rivals and any(item.is_candidate for item in diagnosis.effects):
                return f"{capital(either)} missing"
            others = join_words(rivals, "or") or "another law that fits as well"
            if any(it.where is not None for it in diagnosis.effects) and _OF_LINEAR_PART.issuperset(
                diagnosis.ambiguous_with
            ):
                parts = [_direction(item) for item in diagnosis.linear if _differs(item)]
                either = f"{either} missing; {join_words(parts, 'and')}"
            return f"{capital(either)}, or {others}"
        case _:
            pass
    if names:
        also = " and more" if diagnosis.verdict == "partly_explained" else ""
        far = "".join(f"; {_direction(it)}" for it in diagnosis.linear if it.is_improbable)
        return f"{capital(join_words(names, 'and'))}{also} missing{far}"
    parts = [_direction(item) for item in diagnosis.linear if _differs(item)]
    parts += [f"{item.name} {item.change}" for item in diagnosis.existing]
    parts += [
        f"{item.channel} {'late' if item.parameter == 'delay_s' else 'with a wrong gain'}"
        for item in wrong_channels(diagnosis)
    ]
    more = "more is missing" if diagnosis.verdict == "partly_explained" else "no further effect"
    return f"{capital(join_words(parts, 'and') or 'parameters off')}; {more}"


def _bare(words: str) -> str:
    """Words without their article."""
    return words.removeprefix("a ").removeprefix("an ")


def _direction(item: LinearCorrection) -> str:
    """A linear correction as “Spring 15 % stiffer than in the model”."""
    name, more, less = _DIRECTIONS[item.parameter]
    change = item.total.value - item.nominal
    if item.parameter in ("preload_n", "free_length_m") or item.nominal == 0.0:
        amount = quantity(abs(change), LINEAR[item.parameter][1])
    else:
        share = 100.0 * abs(change / item.nominal)
        amount = with_unit(number(share, decimals_of(share) if share else 0), "%")
    return f"{name} {amount} {more if change > 0.0 else less} than in the model"


def _differs(item: LinearCorrection) -> bool:
    """Whether a correction's interval excludes the value of the model file."""
    low, high = item.total.low, item.total.high
    return low is None or high is None or not low <= item.nominal <= high


def _values(diagnosis: Diagnosis) -> tuple[str, ...]:
    texts: list[str] = []
    for item in missing(diagnosis):
        law = effect(item.name)
        for parameter in law.parameters:
            if parameter.name in law.shown and parameter.name in item.parameters:
                estimate = item.parameters[parameter.name]
                value, interval = value_and_interval(estimate, parameter.unit)
                texts.append(f"{capital(label(parameter))} {value} (95 %: {interval})")
    for item in filter(_differs, diagnosis.linear):
        value, interval = value_and_interval(item.total, LINEAR[item.parameter][1])
        texts.append(f"{_direction(item)}: {value} (95 %: {interval})")
    texts += [describe_channel(item) for item in wrong_channels(diagnosis)]
    return tuple(texts)


def _meaning(result: Result, item: FoundEffect) -> str:
    """The force of a law where it is largest and half way there; of a state, its RMS."""
    law = effect(item.name)
    series = [it for it in result.fitted if it.strut == item.strut]
    if not series or set(item.parameters) != {it.name for it in law.parameters}:
        return ""
    if law.states or law.adds_mass:
        rms = quantity(item.force_rms_n, "N")
        return f"{capital(_bare(law.words))}: {rms} RMS along the recordings."
    heights = np.concatenate([it.height_m for it in series])
    speeds = np.concatenate([it.velocity_m_per_s for it in series])
    low_m, high_m = float(heights.min()), float(heights.max())
    slow, fast = float(speeds.min()), float(speeds.max())
    middle = 0.5 * (low_m + high_m)
    ends = [
        [(float(h), 0.0) for h in np.linspace(low_m, high_m, _POINTS)],
        [(middle, float(v)) for v in np.linspace(slow, fast, _POINTS)],
    ]
    force_at = _force_of(law, item, result)
    if not any(force_at(*at) for points in ends for at in points):
        # A damper that acts at an end of the travel only.
        place_m = max((low_m, high_m), key=lambda height_m: abs(force_at(height_m, fast)))
        ends[1] = [(place_m, speed) for _, speed in ends[1]]
    forces = [[force_at(*at) for at in points] for points in ends]
    if not all(math.isfinite(force) for of in forces for force in of):
        return ""
    spans = [max(of) - min(of) for of in forces]
    over_velocity = spans[1] > spans[0]
    unit, scale = ("m/s", 1.0) if over_velocity else ("mm", 1e3)
    points: list[tuple[float, float]] = ends[int(over_velocity)]
    force: list[float] = forces[int(over_velocity)]
    largest = int(np.argmax(np.abs(force)))
    centre = _POINTS // 2
    texts: list[str] = []
    for share in _SHARES:
        at = centre + round(share * (largest - centre))
        x = scale * points[at][int(over_velocity)]
        texts.append(
            f"{quantity(force[at], 'N')} at {with_unit(number(x, 2 - 2 * (unit == 'mm')), unit)}"
        )
    place = points[0][0]
    where = "" if over_velocity else " of height"
    if over_velocity and place != middle:
        where = f", at {with_unit(number(1e3 * place, 0), 'mm')} of height"
    return f"{capital(_bare(law.words))}: {', '.join(texts)}{where}."


def _force_of(law: Effect, item: FoundEffect, result: Result) -> Callable[[float, float], float]:
    """Force of a found law, N, at a height (m) and velocity (m/s); NaN where it has no value."""
    values = [item.parameters[parameter.name].value for parameter in law.parameters]
    strut = next(it for it in result.corrected.struts if it.name == item.strut)
    of_strut = strut.free_length_m, strut.stiffness_n_per_m, strut.damping_n_s_per_m
    constants = (*of_strut, result.corrected.gravity_m_per_s2)
    force_n = force_over_arrays(law)

    def force_at(height_m: float, velocity_m_per_s: float) -> float:
        try:
            motion = 0.0, height_m, velocity_m_per_s, 0.0, AMBIENT_C
            return force_n(*motion, (), values, constants)
        except (ArithmeticError, ValueError):
            return math.nan

    return force_at


def _error(diagnosis: Diagnosis) -> str:
    figure, _ = _deciding(diagnosis)
    if not math.isfinite(figure.before):
        return ""
    if is_prescribed(diagnosis):
        name, factor, unit = "Force error", 1.0, "N"
    else:
        name, factor, unit = "Height error", 1e3, "mm"
    before, after = (three_digits(factor * it) for it in (figure.before, figure.after))
    if before == after:
        return f"{name} {with_unit(before, unit)} {_NOT_USED}."
    return f"{name} {before} → {with_unit(after, unit)} {_NOT_USED}."


def _rivals(diagnosis: Diagnosis) -> Statement:
    tried = [item for item in diagnosis.rejected if item.left is not None]
    if diagnosis.ambiguous_with:
        rivals = join_words([FAMILY_WORDS[item] for item in diagnosis.ambiguous_with], "and")
        text = f"{capital(rivals)} cannot be distinguished from it in these recordings"
        cure = diagnosis.suggested_excitation
        text += f". To distinguish them: {cure}." if cure else "."
        return Statement("part", "?", text)
    if diagnosis.verdict == "nothing_missing":
        return Statement("good", "✓", "No law is needed for what these recordings excite.")
    if not tried:
        return Statement("part", "?", "No other law was tried.")
    if not missing(diagnosis):
        if diagnosis.verdict == "explained":
            return Statement("good", "✓", "No law reduces the error further.")
        return Statement("bad", "✕", f"None of {len(tried)} laws explains it.")
    return _nearest_rival(diagnosis, tried)


def _nearest_rival(diagnosis: Diagnosis, tried: Sequence[RejectedEffect]) -> Statement:
    nearest = min(tried, key=lambda item: item.left or 0.0)
    tested = "The one rival" if len(tried) == 1 else f"The nearest of {len(tried)} rivals"
    text = (
        f"{tested}, {effect(nearest.name).words}, leaves {percent(nearest.left, 1)} of the linear "
        "model's residual"
    )
    if diagnosis.left is None:
        return Statement("good", "✓", f"{text}.")
    text += f"; what is named here leaves {percent(diagnosis.left, 1)}."
    if diagnosis.left < (nearest.left or 0.0):
        return Statement("good", "✓", text)
    return Statement("part", "?", f"{text} It was not chosen: {nearest.why.rstrip('.')}.")


def _load_cell(diagnosis: Diagnosis) -> Statement:
    figure = diagnosis.held_out.strut_force_rmse_n
    if figure is None or not math.isfinite(figure.after):
        return Statement("idle", "–", "No load cell: the strut's force itself was not compared.")
    if is_prescribed(diagnosis):
        return Statement("idle", "–", "The force error is the difference from the load cell.")
    before, after = quantity(figure.before, "N"), quantity(figure.after, "N")
    if before == after:
        return Statement("idle", "–", f"The load cell differs by {before} RMS from the model.")
    if figure.after < figure.before:
        text = f"The load cell agrees better: its difference falls from {before} to {after} RMS."
        return Statement("good", "✓", text)
    text = f"The load cell does not agree: its difference goes from {before} to {after} RMS."
    return Statement("bad", "✕", text)
