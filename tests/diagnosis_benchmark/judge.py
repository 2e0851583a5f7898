"""Holds a diagnosis against the truth."""

from dataclasses import dataclass

from tests.diagnosis_benchmark.comparable import Interval, intervals
from tests.truth.plant import Case

NAMES_A_CAUSE = frozenset({"explained", "partly_explained", "ambiguous"})


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
        height_noise_m: RMS of the height's noise and quantisation, the truth's.
        sample_rate_hz: Samples a second.
        verdict: The diagnosis's, or ``failed``.
        families: Families it names, in order.
        names: Effects it names, in order.
        ambiguous_with: Rivals it could not tell apart.
        right: Whether it is right, see `is_right`.
        rmse_before_m: Held-out open-loop error without effects.
        rmse_after_m: With those that it found.
        own_floor_m: The noise floor it claims.
        intervals: Parameters that the truth can be held against.
        duration_s: Wall time of the diagnosis.
        message: What went wrong, if it failed.
    """

    slot: str
    group: str
    case: str
    planted: tuple[str, ...]
    laws: tuple[str, ...]
    ratios: tuple[float, ...]
    height_noise_m: float
    sample_rate_hz: int
    verdict: str
    families: tuple[str, ...]
    names: tuple[str, ...]
    ambiguous_with: tuple[str, ...]
    right: bool
    rmse_before_m: float
    rmse_after_m: float
    own_floor_m: float
    intervals: tuple[Interval, ...]
    duration_s: float
    message: str

    @property
    def floor_multiple(self) -> float:
        """Held-out error after the correction over the true noise floor."""
        return self.rmse_after_m / self.height_noise_m


def is_right(planted: tuple[str, ...], diagnosis: dict) -> bool:
    """Whether a diagnosis is right.

    Nothing planted: it says so. One effect: its family comes first, or, where the verdict is
    ``ambiguous``, is among the named rivals. Several: all families are named. A force that no
    catalogue holds: anything but a claim that a law explains it, or that nothing is there. No
    answer at all is never right.
    """
    verdict = diagnosis["verdict"]
    families = [effect["family"] for effect in diagnosis["effects"]]
    if verdict == "failed":
        return False
    if not planted:
        return verdict == "nothing_missing"
    if planted == ("outside",):
        return verdict not in {"explained", "ambiguous", "nothing_missing"}
    if verdict not in NAMES_A_CAUSE:
        return False
    rivals = set(diagnosis["ambiguous_with"]) if verdict == "ambiguous" else set()
    named = set(families[:1] if len(planted) == 1 else families) | rivals
    return set(planted) <= named


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def judge(case: Case, ratios: tuple[float, ...], diagnosis: dict, slot: str, group: str) -> dict:
    """All of a `Result` but its duration, as its fields."""
    found = diagnosis["effects"]
    error = (diagnosis.get("held_out") or {}).get("height_rmse_m") or {}
    floor = diagnosis.get("noise_floor") or {}
    return {
        "slot": slot,
        "group": group,
        "case": case.name,
        "planted": case.families,
        "laws": tuple(effect.law for effect in case.effects),
        "ratios": ratios,
        "height_noise_m": case.sensors.height_error_m,
        "sample_rate_hz": case.sensors.sample_rate_hz,
        "verdict": diagnosis["verdict"],
        "families": tuple(effect["family"] for effect in found),
        "names": tuple(effect["name"] for effect in found),
        "ambiguous_with": tuple(diagnosis["ambiguous_with"]),
        "right": is_right(case.families, diagnosis),
        "rmse_before_m": _number(error.get("before")),
        "rmse_after_m": _number(error.get("after")),
        "own_floor_m": _number(floor.get("height_rmse_m")),
        "intervals": tuple(intervals(case.effects, case.bench, found)),
        "message": diagnosis.get("message", ""),
    }
