"""The report: one page, without network, that says what was found and shows why."""

from rig.pages.report.page import page, write_report
from rig.pages.report.words import sentence

__all__ = ["page", "sentence", "write_report"]
