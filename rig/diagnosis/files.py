"""Recordings in, diagnosis out: `rig diagnose` without its page."""

import os
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, dump_model, files_of
from rig.diagnosis.determinable import find_determinable
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import (
    CORRECTED_FILE,
    DIAGNOSIS_FILE,
    REPORT_FILE,
    DiagnosisSource,
    Result,
    write_results,
)
from rig.diagnosis.progress import Progress
from rig.diagnosis.search.criteria import CRITERIA, SelectionCriteria
from rig.log.file_names import RUN_FILE
from rig.recordings.read import read_recording
from rig.recordings.recording import Recording


def diagnose_runs(
    runs: Sequence[Path],
    model: ModelSpec,
    held_out: Sequence[Path],
    out: Path,
    progress: Progress,
    criteria: SelectionCriteria = CRITERIA,
) -> Result:
    """Diagnose runs (folders or CSV files); write diagnosis and corrected model into `out`.

    Raises:
        InputError: A run cannot be read or is given twice, or `out` cannot be written or holds a
            run.
        RecordingError: A run holds nothing that can be diagnosed.
    """
    _check_folder(out, model)  # Before a search that takes minutes, not after it.
    paths = (*runs, *held_out)
    for i, path in enumerate(paths):
        if path.resolve() in {other.resolve() for other in paths[:i]}:
            raise InputError(f"{path}: given twice, expected each run once: held-out ones are new")
    names = [strut.name for strut in model.struts]
    recordings = [read_recording(path, names) for path in paths]
    learnt, evaluated = recordings[: len(runs)], recordings[len(runs) :]
    progress("checking what the recordings determine", 0.0)
    determinable = find_determinable(model, learnt)
    result = replace(
        diagnose(model, learnt, evaluated, progress, criteria),
        determinable=determinable,
        sources=(
            DiagnosisSource(
                "nominal model", model.name, sha256(dump_model(model).encode()).hexdigest()
            ),
            *map(_source, ["fitted"] * len(runs) + ["held out"] * len(held_out), paths, recordings),
        ),
    )
    progress("writing the diagnosis", 1.0)
    try:
        write_results(result, model, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return result


def _source(role: str, path: Path, recording: Recording) -> DiagnosisSource:
    return DiagnosisSource(role, str(path), recording.sha256 or "")


def _check_folder(out: Path, model: ModelSpec) -> None:
    """Refuse a folder that holds a run or a diagnosis, or that cannot be written."""
    if (out / RUN_FILE).exists():
        raise InputError(f"{out}: holds a run, expected another folder for the diagnosis")
    for name in (DIAGNOSIS_FILE, CORRECTED_FILE, REPORT_FILE, "report.pdf"):
        if (out / name).exists():
            raise InputError(f"{out}: holds {name} already, expected a folder without one")
    for name in files_of(model):
        copied = out / name
        if copied.exists() and not copied.samefile(model.folder / name):
            raise InputError(f"{copied}: exists already, expected a folder without it")
    existing = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"{out}: cannot be written: {existing}: expected a folder to write into")
