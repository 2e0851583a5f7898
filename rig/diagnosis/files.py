"""Runs in, diagnosis out: what `rig diagnose` does but for its page."""

import os
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

from can_dbc.errors import InputError
from dart_model.spec import ModelSpec, dump_model, files_of
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import (
    CORRECTED_FILE,
    DIAGNOSIS_FILE,
    REPORT_FILE,
    Result,
    Source,
    write_results,
)
from rig.diagnosis.progress import Progress
from rig.diagnosis.recording import read_recording
from rig.log.file_names import RUN_FILE, STEPS_FILE, parts


def diagnose_runs(
    runs: Sequence[Path],
    model: ModelSpec,
    held_out: Sequence[Path],
    out: Path,
    progress: Progress,
) -> Result:
    """Diagnose runs, and write the diagnosis and the corrected model.

    Args:
        runs: Folders of runs, or CSV files.
        model: The nominal model.
        held_out: Runs to judge on.
        out: Folder to write into.
        progress: Called with what is being done, and the share that is done.

    Raises:
        InputError: A run cannot be read or is given twice, or `out` cannot be written or holds a
            run.
        RecordingError: A run holds nothing that can be diagnosed.
    """
    if (out / RUN_FILE).exists():
        raise InputError(f"{out}: holds a run, expected another folder for what was found")
    # Before a search that takes minutes, not after it.
    for name in (DIAGNOSIS_FILE, CORRECTED_FILE, REPORT_FILE, "report.pdf"):
        if (out / name).exists():
            raise InputError(f"{out}: holds {name} already, expected a folder without one")
    for name in files_of(model):
        copied = out / name
        if copied.exists() and not copied.samefile(model.folder / name):
            raise InputError(f"{copied}: exists already, expected a folder without it")
    standing = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    if not standing.is_dir() or not os.access(standing, os.W_OK):
        raise InputError(f"{out}: cannot be written: {standing}: expected a folder to write into")
    given = (*runs, *held_out)
    for i, path in enumerate(given):
        if path.resolve() in {other.resolve() for other in given[:i]}:
            raise InputError(f"{path}: given twice, expected each run once: held-out ones are new")
    names = [strut.name for strut in model.struts]
    result = diagnose(
        model,
        [read_recording(path, names) for path in runs],
        [read_recording(path, names) for path in held_out],
        progress,
    )
    sources = [
        Source("nominal model", model.name, sha256(dump_model(model).encode()).hexdigest()),
        *(Source("fitted", str(path), _fingerprint(path)) for path in runs),
        *(Source("held out", str(path), _fingerprint(path)) for path in held_out),
    ]
    result = replace(result, sources=tuple(sources))
    progress("writing what was found", 1.0)
    try:
        write_results(result, model, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return result


def _fingerprint(path: Path) -> str:
    """SHA-256 of a recording: of a run's steps, part by part, or of the file."""
    found = sha256()
    for part in parts(path, STEPS_FILE) if path.is_dir() else [path]:
        with part.open("rb") as file:
            while piece := file.read(1 << 20):
                found.update(piece)
    return found.hexdigest()
