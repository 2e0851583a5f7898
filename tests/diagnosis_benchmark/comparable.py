"""Which parameter of a diagnosis means the same as which one of the truth.

A gain of the load cannot be told from the size of all that the load moves, so where the load's
sensor is wrong nothing that is in newtons or kilograms is compared.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from tests.diagnosis_benchmark.moving import MovingCase
from tests.truth.cases import FOREIGN_KINDS
from tests.truth.compiled import REFERENCE_C
from tests.truth.plant import Bench, Case

Truth = dict[str, float]


class Same(NamedTuple):
    """A parameter that two formulas share.

    Attributes:
        effect: Name of the effect in the diagnosis.
        parameter: Its parameter.
        value: The true value, from the planted parameters and the bench.
    """

    effect: str
    parameter: str
    value: Callable[[Truth, Bench], float]


def _of(effect: str, parameter: str, planted: str, factor: float = 1.0) -> Same:
    return Same(effect, parameter, lambda truth, _: factor * truth[planted])


def _kept(truth: Truth, _: Bench) -> float:
    return 1.0 - truth["lost_fraction"]


def _yield_travel(truth: Truth, _: Bench) -> float:
    return truth["yield_n"] / truth["stiffness_n_per_m"]


_FRICTION = tuple(
    _of(f"{name}_friction", "coulomb_force_n", "coulomb_n")
    for name in ("coulomb", "stribeck", "presliding", "elastoplastic", "lugre")
)
_CONTACTS = (
    *(
        _of(f"{law}{side}_stop", "contact_height_m", height)
        for law in ("", "hertz_", "power_")
        for side, height in (("bump", "low_m"), ("rebound", "high_m"))
    ),
    *(
        _of(f"{law}end_stops", f"{end}_contact_height_m", f"{end}_m")
        for law in ("", "hertz_")
        for end in ("low", "high")
    ),
)
_SIDES = ("bump_stop", "rebound_stop", "end_stops")

COMPARABLE: dict[str, tuple[Same, ...]] = {
    "late_load": (_of("delay", "delay_s", "lag_s"),),
    "tone": (
        _of("periodic_force", "amplitude_n", "force_n"),
        _of("periodic_force", "frequency_hz", "frequency_hz"),
    ),
    "square_spring": (_of("quadratic_stiffness", "stiffness_n_per_m2", "stiffness_n_per_m2"),),
    "cube_spring": (_of("cubic_stiffness", "stiffness_n_per_m3", "stiffness_n_per_m3"),),
    "power_spring": (
        _of("power_stiffness", "force_at_100_mm_n", "force_at_reach_n"),
        _of("power_stiffness", "exponent", "exponent"),
    ),
    "exponential_spring": (
        _of("exponential_stiffness", "force_n", "force_n"),
        _of("exponential_stiffness", "length_m", "length_m"),
    ),
    "gas_column": tuple(
        _of(name, theirs, ours)
        for name in ("gas_spring", "balanced_gas_spring")
        for theirs, ours in (("gas_length_m", "column_m"), ("polytropic_exponent", "exponent"))
    ),
    "set_up_spring": (
        _of("plateau_stiffness", "plateau_force_n", "force_n"),
        _of("plateau_stiffness", "half_width_m", "half_width_m"),
        Same(
            "plateau_stiffness",
            "centre_height_m",
            lambda truth, bench: bench.free_length_m + truth["centre_m"],
        ),
    ),
    "hertz_bumper": (
        *_CONTACTS,
        *(
            _of(f"hertz_{side}", "contact_stiffness_n_per_m1_5", "stiffness_n_per_m15")
            for side in _SIDES
        ),
        *(
            _of(f"hertz_{side}", "dissipation_s_per_m", "dissipation_s_per_m", 1.5)
            for side in _SIDES
        ),
    ),
    "linear_bumper": (
        *_CONTACTS,
        *(_of(side, "stiffness_n_per_m", "stiffness_n_per_m") for side in _SIDES),
        *(_of(side, "damping_n_s_per_m", "damping_n_s_per_m") for side in _SIDES),
    ),
    "free_play": (
        _of("free_play", "gap_m", "half_gap_m", 2.0),
        _of("backlash", "gap_m", "half_gap_m", 2.0),
        Same("free_play", "centre_height_m", lambda _, bench: bench.free_length_m),
        Same("backlash", "centre_height_m", lambda _, bench: bench.free_length_m),
    ),
    "stick": _FRICTION,
    "bristle": _FRICTION,
    "orifice": (
        _of("power_damping", "force_at_1_m_per_s_n", "force_at_1_m_per_s_n"),
        _of("power_damping", "exponent", "exponent"),
        _of("quadratic_damping", "damping_n_s2_per_m2", "force_at_1_m_per_s_n"),
    ),
    "one_way": (
        Same(
            "asymmetric_damping",
            "compression_n_s_per_m",
            lambda truth, _: truth["damping_n_s_per_m"] * (truth["side"] < 0),
        ),
        Same(
            "asymmetric_damping",
            "rebound_n_s_per_m",
            lambda truth, _: truth["damping_n_s_per_m"] * (truth["side"] > 0),
        ),
    ),
    "arctan_damper": (
        _of("arctan_damping", "knee_velocity_m_per_s", "velocity_m_per_s"),
        Same(
            "arctan_damping",
            "damping_n_s_per_m",
            lambda truth, _: 2 * truth["force_n"] / (math.pi * truth["velocity_m_per_s"]),
        ),
    ),
    "blow_off": (
        _of("blow_off_damping", "lost_damping_n_s_per_m", "damping_drop_n_s_per_m"),
        _of("blow_off_damping", "knee_velocity_m_per_s", "knee_m_per_s"),
    ),
    "taper": (
        _of("end_zone_damping", "damping_n_s_per_m2", "damping_n_s_per_m2"),
        Same("end_zone_damping", "zone_height_m", lambda _, bench: bench.free_length_m),
    ),
    "groove": (_of("position_dependent_damping", "damping_n_s_per_m3", "damping_n_s_per_m3"),),
    "yielding": (
        _of("bouc_wen", "yield_force_n", "yield_n"),
        Same("bouc_wen", "yield_displacement_m", _yield_travel),
    ),
    "dahl": (
        _of("dahl", "yield_force_n", "yield_n"),
        Same("dahl", "yield_displacement_m", _yield_travel),
        _of("dahl", "exponent", "exponent"),
    ),
    "slip_elements": (_of("iwan", "yield_force_n", "yield_n"),),
    "relaxing_branch": (
        _of("maxwell", "stiffness_n_per_m", "stiffness_n_per_m"),
        _of("maxwell", "relaxation_time_s", "relaxation_s"),
    ),
    "thin_oil": (
        _of("temperature_fade", "fraction_per_k", "per_k"),
        Same("temperature_fade", "reference_c", lambda *_: REFERENCE_C),
    ),
    "time_fade": (
        Same("time_fade", "final_fraction", _kept),
        _of("time_fade", "time_constant_s", "time_s"),
    ),
    "work_fade": (
        Same("energy_fade", "final_fraction", _kept),
        _of("energy_fade", "energy_j", "energy_j"),
    ),
    "hung_mass": (
        _of("hidden_mass", "mass_kg", "mass_kg"),
        _of("hidden_mass", "frequency_hz", "frequency_hz"),
        _of("hidden_mass", "damping_ratio", "damping_ratio"),
    ),
}
"""Planted law -> the parameters of a diagnosis that can be held against it.

