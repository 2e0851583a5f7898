"""Runs in, diagnosis out: what `rig diagnose` does but for its page."""

from collections.abc import Sequence
from pathlib import Path

from dart_model.spec import ModelSpec
from dart_model.yaml_file import InputError
from rig.diagnosis.diagnose import diagnose
from rig.diagnosis.outcome import Result, write_results
from rig.diagnosis.progress import Progress
from rig.diagnosis.recording import read_recording
from rig.io.run_log import RUN_FILE


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
        progress: Told what is being done, and the share that is done.

    Raises:
        InputError: A run cannot be read, or `out` cannot be written or holds a run.
        RecordingError: A run holds nothing that can be diagnosed.
    """
    if (out / RUN_FILE).exists():
        raise InputError(f"{out}: holds a run, expected another folder for what was found")
    names = [strut.name for strut in model.struts]
    result = diagnose(
        model,
        [read_recording(path, names) for path in runs],
        [read_recording(path, names) for path in held_out],
        progress,
    )
    progress("writing what was found", 1.0)
    try:
        write_results(result, model, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return result
