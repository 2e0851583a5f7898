"""What was found, said as a test engineer would say it."""

import math
from collections.abc import Sequence

from dart_model.effects import effect
from rig.identify.diagnosis import BeforeAfter, Diagnosis, FoundEffect
from rig.identify.report.inputs import Ranked
from rig.identify.report.quantities import label, quantity, times, value_and_interval

AT_THE_FLOOR = 1.3
"""Errors up to this multiple of the noise floor count as being at it."""

FAMILIES = {
    "preload": "a preload",
    "stiffness": "another stiffness",
    "damping": "another damping",
    "inertia": "another inertia",
    "input_gain": "a wrong gain of the applied force",
    "nonlinear_stiffness": "a non-linear spring",
    "stop": "an end stop",
    "backlash": "free play",
    "friction": "friction",
    "nonlinear_damping": "a non-linear damper",
    "hysteresis": "hysteresis",
    "fade": "fade of the damper",
    "delay": "a delay between the channels",
    "periodic_force": "a periodic force",
    "unmodelled_mode": "a further mass on a spring",
    "restoring_surface": "a force over height and velocity without a name",
}
"""Families in words."""

EFFECTS = {
    "none": "nothing",
    "preload": "a constant preload",
    "linear_stiffness": "linear stiffness",
    "linear_damping": "linear damping",
    "added_mass": "inertia (a mass that moves with the upper body)",
    "inerter": "inertia between the bodies (an inerter)",
    "input_gain": "the right gain of the applied force",
    "quadratic_stiffness": "a non-linear spring (quadratic)",
    "cubic_stiffness": "a non-linear spring (cubic, about the free length)",
    "centred_cubic_stiffness": "a non-linear spring (cubic, about a centre of its own)",
    "power_stiffness": "a non-linear spring (power law)",
    "progressive_stiffness": "a non-linear spring (progressive)",
    "exponential_stiffness": "a non-linear spring (exponential, as rubber)",
    "gas_spring": "a gas spring (polytropic)",
    "balanced_gas_spring": "a gas spring (polytropic, balanced at the free length)",
    "end_stops": "a bump stop and a rebound stop",
    "hertz_end_stops": "a bump stop and a rebound stop (Hertzian contact)",
    "bump_stop": "a bump stop",
    "rebound_stop": "a rebound stop",
    "hertz_bump_stop": "a bump stop (Hertzian contact)",
    "hertz_rebound_stop": "a rebound stop (Hertzian contact)",
    "power_bump_stop": "a bump stop (power law, as rubber)",
    "power_rebound_stop": "a rebound stop (power law, as rubber)",
    "backlash": "free play (backlash)",
    "free_play": "free play (of the spring-damper itself)",
    "coulomb_friction": "dry friction (Coulomb)",
    "stribeck_friction": "dry friction with break-away (Stribeck)",
    "presliding_friction": "dry friction with presliding (Dahl's bristle)",
    "elastoplastic_friction": "dry friction that holds at rest (elastoplastic bristle)",
    "lugre_friction": "dry friction with break-away and presliding (LuGre)",
    "quadratic_damping": "a non-linear damper (quadratic, orifice flow)",
    "power_damping": "a non-linear damper (power law)",
    "asymmetric_damping": "a non-linear damper (rebound and compression differ)",
    "digressive_damping": "a non-linear damper (digressive)",
    "saturating_damping": "a non-linear damper (saturating)",
    "arctan_damping": "a non-linear damper (arctangent)",
    "blow_off_damping": "a non-linear damper (blow-off valve)",
    "smooth_blow_off_damping": "a non-linear damper (blow-off valve, rounded knee)",
    "stroke_damping": "a non-linear damper (linear in the stroke)",
    "position_dependent_damping": "a non-linear damper (quadratic in the stroke)",
    "zone_damping": "a non-linear damper (a zone of its stroke)",
    "end_zone_damping": "a non-linear damper (hydraulic end stop)",
    "bouc_wen": "hysteresis (Bouc-Wen)",
    "dahl": "hysteresis (Dahl)",
    "iwan": "hysteresis (Iwan)",
    "maxwell": "hysteresis (a Maxwell branch)",
    "temperature_fade": "fade of the damper with temperature",
    "linear_temperature_fade": "fade of the damper with temperature (linear)",
    "time_fade": "fade of the damper with time",
    "energy_fade": "fade of the damper with dissipated energy",
    "delay": "a delay between applied force and height",
    "periodic_force": "a periodic force",
    "hidden_mass": "a further mass on a spring (an unmodelled mode)",
    "restoring_surface": "a force over height and velocity without a name",
}
"""Effects in words; what stands in brackets is the law."""

_KEY = {
    "bump_stop": ("contact_height_m", "stiffness_n_per_m"),
    "rebound_stop": ("contact_height_m", "stiffness_n_per_m"),
    "end_stops": ("low_contact_height_m", "high_contact_height_m", "stiffness_n_per_m"),
    "hertz_end_stops": ("low_contact_height_m", "high_contact_height_m"),
    "power_bump_stop": ("contact_height_m", "force_at_10_mm_n"),
    "power_rebound_stop": ("contact_height_m", "force_at_10_mm_n"),
    "backlash": ("gap_m",),
    "free_play": ("gap_m",),
    "periodic_force": ("amplitude_n", "frequency_hz"),
    "hidden_mass": ("mass_kg", "stiffness_n_per_m"),
    "asymmetric_damping": ("compression_n_s_per_m", "rebound_n_s_per_m"),
    "restoring_surface": (),
}


def family_words(family: str) -> str:
    """A family in words."""
    return FAMILIES.get(family, family.replace("_", " "))