What is linear is reported as a total apart from the effects, see `TOTALS`.
"""

ABOUT_THE_FREE_LENGTH = frozenset(
    {
        "cubic_stiffness.stiffness_n_per_m3",
        "power_stiffness.force_at_100_mm_n",
        "power_stiffness.exponent",
        "exponential_stiffness.force_n",
        "gas_spring.gas_length_m",
        "balanced_gas_spring.gas_length_m",
        "position_dependent_damping.damping_n_s_per_m3",
    }
)
"""Parameters that mean something else in a model file whose free length is wrong."""


class Total(NamedTuple):
    """A linear parameter of the whole bench.

    Attributes:
        family: Family of a diagnosis that corrects it.
        change: True change against the model file.
        overlaps: Families whose laws change it too, so that its truth depends on the law.
    """

    family: str
    change: Callable[[Case], float]
    overlaps: frozenset[str]


def _planted(law: str) -> Callable[[Case], float]:
    """Sum of a linear law's only parameter."""

    def total(case: Case) -> float:
        return sum(next(iter(e.truth.values())) for e in case.effects if e.law == law)

    return total


def _change(field: str, law: str) -> Callable[[Case], float]:
    planted = _planted(law)
    return lambda case: getattr(case.bench, field) - getattr(case.nominal, field) + planted(case)


_ANY_FORCE = frozenset({"input_gain", "delay", "unmodelled_mode", "outside"})
_ANY_SPRING = _ANY_FORCE | {"nonlinear_stiffness", "backlash", "hysteresis"}

TOTALS: dict[str, Total] = {
    "mass_kg": Total("inertia", _change("mass_kg", "rigid_mass"), _ANY_FORCE),
    "stiffness_n_per_m": Total(
        "stiffness", _change("stiffness_n_per_m", "stiffness_error"), _ANY_SPRING
    ),
    "damping_n_s_per_m": Total(
        "damping",
        _change("damping_n_s_per_m", "damping_error"),
        _ANY_FORCE | {"nonlinear_damping", "hysteresis", "fade"},
    ),
    "preload_n": Total("preload", _planted("constant"), _ANY_SPRING),
    "input_gain": Total("input_gain", _planted("load_scale"), _ANY_FORCE - {"input_gain"}),
    "free_length_m": Total(
        "preload",
        lambda case: case.bench.free_length_m - case.nominal.free_length_m,
        _ANY_SPRING | {"preload", "stop"},
    ),
}
"""Parameter of a linear correction -> how to hold it against the truth."""


