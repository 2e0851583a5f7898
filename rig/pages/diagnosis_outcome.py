"""Outcome of a diagnosis as a value, with its tables in a notebook."""

from dataclasses import dataclass
from html import escape
from pathlib import Path

from dart_model.spec import ModelSpec
from rig.diagnosis.outcome import REPORT_FILE, Diagnosis, Result, write_results
from rig.pages.report import sentence, tables, write_report

_HEADINGS = ("on held-out data", "before", "after", "change", "noise floor", "ratio")


@dataclass(frozen=True)
class DiagnosisOutcome:
    """Outcome of a diagnosis.

    Attributes:
        result: The whole result, with the series that a report draws.
        nominal: The nominal model.
    """

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

    def _repr_html_(self) -> str:
        diagnosis = self.diagnosis
        rows = [
            _row("td", (table.law.name, name, value, interval))
            for table in tables.effects(diagnosis)
            for name, _, value, interval, _, _ in table.rows
        ]
        rows += [
            _row("td", (name, "", value, low))
            for name, _, _, _, value, low, _ in tables.linear(diagnosis)
        ]
        effects = _row("th", ("effect", "parameter", "value", "95 % interval")) + "".join(rows)
        errors = _row("th", _HEADINGS) + "".join(
            _row("td", row) for row in tables.errors(diagnosis)
        )
        return f"<p>{escape(str(self))}</p><table>{effects}</table><table>{errors}</table>"


def _row(tag: str, cells: tuple[str, ...]) -> str:
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"
