"""Sentences about a diagnosis, in the words of a test engineer."""

import math
from collections.abc import Sequence

from dart_model.effects import FAMILY_WORDS, effect
from rig.diagnosis.outcome import (
    ActingRange,
    ChannelCorrection,
    Diagnosis,
    Estimate,
    Evidence,
    FoundEffect,
    Interval,
    LikelihoodGain,
    LinearCorrection,
)
from rig.diagnosis.search.criteria import CRITERIA
from rig.pages.number_formats import (
    capital,
    decimals_of,
    label,
    number,
    quantity,
    times,
    value_and_interval,
)

LINEAR = {
    "mass_kg": ("mass", "kg"),
    "stiffness_n_per_m": ("stiffness", "N/m"),
    "damping_n_s_per_m": ("damping", "N·s/m"),
    "preload_n": ("preload", "N"),
    "input_gain": ("input gain", ""),
    "free_length_m": ("centre of the spring law", "m"),
}
"""Name and unit of each parameter that a linear correction may change."""

_AS_EFFECT = {
    "added_mass": "mass_kg",
    "linear_stiffness": "stiffness_n_per_m",
    "linear_damping": "damping_n_s_per_m",
    "preload": "preload_n",
    "input_gain": "input_gain",
}

_OF_CHANNELS = {"delay_s": "delay", "gain": "input_gain"}
"""Effects that stand for corrections of channels."""

CONFIRMATIONS = {
    "confirmed": "held-out data confirm it",
    "unsettled": "held-out data gain by it, but far more than noise is left, which it may imitate",
    "not_exercised": "held-out data do not exercise it",
    "contradicted": "held-out data contradict it",
}
"""What held-out data say of an effect."""

BLOCKS = "blocks of the recordings, spread over them, were held out"


