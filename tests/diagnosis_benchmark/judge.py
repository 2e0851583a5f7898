"""Holds a diagnosis against the truth."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from tests.diagnosis_benchmark.acting import overlaps
from tests.diagnosis_benchmark.comparable import (
    TOTALS,
    Interval,
    carries_force,
    intervals,
    is_bounded,
)
from tests.diagnosis_benchmark.moving import RATE_HZ, MovingCase
from tests.truth.cases import LINEAR_FAMILIES
from tests.truth.plant import Case
from tests.truth.simulation import height_floor_m

NAMES_A_CAUSE = frozenset({"explained", "partly_explained", "ambiguous"})
NO_CAUSE = "restoring_surface"
LIVE_MULTIPLE = 2.0
"""Times its floor that the residual force of a right model may be, as an observer finds it."""
SIDE_EFFECTS = {"stiffness": frozenset({"preload"})}
"""Linear family -> what a correction of it brings along: stiffness is about the free length in the
file, and about mid-stroke in a diagnosis, where its change is a preload as well."""


@dataclass(frozen=True)
class Result:
    """One case, diagnosed.

    Attributes:
        slot: Place in the benchmark.
        group: Its group.
        case: Name of the case.
        planted: Families in the bench.
        laws: Their formulas.
        ratios: How far each stands above the noise floor.
        is_rough: Whether the model file is rough.
        sample_rate_hz: Samples a second.
        verdict: The diagnosis's, or ``failed``.
        families: Families it names as missing, in order.
        names: Effects it names, in order.
        linear: Families of its linear corrections.
        ambiguous_with: Rivals it could not tell apart.
        right: Whether it is right, see `is_right`.
        false_names: Families it names that are not there, see `false_names`.
        false_candidates: Families it calls candidates that are not there, likewise.
        unbound: Effects it names that the data do not bind, see `is_unbound`.
        unit: ``m`` or ``N``, of the next four.
        error_before: Held-out error of the nominal model: open-loop height, on a dyno strut force.
        error_after: That of the corrected model.
        floor: What a right model leaves: the height sensor's true error, and what the resolution
            of the measured load moves; on a dyno the floor that the diagnosis claims.
        own_floor: The floor that the diagnosis claims.
        intervals: Parameters that the truth can be held against.
        overlaps: Of where stops and knees show with where they were planted (F1).
        duration_s: Wall time of the diagnosis.
        live_force_ratio: RMS residual force that an observer finds of the corrected model over its
            floor (see `live_force`, `live_force_of_moving`), while it follows the held-out run with
            tuned gains; infinite where the loop is unstable or a force is not finite; None on a
            dyno.
        message: What went wrong, if it failed.
    """

    slot: str
    group: str
    case: str
    planted: tuple[str, ...]
    laws: tuple[str, ...]
    ratios: tuple[float, ...]
    is_rough: bool
    sample_rate_hz: int
    verdict: str
    families: tuple[str, ...]
    names: tuple[str, ...]
    linear: tuple[str, ...]
    ambiguous_with: tuple[str, ...]
    right: bool
    false_names: tuple[str, ...]
    false_candidates: tuple[str, ...]
    unbound: tuple[str, ...]
    unit: str
    error_before: float
    error_after: float
    floor: float
    own_floor: float
    intervals: tuple[Interval, ...]
    overlaps: tuple[float, ...]
    duration_s: float
    live_force_ratio: float | None
    message: str

    @property
    def runs_live(self) -> bool:
        """Whether the corrected model runs, and leaves noise alone where all is explained."""
        is_complete = self.verdict in {"explained", "ambiguous", "nothing_missing"}
        most = LIVE_MULTIPLE if is_complete else math.inf
        return self.live_force_ratio is not None and self.live_force_ratio < most

    @property
    def floor_multiple(self) -> float:
        """Held-out error after the correction over the noise floor."""
        return self.error_after / self.floor if self.floor else math.nan


def linear_families(diagnosis: dict) -> list[str]:
    """Families of the linear corrections."""
    return [TOTALS[entry["parameter"]].family for entry in diagnosis.get("linear", [])]


def _without(families: Iterable[str], left_out: Iterable[str]) -> list[str]:
    return [family for family in families if family not in left_out]


def is_right(planted: tuple[str, ...], diagnosis: dict, *, is_rough: bool = False) -> bool:
    """Whether a diagnosis is right; what it calls a candidate counts as named.

    Nothing planted: it says so; where the model file is rough, it names linear corrections at most,
    and does not say that anything is residual_of.
    One effect: its family comes first, or, where the verdict is ``ambiguous``, is among the named
    rivals; where the model file is rough, first of all that is not linear. Several: all families
    are named, those that are linear among the corrections. A force that no catalogue holds:
    anything but a claim that a law explains it, or that nothing is there. No answer at all is
    never right.
    """
    verdict = diagnosis["verdict"]
    linear = linear_families(diagnosis)
    families = [effect["family"] for effect in diagnosis["effects"]]
    if is_rough:
        families = _without(families, LINEAR_FAMILIES)
    if verdict == "failed":
        return False
    if not planted:
        silent = not families and verdict != "not_explained"
        return silent if is_rough else verdict == "nothing_missing"
    if planted == ("outside",):
        return verdict not in {"explained", "ambiguous", "nothing_missing"}
    if verdict not in NAMES_A_CAUSE:
        return False
    rivals = set(diagnosis["ambiguous_with"]) if verdict == "ambiguous" else set()
    if len(planted) == 1:
        first = _without(families, SIDE_EFFECTS.get(planted[0], ()))[:1]
        return set(planted) <= set(first) | rivals
    return set(planted) <= {*families, *linear} | rivals


def is_candidate(effect: dict) -> bool:
    """Whether a diagnosis calls an effect a candidate."""
    evidence = effect.get("evidence")
    return evidence is not None and evidence["held_out"] != "confirmed"


def false_names(
    planted: tuple[str, ...],
    diagnosis: dict,
    *,
    is_rough: bool,
    counted: Callable[[dict], bool] = lambda effect: not is_candidate(effect),
) -> list[str]:
    """Families that a diagnosis names with an interval and that are not there.

    A linear family is none where it is a linear correction, nor the surface that names no cause,
    nor a candidate. Where a planted family is a rival, what was named in its place is none.
    """
    linear = set(LINEAR_FAMILIES if is_rough else linear_families(diagnosis))
    named = [
        effect["family"]
        for effect in filter(counted, diagnosis["effects"])
        if any(is_bounded(estimate) for estimate in effect["parameters"].values())
    ]
    wrong = _without(named, {*planted, *linear, NO_CAUSE})
    if diagnosis["verdict"] == "ambiguous":
        told = set(planted).intersection(diagnosis["ambiguous_with"]) - set(named)
        wrong = wrong[len(told) :]
    return wrong


def is_unbound(effect: dict) -> bool:
    """Whether the data leave open that a named effect is nothing.

    They do where no parameter that scales it (in newtons or kilograms; the first one where there
    is none) has an interval that ends on both sides and leaves out zero.
    """
    parameters = effect["parameters"]
    scales = [name for name in parameters if carries_force(name)] or list(parameters)[:1]
    return effect["family"] != NO_CAUSE and not any(
        is_bounded(parameters[name])
        and not parameters[name]["low"] <= 0.0 <= parameters[name]["high"]
        for name in scales
    )


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _errors(case: Case | MovingCase, diagnosis: dict) -> dict[str, str | float]:
    """Held-out errors and floors, as fields of a `Result`."""
    held_out, claimed = diagnosis.get("held_out") or {}, diagnosis.get("noise_floor") or {}
    if isinstance(case, MovingCase):
        # Noise of the base is part of what a right model leaves, by the model's own resonances.
        error = held_out.get("height_rmse_m") or {}
        own_floor = _number(claimed.get("height_rmse_m"))
        floor, unit = own_floor, "m"
    elif case.is_dyno:
        error = held_out.get("strut_force_rmse_n") or held_out.get("residual_force_rmse_n") or {}
        own_floor = _number(claimed.get("residual_force_rmse_n"))
        floor, unit = own_floor, "N"
    else:
        error = held_out.get("height_rmse_m") or {}
        own_floor = _number(claimed.get("height_rmse_m"))
        floor, unit = height_floor_m(case), "m"
    return {
        "unit": unit,
        "error_before": _number(error.get("before")),
        "error_after": _number(error.get("after")),
        "floor": floor,
        "own_floor": own_floor,
    }


def judge(
    case: Case | MovingCase, ratios: tuple[float, ...], diagnosis: dict, slot: str, group: str
) -> dict:
    """All of a `Result` but its duration and how it runs live, as its fields."""
    found = diagnosis["effects"]
    is_moving = isinstance(case, MovingCase)
    is_rough = is_moving or not case.roughness.is_exact
    return _errors(case, diagnosis) | {
        "slot": slot,
        "group": group,
        "case": case.name,
        "planted": case.families,
        "laws": tuple(it.name if is_moving else it.law for it in case.effects),
        "ratios": ratios,
        "is_rough": is_rough,
        "sample_rate_hz": RATE_HZ if is_moving else case.sensors.sample_rate_hz,
        "verdict": diagnosis["verdict"],
        "families": tuple(effect["family"] for effect in found),
        "names": tuple(effect["name"] for effect in found),
        "linear": tuple(linear_families(diagnosis)),
        "ambiguous_with": tuple(diagnosis["ambiguous_with"]),
        "right": is_right(case.families, diagnosis, is_rough=is_rough),
        "false_names": tuple(false_names(case.families, diagnosis, is_rough=is_rough)),
        "false_candidates": tuple(
            false_names(case.families, diagnosis, is_rough=is_rough, counted=is_candidate)
        ),
        "unbound": tuple(effect["name"] for effect in found if is_unbound(effect)),
        "intervals": tuple(intervals(case, diagnosis)),
        "overlaps": () if is_moving else tuple(overlaps(case, diagnosis)),
        "message": diagnosis.get("message", ""),
    }