def effect_words(name: str) -> str:
    """An effect in words."""
    return EFFECTS.get(name, name.replace("_", " "))


def listed(items: Sequence[str], last: str) -> str:
    """Items with commas, and a word before the last one."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {last} {items[-1]}"


def sentence(found: Diagnosis, struts: int) -> str:
    """What was found, in one sentence.

    Args:
        found: The diagnosis.
        struts: Number of struts in the model; with one, its name is not said.
    """
    match found.verdict:
        case "nothing_missing":
            return f"Nothing is missing: {_as_given(found)}."
        case "explained":
            return (
                f"The model lacks {_effects(found, struts)}: "
                f"{_error_falls(found)}{_or_else(found)}."
            )
        case "partly_explained":
            return (
                f"The model lacks {_effects(found, struts)}, and something more that is not "
                f"explained: {_error_falls(found)}{_or_else(found)}."
            )
        case "ambiguous":
            return _ambiguous(found, struts)
        case "not_explained":
            return _not_explained(found)


def _figure(found: Diagnosis) -> tuple[str, BeforeAfter, float, str]:
    # Height is what the corrected model is judged by; an imposed motion leaves only the force.
    held_out, floor = found.held_out, found.noise_floor
    if math.isfinite(held_out.height_rmse_m.before):
        return "open-loop height error", held_out.height_rmse_m, floor.height_rmse_m, "m"
    return "residual force", held_out.residual_force_rmse_n, floor.residual_force_rmse_n, "N"


def against_floor(value: float, floor: float, unit: str) -> str:
    """How a value compares with the noise floor."""
    if not floor > 0.0:
        return "with a noise floor that is not known"
    if value <= AT_THE_FLOOR * floor:
        return f"at the noise floor of {quantity(floor, unit)}"
    return f"{times(value / floor)} times the noise floor of {quantity(floor, unit)}"


def _as_given(found: Diagnosis) -> str:
    name, figure, floor, unit = _figure(found)
    return (
        f"the model as given has an RMS {name} of {quantity(figure.before, unit)} on held-out "
        f"data, {against_floor(figure.before, floor, unit)}"
    )


def _error_falls(found: Diagnosis, subject: str = "") -> str:
    name, figure, floor, unit = _figure(found)
    with_what = subject or ("it" if len(found.effects) == 1 else "them")
    return (
        f"with {with_what} the RMS {name} on held-out data {_goes(figure)} from "
        f"{quantity(figure.before, unit)} to {quantity(figure.after, unit)}, "
        f"{against_floor(figure.after, floor, unit)}"
    )


def _goes(figure: BeforeAfter) -> str:
    return "falls" if figure.after < figure.before else "goes"


def _effects(found: Diagnosis, struts: int) -> str:
    described = listed([_effect(item, struts) for item in found.effects], "and")
    # Said once; the other brackets are then understood.
    return described.replace("(95 %: ", "(95 % interval ", 1).replace("(95 %: ", "(")


def _effect(item: FoundEffect, struts: int) -> str:
    words = effect_words(item.name)
    parameters = effect(item.name).parameters
    keys = _KEY.get(item.name, tuple(first.name for first in parameters[:1]))
    parts: list[str] = []
    for parameter in parameters:
        if parameter.name in keys and parameter.name in item.parameters:
            value, interval = value_and_interval(item.parameters[parameter.name], parameter.unit)
            parts.append(f"{label(parameter)} {value} (95 %: {interval})")
    where = f" in strut “{item.strut}”" if struts > 1 else ""
    described = f", {' and '.join(parts)}" if parts else ""
    return f"{words}{where}{described}"


def _or_else(found: Diagnosis) -> str:
    if not found.ambiguous_with:
        return ""
    others = listed([family_words(item) for item in found.ambiguous_with], "or")
    return f"; it could also be {others}{_run_that_tells(found)}"


def _run_that_tells(found: Diagnosis) -> str:
    if not found.suggested_excitation:
        return ""
    return f" (what would tell: {_clause(found.suggested_excitation)})"


def _ambiguous(found: Diagnosis, struts: int) -> str:
    others = listed([family_words(item) for item in found.ambiguous_with], "or")
    rivals = others or "another effect that fits as well"
    return (
        f"The model lacks {_effects(found, struts)}, or else {rivals}; this run cannot tell "
        f"them apart{_run_that_tells(found)}; {_error_falls(found, 'the former')}."
    )


def _not_explained(found: Diagnosis) -> str:
    name, figure, floor, unit = _figure(found)
    start = "The model lacks a force that no law in the catalogue describes"
    if not (found.effects and figure.after < figure.before):
        return (
            f"{start}: the RMS {name} on held-out data is {quantity(figure.before, unit)}, "
            f"{against_floor(figure.before, floor, unit)}{_or_else(found)}."
        )
    nearest = listed([effect_words(item.name) for item in found.effects], "and")
    if found.effects[0].family == "restoring_surface":
        nearest = "a table of force over height and velocity, which names no cause"
    return (
        f"{start}: the nearest, {nearest}, takes the RMS {name} on held-out data from "
        f"{quantity(figure.before, unit)} to {quantity(figure.after, unit)}, "
        f"{against_floor(figure.after, floor, unit)}{_or_else(found)}."
    )


def _clause(text: str) -> str:
    # The excitation comes as a phrase or as a sentence; here it stands inside one.
    bare = text.strip().rstrip(".")
    return bare if bare[1:2].isupper() else bare[:1].lower() + bare[1:]


def nearest_rival(ranking: Sequence[Ranked]) -> Ranked | None:
    """The best candidate that was rejected."""
    scored = [item for item in ranking if item.why and item.score is not None]
    return max(scored, key=lambda item: item.score or 0.0, default=None)
