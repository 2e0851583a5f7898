"""Reads recordings from wherever a run was measured: a CSV file or a run's folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from can_dbc.errors import InputError
from rig.files.hashes import hash_files
from rig.log.file_names import STEPS_FILE, parts
from rig.recordings.csv_file import read_csv
from rig.recordings.exported_csv import is_export, read_export
from rig.recordings.recording import Recording
from rig.recordings.recording_checks import check_recording
from rig.recordings.run_folder import read_run


def read_recording(path: Path, struts: Sequence[str] | None = None) -> Recording:
    """Recording from a run's folder or from a CSV file, whose columns may name `struts`.

    Raises:
        InputError: There is no such run.
        DamageError: Its frames or steps have changed since they were written.
        RecordingError: It holds nothing that can be diagnosed.
    """
    if path.is_dir():
        recording, files = read_run(path), parts(path, STEPS_FILE)
    elif path.is_file():
        read = read_export if is_export(path) else read_csv
        recording, files = read(path, struts), [path]
    else:
        kind = "is neither file nor folder" if path.exists() else "no such run"
        raise InputError(f"{path}: {kind}, expected a run's folder or a CSV file")
    return replace(check_recording(recording), sha256=hash_files(files))