def join_words(items: Sequence[str], last: str) -> str:
    """Items separated by commas, with a word before the last one."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"


def missing(diagnosis: Diagnosis) -> tuple[FoundEffect, ...]:
    """Missing effects, without those that are also corrections of linear part or channels."""
    linear = {(item.strut, item.parameter) for item in diagnosis.linear}
    of_channels = {_OF_CHANNELS[item.parameter] for item in diagnosis.channels}
    return tuple(
        item
        for item in diagnosis.effects
        if (item.strut, _AS_EFFECT.get(item.name)) not in linear and item.name not in of_channels
    )


def wrong_channels(diagnosis: Diagnosis) -> tuple[ChannelCorrection, ...]:
    """Channels that the data show to be late or early, or to have a wrong gain."""
    return tuple(item for item in diagnosis.channels if item.is_wrong)


def reference_channel(diagnosis: Diagnosis) -> str:
    """What delays of channels are counted from, in words."""
    return "the height" if is_prescribed(diagnosis) else "the bench's first input"


def describe_channel(item: ChannelCorrection) -> str:
    """Channel and delay as “strut_force_n:strut is 3.10 ms late (95 %: 3.05 to 3.15 ms)”.

    A recording that a delay was taken from already has the rest alone. A gain is shown as
    “height_m:strut shows 1.020 times the motion (95 %: 1.019 to 1.021)”.
    """
    if item.parameter == "gain":
        value, interval = value_and_interval(item.total, "")
        return f"{item.channel} shows {value} times the motion (95 %: {interval})"
    ends = [item.total.value, item.total.low, item.total.high]
    sizes = [abs(end - item.nominal) for end in ends if end is not None]
    value, interval = value_and_interval(Estimate(sizes[0], min(sizes), max(sizes)), "s")
    direction = "late" if item.total.value > item.nominal else "early"
    further = " more" if item.nominal else ""
    return f"{item.channel} is {value}{further} {direction} (95 %: {interval})"


def is_prescribed(diagnosis: Diagnosis) -> bool:
    """Whether the motion is prescribed, so that there is no height error."""
    return not math.isfinite(diagnosis.held_out.height_rmse_m.before)


def difference(item: LinearCorrection) -> str:
    """Size of a linear correction: in per cent, or in its unit where a share has no meaning."""
    change = item.total.value - item.nominal
    if change == 0.0 or not math.isfinite(change):
        return "as in the file"
    if item.parameter in ("preload_n", "free_length_m") or item.nominal == 0.0:
        amount = quantity(abs(change), LINEAR[item.parameter][1])
    else:
        percent = 100.0 * abs(change / item.nominal)
        amount = f"{number(percent, decimals_of(percent))}\u00a0%"
    return f"{amount} {'above' if change > 0.0 else 'below'} the given model's"


def linear_label(item: LinearCorrection) -> str:
    """Name of the corrected parameter, with the height to which it refers."""
    name, _ = LINEAR[item.parameter]
    if item.about_height_m is None:
        return name
    return f"{name} about mid-stroke ({number(1e3 * item.about_height_m, 1)}\u00a0mm)"


def sentence(diagnosis: Diagnosis, struts: int) -> str:
    """The diagnosis in one sentence; the strut is named if the model has several."""
    match diagnosis.verdict:
        case "nothing_missing":
            name, _, before, change = _error(diagnosis)
            if diagnosis.existing:
                return f"Nothing is missing; with its effects refitted, {name} goes {change}."
            return f"Nothing is missing: with the nominal model {name} is {before}."
        case "explained":
            no_more = "" if missing(diagnosis) else "; nothing is missing"
            return f"{_finding(diagnosis, struts)}{no_more}: {_error_falls(diagnosis)}"
        case "partly_explained":
            return (
                f"{_finding(diagnosis, struts)}, and a part of the residual is not explained: "
                f"{_error_falls(diagnosis)}"
            )
        case "ambiguous":
            return _ambiguous(diagnosis, struts)
        case "not_explained":
            return _not_explained(diagnosis)


def _ambiguous(diagnosis: Diagnosis, struts: int) -> str:
    others = [FAMILY_WORDS[item] for item in diagnosis.ambiguous_with]
    if not others and any(item.is_candidate for item in diagnosis.effects):
        hint = _excitation_hint(diagnosis, "to confirm it")
        return f"{_finding(diagnosis, struts)}{hint}; {_error_falls(diagnosis)}"
    rivals = join_words(others, "or") or "another effect that fits as well"
    hint, error = _excitation_hint(diagnosis), _error_falls(diagnosis, "the former")
    return (
        f"{_finding(diagnosis, struts)}, or else {rivals}; these recordings do not "
        f"distinguish them{hint}; {error}"
    )


def _finding(diagnosis: Diagnosis, struts: int) -> str:
    lacking = missing(diagnosis)
    if lacking:
        effects = join_words([_effect(item, struts) for item in lacking], "and")
        clauses = _corrections_clause(diagnosis, struts) + _channels_clause(diagnosis)
        return _one_interval(f"The model lacks {effects}{clauses}")
    parts: list[str] = []
    if diagnosis.linear:
        corrections = join_words([_linear(item, struts) for item in diagnosis.linear], "and")
        parts.append(f"linear part is off: {corrections}")
    parts += [f"effect “{item.name}” is {item.change}" for item in diagnosis.existing]
    channels = _channels_clause(diagnosis)
    if channels and not parts:
        return _one_interval(channels.removeprefix("; "))
    return _one_interval(f"The model's {'; its '.join(parts) or 'parameters are off'}{channels}")


def _channels_clause(diagnosis: Diagnosis) -> str:
    return "".join(f"; {describe_channel(item)}" for item in wrong_channels(diagnosis))


def _corrections_clause(diagnosis: Diagnosis, struts: int) -> str:
    parts: list[str] = []
    if diagnosis.linear:
        offs = [
            f"{LINEAR[item.parameter][0]} {difference(item)}{_where(item.strut, struts)}"
            for item in diagnosis.linear
        ]
        parts.append(f"linear corrections ({', '.join(offs)})")
    if diagnosis.existing:
        changes = [f"“{item.name}” {item.change}" for item in diagnosis.existing]
        parts.append(f"changes of its effects ({', '.join(changes)})")
    return f", in addition to {join_words(parts, 'and')}" if parts else ""


def _one_interval(text: str) -> str:
    # The level is stated once; the other brackets are then understood.
    return text.replace("(95 %: ", "(95 % interval ", 1).replace("(95 %: ", "(")


def _where(strut: str, struts: int) -> str:
    return f" in strut “{strut}”" if struts > 1 else ""


def _effect(item: FoundEffect, struts: int) -> str:
    law = effect(item.name)
    parts: list[str] = []
    for parameter in law.parameters:
        if parameter.name in law.shown and parameter.name in item.parameters:
            value, interval = value_and_interval(item.parameters[parameter.name], parameter.unit)
            parts.append(f"{label(parameter)} {value} (95 %: {interval})")
    described = f", {' and '.join(parts)}" if parts else ""
    doubt = ""
    if item.evidence is not None and item.is_candidate:
        doubt = f" (a candidate: {CONFIRMATIONS[item.evidence.held_out]})"
    return f"{law.words}{_where(item.strut, struts)}{described}{doubt}"


def evidence_words(evidence: Evidence, level: float) -> str:
    """How much an effect gains on data left out of fits, and what held-out data say of it."""
    error = "the error on blocks left out of the fit is"
    text = f"Without it {error} {_gain(evidence.without)}"
    if evidence.rival is not None:
        laws = join_words([effect(name).words for name in evidence.rival.over], "and")
        text += f"; with the nearest other explanation ({laws}) it is {_gain(evidence.rival)}"
    text += f" (ranges at a level of {100.0 * level:g}\u00a0%)"
    return f"{text}. {capital(CONFIRMATIONS[evidence.held_out])}"


_ALL = 0.95
"""Share of a recorded range from which on an effect acts in all of it."""


def acting_words(where: ActingRange) -> str:
    """Where along stroke and speed the recordings show an effect, and how far they reach."""
    heights = _parts(where.height_m, where.recorded_height_m, "heights", "m")
    velocities = _parts(
        where.velocity_m_per_s, where.recorded_velocity_m_per_s, "velocities", "m/s"
    )
    return f"It shows {heights}, and {velocities}; of others the recordings say nothing"


def _parts(shown: Sequence[Interval], recorded: Interval, name: str, unit: str) -> str:
    reach = _from_to(recorded, unit)
    share = sum(high - low for low, high in shown) / max(recorded[1] - recorded[0], 1e-300)
    if share > _ALL:
        return f"at all recorded {name} ({reach})"
    if not shown:
        return f"no place of its own over the recorded {name} ({reach})"
    parts = join_words([_from_to(part, unit) for part in shown], "and")
    return f"at {name} {parts} (recorded {reach})"


def _from_to(interval: Interval, unit: str) -> str:
    return f"from {quantity(interval[0], unit)} to {quantity(interval[1], unit)}"


def _gain(gain: LikelihoodGain) -> str:
    ratio = gain.error_ratio
    low, high = (math.nan if end is None else end for end in (ratio.low, ratio.high))
    return f"{times(ratio.value)} times as large ({times(low)} to {times(high)})"


def _linear(item: LinearCorrection, struts: int) -> str:
    name, unit = LINEAR[item.parameter]
    if item.parameter == "preload_n":
        name = linear_label(item)
    value, interval = value_and_interval(item.total, unit)
    where = _where(item.strut, struts)
    return f"{name} {difference(item)}{where}, {value} (95 %: {interval})"


def _error(diagnosis: Diagnosis) -> tuple[str, bool, str, str]:
    """Error to which a verdict refers: name, whether it falls, before, from before to after."""
    # The corrected model is evaluated by its height; a prescribed motion leaves only the force.
    held_out, floor = diagnosis.held_out, diagnosis.noise_floor
    name, unit, figure = "free-run height error", "m", held_out.height_rmse_m
    floor_rms = floor.height_rmse_m
    if is_prescribed(diagnosis):
        name, unit, figure = "residual force", "N", held_out.residual_force_rmse_n
        floor_rms = floor.residual_force_rmse_n
    before, after = quantity(figure.before, unit), quantity(figure.after, unit)
    return (
        f"the RMS {name} on held-out data",
        figure.after < figure.before,
        f"{before}, {_against_floor(figure.before, floor_rms, unit)}",
        f"from {before} to {after}, {_against_floor(figure.after, floor_rms, unit)}",
    )


def _against_floor(value: float, floor: float, unit: str) -> str:
    if not floor > 0.0:
        return "with a noise floor that is not known"
    if value <= CRITERIA.explained * floor:
        return f"at the noise floor of {quantity(floor, unit)}"
    return f"{times(value / floor)} times the noise floor of {quantity(floor, unit)}"


def _error_falls(diagnosis: Diagnosis, subject: str = "") -> str:
    name, falls, _, change = _error(diagnosis)
    corrections = len(diagnosis.linear) + len(diagnosis.existing) + len(wrong_channels(diagnosis))
    single = len(missing(diagnosis)) + corrections == 1
    if corrections:
        plain = "this correction" if single else "these corrections"
    else:
        plain = "it" if single else "them"
    goes, or_else = "falls" if falls else "goes", "" if subject else _or_else(diagnosis)
    return f"with {subject or plain} {name} {goes} {change}{or_else}."


def _or_else(diagnosis: Diagnosis) -> str:
    if not diagnosis.ambiguous_with:
        return ""
    others = join_words([FAMILY_WORDS[item] for item in diagnosis.ambiguous_with], "or")
    return f"; it could also be {others}{_excitation_hint(diagnosis)}"


def _excitation_hint(diagnosis: Diagnosis, purpose: str = "to distinguish them") -> str:
    # The excitation is a phrase or a sentence; here it is part of one.
    bare = (diagnosis.suggested_excitation or "").strip().rstrip(".")
    if not bare:
        return ""
    clause = bare if bare[1:2].isupper() else bare[:1].lower() + bare[1:]
    return f" ({purpose}: {clause})"


def _not_explained(diagnosis: Diagnosis) -> str:
    start = "The model lacks a force that no law in the catalogue describes"
    name, falls, before, change = _error(diagnosis)
    corrected = diagnosis.effects or diagnosis.linear or diagnosis.existing
    if not (corrected and falls):
        return f"{start}: {name} is {before}{_or_else(diagnosis)}."
    parts = [effect(item.name).words for item in diagnosis.effects]
    parts += ["linear corrections"] if diagnosis.linear and not parts else []
    parts += ["other parameters of its own effects"] if diagnosis.existing else []
    only = "" if diagnosis.effects else " alone"
    nearest = f"the best model found, with {join_words(parts, 'and')}{only}, takes"
    if diagnosis.effects and diagnosis.effects[0].family == "restoring_surface":
        nearest = (
            "a table of force over height and velocity, which names no cause, is offered and takes"
        )
    return f"{start}: {nearest} {name} {change}{_or_else(diagnosis)}."
