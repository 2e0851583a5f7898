"""A damper's record with its standing in a tolerance band and against a master."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from can_dbc.atomic_file import write_whole
from can_dbc.errors import InputError
from rig.dyno.characterise import Characteristics, characterise
from rig.dyno.faults import MasterComparison, name_faults
from rig.dyno.master import master_of
from rig.dyno.request import DEFAULT, FigureRequest
from rig.dyno.tolerance import PointVerdict, ToleranceBand, evaluate_band
from rig.files.json_text import json_text

CHARACTERISTICS_FILE = "characteristics.json"

Standing = Literal["pass", "open", "fail"]


class Check(NamedTuple):
    """One criterion that a damper passes or not."""

    name: str
    words: str
    passes: bool


class DamperReport(NamedTuple):
    """The figures of one record, its verdict at each point of a band, and against a master."""

    characteristics: Characteristics
    points: Sequence[PointVerdict] = ()
    against_master: MasterComparison | None = None
    master: Characteristics | None = None

    @property
    def standing(self) -> Standing | None:
        """Verdict on the damper as a whole; None where it is held against nothing.

        It fails with one point outside the band, or if it differs from its master; it passes if
        every point and every step of the master's record does. Otherwise the record proves neither.
        """
        verdicts, comparison = {point.verdict for point in self.points}, self.against_master
        if "fail" in verdicts or (comparison is not None and not comparison.is_good):
            return "fail"
        if not verdicts and comparison is None:
            return None
        is_proven = verdicts <= {"pass"} and (comparison is None or comparison.passes)
        return "pass" if is_proven else "open"

    def checks(self) -> list[Check]:
        """Every criterion, point by point."""
        name, comparison = self.characteristics.name, self.against_master
        checks = [
            Check(
                f"{name}: {point.side} at {point.velocity_m_per_s:g} m/s",
                f"{point.verdict}: {point.words()}",
                point.verdict == "pass",
            )
            for point in self.points
        ]
        if comparison is not None:
            words = comparison.words()
            checks.append(Check(f"{name}: against the master", words, comparison.passes))
        return checks

    def as_dict(self) -> dict[str, object]:
        """For `characteristics.json`."""
        return {
            **self.characteristics.as_dict(),
            "points": list(self.points),
            "against_master": self.against_master,
        }


def evaluate_records(
    paths: Sequence[Path],
    strut: str | None,
    band: ToleranceBand | None,
    master: Path | None,
    scatter: float,
    requested: FigureRequest = DEFAULT,
) -> list[DamperReport]:
    """Reports of several records, folders of runs or CSV files, against a band and a master.

    `strut` may be None where a run has only one. The master is the record of a good damper in the
    same test, `scatter` the relative standard deviation of each property among good dampers. The
    lag that is removed from a record is then the master's: what is more in one of them is a fault.

    Raises:
        InputError: A record cannot be characterised, or not be compared with the master.
    """
    if master is not None and any(path.resolve() == master.resolve() for path in paths):
        raise InputError(f"--master {master}: is the record itself, expected that of a good damper")
    good = None if master is None else characterise(master, strut, requested)
    if good is not None:
        requested = requested._replace(lag_s=good.corrections.removed_lag_s)
    records = [characterise(path, strut, requested) for path in paths]
    model = None if good is None else master_of(good)
    return [
        DamperReport(
            record,
            () if band is None else evaluate_band(record.steps, band),
            None if model is None else name_faults(record, model, scatter),
            good,
        )
        for record in records
    ]


def content_of(
    reports: Sequence[DamperReport], serial: str | None, band: ToleranceBand | None
) -> dict[str, object]:
    """Content of `characteristics.json`."""
    return {
        "schema": 1,
        "serial": serial,
        "tolerance": None if band is None else band.name,
        "records": [report.as_dict() for report in reports],
    }


def write_content(content: object, folder: Path, name: str = CHARACTERISTICS_FILE) -> None:
    """Write a JSON file into a folder, which is made if it is missing.

    Raises:
        InputError: The folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / name, json_text(content))
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written: {error.strerror}") from error
