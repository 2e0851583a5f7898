"""All that a diagnosis gives."""

from typing import NamedTuple

from dart_model.spec import ModelSpec
from rig.identify.diagnosis import Diagnosis
from rig.identify.report import FittedSeries, HeldOutForce, HeldOutSeries, Ranked


class Result(NamedTuple):
    """All that a diagnosis gives.

    Attributes:
        diagnosis: What was found.
        corrected: The corrected model.
        fitted: Missing force along the runs that were learnt from, for the report.
        held_out: Heights, or forces where the motion is imposed, along the held-out runs.
        ranking: Candidates, best first, for the report.
        assumptions: What this diagnosis took for granted.
    """

    diagnosis: Diagnosis
    corrected: ModelSpec
    fitted: tuple[FittedSeries, ...]
    held_out: tuple[HeldOutSeries, ...] | tuple[HeldOutForce, ...]
    ranking: tuple[Ranked, ...]
    assumptions: tuple[str, ...]
