"""Hardware-in-the-loop bridge over CAN between a shock-absorber bench and a DART model.

Functions for scripts and notebooks:

    import rig

    run = rig.open_run("runs/7")                       # arrays by column, with units in the names
    outcome = rig.diagnose(["runs/7"], "bench_model.yaml", held_out=["test.csv"])
    outcome.write("diagnosis")

Each function imports what it needs when it is called: DART and numba take seconds.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dart_model.spec import ModelSpec
    from rig.formats.run_arrays import Run
    from rig.pages.diagnosis_outcome import DiagnosisOutcome
    from rig.recordings.recording import Recording

__all__ = ["diagnose", "load_model", "open_run", "read_csv"]


def load_model(name: Path | str) -> "ModelSpec":
    """A model from its YAML file, or a shipped one by its name.

    Raises:
        InputError: One line that names file, key, value and what was expected.
    """
    from dart_model import spec

    return spec.load_named_model(str(name), Path())


def open_run(folder: Path | str) -> "Run":
    """A run of the bridge as arrays.

    Raises:
        InputError: It is no run, or damaged.
    """
    from rig.formats import run_arrays

    return run_arrays.open_run(folder)


def read_csv(path: Path | str, struts: Sequence[str] | None = None) -> "Recording":
    """A recording from a CSV file with units in its header.

    Args:
        path: The file.
        struts: Names of the model's struts, where columns name them.

    Raises:
        InputError: The file is no such table, or none of its columns can be diagnosed.
    """
    from rig.recordings import csv_file, recording_checks

    return recording_checks.check_recording(csv_file.read_csv(Path(path), struts))


def diagnose(
    runs: Sequence["Path | str | Recording"],
    model: "Path | str | ModelSpec",
    held_out: Sequence["Path | str | Recording"] = (),
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> "DiagnosisOutcome":
    """Identify the effects that a model lacks, correct it, and evaluate it on held-out data.

    Args:
        runs: Recordings, or folders of runs and CSV files, for search and fit.
        model: The nominal model, its file, or the name of a shipped one.
        held_out: Held-out recordings; without them, blocks spread over `runs` are held out.
        progress: Called with the stage that is running and the share that is done.

    Returns:
        The outcome; a notebook shows its tables.

    Raises:
        InputError: A recording or the model cannot be used.
    """
    from dart_model.spec import ModelSpec
    from rig.diagnosis import diagnose as diagnosis
    from rig.pages.diagnosis_outcome import DiagnosisOutcome
    from rig.recordings.read import read_recording
    from rig.recordings.recording import Recording

    spec = model if isinstance(model, ModelSpec) else load_model(model)
    struts = [strut.name for strut in spec.struts]

    def read(given: "Path | str | Recording") -> Recording:
        return given if isinstance(given, Recording) else read_recording(Path(given), struts)

    result = diagnosis.diagnose(spec, [*map(read, runs)], [*map(read, held_out)], progress)
    return DiagnosisOutcome(result, spec)
