"""A band of tolerance about a master curve, and the verdict on a damper at each of its points.

A point passes when its interval lies inside the band, fails when it lies outside, and is open when
the interval crosses a limit: the measurement then proves neither (ISO 14253-1, 2017).
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from can_dbc.errors import InputError
from can_dbc.yaml_file import load_yaml, validate
from rig.dyno.curves import peak_force_at
from rig.dyno.figures import SIDES, DynoStep
from rig.dyno.stroke_force import Figure
from rig.files.delimited_text import read_csv_columns

_MAX_BYTES = 4_000_000
"""Largest file of a band, whose points are at most a thousand."""

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Verdict = Literal["pass", "fail", "open", "not measured"]

_COLUMNS = ("velocity_m_per_s", "compression_low_n", "compression_high_n", "rebound_low_n",
            "rebound_high_n")  # fmt: skip


class BandPoint(BaseModel):
    """Limits at one peak velocity; damping is negative in rebound."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    velocity_m_per_s: Annotated[float, Field(gt=0.0, le=100.0, strict=True)]
    compression_low_n: Finite
    compression_high_n: Finite
    rebound_low_n: Finite
    rebound_high_n: Finite

    @model_validator(mode="after")
    def _in_order(self) -> "BandPoint":
        for side in SIDES:
            low, high = getattr(self, f"{side}_low_n"), getattr(self, f"{side}_high_n")
            if low >= high:
                raise ValueError(f"{side}_low_n {low}: expected less than {side}_high_n ({high})")
        return self


class ToleranceBand(BaseModel):
    """A band about a master curve: limits by peak velocity, increasing."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=200)]
    points: Annotated[tuple[BandPoint, ...], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _in_order(self) -> "ToleranceBand":
        speeds = [point.velocity_m_per_s for point in self.points]
        if sorted(set(speeds)) != speeds:
            raise ValueError("points: expected velocities that increase")
        return self


class PointVerdict(NamedTuple):
    """A damper at a point of a band, in `compression` or `rebound`; the force may be unknown."""

    velocity_m_per_s: float
    side: str
    force: Figure | None
    low_n: float
    high_n: float
    verdict: Verdict

    @property
    def margin_n(self) -> float | None:
        """Distance of the force from the nearer limit, negative beyond it; None if unknown."""
        if self.force is None or not self.force.is_bounded:
            return None
        return min(self.force.value - self.low_n, self.high_n - self.force.value)

    def words(self) -> str:
        """The same in a line."""
        band = f"{self.low_n:g} to {self.high_n:g} N"
        if self.force is None:
            return f"no step at {self.velocity_m_per_s:g} m/s, expected {band}"
        low, high = self.force.low, self.force.high
        if self.force.is_bounded:
            shown = f"{self.force.value:.1f} N ({low:.1f} to {high:.1f})"
        elif math.isfinite(low):
            shown = f"at least {low:.1f} N, the load cell was clipped"
        elif math.isfinite(high):
            shown = f"at most {high:.1f} N, the load cell was clipped"
        else:
            shown = "not known, the load cell was clipped"
        return f"{shown}, {self.force.method}, expected {band}"


def load_tolerance(path: Path) -> ToleranceBand:
    """A band from YAML, or from CSV with the columns of `BandPoint`.

    Raises:
        InputError: One line that names file, key, value and what was expected.
    """
    if path.suffix.lower() != ".csv":
        return load_yaml(ToleranceBand, path)
    columns, _ = read_csv_columns(
        path, str(path), _MAX_BYTES, lambda header: _check_header(path, header)
    )
    points = [
        dict(zip(columns, row, strict=True))
        for row in np.column_stack(list(columns.values())).tolist()
    ]
    if not points:
        raise InputError(f"{path}: holds no point, expected rows under the header")
    return validate(ToleranceBand, {"name": path.stem, "points": points}, str(path))


def _check_header(path: Path, header: Sequence[str]) -> Sequence[str]:
    if tuple(header) != _COLUMNS:
        raise InputError(f"{path}: line 1: expected the header {','.join(_COLUMNS)}")
    return header


def evaluate_band(steps: Sequence[DynoStep], tolerance: ToleranceBand) -> list[PointVerdict]:
    """Every point of a band, compression and rebound.

    A point belongs to the velocity step nearest to its speed within 1 %; the force is then less
    certain by what it may change over the difference. Between two steps the force of a damper lies
    between theirs, since it rises with speed: that is its interval. Beyond all steps it is not
    measured. A warm-up is no step.
    """
    verdicts: list[PointVerdict] = []
    for point in tolerance.points:
        for side in SIDES:
            low, high = getattr(point, f"{side}_low_n"), getattr(point, f"{side}_high_n")
            force = peak_force_at(steps, side, point.velocity_m_per_s)
            verdict = _verdict(force, low, high)
            verdicts.append(PointVerdict(point.velocity_m_per_s, side, force, low, high, verdict))
    return verdicts


def _verdict(force: Figure | None, low: float, high: float) -> Verdict:
    if force is None:
        return "not measured"
    if low <= force.low and force.high <= high:
        return "pass"
    return "fail" if force.high < low or force.low > high else "open"