class Interval(NamedTuple):
    """One parameter with its interval, and whether the truth lies inside."""

    law: str
    parameter: str
    truth: float
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        return self.low <= self.truth <= self.high


def carries_force(parameter: str) -> bool:
    """Whether a parameter is in newtons, kilograms or joules, times or by anything."""
    return not {"n", "kg", "j"}.isdisjoint(parameter.split("_"))


def is_bounded(estimate: dict) -> bool:
    """Whether the data bound an estimate on both sides."""
    return estimate["low"] is not None and estimate["high"] is not None


def intervals(case: Case | MovingCase, diagnosis: dict) -> list[Interval]:
    """Every interval of a diagnosis that the truth can be held against.

    Args:
        case: The truth.
        diagnosis: The diagnosis.
    """
    if isinstance(case, MovingCase):
        held = list(_of_moving(case, diagnosis["effects"]))
        return [interval for interval in held if math.isfinite(interval.high - interval.low)]
    if any(case.kind.endswith(kind) for kind in FOREIGN_KINDS):
        return []
    held = [*_of_effects(case, diagnosis["effects"]), *_of_totals(case, diagnosis)]
    return [interval for interval in held if math.isfinite(interval.high - interval.low)]


MOVING: dict[str, dict[str, str]] = {
    "friction": {
        f"{name}_friction": "coulomb_force_n"
        for name in ("coulomb", "stribeck", "presliding", "elastoplastic", "lugre")
    },
    "cubic_stiffness": {"cubic_stiffness": "stiffness_n_per_m3"},
    "quadratic_damping": {"quadratic_damping": "damping_n_s2_per_m2"},
    "bump_stop": {"hertz_bump_stop": "contact_height_m"},
}
"""Effect of a simulated bench -> parameter of the same name and meaning in each of ours."""


def _of_moving(case: MovingCase, found: list[dict]) -> Iterator[Interval]:
    for planted in case.effects:
        for answer in found:
            parameter = MOVING[planted.name].get(answer["name"])
            if parameter is None or answer["strut"] != planted.strut:
                continue
            estimate, truth = answer["parameters"][parameter], planted.parameters[parameter]
            yield _interval(planted.name, f"{answer['name']}.{parameter}", truth, estimate)


def _of_effects(case: Case, found: list[dict]) -> Iterator[Interval]:
    for planted_effect in case.effects:
        same = COMPARABLE.get(planted_effect.law, ())
        comparable = {entry.effect for entry in same}
        answers = [answer for answer in found if answer["name"] in comparable]
        # Two stops may stand for one law with two ends; of all else the first answer counts.
        for answer in answers if planted_effect.family == "stop" else answers[:1]:
            for entry in same:
                estimate = answer["parameters"].get(entry.parameter)
                name = f"{entry.effect}.{entry.parameter}"
                if entry.effect != answer["name"] or estimate is None or _is_blurred(case, name):
                    continue
                truth = entry.value(planted_effect.truth, case.bench)
                yield _interval(planted_effect.law, name, truth, estimate)


def _is_blurred(case: Case, name: str) -> bool:
    """Whether the roughness of the model file changes what a parameter of an effect means."""
    if case.roughness.input_gain and carries_force(name.partition(".")[2]):
        return True
    return not case.roughness.is_exact and name in ABOUT_THE_FREE_LENGTH


def _of_totals(case: Case, diagnosis: dict) -> Iterator[Interval]:
    corrected = {entry["parameter"] for entry in diagnosis.get("linear", [])}
    for entry in diagnosis.get("linear", []):
        parameter, nominal = entry["parameter"], entry["nominal"]
        total = TOTALS[parameter]
        # About mid-stroke a wrong stiffness or free length is a preload as well.
        is_moved = "stiffness_n_per_m" in corrected or not case.roughness.is_exact
        if (
            case.roughness.input_gain
            or not total.overlaps.isdisjoint(case.families)
            or (parameter == "preload_n" and is_moved)
            or (parameter == "mass_kg" and case.is_dyno)
        ):
            continue
        truth = nominal + total.change(case)
        yield _interval("linear", f"total.{parameter}", truth, entry["total"])


def _interval(law: str, parameter: str, truth: float, estimate: dict) -> Interval:
    low, high = (math.nan if estimate[end] is None else estimate[end] for end in ("low", "high"))
    return Interval(law, parameter, truth, estimate["value"], low, high)
