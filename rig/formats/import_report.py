"""The report of an import."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ImportReport:
    """Result of an import, and what it assumed.

    Attributes:
        out: The file or folder written.
        samples: Rows, or frames of a bus log.
        duration_s: Time from the first to the last.
        rate_hz: Rows a second, by the median step; frames a second of a bus log.
        columns: Columns written, or messages of a bus log.
        assumptions: What was assumed and converted, one line each.
    """

    out: Path
    samples: int
    duration_s: float
    rate_hz: float
    columns: tuple[str, ...]
    assumptions: tuple[str, ...]
