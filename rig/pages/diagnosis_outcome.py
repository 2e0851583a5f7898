"""Outcome of a diagnosis as a value, with its tables in a notebook."""

from dataclasses import dataclass
from pathlib import Path

from dart_model.spec import ModelSpec
from rig.diagnosis.outcome import REPORT_FILE, Diagnosis, Result, write_results
from rig.pages.html import render
from rig.pages.report import sentence, tables, write_report


@dataclass(frozen=True)
class DiagnosisOutcome:
    """Outcome of a diagnosis, with the series that a report draws, and the nominal model."""

    result: Result
    nominal: ModelSpec

    @property
    def diagnosis(self) -> Diagnosis:
        """Verdict, linear corrections, effects, errors before and after."""
        return self.result.diagnosis

    @property
    def corrected_model(self) -> ModelSpec:
        """The corrected model."""
        return self.result.corrected

    def write(self, folder: Path | str) -> None:
        """Write `diagnosis.json`, `corrected.yaml` and `report.html`.

        Raises:
            InputError: The report cannot be written.
            OSError: The folder cannot be written.
        """
        write_results(self.result, self.nominal, Path(folder))
        write_report(self.result, Path(folder) / REPORT_FILE)

    def __str__(self) -> str:
        return f"{self.diagnosis.verdict}: {sentence(self.diagnosis, len(self.nominal.struts))}"

    # A notebook keeps this beside the tables: without the thousands of numbers, and without paths.
    __repr__ = __str__

    def _repr_html_(self) -> str:
        return render("report/outcome.html", outcome=self, diagnosis=self.diagnosis, tables=tables)
