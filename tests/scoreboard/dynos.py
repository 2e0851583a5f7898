"""Dampers on a dyno: the motion is prescribed, the residual is in the force.

References:
    Downey, Cao, Laflamme, Taylor, Ricles, "High capacity variable friction damper based on band
    brake technology", Engineering Structures 113 (2016): the banded rotary friction damper.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rig.diagnosis.files import diagnose_runs
from rig.diagnosis.progress import Progress, within
from rig.formats.mapping import load_mapping
from rig.pages.report import write_report
from rig.plan.config import CONFIGS
from rig.recordings.read import read_recording
from rig.recordings.recording import RecordingError
from tests.scoreboard.parts import Part, imported
from tests.scoreboard.starts import dyno_start
from tests.scoreboard.table import CORRECTED, Row, findings

_UNIT = "RMSE in % of the force's standard deviation"
_LINEAR = "rig, spring and damper"
_MR, _MR_FOLDER = "MR damper", "mr_damper"
_HALVED = "5mm3Hz1A"
"""The record of which the second half is predicted from the first."""
_CURRENTS = ("1A", "0x5A", "0A")
_BRFD, _BRFD_FOLDER = "Friction damper with play", "brfd"
_BRFD_LEARNT = (
    ("0.5Hz30lb1in",),
    ("0.25Hz30lb0.5in", "1Hz30lb1.5in", "2Hz30lb0.5in"),
)
"""From a record amid the others, and from the slowest, the widest and the fastest one."""


class _Split(NamedTuple):
    """Records to learn from, and to be tested on, by name."""

    learnt: Mapping[str, Path]
    tests: Mapping[str, Path]


def mr_damper_rows(data_folder: Path | None, out: Path, progress: Progress) -> list[Row]:
    """One half of a record from the other, and each record from the others of its coil current."""
    if data_folder is None or not (data_folder / _MR_FOLDER).is_dir():
        return []
    sources = {path.stem: path for path in sorted((data_folder / _MR_FOLDER).glob("*.txt"))}
    folder, mapping = out / _MR_FOLDER, load_mapping(CONFIGS / "dyno_mapping.yaml")
    splits: list[_Split] = []
    if _HALVED in sources:
        half = sum(1 for _ in sources[_HALVED].open("rb")) // 2
        parts = Part("first half", 0, half), Part("second half", half, 2 * half)
        first, second = (
            {f"{_HALVED}, {part.name}": imported(sources[_HALVED], mapping, part, folder / name)}
            for part, name in zip(parts, ("first_half.csv", "second_half.csv"), strict=True)
        )
        splits.append(_Split(first, second))
    for current in _CURRENTS:
        alike = {
            name: imported(path, mapping, None, folder / f"{name}.csv")
            for name, path in sources.items()
            if name.endswith(f"Hz{current}")
        }
        splits += _one_left_out(alike)
    return _rows(_MR, splits, folder, progress)


def brfd_rows(data_folder: Path | None, out: Path, progress: Progress) -> list[Row]:
    """The other records from one, and from three; none without the set."""
    if data_folder is None or not (data_folder / _BRFD_FOLDER).is_dir():
        return []
    files = {path.stem: path for path in sorted((data_folder / _BRFD_FOLDER).glob("*.csv"))}
    splits = [
        _Split(
            {name: files[name] for name in learnt},
            {name: path for name, path in files.items() if name not in learnt},
        )
        for learnt in _BRFD_LEARNT
        if set(learnt) < set(files)
    ]
    return _rows(_BRFD, splits, out / _BRFD_FOLDER, progress)


def _one_left_out(files: Mapping[str, Path]) -> Iterable[_Split]:
    for name, path in files.items():
        others = {other: there for other, there in files.items() if other != name}
        if others:
            yield _Split(others, {name: path})


def _rows(dataset: str, splits: Sequence[_Split], folder: Path, progress: Progress) -> list[Row]:
    rows: list[Row] = []
    for i, split in enumerate(splits):
        share = within(progress, i / len(splits), (i + 1) / len(splits), dataset)
        rows += _split_rows(dataset, split, folder / f"split_{i + 1}", share)
    return rows


def _split_rows(dataset: str, split: _Split, folder: Path, progress: Progress) -> list[Row]:
    """Force errors on every test, and over all of them where there are several."""
    runs, tests = list(split.learnt.values()), list(split.tests.values())
    model = dyno_start([read_recording(path) for path in runs], dataset.replace(" ", "_"))
    learnt = ", ".join(split.learnt)
    try:
        result = diagnose_runs(runs, model, tests, folder, progress)
    except RecordingError as error:
        why = f"computed here, trained on `{learnt}`; refused: {error}"
        return [Row(dataset, test, CORRECTED, None, _UNIT, why) for test in split.tests]
    write_report(result, folder / "report.html")
    sizes: list[float] = []
    before: list[float] = []
    after: list[float] = []
    for path, figures in zip(tests, result.diagnosis.held_out.runs, strict=True):
        force, error = read_recording(path).strut_forces_n, figures.strut_force_rmse_n
        if force is not None and error is not None:
            sizes.append(float(np.std(force)))
            before.append(error.before)
            after.append(error.after)
    how = f"computed here, trained on `{learnt}`; {findings(result.diagnosis)}"
    sources = {
        _LINEAR: (before, f"computed here, least squares on `{learnt}`"),
        CORRECTED: (after, how),
    }
    rows: list[Row] = []
    for name, (errors, source) in sources.items():
        if len(split.tests) > 1:
            rows.append(Row(dataset, "the others", name, _percent(errors, sizes), _UNIT, source))
        rows += [
            Row(dataset, test, name, _percent([error], [size]), _UNIT, source)
            for test, error, size in zip(split.tests, errors, sizes, strict=True)
        ]
    return rows


def _percent(errors: Sequence[float], sizes: Sequence[float]) -> float:
    """Root mean square of all errors, as a share of that of all forces."""
    return 100.0 * float(np.linalg.norm(errors) / np.linalg.norm(sizes))
