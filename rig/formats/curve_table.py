"""Forces at speeds as a table: CSV, or a workbook."""

import csv
import importlib
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from can_dbc.atomic_file import write_whole
from can_dbc.errors import InputError, missing_package
from rig.dyno.characterise import Characteristics
from rig.dyno.curves import CurvePoint
from rig.dyno.stroke_force import Figure

COLUMNS = (
    "record", "speed_m_per_s", "side", "part", "step", "temperature_c",
    "force_n", "force_low_n", "force_high_n",
    "damping_n", "damping_low_n", "damping_high_n",
    "at_reference_n", "at_reference_low_n", "at_reference_high_n",
    "method",
)  # fmt: skip

_ENDINGS = (".csv", ".xlsx")


def check_curve_table(path: Path) -> None:
    """Refuse a file that cannot be written, before the work.

    Raises:
        InputError: It exists, its ending is neither .csv nor .xlsx, or openpyxl is missing.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"--curves {path}: expected a file that ends in .csv or .xlsx")
    if path.exists():
        raise InputError(f"--curves {path}: exists already, expected a new file")
    if path.suffix.lower() == ".xlsx":
        _workbook()


def write_curve_table(records: Sequence[Characteristics], path: Path) -> None:
    """Write the curves of records, a row for each point.

    Raises:
        InputError: The file cannot be written.
    """
    rows = [_row(record.name, point) for record in records for point in record.curves]
    try:
        if path.suffix.lower() == ".csv":
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([COLUMNS, *rows])
            write_whole(path, text.getvalue())
            return
        book = _workbook()
        sheet = book.create_sheet("curves")
        for row in [COLUMNS, *rows]:
            sheet.append(row)
        book.save(path)
    except OSError as error:
        raise InputError(f"--curves {path}: cannot be written: {error.strerror}") from error


def _workbook() -> Any:
    try:
        return importlib.import_module("openpyxl").Workbook(write_only=True)
    except ModuleNotFoundError as error:
        missing = missing_package("openpyxl", "pip install -e '.[tables]'")
        raise InputError(f"--curves: {missing}; a file that ends in .csv needs none") from error


def _row(record: str, point: CurvePoint) -> tuple[object, ...]:
    return (
        record,
        point.speed_m_per_s,
        point.side,
        point.part,
        point.step,
        point.temperature_c,
        *_cells(point.force_n),
        *_cells(point.damping_n),
        *_cells(point.at_reference_n),
        point.force_n.method,
    )


def _cells(figure: Figure | None) -> tuple[float | None, ...]:
    """Value and interval; an end that is not known is empty."""
    if figure is None:
        return None, None, None
    ends = (end if abs(end) < float("inf") else None for end in (figure.low, figure.high))
    return figure.value, *ends
