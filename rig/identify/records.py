"""Records of a bench: what was measured, read from CSV or from a run folder, and checked.

A record that cannot be diagnosed is refused here with one line that says what is wrong and what
would help, before anything is computed from it.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COLUMNS = ("t_s", "height_m", "applied_force_n", "strut_force_n", "temperature_c")
"""Columns of a CSV file; the first two must be there, and one of the forces."""

_LEAST_SAMPLES = 200
_LEAST_DURATION_S = 0.5
_LARGEST_BYTES = 2_000_000_000
_LARGEST_SAMPLES = 5_000_000
_LARGEST_HEIGHT_M = 100.0


class RecordError(ValueError):
    """A record that cannot be diagnosed; one line: file, column, what was found and expected."""


@dataclass(frozen=True)
class Record:
    """One run of a bench.

    Attributes:
        name: File or folder, for reports.
        t_s: Times, increasing, shape (N,).
        heights_m: Heights of the struts, shape (N, struts); NaN where a sample is missing.
        applied_force_n: Applied force, shape (N,), or None where the bench has none.
        strut_force_n: Load-cell force, shape (N,), or None.
        temperature_c: Damper temperature, shape (N,), or None.
    """

    name: str
    t_s: Array
    heights_m: Array
    applied_force_n: Array | None = None
    strut_force_n: Array | None = None
    temperature_c: Array | None = None

    @property
    def duration_s(self) -> float:
        """Time from first to last sample."""
        return float(self.t_s[-1] - self.t_s[0])


def read_csv(path: Path) -> Record:
    """Record from a CSV file with units in its header.

    Raises:
        RecordError: The file is no such table, or holds no run that can be diagnosed.
    """
    name = path.name
    columns, table = _read_table(path)
    for i, column in enumerate(columns):
        bad = ~np.isfinite(table[:, i])
        if np.any(bad):
            raise RecordError(
                f"{name}: line {int(np.argmax(bad)) + 2}: {column} is no finite number "
                f"({int(bad.sum())} such values), expected numbers: leave out rows without a "
                "measurement, gaps in time are understood"
            )
    values = {column: table[:, i] for i, column in enumerate(columns)}
    record = Record(
        name,
        values["t_s"],
        values["height_m"][:, np.newaxis],
        values.get("applied_force_n"),
        values.get("strut_force_n"),
        values.get("temperature_c"),
    )
    return checked(record)


def _read_table(path: Path) -> tuple[list[str], Array]:
    name = path.name
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise RecordError(f"{name}: larger than {_LARGEST_BYTES} bytes, expected a shorter run")
        with path.open(encoding="utf-8-sig", newline="") as file:
            first = next(csv.reader(file), None)
            if first is None:
                raise RecordError(f"{name}: is empty, expected a header {','.join(COLUMNS[:3])}")
            columns = [column.strip() for column in first]
            _check_header(name, columns)
            return columns, _read_rows(name, columns, file)
    except OSError as error:
        raise RecordError(f"{name}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        reason = " ".join(str(error).split())
        raise RecordError(f"{name}: is no CSV text in UTF-8: {reason}") from error


def _check_header(name: str, columns: list[str]) -> None:
    for column in columns:
        if column not in COLUMNS:
            raise RecordError(
                f"{name}: header: column {column[:40]!r}: expected one of {', '.join(COLUMNS)}"
            )
        if columns.count(column) > 1:
            raise RecordError(f"{name}: header: column {column} stands there twice, expected once")
    for column in COLUMNS[:2]:
        if column not in columns:
            raise RecordError(f"{name}: header: column {column} is missing, expected it")
    if "applied_force_n" not in columns and "strut_force_n" not in columns:
        raise RecordError(
            f"{name}: header: expected applied_force_n or strut_force_n beside t_s and height_m"
        )


def _read_rows(name: str, columns: list[str], lines: object) -> Array:
    rows: list[list[str]] = []
    for number, row in enumerate(csv.reader(cast("list[str]", lines)), start=2):
        if not row:
            continue
        if len(row) != len(columns):
            raise RecordError(f"{name}: line {number}: {len(row)} values, expected {len(columns)}")
        rows.append(row)
        if len(rows) > _LARGEST_SAMPLES:
            raise RecordError(f"{name}: more than {_LARGEST_SAMPLES} samples, expected fewer")
    if not rows:
        raise RecordError(f"{name}: holds no samples, expected at least {_LEAST_SAMPLES}")
    table = np.empty((len(rows), len(columns)))
    for i, column in enumerate(columns):
        cells = [row[i].strip() or "nan" for row in rows]
        try:
            table[:, i] = np.array(cells, dtype=np.float64)
        except ValueError:
            bad = next(k for k, cell in enumerate(cells) if not _is_number(cell))
            raise RecordError(
                f"{name}: line {bad + 2}: {column} = {cells[bad][:40]!r}, expected a number"
            ) from None
    return table


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def checked(record: Record) -> Record:
    """The record with single missing heights allowed, or an error for what would mislead.

    Raises:
        RecordError: See the module.
    """
    name, t_s = record.name, record.t_s
    if len(t_s) < _LEAST_SAMPLES:
        raise RecordError(
            f"{name}: {len(t_s)} samples, expected at least {_LEAST_SAMPLES}: record a longer run"
        )
    _check_times(name, t_s)
    for column in range(record.heights_m.shape[1]):
        _check_heights(name, record.heights_m[:, column])
    for label, channel in (
        ("applied_force_n", record.applied_force_n),
        ("strut_force_n", record.strut_force_n),
        ("temperature_c", record.temperature_c),
    ):
        if channel is not None:
            _check_finite(name, label, channel)
    if record.applied_force_n is not None:
        _check_moves(name, "applied_force_n", record.applied_force_n, "apply a force that changes")
    if record.strut_force_n is not None:
        _check_moves(name, "strut_force_n", record.strut_force_n, "is the load cell connected?")
    return record


def _check_times(name: str, t_s: Array) -> None:
    if not np.all(np.isfinite(t_s)):
        row = int(np.argmin(np.isfinite(t_s)))
        raise RecordError(f"{name}: t_s is no number in sample {row}, expected a time in s")
    steps = np.diff(t_s)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0)) + 1
        raise RecordError(
            f"{name}: t_s = {t_s[row]:.6g} in sample {row} after {t_s[row - 1]:.6g}, "
            "expected times that increase"
        )
    if t_s[-1] - t_s[0] < _LEAST_DURATION_S:
        raise RecordError(
            f"{name}: t_s spans {t_s[-1] - t_s[0]:.3g} s, "
            f"expected at least {_LEAST_DURATION_S} s: is the time in s?"
        )
    usual = float(np.median(steps))
    if usual > 0.05:
        raise RecordError(
            f"{name}: t_s has one sample in {usual:.3g} s, expected 20 a second or more: "
            "is the time in s?"
        )


def _check_finite(name: str, label: str, channel: Array) -> None:
    bad = ~np.isfinite(channel)
    if np.any(bad):
        row = int(np.argmax(bad))
        raise RecordError(
            f"{name}: {label} is no number in {int(bad.sum())} samples, first in sample {row}, "
            "expected numbers"
        )


def _check_heights(name: str, heights_m: Array) -> None:
    finite = np.isfinite(heights_m)
    if np.any(np.isinf(heights_m)) or finite.mean() < 0.7:
        raise RecordError(
            f"{name}: height_m is no number in {int((~finite).sum())} of {len(finite)} samples, "
            "expected at most 30 % missing"
        )
    heights = heights_m[finite]
    if float(np.max(np.abs(heights))) > _LARGEST_HEIGHT_M:
        raise RecordError(
            f"{name}: height_m reaches {np.max(np.abs(heights)):.6g} m, expected less than "
            f"{_LARGEST_HEIGHT_M:g} m: are the columns swapped, or the unit wrong?"
        )
    low, high = float(heights.min()), float(heights.max())
    if high - low == 0.0:
        raise RecordError(
            f"{name}: height_m is constant at {low:.6g} m, "
            "expected motion: is the sensor connected?"
        )
    for label, limit in (("lowest", low), ("highest", high)):
        longest = _longest_run(heights == limit)
        steps = np.unique(np.diff(np.sort(heights)))
        resolution = float(steps[steps > 0.0][0])
        if longest > max(20, 0.002 * len(heights)) and (high - low) > 50.0 * resolution:
            raise RecordError(
                f"{name}: height_m stays at its {label} value {limit:.6g} m for {longest} samples "
                "on end, expected a sensor that is not clipped: widen its range or reduce the load"
            )


def _longest_run(flags: NDArray[np.bool_]) -> int:
    padded = np.concatenate([[False], flags, [False]])
    edges = np.flatnonzero(np.diff(padded.astype(np.int8)))
    return int(np.max(edges[1::2] - edges[::2])) if len(edges) else 0


def _check_moves(name: str, label: str, channel: Array, advice: str) -> None:
    if float(np.ptp(channel)) == 0.0:
        raise RecordError(
            f"{name}: {label} is constant at {channel[0]:.6g} N, expected it to change: {advice}"
        )
