"""All measured sets that are there, one after another.

Sets that are not there are passed over, and nothing is downloaded.
"""

from collections.abc import Collection
from pathlib import Path

from can_dbc.errors import InputError
from rig.diagnosis.progress import Progress
from tests.scoreboard.dynos import brfd_rows, mr_damper_rows
from tests.scoreboard.emps import emps_rows
from tests.scoreboard.silverbox import silverbox_rows
from tests.scoreboard.table import Row, write_scoreboard

SETS = {
    "silverbox": silverbox_rows,
    "emps": emps_rows,
    "brfd": brfd_rows,
    "mr_damper": mr_damper_rows,
}
"""Measured sets by the name of their folder."""


def run_scoreboard(
    data_folder: Path | None, out: Path, progress: Progress, only: Collection[str] = ()
) -> list[Row]:
    """Diagnose every measured set that is there, and set our figures beside the published ones.

    Args:
        data_folder: Folder with any of `silverbox/SNLS80mV.csv`, `emps/*.csv`, `brfd/*.csv`,
            `mr_damper/*.txt`; without it only what the package nonlinear_benchmarks has on this
            machine is found.
        out: Folder to write into: `scoreboard.csv`, `scoreboard.md`, and a folder for each
            diagnosis.
        progress: Called with what is being done.
        only: Names of `SETS`; all if empty.

    Returns:
        All rows, set after set.

    Raises:
        InputError: No set is there, a name is none of `SETS`, a file is wrong, or `out` cannot be
            written.
    """
    unknown = sorted(set(only) - set(SETS))
    if unknown:
        raise InputError(f"set {unknown[0]!r}: expected one of {', '.join(SETS)}")
    rows: list[Row] = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, rows_of in SETS.items():
            if not only or name in only:
                rows += rows_of(data_folder, out, progress)
        if not rows:
            raise InputError(
                f"{data_folder or 'no data folder'}: holds no measured set, expected one of "
                f"{', '.join(only or SETS)} there; nonlinear_benchmarks has none here"
            )
        write_scoreboard(rows, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return rows
