"""What a report is written from."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rig.identify.diagnosis import Diagnosis

Array = NDArray[np.float64]


class ReportError(ValueError):
    """A report cannot be written from this; one line: key, what was found and expected."""


@dataclass(frozen=True)
class FittedSeries:
    """Missing force of one strut along one run that was fitted; all arrays of shape (N,).

    Attributes:
        run: Name of the run.
        strut: Name of the strut.
        t_s: Times in s, increasing.
        height_m: Smoothed height.
        velocity_m_per_s: Smoothed velocity.
        residual_before_n: Force that the model as given lacks.
        residual_after_n: Force that the corrected model lacks.
        residual_std_n: Standard deviation of either, from the smoother.
    """

    run: str
    strut: str
    t_s: Array
    height_m: Array
    velocity_m_per_s: Array
    residual_before_n: Array
    residual_after_n: Array
    residual_std_n: Array


@dataclass(frozen=True)
class HeldOutSeries:
    """Height of one strut along one run that was not fitted; all arrays of shape (N,).

    Attributes:
        run: Name of the run.
        strut: Name of the strut.
        t_s: Times in s, increasing.
        height_m: Measured height; NaN where a sample is missing.
        height_before_m: The model as given, running open loop.
        height_after_m: The corrected model, running open loop.
    """

    run: str
    strut: str
    t_s: Array
    height_m: Array
    height_before_m: Array
    height_after_m: Array


@dataclass(frozen=True)
class HeldOutForce:
    """Strut force along one run with an imposed motion that was not fitted; arrays of shape (N,).

    Attributes:
        run: Name of the run.
        strut: Name of the strut.
        t_s: Times in s, increasing.
        height_m: Measured height; NaN where a sample is missing.
        velocity_m_per_s: Smoothed velocity.
        force_n: Load cell.
        force_before_n: The model as given, driven along the motion.
        force_after_n: The corrected model, driven along the motion.
    """

    run: str
    strut: str
    t_s: Array
    height_m: Array
    velocity_m_per_s: Array
    force_n: Array
    force_before_n: Array
    force_after_n: Array


@dataclass(frozen=True)
class Ranked:
    """A candidate in the ranking.

    Attributes:
        name: Effect, as in the catalogue.
        family: Its family.
        strut: Strut on which it was tried.
        score: Share of the held-out residual that it explains (1 all, 0 nothing); None if it was
            put aside before it was scored.
        why: Why it was rejected; empty if it was chosen.
    """

    name: str
    family: str
    strut: str
    score: float | None
    why: str


@dataclass(frozen=True)
class ReportInput:
    """All that a report shows.

    Attributes:
        diagnosis: What was found.
        fitted: Series of every strut along the fitted runs.
        held_out: Series of every strut along the held-out runs: heights, or forces where the
            motion is imposed.
        ranking: Every candidate, best first.
        assumptions: Whole sentences on what this diagnosis took for granted, beside those that
            hold for every diagnosis.
    """

    diagnosis: Diagnosis
    fitted: tuple[FittedSeries, ...]
    held_out: tuple[HeldOutSeries, ...] | tuple[HeldOutForce, ...]
    ranking: tuple[Ranked, ...]
    assumptions: tuple[str, ...] = ()


def check_series(series: FittedSeries | HeldOutSeries | HeldOutForce) -> None:
    """Check that the arrays of a series belong together.

    Raises:
        ReportError: An array is empty, or is not as long as the times, or times do not increase.
    """
    where = f"run {series.run!r}, strut {series.strut!r}"
    shape = series.t_s.shape
    if len(shape) != 1 or shape[0] < 2:
        raise ReportError(f"{where}: t_s: shape {shape}, expected two or more times")
    if not bool(np.all(np.diff(series.t_s) > 0)):
        raise ReportError(f"{where}: t_s: expected times that increase")
    for name, value in _arrays(series):
        if value.shape != shape:
            raise ReportError(f"{where}: {name}: shape {value.shape}, expected {shape}")


def _arrays(
    series: FittedSeries | HeldOutSeries | HeldOutForce,
) -> tuple[tuple[str, Array], ...]:
    arrays = (
        (field.name, getattr(series, field.name))
        for field in fields(series)
        if field.name not in ("run", "strut", "t_s")
    )
    return tuple((name, np.asarray(value)) for name, value in arrays)
