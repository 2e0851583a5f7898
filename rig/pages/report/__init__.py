"""The report of a diagnosis: one page without network, with the result and its evidence."""

from rig.pages.report.page import page, write_report
from rig.pages.report.words import sentence

__all__ = ["page", "sentence", "write_report"]
