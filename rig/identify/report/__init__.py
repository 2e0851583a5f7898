"""The report: one page, without network, that says what was found and shows why."""

from rig.identify.report.inputs import (
    FittedSeries,
    HeldOutForce,
    HeldOutSeries,
    Ranked,
    ReportError,
    ReportInput,
)
from rig.identify.report.page import page, write_report
from rig.identify.report.words import sentence

__all__ = [
    "FittedSeries",
    "HeldOutForce",
    "HeldOutSeries",
    "Ranked",
    "ReportError",
    "ReportInput",
    "page",
    "sentence",
    "write_report",
]
